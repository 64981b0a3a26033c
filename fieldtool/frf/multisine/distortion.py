"""What multi-axis multisines show between their lines: odd and even distortion of every axis.

At a line inside the band that no reference excites, a straight machine's torques are what its
positions there ask for, whatever the loops make of them.  So what is left,

    G^-1 position - torque,    G interpolated between the excited lines,

is noise and distortion, as a torque at the motor whose axis causes it (in the positions it would
show on all axes that are coupled to it).  Odd lines show friction, saturation and hardening, even
ones what differs between the directions.  A share that falls as the amplitude grows is friction or
backlash, one that rises is a spring that is not straight.

Source: Pintelon and Schoukens, System Identification: A Frequency Domain Approach, chapter 4.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.multisine.lines import LinePhasors, same_level
from fieldtool.frf.multisine.single_axis import between_lines
from fieldtool.frf.response import FrequencyResponse

NOTE_SHARE = 0.1
"""Distortion over torque from which it is said."""
ERROR_SHARE = 0.3
"""Distortion over torque from which the data are refused."""
_FEWEST_LINES = 3
_OUT_OF_NOISE = 1.3
"""Mean square over what noise explains; the estimate of the noise has an error of its own."""
_SIGMAS = 6.0
"""Standard errors of a mean square above that, from which it counts as distortion."""
_CHANGE = 1.5
"""Ratio of shares at two levels that is called a change."""


@dataclass(frozen=True)
class AxisDistortion:
    """Root mean squares of one axis' torque at one amplitude level, N m, N or A (peak) a line."""

    axis: str
    level: float
    """Amplitude of the references relative to the strongest experiments."""
    excited: float
    """Torque at the excited lines."""
    odd: float
    """Unexplained at odd detection lines, noise included; NaN where there are too few."""
    even: float
    """Unexplained at even lines; NaN where there are too few."""
    odd_noise: float
    """What noise alone explains of ``odd``."""
    even_noise: float
    odd_lines: int
    """Number of odd detection lines in all experiments of the level."""
    even_lines: int
    trend: str
    """``falls with amplitude``, ``rises with amplitude``, ``does not depend on amplitude``, or empty
    where there is one level only, or no distortion."""

    @property
    def odd_share(self) -> float:
        """Odd distortion without noise over the torque; 0 where noise explains it all."""
        return _share(self.odd, self.odd_noise, self.excited, self.odd_lines)

    @property
    def even_share(self) -> float:
        """Even distortion without noise over the torque; 0 where noise explains it all."""
        return _share(self.even, self.even_noise, self.excited, self.even_lines)

    @property
    def worth_saying(self) -> bool:
        """Whether it stands out of the noise and is above 10 %, or its size tells its kind."""
        largest = max(self.odd_share, self.even_share)
        return largest > NOTE_SHARE or (largest > 0.003 and bool(self.trend))

    @property
    def sentence(self) -> str:
        """For a technician: levels in dB of the torque, and what they look like."""
        parts = []
        for name, share in (("odd", self.odd_share), ("even", self.even_share)):
            if share > 0:
                parts.append(f"{name} distortion {20 * np.log10(share):.0f} dB of its torque")
        if not parts:
            return f"{self.axis}: no distortion above the noise at level {self.level:.2g}."
        return f"{self.axis}: {', '.join(parts)} at level {self.level:.2g}, {self._kind()}."

    def _kind(self) -> str:
        kind = {
            "falls with amplitude": "friction-like or backlash-like (falls with amplitude)",
            "rises with amplitude": "like a hardening spring or saturation (rises with amplitude)",
            "does not depend on amplitude": "of a kind that does not depend on amplitude",
        }.get(self.trend)
        if kind is None:
            kind = "likely friction or backlash" if self.odd_share > 0 else "of unknown kind"
        if self.even_share > self.odd_share:
            kind += ", different in the two directions"
        return kind


def joint_distortion(
    measured: Sequence[LinePhasors], response: FrequencyResponse
) -> tuple[AxisDistortion, ...]:
    """Return the distortion of every axis at every amplitude level, strongest level first.

    Parameters
    ----------
    measured
        Experiments at all lines.
    response
        The response matrix they gave, for what the measured torques explain.
    """
    levels: list[list[LinePhasors]] = []
    for one in sorted(measured, key=lambda one: -one.level):
        if levels and same_level(levels[-1][0].level, one.level):
            levels[-1].append(one)
        else:
            levels.append([one])
    found = [_of_level(members, response) for members in levels]
    result = []
    for axis in range(len(response.axes)):
        values = [one[axis] for one in found if one]
        result += [_with_trend(value, values) for value in values]
    return tuple(result)


