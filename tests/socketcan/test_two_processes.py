"""Master and simulated drives in two processes on one bus; one of the two, or the bus, dies."""

import json
import os
import random
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml

from drives.bus.kernel_sync import LEASE
from drives.canopen_drive import connect
from drives.canopen_drive.setup import HOST_HEARTBEAT, HOST_LOST_AFTER
from drives.profile import load_machine
from fieldtool.cli.main import main
from fieldtool.records.recording import load
from tests.socketcan.conftest import ARM, CYCLE, MACHINE, PATIENCE, TABLE, link

STOPPED, TAKEN_BACK = 4, 6
"""Exit codes: stopped for safety; a write that was taken back."""
HOST, HEARTBEAT_LOST = 0x77F, 0x8130
SLACK = 0.1
"""Seconds that a guest with one slow processor may add to a drive's time."""
SPEED = 1.0
"""rad/s: of the motions that are cut off, about."""


def swing(sync: str = "host", forever: float = 60.0) -> None:
    """Connect, enable both axes and move them about the middle, until something ends it."""
    machine = load_machine(MACHINE)
    bus = machine.bus.model_copy(update={"sync": sync})
    machine = machine.model_copy(update={"bus": bus})
    with connect(machine) as group, group.motion(CYCLE) as motion:
        start = motion.position
        print("MOVING", flush=True)
        rows = 0

        def source(_before):
            nonlocal rows
            if rows * CYCLE > forever:
                return None
            t = CYCLE * (rows + 1 + np.arange(10))
            rows += 10
            swung = 0.4 * np.sin(SPEED / 0.4 * t) * np.minimum(t, 1.0)
            back = 0.5 + 0.5 * np.cos(np.pi * np.minimum(t / 4.0, 1.0))
            return np.outer(back, start) + np.column_stack([swung, -swung])

        motion.stream(source)


def assert_still(listener) -> None:
    """Both drives are off, and do not move but for what swings in the spring."""
    for node in (TABLE, ARM):
        assert not listener.enabled(node)
    time.sleep(3.0)  # what is off swings, and comes to rest by friction alone
    first = [listener.position(node) for node in (TABLE, ARM)]
    time.sleep(1.0)
    moved = np.abs(np.array([listener.position(node) for node in (TABLE, ARM)]) - first)
    assert np.all(moved < 0.05 * SPEED), moved


def lost_after(frames) -> dict[int, float]:
    """Return, for each node, the seconds from the host's last heartbeat to its emergency."""
    last = max(m.timestamp for m in frames if m.arbitration_id == HOST)
    found: dict[int, float] = {}
    for message in frames:
        node = message.arbitration_id - 0x80
        if node in (TABLE, ARM) and int.from_bytes(message.data[:2], "little") == HEARTBEAT_LOST:
            found.setdefault(node, message.timestamp - last)
    return found


@pytest.mark.parametrize("sync", ["host", "kernel"])
def test_sigkill_in_motion_stops_every_drive_by_its_own_heartbeat_consumer(
    drives, listener, start, sync
) -> None:
    wait = random.uniform(0.3, 3.0)
    print(f"killed {wait:.3f} s into the motion")
    master = start(lambda: swing(sync))
    master.wait_for("MOVING")
    listener.wait_for_motion(master, TABLE, rows=10, way=0.001)
    time.sleep(wait)
    assert listener.enabled(TABLE), master.text
    assert listener.enabled(ARM), master.text
    listener.forget()
    heard = listener.heard(0.1)
    master.kill()
    heard += listener.heard(HOST_LOST_AFTER + HOST_HEARTBEAT + SLACK + 0.2)
    assert master.join() == -signal.SIGKILL
    last = {i: max(m.timestamp for m in heard if m.arbitration_id == i) for i in (0x080, HOST)}
    assert last[0x080] < last[HOST] + HOST_HEARTBEAT + 2 * CYCLE, "SYNC ends with the host"
    times = lost_after(heard)
    print({node: round(1000 * t) for node, t in times.items()}, "ms after the last heartbeat")
    assert set(times) == {TABLE, ARM}
    for seconds in times.values():
        assert HOST_LOST_AFTER - 0.01 <= seconds <= HOST_LOST_AFTER + SLACK
    assert_still(listener)


def in_the_pilot(master, listener) -> None:
    """Return about two seconds after the pilot experiment, of nine, began to move the axes."""
    master.wait_for("1/1 pilot")
    listener.wait_for_motion(master, TABLE, rows=200, way=0.02)


def test_sigkill_of_the_tool_in_a_sweep(drives, listener, start, tmp_path) -> None:
    master = start(lambda: main(["measure", str(MACHINE), "--yes", "--out", str(tmp_path / "s")]))
    in_the_pilot(master, listener)
    listener.forget()
    heard = listener.heard(0.1)
    master.kill()
    heard += listener.heard(HOST_LOST_AFTER + HOST_HEARTBEAT + SLACK + 0.2)
    times = lost_after(heard)
    assert set(times) == {TABLE, ARM}
    assert max(times.values()) <= HOST_LOST_AFTER + SLACK
    assert_still(listener)


