"""Identify a machine from multisines of all its axes under closed loops.

The response matrix gives modes, the modes give chains (block order reduction), and the chains are
where a maximum likelihood fit to positions and torques of all experiments begins.  Its equation
error holds whatever the controllers did; what it leaves is compared with the noise.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace

import numpy as np

from fieldtool.errors import IdentificationError
from fieldtool.frf.from_matrix import locked_responses
from fieldtool.frf.multisine.inputs import joint_input, with_lines
from fieldtool.frf.multisine.lines import LinePhasors, line_phasors
from fieldtool.frf.multisine.matrix import JointResult, joint_response
from fieldtool.frf.phasors import Phasors
from fieldtool.frf.response import FrequencyResponse
from fieldtool.identify.chains.block_reduction import BlockReduced, reduce_blocks
from fieldtool.identify.chains.modal_chain import reduce_modes
from fieldtool.identify.chains.order import OrderSelection, select_order
from fieldtool.identify.classic import without_friction, without_friction_seen
from fieldtool.identify.likelihood.joint_data import frequencies_of, joint_spectra
from fieldtool.identify.likelihood.record_data import RecordData
from fieldtool.identify.likelihood.refine import RefinedModel, machine_response, refine
from fieldtool.identify.likelihood.response_data import ResponseMatrix, matrix_of
from fieldtool.identify.modes.fit import fit_modes
from fieldtool.identify.modes.model import ModalModel
from fieldtool.identify.modes.search import find_modes
from fieldtool.identify.multisine.dry_friction import (
    SEEN,
    DryFriction,
    dry_friction,
    without_dry_friction,
)
from fieldtool.identify.multisine.notes import (
    cross_check,
    friction_notes,
    misfit_note,
    mode_notes,
    runner_up,
    structure_notes,
    transient_note,
)
from fieldtool.identify.multisine.records import check_alive, moving_on, settled, with_periods
from fieldtool.identify.multisine.whole_records import WholeRecords
from fieldtool.records.model import Estimate, Kind, MachineModel
from fieldtool.records.recording import Experiment, Recording

WEIGHTINGS = 2
"""Fits, each weighted with the response of the one before."""
DELAY_SEEN = 5.0
"""Standard errors from which a delay is reported."""
DELAY_SHARE = 0.05
"""Of the sample period: a smaller delay between torque and position is one of sampling, no effect."""
FRICTION_ROUNDS = 3
"""Of estimating dry friction and fitting without it."""
WORTH = 25.0
"""By so much chi2 has to fall for each axis' friction at its last mass to be believed."""
BENT = 0.01
"""Distortion over torque from which it is said with an error: chains without friction show none."""
GOOD = 3.0
"""Misfit over noise at which no further start is tried."""
MOST_UNEXPLAINED = 0.3
"""Share of the motion that may be left unexplained."""


@dataclass(frozen=True, eq=False)
class JointIdentified:
    """The identified machine and what it was made from."""

    model: MachineModel
    """With standard errors; delays and dry friction among its effects."""
    fitted: RefinedModel
    modal: ModalModel
    measured: JointResult
    responses: Mapping[str, FrequencyResponse]
    """Solved, and what follows from it: others locked, others free, pairs free."""
    order: OrderSelection | None
    """Where the number of masses was not known of every axis."""
    friction: DryFriction
    notes: tuple[str, ...]


