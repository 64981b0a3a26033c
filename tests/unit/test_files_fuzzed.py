"""Machine profiles, models, tunings and recordings that somebody changed: refused in words, or whole."""

import math
import shutil
import time
from contextlib import suppress
from dataclasses import replace
from importlib.resources import files

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drives.errors import ProfileError
from drives.parameters import load_backup, load_journal
from drives.profile import load_drive, load_machine, packaged
from drives.sim.machine import simulated_machine
from fieldtool.design.tuning import AxisTuning, Choice, Tuning
from fieldtool.design.tuning_file import read_tuning, tuning_as_dict
from fieldtool.errors import FieldtoolError, FileFormatError
from fieldtool.identify.multisine.identify import identify_joint
from fieldtool.records.csv_folder import read_folder, write_folder
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from fieldtool.records.model_file import read_model, write_model
from fieldtool.records.raw_rows import cut_off_rows
from fieldtool.records.recording import (
    AxisInfo,
    Controller,
    Experiment,
    Recording,
    Segment,
    load,
    save,
)
from fieldtool.records.yaml_file import write_yaml
from tests.fuzzed import RAW, changed_yaml, in_words, noisy, scalars_of

MACHINES = {
    name: files("profiles").joinpath("machines", f"{name}.yaml").read_text(encoding="utf-8")
    for name in packaged("machines")
}
MANY = settings(max_examples=200, deadline=None)


