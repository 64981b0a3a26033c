"""Torque offsets streamed with target positions: what they do, when they act, and when they end."""

import struct
from dataclasses import dataclass
from importlib.resources import files

import numpy as np
import pytest
import yaml

from drives.api import Targets
from drives.errors import LimitsError, NotSupportedError, SafetyStopError, UserStopError
from drives.sim.faults import DriveFault, Fault, SdoRefused, WriteAltered

TABLE, ARM = 11, 12
TORQUE_OFFSET, TARGET_TORQUE = 0x60B20010, 0x60710010
UNIT = 0.004
"""N m per mille of both axes' rated torque."""
ENABLE = 0x0F


def once(block):
    return lambda before: block if before is None else None


def pushed(motion, offsets):
    """Hold all positions, with these torque offsets of the first axis (n,) or of all (n, M)."""
    m = motion.position.size
    if offsets.ndim == 1:
        offsets = np.stack([offsets] + [0 * offsets] * (m - 1), axis=1)
    return Targets(np.tile(motion.position, (offsets.shape[0], 1)), offsets)


def sent(frames, node):
    """SYNC at which they act, controlword and torque of a node's RPDOs."""
    rows = [
        (f.sync + 1, *struct.unpack("<Hih", f.data)) for f in frames if f.cob_id == 0x200 + node
    ]
    return np.array([(sync, word, torque) for sync, word, _, torque in rows])


def rigid(profile_of_two, noise=0.004):
    """The arm alone: 0.04 kg m2 on a motor with viscous friction 0.02 N m s/rad."""
    profile = profile_of_two
    del profile["axes"][0], profile["simulation"]["axes"][0]
    del profile["couplings"], profile["simulation"]["couplings"]
    profile["simulation"]["axes"][0]["torque_noise"] = noise
    return profile


def drive_without(folder, change_profile=lambda p: None, change_eds=lambda text: text):
    """Put a drive profile like the reference drive's, but for one thing, beside the machine's."""
    packaged = files("profiles").joinpath("drives")
    profile = yaml.safe_load(packaged.joinpath("reference.yaml").read_text(encoding="utf-8"))
    profile["name"], profile["eds"] = "other", "other.eds"
    change_profile(profile)
    (folder / "other.yaml").write_text(yaml.safe_dump(profile), encoding="utf-8")
    eds = packaged.joinpath("reference.eds").read_text(encoding="utf-8")
    (folder / "other.eds").write_text(change_eds(eds), encoding="utf-8")
    return "other.yaml"


def not_in_profile(profile):
    profile["torque_offset"] = False


def edited(section_edit):
    """Return a change of the EDS' section 60B2."""

    def change(text):
        head, rest = text.split("[60B2]\n")
        section, tail = rest.split("\n[", 1)
        return head + "[60B2]\n" + section_edit(section) + "\n[" + tail

    return change


@dataclass(frozen=True)
class Look(Fault):
    """Look at what is mapped and at 0x60B2 at this moment."""

    seen: tuple = ()

    def set(self, machine, *, present):
        read = machine.node(self.node_id).dictionary.read
        self.seen[0].append((read(0x1600, 3), read(0x60B2, 0)))


# --- what is sent --------------------------------------------------------------------------------


def test_offsets_go_out_with_the_targets_rounded_as_the_capture_says(bench, fresh_rng):
    offsets = fresh_rng.uniform(-0.8, 0.8, (60, 2))
    seen: list = []
    bench.inject(Look(TABLE, (seen,)), 60)
    bench.listen()
    with bench.connected() as group:
        assert group.torque_offsets == (True, True)
        with group.motion(0.002, torque_offset=True) as motion:
            assert motion.torque_offsets == (True, True)
            first = bench.machine.sync_count + 1
            blocks = iter([pushed(motion, offsets[:25]), pushed(motion, offsets[25:])])
            capture = motion.stream(lambda _: next(blocks, None))
    assert seen
    assert {mapped for mapped, _ in seen} == {TORQUE_OFFSET}
    np.testing.assert_allclose(capture.torque_offset, offsets, rtol=0, atol=0.501 * UNIT)
    frames = bench.heard()
    for k, node in enumerate((TABLE, ARM)):
        rows = sent(frames, node)
        streamed = rows[(rows[:, 0] >= first) & (rows[:, 0] < first + 60)]
        assert np.all(streamed[:, 1] == ENABLE)
        np.testing.assert_array_equal(streamed[:, 2] * UNIT, capture.torque_offset[:, k])
        rest = rows[(rows[:, 0] < first) | (rows[:, 0] >= first + 60)]
        assert not rest[:, 2].any(), "before and after the stream there is no offset"
    assert bench.changed() == {}
    assert bench.powered() == {}


