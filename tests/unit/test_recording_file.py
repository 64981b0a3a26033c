"""A recording survives its file; a file is whole or not there, and says what is wrong with it."""

import errno
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from fieldtool.errors import FileFormatError, OutputError
from fieldtool.records.csv_folder import read_folder, write_folder
from fieldtool.records.hdf5_file import MemoryFile
from fieldtool.records.recording import (
    AxisInfo,
    Controller,
    Experiment,
    Recording,
    RecordingWriter,
    Segment,
    load,
    recorded_seconds,
    save,
    whole_kinds,
)
from tests.seeds import fresh_seed


def random_recording(seed: int, experiments: int = 3) -> Recording:
    rng = np.random.default_rng(seed)
    M = int(rng.integers(1, 4))
    axes = tuple(
        AxisInfo(
            f"axis {i} ä",
            "linear" if i % 2 else "rotary",
            masses=int(rng.integers(1, 5)) if rng.random() < 0.5 else None,
            motor_inertia=rng.random() + 0.1 if rng.random() < 0.5 else None,
            rated_torque=rng.random() + 0.1 if rng.random() < 0.5 else None,
            encoder_counts_per_rev=2.0**20 if rng.random() < 0.5 else None,
            controller=Controller(*rng.random(4)) if rng.random() < 0.5 else None,
            torque_unit="N" if i % 2 else "N m",
            position_unit="m" if i % 2 else "rad",
        )
        for i in range(M)
    )
    return Recording(
        0.004,
        axes,
        tuple(random_experiment(rng, k, axes) for k in range(experiments)),
        "any machine: with a colon, # and ä",
        {"tool": "0.1", "operator": "me"},
    )


def random_experiment(
    rng: np.random.Generator, number: int, axes: tuple[AxisInfo, ...]
) -> Experiment:
    n, M = int(rng.integers(200, 400)), len(axes)
    scale = 10.0 ** rng.integers(-12, 6)

    def signal() -> np.ndarray:
        return rng.standard_normal((n, M)) * scale

    reference = signal()
    reference[:, -1] = np.nan
    held = round(100 * 0.004 * 5.0)
    return Experiment(
        name=f"sweep {number}/a",
        kind="stepped_sine",
        driven=(axes[0].name,),
        free=tuple(axis.name for axis in axes[1:]),
        period=float(rng.random() + 0.1) if rng.random() < 0.5 else None,
        time=rng.random() + np.arange(n) * 0.004,
        position=signal(),
        torque=signal(),
        position_reference=reference if M > 1 else signal(),
        torque_reference=signal() if rng.random() < 0.5 else None,
        velocity=signal() if rng.random() < 0.5 else None,
        statusword=rng.integers(0, 65536, (n, M)).astype(np.uint16),
        extra={f"{axes[0].name}.load": rng.standard_normal(n)} if rng.random() < 0.7 else {},
        segments=(
            Segment(0, 100, 5.0, held, True, "first"),
            Segment(100, 190, 7.123, None, False),
        ),
        complete=bool(rng.random() < 0.5),
        note="cut: by hand",
    )


def assert_same(a: Recording, b: Recording) -> None:
    assert (a.sample_period, a.axes, a.description, dict(a.source)) == (
        b.sample_period,
        b.axes,
        b.description,
        dict(b.source),
    )
    assert len(a.experiments) == len(b.experiments)
    for one, other in zip(a.experiments, b.experiments, strict=True):
        for name, value in vars(one).items():
            found = getattr(other, name)
            if isinstance(value, np.ndarray):
                assert value.dtype == found.dtype
                np.testing.assert_array_equal(value, found, err_msg=name)
            elif name == "extra":
                assert value.keys() == found.keys()
                for key in value:
                    np.testing.assert_array_equal(value[key], found[key])
            else:
                assert value == found, name


@pytest.mark.parametrize("_", range(5))
def test_file_and_folder_give_back_what_was_saved(tmp_path: Path, _: int) -> None:
    seed = fresh_seed()
    original = random_recording(seed)
    save(original, tmp_path / "r.h5")
    assert_same(original, load(tmp_path / "r.h5"))
    write_folder(original, tmp_path / "folder")
    assert_same(original, read_folder(tmp_path / "folder"))


def test_a_recording_without_experiments_is_a_file_too(tmp_path: Path) -> None:
    original = random_recording(1, experiments=0)
    save(original, tmp_path / "r.h5")
    assert_same(original, load(tmp_path / "r.h5"))


def test_the_writer_keeps_the_file_whole_after_each_experiment(tmp_path: Path) -> None:
    full = random_recording(2)
    header = Recording(full.sample_period, full.axes, (), full.description, full.source)
    path = tmp_path / "r.h5"
    with RecordingWriter(path, header) as writer:
        for count, experiment in enumerate(full.experiments):
            assert len(load(path).experiments) == count
            writer.append(experiment)
        assert_same(writer.recording, full)
    assert_same(load(path), full)
    assert [p.name for p in tmp_path.iterdir()] == ["r.h5"]


