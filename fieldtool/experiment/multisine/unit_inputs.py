"""What a unit of each axis' input does at each line, and how inputs are spread over the lines.

An axis' input is its position reference, or, where a drive's filters pass little of that, a torque
offset.  All loops are closed, so each input moves all axes, and each takes its share of every limit.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.forecast import allowed_peaks, offset_response
from fieldtool.records.closed_loop import AxisLoop, ComplexArray
from fieldtool.records.model import FloatArray

CREST = 2.5
"""Peak over root mean square that is reckoned with before a plan is simulated."""
WEAK = 0.35
"""Of the largest torque at any line that a controller asks for per reference, its axis locked: where
it is less, behind its filters, a torque offset excites the axis if its drive takes one."""
BEYOND, SMOOTH = 8.0, 0.05
"""A drive takes torque offsets once a cycle.  Their steps must not reach the torque, which is sampled
at the same rate: at so many times the highest line, below the rate of the cycles, the drive's filters
may pass so much."""
TIGHT = 0.7
"""Of the use of the nearest limit, from which an output must not have peaks."""
ROUNDS = 8
"""Of bringing the axes' factors to one level."""


@dataclass(frozen=True, eq=False)
class UnitInputs:
    """What a unit input of each axis does at each line, by the model."""

    setting: Setting
    omega: FloatArray
    """(L,), rad/s."""
    by_torque: NDArray[np.bool_]
    """Where the input is a torque offset and not a position reference, (L, M)."""
    position: ComplexArray
    """(L, M motors, M inputs)."""
    torque: ComplexArray
    """(L, M motors, M inputs)."""

    @cached_property
    def outputs(self) -> ComplexArray:
        """All that has a limit, as a share of it, for a unit input: (5, L, M motors, M inputs)."""
        w = self.omega[:, None, None]
        reference = np.eye(len(self.setting.loops)) * ~self.by_torque[:, None, :]
        moved = [
            self.position,
            self.position * w,
            self.position * w**2,
            self.torque,
            reference - self.position,
        ]
        allowed = allowed_peaks(self.setting)[:, None, :, None]
        shares: ComplexArray = (np.stack(moved) / allowed).astype(np.complex128)
        return shares

    def use(self, size: FloatArray, crest: FloatArray) -> FloatArray:
        """Return the share of each limit that each axis uses with inputs (L, M), shape (5, M).

        Orthogonal experiments share out each input's power: on average an axis moves by the root
        sum of squares of what all inputs pass on to it.

        Parameters
        ----------
        size
            Inputs, peak, shape (L, M).
        crest
            Peak over root mean square, shape (5, M).
        """
        used: FloatArray = crest * np.sqrt(np.einsum("qlij,lj->qi", self.power, size**2))
        return used

    @cached_property
    def power(self) -> FloatArray:
        """Mean square share of each limit for a unit input, shape (5, L, M motors, M inputs)."""
        power: FloatArray = (np.abs(self.outputs) ** 2 / 2).astype(np.float64)
        return power

    def tightest(self, size: FloatArray, crest: FloatArray) -> ComplexArray:
        """Return the outputs that are near to a limit, for a unit input, (L, M, Q).

        For each axis that which is nearest, and all others within TIGHT of the nearest of all.
        """
        use = self.use(size, crest)
        near = (use >= TIGHT * use.max()) | (use == use.max(axis=0))
        columns = [self.outputs[q][:, k, :] for q, k in zip(*np.nonzero(near), strict=True)]
        weights: ComplexArray = np.stack(columns, axis=2)
        return weights


class Spreading(Protocol):
    """How some unit inputs are spread over lines and axes."""

    def sizes(self, share: float, crest: FloatArray) -> FloatArray:
        """Return inputs (L, M), peak, that use a share of the limits with crest factors (5, M)."""

    def loss(self, size: FloatArray) -> float:
        """Return how bad inputs are, (L, M): of two that fit the limits, take the one with less."""


Spread = Callable[[UnitInputs], Spreading]


@dataclass(frozen=True)
class Shape:
    """A spread of the torque by a power of the frequency, all axes equally near to their limits."""

    slope: float
    """0: each line the same; -1: falling with the frequency."""

    def __call__(self, inputs: UnitInputs) -> Spreading:
        """Return the spreading of some inputs."""
        return _Shaped(inputs, self.slope)


@dataclass(frozen=True, eq=False)
class _Shaped:
    inputs: UnitInputs
    slope: float

    def sizes(self, share: float, crest: FloatArray) -> FloatArray:
        omega = self.inputs.omega
        own = np.abs(np.einsum("lkk->lk", self.inputs.torque))
        relative = (omega / np.sqrt(omega[0] * omega[-1])) ** self.slope
        size: FloatArray = relative[:, None] / own
        for _ in range(ROUNDS):
            use = self.inputs.use(size, crest).max(axis=0)
            size = size * np.clip(share / use, 0.25, 4.0) ** 0.7
        return size

    def loss(self, size: FloatArray) -> float:
        return -float(np.sum(np.log(np.linalg.norm(size, axis=0))))


def unit_inputs(
    setting: Setting, lines: NDArray[np.int64], period: float, offsets: Sequence[bool]
) -> UnitInputs:
    """Choose how each axis is excited at each line, and return what a unit of that does.

    Parameters
    ----------
    setting
        Model, loops and limits.
    lines, period
        Line numbers (L,), and the period in s.
    offsets
        Which axes' drives take a torque offset; none where empty.
    """
    loop = setting.closed_loop(())
    axes = len(setting.loops)
    offsets = offsets or (False,) * axes
    omega = (2 * np.pi / period * lines).astype(np.float64)
    shape = (omega.size, axes, axes)
    position, torque = np.zeros(shape, np.complex128), np.zeros(shape, np.complex128)
    by_torque = np.zeros((omega.size, axes), dtype=np.bool_)
    for k in range(axes):
        position[:, :, k], torque[:, :, k] = loop.response(omega, k)
        if offsets[k] and smooth(setting.loops[k], BEYOND * omega[-1]):
            passed = np.abs([setting.loops[k].gain_of_reference(1j * w) for w in omega])
            by_torque[:, k] = passed < WEAK * passed.max()
            unit = np.zeros((omega.size, axes), dtype=np.complex128)
            unit[:, k] = 1.0
            moved, pushed = offset_response(loop, omega, unit)
            there = by_torque[:, k]
            position[there, :, k], torque[there, :, k] = moved[there], pushed[there]
    return UnitInputs(setting, omega, by_torque, position, torque)


def smooth(loop: AxisLoop, omega: float) -> bool:
    """Return whether a drive's filters leave nothing of steps that come at this rate, rad/s."""
    return abs(loop.torque_shape(1j * omega)) < SMOOTH
