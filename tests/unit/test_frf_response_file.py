"""A frequency response checks itself and survives its file."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from fieldtool.errors import FileFormatError, OutputError
from fieldtool.frf.response import FrequencyResponse, load_responses, save_responses
from tests.seeds import fresh_seed


def random_response(seed: int) -> FrequencyResponse:
    rng = np.random.default_rng(seed)
    values = rng.standard_normal((4, 2, 2)) + 1j * rng.standard_normal((4, 2, 2))
    std = rng.random((4, 2, 2))
    values[1, 0, 1], std[1, 0, 1] = np.nan, np.nan
    return FrequencyResponse(("a", "b"), np.array([1.0, 2, 3, 5]), values, std, "others free")


def test_a_file_gives_back_what_was_saved(tmp_path: Path) -> None:
    seed = fresh_seed() // 2
    saved = {"free": random_response(seed), "locked a/b": random_response(seed + 1)}
    save_responses(saved, tmp_path / "f.h5")
    found = load_responses(tmp_path / "f.h5")
    assert list(found) == list(saved)
    for name, one in saved.items():
        assert (found[name].axes, found[name].condition) == (one.axes, one.condition)
        for field in ("frequencies", "response", "std"):
            np.testing.assert_array_equal(getattr(found[name], field), getattr(one, field))


def test_an_element_skips_what_was_not_measured() -> None:
    one = random_response(0)
    f, values, std = one.element("a", "b")
    np.testing.assert_array_equal(f, [1, 3, 5])
    np.testing.assert_array_equal(values, one.response[[0, 2, 3], 0, 1])
    assert std.shape == (3,)
    np.testing.assert_allclose(one.complex_std[0], one.std[0] * 2**0.5)
    with pytest.raises(KeyError, match="no axis 'q' among a, b"):
        one.element("q", "a")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"frequencies": np.array([1.0, 2, 2, 5])}, "must rise"),
        ({"frequencies": np.array([0.0, 2, 3, 5])}, "above 0 Hz"),
        ({"frequencies": np.array([1.0, 2, 3])}, "response must have shape"),
        ({"std": np.zeros((4, 2, 2))}, "NaN at the same places"),
        ({"std": -random_response(0).std}, "must not be negative"),
        ({"response": np.full((4, 2, 2), np.inf + 0j)}, "infinite"),
        ({"axes": ()}, "axes named"),
    ],
)
def test_a_faulty_response_is_refused(changes: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        replace(random_response(0), **changes)  # type: ignore[arg-type]


def test_files_that_are_not_ours(tmp_path: Path) -> None:
    path = tmp_path / "f.h5"
    save_responses({"x": random_response(0)}, path)
    with h5py.File(path, "r+") as file:
        del file["responses/0000/std"]
    with pytest.raises(FileFormatError, match="in /responses/0000: the dataset 'std' is missing"):
        load_responses(path)
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "fieldtool-recording/1"
    with pytest.raises(FileFormatError, match="expected 'fieldtool-frequency-response/1'"):
        load_responses(path)
    with pytest.raises(OutputError, match="no folder"):
        save_responses({}, tmp_path / "no" / "f.h5")
