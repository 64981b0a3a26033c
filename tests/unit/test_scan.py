"""What a scan makes of a bus: simulated drives, other masters, wrong bit rates, nonsense."""

from collections.abc import Iterator

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drives.errors import BusError
from drives.profile import load_drive
from drives.scan import scan
from drives.scan.traffic import service_of, sorted_traffic
from drives.sim.faults import SdoRefused, SdoSilent
from drives.sim.lockstep_bus import LockstepBus, register, unregister
from drives.sim.machine import SimulatedDrive, SimulatedMachine
from drives.sim.plant import ChainParameters
from drives.sim.running import RunningMachine
from tests.unit.scripted_bus import ScriptedBus, frame

PROFILES = {"reference": load_drive("reference")}
NODES = (5, 64, 127)
NO_OBJECT = 0x06020000


@pytest.fixture
def machine() -> Iterator[RunningMachine]:
    chain = ChainParameters((0.02,), (), ())
    drives = tuple(SimulatedDrive(f"axis{n}", n, chain, 4.0, 12.0, serial=7000 + n) for n in NODES)
    yield register("scanned", SimulatedMachine(drives))
    unregister("scanned")


def scanned(**options: object):
    with LockstepBus("scanned") as bus:
        return scan(bus, 1_000_000, PROFILES, **options)


def test_every_node_is_found_and_told(machine: RunningMachine) -> None:
    found = scanned()
    assert [node.node_id for node in found.nodes] == list(NODES)
    for node in found.nodes:
        assert node.identity is not None
        assert node.identity.serial_number == 7000 + node.node_id
        assert node.identity.device_type == 0x00020192
        assert node.power == "switch on disabled"
        assert node.modes is not None
        assert "cyclic position" in node.modes
        assert node.fit is not None
        assert (node.fit.profile, node.fit.verdict) == ("reference", "fits")
        assert not node.lacking
    assert found.problems == ()


def test_only_questions_are_sent_and_nothing_is_changed(machine: RunningMachine) -> None:
    before = {n.node_id: n.dictionary.parameters() for n in machine.nodes}
    states = {n.node_id: n.nmt.state for n in machine.nodes}
    listener = LockstepBus("scanned")
    scanned()
    commands = set()
    while (message := listener.recv(0.0)) is not None:
        if 0x580 < message.arbitration_id < 0x600 or message.arbitration_id == 0x7F + 0x700:
            continue
        assert 0x601 <= message.arbitration_id <= 0x67F, hex(message.arbitration_id)
        commands.add(message.data[0] & 0xE0)
    listener.shutdown()
    assert commands == {0x40, 0x60}  # upload, and its further segments: never a download
    assert {n.node_id: n.dictionary.parameters() for n in machine.nodes} == before
    assert {n.node_id: n.nmt.state for n in machine.nodes} == states


@pytest.mark.parametrize(
    ("identifier", "data", "word"),
    [
        (0x080, b"", "SYNC"),
        (0x000, b"\x01\x05", "NMT commands"),
        (0x605, b"\x40\x41\x60\0\0\0\0\0", "SDO requests to node 5"),
        (0x205, b"\x0f\0\0\0\0\0\0\0", "targets (RPDO 1) for node 5"),
    ],
)
def test_another_master_is_noticed_and_not_disturbed(
    identifier: int, data: bytes, word: str
) -> None:
    unasked = [frame(identifier, data, 0.1 * k) for k in range(1, 15)]
    unasked += [frame(0x705, b"\x05", 1.41)]
    bus = ScriptedBus(unasked=unasked)
    found = scan(bus, 1_000_000, PROFILES)  # type: ignore[arg-type]
    assert bus.sent == []
    assert not found.asked
    assert [(n.node_id, n.heard.state, n.answers) for n in found.nodes] == [
        (5, "operational", False)
    ]
    assert f"another master is at work: {word} (14)" in found.problems[0]


def test_beside_another_master_nodes_are_asked_only_on_request(machine: RunningMachine) -> None:
    other = LockstepBus("scanned")
    other.send_periodic(frame(0x80), 0.1)
    found = scanned()
    assert not found.asked
    assert found.traffic.sync_period == pytest.approx(0.1)
    assert [n.node_id for n in scanned(ask=True).nodes] == list(NODES)
    other.shutdown()