def identify_joint(
    recording: Recording,
    masses: Mapping[str, int],
    kinds: Mapping[str, Kind],
    prior: MachineModel | None = None,
    motor_masses: Mapping[str, Estimate] | None = None,
) -> JointIdentified:
    """Identify masses, springs, couplings, dampers, friction and delays.

    Parameters
    ----------
    recording
        With multisine experiments of all axes.
    masses
        Chain lengths, as far as they are known; the others are chosen on evidence.
    kinds
        Rotary or linear, of each axis.
    prior
        Its poles are tried first in the fit of the modes; nothing else is taken from it.
    motor_masses
        From data sheets, counted as one more measurement each.

    Raises
    ------
    NotEnoughDataError
        If the data are too few, too noisy, saturated, or strongly non-linear.
    IdentificationError
        If no machine of chains explains the data.
    """
    recording = with_periods(recording)
    check_alive(recording)
    used = moving_on(recording)
    complete, single = _sets(used)
    measured = joint_response(used, complete)
    lines = (*measured.lines, *lines_of(used, single))
    data = matrix_of(measured.response)
    notes = list(measured.notes)
    order: OrderSelection | None = None
    with _told_of_distortion(measured):
        if all(name in masses for name in recording.names):
            modal, start, reduced = _known_order(data, masses, kinds, prior, notes)
        else:
            order = _chosen_order(data, masses, kinds, prior, notes)
            if order is not None:
                modal, start, reduced = order.modal, order.model, order.reduced
            else:
                last = {axis.name: len(axis.masses) for axis in prior.axes} if prior else {}
                known = {**last, **masses}
                modal, start, reduced = _known_order(data, known, kinds, prior, notes)
        priors = {f"{name}.mass[1]": mass for name, mass in (motor_masses or {}).items()}
        fit = _Fit([one.phasors(recording.names) for one in lines], recording, priors)
        first = _first_fit(_starts(start, modal, prior, kinds), data, priors)
        fitted, friction = fit.run(first)
        fitted, whole = _with_free_motion(
            fitted, WholeRecords.of(recording, lines, friction), priors
        )
        _check_explained(fit.unexplained(fitted), friction)
    notes += structure_notes(reduced, fitted, whole)
    notes += mode_notes(order, fitted, whole, data.omega.size)
    notes += transient_note(measured, data, fitted)
    notes += [unknown.reason for unknown in fitted.unknown]
    notes += friction_notes(friction, recording)
    notes += misfit_note(fitted)
    notes += cross_check(modal, fitted.model, kinds)
    return JointIdentified(
        model=_with_effects(fitted, friction, recording),
        fitted=fitted,
        modal=modal,
        measured=measured,
        responses=_responses(measured.response),
        order=order,
        friction=friction,
        notes=tuple(dict.fromkeys(notes)),
    )


@contextmanager
def _told_of_distortion(measured: JointResult) -> Iterator[None]:
    """Add to an error that the data are not those of a straight machine, where they show it."""
    try:
        yield
    except IdentificationError as error:
        seen = [
            f"{one.axis} ({20 * np.log10(max(one.odd_share, one.even_share)):.0f} dB of its torque)"
            for one in measured.distortion
            if max(one.odd_share, one.even_share) > BENT
        ]
        if seen:
            error.add_note(
                f"The data are strongly non-linear, which may be the cause: distortion of "
                f"{', '.join(dict.fromkeys(seen))}, likely dry friction or backlash. Give the numbers "
                "of masses with --masses AXIS=N (dry friction is then taken off), or measure with a "
                "larger amplitude or on top of a constant velocity, and check the axis for play."
            )
        raise


def _responses(solved: FrequencyResponse) -> dict[str, FrequencyResponse]:
    return {solved.condition: solved, **locked_responses(solved)}


def phasors_of(recording: Recording, experiments: Sequence[Experiment]) -> tuple[Phasors, ...]:
    """Return the steady phasors of each experiment at its excited lines, however few there are."""
    return tuple(one.phasors(recording.names) for one in lines_of(recording, experiments))


def lines_of(recording: Recording, experiments: Sequence[Experiment]) -> tuple[LinePhasors, ...]:
    """Return the steady phasors of each experiment at all lines, however few there are."""
    if not experiments:
        return ()
    inputs = [with_lines(recording, joint_input(recording, one)) for one in experiments]
    return tuple(line_phasors(recording, inputs))


def _sets(
    recording: Recording,
) -> tuple[tuple[Experiment, ...] | None, tuple[Experiment, ...]]:
    """Part the multisines in those with as many of one period as axes, and single ones.

    Single ones (a short pilot) have no response matrix of their own, but the fit uses them.  Where
    there are no others, the first part is None: all are tried.
    """
    groups: dict[int | None, list[Experiment]] = {}
    for one in recording.experiments:
        if one.kind == "multisine" and one.driven and one.complete:
            samples = round(one.period / recording.sample_period) if one.period else None
            groups.setdefault(samples, []).append(one)
    whole = {k for k, members in groups.items() if len(members) >= len(recording.axes)}
    if not whole:
        return None, ()
    complete = [e for k, members in groups.items() if k in whole for e in members]
    single = [e for k, members in groups.items() if k not in whole and k for e in members]
    return tuple(complete), tuple(single)


def _known_order(
    data: ResponseMatrix,
    masses: Mapping[str, int],
    kinds: Mapping[str, Kind],
    prior: MachineModel | None,
    notes: list[str],
) -> tuple[ModalModel, MachineModel, BlockReduced | None]:
    """Return modes and chains of known lengths; the prior's numbers where the chains fail."""
    modes = sum(masses[name] - 1 for name in data.names)
    same = prior is not None and all(len(axis.masses) == masses[axis.name] for axis in prior.axes)
    modal = _modes(data, modes, prior if same else None)
    try:
        reduced = reduce_blocks(modal, masses, kinds)
    except IdentificationError as error:
        if prior is None or not same:
            raise
        notes.append(f"Block order reduction failed ({error}); the fit began at the prior model.")
        return modal, prior, None
    return modal, reduced.model, reduced


