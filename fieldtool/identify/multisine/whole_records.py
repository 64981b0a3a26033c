"""Whole records of multisines made ready for the fit that holds the machine's own free motion.

What the equation error's noise is, the bins between the lines of the periods tell: what repeats is
not there, and transients are explained by the machine.  Its shape over frequency is that of white noise
of each position and each torque, as strong as explains these errors best; errors whitened with that are
averaged over neighbouring bins, which makes up for noise that is not white.

How far the states at both ends of a stretch may differ, the records tell too: by a share of the motion
that is most likely (none where the machine had settled), the same in all experiments of one design.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from fieldtool.frf.held_targets import Fold, folds
from fieldtool.frf.multisine.lines import LinePhasors, same_level
from fieldtool.frf.multisine.transient import windows
from fieldtool.frf.phasors import equation_errors
from fieldtool.identify.likelihood.record_data import RecordData, TorquePart
from fieldtool.identify.likelihood.record_spectrum import Spectrum, amplitudes, spectrum_of
from fieldtool.identify.likelihood.record_system import RecordSystem
from fieldtool.identify.likelihood.refine import RefinedModel, machine_response
from fieldtool.identify.likelihood.whitening import whitening
from fieldtool.identify.multisine.dry_friction import SEEN, DryFriction
from fieldtool.identify.multisine.records import settled
from fieldtool.identify.multisine.sliding import Sliding, directions
from fieldtool.records.recording import Recording

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
FREEDOM_AN_AXIS = 60.0
"""Degrees of freedom of the noise's estimate, for each axis."""
FEWEST_AN_AXIS = 4.0
"""Below so many the noise keeps its shape and gets one factor."""
SHAPINGS = 12
"""Of finding the strengths of white noise, each weighted with those before."""
SHARES = np.concatenate([[0.0], np.geomspace(1e-6, 1.0, 61)])
"""Of the motion, that states may differ by from end to end; from the last one on they are free."""
SLOWEST = 0.5
"""Of the lowest excited line: slower motion says nothing of the machine, and much of what drifts."""
SAME_NOISE = 2.0
"""Experiments whose noise powers differ by less share one estimate."""
MOST_NUMBERS = 100_000
"""Measured numbers above which records are too long: many periods leave little of transients."""