def recording() -> Recording:
    """Two axes, two experiments, everything that a recording can have."""
    time = 0.001 * np.arange(40)
    rng = np.random.default_rng(3)
    two = rng.normal(size=(40, 2))
    axes = (
        AxisInfo("a", "rotary", 2, 0.1, 4.0, 2.0**20, Controller(1.0, 2.0, 3.0, 4.0)),
        AxisInfo("b", "linear", torque_unit="N", position_unit="m"),
    )
    whole = Experiment(
        "one", "multisine", ("a", "b"), (), 0.02, time, two, two + 1, two, two, two,
        np.full((40, 2), 0x27, np.uint16), {"a.load": two[:, 0]},
    )  # fmt: skip
    steps = (Segment(0, 20, 50.0, 1), Segment(20, 40, 100.0, 2, False, "late"))
    cut = Experiment(
        "two", "stepped_sine", ("a",), ("b",), None, time, two, two, segments=steps,
        complete=False, note="stopped",
    )  # fmt: skip
    return Recording(0.001, axes, (whole, cut), "all of it", {"linear_targets": "a=0.0002/1.0"})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One whole file of each kind."""
    made = tmp_path_factory.mktemp("whole")
    one = Estimate(1.0, 0.1)
    axis = AxisModel("a", "rotary", (one, one), (one,), (one,), one, one)
    other = AxisModel("b", "linear", (one,), (), (), one)
    gap = {"value": 0.1, "std": 0.01, "unit": "rad"}
    backlash = {"effect": "backlash", "axis": "a", "parameters": {"gap": gap}}
    model = MachineModel((axis, other), (Coupling(("a", "b"), 0.1, 0.01),), (backlash,))
    write_model(model, made / "model.yaml")
    gains = {"position_p": 20.0, "velocity_p": 2.0}
    tuned = tuple(AxisTuning(name, gains, 1.4, "why") for name in ("a", "b"))
    choices = (Choice("soft", 1.4, refused="too much"), Choice("normal", 1.7, kept=("a",)))
    write_yaml(made / "tuning.yaml", tuning_as_dict(Tuning(tuned, responses=choices)))
    write_folder(recording(), made / "csv")
    save(recording(), made / "recording.h5")
    return made


def _sparse(path, size):
    """A file that is said to be so large, and takes no room."""
    with path.open("wb") as file:
        file.truncate(size)
    return path


@pytest.mark.parametrize(
    ("size", "read", "error"),
    [
        (1_000_001, load_machine, ProfileError),
        (1_000_001, load_drive, ProfileError),
        (2**30, load_backup, ProfileError),
        (2**30, load_journal, ProfileError),
        (2**20 + 1, read_model, FileFormatError),
        (2**20 + 1, read_tuning, FileFormatError),
        (16 * 2**30 + 1, load, FileFormatError),
        (4 * 2**30 + 1, lambda path: cut_off_rows(path, recording()), FileFormatError),
    ],
    ids=["machine", "drive", "backup", "journal", "model", "tuning", "recording", "raw rows"],
)
def test_files_that_are_too_large_are_not_read(tmp_path, size, read, error):
    path = _sparse(tmp_path / "large.yaml", size)
    began = time.process_time()
    with pytest.raises(error, match=r"large\.yaml.*(too large|MiB, the limit is)"):
        read(path)
    assert time.process_time() - began < 5.0


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_nothing_in_a_profile_is_ever_run(folder, data):
    """Whatever a value says: python, a shell, a template, a tag of YAML."""
    marker = folder / "was-run"
    python = f"__import__('pathlib').Path({str(marker)!r}).touch()"
    words = [
        python,
        f"!!python/object/apply:os.system ['touch {marker}']",
        f"!!python/object/new:os.system ['touch {marker}']",
        f"$(touch {marker})",
        f"`touch {marker}`",
        "{{ " + python + " }}",
        f"'{{{python}}}'",
    ]
    kind = data.draw(st.sampled_from(["machines", "drives"]))
    name = data.draw(st.sampled_from(packaged(kind)))
    shipped = files("profiles").joinpath(kind)
    text = shipped.joinpath(f"{name}.yaml").read_text(encoding="utf-8")
    begin, end = data.draw(st.sampled_from(scalars_of(text)))
    path = folder / "code.yaml"
    path.write_text(text[:begin] + data.draw(st.sampled_from(words)) + text[end:])
    read = load_machine if kind == "machines" else load_drive
    in_words(lambda: read(path), ProfileError)
    assert not marker.exists()


@pytest.mark.parametrize("kind", ["null", "bool", "int", "float", "binary", "timestamp", "set",
                                  "omap", "pairs", "merge", "value", "seq", "map"])  # fmt: skip
@pytest.mark.parametrize(
    ("read", "error"), [(load_machine, ProfileError), (read_model, FileFormatError)]
)
def test_values_that_are_not_of_the_type_before_them(tmp_path, read, error, kind):
    """``!!int x`` and its like, as a value and as a key."""
    path = tmp_path / "file.yaml"
    for value in ("''", "x", "1", "-", "0x", "2020-13-45", "[1]", "[[1]]", "{a: 1}"):
        for text in (f"format: !!{kind} {value}", f"? !!{kind} {value}\n: 1"):
            path.write_text(text)
            assert in_words(lambda: read(path), error) is None, text


def numbers_in(value) -> list[float]:
    if isinstance(value, dict):
        return [n for part in value.values() for n in numbers_in(part)]
    if isinstance(value, list | tuple):
        return [n for part in value for n in numbers_in(part)]
    return [value] if isinstance(value, float) else []


@MANY
@given(st.data())
def test_machine_profiles(folder, data):
    text = MACHINES[data.draw(st.sampled_from(sorted(MACHINES)))]
    path = folder / "machine.yaml"
    path.write_bytes(data.draw(changed_yaml(text)))
    machine = in_words(lambda: load_machine(path), ProfileError)
    if machine is None:
        return
    for axis in machine.axes:
        limits = axis.limits
        for limit in (limits.velocity, limits.acceleration, limits.torque, limits.following_error):
            assert 0 < limit < math.inf
        assert -math.inf < limits.travel[0] < limits.travel[1] < math.inf
    if machine.simulation is not None:
        in_words(lambda: simulated_machine(machine), ProfileError)


@MANY
@given(st.data())
def test_models(folder, data):
    path = folder / "changed-model.yaml"
    path.write_bytes(data.draw(changed_yaml((folder / "model.yaml").read_text())))
    model = in_words(lambda: read_model(path), FileFormatError)
    if model is not None:
        assert all(map(math.isfinite, numbers_in(model.as_dict())))
        write_model(model, path)
        assert read_model(path) == model


@MANY
@given(st.data())
def test_tunings(folder, data):
    path = folder / "changed-tuning.yaml"
    path.write_bytes(data.draw(changed_yaml((folder / "tuning.yaml").read_text())))
    tuning = in_words(lambda: read_tuning(path), FileFormatError)
    if tuning is not None:
        assert all(map(math.isfinite, numbers_in(tuning_as_dict(tuning))))
        write_yaml(path, tuning_as_dict(tuning))
        assert read_tuning(path) == tuning


def same(one: Recording, other: Recording) -> bool:
    """Whether all signals agree, number by number."""
    return one.axes == other.axes and all(
        np.array_equal(a.time, b.time)
        and all(np.array_equal(v, b.signals()[n], True) for n, v in a.signals().items())
        for a, b in zip(one.experiments, other.experiments, strict=True)
    )


@MANY
@given(st.data())
def test_folders_of_csv_files(folder, tmp_path_factory, data):
    path = folder / "changed-csv"
    shutil.rmtree(path, ignore_errors=True)
    shutil.copytree(folder / "csv", path)
    if data.draw(st.booleans()):
        told = path / "recording.yaml"
        told.write_bytes(data.draw(changed_yaml(told.read_text())))
    else:
        table = path / data.draw(st.sampled_from(["one.csv", "two.csv"]))
        lines = table.read_text().splitlines()
        cells = [line.split(",") for line in lines]
        for _ in range(data.draw(st.integers(0, 2))):
            row = data.draw(st.sampled_from(cells))
            row[data.draw(st.integers(0, len(row) - 1))] = data.draw(
                st.sampled_from([*RAW, "0.0", "-1", "1e308", "a.torque", "0x10", "1_0"])
                | st.text(max_size=4)
            )
        text = "\n".join(map(",".join, cells)).encode("utf-8", "surrogatepass")
        table.write_bytes(noisy(data.draw, text) if data.draw(st.booleans()) else text)
    read = in_words(lambda: read_folder(path), FileFormatError)
    if read is not None:
        again = path / "again.h5"
        save(read, again)
        assert same(load(again), read)


def _spoil(draw: st.DrawFn, root: h5py.File) -> None:
    """Change, take out or add an attribute or a data set somewhere in the file."""
    places = [root]
    root.visititems(lambda _, item: places.append(item))
    place = draw(st.sampled_from(places))
    names = sorted(place.attrs)
    values = [
        "x", "", b"\xff", "a\nb\x1b[31m", 0, -1, 1e308, math.nan, 2**63 - 1, [1, 2], ["a", "b"],
        True, [math.inf], np.zeros((2, 2)), "multisine", "A", h5py.Empty("f"),
    ]  # fmt: skip
    if names and draw(st.booleans()):
        name = draw(st.sampled_from(names))
        del place.attrs[name]
        if draw(st.booleans()):
            place.attrs[name] = draw(st.sampled_from(values))
    elif isinstance(place, h5py.Dataset):
        group, name, held = place.parent, place.name.rsplit("/", 1)[1], place[()]
        del group[name]
        arrays = [
            held[:-1], held[:0], held.T, held * 0, held.astype(np.complex128), held.astype("f4"),
            np.array(["x"], dtype="S1"), np.full(held.shape, np.nan), np.array(1.0), held + 1e12,
            np.concatenate([held, held]),
        ]  # fmt: skip
        choice = draw(st.integers(0, len(arrays) + 1))
        if choice < len(arrays):
            group[name] = arrays[choice]
        elif choice == len(arrays):
            group.create_dataset(name, shape=(10**10, *held.shape[1:]), dtype="f8", chunks=True)
        else:
            group.create_group(name)
    elif isinstance(place, h5py.Group) and len(place):
        name = draw(st.sampled_from(sorted(place)))
        way = draw(st.sampled_from(["remove", "link", "outside", "double"]))
        if way == "double":
            place.copy(place[name], place, f"{name}9")
            return
        del place[name]
        if way == "link":
            place[name] = h5py.SoftLink("/")
        elif way == "outside":
            place[name] = h5py.ExternalLink("/etc/hostname", "/")


@MANY
@given(st.data())
def test_recordings(folder, data):
    path = folder / "changed.h5"
    whole = (folder / "recording.h5").read_bytes()
    if data.draw(st.booleans()):
        path.write_bytes(whole)
        with h5py.File(path, "r+") as root:
            for _ in range(data.draw(st.integers(1, 2))):
                with suppress(IndexError, MemoryError, TypeError, ValueError, OSError):
                    _spoil(data.draw, root)
    else:
        path.write_bytes(noisy(data.draw, whole))
    read = in_words(lambda: load(path), FileFormatError)
    if read is not None:
        again = folder / "again.h5"
        save(read, again)
        assert same(load(again), read)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_recordings_that_can_be_read_are_identified_or_refused(folder, data):
    """Numbers that a file may hold and no machine makes."""
    given_one = recording()
    numbers = st.sampled_from([0.0, 1e-300, 1e-160, 1e-30, -1.0, 1e-9, 1e9, 1e11])
    scale = np.array([data.draw(numbers), data.draw(numbers)])
    one = given_one.experiments[0]
    with np.errstate(all="ignore"):
        moved = one.position * scale[0]
        torque = one.torque * scale[1]
    source = {
        "linear_targets": data.draw(st.sampled_from(["a=", "a=x/y", "=1", "a=-1", "a=nan", ""]))
    }
    changed = Experiment("m", "multisine", ("a", "b"), (), 0.02, one.time, moved, torque, moved)
    spoilt = Recording(0.001, given_one.axes, (changed, replace(changed, name="n")), source=source)
    kinds = {"a": "rotary", "b": "linear"}
    in_words(lambda: identify_joint(spoilt, {"a": 1, "b": 1}, kinds), FieldtoolError)
