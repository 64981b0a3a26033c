"""What a trial shows of the loops: sensitivity at the excited lines, and the figures of moves.

At a line that only axis k excites, by a torque offset u that its drive adds before its filters F::

    S_k = T_k / (F_k u)                       T_k the torque that the drive gives

and where a position reference excites it, with P = q_k / T_k, the axis with all other loops closed::

    S_k = 1 / (1 + C_k P)                     C_k the drive's controller, as its parameters say

Both are 1 / (1 + L_k) of the axis' loop with the others closed, the kk element of the sensitivity of all
loops together; 1 - S_k is the loop's response, how much of its reference it follows.

An offset is held from cycle to cycle: its spectrum is that of the samples times
``exp(-s T / 2) sinc(w T / 2)``.  Torques are sampled at the cycles too, so the steps of the offset fold
back; the machine does not answer to them.  At 40 Hz and 1 ms that is a tenth of the torque that was
added, and where the loop leaves little of it, most of what is seen: it is taken off
(:func:`fieldtool.frf.held_targets.held_offset`), as far as the filters pass it.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldtool.design.figures import MoveFigures, move_figures
from fieldtool.design.predict import finite
from fieldtool.design.servo import Servo
from fieldtool.frf.held_targets import held_offset
from fieldtool.records.model import FloatArray

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """One axis' sensitivity at the lines that excite it, all other loops closed."""

    frequency: FloatArray
    """Hz, rising, shape (L,)."""
    size: FloatArray
    """abs(1 / (1 + L)), shape (L,)."""
    response: FloatArray | None = None
    """abs(L / (1 + L)), how much of its reference the loop follows, shape (L,); None: not known."""

    @property
    def peak(self) -> float:
        """Largest size, between lines by a parabola in the logarithms."""
        return self._top()[1]

    @property
    def peak_frequency(self) -> float:
        """Hz, where it is."""
        return self._top()[0]

    def _top(self) -> tuple[float, float]:
        k = int(np.argmax(self.size))  # what is no number comes first
        if not np.all(self.size[max(k - 1, 0) : k + 2] > 0):
            return float(self.frequency[k]), float(self.size[k])
        if not 0 < k < self.size.size - 1:
            return float(self.frequency[k]), float(self.size[k])
        x, y = np.log(self.frequency[k - 1 : k + 2]), np.log(self.size[k - 1 : k + 2])
        a, b, _ = np.polyfit(x - x[1], y, 2)
        if a >= 0:
            return float(self.frequency[k]), float(self.size[k])
        at = float(np.clip(-b / (2 * a), x[0] - x[1], x[2] - x[1]))
        top = y[1] + b * at + a * at * at
        return float(np.exp(x[1] + at)), float(np.exp(top))

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "peak": self.peak,
            "peak_frequency": self.peak_frequency,
            "frequency": [float(f) for f in self.frequency],
            "size": [float(v) for v in self.size],
            "response": None if self.response is None else [float(v) for v in self.response],
        }

    @classmethod
    def of(cls, frequency: FloatArray, value: ComplexArray) -> "Sensitivity":
        """Return that of complex values, in the order of frequencies.

        Parameters
        ----------
        frequency
            Hz, shape (L,).
        value
            1 / (1 + L), shape (L,).
        """
        order = np.argsort(frequency)
        return cls(frequency[order], np.abs(value)[order], np.abs(1 - value)[order])


@dataclass(frozen=True)
class Excited:
    """One axis' signals over whole periods, (n,) each, and the lines that only it excites."""

    lines: NDArray[np.int64]
    """Periods in a period, shape (L,)."""
    samples: int
    """Rows of a period."""
    step: float
    """s from row to row."""
    position: FloatArray
    torque: FloatArray
    offset: FloatArray | None
    """Torque offset as sent; None where the position reference excites the lines."""
    lag: float | None = None
    """s, by which the torque is behind the cycle at which an offset takes effect and it is sampled;
    None where the torque is the mean one already, not sampled."""


