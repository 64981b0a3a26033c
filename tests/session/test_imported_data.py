"""Data from elsewhere through the command line: what is wrong in them ends with exit code 2 or 5."""

import numpy as np
import pytest
import yaml

PERIOD, ROWS = 0.001, 4000


def folder_of(tmp_path, columns, *, names=None, step=PERIOD, header=None, file="a.csv"):
    folder = tmp_path / "data"
    folder.mkdir(exist_ok=True)
    rows = next(iter(columns.values())).size
    table = {"time": np.arange(rows) * step, **columns}
    lines = [",".join(names or table)]
    lines += [",".join(repr(float(v)) for v in row) for row in zip(*table.values(), strict=True)]
    (folder / file).write_text("\n".join(lines) + "\n")
    description = {
        "format": "fieldtool-recording/1",
        "sample_period": PERIOD,
        "units": {"time": "s", "position": "rad", "torque": "N m"},
        "axes": [{"name": "x", "kind": "rotary", "masses": 2}],
        "experiments": [{"file": file, "kind": "multisine", "driven": ["x"], "period": 1.0}],
        **(header or {}),
    }
    (folder / "recording.yaml").write_text(yaml.safe_dump(description, sort_keys=False))
    return folder


def signals(seed=1):
    rng = np.random.default_rng(seed)
    return {
        "x.position_reference": rng.normal(size=ROWS),
        "x.position": rng.normal(size=ROWS),
        "x.torque": rng.normal(size=ROWS),
    }


@pytest.fixture
def imported(small_bench, tmp_path):
    def go(folder):
        return small_bench.command("import", folder, "-o", tmp_path / "out.h5")

    return go


def spoiled(tmp_path, row, column, text):
    folder = folder_of(tmp_path, signals())
    lines = (folder / "a.csv").read_text().splitlines()
    cells = lines[row - 1].split(",")
    cells[column] = text
    lines[row - 1] = ",".join(cells)
    (folder / "a.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_good_data_are_imported(imported, tmp_path):
    outcome = imported(folder_of(tmp_path, signals()))
    assert outcome.code == 0, outcome.err
    assert "4000 rows" in outcome.out


@pytest.mark.parametrize("text", ["nan", "", "abc", "inf", "1;2", "0x10"])
def test_what_is_no_number_is_named_with_line_and_column(imported, tmp_path, text):
    outcome = imported(spoiled(tmp_path, 1234, 2, text))
    assert outcome.code == 2
    assert "a.csv:1234: " in outcome.err
    assert "x.position" in outcome.err
    assert not (tmp_path / "out.h5").exists()


@pytest.mark.parametrize("column", ["x.torque", "x.position"])
def test_a_missing_column_is_named(imported, tmp_path, column):
    data = {k: v for k, v in signals().items() if k != column}
    outcome = imported(folder_of(tmp_path, data))
    assert outcome.code == 2
    assert column in outcome.err
    assert "a.csv" in outcome.err


def test_a_wrong_sample_period_is_named_with_both(imported, tmp_path):
    outcome = imported(folder_of(tmp_path, signals(), step=0.002))
    assert outcome.code == 2
    assert "0.001" in outcome.err
    assert "0.002" in outcome.err


def test_rows_of_different_length_are_named(imported, tmp_path):
    folder = folder_of(tmp_path, signals())
    with (folder / "a.csv").open("a") as file:
        file.write("4.0,1,2\n")
    outcome = imported(folder)
    assert outcome.code == 2
    assert f"a.csv:{ROWS + 2}" in outcome.err


def test_a_table_without_rows_is_refused(imported, tmp_path):
    data = {k: v[:0] for k, v in signals().items()}
    outcome = imported(folder_of(tmp_path, data))
    assert outcome.code == 2
    assert "a.csv" in outcome.err


@pytest.mark.parametrize("missing", ["a.csv", "recording.yaml"])
def test_a_missing_file_is_named(imported, tmp_path, missing):
    folder = folder_of(tmp_path, signals())
    (folder / missing).unlink()
    outcome = imported(folder)
    assert outcome.code == 2
    assert missing in outcome.err


def test_a_key_that_is_not_known_is_named_with_its_line(imported, tmp_path):
    outcome = imported(folder_of(tmp_path, signals(), header={"sample_periode": 1}))
    assert outcome.code == 2
    assert "sample_periode" in outcome.err
    assert "recording.yaml:" in outcome.err


def test_an_output_that_can_not_be_written_is_refused(small_bench, tmp_path):
    folder = folder_of(tmp_path, signals())
    outcome = small_bench.command("import", folder, "-o", folder / "a.csv" / "x.h5")
    assert outcome.code == 3
    assert "can not be written" in outcome.err


@pytest.mark.parametrize("case", ["noise", "nothing moved", "no torque"])
def test_data_from_which_nothing_can_be_identified(small_bench, tmp_path, case):
    data = signals()
    if case == "nothing moved":
        data["x.position"] = np.zeros(ROWS)
    if case == "no torque":
        data["x.torque"] = np.zeros(ROWS)
    assert (
        small_bench.command("import", folder_of(tmp_path, data), "-o", tmp_path / "o.h5").code == 0
    )
    outcome = small_bench.command("identify", tmp_path / "o.h5")
    assert outcome.code == 5, outcome.out + outcome.err
    assert len(outcome.err) > 40, "and why"


def test_a_recording_cut_short_before_its_first_tone_can_not_be_identified(small_bench):
    from drives.sim.faults import EmergencyOnly

    small_bench.inject(EmergencyOnly(11), 4500)
    assert small_bench.measure().code == 4
    outcome = small_bench.command("identify", small_bench.out)
    assert outcome.code == 5, outcome.err
    assert len(outcome.err) > 40


@pytest.mark.parametrize("content", [b"", b"no HDF5", b"\x89HDF\r\n\x1a\n" + b"\0" * 100])
def test_a_recording_that_is_none_is_refused(small_bench, tmp_path, content):
    file = tmp_path / "broken.h5"
    file.write_bytes(content)
    outcome = small_bench.command("identify", file)
    assert outcome.code == 2
    assert str(file) in outcome.err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("run", "?", "--plan", "quick"), "no plan is called"),
        (("run", "?", "--motor-inertia", "guess"), "--motor-inertia"),
        (("identify", "?", "--masses", "x"), "AXIS=N"),
        (("identify", "?", "--masses", "x=0"), "AXIS=N"),
        (("dance",), "No such command"),
        (("run",), "Missing argument"),
        (("run", "?", "--amplitude", "3"), "No such option"),
    ],
)
def test_wrong_use_is_exit_code_2(small_bench, arguments, sentence):
    real = [small_bench.profile if a == "?" else a for a in arguments]
    outcome = small_bench.command(*real)
    assert outcome.code == 2
    assert sentence in " ".join((outcome.out + outcome.err).split())
