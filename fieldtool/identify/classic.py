"""From stepped-sine responses to the machine: the paper's way, end to end.

Resonances, antiresonances and high-frequency gains come from a fit of common modes to the
responses with the other axes free.  Low-frequency gains A_L and cross gains A_C come from the
sweeps with the other axes held: at each frequency all these sweeps together are solved for the
response matrix G, and Z = inv(G) is what perfectly held axes would show::

    X = Re(Z) / (-w^2)      1 / A_L,i = X_ii      A_C,ij = [inv(X restricted to i, j)]_ij   as w -> 0

so that position loops that give way a little do no harm, and friction, which acts in phase with
the velocity and stays in Im(Z), neither.  Then order reduction, equations (2) to (22).  Dampers
come from a non-linear fit, as the paper's conclusion says; it starts from the result of the order
reduction, and moves masses, springs and couplings too, because each of them then rests on all
measured points and not on single ones.  Both results have to agree.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import hypot

import numpy as np

from fieldtool.errors import IdentificationError, NotEnoughDataError
from fieldtool.frf.low_frequency import (
    LowFrequencyGain,
    LowFrequencyMass,
    dynamic_stiffness_low,
    low_frequency_gain,
)
from fieldtool.frf.matrix import OTHERS_FREE, solved_response
from fieldtool.frf.response import FrequencyResponse
from fieldtool.frf.stepped.responses import SteppedResult
from fieldtool.identify.chains.modal_chain import reduction_inputs
from fieldtool.identify.chains.order_reduction import CrossGain, ReducedMachine, reduce_machine
from fieldtool.identify.likelihood.refine import refine
from fieldtool.identify.likelihood.response_data import ResponseMatrix, matrix_of
from fieldtool.identify.modes.fit import fit_modes
from fieldtool.identify.modes.model import ModalModel
from fieldtool.records.model import Estimate, FloatArray, Kind, MachineModel

RELATIVE_FLOOR = 5e-4
"""Of each response: what settling, quantisation and small distortion leave beside noise."""
ALLOWED_APART = 0.1
"""Relative difference between order reduction and refinement above which something is wrong."""
SIGNIFICANT = 3.0
"""Standard errors above which friction counts as seen."""
DISAGREEMENT = 5.0
"""Standard errors between two ways to one number above which a note is made."""


@dataclass(frozen=True, eq=False)
class ClassicResult:
    """The identified machine and what it was made from."""

    model: MachineModel
    modal: ModalModel
    reduced: ReducedMachine
    free: FrequencyResponse
    """Response with the other axes free."""
    low_masses: tuple[LowFrequencyMass, ...]
    """1 / A_L of each axis; empty for one axis."""
    cross_gains: tuple[LowFrequencyGain, ...]
    """A_C of each pair of axes in the order of ``itertools.combinations``."""
    notes: tuple[str, ...]

    @property
    def damping_ratios(self) -> FloatArray:
        """Of the resonances, rising frequency, shape (n,)."""
        return self.modal.zeta


def identify_classic(
    stepped: SteppedResult,
    masses: Mapping[str, int],
    kinds: Mapping[str, Kind],
    prior: MachineModel | None = None,
    motor_masses: Mapping[str, Estimate] | None = None,
) -> ClassicResult:
    """Identify masses, springs, couplings and dampers from stepped sines.

    Parameters
    ----------
    stepped
        Responses and phasors of the recording.
    masses
        Chain length of each axis.
    kinds
        Rotary or linear, of each axis.
    prior
        Its poles are tried first in the fit of the modes; nothing else is taken from it.
    motor_masses
        From data sheets; order reduction then removes one mass at a time and does not use the
        high-frequency gain.

    Raises
    ------
    NotEnoughDataError
        If there are no responses with the other axes free, or too few.
    IdentificationError
        If the modes can not come from such chains.
    """
    free = stepped.responses.get(OTHERS_FREE)
    if free is None:
        raise NotEnoughDataError(
            "no sweep lets the other axes float, so there are no resonances to read. Measure with "
            "the classic plan."
        )
    data = matrix_of(free, RELATIVE_FLOOR)
    modal = fit_modes(
        data,
        sum(masses[name] - 1 for name in free.axes),
        fit_friction=bool(data.pairs.all() and np.all(data.measured.any(axis=0))),
        prior=prior,
    )
    inputs = reduction_inputs(modal, masses, kinds, motor_masses)
    axes, cross, covariance = list(inputs.axes), inputs.cross_gains, inputs.covariance.copy()
    notes: list[str] = []
    low: tuple[LowFrequencyMass, ...] = ()
    measured_cross: tuple[LowFrequencyGain, ...] = ()
    if len(axes) > 1:
        low, measured_cross = held_gains(stepped)
        at = 0
        for k, mass in enumerate(low):
            at += 2 * axes[k].spectrum.antiresonances.size
            gain = Estimate(1 / mass.mass, mass.std / mass.mass**2)
            _compare(notes, f"{free.axes[k]}: A_L", axes[k].low_gain, gain)
            axes[k] = replace(axes[k], low_gain=gain)
            _set_variance(covariance, at, gain.std)
            at += 2
        cross = tuple(
            CrossGain((free.axes[i], free.axes[j]), found.gain, found.std)
            for (i, j), found in zip(combinations(range(len(axes)), 2), measured_cross, strict=True)
        )
        for k, found in enumerate(measured_cross):
            _set_variance(covariance, at + k, found.std)
    reduced = reduce_machine(axes, cross, covariance)
    model, refinement = _refined(reduced.model, data, modal)
    notes += [*reduced.notes, *refinement]
    return ClassicResult(model, modal, reduced, free, low, measured_cross, tuple(notes))


def held_gains(
    stepped: SteppedResult,
) -> tuple[tuple[LowFrequencyMass, ...], tuple[LowFrequencyGain, ...]]:
    """Return A_L of every axis and A_C of every pair, from the sweeps with axes held.

    Raises
    ------
    NotEnoughDataError
        If not every axis was driven at common frequencies while others were held.
    """
    axes = stepped.phasors[0].axes
    held = [p for p in stepped.phasors if len(p.free) < len(p.axes) - 1]
    driven = {name for p in held for name in p.driven}
    missing = [name for name in axes if name not in driven]
    if missing:
        raise NotEnoughDataError(
            f"no sweep drives {', '.join(missing)} with other axes held, so the low-frequency gain is "
            "not known. Measure with the classic plan."
        )
    solved = solved_response(held)
    omega2 = (2 * np.pi * solved.frequencies) ** 2
    stiffness = np.linalg.inv(solved.response).astype(np.complex128)
    size = np.abs(stiffness) ** 2
    stiffness_std = np.sqrt(size @ solved.std**2 @ size)  # dZ = -Z dG Z, elements independent
    low = []
    for k in range(len(axes)):
        found = dynamic_stiffness_low(
            solved.frequencies,
            np.reciprocal(stiffness[:, k, k]),
            np.ones(omega2.size, dtype=np.complex128),
            stiffness_std[:, k, k] / np.abs(stiffness[:, k, k]) ** 2,
        )
        low.append(found)
    apparent = -stiffness.real / omega2[:, None, None]
    apparent_std = stiffness_std / omega2[:, None, None]
    cross = []
    for i, j in combinations(range(len(axes)), 2):
        pair = np.ix_(range(omega2.size), [i, j], [i, j])
        inverse = np.linalg.inv(apparent[pair]).astype(np.float64)
        spread = inverse**2
        std = np.sqrt(spread @ apparent_std[pair] ** 2 @ spread)
        cross.append(
            low_frequency_gain(
                solved.frequencies,
                inverse[:, 0, 1],
                std[:, 0, 1],
                f"cross gain of {axes[i]} and {axes[j]}",
            )
        )
    return tuple(low), tuple(cross)


def _set_variance(covariance: FloatArray, at: int, std: float) -> None:
    covariance[at, :] = covariance[:, at] = 0.0
    covariance[at, at] = std**2


def _compare(notes: list[str], what: str, other: Estimate, gain: Estimate) -> None:
    apart = abs(other.value - gain.value)
    allowed = DISAGREEMENT * hypot(other.std, gain.std, 2e-3 * gain.value)
    if apart > allowed:
        notes.append(
            f"{what} is {gain.value:.5g} with the others held and {other.value:.5g} with the others "
            "free; they should agree. Friction, or a coupling that is not between the last masses?"
        )


def _refined(
    reduced: MachineModel, data: ResponseMatrix, modal: ModalModel
) -> tuple[MachineModel, Sequence[str]]:
    """Fit everything to all points, starting from the order reduction; keep that if they disagree."""
    try:
        fitted = refine(reduced, data, fit_friction=modal.parts.friction)
        unseen = without_friction_seen(fitted.model) if modal.parts.friction else ()
        if unseen:
            fixed = [f"{name}.viscous_friction" for name in unseen]
            start = without_friction(fitted.model, unseen)
            fitted = refine(start, data, fixed=fixed, fit_friction=True)
    except IdentificationError as error:
        return reduced, (f"The refinement failed, so dampers are not known: {error}",)
    notes = [unknown.reason for unknown in fitted.unknown]
    apart, what = _largest_difference(reduced, fitted.model)
    if apart > ALLOWED_APART:
        notes.append(
            f"Order reduction and refinement disagree by {100 * apart:.1f} % in {what}; the result of "
            "the order reduction is kept. A mode was missed, or a coupling is not between last masses?"
        )
        return reduced, notes
    return fitted.model, notes


def without_friction_seen(model: MachineModel) -> tuple[str, ...]:
    """Return the axes whose friction at the motor can not be told from none."""
    return tuple(
        axis.name
        for axis in model.axes
        if axis.viscous_friction.value <= SIGNIFICANT * axis.viscous_friction.std
    )


def without_friction(model: MachineModel, names: Collection[str] | None = None) -> MachineModel:
    """Return the model with no friction at the motors of these axes (None: of all)."""
    axes = tuple(
        replace(axis, viscous_friction=Estimate(0.0))
        if names is None or axis.name in names
        else axis
        for axis in model.axes
    )
    return replace(model, axes=axes)


def _largest_difference(a: MachineModel, b: MachineModel) -> tuple[float, str]:
    """Return the largest relative difference of masses and springs, and where it is."""
    worst, where = 0.0, "nothing"
    for one, other in zip(a.axes, b.axes, strict=True):
        for what, first, second in (
            ("mass", one.masses, other.masses),
            ("spring", one.springs, other.springs),
        ):
            for k, (x, y) in enumerate(zip(first, second, strict=True)):
                apart = abs(x.value / y.value - 1)
                if apart > worst:
                    worst, where = apart, f"{one.name} {what} {k + 1}"
    return worst, where
