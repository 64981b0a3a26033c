"""Import of a folder with recording.yaml and CSV files: every fault names file and line."""

import os
import time
from pathlib import Path

import numpy as np
import pytest

from fieldtool.errors import FileFormatError
from fieldtool.records import csv_folder
from fieldtool.records.csv_folder import read_folder, write_folder

YAML = """\
format: fieldtool-recording/1
sample_period: 0.001
units: {time: s, position: rad, torque: N m}
axes:
  - name: a
    kind: rotary
    extra_columns: [load]
experiments:
  - {file: one.csv, kind: moves, driven: [a]}
"""
HEADER = "time,a.position_reference,a.position,a.torque,a.load"
LINES = [HEADER, *(f"{k / 1000},{k},{k}.5,-1e-3,0" for k in range(20))]


def folder(tmp_path: Path, yaml: str = YAML, lines: list[str] = LINES) -> Path:
    (tmp_path / "recording.yaml").write_text(yaml, encoding="utf-8")
    (tmp_path / "one.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return tmp_path


def changed(line: int, text: str) -> list[str]:
    return [text if number == line else old for number, old in enumerate(LINES, start=1)]


def test_a_good_folder(tmp_path: Path) -> None:
    recording = read_folder(folder(tmp_path))
    one = recording.experiment("one")
    assert recording.axes[0].torque_unit == "N m"
    assert one.driven == ("a",)
    assert one.free == ()
    assert one.torque_reference is None
    np.testing.assert_array_equal(one.position[:, 0], np.arange(20) + 0.5)
    np.testing.assert_array_equal(one.torque[:, 0], -1e-3)
    assert list(one.extra) == ["a.load"]


def test_files_as_spreadsheets_write_them(tmp_path: Path) -> None:
    """Byte order mark, CRLF, blanks around names, columns in any order, a blank last line."""
    lines = ["\ufefftime, a.torque ,a.position,a.load", "0,1,2,0", "0.001,3,4,0", ""]
    folder(tmp_path)
    (tmp_path / "one.csv").write_bytes("\r\n".join(lines).encode("utf-8"))
    one = read_folder(tmp_path).experiments[0]
    np.testing.assert_array_equal(one.torque[:, 0], [1, 3])
    assert one.position_reference is None


@pytest.mark.parametrize(
    ("lines", "line", "words"),
    [
        (changed(1, "time,a.position,a.load,a.position_reference,x"), 1, "a.torque are missing"),
        (changed(1, HEADER + ",a.temperature"), 1, "'a.temperature' are not known"),
        (changed(1, "time,a.position,a.position,a.torque,a.load"), 1, "a.position are there twice"),
        (changed(1, HEADER.replace(",", ";")), 1, "separated by semicolons"),
        (changed(7, "0.005,5,nan,0,0"), 7, "'a.position' has 'nan', expected a finite number"),
        (changed(7, "0.005,5,inf,0,0"), 7, "'a.position' has 'inf'"),
        (changed(9, "0.007,5,1,off,0"), 9, "'a.torque' has 'off'"),
        (changed(9, "0.007,5,1,,0"), 9, "'a.torque' has ''"),
        (changed(9, "0.007,5,1,1_0,0"), 9, "'a.torque' has '1_0'"),
        (changed(11, "0.009,1,2,3"), 11, "has 4 values, the header has 5 columns"),
        (changed(11, "0.009,1,2,3,4,5"), 11, "has 6 values"),
        ([HEADER, *LINES[1:8], *LINES[9:]], 9, r"1 sample\(s\) missing before this row"),
        ([HEADER, *LINES[1:8], "0.0065,1,1,1,1", *LINES[8:]], 9, "doubled or out of order"),
        ([HEADER, *LINES[1:8], LINES[7], *LINES[8:]], 9, "doubled or out of order"),
        ([HEADER, "", *LINES[1:8], "", *LINES[9:]], 11, r"1 sample\(s\) missing"),
        ([HEADER, *(f"{k / 500},0,0,0,0" for k in range(9))], 3, "steps of 0.002 s, the sample"),
        ([HEADER], 1, "no rows"),
    ],
)
def test_a_fault_in_a_csv_is_named_by_line(
    tmp_path: Path, lines: list[str], line: int, words: str
) -> None:
    with pytest.raises(FileFormatError, match=rf"one\.csv:{line}: .*{words}") as caught:
        read_folder(folder(tmp_path, lines=lines))
    assert caught.value.line == line


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("format: fieldtool-recording/1\n", "", 1, "'format' is missing"),
        ("recording/1", "recording/2", 1, "'format'"),
        ("sample_period: 0.001", "sample_period: yes", 2, "expected a number, got yes/no"),
        ("sample_period: 0.001", "sample_period: fast", 2, "'sample_period'.*not 'fast'"),
        ("sample_period: 0.001", "sample_period: -1", 2, "above 0"),
        ("sample_period: 0.001", "sample_period: .nan", 2, "finite|above 0"),
        ("position: rad", "position: deg", 3, "'units.position'.*rad or m.*'deg'"),
        ("torque: N m", "torque: kN", 3, "'units.torque'"),
        ("position: rad", "position: m", 5, "a rotary axis has positions in rad"),
        ("    kind: rotary", "    knid: rotary", 6, "'axis a, knid' is not known"),
        ("    kind: rotary", "    kind: rotary\n    colour: red", 7, "'axis a, colour' is not kno"),
        ("    kind: rotary", "    kind: rotary\n    kind: rotary", 7, "the key 'kind' twice"),
        ("    kind: rotary", "    kind: rotary\n    masses: 0", 7, "'axis a, masses'"),
        ("    kind: rotary", "    kind: rotary\n    masses: 1.5", 7, "'axis a, masses'"),
        ("name: a\n", "name: 7\n", 5, "'axis number 1, name'.*text belongs"),
        ("driven: [a]", "driven: [b]", 9, "driven axes .'b'. are not among"),
        ("kind: moves", "kind: sweep", 9, "'experiments, number 1, kind'"),
        ("one.csv", "two.csv", 9, "the file 'two.csv' is not in the folder"),
        ("one.csv", "../one.csv", 9, "must be the plain name of a file"),
        ("[load]", "[load, lamp]", None, "extra column 'a.lamp' is in none"),
        ("[load]", "[load", 8, "not valid YAML"),
        ("[load]", "&l [load]\n    other: *l", 8, "YAML alias"),
        ("units: {time: s, position: rad, torque: N m}\n", "", 1, "'units' is missing"),
        (YAML, "", None, "is empty"),
        (YAML, "[" * 500_000, 1, "nested too deeply"),
        (YAML, "- 1\n", 1, "the file"),
    ],
)
def test_a_fault_in_the_description_is_named_by_line(
    tmp_path: Path, old: str, new: str, line: int | None, words: str
) -> None:
    assert old in YAML
    with pytest.raises(FileFormatError, match=words) as caught:
        read_folder(folder(tmp_path, yaml=YAML.replace(old, new)))
    assert caught.value.path.name == "recording.yaml"
    if line is not None:
        assert caught.value.line in (line, line - 1)