def _modes(data: ResponseMatrix, modes: int, prior: MachineModel | None) -> ModalModel:
    """Fit so many modes; a search that adds one after the other finds many of them more surely."""
    found = find_modes(data, modes, prior=prior).modal
    if found.omega.size == modes:
        return found
    return fit_modes(data, modes, fit_friction=True, fit_delay=True, prior=prior)


def _chosen_order(
    data: ResponseMatrix,
    masses: Mapping[str, int],
    kinds: Mapping[str, Kind],
    prior: MachineModel | None,
    notes: list[str],
) -> OrderSelection | None:
    """Choose the chains' lengths on evidence; None where nothing fits but there is a prior model."""
    try:
        order = select_order(data, kinds, known=masses, prior=prior)
    except IdentificationError as error:
        if prior is None:
            raise
        notes.append(f"{error} The chains are as long as in the prior model.")
        return None
    notes += order.other_doubts
    if order.runner_up is not None:
        notes.append(runner_up(order, data.names))
    for axis in prior.axes if prior is not None else ():
        if order.masses[axis.name] != len(axis.masses):
            notes.append(
                f"{axis.name}: the data show {order.masses[axis.name]} masses, the prior model has "
                f"{len(axis.masses)}. Force it with --masses {axis.name}={len(axis.masses)} to compare."
            )
    return order


def _starts(
    start: MachineModel,
    modal: ModalModel,
    prior: MachineModel | None,
    kinds: Mapping[str, Kind],
) -> Iterator[MachineModel]:
    """Where to begin, best guess first: blocks, one axis at a time, the machine as last accepted."""
    yield start
    lengths = {axis.name: len(axis.masses) for axis in start.axes}
    with suppress(IdentificationError, ValueError):
        yield reduce_modes(modal, lengths, kinds).model
    if prior is not None and {a.name: len(a.masses) for a in prior.axes} == lengths:
        yield prior


def _first_fit(
    starts: Iterator[MachineModel], data: ResponseMatrix, priors: Mapping[str, Estimate]
) -> RefinedModel:
    """Fit from one start after another until the responses are explained; the best otherwise."""
    best: RefinedModel | None = None
    failure: IdentificationError | None = None
    for start in starts:
        try:
            found = refine(
                _still_loads(start), data, fit_delay=True, fit_friction=True, priors=priors
            )
        except IdentificationError as error:
            failure = failure or error
            continue
        if best is None or found.chi2 < best.chi2:
            best = found
        if best.chi2 <= GOOD * best.degrees_of_freedom:
            break
    if best is None:
        raise failure or IdentificationError("there is no machine to begin the fit from")
    return best


class _Fit:
    """Maximum likelihood on positions and torques of all experiments, dry friction taken off."""

    def __init__(
        self,
        phasors: Sequence[Phasors],
        recording: Recording,
        priors: Mapping[str, Estimate],
    ) -> None:
        """`phasors`: what is fitted; dry friction comes from all multisines of the recording."""
        self._phasors, self._priors = phasors, priors
        self._step = recording.sample_period
        everything = (e for e in recording.experiments if e.kind == "multisine" and e.complete)
        self._settled = {one.name: settled(one, self._step) for one in everything}
        self._omega = frequencies_of(phasors)

    def run(self, start: RefinedModel) -> tuple[RefinedModel, DryFriction]:
        """Return the fitted machine, and the dry friction beside it."""
        fitted = self._weighted(start, self._phasors)
        friction = self._friction(fitted)
        taken = np.zeros(len(friction.axes))
        for _ in range(FRICTION_ROUNDS):
            seen = friction.seen(SEEN)
            if not seen:
                break
            taken[list(seen)] = [friction.torque[k].value for k in seen]
            fitted_ones = [self._settled[one.experiment] for one in self._phasors]
            freed = without_dry_friction(self._phasors, fitted_ones, self._step, taken.tolist())
            fitted = self._weighted(fitted, freed)
            friction = self._friction(fitted)
        return fitted, friction

    def unexplained(self, fitted: RefinedModel) -> float:
        """Return the share of the motion, in standard errors, that the machine does not explain."""
        response = machine_response(fitted.model, self._omega, fitted.delay_values)
        data = joint_spectra(self._phasors, response)
        left, moved = data.residuals(response), data.residuals(np.zeros_like(response))
        return float(np.linalg.norm(left) / np.linalg.norm(moved))

    def _friction(self, fitted: RefinedModel) -> DryFriction:
        band = (float(self._omega[0] / (2 * np.pi)), float(self._omega[-1] / (2 * np.pi)))
        settled_ones = list(self._settled.values())
        return dry_friction(settled_ones, self._step, band, fitted.model, fitted.delay_values)

    def _weighted(self, start: RefinedModel, phasors: Sequence[Phasors]) -> RefinedModel:
        """Fit, each time weighted anew, then once more without friction that is not seen."""
        found = start
        for _ in range(WEIGHTINGS):
            found = self._once(found, phasors, ())
        unseen = without_friction_seen(found.model)
        if unseen:
            found = self._once(found, phasors, unseen)
        loads = self._once(found, phasors, unseen, loads=True)
        return loads if loads.chi2 < found.chi2 - WORTH * len(found.model.axes) else found

    def _once(
        self,
        start: RefinedModel,
        phasors: Sequence[Phasors],
        without: Sequence[str],
        *,
        loads: bool = False,
    ) -> RefinedModel:
        response = machine_response(start.model, self._omega, start.delay_values)
        model = without_friction(start.model, without)
        return refine(
            model,
            joint_spectra(phasors, response),
            fixed=[f"{name}.viscous_friction" for name in without],
            priors=self._priors,
            fit_delay=True,
            fit_friction=True,
            fit_load_friction=loads,
            delays=start.delay_values.tolist(),
        )


