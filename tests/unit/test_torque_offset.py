"""Blocks of targets with torque offsets: rounded to the drive's units, refused above a limit."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drives.api import AxisLimits, Capture, Targets, joined
from drives.canopen_drive.channel import channel_of
from drives.canopen_drive.outputs import OUTPUT_ROW, outputs_of
from drives.canopen_drive.unseen import Learned
from drives.errors import SafetyStopError
from drives.profile import DriveProfile, load_drive
from drives.units import AxisScaling


@dataclass(frozen=True)
class FakeDrive:
    """What a channel looks up in a drive; it does not imitate a bus or objects."""

    axis: str
    limits: AxisLimits
    scaling: AxisScaling
    node_id: int = 5
    position_unit: str = "rad"
    torque_unit: str = "N m"
    learned: Learned = field(default_factory=Learned)

    @property
    def axis_profile(self):
        return SimpleNamespace(prior=SimpleNamespace(masses=(0.02,), springs=()), may_float=False)


def channel(name="x", rated=4.0, limit=6.0, takes_offset=True):
    limits = AxisLimits((-2.0, 2.0), 10.0, 400.0, limit, 0.5)
    drive = FakeDrive(name, limits, AxisScaling(1e-5, 1e-5, rated / 1000))
    return channel_of(drive, 0.002, False, takes_offset)  # type: ignore[arg-type]


def block(*offsets):
    values = np.array(offsets, dtype=float)
    return Targets(np.zeros(values.shape), values)


def capture(first, rows, offset=None):
    data = np.full((rows, 2), float(first))
    offsets = None if offset is None else np.full((rows, 2), offset)
    return Capture(first, data, data, data, data.astype(np.uint16), (), offsets)


def test_targets_need_one_shape():
    with pytest.raises(ValueError, match=r"got \(3, 2\) and \(3, 1\)"):
        Targets(np.zeros((3, 2)), np.zeros((3, 1)))
    with pytest.raises(ValueError, match=r"got \(3,\) and \(3,\)"):
        Targets(np.zeros(3), np.zeros(3))


def test_joined_captures_keep_their_offsets():
    both = joined([capture(0, 3, 0.5), capture(3, 2, -0.25)])
    assert both.torque_offset is not None
    np.testing.assert_array_equal(both.torque_offset[:, 0], [0.5, 0.5, 0.5, -0.25, -0.25])
    mixed = joined([capture(0, 2), capture(2, 1, 1.5), capture(3, 1)])
    assert mixed.torque_offset is not None
    np.testing.assert_array_equal(mixed.torque_offset, [[0, 0], [0, 0], [1.5, 1.5], [0, 0]])
    assert joined([capture(0, 2), capture(2, 1)]).torque_offset is None


def test_only_a_profile_that_says_so_has_torque_offsets():
    assert load_drive("reference").torque_offset
    assert not DriveProfile.model_fields["torque_offset"].default


@given(
    rated=st.floats(0.01, 500.0),
    share=st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=20),
    limit=st.floats(0.1, 60.0),
)
def test_an_offset_within_the_limit_is_sent_to_the_nearest_unit(rated, share, limit):
    """The limit in multiples of the rated torque; some of them are more than 0x60B2 can hold."""
    unit = rated / 1000
    allowed = min(limit * rated, 32767 * unit) - unit  # rounding never leads beyond the limit
    offsets = allowed * np.array(share)
    out = outputs_of(block(*offsets[:, None]), [channel(rated=rated, limit=limit * rated)], 0)
    assert np.abs(out.torque_offset[:, 0] - offsets).max() <= 0.5 * unit * (1 + 1e-6)
    rows = np.frombuffer(out.frames[0], dtype=OUTPUT_ROW)
    assert np.all(rows["controlword"] == 0x0F)
    np.testing.assert_array_equal(rows["torque"] * unit, out.torque_offset[:, 0])


@pytest.mark.parametrize(
    ("rated", "limit", "offset", "named"),
    [
        (4.0, 6.0, 6.0001, "6 N m is above the torque limit 6 N m"),
        (4.0, 6.003, 6.003, "6.004 N m is above the torque limit 6.003 N m"),  # as it would be sent
        (1.0, 50.0, 33.0, "33 N m is above the most that object 0x60B2 holds, 32.77 N m"),
        (1.0, 50.0, -40.0, "40 N m is above the most that object 0x60B2 holds, 32.77 N m"),
    ],
)
def test_above_the_limit_before_or_after_rounding_is_refused(rated, limit, offset, named):
    channels = [channel("x"), channel("y", rated, limit)]
    with pytest.raises(SafetyStopError) as refused:
        outputs_of(block([0.0, 0.0], [0.0, offset]), channels, 77)
    assert f"y: a torque offset of {named}; it was not sent" in str(refused.value)
    assert (refused.value.axis, refused.value.cycle) == ("y", 77)


def test_the_limit_itself_is_allowed():
    out = outputs_of(block([6.0], [-6.0]), [channel()], 0)
    np.testing.assert_array_equal(out.offset_units[:, 0], [1500, -1500])


def test_an_axis_that_takes_none_gets_none():
    channels = [channel("x"), channel("y", takes_offset=False)]
    out = outputs_of(block([1.0, 0.0]), channels, 0)
    np.testing.assert_array_equal(out.offset_units, [[250, 0]])
    with pytest.raises(SafetyStopError, match=r"y: a torque offset of -0\.001 N m .* takes none"):
        outputs_of(block([1.0, 0.0], [1.0, -0.001]), channels, 0)
    plain = outputs_of(np.zeros((3, 2)), channels, 0)
    np.testing.assert_array_equal(plain.torque_offset, np.zeros((3, 2)))