@dataclass(frozen=True, eq=False)
class WholeRecords:
    """Multisine experiments whose spectra can be taken over any stretch."""

    recording: Recording
    lines: tuple[LinePhasors, ...]
    """Of each experiment used."""
    friction: FloatArray
    """(M,), N m or N: dry friction that is taken off the torques."""
    sizes: tuple[float, ...] | None = None
    """Of the folds, as far as they are known by now; None: as they are expected."""

    @classmethod
    def of(
        cls, recording: Recording, lines: Sequence[LinePhasors], friction: DryFriction
    ) -> "WholeRecords":
        """Take off the dry friction that is seen."""
        return cls(recording, tuple(lines), friction.sizes(SEEN))

    @property
    def folds(self) -> tuple[tuple[Fold, float], ...]:
        """What sampled torques show besides what acts, and of what size: it is taken off."""
        found = folds(self.recording)
        sizes = tuple(one.size for one in found) if self.sizes is None else self.sizes
        return tuple(zip(found, sizes, strict=True))

    @property
    def too_long(self) -> bool:
        """Whether there are too many bins for a fit."""
        axes = len(self.recording.axes)
        bins = sum(float(one.frequencies[-1]) * one.given.experiment.samples for one in self.lines)
        return 2 * axes * bins * self.recording.sample_period > MOST_NUMBERS

    def data(self, found: RefinedModel, *, run_in: bool) -> RecordData:
        """Return spectra of periods, with the run-in before them or without, and their noise.

        Parameters
        ----------
        found
            The best machine so far: it tells what noise is.
        run_in
            Whether what comes before the whole periods is in.
        """
        between = [self._spectrum(one, found, run_in=False, beyond=True) for one in self.lines]
        wide = [self._spectrum(one, found, run_in=run_in, beyond=False) for one in self.lines]
        rough = tuple(self._rough(*each, found) for each in zip(self.lines, between, strict=True))
        told = RecordData(self.recording.names, tuple(between), rough)
        seen = told.systems(found.model, found.delay_values)
        covariance: dict[int, ComplexArray] = {}
        groups = self._groups(seen)
        for group in groups:
            noise = _Noise.of([(self.lines[k], seen[k]) for k in group], found)
            for k in group:
                shape = self._rough(self.lines[k], wide[k], found)
                covariance[k] = noise.coloured(wide[k], shape, found)
        errors = tuple(covariance[k] for k in range(len(wide)))
        data = RecordData(self.recording.names, tuple(wide), errors, self._parts(run_in))
        return replace(data, spread=_spread(data.systems(found.model, found.delay_values), groups))

    def _spectrum(
        self, one: LinePhasors, found: RefinedModel, *, run_in: bool, beyond: bool
    ) -> Spectrum:
        """Spectrum up to the highest line, or as far beyond it as the noise is wanted."""
        experiment, step = one.given.experiment, self.recording.sample_period
        torque = experiment.torque.copy()
        for fold, size in self.folds:
            torque[:, fold.axis] -= fold.course(self._reference(one, fold.axis), size)
        if np.any(self.friction):
            torque -= self._rubbing(one, found)
        M = len(self.recording.axes)
        signals, bins = self._cut(one, np.hstack([experiment.position, torque]), run_in, beyond)
        return spectrum_of(signals[:, :M], signals[:, M:], step, bins)

    def _rubbing(self, one: LinePhasors, found: RefinedModel) -> FloatArray:
        """Dry friction in every row, (n, M): of motors that stand, as in the last whole period."""
        experiment, step = one.given.experiment, self.recording.sample_period
        highest, delays = float(one.frequencies[-1]), found.delay_values
        sliding = Sliding.of(settled(experiment, step), step, highest, delays)
        standing = sliding.standing(found.model, delays, self.friction)
        way = directions(experiment, step, highest, delays)
        period = np.arange(-experiment.samples, 0) % standing.shape[0]
        return way * self.friction + np.where(way == 0, standing[period], 0.0)

    @staticmethod
    def _reference(one: LinePhasors, axis: int) -> FloatArray:
        """Position reference of an axis, (n,); zeros where there is none."""
        experiment = one.given.experiment
        if experiment.position_reference is None:
            return np.zeros(experiment.samples)
        reference = experiment.position_reference[:, axis]
        return np.zeros(experiment.samples) if np.any(np.isnan(reference)) else reference

    def _parts(self, run_in: bool) -> tuple[TorquePart, ...]:
        """What is not known of the sizes of the folds that show."""
        parts = []
        for fold, size in self.folds:
            spectra = []
            for one in self.lines:
                course = fold.slope(self._reference(one, fold.axis), size)
                rows, bins = self._cut(one, course[:, None], run_in, beyond=False)
                spectra.append(amplitudes(rows, self.recording.sample_period, bins)[:, 0])
            parts.append(TorquePart(fold.axis, fold.std, tuple(spectra), size - fold.size))
        return tuple(parts)

    def sized(self, data: RecordData, found: RefinedModel) -> "WholeRecords":
        """Return the same with sizes of the folds as the fit to these data found them."""
        more = data.part_sizes(found.model, found.delay_values)
        sizes = [size + more for (_, size), more in zip(self.folds, more.tolist(), strict=True)]
        return replace(self, sizes=tuple(sizes))

    def _cut(
        self, one: LinePhasors, signals: FloatArray, run_in: bool, beyond: bool
    ) -> tuple[FloatArray, NDArray[np.intp]]:
        """Rows of a stretch, both ends among them, and the bins in question."""
        rows, period = one.given.rows, one.given.samples
        first = 0 if run_in else max(rows.start - 1, 0)
        cut = signals[first : rows.stop]
        if rows.start == 0:
            cut = _with_next(cut, period)
        count = cut.shape[0] - 1
        last = one.given.lines[-1]
        highest = last + max(10, last // 3) if beyond else last
        lowest = 0.0 if beyond else SLOWEST * float(one.given.lines[0])
        top = min(int(highest * count / period + 1e-6), count // 2 - 1)
        return cut, np.arange(max(1, int(lowest * count / period)), top + 1)

    def _rough(self, one: LinePhasors, at: Spectrum, found: RefinedModel) -> ComplexArray:
        """Covariance of the equation error as the phasors' noise says."""
        place = at.omega / (2 * np.pi)
        above = np.clip(np.searchsorted(one.frequencies, place), 1, one.frequencies.size - 1)
        below, step = above - 1, one.frequencies[1] - one.frequencies[0]
        share = np.clip((place - one.frequencies[below]) / step, 0.0, 1.0)[:, None, None]
        noise = (1 - share) * one.covariance[below] + share * one.covariance[above]
        periods = one.given.periods * one.given.samples * self.recording.sample_period
        response = machine_response(found.model, at.omega, found.delay_values)
        errors: ComplexArray = equation_errors(response, noise) * (periods / at.duration)
        return errors

    def _groups(self, seen: Sequence[RecordSystem]) -> list[list[int]]:
        """Experiments whose noise is alike."""
        power = [np.mean(np.abs(one.white) ** 2, axis=0) for one in seen]
        groups: list[list[int]] = []
        for k, one in enumerate(self.lines):
            for group in groups:
                first = self.lines[group[0]]
                ratio = power[k] / power[group[0]]
                alike = (ratio < SAME_NOISE) & (ratio > 1 / SAME_NOISE)
                if (
                    _design(one) == _design(first)
                    and same_level(one.level, first.level)
                    and np.all(alike)
                ):
                    group.append(k)
                    break
            else:
                groups.append([k])
        return groups


@dataclass(frozen=True, eq=False)
class _Noise:
    """What errors between the lines show: white noise, and where it is not white."""

    omega: FloatArray
    """(B,), rad/s, of the bins between the lines."""
    products: ComplexArray
    """(B + 1, M, M): sums of e e^H over all bins before, whitened with the shape."""
    counts: FloatArray
    """(B + 1,): sums of their degrees of freedom."""
    strength: FloatArray | None
    """(2 M,): E|n|^2 of torques, then positions, times s; None where too few bins tell it."""

    @classmethod
    def of(
        cls, seen: "Sequence[tuple[LinePhasors, RecordSystem]]", found: RefinedModel
    ) -> "_Noise":
        """From experiments of one design."""
        periods, one = seen[0][0].given.periods, seen[0][1].one
        between = (np.arange(one.omega.size) + 1) % periods != 0
        omega = one.omega[between]
        white = np.array([system.white[between] for _, system in seen])
        freedom = np.sum([system.freedom[between] for _, system in seen], axis=0)
        strength = None
        if freedom.sum() >= FEWEST_AN_AXIS * 2 * white.shape[2]:
            back = np.array([np.linalg.inv(system.whiten[between]) for _, system in seen])
            errors = np.einsum("ebij,ebj->ebi", back, white)
            shapes = _white_shapes(found, omega)
            strength = _strengths(errors, freedom, shapes) * one.duration
            turn = whitening(_mixed(shapes, strength / one.duration))
            white = np.einsum("bij,ebj->ebi", turn, errors)
        products = np.einsum("ebi,ebj->bij", white, white.conj()) / 2.0
        zero = np.zeros((1, *products.shape[1:]))
        return cls(
            omega,
            np.concatenate([zero, np.cumsum(products, axis=0)]),
            np.concatenate([[0.0], np.cumsum(freedom)]),
            strength,
        )

    def coloured(self, at: Spectrum, rough: ComplexArray, found: RefinedModel) -> ComplexArray:
        """Return covariances (F, M, M) of a stretch; `rough` is the shape where none was found.

        The inverse of a covariance estimated with D degrees of freedom is D / (D - M) too large on
        average, which is put right.
        """
        if self.strength is not None:
            rough = _mixed(_white_shapes(found, at.omega), self.strength / at.duration)
        M = rough.shape[1]
        low, high = windows(self.omega, self.counts, at.omega, FREEDOM_AN_AXIS * M)
        freedom = self.counts[high] - self.counts[low]
        total = self.products[high] - self.products[low]
        if freedom.min() < FEWEST_AN_AXIS * M:
            factor = np.trace(total, axis1=1, axis2=2).real / M
            total = factor[:, None, None] * np.eye(M)
            mean = total / np.maximum(freedom, 1e-9)[:, None, None]
        else:
            mean = total / (freedom - M)[:, None, None]
        back = np.linalg.inv(whitening(rough)) * np.sqrt(2.0)
        covariance: ComplexArray = back @ mean @ back.conj().transpose(0, 2, 1)
        return (covariance + covariance.conj().transpose(0, 2, 1)) / 2


def _design(one: LinePhasors) -> tuple[int, int, int]:
    """Samples of a period, periods, and the highest line: what makes bins the same ones."""
    return one.given.samples, one.given.periods, int(one.given.lines[-1])


def _white_shapes(found: RefinedModel, omega: FloatArray) -> ComplexArray:
    """Columns of what noise of each torque, then of each position, leaves in the error, (F, M, 2 M)."""
    response = machine_response(found.model, omega, found.delay_values)
    unit = np.broadcast_to(np.eye(response.shape[1]), response.shape)
    return np.concatenate([response, unit], axis=2)


def _mixed(shapes: ComplexArray, strength: FloatArray) -> ComplexArray:
    mixed: ComplexArray = (shapes * strength) @ shapes.conj().transpose(0, 2, 1)
    return mixed


def _strengths(errors: ComplexArray, freedom: FloatArray, shapes: ComplexArray) -> FloatArray:
    """Most likely E|n|^2 of the noises (2 M,) behind errors (E, B, M): Fisher's scoring.

    Not less than its own standard error, so that no noise is taken for none.
    """
    power = np.einsum("ebi,ebj->bij", errors, errors.conj())
    mean = np.einsum("bii->i", power).real / freedom.sum()
    gain = np.mean(np.abs(shapes) ** 2, axis=0)  # (M, 2 M): each alone could explain everything
    strength: FloatArray = np.min(mean[:, None] / np.maximum(gain, 1e-300), axis=0)
    strength = np.where(gain.max(axis=0) > 0, strength, 0.0)
    for _ in range(SHAPINGS):
        turn = whitening(_mixed(shapes, strength)) / np.sqrt(2.0)
        white = turn @ shapes * np.sqrt(strength)
        overlap = np.abs(white.conj().transpose(0, 2, 1) @ white) ** 2
        matrix = np.einsum("b,bkl->kl", freedom, overlap)
        seen = turn @ power @ turn.conj().transpose(0, 2, 1)
        right = np.einsum("bik,bij,bjk->k", white.conj(), seen, white).real
        lower = np.linalg.cholesky(matrix + 1e-9 * np.trace(matrix) * np.eye(strength.size))
        share = nnls(lower.T, np.linalg.solve(lower, right))[0]
        error = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        strength = strength * np.maximum(share, error)
    return strength


def _spread(
    systems: Sequence[RecordSystem], groups: Sequence[Sequence[int]]
) -> tuple[FloatArray | None, ...]:
    """How far states may differ from end to end, (2 n,) of each stretch; None where that is open."""
    spread: dict[int, FloatArray | None] = {}
    for group in groups:
        each = [systems[k].unrest() for k in group]
        found = np.concatenate([one[0] for one in each])
        told = np.concatenate([one[1] for one in each])
        variance = 1.0 + np.outer(SHARES, told) ** 2
        unlikely = np.sum(np.log(variance) + found**2 / variance, axis=1)
        unlikely[1:] += np.log(found.size)  # none, unless the data clearly say otherwise
        share = float(SHARES[np.argmin(unlikely)])
        for k in group:
            spread[k] = None if share >= SHARES[-1] else share * systems[k].motion
    return tuple(spread[k] for k in range(len(systems)))


def _with_next(signals: FloatArray, period: int) -> FloatArray:
    """Add the row that would follow: one period before, and as far from it as the last two are."""
    following = signals[-period] + signals[-1] - signals[-1 - period]
    return np.concatenate([signals, following[None]])
