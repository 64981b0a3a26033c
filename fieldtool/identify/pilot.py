"""What a short, weak measurement tells, so that the main one can be planned: noise, friction, modes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from fieldtool.errors import IdentificationError, NotEnoughDataError
from fieldtool.frf.phasors import Phasors
from fieldtool.identify.expected import Noise
from fieldtool.identify.friction_left import DryFriction, dry_friction
from fieldtool.identify.joint import phasors_of
from fieldtool.identify.joint_data import frequencies_of, joint_spectra
from fieldtool.identify.refine import RefinedModel, machine_response, refine
from fieldtool.records.model import Estimate, FloatArray, MachineModel
from fieldtool.records.recording import Experiment, Recording

TRUST = {"mass": 0.7, "spring": 0.7, "damper": 1.0}
"""Relative standard error of the machine as last accepted: new tooling changes a lot."""
WEIGHTINGS = 2
"""Fits, each weighted with the response of the one before."""
POOR_FIT = 30.0
"""Misfit over noise above which the pilot's model is not used."""
SMALLEST = 1e-12
"""rad or m: noise of a position that shows none."""
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
    experiments = [e for e in recording.experiments if e.kind == "multisine" and e.complete]
    if not experiments:
        raise NotEnoughDataError("there is no complete multisine experiment to be read as a pilot")
    phasors = phasors_of(recording, experiments)
    notes: list[str] = []
    fitted = _fitted(phasors, prior, notes)
    model = prior if fitted is None else fitted.model
    delays = np.zeros(len(prior.axes))
    if fitted is not None:
        delays = np.array([d.value for d in fitted.delays])
    noise = _noise(phasors, experiments, recording.sample_period, model, delays)
    if fitted is None:
        return PilotFindings(prior, noise, None, tuple(notes))
    band = (
        min(float(p.frequencies.min()) for p in phasors),
        max(float(p.frequencies.max()) for p in phasors),
    )
    friction = dry_friction(experiments, recording.sample_period, band, fitted.model, delays)
    for k in friction.seen(FRICTION_SEEN):
        unit = recording.axes[k].torque_unit
        one = friction.torque[k]
        notes.append(
            f"{friction.axes[k]}: dry friction of {one.value:.2g} +- {1.96 * one.std:.1g} {unit}, "
            f"{100 * friction.share[k]:.0f} % of the pilot's torque."
        )
    return PilotFindings(fitted.model, noise, friction, tuple(notes))


def measured_noise(recording: Recording, model: MachineModel) -> Noise:
    """Return the noise of single samples that a recording's multisines show.

    Raises
    ------
    NotEnoughDataError
        If there is no complete multisine, or none with two whole periods.
    """
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
    axes = len(model.axes)
    rows, sides = [], []
    for one, experiment in zip(phasors, experiments, strict=True):
        samples = round(float(experiment.period or 0.0) / sample_period)
        counted = experiment.samples // samples * samples
        response = machine_response(model, 2 * np.pi * one.frequencies, delays)
        mixing = np.concatenate([np.broadcast_to(np.eye(axes), response.shape), -response], axis=2)
        error = np.einsum("fia,fab,fib->fi", mixing, one.covariance, mixing.conj()).real
        passed = np.concatenate(
            [np.abs(response) ** 2, np.broadcast_to(np.eye(axes), response.shape)], axis=2
        )
        rows.append((passed / error[:, :, None]).reshape(-1, 2 * axes))
        sides.append(np.full(error.size, counted / 4))
    matrix = np.vstack(rows)
    scale = np.linalg.norm(matrix, axis=0)
    variance = nnls(matrix / scale, np.concatenate(sides))[0] / scale
    std = np.sqrt(variance)
    return Noise(torque=std[:axes], position=np.maximum(std[axes:], SMALLEST))


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
            model, delays = found.model, np.array([d.value for d in found.delays])
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
    return found


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
