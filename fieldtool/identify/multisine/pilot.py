"""What a short, weak measurement tells, so that the main one can be planned: noise, friction, modes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from fieldtool.errors import IdentificationError, NotEnoughDataError
from fieldtool.frf.phasors import ComplexArray, Phasors, equation_errors
from fieldtool.identify.chains.forward import spectra
from fieldtool.identify.likelihood.expected import Noise
from fieldtool.identify.likelihood.joint_data import frequencies_of, joint_spectra
from fieldtool.identify.likelihood.refine import RefinedModel, machine_response, refine
from fieldtool.identify.multisine.dry_friction import (
    DryFriction,
    dry_friction,
    without_dry_friction,
)
from fieldtool.identify.multisine.lines import lines_of, phasors_of
from fieldtool.identify.multisine.records import settled, with_periods
from fieldtool.identify.multisine.whole_records import WholeRecords
from fieldtool.records.model import Estimate, FloatArray, MachineModel
from fieldtool.records.recording import Experiment, Recording

TRUST = {"mass": 0.7, "spring": 0.7, "damper": 1.0}
"""Relative standard error of the machine as last accepted: new tooling changes a lot."""
WEIGHTINGS = 2
"""Fits, each weighted with the response of the one before."""
POOR_FIT = 30.0
"""Misfit (chi2 over degrees of freedom) above which it is said that the model is only the nearest."""
BEYOND = 2.0
"""Factor by which a mode may lie outside the pilot's lines and still be believed."""
LEAST_FREEDOM = 0.1
"""Share of a bin that the states at the ends may use up, and it still tells the noise."""
POWER_ROUNDS = 6
"""Of weighting the powers of errors by what noise explains of them."""
LEAST_POWER = 1e-3
"""Of what was expected the round before, and of the median power at first."""
SMALLEST = 1e-12
"""rad or m: noise of a position that shows none."""
FRICTION_ROUNDS = 6
"""Of fitting anew without dry friction, at most."""
PUSHING = 5.0
"""Standard errors below zero from which friction can not be one: it would bring energy in."""
FRICTION_TAKEN = 2.0
"""Standard errors from which dry friction is taken off before the next fit: a model that was fitted
with it hides a part of it, and the rest stands out more from one fit to the next."""
FRICTION_SETTLED = 0.02
"""Relative change of the friction from one fit to the next, below which no other follows."""
IN_PHASE = 0.7
"""Share of the torque that has to be in phase with what the prior model expects."""
FRICTION_SEEN = 5.0
"""Standard errors from which dry friction counts as seen."""


@dataclass(frozen=True, eq=False)
class PilotFindings:
    """What the pilot found."""

    model: MachineModel
    """The machine by the pilot, or as last accepted where the pilot can not tell."""
    noise: Noise
    """Of single samples."""
    friction: DryFriction | None
    """None where the model does not explain the pilot."""
    notes: tuple[str, ...]
    torque_ratio: FloatArray
    """Torque that each axis' motion took, over what it takes by the machine as last accepted, (M,)."""


def read_pilot(recording: Recording, prior: MachineModel) -> PilotFindings:
    """Read noise, friction and modes from the multisine experiments of a recording.

    Parameters
    ----------
    recording
        Whose multisine experiments are the pilot.
    prior
        The machine as last accepted: chain lengths, and start of the fit.

    Raises
    ------
    NotEnoughDataError
        If there is no multisine, or nothing moved.
    """
    recording = with_periods(recording)
    experiments = [e for e in recording.experiments if e.kind == "multisine" and e.complete]
    if not experiments:
        raise NotEnoughDataError("there is no complete multisine experiment to be read as a pilot")
    lines = lines_of(recording, experiments)
    phasors = tuple(one.phasors(recording.names) for one in lines)
    step = recording.sample_period
    notes: list[str] = []
    ratios = _torque_ratios(phasors, prior)
    explained = _explained(phasors, experiments, step, prior, notes)
    if explained is None:
        noise = _noise(phasors, experiments, step, prior, np.zeros(len(prior.axes)))
        return PilotFindings(prior, noise, None, tuple(notes), ratios)
    fitted, friction = explained
    records = WholeRecords.of(recording, lines, friction)
    if records.too_long:
        noise = _noise(phasors, experiments, step, fitted.model, fitted.delay_values)
    else:
        fitted, noise = _with_free_motion(fitted, records, prior)
    if (pushing := _pushing_axis(fitted.model)) is not None:
        notes.append(
            f"The model that fits the pilot best can not be: friction of {pushing} would push its axis. "
            "The main experiments are planned with the machine as last accepted."
        )
        noise = _noise(phasors, experiments, step, prior, np.zeros(len(prior.axes)))
        return PilotFindings(prior, noise, None, tuple(notes), ratios)
    for k in friction.seen(FRICTION_SEEN):
        unit = recording.axes[k].torque_unit
        one = friction.torque[k]
        notes.append(
            f"{friction.axes[k]}: dry friction of {one.value:.2g} +- {1.96 * one.std:.1g} {unit}, "
            f"{100 * friction.share[k]:.0f} % of the pilot's torque."
        )
    return PilotFindings(fitted.model, noise, friction, tuple(notes), ratios)


