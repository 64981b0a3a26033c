"""Ctrl-C at every stage: exit code 130, axes disabled, drives as they were, data kept."""

import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from importlib import import_module

import pytest
import yaml

from drives.canopen_drive import CanopenDrive, CanopenMotion
from drives.canopen_drive.interrupts import SIGNALS, uninterrupted
from drives.errors import UserStopError
from drives.sim.faults import DriveFault, Fault
from fieldtool import workflow
from fieldtool.cli.output import nobody_reads
from fieldtool.errors import NotEnoughDataError
from fieldtool.records.recording import load, whole_kinds
from fieldtool.workflow import Options

CLASSIC = Options(plan="classic")
TABLE, ARM = 11, 12
CHECKING = 3000
"""A SYNC in the middle of the direction checks."""


@dataclass(frozen=True)
class Pressed(Fault):
    """The user presses Ctrl-C at this moment."""

    signal: int = signal.SIGINT

    def set(self, machine, *, present):
        signal.raise_signal(self.signal)


def is_safe(bench):
    assert bench.powered() == {}
    assert bench.changed() == {}


def test_while_connecting(bench, monkeypatch):
    identify = CanopenDrive.identify

    def pressing(drive):
        signal.raise_signal(signal.SIGINT)
        return identify(drive)

    monkeypatch.setattr(CanopenDrive, "identify", pressing)
    outcome = bench.run("--write", "--yes")
    assert outcome.code == 130
    assert "stopped by the user" in outcome.err
    assert bench.machine.sync_count == 0, "nothing was enabled"
    is_safe(bench)


def test_while_enabling(bench, monkeypatch):
    step = CanopenMotion._towards_enabled

    def pressing(motion):
        step(motion)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(CanopenMotion, "_towards_enabled", pressing)
    assert bench.run().code == 130
    assert bench.machine.sync_count < 100
    is_safe(bench)


@pytest.mark.parametrize("signal_number", SIGNALS)
@pytest.mark.parametrize("sweeping", [False, True])
def test_while_axes_move(bench, sweeping, signal_number):
    press = Pressed(TABLE, signal_number)
    if sweeping:
        bench.in_sweep.append((press, 0))
    else:
        bench.inject(press, CHECKING)
    outcome = bench.run("--write", "--yes")
    assert outcome.code == 130, outcome.err
    assert "Stopping all axes" in outcome.err
    assert "stopped by the user" in outcome.err
    assert bench.machine.sync_count < (bench.mid_sweep if sweeping else CHECKING) + 600
    is_safe(bench)
    recording = bench.recording()
    assert not recording.experiments[-1].complete
    assert recording.experiments[-1].samples > 10
    assert not (bench.out / "write-journal.yaml").exists()


def test_a_second_and_third_time_does_not_cut_the_stop_short(bench):
    for k in (0, 1, 2, 5, 20, 60):
        bench.in_sweep.append((Pressed(TABLE), k))
    outcome = bench.run()
    assert outcome.code == 130
    is_safe(bench)
    assert not bench.recording().experiments[-1].complete


def pressing_during(monkeypatch, module, name, only_call=1):
    """Press Ctrl-C while this function of a module is at work."""
    function, calls = getattr(module, name), []

    def pressing(*arguments, **options):
        calls.append(name)
        if len(calls) == only_call:
            signal.raise_signal(signal.SIGINT)
        return function(*arguments, **options)

    monkeypatch.setattr(module, name, pressing)


@pytest.mark.usefixtures("quick_plan")
@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize(
    ("module", "name", "call"),
    [
        ("measuring", "identify_recording", 1),
        ("stages", "identify_recording", 1),
        ("stages", "designed", 1),
        ("writing", "apply", 1),
    ],
)
def test_between_measuring_and_writing(small_bench, monkeypatch, module, name, call, late):
    """Neither in the mathematics nor right before the write is anything written any more.

    ``late``: so long after the last motion that nothing polls; the work is broken off at once.
    """
    if late:
        monkeypatch.setattr(import_module("fieldtool.cli.stop_key"), "ASKED_WITHIN", -1.0)
    target = import_module(f"fieldtool.workflow.{module}")
    pressing_during(monkeypatch, target, name, call)
    outcome = small_bench.run("--write", "--yes", "--store")
    assert outcome.code == 130, outcome.err
    is_safe(small_bench)
    assert small_bench.stored() == {TABLE: {}}
    assert small_bench.recording().experiments[-1].complete, "the data are kept"