def test_raw_data_survive_the_death_of_the_program(tmp_path: Path) -> None:
    script = f"""
import os, signal, sys
import numpy as np
from fieldtool.records.recording import AxisInfo, Experiment, Recording, RecordingWriter
writer = RecordingWriter({str(tmp_path / "r.h5")!r}, Recording(0.01, (AxisInfo("x", "rotary"),)))
t = np.arange(100) * 0.01
for name in ("one", "two"):
    writer.append(Experiment(name, "other", ("x",), (), None, t, t[:, None], t[:, None]))
os._exit(9)
"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", script], env=environment, check=False)
    assert done.returncode == 9
    assert [e.name for e in load(tmp_path / "r.h5").experiments] == ["one", "two"]


def test_an_experiment_of_another_machine_is_not_appended(tmp_path: Path) -> None:
    full = random_recording(3)
    header = Recording(1.0, full.axes)
    with RecordingWriter(tmp_path / "r.h5", header) as writer:
        with pytest.raises(ValueError, match="sample period is given as 1 s"):
            writer.append(full.experiments[0])
        assert writer.recording.experiments == ()
    assert load(tmp_path / "r.h5").experiments == ()


def test_a_full_disk_keeps_the_old_file_and_the_experiment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = random_recording(4)
    path = tmp_path / "r.h5"
    with RecordingWriter(path, Recording(full.sample_period, full.axes)) as writer:
        writer.append(full.experiments[0])
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", _no_space)
            with pytest.raises(OutputError, match=r"r\.h5 can not be written: no room for .* MiB"):
                writer.append(full.experiments[1])
        assert len(load(path).experiments) == 1
        assert [p.name for p in tmp_path.iterdir()] == ["r.h5"]
        writer.flush()
    assert len(load(path).experiments) == 2


def test_a_heap_without_end_is_refused_and_holds_nobody_up(tmp_path: Path) -> None:
    """Free room of no size: the HDF5 library would walk round in it for ever."""
    path = tmp_path / "r.h5"
    save(random_recording(5), path)
    content = bytearray(path.read_bytes())
    at = content.index(b"GCOL") + 16
    while int.from_bytes(content[at : at + 2], "little"):
        size = int.from_bytes(content[at + 8 : at + 16], "little")
        at += 16 + (size + 7) // 8 * 8
    content[at + 8 : at + 16] = bytes(8)
    path.write_bytes(content)
    for read in (load, recorded_seconds):
        with pytest.raises(FileFormatError, match=r"is damaged .*heap without end at byte"):
            read(path)


def test_a_text_of_an_unknown_kind_is_refused_and_kills_nobody(tmp_path: Path) -> None:
    """One changed byte in the type of an attribute; the HDF5 library itself would not survive it."""
    text, unknown = bytes.fromhex("190101001000"), bytes.fromhex("19eb01001000")
    path = tmp_path / "r.h5"
    save(random_recording(5, 1), path)
    whole = path.read_bytes()
    at, files = whole.find(text), []
    while at >= 0:
        files.append(tmp_path / f"{at}.h5")
        files[-1].write_bytes(whole[:at] + unknown + whole[at + len(unknown) :])
        at = whole.find(text, at + 1)
    assert len(files) > 10
    program = (
        "import sys\nfrom pathlib import Path\nfrom fieldtool.errors import FileFormatError\n"
        "from fieldtool.records.recording import load\n"
        "for file in sys.argv[1:]:\n"
        "    try:\n        load(Path(file))\n"
        "    except FileFormatError:\n        print('refused')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, files)],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["refused"] * len(files)


@pytest.mark.skipif(sys.platform == "win32", reason="needs a limit on the size of files")
def test_a_limit_on_the_size_of_files_is_a_clear_error(tmp_path: Path) -> None:
    script = f"""
import resource
import numpy as np
from fieldtool.errors import OutputError
from fieldtool.records.recording import AxisInfo, Experiment, Recording, save
t = np.arange(200000) * 0.01
values = np.random.default_rng(0).standard_normal((t.size, 1))
one = Experiment("one", "other", ("x",), (), None, t, values, values)
resource.setrlimit(resource.RLIMIT_FSIZE, (100000, 100000))
try:
    save(Recording(0.01, (AxisInfo("x", "rotary"),), (one,)), {str(tmp_path / "r.h5")!r})
except OutputError as error:
    print(error)
"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, check=True, capture_output=True, text=True
    )
    assert "no room for" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"there is no folder .*missing"):
        save(random_recording(5), tmp_path / "missing" / "r.h5")
    with pytest.raises(OutputError, match="is a folder"):
        save(random_recording(5), tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="can not be made"):
        write_folder(random_recording(5), tmp_path / "file" / "folder")