def _pushing_axis(model: MachineModel) -> str | None:
    """Return the axis whose viscous friction is negative beyond its error: a fit gone astray."""
    for axis in model.axes:
        friction = axis.viscous_friction
        if friction.value < -PUSHING * friction.std:
            return axis.name
    return None


def _torque_ratios(phasors: Sequence[Phasors], prior: MachineModel) -> FloatArray:
    """Return the median over all lines of measured over expected torque, shape (M,).

    Only the part in phase with what is expected counts: friction is a quarter period beside it.  Where
    that part is not most of it, the machine is another one, and no scale can be told: then 1.
    """
    along, sizes = [], []
    for one in phasors:
        response = machine_response(prior, 2 * np.pi * one.frequencies)
        expected = np.linalg.solve(response, one.position[:, :, None])[:, :, 0]
        size = np.maximum(np.abs(expected), 1e-300)
        along.append((one.torque * expected.conj()).real / size**2)
        sizes.append(np.abs(one.torque) / size)
    ratios: FloatArray = np.median(np.vstack(along), axis=0)
    return np.where(ratios > IN_PHASE * np.median(np.vstack(sizes), axis=0), ratios, 1.0)


def _explained(
    phasors: Sequence[Phasors],
    experiments: Sequence[Experiment],
    step: float,
    prior: MachineModel,
    notes: list[str],
) -> tuple[RefinedModel, DryFriction] | None:
    """Fit a model and dry friction in turn: friction that is likely is taken off before the next fit.

    None where no model explains the pilot; why is added to the notes.
    """
    steady = [settled(one, step) for one in experiments]
    band = (
        min(float(p.frequencies.min()) for p in phasors),
        max(float(p.frequencies.max()) for p in phasors),
    )
    found: tuple[RefinedModel, DryFriction] | None = None
    freed, taken, said = phasors, np.zeros(len(prior.axes)), list[str]()
    for _ in range(1 + FRICTION_ROUNDS):
        said = []
        fitted = _fitted(freed, prior, said)
        if fitted is None:
            break
        model, delays = fitted.model, fitted.delay_values
        friction = dry_friction(steady, step, band, model, delays, taken)
        found = fitted, friction
        new = friction.sizes(FRICTION_TAKEN)
        if np.all(np.abs(new - taken) <= FRICTION_SETTLED * np.abs(new)):
            break
        taken = new
        freed = without_dry_friction(phasors, steady, step, taken, model, delays)
    notes += said
    return found


def measured_noise(recording: Recording, model: MachineModel) -> Noise:
    """Return the noise of single samples that a recording's multisines show.

    Raises
    ------
    NotEnoughDataError
        If there is no complete multisine, or none with two whole periods.
    """
    recording = with_periods(recording)
    experiments = [e for e in recording.experiments if e.kind == "multisine" and e.complete]
    if not experiments:
        raise NotEnoughDataError("there is no complete multisine experiment that tells the noise")
    phasors = phasors_of(recording, experiments)
    still = np.zeros(len(model.axes))
    return _noise(phasors, experiments, recording.sample_period, model, still)