def commands_to_go_on(outcome):
    told = " ".join(outcome.err.split()).partition("To go on without measuring again: ")[2]
    return [command.split() for command in re.findall(r"`fieldtool ([^`]*)`", told)]


@pytest.mark.usefixtures("quick_plan", "untried")
@pytest.mark.parametrize(
    ("module", "name", "left"),
    [
        ("stages", "identify_recording", ["identify", "criticise", "design", "write"]),
        ("stages", "criticised", ["criticise", "design", "write"]),
        ("criticising", "draw_criticism", ["criticise", "design", "write"]),
        ("stages", "designed", ["design", "write"]),
        ("writing", "apply", ["write"]),
    ],
)
def test_what_a_stop_left_undone_is_done_by_the_commands_that_are_named(
    small_bench, monkeypatch, module, name, left
):
    monkeypatch.setattr(import_module("fieldtool.cli.stop_key"), "ASKED_WITHIN", -1.0)
    pressing_during(monkeypatch, import_module(f"fieldtool.workflow.{module}"), name)
    small_bench.out.mkdir()
    (small_bench.out / "tuning.yaml").write_text("of an older run")
    outcome = small_bench.run("--write", "--yes", "--response", "soft")
    assert outcome.code == 130, outcome.err
    assert "No whole experiment" not in outcome.err
    commands = commands_to_go_on(outcome)
    assert [command[0] for command in commands] == left
    for command in commands:
        answers = ("--yes",) if command[0] == "write" else ()
        again = small_bench.command(*command, *answers)
        assert again.code == 0, again.err
    assert "response: soft" in (small_bench.out / "tuning.yaml").read_text()
    assert small_bench.changed() != {}


@pytest.mark.usefixtures("quick_plan")
def test_a_criticism_that_was_refused_is_not_named_again(small_bench, monkeypatch):
    def refused(*_, **__):
        raise NotEnoughDataError("nothing can be compared")

    monkeypatch.setattr("fieldtool.workflow.criticising.criticise", refused)
    pressing_during(monkeypatch, import_module("fieldtool.workflow.stages"), "designed")
    outcome = small_bench.run("--yes")
    assert outcome.code == 130, outcome.err
    assert [command[0] for command in commands_to_go_on(outcome)] == ["design", "write"]