def test_without_torque_offsets_all_is_as_it_was(bench):
    seen: list = []
    bench.inject(Look(TABLE, (seen,)), 60)
    with bench.connected() as group, group.motion(0.002) as motion:
        capture = motion.stream(once(np.tile(motion.position, (60, 1))))
    assert capture.torque_offset is None
    assert {mapped for mapped, _ in seen} == {TARGET_TORQUE}
    assert bench.changed() == {}


def test_plain_targets_in_such_a_motion_have_offsets_of_zero(bench):
    with bench.connected() as group, group.motion(0.002, torque_offset=True) as motion:
        capture = motion.stream(once(np.tile(motion.position, (10, 1))))
    np.testing.assert_array_equal(capture.torque_offset, np.zeros((10, 2)))


@pytest.mark.parametrize("streamed", [True, False])
def test_what_stood_in_the_drive_is_zero_while_axes_move_and_put_back(bench, streamed):
    node = bench.machine.node(TABLE)
    node.dictionary.write(0x60B2, 0, 70)
    bench.before = bench.objects()
    seen: list = []
    bench.inject(Look(TABLE, (seen,)), 40)
    with bench.connected() as group, group.motion(0.002, torque_offset=streamed) as motion:
        motion.stream(once(np.tile(motion.position, (60, 1))))
    assert [value for _, value in seen] == [0]
    assert node.motion.torque_offset == 70
    assert bench.changed() == {}


def test_a_floating_axis_is_not_pushed_by_what_stood_in_the_drive(bench):
    bench.machine.node(ARM).dictionary.write(0x60B2, 0, 100)
    seen: list = []
    bench.inject(Look(ARM, (seen,)), 40)
    with bench.connected() as group, group.motion(0.002, ("arm",)) as motion:
        capture = motion.stream(once(np.tile(motion.position, (60, 1))))
    assert [value for _, value in seen] == [0]
    assert np.abs(capture.torque[:, 1]).max() < 0.05
    assert bench.machine.node(ARM).motion.torque_offset == 100


def test_a_drive_that_keeps_its_offset_is_not_enabled(bench):
    bench.machine.node(ARM).dictionary.write(0x60B2, 0, 100)
    bench.inject(WriteAltered(ARM, 0x60B2, 0, 100))
    with (
        bench.connected() as group,
        pytest.raises(NotSupportedError, match=r"arm, object 0x60B2:00 .*wrote 0, .* holds 100"),
    ):
        group.motion(0.002, torque_offset=True).__enter__()
    assert bench.powered() == {}


def test_feed_forward_of_the_drives_stays_off_while_offsets_act(bench):
    node = bench.machine.node(TABLE).dictionary
    with bench.connected() as group:
        with group.without_feed_forward():
            with group.motion(0.002, torque_offset=True) as motion:
                capture = motion.stream(once(pushed(motion, np.full(20, 0.5))))
                assert node.read(0x2010, 4) == 0
            assert node.read(0x2010, 4) == 0
        assert node.read(0x2010, 4) == 1000
    assert capture.torque[1:4, 0].min() > 0.2, "what the host streams acts all the same"
    assert bench.changed() == {}


# --- when it acts, and what it does ----------------------------------------------------------------


def test_an_offset_of_one_row_shows_in_the_torque_of_the_next(make_bench, profile_of_two):
    """SYNC k samples first and lets the offset act then; SYNC k + 1 sees the current settled."""
    bench = make_bench(rigid(profile_of_two, noise=0.0))
    offsets = np.zeros(12)
    offsets[5] = 1.0
    with bench.connected() as group, group.motion(0.002, torque_offset=True) as motion:
        capture = motion.stream(once(pushed(motion, offsets)))
    np.testing.assert_array_equal(np.flatnonzero(capture.torque_offset[:, 0]), [5])
    torque, position = capture.torque[:, 0], capture.position[:, 0]
    assert np.all(torque[:6] == 0.0)
    assert np.all(position[:6] == position[0])
    # 1 N m for 2 ms on 0.04 kg m2: 0.05 rad/s, which velocity P of 1.2 N m s/rad brakes
    assert 1.0 - 0.05 * 1.2 - 2 * UNIT <= torque[6] < 1.0
    assert abs(torque[7]) < 0.1
    lag, count = 1 / (2 * np.pi * 1000), 2 * np.pi / 2**20
    moved = position[6] - position[0]
    after = 0.5 * 1.0 / 0.04 * (0.002**2 - 2 * lag * 0.002 + 2 * lag**2)
    assert moved == pytest.approx(after, abs=1.5 * count)


