"""A session shown again from its trace: by independent decoding, and by the tool itself."""

import json
import re
from pathlib import Path

import pytest

from drives.sim.faults import DriveFault

TRACED = ("--yes", "--trace")
FAILS_AT = 5000
"""SYNC at which a drive fails: a session that is short, and ends with all that there is to put back."""


@pytest.fixture
def traced(small_bench):
    """A bench with a session, cut short by a fault of the drive, and its trace."""
    small_bench.inject(DriveFault(11), sync=FAILS_AT)
    outcome = small_bench.measure(*TRACED)
    assert outcome.code == 4, outcome.err
    assert "0x2310" in outcome.err
    assert (small_bench.out / "trace.asc").is_file()
    return small_bench


def replayed(bench, *arguments: object) -> dict:
    outcome = bench.command("replay", bench.out, "--json", *arguments)
    assert outcome.code == 0, outcome.err
    return json.loads(outcome.out)


def changed_line(trace: Path, pattern: str, number: int, change) -> None:
    """Change one of the lines that match, counted from the end if negative."""
    lines = trace.read_text().splitlines(keepends=True)
    matching = [k for k, line in enumerate(lines) if re.search(pattern, line)]
    k = matching[number]
    lines[k] = change(lines[k])
    trace.write_text("".join(lines))


def flip_last_byte(line: str) -> str:
    return re.sub(r"([0-9A-F]{2})(\s*)$", lambda m: f"{int(m[1], 16) ^ 1:02X}{m[2]}", line)


def test_a_session_is_shown_again_from_its_trace(traced) -> None:
    """One session, looked at in every way: measuring takes the time."""
    found = replayed(traced)
    recording = traced.recording()
    assert [e["experiment"] for e in found["recording"]] == [e.name for e in recording.experiments]
    assert all(e["rows_found"] == e["rows"] > 100 for e in found["recording"])
    rows = sum(e.samples for e in recording.experiments)
    assert sum(e["rows"] for e in found["recording"]) == rows
    assert any("0x2310" in text for text in found["emergencies"])
    assert found["pdos"][0]["missing"] == 0
    assert found["sync"]["median"] == pytest.approx(recording.sample_period, rel=1e-6)
    assert found["sync"]["syncs"] == traced.machine.sync_count

    frames_are_shown_and_filtered(traced)

    syncs = traced.machine.sync_count
    outcome = traced.command("replay", traced.out, "--again", "--json")
    assert outcome.code == 0, outcome.err
    done = json.loads(outcome.out)
    assert (done["same_frames"], done["differences"]) == (True, []), "it ends with the same fault"
    assert done["rows_compared"] == rows
    assert traced.machine.sync_count == syncs, "no drive was asked"

    one_wrong_bit_is_seen(traced)
    a_trace_without_motion_has_no_recording(traced)


def a_trace_without_motion_has_no_recording(traced) -> None:
    other = traced.out / "other.log"
    other.write_text("(1.000000) can0 70B#7F R\n(2.000000) can0 70B#7F R\n")
    outcome = traced.command("replay", other, "--json")
    assert json.loads(outcome.out)["recording"] == []


def frames_are_shown_and_filtered(traced) -> None:
    shown = replayed(traced, "--kind", "sdo", "--object", "0x6502")["shown"]
    assert shown
    assert {f["object"] for f in shown} == {"0x6502:00"}
    texts = traced.command("replay", traced.out, "--kind", "nmt", "--node", "11").out
    assert "start node 11" in texts
    first = replayed(traced, "--kind", "pdo", "--from", "1", "--to", "1.2", "--limit", "7")
    assert len(first["shown"]) == 7
    assert first["not_shown"] > 100
    assert all(1 <= f["seconds"] <= 1.2 for f in first["shown"])
    values = {v["name"]: v for f in first["shown"] for v in f["values"]}
    assert values["Position actual value"]["unit"] == "rad"
    assert values["Torque actual value"]["unit"] == "N m"


def one_wrong_bit_is_seen(traced) -> None:
    trace = traced.out / "trace.asc"
    sound = trace.read_text()
    changed_line(trace, r" 18B  .*Rx", -600, flip_last_byte)
    found = replayed(traced)
    assert sum(e["rows"] - e["rows_found"] for e in found["recording"]) >= 1

    trace.write_text(sound)
    changed_line(trace, r" 20B  .*Tx", 500, flip_last_byte)
    frames = [line for line in trace.read_text().splitlines() if re.search(r" [TR]x ", line)]
    number = 1 + [k for k, line in enumerate(frames) if " 20B  " in line][500]
    outcome = traced.command("replay", traced.out, "--again")
    assert outcome.code == 3
    assert f"frame {number} at " in " ".join(outcome.out.split())


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--kind", "xyz"], "--kind xyz"),
        (["--object", "xyz"], "--object"),
        (["--limit", "0"], "limit"),
    ],
)
def test_wrong_use(small_bench, arguments: list[str], word: str) -> None:
    trace = small_bench.folder / "short.log"
    trace.write_text("(1.000000) can0 080# R\n")
    outcome = small_bench.command("replay", trace, *arguments)
    assert outcome.code == 2
    assert word in outcome.err


def test_a_session_without_a_trace(small_bench) -> None:
    outcome = small_bench.command("replay", small_bench.folder)
    assert outcome.code == 2
    assert "has no trace; measure with --trace" in outcome.err


@pytest.mark.parametrize("name", ["none", "none.txt", "none.asc", "none/trace.asc"])
@pytest.mark.parametrize("again", [(), ("--again",)])
def test_a_path_that_is_not_there(small_bench, name: str, again: tuple[str, ...]) -> None:
    (small_bench.folder / "machine.yaml").write_text("nonsense: [")
    path = small_bench.folder / name
    outcome = small_bench.command("replay", path, *again)
    assert outcome.code == 2
    assert f"{path}: does not exist. Give a session folder" in " ".join(outcome.err.split())


def test_a_trace_of_somebody_else_is_shown_without_a_machine(tmp_path, small_bench) -> None:
    trace = tmp_path / "other.log"
    trace.write_text("(1.000000) can0 080# R\n(1.010000) can0 705#05 R\n(1.020000) can0 080# R\n")
    outcome = small_bench.command("replay", trace, "--frames")
    assert outcome.code == 0
    assert "operational" in outcome.out
    again = small_bench.command("replay", trace, "--again")
    assert again.code == 2
    assert "no session folder" in again.err