def test_listening_only_sends_nothing() -> None:
    bus = ScriptedBus(unasked=[frame(0x701, b"\x7f", 0.2), frame(0x702, b"\x00", 0.3)])
    found = scan(bus, 500_000, PROFILES, ask=False)  # type: ignore[arg-type]
    assert bus.sent == []
    assert [(n.node_id, n.heard.state, n.heard.booted) for n in found.nodes] == [
        (1, "pre-operational", False),
        (2, "boot-up", True),
    ]


def test_error_frames_alone_mean_another_bit_rate_and_nothing_is_sent() -> None:
    errors = [frame(0x20, b"\0" * 8, 0.01 * k, is_error_frame=True) for k in range(1, 50)]
    bus = ScriptedBus(unasked=errors)
    found = scan(bus, 250_000, PROFILES)  # type: ignore[arg-type]
    assert bus.sent == []
    assert "49 error frames and not one good frame" in found.problems[0]
    assert "another bit rate" in found.problems[0]


def test_error_frames_among_good_ones_are_told() -> None:
    unasked = [frame(0x705, b"\x05", 0.3), frame(0x20, b"\0" * 8, 0.5, is_error_frame=True)]
    found = scan(ScriptedBus(unasked=unasked), 250_000, PROFILES)  # type: ignore[arg-type]
    assert "1 error frames among 1 good ones" in found.problems[0]


def test_an_empty_bus_is_told_within_seconds() -> None:
    bus = ScriptedBus()
    found = scan(bus, 125_000, PROFILES)  # type: ignore[arg-type]
    assert found.nodes == ()
    assert "none of the 127 node ids answered at 125000 bit/s" in found.problems[0]
    assert len({m.arbitration_id for m in bus.sent}) == 127
    assert bus.now() < 5.0


def test_questions_leave_room_on_a_slow_bus() -> None:
    bus = ScriptedBus()
    scan(bus, 10_000, PROFILES, listen=0.5)  # type: ignore[arg-type]
    bits = 127 * 135
    assert bits / (bus.now() - 0.5) < 0.3 * 10_000


def test_nobody_who_acknowledges() -> None:
    bus = ScriptedBus(refuses=can.CanOperationError("No buffer space available"))
    with pytest.raises(BusError, match=r"no other node is on the bus with this bit rate"):
        scan(bus, 500_000, PROFILES)  # type: ignore[arg-type]


def test_a_stopped_node_is_told_and_left_alone() -> None:
    bus = ScriptedBus(unasked=[frame(0x709, b"\x04", 0.2), frame(0x709, b"\x04", 0.7)])
    (node,) = scan(bus, 500_000, PROFILES).nodes  # type: ignore[arg-type]
    assert (node.heard.state, node.heard.heartbeat) == ("stopped", pytest.approx(0.5))
    assert "NMT state stopped" in node.problem
    assert all(m.arbitration_id != 0 for m in bus.sent)


def test_what_a_drive_lacks_is_named_with_its_consequence(machine: RunningMachine) -> None:
    for index, sub in ((0x1016, 1), (0x60B2, 0), (0x1010, 1)):
        machine.inject(SdoRefused(5, index, sub, NO_OBJECT))
    first, second, _ = scanned().nodes
    lacking = {need.what: need for need in first.lacking}
    assert set(lacking) == {
        "stops when the host dies",
        "torque offset 0x60B2",
        "store 0x1010",
    }
    assert lacking["stops when the host dies"].blocks
    assert "may not be moved" in lacking["stops when the host dies"].consequence
    assert first.fit is not None
    assert first.fit.verdict == "may fit"
    assert any("0x1010:01 (store) is not there" in d for d in first.fit.differences)
    assert not second.lacking


def test_a_drive_without_cyclic_position_or_scales(machine: RunningMachine) -> None:
    node = machine.node(64)
    node.dictionary.force(0x6502, 0, 0x01)
    node.dictionary.force(0x6076, 0, 0)
    found = next(n for n in scanned().nodes if n.node_id == 64)
    assert {need.what for need in found.lacking if need.blocks} == {
        "mode cyclic position",
        "torque scale 0x6076:00",
    }