def test_numbers_with_an_exponent_but_no_point_are_numbers(tmp_path: Path) -> None:
    assert read_folder(folder(tmp_path, YAML.replace("0.001", "1e-3"))).sample_period == 1e-3


def test_missing_and_large_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileFormatError, match=r"recording\.yaml: can not be opened"):
        read_folder(tmp_path)
    folder(tmp_path)
    monkeypatch.setattr(csv_folder, "MAX_CSV_BYTES", 100)
    with pytest.raises(FileFormatError, match=r"one\.csv: is .* MiB, the limit is"):
        read_folder(tmp_path)
    (tmp_path / "recording.yaml").write_bytes(b"#" * 2_000_000)
    with pytest.raises(FileFormatError, match=r"recording\.yaml: is 1\.9 MiB"):
        read_folder(tmp_path)


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    folder(tmp_path)
    (tmp_path / "one.csv").write_bytes(HEADER.encode() + b"\n0,0,0,0,0\n0.001,\xff,0,0,0\n")
    with pytest.raises(FileFormatError, match=r"one\.csv:3: is not UTF-8"):
        read_folder(tmp_path)
    (tmp_path / "recording.yaml").write_bytes(YAML.encode("utf-16"))
    with pytest.raises(FileFormatError, match=r"recording\.yaml:1: is not UTF-8"):
        read_folder(tmp_path)


def test_a_statusword_is_a_whole_number(tmp_path: Path) -> None:
    lines = [HEADER + ",a.statusword", *(line + ",4663" for line in LINES[1:])]
    one = read_folder(folder(tmp_path, lines=lines)).experiments[0]
    assert one.statusword is not None
    assert one.statusword.dtype == np.uint16
    lines[5] = LINES[5] + ",70000"
    with pytest.raises(FileFormatError, match=r"one\.csv:6: column 'a.statusword' has 70000"):
        read_folder(folder(tmp_path, lines=lines))


def real_data() -> Path:
    """Real measurements beside the project; FIELDTOOL_DATA says where if they are elsewhere."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    data = Path(os.environ.get("FIELDTOOL_DATA", beside))
    if not data.is_dir():
        pytest.skip("no real measurements beside the project; set FIELDTOOL_DATA")
    return data


@pytest.mark.parametrize(
    ("name", "rows", "extras"),
    [("emps", [24841], []), ("two-mass-bench", [50000, 50000], ["motor.load_position"])],
)
def test_real_measurements_there_and_back(
    tmp_path: Path, name: str, rows: list[int], extras: list[str]
) -> None:
    start = time.perf_counter()
    recording = read_folder(real_data() / name)
    assert time.perf_counter() - start < 5
    assert [experiment.samples for experiment in recording.experiments] == rows
    write_folder(recording, tmp_path / "again")
    again = read_folder(tmp_path / "again")
    assert again.axes == recording.axes
    for one, other in zip(recording.experiments, again.experiments, strict=True):
        assert list(one.extra) == extras
        np.testing.assert_array_equal(one.time, other.time)
        np.testing.assert_array_equal(one.torque, other.torque)
        np.testing.assert_array_equal(one.position, other.position)
        for key in extras:
            np.testing.assert_array_equal(one.extra[key], other.extra[key])