def _with_free_motion(
    start: RefinedModel, records: WholeRecords, priors: Mapping[str, Estimate]
) -> tuple[RefinedModel, RecordData | None]:
    """Fit whole records, transients and all; the start's frictions that were not seen stay out.

    Returns the fit and its data, or the start and None where records are too long.
    """
    if records.too_long:
        return start, None
    axes = start.model.axes
    still = [f"{axis.name}.viscous_friction" for axis in axes if not axis.viscous_friction.value]
    found, data = start, None
    for _ in range(WEIGHTINGS):
        data = records.data(found, run_in=not np.any(records.friction))
        found = refine(
            found.model,
            data,
            fixed=still,
            priors=priors,
            fit_delay=True,
            fit_friction=True,
            fit_load_friction=any(axis.load_friction.value for axis in axes),
            delays=found.delay_values.tolist(),
        )
        records = records.sized(data, found)
    return found, data


def _still_loads(model: MachineModel) -> MachineModel:
    """Return the model without friction at its last masses: that is fitted only where it shows."""
    axes = tuple(replace(axis, load_friction=Estimate(0.0)) for axis in model.axes)
    return replace(model, axes=axes)


def _check_explained(share: float, friction: DryFriction) -> None:
    """Refuse a machine that does not explain most of what was measured."""
    if share > MOST_UNEXPLAINED:
        rubs = [friction.axes[k] for k in friction.seen(SEEN)]
        why = f"dry friction of {', '.join(rubs)}, " if rubs else ""
        raise IdentificationError(
            f"the nearest machine of such chains leaves {100 * share:.0f} % of the motion unexplained "
            f"(limit {100 * MOST_UNEXPLAINED:.0f} %), so its masses and springs mean nothing: {why}"
            "another number of masses (--masses AXIS=N), or an axis that does not report its own "
            "torque? Look at the responses in frequency-response.h5, or use the classic plan."
        )


def _with_effects(
    fitted: RefinedModel, friction: DryFriction, recording: Recording
) -> MachineModel:
    """Put delays and dry friction that are seen among the model's effects."""
    effects = list(fitted.model.effects)
    for axis, delay in zip(fitted.model.axes, fitted.delays, strict=True):
        if abs(delay.value) > max(DELAY_SEEN * delay.std, DELAY_SHARE * recording.sample_period):
            effects.append(effect_entry("measurement_delay", axis.name, "delay", delay, "s"))
    for k in friction.seen(SEEN):
        unit = recording.axes[k].torque_unit
        effects.append(
            effect_entry("coulomb_friction", friction.axes[k], "torque", friction.torque[k], unit)
        )
    return replace(fitted.model, effects=tuple(effects))


def effect_entry(
    name: str, axis: str, parameter: str, value: Estimate, unit: str
) -> dict[str, object]:
    """Return an effect with one parameter, as a model holds it."""
    values = {"value": value.value, "std": value.std, "unit": unit}
    return {"effect": name, "axis": axis, "parameters": {parameter: values}}