def test_a_node_that_stops_to_answer_costs_little_time(machine: RunningMachine) -> None:
    for index in (0x1018, 0x1008, 0x100A, 0x6502, 0x1016):
        for sub in range(5):
            machine.inject(SdoSilent(5, index, sub))
    began = machine.now
    found = scanned()
    assert found.nodes[0].problem == "it stopped to answer in the middle"
    assert found.nodes[1].problem == ""
    assert machine.now - began < 6.0


def test_no_drive_at_all() -> None:
    def answer(message: can.Message) -> list[can.Message]:
        if message.arbitration_id != 0x614:
            return []
        index = bytes(message.data[1:4])
        if index == b"\x00\x10\x00":
            return [frame(0x594, b"\x43\x00\x10\x00\x91\x01\x0f\x00")]  # CiA 401, an I/O module
        return [frame(0x594, b"\x80" + index + b"\x00\x00\x02\x06")]

    (node,) = scan(ScriptedBus(answer), 500_000, PROFILES).nodes  # type: ignore[arg-type]
    assert node.fit is None
    (need,) = node.needs
    assert need.blocks
    assert "profile 401" in need.shown


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_nonsense_on_the_bus_harms_nobody(data: st.DataObject) -> None:
    any_frame = st.builds(
        frame,
        st.integers(0, 0x7FF),
        st.binary(max_size=8),
        st.just(0.0),
        is_error_frame=st.booleans(),
        is_remote_frame=st.just(False),
    )

    def answer(message: can.Message) -> list[can.Message]:
        node = message.arbitration_id - 0x600
        if node not in (3, 4):
            return []
        raw = data.draw(st.binary(min_size=8, max_size=8))
        if data.draw(st.booleans()):
            raw = raw[:1] + bytes(message.data[1:4]) + raw[4:]
        return [frame(0x580 + node, raw), *data.draw(st.lists(any_frame, max_size=2))]

    unasked = [
        frame(m.arbitration_id, bytes(m.data), 0.01 * k, is_error_frame=m.is_error_frame)
        for k, m in enumerate(data.draw(st.lists(any_frame, max_size=20)))
    ]
    bus = ScriptedBus(answer, unasked)
    found = scan(bus, 500_000, PROFILES, ask=True)  # type: ignore[arg-type]
    assert {3, 4} <= {n.node_id for n in found.nodes} or not found.asked
    assert all(m.data[0] & 0xE0 in (0x40, 0x60, 0x80, 0xA0) for m in bus.sent)
    assert bus.now() < 70


@pytest.mark.parametrize(
    ("identifier", "service", "node"),
    [
        (0x000, "NMT", 0),
        (0x080, "SYNC", 0),
        (0x081, "EMCY", 1),
        (0x0FF, "EMCY", 127),
        (0x100, "TIME", 0),
        (0x181, "TPDO 1", 1),
        (0x27F, "RPDO 1", 127),
        (0x281, "TPDO 2", 1),
        (0x57F, "RPDO 4", 127),
        (0x580, "other", 0),
        (0x5FF, "SDO answer", 127),
        (0x601, "SDO request", 1),
        (0x701, "heartbeat", 1),
        (0x7E5, "LSS", 0),
        (0x7FF, "other", 0),
    ],
)
def test_services_by_identifier(identifier: int, service: str, node: int) -> None:
    assert service_of(identifier) == (service, node)


def test_traffic_is_sorted() -> None:
    frames = [
        frame(0x705, b"\x00", 0.1),
        frame(0x705, b"\x05", 0.2),
        frame(0x705, b"\x85", 0.7),  # node guarding's toggle bit
        frame(0x085, b"\x11\x86\x20\0\0\0\0\0", 0.8),
        frame(0x185, b"\0" * 8, 0.9),
        frame(0x18FF, b"", 0.9, is_extended_id=True),
    ]
    traffic = sorted_traffic(frames, 1.0)
    (node,) = traffic.nodes
    assert (node.state, node.booted, node.pdos) == ("operational", True, ("TPDO 1",))
    assert node.heartbeat == pytest.approx(0.5)
    assert node.emergencies == ("0x8611 (following error)",)
    assert (traffic.frames, traffic.extended, traffic.commanded) == (5, 1, False)
