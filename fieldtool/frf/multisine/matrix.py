"""From multisine experiments under closed loops to the open-loop response matrix.

With the phasors of E >= M experiments in the columns of Theta (positions) and T (torques), whatever
the loops do to both, each line has

    Theta = G T,     G = Theta A,    A = V (T V)^-1

with V the M directions among the experiments in which they were told to differ: the leading right
singular vectors of the references, which are free of noise.  For E = M this is G = Theta T^-1.  G
is an analytic function of the measured phasors, so circular noise does not bias it as it does
Theta T^H (T T^H)^-1.  Errors in variables: an experiment's error in the equation is

    e = [I, -G] (errors of positions; of torques),    C_e = [I, -G] C [I, -G]^H

and the error of G is the sum over the experiments of e a^T, a its row of A.

Realisations (sets of M experiments) are averaged with weights by the logarithm, element by element,
where every one stands out of its noise, which leaves no bias of ratios; else linearly.  To first
order both have the same covariance.

Source: Pintelon and Schoukens, System Identification: A Frequency Domain Approach, chapters 2, 7.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.multisine.distortion import AxisDistortion, check_distortion, joint_distortion
from fieldtool.frf.multisine.inputs import joint_input, with_lines
from fieldtool.frf.multisine.lines import LinePhasors, line_phasors
from fieldtool.frf.multisine.mean import SetResponse, averaged
from fieldtool.frf.multisine.sets import (
    check_axes_excited,
    common_lines,
    experiment_sets,
    inputs_at,
)
from fieldtool.frf.phasors import ComplexArray, FloatArray, Phasors, equation_errors
from fieldtool.frf.response import FrequencyResponse
from fieldtool.records.recorded import Experiment, Recording

_ENOUGH = 3
"""Periods from which transients are told well from what repeats."""
_TOO_MUCH, _TOO_MUCH_OF_FEW = 0.3, 0.03
"""Share of transients in a signal that is worth a word, and where there are fewer periods."""
_CLEAR = 5.0
"""Weakest direction of the torques over its noise, below it a line is left out."""


@dataclass(frozen=True, eq=False)
class JointResult:
    """The response matrix and what it was made from."""

    response: FrequencyResponse
    """Condition ``solved``, at the excited lines, with covariance."""
    freedom: FloatArray
    """(F,): complex degrees of freedom behind the covariance."""
    lines: tuple[LinePhasors, ...]
    """Of each experiment, transients and folded images taken off."""
    distortion: tuple[AxisDistortion, ...]
    """Per axis and amplitude level; empty where no line was left out for detection."""
    transient: float
    """Largest share of transients in a signal where it is so large that the covariance may be too
    small, 0 otherwise."""
    notes: tuple[str, ...]
    """What a technician should know, one sentence each."""

    @property
    def phasors(self) -> tuple[Phasors, ...]:
        """Of each experiment at its excited lines."""
        return tuple(one.phasors(self.response.axes) for one in self.lines)


def joint_response(
    recording: Recording,
    experiments: Sequence[Experiment] | None = None,
    *,
    offset_sampled: float | None = None,
    offset_rows: int = 1,
) -> JointResult:
    """Return the open-loop response matrix from the multisine experiments of a recording.

    Parameters
    ----------
    recording
        M axes.
    experiments
        Those to use; None: all complete ones of kind ``multisine`` that drive an axis.
    offset_sampled, offset_rows
        When torques are sampled after a held torque offset took effect, s, and in which row it
        shows; only for recordings with ``AXIS.torque_offset`` that no low-pass follows
        (see :func:`~fieldtool.frf.held_targets.held_offset`).

    Raises
    ------
    NotEnoughDataError
        If there is no such experiment, no period, fewer than two periods, a saturated torque, an axis
        that was not excited, fewer experiments than axes, experiments that are alike, no line above
        the noise, or distortion of more than 30 %.
    """
    chosen = _chosen(recording) if experiments is None else list(experiments)
    if not chosen:
        raise NotEnoughDataError(
            "the recording has no complete multisine experiment that drives an axis: there is no "
            "response matrix to compute; measure with the fast plan, or mark the experiments' kind."
        )
    inputs = [with_lines(recording, joint_input(recording, one)) for one in chosen]
    measured = line_phasors(recording, inputs, offset_sampled, offset_rows)
    check_axes_excited(measured, recording.names)
    sets = experiment_sets(measured, recording.names)
    solved = [solve_set([measured[p] for p in members], recording.names) for members in sets]
    left_out = sum(one.left_out for one in solved)
    mean = averaged(solved, recording.names)
    distortion = joint_distortion(measured, mean.response)
    check_distortion(distortion)
    notes = (
        *_notes(left_out),
        *mean.notes,
        *(one.sentence for one in distortion if one.worth_saying),
    )
    transient = _transient(measured)
    return JointResult(mean.response, mean.freedom, tuple(measured), distortion, transient, notes)


def _chosen(recording: Recording) -> list[Experiment]:
    return [
        one
        for one in recording.experiments
        if one.kind == "multisine" and one.driven and one.complete
    ]


def _transient(measured: Sequence[LinePhasors]) -> float:
    largest = max(one.transient for one in measured)
    few = min(one.given.periods for one in measured) < _ENOUGH
    allowed = _TOO_MUCH_OF_FEW if few else _TOO_MUCH
    drifts = any(_drifts(one.given.experiment) for one in measured)
    return largest if largest > allowed and not drifts else 0.0


def _notes(left_out: int) -> list[str]:
    if not left_out:
        return []
    return [
        f"{left_out} excited lines were left out because the torques of the experiments do not "
        "stand out of the noise in every direction, or too few experiments excite them."
    ]


def _drifts(experiment: Experiment) -> bool:
    """Whether an axis ends far from where it began: a constant velocity is no transient."""
    position = experiment.position
    quarter = experiment.samples // 4
    moved = np.abs(position[-quarter:].mean(axis=0) - position[:quarter].mean(axis=0))
    swing = np.ptp(position[:quarter], axis=0) + np.ptp(position[-quarter:], axis=0)
    return bool(np.any(moved > swing))


def solve_set(members: Sequence[LinePhasors], axes: tuple[str, ...]) -> SetResponse:
    """Solve one set of E >= M experiments at every line that all, or at least M, of them excite.

    Raises
    ------
    NotEnoughDataError
        If no line is excited by M experiments, or none stands out of the noise.
    """
    M = len(axes)
    everywhere = common_lines(members, 1)
    lines = common_lines(members, M)
    rows: list[int] = []
    values, covariances, freedoms = [], [], []
    for line in lines:
        there = [one for one in members if line in one.given.lines]
        solved = _solve_line(there, int(line), M)
        if solved is not None:
            rows.append(int(line) - 1)
            values.append(solved[0])
            covariances.append(solved[1])
            freedoms.append(min(float(one.freedom[line - 1]) for one in there))
    if not rows:
        names = ", ".join(one.name for one in members)
        if M == 1:
            raise NotEnoughDataError(
                f"{names}: none of {everywhere.size} excited lines stands out of the noise, or of the "
                "encoder's counts; raise the amplitude (wider limits), or measure more periods."
            )
        raise NotEnoughDataError(
            f"experiments {names}: at none of {everywhere.size} "
            f"excited lines do {M} of them stand out of the noise in different directions; raise the "
            "amplitude, measure more periods, or drive all axes at the same lines."
        )
    return SetResponse(
        names=tuple(one.name for one in members),
        level=max(one.level for one in members),
        frequencies=max((one.frequencies for one in members), key=len)[rows],
        response=np.array(values),
        covariance=np.array(covariances),
        freedom=np.array(freedoms),
        left_out=everywhere.size - len(rows),
    )


def _solve_line(
    there: Sequence[LinePhasors], line: int, M: int
) -> tuple[ComplexArray, ComplexArray] | None:
    """Return G (M, M) and the covariance of its elements (M*M, M*M), None if noise hides it."""
    phasors = np.stack([one.mean[line - 1] for one in there], axis=1)  # (2M, E)
    noise = np.stack([one.covariance[line - 1] for one in there])  # (E, 2M, 2M)
    theta, torque = phasors[:M], phasors[M:]
    spread = np.sqrt(np.maximum(np.einsum("ekk->ek", noise).real.mean(axis=0)[M:], 1e-300))
    if np.linalg.svd(torque / spread[:, None], compute_uv=False)[M - 1] < _CLEAR:
        return None
    told = inputs_at(there, np.array([line]))[0]
    weights = np.ones(len(there))
    G, A = _weighted(theta, torque, told, weights)
    errors = equation_errors(G, noise)
    if len(there) > M:
        power = np.einsum("eii->ei", errors).real
        weights = 1 / np.mean(power / power.mean(axis=0), axis=1)
        G, A = _weighted(theta, torque, told, weights)
        errors = equation_errors(G, noise)
    covariance = np.einsum("eik,ej,el->ijkl", errors, A, A.conj()).reshape(M * M, M * M)
    return G, (covariance + covariance.conj().T) / 2


def _weighted(
    theta: ComplexArray, torque: ComplexArray, told: ComplexArray, weights: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return G and A (E, M) with G = theta A, experiments weighted by the inverse of their noise."""
    M = torque.shape[0]
    root = np.sqrt(weights)
    _, _, Vh = np.linalg.svd(told * root)
    V = root[:, None] * Vh[:M].conj().T
    A = V @ np.linalg.inv(torque @ V)
    return theta @ A, A