def measured_sensitivity(signals: Excited, servo: Servo) -> Sensitivity:
    """Return an axis' sensitivity from what a multisine did.

    Parameters
    ----------
    signals
        Whole periods; the last ones of a record.
    servo
        The controller that was in the drive; only its filters matter where an offset excited.
    """
    frequency = signals.lines / (signals.samples * signals.step)
    s = 2j * np.pi * frequency
    torque = _phasors(signals.torque, signals)
    if signals.offset is not None:
        offset = _phasors(signals.offset, signals)
        if signals.lag is not None:
            torque = torque + _folded(offset, frequency, signals.step, signals.lag, servo)
        held = offset * np.sinc(frequency * signals.step)
        held *= np.exp(-s * (signals.step / 2 + (signals.lag or 0.0)))
        value = torque / (held * servo.loop.filtered(s))
    else:
        plant = _phasors(signals.position, signals) / torque
        value = 1 / (1 + servo.gain(s) * plant)
    return Sensitivity.of(frequency, value)


def _folded(
    offset: ComplexArray, frequency: FloatArray, step: float, lag: float, servo: Servo
) -> ComplexArray:
    """Return what sampled torques lack, (L,): the offset's first images pass filters of their own."""
    images = [servo.loop.filtered(2j * np.pi * (frequency + k / step)) for k in (-1, 1)]
    held = held_offset(frequency, offset[:, None], step, step - min(lag, step))[:, 0]
    return np.asarray(held * np.mean(images, axis=0), dtype=np.complex128)


def _phasors(values: FloatArray, signals: Excited) -> ComplexArray:
    whole = values[values.size % signals.samples :]
    mean = whole.reshape(-1, signals.samples).mean(axis=0)
    return np.asarray(np.fft.rfft(mean)[signals.lines], dtype=np.complex128)


def measured_move(
    time: FloatArray, target: FloatArray, position: FloatArray, band: float, watched: float = inf
) -> tuple[MoveFigures, MoveFigures]:
    """Return the figures of a move out and of that back.

    Parameters
    ----------
    time, target, position
        Of the axis, shape (n,); the record begins at rest before the move out, holds still between
        the two, and ends at rest.  A target that is sent with one sample is reached at the next one.
    band, watched
        As :func:`fieldtool.design.figures.move_figures` wants them.

    Raises
    ------
    ValueError
        If the record does not hold two moves.
    """
    reference = np.concatenate([target[:1], target[:-1]])
    far = np.abs(reference - reference[0])
    there = np.flatnonzero(far >= far.max() * (1 - 1e-9))
    if far.max() == 0 or there.size == 0:
        raise ValueError("the record holds no move")
    back = int(there[-1])  # the last sample before it comes back
    out = slice(0, back + 1)
    home = slice(back, reference.size)
    return (
        move_figures(time[out], reference[out], position[out], band, watched),
        move_figures(time[home] - time[back], reference[home], position[home], band, watched),
    )


@dataclass(frozen=True)
class AxisFigures:
    """What is compared of one axis: before, predicted, after; SI.  None: not measured or predicted."""

    settling_time: float
    """s; the slower one of the moves out and back."""
    positioning_time: float
    """s."""
    overshoot: float
    following_error: float
    vibration: float
    """Largest deviation of the oscillating part after the move."""
    peak_torque: float
    sensitivity_peak: float | None
    sensitivity_frequency: float | None
    """Hz."""
    settling_latest: float | None = None
    """s, of a prediction: settling time in a narrower band, from which it counts as touching the edge.
    None: measured, or not known."""

    def as_dict(self) -> dict[str, float | None]:
        """Plain values; what is infinite is null."""
        plain: dict[str, float | None] = finite(asdict(self))
        return plain


def axis_figures(
    moves: Sequence[MoveFigures],
    peak_torque: float,
    sensitivity: Sensitivity | None,
    settling_latest: float | None = None,
) -> AxisFigures:
    """Return the figures of an axis from its moves, of each the worst, and its sensitivity."""
    return AxisFigures(
        max(move.settling_time for move in moves),
        max(move.positioning_time for move in moves),
        max(move.overshoot for move in moves),
        max(move.following_error for move in moves),
        max(move.residual_peak for move in moves),
        peak_torque,
        sensitivity.peak if sensitivity else None,
        sensitivity.peak_frequency if sensitivity else None,
        settling_latest,
    )
