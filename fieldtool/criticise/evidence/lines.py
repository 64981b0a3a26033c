"""Errors of the torque as weighted lines of their spectrum, and back as courses in time.

An error e (n, M) in the rows of one span becomes E(f) / sqrt(S(f)) at the lines of the band, S its
noise; what is not known beforehand of each span (the hidden masses' first position and velocity)
is projected out.  Measured and modelled torque thus pass the same filter.
S comes from the lines between the harmonics and from the top of the band where the excitation is
periodic, and from a white level and the noise of the position where it is not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.signal import butter, sosfilt_zi
from scipy.signal.windows import tukey

from fieldtool.criticise.evidence.spans import Span
from fieldtool.criticise.simulate.inverse import dynamic_stiffness
from fieldtool.criticise.simulate.kernels import both_ways
from fieldtool.criticise.simulate.motion import Motion
from fieldtool.criticise.simulate.structure import Structure
from fieldtool.frf.velocity_band import white_noise

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
ORDER, CORNER = 4, 1.3
"""Of the low-pass, its corner over the top of the band."""
TAPER = 0.1
"""Share of a span in which both its ends fade, where it is not periodic."""
SMALL = 1e-4
"""Of the torque at a line and around it: nothing smaller is believed (what happens between samples)."""
UPPER = 0.4
"""Share of the band, at its top, from whose lines noise is taken that repeats with the period."""
MOST_REPEATED = 4.0
"""Power of noise that repeats over that of noise that does not: what is more is no noise."""
AROUND = 12
"""Lines to either side over which noise is averaged."""
PART = 0.2
"""Of the noise that comes from the position, from which a line has to stand out of it."""
STANDS_OUT = 30.0
"""Power of the torque over the noise at such a line."""
NO_NOISE = 4.0
"""Power over that of the quietest experiment, of torques as large, from which it is no noise."""
LEAST_ROWS = 0.02
"""Share of rows that count, below which an axis is left out of a span."""
DEPENDENT = 1e-8
"""Of the largest: columns that add less than this to the others are left out."""


@dataclass(frozen=True, eq=False)
class Lines:
    """How errors in the rows of one span become numbers of variance one."""

    span: Span
    motion: Motion
    window: FloatArray
    """(n, M): taper times the rows that count."""
    weight: FloatArray
    """1 / sqrt(S), (L, M)."""
    filter: FloatArray
    """Sections of the low-pass that both torques pass, forward and backward."""
    noise: FloatArray
    """S, (L, M)."""
    free: FloatArray
    """Orthonormal columns that are projected out, (2 L M, F)."""
    unknown: tuple[FloatArray, ...] = ()
    """Their courses, (n, M) each."""

    @cached_property
    def at_rest(self) -> FloatArray:
        """States of the low-pass for a constant 1, (sections, 2)."""
        return np.asarray(sosfilt_zi(self.filter))

    def raw(self, error: FloatArray) -> ComplexArray:
        """Return the spectrum of an error of the whole experiment (n, M) at the lines, (L, M).

        What is above the band is taken out before rows are left out, or these would fold it into it.
        """
        filtered = both_ways(self.filter, self.at_rest, np.ascontiguousarray(error))
        rows = filtered[self.span.start : self.span.stop]
        spectrum = np.fft.rfft(rows * self.window, axis=0) / rows.shape[0]
        return np.asarray(spectrum[: self.weight.shape[0]])

    def weighted(self, error: FloatArray) -> FloatArray:
        """Return the weighted lines of an error, real and imaginary parts, (2 L M,)."""
        return flat(self.raw(error) * self.weight)

    def projected(self, values: FloatArray) -> FloatArray:
        """Take out of (2 L M, ...) what is not known beforehand."""
        return values - self.free @ (self.free.T @ values)

    def less_unknown(self, error: FloatArray) -> FloatArray:
        """Return the rows of this span of an error (n, M), without what is not known beforehand."""
        rows = slice(self.span.start, self.span.stop)
        left = error[rows].copy()
        if self.unknown:
            columns = np.column_stack([self.weighted(c) for c in self.unknown])
            solved = np.linalg.lstsq(columns, self.weighted(error), rcond=1e-8)[0]
            for size, course in zip(solved, self.unknown, strict=True):
                left -= size * course[rows]
        return left

    def in_time(self, values: FloatArray) -> FloatArray:
        """Return weighted lines (2 L M,) as courses in time, (N, M), with the same sum of squares."""
        lines = unflat(values, self.weight.shape[1])
        spectrum = np.zeros((lines.shape[0] + 1, lines.shape[1]), dtype=complex)
        spectrum[:-1] = lines
        course = np.fft.irfft(spectrum, axis=0)
        return np.asarray(course * np.sqrt(course.shape[0] / 2.0), dtype=np.float64)


def flat(lines: ComplexArray) -> FloatArray:
    """(L, M) complex as (2 L M,) real."""
    return np.concatenate([lines.real.ravel(), lines.imag.ravel()])


def unflat(values: FloatArray, axes: int) -> ComplexArray:
    """Inverse of :func:`flat`."""
    half = values.size // 2
    return np.asarray((values[:half] + 1j * values[half:]).reshape(-1, axes))


def lines_of(
    span: Span,
    motion: Motion,
    error: FloatArray,
    top: float,
    structure: Structure,
    unknown: Sequence[FloatArray],
    named: Sequence[FloatArray] = (),
) -> Lines:
    """Find noise and weights of one span.

    Parameters
    ----------
    span, motion
    error : ndarray
        Torque measured less simulated, (n, M), of the whole experiment.
    top : float
        Hz.
    structure : Structure
        Says what noise of the position does to the torque.
    unknown : sequence of ndarray
        Courses (n, M) of what is not known beforehand.
    named : sequence of ndarray
        Courses of what an effect is the cause of, and therefore no noise.
    """
    n, M = span.stop - span.start, motion.position.shape[1]
    taper = np.ones(n) if span.periods else tukey(n, TAPER)
    window = taper[:, None] * motion.counted[span.start : span.stop]
    count = max(8, int(top * n * motion.step))
    ones = np.ones((count, M))
    low_pass = butter(ORDER, min(CORNER * top * 2 * motion.step, 0.9), output="sos")
    shape = Lines(span, motion, window, ones, low_pass, ones, np.zeros((2 * count * M, 0)))
    lines = _less(shape, error, (*unknown, *named))
    frequency = np.arange(count) / (n * motion.step)
    white = white_noise(motion.position[span.start : span.stop])
    share = np.mean(window**2, axis=0)
    stiff = np.abs(dynamic_stiffness(structure, 2 * np.pi * frequency)) ** 2
    moved = stiff @ white**2 * share / n
    if span.periods > 1:
        noise = _between_harmonics(lines, span.periods)
        most = MOST_REPEATED * np.median(noise, axis=0)
        noise = np.maximum(noise, np.minimum(_repeated(lines, moved, span.periods), most))
    else:
        noise = _level(lines)
    torque = np.abs(shape.raw(motion.torque)) ** 2
    floor = SMALL**2 * _averaged(torque, AROUND) + 1e-20 * torque.max(axis=0)
    noise = np.maximum(noise, 0.25 * moved) + floor + np.finfo(float).tiny ** 0.5
    # Where the motion is little but noise, a model that asks for less torque would seem the better one.
    drowned = (moved > PART * noise) & (torque < STANDS_OUT * noise)
    still = share < LEAST_ROWS
    counted = np.where(still | drowned, 0.0, 1.0)
    return _weighed(replace(shape, weight=counted, unknown=tuple(unknown)), noise)


def _weighed(lines: Lines, noise: FloatArray) -> Lines:
    """Return the same with another noise; lines of no weight keep none."""
    weight = np.where(lines.weight > 0.0, 1.0 / np.sqrt(noise), 0.0)
    stacked = np.zeros((2 * weight.size, 0))
    if lines.unknown:
        stacked = np.column_stack([flat(lines.raw(c) * weight) for c in lines.unknown])
    return replace(lines, weight=weight, noise=noise, free=_orthonormal(stacked))


def with_shared_noise(all_lines: Sequence[Lines]) -> list[Lines]:
    """Take for noise no more than the quietest of like experiments lets expect, larger torques granted.

    Where something changes while an experiment is measured, its periods differ, and not by noise.
    """
    periodic = [lines for lines in all_lines if lines.span.periods > 1]
    rows = {id(a): a.span.stop - a.span.start for a in periodic}
    powers = {id(a): np.sum(np.abs(a.raw(a.motion.torque)) ** 2, axis=0) for a in periodic}
    out = []
    for a in all_lines:
        if id(a) not in powers:
            out.append(a)
            continue
        own = np.arange(a.noise.shape[0]) / rows[id(a)]
        noise = a.noise.copy()
        for b in periodic:
            theirs = np.arange(b.noise.shape[0]) / rows[id(b)]
            for k in range(noise.shape[1]):
                granted = NO_NOISE * max(1.0, powers[id(a)][k] / max(powers[id(b)][k], 1e-300))
                level = np.interp(own, theirs, b.noise[:, k]) * rows[id(b)] / rows[id(a)]
                if np.any(b.weight[:, k] > 0.0):
                    noise[:, k] = np.minimum(noise[:, k], granted * level)
        out.append(a if np.array_equal(noise, a.noise) else _weighed(a, noise))
    return out


def _less(shape: Lines, error: FloatArray, unknown: Sequence[FloatArray]) -> ComplexArray:
    """Lines of an error less what is not known beforehand, all lines counted alike."""
    lines = shape.raw(error)
    if not unknown:
        return lines
    free = _orthonormal(np.column_stack([flat(shape.raw(c)) for c in unknown]))
    values = flat(lines)
    return unflat(values - free @ (free.T @ values), lines.shape[1])


def _orthonormal(columns: FloatArray) -> FloatArray:
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0] / size[size > 0]
    if not columns.shape[1]:
        return columns
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(u[:, s > DEPENDENT * s[0]])


def _between_harmonics(lines: ComplexArray, periods: int) -> FloatArray:
    """Noise at each line from those around it that are no multiples of the period's, (L, M)."""
    numbers = np.arange(lines.shape[0])
    between = numbers[numbers % periods != 0]
    power = np.abs(lines[between]) ** 2
    level = median_filter(power, size=(2 * AROUND + 1, 1), mode="nearest") / np.log(2.0)
    near = np.clip(np.searchsorted(between, numbers), 0, between.size - 1)
    return np.asarray(level[near])


def _repeated(lines: ComplexArray, moved: FloatArray, periods: int) -> FloatArray:
    """Noise that repeats with the period (rounding of signals that repeat), (M,).

    It shows at the harmonics in the upper part of the band, where little is excited.
    """
    numbers = np.arange(lines.shape[0])
    upper = (numbers >= lines.shape[0] * (1.0 - UPPER)) & (numbers % periods == 0)
    power = np.maximum(np.abs(lines[upper]) ** 2 - moved[upper], 0.0)
    return np.asarray(np.median(power, axis=0) / np.log(2.0))


def _level(lines: ComplexArray) -> FloatArray:
    """One level for all lines, from the power that the error has in the band, (L, M)."""
    power = np.abs(lines) ** 2
    return np.broadcast_to(power.mean(axis=0), power.shape).copy()


def _averaged(power: FloatArray, reach: int) -> FloatArray:
    kernel = np.ones(2 * reach + 1) / (2 * reach + 1)
    padded = np.pad(power, [(reach, reach), (0, 0)], mode="edge")
    return np.column_stack([np.convolve(c, kernel, mode="valid") for c in padded.T])