@pytest.mark.parametrize("sync", ["host", "kernel"])
def test_a_host_that_stands_still_finds_stopped_drives_and_says_so(
    drives, listener, start, sync
) -> None:
    """A kernel that gives the SYNC does not go on without the host."""
    master = start(lambda: swing(sync))
    master.wait_for("MOVING")
    listener.wait_for_motion(master, TABLE, rows=100, way=0.05)
    listener.forget()
    heard = listener.heard(0.1)
    os.kill(master.pid, signal.SIGSTOP)
    stopped = time.time()
    heard += listener.heard(0.6)
    after = [m for m in heard if m.arbitration_id == 0x080 and m.timestamp > stopped + 0.001]
    assert len(after) <= (LEASE if sync == "kernel" else 0)
    for node in (TABLE, ARM):
        assert not listener.enabled(node), "the drive did not wait for the host to come back"
    os.kill(master.pid, signal.SIGCONT)
    assert master.join() != 0
    assert re.search(r"all axes were stopped|All axes were stopped", master.text), master.text
    assert_still(listener)


def test_an_interface_that_goes_down_in_a_sweep(
    drives, listener, start, tmp_path, up_again
) -> None:
    """Exit code 4, the reason in words, raw data kept, and the drives stop by themselves."""
    out = tmp_path / "session"
    master = start(lambda: main(["measure", str(MACHINE), "--yes", "--out", str(out)]))
    in_the_pilot(master, listener)
    link("vcan0", "down")
    assert master.join() == 4, master.text
    assert "interface vcan0 is down" in master.text
    assert "stops by itself when it misses the host's heartbeat" in " ".join(master.text.split())
    assert "Traceback" not in master.text
    link("vcan0", "up")
    listener.bus.shutdown()
    listener.__init__()
    assert_still(listener)
    for node in (TABLE, ARM):
        errors = [listener.read(node, 0x1003, k) & 0xFFFF for k in (1, 2)]
        assert HEARTBEAT_LOST in errors
    recording = load(out / "recording.h5")
    cut = recording.experiments[-1]
    assert cut.samples > 100
    assert not cut.complete
    assert np.ptp(cut.position, axis=0).max() > 0.01, "it was cut in motion"
    assert "interface vcan0 is down" in cut.note


def test_the_whole_job(drives, listener, tmp_path) -> None:
    """``fieldtool run`` in a process of its own: identified, tried, written, tried again, read back.

    The drives may miss their host for longer here, for a guest on a busy computer stands still for
    some 0.15 s again and again, master or drives.  In a move of a trial an axis swings then and is
    rightly stopped, and the drives get back what they held: the rest is done without trials.
    """
    out, machine = tmp_path / "session", tmp_path / "machine.yaml"
    patient = MACHINE.read_text().replace("bus: {", "bus: {host_lost_after: 800 ms, ")
    machine.write_text(patient, encoding="utf-8")

    def fieldtool(*arguments: str) -> "subprocess.CompletedProcess[str]":
        done = subprocess.run(
            [sys.executable, "-m", "fieldtool", *arguments, "--yes", "--json"],
            capture_output=True,
            text=True,
            timeout=5 * PATIENCE,
            check=False,
        )
        print(done.stderr)
        return done

    def held() -> list[int]:
        return [listener.read(node, 0x2010, sub) for node in (TABLE, ARM) for sub in (1, 2, 3)]

    before = held()
    run = fieldtool("run", str(machine), "--write", "--out", str(out))
    assert re.search(r"This computer began \d+ of \d+ cycles", " ".join(run.stderr.split()))
    if run.returncode in (STOPPED, TAKEN_BACK) and "Try the old parameters" in run.stderr:
        assert held() == before
        assert not listener.enabled(TABLE)
        assert not listener.enabled(ARM)
        print("a trial was stopped: written without one")
        run = fieldtool("write", str(out), "--no-verify")
    assert run.returncode == 0, run.stderr
    result = json.loads(run.stdout)
    model = yaml.safe_load((out / "model.yaml").read_text(encoding="utf-8"))
    axes = {axis["name"]: axis for axis in model["axes"]}
    found = [m["value"] for m in axes["table"]["masses"]]
    assert found == pytest.approx([2.0, 3.0], rel=0.02)
    assert axes["arm"]["masses"][0]["value"] == pytest.approx(4.0, rel=0.02)
    assert axes["table"]["springs"][0]["value"] == pytest.approx(300.0, rel=0.02)
    for row in result["parameters"]:
        assert row["read_back"] == pytest.approx(row["after"], rel=1e-3)
    for node in (TABLE, ARM):
        assert not listener.enabled(node)
        assert listener.read(node, 0x1016, 1) == 0, "put back"
    events = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    assert max(e["count"] for e in events if e["event"] == "cycles") > 1000
