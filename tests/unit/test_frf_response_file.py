"""A frequency response checks itself and survives its file."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from fieldtool.errors import FileFormatError, OutputError
from fieldtool.frf.response import (
    FrequencyResponse,
    ModelBand,
    load_band,
    load_responses,
    save_responses,
)
from tests.fuzzed import in_words
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


BAND = ModelBand(np.geomspace(1.0, 100.0, 9), np.full((9, 2, 2), 0.01))


def test_the_band_survives_its_file_and_may_be_missing(tmp_path: Path) -> None:
    path = tmp_path / "f.h5"
    save_responses({"x": random_response(0)}, path)
    assert load_band(path) is None
    save_responses({"x": random_response(0)}, path, BAND)
    found = load_band(path)
    assert found is not None
    np.testing.assert_array_equal(found.frequencies, BAND.frequencies)
    np.testing.assert_array_equal(found.relative_std, BAND.relative_std)


@pytest.mark.parametrize("signature", [b"TREE", b"HEAP", b"SNOD"])
@pytest.mark.parametrize("read", [load_responses, load_band])
def test_a_file_whose_inner_structure_is_not_whole_is_refused(  # type: ignore[no-untyped-def]
    tmp_path: Path, read, signature: bytes
) -> None:
    """Each node of its trees of names, one after the other: what can be read is, the rest is said."""
    path = tmp_path / "f.h5"
    save_responses({"x": random_response(0), "y": random_response(1)}, path, BAND)
    whole = path.read_bytes()
    refused, at = 0, whole.find(signature)
    assert at > 0
    while at > 0:
        path.write_bytes(whole[:at] + b"0000" + whole[at + 4 :])
        refused += in_words(lambda: read(path), FileFormatError) is None
        at = whole.find(signature, at + 1)
    assert refused


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("frequencies", np.zeros(0)),
        ("frequencies", np.linspace(0.0, 8.0, 9)),
        ("frequencies", np.full(9, 3.0)),
        ("frequencies", np.arange(1.0, 9.0)),
        ("relative_std", np.zeros((8, 2, 2))),
    ],
)
def test_a_band_that_is_none_is_refused(tmp_path: Path, name: str, values: np.ndarray) -> None:
    path = tmp_path / "f.h5"
    save_responses({"x": random_response(0)}, path, BAND)
    with h5py.File(path, "r+") as file:
        del file["band"][name]
        file["band"][name] = values
    with pytest.raises(FileFormatError, match="contradicts itself"):
        load_band(path)
