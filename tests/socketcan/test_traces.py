"""Traces of a real bus: complete, with the kernel's time stamps, and good for a replay."""

from pathlib import Path

import numpy as np
import pytest

from drives.canopen_drive import connect
from drives.canopen_drive.group import profile_of
from drives.profile import MachineProfile, load_machine
from drives.replay import Decoder, read_trace
from drives.replay.decoding import knowledge
from drives.replay.process_data import find, rebuilt
from drives.replay.replay_bus import INTERFACE
from tests.socketcan.conftest import ARM, CYCLE, MACHINE, TABLE

ROWS = 300


def swung(machine: MachineProfile, trace: Path | None = None):
    """Enable both axes, swing them for some seconds, and return what they did."""
    with connect(machine, trace=trace) as group, group.motion(CYCLE) as motion:
        start = motion.position
        t = CYCLE * np.arange(1, ROWS + 1)
        way = 0.2 * np.sin(2.5 * t) * np.minimum(t, 1.0)
        blocks = iter(np.array_split(start + np.column_stack([way, -way]), 10))
        return motion.stream(lambda _before: next(blocks, None))


@pytest.mark.parametrize("sync", ["host", "kernel"])
def test_a_motion_is_traced_rebuilt_and_done_again(drives, listener, tmp_path, sync) -> None:
    machine = load_machine(MACHINE)
    machine = machine.model_copy(update={"bus": machine.bus.model_copy(update={"sync": sync})})
    trace = tmp_path / "trace.log"
    listener.forget()
    capture = swung(machine, trace)

    frames = list(read_trace(trace))
    known = [0x80, *(base + node for base in (0x180, 0x200) for node in (TABLE, ARM))]
    heard = [
        (m.arbitration_id, bytes(m.data)) for m in listener.heard(0.5) if m.arbitration_id in known
    ]
    traced = [(m.arbitration_id, bytes(m.data)) for m in frames if m.arbitration_id in known]
    if sync == "host":
        assert traced == heard, "what another socket hears, in the order in which it was"
    else:  # the kernel's SYNC may come between what the host hands over and writes down
        for ids in (known[:3], known[3:]):  # received, sent
            of = [[one for one in every if one[0] in ids] for every in (traced, heard)]
            assert of[0] == of[1], (
                "what another socket hears, each way in the order in which it was"
            )
    assert {m.is_rx for m in frames if m.arbitration_id == 0x80} == {False}

    decoder = Decoder(knowledge((axis, profile_of(axis, machine)) for axis in machine.axes))
    data = rebuilt(map(decoder.decode, frames), [axis.node_id for axis in machine.axes])
    (piece,) = find(data, capture.position, capture.torque)
    assert piece.rows == capture.rows >= ROWS
    gaps = np.diff(data.time[piece.sync : piece.sync + piece.rows])
    print(f"{sync}: SYNC every {1e3 * np.median(gaps):.3f} ms, deviation {1e6 * gaps.std():.0f} us")
    assert np.median(gaps) == pytest.approx(CYCLE, rel=0.02)

    if sync == "kernel":  # its SYNC may come twice in a cycle, which the replay's host does not do
        return
    played = machine.model_copy(update={"bus": machine.bus.elsewhere(INTERFACE, str(trace))})
    again = swung(played)
    assert np.array_equal(again.position, capture.position)
    assert np.array_equal(again.torque, capture.torque)
    assert np.array_equal(again.position_reference, capture.position_reference)


def test_a_scan_of_the_real_bus(drives) -> None:
    from drives.bus import open_bus
    from drives.scan import scan

    machine = load_machine(MACHINE)
    bus = open_bus(machine.bus)
    try:
        profiles = {axis.drive: profile_of(axis, machine) for axis in machine.axes}
        found = scan(bus, machine.bus.bitrate, profiles, listen=0.5)
        assert [node.node_id for node in found.nodes] == [TABLE, ARM]
        assert all(node.fit is not None and not node.lacking for node in found.nodes)
    finally:
        bus.shutdown()
