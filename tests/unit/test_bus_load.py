"""Frame bits by stuffing real bit patterns, and cycles that fit the bus by trying them all."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drives.bus import (
    MAX_CYCLIC_LOAD,
    CyclicLoad,
    WallClock,
    check_cycle,
    clock_of,
    frame_bits,
    not_imitated,
    open_bus,
    shortest_cycle,
)
from drives.errors import BusError, LimitsError
from drives.profile import BusProfile

FIELDS_STUFFED = 1 + 11 + 1 + 1 + 1 + 4 + 15  # SOF, identifier, RTR, IDE, r0, DLC, CRC
FIELDS_NOT_STUFFED = 1 + 1 + 1 + 7 + 3  # CRC delimiter, ACK, its delimiter, EOF, interframe space


def stuffed(bits: list[int]) -> int:
    """Length after a transmitter's stuffing: after five equal bits comes one of the other kind."""
    length, run, last = 0, 0, None
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        length += 1
        if run == 5:
            length += 1
            last, run = 1 - bit, 1
    return length


def worst_pattern(n: int) -> list[int]:
    """Five equal bits, then groups of four that go on where the stuff bit began."""
    pattern = [0] * 5
    while len(pattern) < n:
        pattern += [1 - pattern[-1]] * 4
    return pattern[:n]


@pytest.mark.parametrize("data_bytes", range(9))
def test_frame_bits_are_the_worst_case(data_bytes: int) -> None:
    n = FIELDS_STUFFED + 8 * data_bytes
    assert frame_bits(data_bytes) == stuffed(worst_pattern(n)) + FIELDS_NOT_STUFFED


def test_known_frames() -> None:
    assert (frame_bits(0), frame_bits(8)) == (55, 135)  # the figures of the literature


@given(st.integers(0, 8), st.data())
def test_no_frame_is_longer(data_bytes: int, data: st.DataObject) -> None:
    n = FIELDS_STUFFED + 8 * data_bytes
    bits = data.draw(st.lists(st.integers(0, 1), min_size=n, max_size=n))
    assert stuffed(bits) + FIELDS_NOT_STUFFED <= frame_bits(data_bytes)


def test_load_of_three_axes_by_hand() -> None:
    load = CyclicLoad(3, 0.001, 1_000_000)
    assert load.bits == 55 + 6 * 135 == 865
    assert load.share == pytest.approx(0.865)
    check_cycle(load)
    assert shortest_cycle(3, 1_000_000) == 0.001
    assert shortest_cycle(4, 1_000_000) == 0.002


@given(st.integers(1, 32), st.integers(10_000, 1_000_000))
def test_the_shortest_cycle_fits_and_no_shorter_one_does(axes: int, bitrate: int) -> None:
    milliseconds = round(1000 * shortest_cycle(axes, bitrate))
    fits = [
        ms
        for ms in range(1, milliseconds + 1)
        if 1000 * CyclicLoad(axes, 1.0, bitrate).bits <= MAX_CYCLIC_LOAD * bitrate * ms
    ]
    assert fits == [milliseconds]
    check_cycle(CyclicLoad(axes, milliseconds / 1000, bitrate))
    if milliseconds > 1:
        with pytest.raises(LimitsError):
            check_cycle(CyclicLoad(axes, (milliseconds - 1) / 1000, bitrate))


def test_a_refusal_has_the_numbers() -> None:
    with pytest.raises(
        LimitsError,
        match=r"6 axes at a cycle of 1 ms need 1675 bits a cycle, 168 % of 1000000 bit/s .* "
        r"at most 90 % are allowed. The shortest cycle that fits is 2 ms",
    ):
        check_cycle(CyclicLoad(6, 0.001, 1_000_000))


def test_a_bus_that_is_not_there() -> None:
    with pytest.raises(BusError, match=r"knows no interface 'nosuch'; it knows .*socketcan"):
        open_bus(BusProfile(interface="nosuch", channel="can0", bitrate=500_000))


def test_real_and_simulated_buses_tell_their_own_time() -> None:
    simulated = open_bus(BusProfile(interface="fieldsim", channel="turntable-arm"))
    try:
        clock = clock_of(simulated)
        before = clock.now()
        clock.wait_until(before + 100.0)  # virtual: takes no time
        assert clock.now() == pytest.approx(before + 100.0)
    finally:
        simulated.shutdown()
    plain = open_bus(BusProfile(interface="virtual", channel="unit-test-bus"))
    try:
        assert isinstance(clock_of(plain), WallClock)
        assert not_imitated(plain) == ()
    finally:
        plain.shutdown()


def test_a_simulated_bus_says_what_it_does_not_imitate() -> None:
    simulated = open_bus(BusProfile(interface="fieldsim", channel="turntable-arm"))
    try:
        assert any("arbitration" in what for what in not_imitated(simulated))
    finally:
        simulated.shutdown()


def test_the_wall_clock_waits() -> None:
    clock = WallClock()
    start = clock.now()
    clock.wait_until(start + 0.003)
    assert clock.now() >= start + 0.003
    clock.wait_until(start)  # has passed: returns at once