@pytest.mark.parametrize("plan", ["fast", "classic"])
def test_data_of_a_stopped_direction_check_are_said_to_be_of_no_use(bench, plan):
    bench.inject(Pressed(TABLE), CHECKING // 2)
    outcome = bench.run("--write", "--yes", plan=plan)
    assert outcome.code == 130
    said = " ".join(outcome.err.split())
    assert "no machine can be identified from it: measure again, into another folder." in said
    assert "To go on" not in said
    assert bench.command("identify", bench.out).code == 5
    is_safe(bench)


def out_of_memory():
    raise MemoryError


def press():
    signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("happen", [out_of_memory, press])
def test_nothing_hides_why_a_session_ended_while_it_is_said_what_is_kept(
    small_bench, monkeypatch, happen
):
    def reading(path):
        happen()
        return whole_kinds(path)

    monkeypatch.setattr(import_module("fieldtool.cli.stop_key"), "ASKED_WITHIN", -1.0)
    monkeypatch.setattr("fieldtool.workflow.session.whole_kinds", reading)
    small_bench.inject(DriveFault(TABLE), CHECKING // 2)
    outcome = small_bench.measure()
    assert outcome.code == 4, outcome.err
    said = " ".join(outcome.err.split())
    assert "reports emergency 0x2310" in said
    assert f"What was measured is kept in {small_bench.out}: " in said
    assert ("No whole experiment" in said) == (happen is press)


@pytest.mark.usefixtures("quick_plan", "untried")
@pytest.mark.parametrize("options", [("--write",), ("--write", "--store"), ()])
def test_while_the_report_is_made_the_new_parameters_are_not_forgotten(
    small_bench, monkeypatch, options
):
    monkeypatch.setattr(import_module("fieldtool.cli.stop_key"), "ASKED_WITHIN", -1.0)
    pressing_during(monkeypatch, import_module("fieldtool.workflow.stages"), "report")
    outcome = small_bench.run("--yes", *options)
    assert outcome.code == 130, outcome.err
    said = " ".join(outcome.err.split())
    way_back = f"fieldtool restore {small_bench.out}{' --store' if '--store' in options else ''}`"
    assert (way_back in said) == ("--write" in options)
    assert ("working memory only" in said) == (options == ("--write",))
    assert ("and stored" in said) == ("--store" in options)
    assert bool(small_bench.changed()) == ("--write" in options)


@pytest.mark.usefixtures("quick_plan", "untried")
def test_while_the_drives_are_left_after_a_write_the_new_parameters_are_not_forgotten(
    small_bench, monkeypatch
):
    monkeypatch.setattr(import_module("fieldtool.cli.stop_key"), "ASKED_WITHIN", -1.0)
    pressing_during(monkeypatch, import_module("fieldtool.workflow.session"), "trace_problem")
    outcome = small_bench.run("--yes", "--write")
    assert outcome.code == 130, outcome.err
    assert f"fieldtool restore {small_bench.out}`" in " ".join(outcome.err.split())
    assert small_bench.changed() != {}


def test_a_script_that_asks_for_a_stop_gets_one(bench):
    """The same from Python, without the command line's handler."""
    with pytest.raises(UserStopError):
        workflow.run(bench.profile, bench.out, CLASSIC, stop_requested=lambda: bench.sweeps)
    is_safe(bench)
    assert not bench.recording().experiments[-1].complete


def test_a_script_without_a_stop_function_is_safe_too(bench):
    """Python's own KeyboardInterrupt in the middle of a cycle: axes off, data kept."""
    bench.in_sweep.append((Pressed(TABLE), 0))
    with pytest.raises(UserStopError) as stop:
        workflow.run(bench.profile, bench.out, CLASSIC)
    assert isinstance(stop.value.__cause__, KeyboardInterrupt)
    is_safe(bench)
    assert not bench.recording().experiments[-1].complete


def test_fieldtool_run_in_a_process_of_its_own(tmp_path, profile_of_two):
    profile = tmp_path / "machine.yaml"
    profile_of_two["bus"]["channel"] = str(profile)
    profile.write_text(yaml.safe_dump(profile_of_two))
    out, log = tmp_path / "out", tmp_path / "log.txt"
    with log.open("w") as output:
        process = subprocess.Popen(
            [
                sys.executable,
                "-u",
                "-m",
                "fieldtool",
                "run",
                str(profile),
                "--plan",
                "classic",
                "--yes",
                "--out",
                str(out),
            ],
            stdout=output,
            stderr=subprocess.STDOUT,
            env={**os.environ, "COLUMNS": "200"},
        )
        deadline = time.monotonic() + 60
        while "sweep 1/5" not in log.read_text() and process.poll() is None:
            assert time.monotonic() < deadline, log.read_text()
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130, log.read_text()
    text = log.read_text()
    assert "stopped by the user" in text
    assert "Traceback" not in text
    assert not load(out / "recording.h5").experiments[-1].complete
    assert '"UserStopError"' in (out / "events.jsonl").read_text()


# --- the guard itself ----------------------------------------------------------------------------


def press_under_guard(done):
    with uninterrupted():
        signal.raise_signal(signal.SIGINT)
        done.append("all of it")


def test_what_came_during_the_guard_acts_after_it():
    done = []
    with pytest.raises(KeyboardInterrupt):
        press_under_guard(done)
    assert done == ["all of it"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_error_on_its_way_is_not_replaced():
    def fail_and_clean_up():
        try:
            raise UserStopError("first")
        finally:
            press_under_guard([])

    with pytest.raises(UserStopError, match="first"):
        fail_and_clean_up()


def test_an_output_that_is_closed_while_axes_move_stops_them(bench, monkeypatch):
    moving = []

    def closed(_screen, _progress):
        moving.append(bench.powered())
        nobody_reads()

    monkeypatch.setattr("fieldtool.cli.output.drop_output", lambda: None)
    monkeypatch.setattr("fieldtool.cli.screen.TerminalScreen.progress", closed)
    outcome = bench.run("--yes")
    assert outcome.code == 130
    assert "the output was closed before its end: stopped." in outcome.err
    assert len(moving) == 1
    assert moving[0], "it came while the axes were on"
    assert bench.recording().experiments
    is_safe(bench)