def closed_loop(frequency, cycle_time):
    """Position over torque offset of the rigid arm, sampled at SYNC, from its data sheets.

    In continuous time: P position loop over PI velocity loop, their half an inner step of hold, the
    current loop's lag, the offset held from SYNC to SYNC.  The velocity is a difference quotient,
    whose half step of delay its filter, which takes the newest value at once, just gains back.
    """
    s = 2j * np.pi * frequency
    current = 1 / (1 + s / (2 * np.pi * 1000))
    plant = current / (0.04 * s**2 + 0.02 * s)
    controller = (1.2 + 8 / s) * (15 + s / (1 + s / (2 * np.pi * 150))) * np.exp(-s / 16000)
    held = (1 - np.exp(-s * cycle_time)) / (s * cycle_time)
    return held * plant / (1 + plant * controller)


@pytest.mark.parametrize("cycle_time", [0.001, 0.002, 0.004])
def test_a_sine_offset_moves_a_held_axis_as_theory_says(
    make_bench, profile_of_two, fresh_rng, cycle_time
):
    frequency = float(fresh_rng.integers(4, min(40, 0.06 / cycle_time)))
    amplitude, phase = fresh_rng.uniform(0.6, 1.2), fresh_rng.uniform(0, 2 * np.pi)
    print(f"{frequency} Hz, {amplitude} N m, phase {phase}")
    bench = make_bench(rigid(profile_of_two))
    rows, settled = round(4 / cycle_time), round(2 / cycle_time)
    turns = frequency * cycle_time * np.arange(rows)
    with bench.connected() as group, group.motion(cycle_time, torque_offset=True) as motion:
        offsets = amplitude * np.sin(2 * np.pi * turns + phase)
        capture = motion.stream(once(pushed(motion, offsets)))
    carrier = np.exp(-2j * np.pi * turns[settled:]) * 2 / (rows - settled)
    offset = carrier @ capture.torque_offset[settled:, 0]
    assert abs(offset) == pytest.approx(amplitude, rel=0.01)
    ratio = carrier @ capture.position[settled:, 0] / offset / closed_loop(frequency, cycle_time)
    assert abs(ratio) == pytest.approx(1.0, abs=0.006)
    assert abs(np.rad2deg(np.angle(ratio))) < 0.5


def test_torque_corrected_for_the_hold_gives_the_plant(make_bench, profile_of_two, fresh_rng):
    """The torque of a row is that of one instant, just before the offset's next step.

    The offset's part in it is one cycle late; what acts on the machine is the offset held over the
    cycle, half a cycle late.  With that put right, position over torque is the plant.
    """
    cycle_time, frequency = 0.002, float(fresh_rng.integers(10, 30))
    print(f"{frequency} Hz")
    bench = make_bench(rigid(profile_of_two))
    turns = frequency * cycle_time * np.arange(2000)
    with bench.connected() as group, group.motion(cycle_time, torque_offset=True) as motion:
        capture = motion.stream(once(pushed(motion, np.sin(2 * np.pi * turns))))
    carrier = np.exp(-2j * np.pi * turns[1000:]) / 500
    x, t, u = (
        carrier @ signal[1000:, 0]
        for signal in (capture.position, capture.torque, capture.torque_offset)
    )
    s = 2j * np.pi * frequency
    held = (1 - np.exp(-s * cycle_time)) / (s * cycle_time) / (1 + s / (2 * np.pi * 1000))
    acting = t + u * (held - np.exp(-s * cycle_time))
    plant = 1 / (0.04 * s**2 + 0.02 * s)
    assert abs(x / acting / plant - 1) < 0.006
    assert abs(np.rad2deg(np.angle(x / t / plant))) > 2, "without it the phase is wrong"


# --- when it ends --------------------------------------------------------------------------------


