"""Traces read, decoded, counted, and played in place of drives."""

from itertools import pairwise
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drives.bus import open_bus
from drives.errors import BusError, ProfileError
from drives.profile import BusProfile
from drives.replay import Decoded, Decoder, read_trace
from drives.replay.process_data import ProcessData, find, rebuilt
from drives.replay.replay_bus import ReplayBus
from drives.replay.statistics import Counting
from drives.trace import FORMATS
from tests.unit.scripted_bus import frame


def sent(identifier: int, data: bytes = b"", timestamp: float = 0.0) -> can.Message:
    return frame(identifier, data, timestamp, is_rx=False)


def written(path: Path, frames: list[can.Message]) -> Path:
    with can.Logger(path) as log:
        for one in frames:
            log.on_message_received(one)
    return path


def decoded(frames: list[can.Message]) -> list[Decoded]:
    decoder = Decoder()
    return [decoder.decode(one) for one in frames]


def expedited(node: int, index: int, sub: int, value: int, size: int) -> list[can.Message]:
    head = index.to_bytes(2, "little") + bytes([sub])
    data = bytes([0x23 | (4 - size) << 2]) + head + value.to_bytes(4, "little")
    return [sent(0x600 + node, data), frame(0x580 + node, b"\x60" + head + bytes(4))]


def mapping(node: int) -> list[can.Message]:
    """What sets up one PDO each way as the tool does."""
    frames: list[can.Message] = []
    for communication, where, cob, entries in (
        (0x1400, 0x1600, 0x200, (0x60400010, 0x607A0020, 0x60710010)),
        (0x1800, 0x1A00, 0x180, (0x60410010, 0x60640020, 0x60770010)),
    ):
        for k, entry in enumerate(entries):
            frames += expedited(node, where, k + 1, entry, 4)
        frames += expedited(node, where, 0, len(entries), 1)
        frames += expedited(node, communication, 1, cob + node, 4)
    return frames


# --- reading -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_trace_is_read_as_it_was_written(tmp_path: Path, suffix: str) -> None:
    frames = [sent(0x605, b"\x40" * 8, 1.5), frame(0x585, b"\x43" * 8, 1.501), sent(0x80, b"", 2.0)]
    path = written(tmp_path / f"t{suffix}", frames)
    found = list(read_trace(path))
    assert [(m.arbitration_id, bytes(m.data), m.is_rx) for m in found] == [
        (m.arbitration_id, bytes(m.data), m.is_rx) for m in frames
    ]
    assert [round(b.timestamp - a.timestamp, 6) for a, b in pairwise(found)] == [0.001, 0.499]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("t.txt", b"", "is no trace: these end in"),
        ("t.asc", b"", "there is no frame in it"),
        ("t.log", b"", "there is no frame in it"),
        ("t.log", b"(not a trace\n", "is no trace"),
        ("t.blf", b"nonsense" * 40, "is no trace"),
    ],
)
def test_what_is_no_trace_is_refused_in_words(
    tmp_path: Path, name: str, content: bytes, words: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ProfileError, match=words):
        list(read_trace(path))


@pytest.mark.parametrize("name", ["nothing.asc", "nothing.ascx", "nothing"])
def test_a_file_that_is_not_there(tmp_path: Path, name: str) -> None:
    with pytest.raises(ProfileError, match="no such file"):
        list(read_trace(tmp_path / name))


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_a_trace_that_was_cut_or_damaged_is_read_without_harm(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("cut")
    suffix = data.draw(st.sampled_from(FORMATS))
    path = written(folder / f"t{suffix}", [sent(0x80, b"", k * 1e-3) for k in range(40)])
    share = st.floats(0, 1, exclude_max=True)
    cut, damage = (
        data.draw(share),
        data.draw(st.lists(st.tuples(share, st.integers(0, 255)), max_size=3)),
    )
    raw = bytearray(path.read_bytes())
    raw = raw[: int(cut * len(raw)) + 1]
    for where, value in damage:
        raw[int(where * len(raw))] = value
    path.write_bytes(bytes(raw))
    try:
        frames = list(read_trace(path))
    except ProfileError:
        return
    decoded(frames)


# --- decoding ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("message", "kind", "node", "text"),
    [
        (sent(0x000, b"\x01\x05"), "NMT", 5, "start node 5"),
        (sent(0x000, b"\x80\x00"), "NMT", 0, "enter pre-operational all nodes"),
        (sent(0x080), "SYNC", 0, "SYNC"),
        (frame(0x085, b"\x11\x86\x20\0\0\0\0\0"), "EMCY", 5, "emergency 0x8611 (following error)"),
        (frame(0x705, b"\x00"), "heartbeat", 5, "boot-up"),
        (frame(0x705, b"\x85"), "heartbeat", 5, "operational"),
        (sent(0x605, b"\x40\x41\x60\0\0\0\0\0"), "SDO", 5, "read 0x6041:00 statusword"),
        (frame(0x585, b"\x4b\x41\x60\0\x37\x02\0\0"), "SDO", 5, "operation enabled"),
        (sent(0x605, b"\x2b\x40\x60\0\x0f\0\0\0"), "SDO", 5, "write 0x6040:00 controlword"),
        (frame(0x585, b"\x80\x00\x20\0\0\0\x02\x06"), "SDO", 5, "the object does not exist"),
        (frame(0x185, bytes(8)), "PDO", 5, "mapping not known"),
        (frame(0x20, bytes(8), is_error_frame=True), "error", 0, "error frame"),
    ],
)
def test_what_a_frame_means(message: can.Message, kind: str, node: int, text: str) -> None:
    (found,) = decoded([message])
    assert (found.kind, found.node) == (kind, node)
    assert text in found.text


