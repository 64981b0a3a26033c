"""Identify a machine from multisines of all its axes under closed loops.

The response matrix gives modes, the modes give chains (block order reduction), and the chains are
where a maximum likelihood fit to positions and torques of all experiments begins.  Its equation
error holds whatever the controllers did; what it leaves is compared with the noise.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from fieldtool.errors import IdentificationError
from fieldtool.frf.from_matrix import locked_responses
from fieldtool.frf.multisine.distortion import joint_distortion
from fieldtool.frf.multisine.matrix import JointResult, joint_response
from fieldtool.frf.response import FrequencyResponse
from fieldtool.identify.chains.order import OrderSelection
from fieldtool.identify.likelihood.refine import RefinedModel
from fieldtool.identify.likelihood.response_data import matrix_of
from fieldtool.identify.modes.model import ModalModel
from fieldtool.identify.multisine.chains import chosen_order, known_order, starts
from fieldtool.identify.multisine.dry_friction import (
    SEEN,
    DryFriction,
)
from fieldtool.identify.multisine.fit import JointFit, first_fit, with_free_motion
from fieldtool.identify.multisine.lines import lines_of
from fieldtool.identify.multisine.local_friction import local_friction, without_local_friction
from fieldtool.identify.multisine.notes import (
    cross_check,
    friction_notes,
    misfit_note,
    mode_notes,
    structure_notes,
    transient_note,
)
from fieldtool.identify.multisine.records import check_alive, moving_on, settled, with_periods
from fieldtool.identify.multisine.whole_records import WholeRecords
from fieldtool.records.model import Estimate, Kind, MachineModel
from fieldtool.records.recording import Experiment, Recording

DELAY_SEEN = 5.0
"""Standard errors from which a delay is reported."""
DELAY_SHARE = 0.05
"""Of the sample period: a smaller delay between torque and position is one of sampling, no effect."""
BENT = 0.01
"""Distortion over torque from which it is said with an error: chains without friction show none."""
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
    early, measured = _freed_response(used, complete, (*(complete or ()), *single))
    lines = (*measured.lines, *lines_of(used, single))
    data = matrix_of(measured.response)
    notes = list(measured.notes)
    order: OrderSelection | None = None
    with _told_of_distortion(measured):
        if all(name in masses for name in recording.names):
            modal, start, reduced = known_order(data, masses, kinds, prior, notes)
        else:
            order = chosen_order(data, masses, kinds, prior, notes)
            if order is not None:
                modal, start, reduced = order.modal, order.model, order.reduced
            else:
                last = {axis.name: len(axis.masses) for axis in prior.axes} if prior else {}
                known = {**last, **masses}
                modal, start, reduced = known_order(data, known, kinds, prior, notes)
        priors = {f"{name}.mass[1]": mass for name, mass in (motor_masses or {}).items()}
        fit = JointFit([one.phasors(recording.names) for one in lines], recording, priors)
        first = first_fit(starts(start, modal, prior, kinds), data, priors)
        fitted, friction = fit.run(first, early)
        fitted, whole = with_free_motion(
            fitted, WholeRecords.of(recording, lines, friction), priors
        )
        _check_explained(fit.unexplained(fitted, friction), friction)
        fitted = fit.with_turns(fitted, friction)
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
    """Add to an error that the data are not those of a straight machine, where they show it.

    A fit that runs away to numbers that are no machine's is an error of that kind.
    """
    try:
        try:
            yield
        except np.linalg.LinAlgError as error:
            raise IdentificationError(
                "the fit runs away to masses and springs that are no machine's; another number of "
                "masses (--masses AXIS=N)? Look at the responses in frequency-response.h5, or use the "
                "classic plan."
            ) from error
    except IdentificationError as error:
        seen = [
            f"{one.axis} ({20 * np.log10(max(one.odd_share, one.even_share)):.0f} dB of its torque)"
            for one in measured.distortion
            if max(one.odd_share, one.even_share) > BENT
        ]
        if seen:
            error.add_note(
                f"The data are strongly non-linear, which may be the cause: distortion of "
                f"{', '.join(dict.fromkeys(seen))}. Dry friction: give the numbers of masses with "
                "--masses AXIS=N (it is then taken off). Backlash: measure with a larger amplitude or "
                "on top of a constant velocity. A motor that gives less torque than its drive tells "
                "(current limit, supply): lower the axis' torque limit in the machine profile, and "
                "measure again."
            )
        raise


def _freed_response(
    recording: Recording,
    complete: tuple[Experiment, ...] | None,
    experiments: tuple[Experiment, ...],
) -> tuple[DryFriction, JointResult]:
    """Return the dry friction that the data show of themselves, and the response without it.

    Lines and distortion are those of the data as measured.
    """
    names, step = recording.names, recording.sample_period
    nothing = DryFriction(names, (Estimate(0.0),) * len(names), np.zeros(len(names)))
    if complete is None:
        return nothing, joint_response(recording)
    lines = lines_of(recording, complete)
    excited = np.concatenate([one.phasors(names).frequencies for one in lines])
    band = (float(excited.min()), float(excited.max()))
    ones = [settled(one, step) for one in experiments]
    early, delays = local_friction(names, ones, step, band)
    if not early.seen(SEEN):
        return early, joint_response(recording, complete)
    freed = without_local_friction(recording, early.sizes(SEEN), band[1], delays)
    straight = {one.name: one for one in freed.experiments}
    measured = joint_response(freed, tuple(straight[one.name] for one in complete))
    bent = joint_distortion(lines, measured.response)
    left = {one.sentence for one in measured.distortion}
    notes = (
        *(note for note in measured.notes if note not in left),
        *(one.sentence for one in bent if one.worth_saying),
    )
    return early, replace(measured, lines=lines, distortion=bent, notes=notes)


def _responses(solved: FrequencyResponse) -> dict[str, FrequencyResponse]:
    return {solved.condition: solved, **locked_responses(solved)}


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