def test_a_folder_that_is_not_writable_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr("tempfile.mkstemp", refuse)
    with pytest.raises(OutputError, match=r"Permission denied.*check that the folder"):
        save(random_recording(6), tmp_path / "r.h5")


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    with pytest.raises(FileFormatError, match=r"can not be opened \(No such file"):
        load(path)
    with pytest.raises(FileFormatError, match="is not a file"):
        load(tmp_path)
    path.write_text("time,position\n0,0\n")
    with pytest.raises(FileFormatError, match="is not a readable HDF5 file"):
        load(path)
    with h5py.File(path, "w") as file:
        file.attrs["format"] = "fieldtool-recording/99"
    with pytest.raises(FileFormatError, match="format 'fieldtool-recording/99', expected"):
        load(path)
    with h5py.File(path, "w"):
        pass
    with pytest.raises(FileFormatError, match="has the format None"):
        load(path)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda f: f["experiments/0001"].pop("torque"), "in /experiments/0001: the dataset 'torq"),
        (lambda f: f["experiments/0001"].pop("extra"), "the group 'extra' is missing"),
        (lambda f: f["axes/0000"].attrs.pop("kind"), "in /axes/0000: the attribute 'kind'"),
        (lambda f: f.pop("source"), "the group 'source' is missing"),
        (lambda f: f.attrs.create("sample_period", "often"), "'sample_period' is no number"),
        (lambda f: f.attrs.modify("sample_period", -1.0), "sample period must be positive"),
        (lambda f: f.attrs.modify("sample_period", 0.1), "the sample period is given as 0.1 s"),
        (lambda f: _replace(f["experiments/0000"], "torque", np.zeros(7)), "the shape .7,."),
        (lambda f: _replace(f["experiments/0000"], "torque", np.zeros((7, 1))), "must have the"),
        (
            lambda f: _replace(f["experiments/0000"], "time", np.array([b"a", b"b"])),
            "'time' holds",
        ),
        (
            lambda f: f["experiments/0000"].attrs.create(
                "note", b"\xff", dtype=h5py.string_dtype()
            ),
            "'note' is no text",
        ),
        (lambda f: f["experiments/0000"].attrs.modify("kind", "dance"), "kind must be one of"),
    ],
)
def test_a_damaged_file_is_refused_with_the_place(tmp_path: Path, damage, words: str) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "r.h5"
    save(random_recording(7), path)
    with h5py.File(path, "r+") as file:
        damage(file)
    with pytest.raises(FileFormatError, match=words):
        load(path)


def test_half_a_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    save(random_recording(8), path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(FileFormatError, match="not a readable HDF5 file"):
        load(path)


def test_the_seconds_of_a_recording_are_those_of_its_rows(tmp_path: Path) -> None:
    recording = random_recording(fresh_seed())
    save(recording, tmp_path / "r.h5")
    rows = sum(e.samples for e in recording.experiments)
    assert recorded_seconds(tmp_path / "r.h5") == pytest.approx(rows * recording.sample_period)


def test_the_kinds_of_whole_experiments_are_those_of_experiments_that_ended(tmp_path: Path) -> None:
    recording = random_recording(7)
    kinds = ("multisine", "moves", "stepped_sine")
    experiments = tuple(
        replace(recording.experiments[0], name=kind, kind=kind, complete=kind != "multisine")
        for kind in kinds
    )
    save(replace(recording, experiments=experiments), tmp_path / "r.h5")
    assert whole_kinds(tmp_path / "r.h5") == {"moves", "stepped_sine"}


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda f: f["experiments/0001"].pop("time"), "in /experiments/0001: the dataset 'time'"),
        (lambda f: _replace(f, "experiments", np.zeros(3)), "the group 'experiments' is missing"),
        (lambda f: _replace(f["experiments/0000"], "time", np.array(1.0)), "has no rows"),
        (lambda f: f.attrs.modify("sample_period", np.nan), "are nan s"),
        (lambda f: f.attrs.modify("sample_period", np.inf), "are inf s"),
        (lambda f: f.attrs.modify("sample_period", -1.0), "are -"),
        (lambda f: f.attrs.create("sample_period", "often"), "'sample_period' is no number"),
        (lambda f: f.attrs.modify("format", "any"), "has the format 'any'"),
    ],
)
def test_a_file_that_can_not_tell_its_seconds_says_why(tmp_path: Path, damage, words: str) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "r.h5"
    save(random_recording(7), path)
    with h5py.File(path, "r+") as file:
        damage(file)
    with pytest.raises(FileFormatError, match=words):
        recorded_seconds(path)


def _replace(group: h5py.Group, name: str, values: np.ndarray) -> None:
    del group[name]
    group[name] = values


def _no_space(_: int) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_several_files_are_in_memory_at_once(tmp_path):
    """One that an error left open kept all later ones of its process from being written."""
    files = [MemoryFile(f"some-format/{k}") for k in range(3)]
    for k, file in enumerate(files):
        file.write(tmp_path / f"{k}.h5")
    for k, file in enumerate(files):
        file.close()
        with h5py.File(tmp_path / f"{k}.h5", "r") as read:
            assert read.attrs["format"] == f"some-format/{k}"