def _noise(
    phasors: Sequence[Phasors],
    experiments: Sequence[Experiment],
    sample_period: float,
    model: MachineModel,
    delays: FloatArray,
) -> Noise:
    """Standard deviations of single samples that explain the scatter of the equation error.

    What noise makes the loops do is in torque and position alike and tells as much as excitation;
    what counts is the scatter of Theta - G T, here put down to independent noise of both.
    """
    seen = []
    for one, experiment in zip(phasors, experiments, strict=True):
        samples = round(float(experiment.period or 0.0) / sample_period)
        response = machine_response(model, 2 * np.pi * one.frequencies, delays)
        error = np.einsum("fkk->fk", equation_errors(response, one.covariance)).real
        seen.append((response, error, experiment.samples // samples * samples))
    return _explaining(seen, rounds=1)


def _with_free_motion(
    start: RefinedModel, records: WholeRecords, prior: MachineModel
) -> tuple[RefinedModel, Noise]:
    """Fit whole records: what is left of transients in so few periods is neither machine nor noise."""
    step = records.recording.sample_period
    found = start
    for _ in range(WEIGHTINGS):
        data = records.data(found, run_in=False)
        found = refine(
            found.model,
            data,
            priors=_trusted(prior),
            fit_delay=True,
            fit_friction=True,
            delays=found.delay_values.tolist(),
        )
    seen = []
    for system in data.systems(found.model, found.delay_values):
        error = np.linalg.solve(system.whiten, system.white[:, :, None])[:, :, 0]
        power = np.abs(error) ** 2 / np.maximum(system.freedom, LEAST_FREEDOM)[:, None]
        response = machine_response(found.model, system.one.omega, found.delay_values)
        seen.append((response, power, round(system.one.duration / step)))
    return found, _explaining(seen, POWER_ROUNDS)


def _explaining(seen: Sequence[tuple[ComplexArray, FloatArray, int]], rounds: int) -> Noise:
    """Noise that explains powers of the equation error (F, M): responses, these, samples of each.

    In the first round each counts by itself, which does for means; single powers scatter as much as
    they are large, and then count by what is expected of them (quasi-likelihood: McCullagh and Nelder,
    Generalized Linear Models, chapter 9).  No axis' position is taken for surer than LEAST_POWER of its
    own scatter: torque noise of one axis alone can not make that of all.
    """
    axes = seen[0][0].shape[1]
    rows = np.vstack(
        [
            np.concatenate(
                [np.abs(g) ** 2, np.broadcast_to(np.eye(axes), g.shape)], axis=2
            ).reshape(-1, 2 * axes)
            * (4.0 / samples)
            for g, _, samples in seen
        ]
    )
    power = np.concatenate([one.ravel() for _, one, _ in seen])
    scale = np.linalg.norm(rows, axis=0)
    expected = np.maximum(power, LEAST_POWER * float(np.median(power)))
    for _ in range(rounds):
        weighted = rows / (scale * expected[:, None])
        variance = nnls(weighted, power / expected)[0] / scale
        expected = np.maximum(rows @ variance, LEAST_POWER * expected)
    std = np.sqrt(variance)
    own = np.median(np.vstack([one * (samples / 4.0) for _, one, samples in seen]), axis=0)
    least = np.maximum(np.sqrt(LEAST_POWER * own), SMALLEST)
    return Noise(torque=std[:axes], position=np.maximum(std[axes:], least))


def _fitted(
    phasors: Sequence[Phasors], prior: MachineModel, notes: list[str]
) -> RefinedModel | None:
    omega = frequencies_of(phasors)
    model, delays = prior, np.zeros(len(prior.axes))
    found: RefinedModel | None = None
    try:
        for _ in range(WEIGHTINGS):
            data = joint_spectra(phasors, machine_response(model, omega, delays))
            found = refine(
                model,
                data,
                priors=_trusted(prior),
                fit_delay=True,
                fit_friction=True,
                delays=delays.tolist(),
            )
            model, delays = found.model, found.delay_values
    except IdentificationError as error:
        notes.append(
            f"The pilot can not be explained ({error}); the plan rests on the prior model."
        )
        return None
    if found is not None and found.chi2 > POOR_FIT * found.degrees_of_freedom:
        misfit = np.sqrt(found.chi2 / found.degrees_of_freedom)
        notes.append(
            f"The pilot differs from what masses and springs explain by {misfit:.0f} times its noise; "
            "friction, or another number of masses? The plan goes on with the nearest model."
        )
    if found is not None and not _in_band(found.model, omega):
        notes.append(
            "The pilot puts modes far outside its band, so its model is not used; the plan rests on the "
            "prior model. Another number of masses than the profile says?"
        )
        return None
    return found


def _in_band(model: MachineModel, omega: FloatArray) -> bool:
    """Whether all springs' modes lie where the pilot could see them."""
    try:
        every = [one.resonances[1:] for one in spectra(model)]
    except ValueError:
        return False
    modes = np.sqrt(np.concatenate([*every, np.zeros(0)]))
    return bool(np.all((modes > omega[0] / BEYOND) & (modes < BEYOND * omega[-1])))


def _trusted(prior: MachineModel) -> dict[str, Estimate]:
    known = {}
    for axis in prior.axes:
        for kind, values in (
            ("mass", axis.masses),
            ("spring", axis.springs),
            ("damper", axis.dampers),
        ):
            for k, value in enumerate(values):
                if value.value > 0:
                    std = TRUST[kind] * value.value
                    known[f"{axis.name}.{kind}[{k + 1}]"] = Estimate(value.value, std)
    return known