def held_torques_after(bench, frames, sync):
    """Torques of all RPDOs that act after a SYNC; there are some for each axis."""
    after = [rows[rows[:, 0] > sync] for rows in (sent(frames, TABLE), sent(frames, ARM))]
    assert all(rows.shape[0] > 2 for rows in after)
    return np.concatenate(after)[:, 2]


def test_the_end_of_a_stream_takes_the_offset_away_and_the_axes_stay_enabled(bench):
    bench.listen()
    with bench.connected() as group, group.motion(0.002, torque_offset=True) as motion:
        one = motion.stream(once(pushed(motion, np.full(30, 0.6))))
        last = bench.machine.sync_count - 1  # one more cycle held the positions
        assert bench.machine.node(TABLE).motion.torque_offset == 0
        assert set(bench.powered()) == {TABLE, ARM}
        other = motion.stream(once(np.tile(one.position_reference[-1], (30, 1))))
    assert (one.rows, other.rows) == (30, 30)
    assert other.first_sync == one.first_sync + 31
    torques = held_torques_after(bench, bench.heard(), last)
    assert not torques.any()
    assert bench.machine.axes.torque(0) == 0.0
    assert bench.changed() == {}


class SomethingBroke(Exception):
    """Nothing that the drives know of."""


@pytest.mark.parametrize("cause", ["user", "program", "drive", "limit"])
def test_every_stop_takes_the_offset_away_in_the_next_cycle(bench, cause):
    stop = False
    bench.listen()
    last = 0
    expected = {
        "user": UserStopError,
        "program": SomethingBroke,
        "drive": SafetyStopError,
        "limit": SafetyStopError,
    }[cause]

    def source(before):
        nonlocal stop, last
        if before is None:
            return pushed(motion, np.full(40, 0.6))
        last = bench.machine.sync_count
        if cause == "program":
            raise SomethingBroke
        if cause == "drive":
            bench.inject(DriveFault(ARM))
        stop = cause == "user"
        return pushed(motion, np.full(40, 0.6 if cause != "limit" else 6.1))

    with (
        bench.connected(lambda: stop) as group,
        pytest.raises(expected),
        group.motion(0.002, torque_offset=True) as motion,
    ):
        motion.stream(source)
    frames = bench.heard()
    seen = {"user": 1, "program": 0, "drive": 1, "limit": 0}[cause]
    rows = sent(frames, TABLE)
    assert np.all(rows[rows[:, 0] == last, 2] == 150), "it was on until then"
    assert not held_torques_after(bench, frames, last + seen).any()
    assert bench.powered() == {}
    assert bench.machine.axes.torque(0) == bench.machine.axes.torque(1) == 0.0
    assert bench.changed() == {}


def test_a_drive_that_hears_no_pdo_any_more_has_its_offset_taken_away_by_sdo(bench):
    def source(before):
        if before is not None:
            bench.machine.receive(0x000, bytes([0x80, TABLE]))  # somebody's NMT command
        return pushed(motion, np.full(40, 0.6))

    with (
        bench.connected() as group,
        pytest.raises(SafetyStopError, match="table: node 11"),
        group.motion(0.002, torque_offset=True) as motion,
    ):
        motion.stream(source)
    assert bench.powered() == {}
    assert bench.machine.node(TABLE).motion.torque_offset == 0
    assert bench.changed() == {}


# --- what is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "error", "sentence"),
    [
        (
            6.01,
            SafetyStopError,
            r"arm: a torque offset of 6\.01 N m is above the torque limit 6 N m",
        ),
        (
            -6.01,
            SafetyStopError,
            "arm: a torque offset of 6.01 N m is above the torque limit 6 N m",
        ),
        (1e300, SafetyStopError, "arm: a torque offset of .* is above the torque limit 6 N m"),
        (np.nan, ValueError, "arm: torque offset nan in row 17 of a block is not finite"),
        (-np.inf, ValueError, "arm: torque offset -inf in row 17 of a block is not finite"),
    ],
)
def test_a_block_with_a_bad_offset_is_not_begun(bench, value, error, sentence):
    offsets = np.full((20, 2), 0.1)
    offsets[17, 1] = value
    bench.listen()
    with (
        bench.connected() as group,
        pytest.raises(error, match=sentence),
        group.motion(0.002, torque_offset=True) as motion,
    ):
        motion.stream(once(pushed(motion, offsets)))
    frames = bench.heard()
    assert not sent(frames, TABLE)[:, 2].any()
    assert not sent(frames, ARM)[:, 2].any()
    assert bench.powered() == {}
    assert bench.changed() == {}


