"""The maximum likelihood fits to multisines: responses, then all records, dry friction taken off."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from fieldtool.errors import IdentificationError
from fieldtool.frf.phasors import Phasors
from fieldtool.identify.classic import without_friction, without_friction_seen
from fieldtool.identify.likelihood.joint_data import frequencies_of, joint_spectra
from fieldtool.identify.likelihood.record_data import RecordData
from fieldtool.identify.likelihood.refine import RefinedModel, machine_response, refine
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.multisine.dry_friction import (
    SEEN,
    DryFriction,
    dry_friction,
    mass_left_unsure,
    without_dry_friction,
)
from fieldtool.identify.multisine.records import settled
from fieldtool.identify.multisine.whole_records import WholeRecords
from fieldtool.records.model import Estimate, MachineModel
from fieldtool.records.recording import Recording

WEIGHTINGS = 2
"""Fits, each weighted with the response of the one before."""
FRICTION_ROUNDS = 3
"""Of estimating dry friction and fitting without it."""
WORSE = 2.0
"""Times chi2 as it was from which taking off dry friction has made things worse."""
WORTH = 25.0
"""By so much chi2 has to fall for each axis' friction at its last mass to be believed."""
GOOD = 3.0
"""Misfit over noise at which no further start is tried."""


def first_fit(
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


class JointFit:
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

    def run(self, start: RefinedModel, friction: DryFriction) -> tuple[RefinedModel, DryFriction]:
        """Return the fitted machine, and the dry friction beside it; `friction`: as known before.

        What makes the misfit WORSE when it is taken off was no dry friction, and stays in.
        """
        fitted, taken = self._weighted(start, self._freed(start, friction)), friction
        friction = self._friction(fitted, friction)
        for _ in range(FRICTION_ROUNDS):
            if not friction.seen(SEEN):
                break
            without = self._weighted(fitted, self._freed(fitted, friction))
            if without.chi2 > WORSE * max(fitted.chi2, fitted.degrees_of_freedom):
                return fitted, taken
            fitted, taken = without, friction
            friction = self._friction(fitted, friction)
        return fitted, friction

    def _freed(self, fitted: RefinedModel, friction: DryFriction) -> Sequence[Phasors]:
        """Return the phasors less the friction that is seen."""
        taken = friction.sizes(SEEN)
        if not np.any(taken):
            return self._phasors
        ones = [self._settled[one.experiment] for one in self._phasors]
        return without_dry_friction(
            self._phasors, ones, self._step, taken, fitted.model, fitted.delay_values
        )

    def with_turns(self, fitted: RefinedModel, friction: DryFriction) -> RefinedModel:
        """Return the same with what friction at the turns adds to the errors of the motors' masses."""
        ones, highest = tuple(self._settled.values()), float(self._omega[-1] / (2 * np.pi))
        more = mass_left_unsure(ones, self._step, highest, friction, fitted.delay_values)
        axes = tuple(
            replace(
                a,
                masses=(
                    replace(a.masses[0], std=float(np.hypot(a.masses[0].std, m))),
                    *a.masses[1:],
                ),
            )
            for a, m in zip(fitted.model.axes, more, strict=True)
        )
        return replace(fitted, model=replace(fitted.model, axes=axes))

    def unexplained(self, fitted: RefinedModel, friction: DryFriction) -> float:
        """Return the share of the motion, in standard errors, that neither of the two explains."""
        response = machine_response(fitted.model, self._omega, fitted.delay_values)
        data = joint_spectra(self._freed(fitted, friction), response)
        left, moved = data.residuals(response), data.residuals(np.zeros_like(response))
        return float(np.linalg.norm(left) / np.linalg.norm(moved))

    def _friction(self, fitted: RefinedModel, before: DryFriction) -> DryFriction:
        band = (float(self._omega[0] / (2 * np.pi)), float(self._omega[-1] / (2 * np.pi)))
        settled_ones = list(self._settled.values())
        delays, known = fitted.delay_values, before.sizes(SEEN)
        return dry_friction(settled_ones, self._step, band, fitted.model, delays, known)

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


def with_free_motion(
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