def test_pdos_are_read_as_they_were_mapped() -> None:
    tpdo = (0x1237).to_bytes(2, "little") + (-7).to_bytes(4, "little", signed=True) + b"\x05\x00"
    found = decoded([*mapping(5), frame(0x185, tpdo)])[-1]
    assert [(v.name, v.raw) for v in found.values] == [
        ("statusword", 0x1237),
        ("position actual value", -7),
        ("torque actual value", 5),
    ]
    assert "operation enabled" in found.text
    other = decoded([*mapping(5), frame(0x185, tpdo[:6])])[-1]
    assert "not what is mapped" in other.text


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.builds(
            frame,
            st.integers(0, 0x7FF),
            st.binary(max_size=8),
            st.floats(0, 1e6),
            is_rx=st.booleans(),
            is_error_frame=st.booleans(),
        ),
        max_size=40,
    )
)
def test_any_frames_are_decoded_and_counted(frames: list[can.Message]) -> None:
    counting = Counting(500_000)
    for one in decoded([*mapping(3), *frames]):
        assert one.text
        counting.add(one)
    found = counting.result()
    assert found.frames == sum(found.kinds.values()) == len(frames) + len(mapping(3))


# --- counting ----------------------------------------------------------------------------------------


def cycles(count: int, missing: int = -1, doubled: int = -1, late: int = -1) -> list[can.Message]:
    frames, time = mapping(5), 0.0
    for k in range(count):
        time += 0.002 if k == late else 0.001
        frames += [sent(0x205, bytes(8), time - 2e-4), sent(0x80, b"", time)]
        for _ in range(0 if k == missing else 2 if k == doubled else 1):
            frames.append(frame(0x185, bytes(8), time + 2e-4))
    return frames


def counted(frames: list[can.Message], bitrate: int = 1_000_000):
    counting = Counting(bitrate)
    for one in decoded(frames):
        counting.add(one)
    return counting.result()


def test_missing_doubled_and_late_are_counted() -> None:
    found = counted(cycles(200, missing=60, doubled=90, late=120))
    (pdos,) = found.pdos
    assert (pdos.received, pdos.missing, pdos.doubled) == (200, 1, 1)
    assert found.pace is not None
    assert (found.pace.syncs, found.pace.late, found.pace.pauses) == (200, 1, 0)
    assert found.pace.median == pytest.approx(0.001)
    assert found.pace.longest == pytest.approx(0.002)


def test_a_pause_is_no_late_cycle() -> None:
    first = cycles(100)
    later = [frame(m.arbitration_id, bytes(m.data), m.timestamp + 1, is_rx=m.is_rx) for m in first]
    found = counted([*first, *later[len(mapping(5)) :]])
    assert found.pace is not None
    assert (found.pace.late, found.pace.pauses) == (0, 1)


def test_the_load_is_that_of_the_frames() -> None:
    found = counted([frame(0x185, bytes(8), k * 1e-3) for k in range(1001)], 500_000)
    assert found.mean_load == pytest.approx(1001 * 135 / 500_000, rel=1e-3)
    assert found.peak_load == pytest.approx(100 * 135 / 50_000, rel=0.02)


def test_aborts_emergencies_and_silence_are_told() -> None:
    frames = [
        sent(0x605, b"\x40\x00\x20\0\0\0\0\0", 0.1),
        frame(0x585, b"\x80\x00\x20\0\0\0\x02\x06", 0.2),
        sent(0x605, b"\x40\x00\x21\0\0\0\0\0", 0.3),
        sent(0x605, b"\x40\x00\x22\0\0\0\0\0", 0.9),
        frame(0x085, b"\x10\x23\0\0\0\0\0\0", 1.0),
        frame(0x705, b"\0", 1.1),
    ]
    found = counted(frames)
    assert found.unanswered == 2
    assert len(found.aborts) == 1
    assert "0x2000:00" in found.aborts[0]
    assert found.emergencies == (
        "1.000 s node 5: emergency 0x2310 (current, device output side)",
    ) or ("0x2310" in found.emergencies[0])
    assert found.boots == ("1.100 s node 5",)


# --- process data ------------------------------------------------------------------------------------