def test_offsets_in_a_motion_without_them_are_refused(bench):
    with (
        bench.connected() as group,
        pytest.raises(SafetyStopError, match=r"table: a torque offset of 0\.2 N m .* takes none"),
        group.motion(0.002) as motion,
    ):
        motion.stream(once(pushed(motion, np.full(5, 0.2))))
    assert bench.powered() == {}


def test_axes_can_not_float_while_offsets_are_streamed(bench):
    syncs = bench.machine.sync_count
    with (
        bench.connected() as group,
        pytest.raises(LimitsError, match="arm: can not float while torque offsets are streamed"),
    ):
        group.motion(0.002, ("arm",), torque_offset=True).__enter__()
    assert bench.machine.sync_count == syncs
    assert bench.changed() == {}


WITHOUT = {
    "profile": (not_in_profile, lambda t: t, "profile other does not say `torque_offset: true`"),
    "mapping": (
        lambda p: None,
        edited(lambda s: s.replace("PDOMapping=1", "PDOMapping=0")),
        "other.eds lets no PDO carry torque offset 0x60B2:00",
    ),
    "access": (
        lambda p: None,
        edited(lambda s: s.replace("AccessType=rw", "AccessType=rwr")),
        "other.eds lets no PDO carry torque offset 0x60B2:00",
    ),
    "type": (
        lambda p: None,
        edited(lambda s: s.replace("DataType=0x0003", "DataType=0x0004")),
        "other.eds has torque offset 0x60B2:00 as INTEGER32, the tool's PDO needs INTEGER16",
    ),
    "absent": (
        lambda p: None,
        lambda t: t.replace("[60B2]", "[5FFF]").replace("=0x60B2", "=0x5FFF"),
        "other.eds has no torque offset 0x60B2:00",
    ),
}


@pytest.mark.parametrize("lacking", WITHOUT)
def test_where_no_drive_has_it_none_is_enabled(make_bench, profile_of_two, tmp_path, lacking):
    profile_change, eds_change, sentence = WITHOUT[lacking]
    for axis in profile_of_two["axes"]:
        axis["drive"] = drive_without(tmp_path, profile_change, eds_change)
    bench = make_bench(profile_of_two)
    with (
        bench.connected() as group,
        pytest.raises(NotSupportedError, match="no drive takes a torque offset") as refused,
    ):
        assert group.torque_offsets == (False, False)
        group.motion(0.002, torque_offset=True).__enter__()
    assert f"{sentence}; arm: " in str(refused.value)
    assert str(refused.value).count(sentence) == 2
    assert bench.machine.sync_count == 0
    assert bench.changed() == {}


@pytest.mark.parametrize("lacking", ["profile", "mapping", "absent"])
def test_an_axis_without_it_keeps_its_target_torque_of_zero(
    make_bench, profile_of_two, tmp_path, lacking
):
    profile_of_two["axes"][1]["drive"] = drive_without(tmp_path, *WITHOUT[lacking][:2])
    bench = make_bench(profile_of_two)
    seen: list = []
    bench.inject(Look(ARM, (seen,)), 40)
    bench.listen()
    with bench.connected() as group:
        assert group.torque_offsets == (True, False)
        with (
            pytest.raises(
                SafetyStopError, match=r"arm: a torque offset of -0\.1 N m .* takes none"
            ),
            group.motion(0.002, torque_offset=True) as motion,
        ):
            assert motion.torque_offsets == (True, False)
            capture = motion.stream(once(pushed(motion, np.full(40, 0.3))))
            motion.stream(once(pushed(motion, np.full((5, 2), -0.1))))
    assert [mapped for mapped, _ in seen] == [TARGET_TORQUE]
    np.testing.assert_allclose(capture.torque_offset, np.tile([0.3, 0.0], (40, 1)), atol=UNIT / 2)
    assert not sent(bench.heard(), ARM)[:, 2].any()
    assert bench.changed() == {}


def test_a_drive_whose_eds_promises_too_much_refuses_too(small_bench):
    small_bench.inject(SdoRefused(TABLE, 0x60B2, 0, 0x06020000))
    with (
        small_bench.connected() as group,
        pytest.raises(NotSupportedError, match="table: the drive has no torque offset 0x60B2:00"),
    ):
        assert group.torque_offsets == (False,)
        group.motion(0.002, torque_offset=True).__enter__()
    assert small_bench.powered() == {}
