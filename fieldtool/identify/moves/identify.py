"""Identify a machine from moves, or from whatever else was recorded that has no period.

Start values come from a prior model; else a rigid machine's from least squares of the torque on
acceleration, velocity, its sign and a constant (inverse dynamics, all of them filtered alike), and an
elastic machine's from the local polynomial method, modes and order reduction.  Then maximum
likelihood on the spectra of the whole records, with Coulomb friction and an offset of the torque
beside the machine.

The noise of the torque is one level for all lines, found from the misfit.  The standard errors rest
on what the misfit does in one stretch of time after the other, on how far the result moves when
friction turns over in half or twice the velocity, and on what the torque may do between the samples.
They say how well the data determine this model, not what an effect outside of it would change.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from fieldtool.errors import IdentificationError, NotEnoughDataError
from fieldtool.frf.local import local_response
from fieldtool.frf.response import FrequencyResponse
from fieldtool.identify.chains.modal_chain import reduce_modes
from fieldtool.identify.likelihood.least_squares import standard_errors
from fieldtool.identify.likelihood.refine import RefinedModel
from fieldtool.identify.likelihood.response_data import matrix_of
from fieldtool.identify.modes.fit import fit_modes
from fieldtool.identify.moves.motion_spectra import (
    Motion,
    reweighted,
    spectra_of,
    usable_motions,
)
from fieldtool.identify.moves.record_spectra import Spectra
from fieldtool.identify.moves.spectra import refine_spectra, torque_residuals
from fieldtool.records.model import AxisModel, Coupling, Estimate, Kind, MachineModel
from fieldtool.records.recording import Experiment, Recording
from fieldtool.records.same_axes import axes_differ

FloatArray = NDArray[np.float64]
STEPS = 3
"""Times the level of noise is taken from the misfit."""
DELAY = (1.0, 5.0)
"""What is known of a delay beforehand, in samples: value and standard error."""
SIGNIFICANT = 2.0
"""Standard errors from which a friction is told from none."""
ROUNDINGS = (0.0005, 0.0015, 0.005, 0.01, 0.02)
"""Shares of the fastest velocity within which friction may turn over, to be tried."""
START_SHARE = 0.05
"""Of the response: model error reckoned with while start values are sought."""
POORLY_EXPLAINED = 0.1
"""Share of the torque that is left, from which it is said that the model is not the whole story."""


@dataclass(frozen=True, eq=False)
class MovesResult:
    """A machine identified from moves."""

    model: MachineModel
    """With standard errors; friction and delay are among its effects."""
    notes: tuple[str, ...]
    response: FrequencyResponse | None
    """From the local polynomial method, where the start values came from it."""
    refined: RefinedModel
    left: tuple[float, ...]
    """Per axis, RMS of the torque that is not explained over RMS of the torque, in the band."""
    band: tuple[float, float]
    """Lowest and highest line used, Hz."""
    experiments: tuple[str, ...]
    """Records used."""


def identify_moves(
    recording: Recording,
    masses: Mapping[str, int],
    kinds: Mapping[str, Kind] | None = None,
    prior: MachineModel | None = None,
    experiments: Sequence[Experiment] | None = None,
) -> MovesResult:
    """Identify a machine from records of moves, noise, or anything else without a period.

    Parameters
    ----------
    recording
        All its experiments are used, each with its own initial state, unless some are given.
    masses
        Chain length by axis, of every axis.
    kinds
        Rotary or linear by axis; the recording's own where not given.
    prior
        A model of the same axes and chain lengths to start from.
    experiments
        Of the recording, to be used.

    Raises
    ------
    NotEnoughDataError
        If an axis never moves, records are too short, torque is at its limit, or an axis' torque is
        not independent of the others'.
    IdentificationError
        If the data contradict a machine of such chains.
    """
    chosen = recording.experiments if experiments is None else tuple(experiments)
    motions = usable_motions(recording, chosen)
    lengths = {name: masses[name] for name in recording.names}
    kind_of = {axis.name: axis.kind for axis in recording.axes} | dict(kinds or {})
    start, response = _start(recording, motions, lengths, kind_of, prior)
    gate = list(lengths.values()) == [1]
    refined, blocks = _fitted(recording, motions, start, gate)
    left = _left(refined, blocks)
    lines = np.concatenate([block.omega for block in blocks]) / (2 * np.pi)
    return MovesResult(
        model=replace(refined.model, effects=(*refined.model.effects, *_delays(refined))),
        notes=_notes(recording, refined, left),
        response=response,
        refined=refined,
        left=left,
        band=(float(lines.min()), float(lines.max())),
        experiments=tuple(motion.experiment.name for motion in motions),
    )


def _start(
    recording: Recording,
    motions: Sequence[Motion],
    lengths: Mapping[str, int],
    kinds: Mapping[str, Kind],
    prior: MachineModel | None,
) -> tuple[MachineModel, FrequencyResponse | None]:
    if prior is not None:
        if differ := axes_differ(prior.axes, "the recording", recording.axes):
            raise NotEnoughDataError(f"the prior model {differ}.")
        if all(len(axis.masses) == lengths[axis.name] for axis in prior.axes):
            return replace(prior, effects=()), None
    if set(lengths.values()) == {1}:
        return _rigid_start(recording, motions, kinds), None
    response = local_response(recording, [motion.experiment for motion in motions])
    return _elastic_start(response, lengths, kinds), response


def _elastic_start(
    response: FrequencyResponse, lengths: Mapping[str, int], kinds: Mapping[str, Kind]
) -> MachineModel:
    """Build start values from modes and order reduction."""
    data = matrix_of(response, START_SHARE)
    modes = sum(lengths.values()) - len(lengths)
    try:
        modal = fit_modes(data, modes, fit_friction=True, fit_delay=True)
        return reduce_modes(modal, lengths, kinds).model
    except IdentificationError as error:
        raise type(error)(
            f"the records give no start values: {error} A prior model of the machine, or the "
            "excitation of `fieldtool measure`, helps where moves excite the modes too little."
        ) from error


def _rigid_start(
    recording: Recording, motions: Sequence[Motion], kinds: Mapping[str, Kind]
) -> MachineModel:
    """Least squares of the torques on accelerations, velocity, its sign and a constant."""
    M, step = len(recording.names), recording.sample_period
    mass = np.zeros((M, M))
    viscous = np.zeros(M)
    sections = butter(4, 0.06, output="sos")  # 3 % of the sample rate
    for i in range(M):
        rows, sides = [], []
        for motion in motions:
            experiment = motion.experiment
            speed = np.gradient(experiment.position, axis=0) / step
            columns = np.column_stack([np.gradient(speed, axis=0) / step, speed[:, i]])
            columns = np.column_stack(
                [columns, np.sign(motion.velocity[:, i]), np.ones(len(speed))]
            )
            columns *= motion.moving[:, [i]] if M == 1 else 1.0
            side = experiment.torque[:, i] * (motion.moving[:, i] if M == 1 else 1.0)
            rows.append(sosfiltfilt(sections, columns, axis=0))
            sides.append(sosfiltfilt(sections, side))
        matrix, side = np.vstack(rows), np.concatenate(sides)
        scale = np.linalg.norm(matrix, axis=0)
        scale[scale == 0.0] = 1.0
        solved = np.linalg.lstsq(matrix / scale, side, rcond=1e-9)[0] / scale
        mass[i], viscous[i] = solved[:M], max(0.0, float(solved[M]))
    mass = (mass + mass.T) / 2.0
    names = recording.names
    for i in np.flatnonzero(~(np.diag(mass) > 0.0)).tolist():
        raise NotEnoughDataError(
            f"axis {names[i]}: its torque does not accelerate it (its mass would be {mass[i, i]:.3g}): "
            "check the signs and units of torque and position, and record livelier moves."
        )
    axes = tuple(
        AxisModel(name, kinds[name], (Estimate(float(m)),), (), (), Estimate(float(f)))
        for name, m, f in zip(names, np.diag(mass), viscous, strict=True)
    )
    most = 0.9 / max(M - 1, 1)
    couplings = tuple(
        Coupling((names[i], names[j]), float(np.clip(mass[i, j], -limit, limit)))
        for i, j in combinations(range(M), 2)
        for limit in [most * float(np.sqrt(mass[i, i] * mass[j, j]))]
    )
    return MachineModel(axes, couplings)


def _fitted(
    recording: Recording, motions: Sequence[Motion], start: MachineModel, gate: bool
) -> tuple[RefinedModel, tuple[Spectra, ...]]:
    """Fit with the level of noise that the misfit shows, frictions that are none left out."""
    blocks = spectra_of(recording, motions, gate=gate)
    fixed: set[str] = set()
    found, blocks = _converged(start, blocks, recording.sample_period, fixed, None)
    none = _no_friction(found)
    if none:
        fixed |= none
        found, blocks = _converged(
            _at_zero(found.model, none), blocks, recording.sample_period, fixed, found
        )
    shifts: list[Mapping[str, float]] = []
    step = recording.sample_period
    if any(name.endswith("coulomb_friction") for name in found.names):
        found, blocks, shift = _turned(recording, motions, found, blocks, fixed, gate)
        shifts.append(shift)
    shifts.append(_between_samples(found, blocks, step, fixed))
    start = replace(found.model, effects=())
    return _fit(start, blocks, step, fixed, found, robust=True, shifts=shifts), blocks


def _converged(
    start: MachineModel,
    blocks: tuple[Spectra, ...],
    step: float,
    fixed: set[str],
    before: RefinedModel | None,
) -> tuple[RefinedModel, tuple[Spectra, ...]]:
    found = before
    for turn in range(STEPS):
        found = _fit(start, blocks, step, fixed, found, robust=turn == STEPS - 1)
        start = replace(found.model, effects=())
        if turn < STEPS - 1:
            freedom = found.degrees_of_freedom / sum(block.count for block in blocks)
            left = torque_residuals(found, blocks)
            blocks = tuple(
                reweighted(block, one, freedom) for block, one in zip(blocks, left, strict=True)
            )
    if found is None:
        raise ValueError("at least one step is needed")
    return found, blocks


def _fit(
    start: MachineModel,
    blocks: Sequence[Spectra],
    step: float,
    fixed: set[str],
    before: RefinedModel | None,
    *,
    robust: bool,
    shifts: Sequence[Mapping[str, float]] = (),
) -> RefinedModel:
    value, std = (samples * step for samples in DELAY)
    priors = {f"{name}.delay": Estimate(value, std) for name in start.names}
    delays = [value] * len(start.names)
    if before is not None:
        delays = [delay.value for delay in before.delays]
        known = dict(zip(before.names, before.values.tolist(), strict=True))
        blocks = [
            replace(
                block,
                parts=tuple(
                    replace(part, start=0.0 if part.name in fixed else known.get(part.name, 0.0))
                    for part in block.parts
                ),
            )
            for block in blocks
        ]
    return refine_spectra(
        start,
        blocks,
        fixed=fixed,
        priors=priors,
        fit_delay=True,
        fit_friction=True,
        delays=delays,
        robust=robust,
        shifts=shifts,
    )


def _no_friction(found: RefinedModel) -> set[str]:
    """Return the frictions that can not be told from none, or come out negative."""
    std = standard_errors(found.covariance)
    return {
        name
        for name, value, error in zip(found.names, found.values, std, strict=True)
        if name.endswith(("coulomb_friction", "viscous_friction"))
        and not value > SIGNIFICANT * error
    }


def _at_zero(model: MachineModel, none: set[str]) -> MachineModel:
    axes = tuple(
        replace(axis, viscous_friction=Estimate(0.0))
        if f"{axis.name}.viscous_friction" in none
        else axis
        for axis in model.axes
    )
    return replace(model, axes=axes, effects=())


def _turned(
    recording: Recording,
    motions: Sequence[Motion],
    found: RefinedModel,
    blocks: tuple[Spectra, ...],
    fixed: set[str],
    gate: bool,
) -> tuple[RefinedModel, tuple[Spectra, ...], Mapping[str, float]]:
    """Choose the velocity at which friction turns over by the misfit.

    Also says what half or twice this velocity does to the result.
    """
    start = replace(found.model, effects=())

    def at(rounding: float) -> tuple[RefinedModel, tuple[Spectra, ...]]:
        turned = spectra_of(recording, motions, gate=gate, rounding=rounding)
        same = tuple(
            replace(other, torque_variance=block.torque_variance)
            for other, block in zip(turned, blocks, strict=True)
        )
        return _fit(start, same, recording.sample_period, fixed, found, robust=False), same

    tried = {rounding: at(rounding) for rounding in ROUNDINGS}
    best = min(tried, key=lambda rounding: tried[rounding][0].chi2)
    ends = [(tried.get(end) or at(end))[0].values for end in (best / 2, best * 2)]
    shift = ((ends[1] - ends[0]) / 2.0).tolist()
    return *tried[best], dict(zip(found.names, shift, strict=True))


def _between_samples(
    found: RefinedModel, blocks: Sequence[Spectra], step: float, fixed: set[str]
) -> Mapping[str, float]:
    """Say what a torque that is held over each sample does to the result, but for its delay.

    It acts on a mass like a smooth one that is weaker by (w Ts)**2 / 24.
    """
    held = [
        replace(block, torque=block.torque * (1.0 - (block.omega * step) ** 2 / 24.0)[:, None])
        for block in blocks
    ]
    start = replace(found.model, effects=())
    fitted = _fit(start, held, step, fixed, found, robust=False)
    return dict(zip(found.names, (fitted.values - found.values).tolist(), strict=True))


def _left(found: RefinedModel, blocks: Sequence[Spectra]) -> tuple[float, ...]:
    residuals = torque_residuals(found, blocks)
    lost = sum(np.sum(np.abs(one.residual) ** 2, axis=(0, 1)) for one in residuals)
    whole = sum(np.sum(np.abs(block.torque) ** 2, axis=(0, 1)) for block in blocks)
    return tuple(np.sqrt(lost / np.maximum(whole, np.finfo(float).tiny)).tolist())


def _delays(found: RefinedModel) -> list[Mapping[str, object]]:
    """The delays as effects, as ``model.yaml`` has them."""
    return [
        {
            "effect": "measurement_delay",
            "axis": name,
            "parameters": {"delay": {"value": delay.value, "std": delay.std, "unit": "s"}},
        }
        for name, delay in zip(found.model.names, found.delays, strict=True)
    ]


def _notes(recording: Recording, found: RefinedModel, left: Sequence[float]) -> tuple[str, ...]:
    notes = [unknown.reason for unknown in found.unknown]
    for axis, share in zip(recording.axes, left, strict=True):
        if share > POORLY_EXPLAINED:
            notes.append(
                f"axis {axis.name}: {100 * share:.0f} % of the torque is not explained by the model, "
                "its friction and an offset; the criticism of the model says more."
            )
    rubbing = [n for n in found.model.names if f"{n}.coulomb_friction" in found.names]
    if rubbing:
        notes.append(
            f"{', '.join(rubbing)}: the velocity at which friction turns over is known to a factor of "
            "two only, and the standard errors count with it."
        )
    return tuple(notes)