def test_a_recording_with_gaps_is_found_in_pieces(fresh_rng: np.random.Generator) -> None:
    position = fresh_rng.integers(-1000, 1000, (500, 2)) * 1e-6
    torque = fresh_rng.integers(-50, 50, (500, 2)) * 1e-3
    data = ProcessData((1, 2), np.arange(500.0), position, torque, position)
    keep = np.r_[50:150, 170:300]
    pieces = find(data, position[keep], torque[keep])
    assert [(p.row, p.sync, p.rows) for p in pieces] == [(0, 50, 100), (100, 170, 130)]
    changed = torque[keep].copy()
    changed[120, 1] += 1e-3
    assert sum(p.rows for p in find(data, position[keep], changed)) == 120


def test_positions_belong_to_the_sync_before_them() -> None:
    def tpdo(position: int, time: float) -> can.Message:
        return frame(0x185, bytes(2) + position.to_bytes(4, "little") + bytes(2), time)

    frames = [*mapping(5), sent(0x80), tpdo(3, 0.1), sent(0x80), sent(0x80), tpdo(9, 0.2)]
    raw = [
        Decoded(
            **{
                **vars(one),
                "values": tuple(
                    type(v)(v.address, v.name, v.raw, float(v.raw)) for v in one.values
                ),
            }
        )
        for one in decoded(frames)
    ]
    data = rebuilt(raw, [5])
    assert data.position[:, 0].tolist()[::2] == [3.0, 9.0]
    assert np.isnan(data.position[1, 0])


# --- the bus -----------------------------------------------------------------------------------------

SESSION = [
    sent(0x605, b"\x40\x00\x10\0\0\0\0\0", 1.0),
    frame(0x585, b"\x43\x00\x10\0\x92\x01\0\0", 1.002),
    sent(0x77F, b"\x05", 1.003),
    frame(0x705, b"\x7f", 1.2),
    sent(0x80, b"", 1.5),
    frame(0x185, bytes(8), 1.5002),
    sent(0x80, b"", 1.501),
]


@pytest.fixture
def trace(tmp_path: Path) -> Path:
    return written(tmp_path / "trace.log", SESSION)


def test_the_recorded_host_gets_the_recorded_answers(trace: Path) -> None:
    with ReplayBus(str(trace)) as bus:
        assert bus.recv(0.0) is None, "nothing comes before the first request"
        bus.send(SESSION[0])
        assert bytes(bus.recv(0.5).data) == bytes(SESSION[1].data)  # type: ignore[union-attr]
        assert bus.now() == pytest.approx(1.002, abs=0.0015)
        bus.send(sent(0x77F, b"\x05"))
        assert bus.recv(1.0).arbitration_id == 0x705  # type: ignore[union-attr]
        assert bus.recv(0.25) is None
        assert bus.now() == pytest.approx(1.5)
        bus.send(SESSION[4])
        assert bus.recv(0.0).arbitration_id == 0x185  # type: ignore[union-attr]
        assert not bus.finished
        bus.send(SESSION[6])
        assert bus.finished
        assert bus.recv(0.5) is None


@pytest.mark.parametrize("beats", [0, 5])
def test_the_hosts_heartbeat_goes_by_the_clock(trace: Path, beats: int) -> None:
    with ReplayBus(str(trace)) as bus:
        for k in (0, 4, 6):
            for _ in range(beats):
                bus.send(sent(0x77F, b"\x05"))
            bus.send(SESSION[k])
        assert bus.finished


def test_the_first_difference_is_named_and_ends_the_replay(trace: Path) -> None:
    with ReplayBus(str(trace)) as bus:
        bus.send(SESSION[0])
        with pytest.raises(
            can.CanOperationError,
            match=r"frame 5 at 1\.500000 s was 080 \[no data\], now 205 \[0F 00\]",
        ):
            bus.send(sent(0x205, b"\x0f\x00"))
        assert not bus.finished
        with pytest.raises(can.CanOperationError, match="has ended"):
            bus.send(SESSION[4])


def test_more_than_was_sent_is_a_difference(trace: Path) -> None:
    with ReplayBus(str(trace)) as bus:
        for k in (0, 4, 6):
            bus.send(SESSION[k])
        with pytest.raises(can.CanOperationError, match="nothing more was sent"):
            bus.send(SESSION[6])


def test_time_waits_for_the_host_of_then(trace: Path) -> None:
    with ReplayBus(str(trace)) as bus:
        bus.send(SESSION[0])
        bus.wait_until(1.1)
        assert bus.now() == pytest.approx(1.5), "then, it sent no sooner"


def test_filters_hold(trace: Path) -> None:
    with ReplayBus(str(trace), can_filters=[{"can_id": 0x705, "can_mask": 0x7FF}]) as bus:
        bus.send(SESSION[0])
        assert bus.recv(1.0).arbitration_id == 0x705  # type: ignore[union-attr]


def test_it_is_opened_like_any_other_bus(trace: Path) -> None:
    bus = open_bus(BusProfile(interface="fieldreplay", channel=str(trace)))
    assert isinstance(bus, ReplayBus)
    bus.shutdown()
    with pytest.raises(BusError, match="no such file"):
        open_bus(BusProfile(interface="fieldreplay", channel=str(trace) + ".asc"))