def check_distortion(distortion: Sequence[AxisDistortion]) -> None:
    """Refuse data whose distortion is above 30 % of the response at every level.

    Raises
    ------
    NotEnoughDataError
        With axis, odd or even, and level.
    """
    best: dict[str, AxisDistortion] = {}
    for one in distortion:
        largest = max(one.odd_share, one.even_share)
        kept = best.get(one.axis)
        if kept is None or largest < max(kept.odd_share, kept.even_share):
            best[one.axis] = one
    for one in sorted(best.values(), key=lambda one: -max(one.odd_share, one.even_share)):
        share, parity = max((one.odd_share, "odd"), (one.even_share, "even"))
        if share > ERROR_SHARE:
            raise NotEnoughDataError(
                f"axis {one.axis} is strongly non-linear: {parity} distortion of "
                f"{20 * np.log10(share):.0f} dB of its torque (limit "
                f"{20 * np.log10(ERROR_SHARE):.0f} dB): friction, backlash, or an encoder whose "
                "counts are coarse for so small a motion; measure with a larger amplitude (wider "
                "limits) or on top of a constant velocity, and check the axis for play."
            )


def _of_level(members: Sequence[LinePhasors], response: FrequencyResponse) -> list[AxisDistortion]:
    """Return one value an axis (without trend); empty if nothing lies between the lines."""
    M = len(response.axes)
    inner = response.frequencies
    whole = np.all(response.measured.reshape(inner.size, -1), axis=1)
    if np.count_nonzero(whole) < 4:
        return []
    excited, unexplained, noise, odd = [], [], [], []
    for one in members:
        lines = one.given.lines
        band = (one.frequencies >= inner[whole][0]) & (one.frequencies <= inner[whole][-1])
        between = np.setdiff1d(np.flatnonzero(band), lines - 1)
        G = between_lines(inner[whole], response.response[whole], one.frequencies[between])
        mean = one.mean[between]
        mixing = np.concatenate([np.linalg.inv(G), -np.broadcast_to(np.eye(M), G.shape)], axis=2)
        unexplained.append(np.einsum("fij,fj->fi", mixing, mean))
        error = np.einsum("fia,fab,fib->fi", mixing, one.covariance[between], mixing.conj())
        noise.append(np.maximum(error.real, 0.0))
        odd.append((between + 1) % 2 == 1)
        excited.append(one.mean[lines - 1, M:])
    left, power = np.abs(np.concatenate(unexplained)) ** 2, np.concatenate(noise)
    odd_lines = np.concatenate(odd)
    size = np.sqrt(np.mean(np.abs(np.concatenate(excited)) ** 2, axis=0))
    level = float(np.mean([one.level for one in members]))
    return [
        AxisDistortion(
            axis=name,
            level=level,
            excited=float(size[axis]),
            odd=_rms(left[odd_lines, axis]),
            even=_rms(left[~odd_lines, axis]),
            odd_noise=_rms(power[odd_lines, axis]),
            even_noise=_rms(power[~odd_lines, axis]),
            odd_lines=int(np.count_nonzero(odd_lines)),
            even_lines=int(np.count_nonzero(~odd_lines)),
            trend="",
        )
        for axis, name in enumerate(response.axes)
    ]


def _with_trend(one: AxisDistortion, levels: Sequence[AxisDistortion]) -> AxisDistortion:
    """Say how the larger kind of distortion goes with amplitude, from strongest to weakest level."""
    strong, weak = levels[0], levels[-1]
    name = "odd_share" if strong.odd_share + weak.odd_share >= strong.even_share else "even_share"
    high, low = getattr(strong, name), getattr(weak, name)
    if len(levels) < 2 or max(high, low) == 0:
        return one
    if low > _CHANGE * high:
        trend = "falls with amplitude"
    elif high > _CHANGE * low:
        trend = "rises with amplitude"
    else:
        trend = "does not depend on amplitude"
    return AxisDistortion(**{**vars(one), "trend": trend})


def _share(total: float, noise: float, excited: float, lines: int) -> float:
    """Part of ``total`` beyond noise over ``excited``; 0 if noise on so few lines explains it."""
    if lines < _FEWEST_LINES or excited == 0:
        return 0.0
    if not total**2 > (_OUT_OF_NOISE + _SIGMAS / np.sqrt(lines)) * noise**2:
        return 0.0
    return float(np.sqrt(total**2 - noise**2) / excited)


def _rms(power: np.typing.NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(power))) if power.size >= _FEWEST_LINES else float("nan")
