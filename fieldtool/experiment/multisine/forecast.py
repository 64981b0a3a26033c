"""What the fast plan will do to the machine, by simulation with a model, before anything moves."""

from dataclasses import replace

import numpy as np

from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.forecast import AxisForecast, Setting, check_peaks, largest_values
from fieldtool.experiment.multisine.excitation import Excitation
from fieldtool.experiment.multisine.plan import MultisineExperiment, MultisinePlan
from fieldtool.records.closed_loop import ClosedLoop, ComplexArray
from fieldtool.records.model import FloatArray

SIMULATED_PERIODS = 2
"""Of each experiment without bias velocity; transients have their largest values before that."""
_WHAT = ("excursion", "velocity", "acceleration", "torque", "following error")
TORQUE, FOLLOWING_ERROR = _WHAT.index("torque"), _WHAT.index("following error")
"""Rows of an experiment's peaks."""


def forecast_multisine(plan: MultisinePlan, setting: Setting) -> tuple[AxisForecast, ...]:
    """Simulate every experiment, one after the other as they are run; return each axis' peaks.

    Raises
    ------
    PlanRefusedError
        If a limit would be left, or the loops are not stable with the model: naming experiment,
        axis, value and limit.
    """
    peaks = experiment_peaks(plan, setting)
    for experiment, found in zip(plan.experiments, peaks, strict=True):
        check_peaks(f"experiment {experiment.name}", found, setting)
    highest = peaks.max(axis=0)
    return tuple(
        AxisForecast(axis.name, axis.kind, *(float(v) for v in highest[:, k]))
        for k, axis in enumerate(setting.model.axes)
    )


def experiment_peaks(plan: MultisinePlan, setting: Setting) -> FloatArray:
    """Return the largest values of every experiment, shape (E, 5, M), SI.

    Excursion from the centre (of the axis or its reference, whichever is larger), velocity,
    acceleration, torque (of the motor or its offset), following error.

    Raises
    ------
    PlanRefusedError
        If the loops are not stable with the model.
    """
    loop = _stable_loop(setting)
    found = [p for row in plan.streams for p in _Stream(row, row, loop).peaks()]
    return np.array(found)


def scaled_to_limits(plan: MultisinePlan, setting: Setting, share: float) -> MultisinePlan:
    """Return the plan with all phasors multiplied so that it just keeps a share of every limit.

    Bias velocities stay; what they take of a limit is reckoned as if both had their peaks at the
    same time.

    Parameters
    ----------
    plan
        Its phasors may have any size.
    setting
        Model, loops, limits and centres.
    share
        Of every limit, above 0, at most 1.

    Raises
    ------
    PlanRefusedError
        If the loops are not stable with the model, or the bias velocities alone take that share.
    """
    if not 0 < share <= 1:
        raise ValueError(f"the share of the limits must be above 0 and at most 1, got {share:g}")
    loop = _stable_loop(setting)
    allowed = share * allowed_peaks(setting)
    factor = np.inf
    for row in plan.streams:
        still = tuple(replace(one, bias=np.zeros(one.axes)) for one in row)
        swings = _Stream(still, row, loop)
        biased = _Stream(row, row, loop).without(swings) if row[0].biased else None
        for k, moved in enumerate(swings.peaks()):
            taken = np.zeros_like(allowed) if biased is None else biased.peaks()[k]
            if np.any(taken >= allowed):
                raise _bias_too_fast(row[k], taken, allowed, setting)
            with np.errstate(divide="ignore"):
                factor = min(factor, float(np.min((allowed - taken) / moved)))
    return plan.scaled(factor)


def predicted_phasors(
    experiment: MultisineExperiment, setting: Setting
) -> tuple[ComplexArray, ComplexArray]:
    """Return the motors' positions and torques at steady state, by the model.

    Returns
    -------
    position, torque
        Peak phasors at the excited lines, shape (L, M) each, phase counted from the start of a
        period.  The time that targets take through the bus and the drives is left out.
    """
    loop = setting.closed_loop(())
    omega = 2 * np.pi * experiment.frequencies
    position = np.zeros(experiment.reference.shape, dtype=np.complex128)
    torque = np.zeros_like(position)
    for axis in range(experiment.axes):
        moved, pushed = loop.response(omega, axis)
        position += moved * experiment.reference[:, axis, None]
        torque += pushed * experiment.reference[:, axis, None]
    if np.any(experiment.torque):
        moved, pushed = offset_response(loop, omega, experiment.torque)
        position += moved
        torque += pushed
    return position, torque


def offset_response(
    loop: ClosedLoop, omega: FloatArray, offset: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return positions and torques that torque offsets (L, M) cause at omega, shape (L, M) each."""
    model, motors = loop.model, loop.model.first_masses
    position, torque = np.zeros_like(offset), np.zeros_like(offset)
    for k, s in enumerate(1j * omega):
        held = [(j, axis) for j, axis in enumerate(loop.loops) if axis is not None]
        gain, push = np.zeros(len(motors), complex), np.zeros(len(motors), complex)
        for j, axis in held:
            gain[j] = axis.gain(s)
            push[j] = axis.torque_shape(s) * offset[k, j]
        dynamic = model.stiffness_matrix + s * model.damping_matrix + s * s * model.mass_matrix
        dynamic[motors, motors] += gain
        load = np.zeros(dynamic.shape[0], complex)
        load[motors] = push
        position[k] = np.linalg.solve(dynamic, load)[motors]
        torque[k] = push - gain * position[k]
    return position, torque


class _Stream:
    """Experiments that follow each other without a pause, simulated.

    ``like`` are the experiments as planned: how many periods are simulated depends on their bias.
    """

    def __init__(
        self,
        row: tuple[MultisineExperiment, ...],
        like: tuple[MultisineExperiment, ...],
        loop: ClosedLoop,
    ) -> None:
        if not like[0].biased:
            row = tuple(replace(one, periods=min(one.periods, SIMULATED_PERIODS)) for one in row)
        self._step = row[0].cycle_time
        self._begins = np.concatenate([[0], np.cumsum([one.rows for one in row])]).tolist()
        rows = self._begins[-1] + row[-1].fade + 1
        self._begins[-1] = rows
        start = row[0].start
        self._references = np.zeros((rows, row[0].axes))
        self._offsets = np.zeros_like(self._references)
        for one, following, begin in zip(row, (*row[1:], row[-1]), self._begins, strict=False):
            count = min(one.rows + one.fade + 1, rows - begin)
            fade_out = min(one.fade, following.fade)  # it is over when the next one's periods begin
            excitation = Excitation.of(one).ending_at(one.rows, fade_out)
            self._references[begin : begin + count] += (
                excitation.displacements(0, count) - one.start
            )
            self._offsets[begin : begin + count] += excitation.torques(0, count)
        offsets = self._offsets if np.any(self._offsets) else None
        self._position, self._torque = loop.simulate(self._references, self._step, offsets)
        self._references += start
        self._position += start

    def without(self, other: "_Stream") -> "_Stream":
        """Return what is left of the motion when another one is taken away from it."""
        rest = object.__new__(_Stream)
        rest._step, rest._begins = self._step, self._begins
        rest._references = self._references - other._references
        rest._offsets = self._offsets - other._offsets
        rest._position = self._position - other._position
        rest._torque = self._torque - other._torque
        return rest

    def peaks(self) -> list[FloatArray]:
        """Return each experiment's largest values, shape (5, M)."""
        every = np.ones(self._references.shape[1], dtype=np.bool_)
        found = []
        for first, stop in zip(self._begins[:-1], self._begins[1:], strict=True):
            part = slice(first, stop)
            references, offsets = self._references[part], self._offsets[part]
            peaks = largest_values(
                references, self._position[part], self._torque[part], self._step, every
            )
            peaks[0] = np.maximum(peaks[0], np.abs(references).max(axis=0))
            peaks[3] = np.maximum(peaks[3], np.abs(offsets).max(axis=0))
            found.append(peaks)
        return found


def _stable_loop(setting: Setting) -> ClosedLoop:
    loop = setting.closed_loop(())
    if not loop.stable:
        raise PlanRefusedError(
            "multisine plan: with the model at hand and the gains in the drives the loops are not "
            "stable. Nothing of it was moved. Check the prior model in the machine profile and the "
            "drives' gains."
        )
    return loop


def allowed_peaks(setting: Setting) -> FloatArray:
    """Return what the peaks have to stay below, shape (5, M)."""
    return np.array(
        [
            (
                min(centre - one.travel[0], one.travel[1] - centre),
                one.velocity,
                one.acceleration,
                one.torque,
                one.following_error,
            )
            for one, centre in zip(setting.limits, setting.centre, strict=True)
        ]
    ).T


def _bias_too_fast(
    experiment: MultisineExperiment, taken: FloatArray, allowed: FloatArray, setting: Setting
) -> PlanRefusedError:
    what, k = np.unravel_index(int(np.argmax(taken / allowed)), taken.shape)
    rotary = setting.model.axes[k].kind == "rotary"
    length, force = ("rad", "N m") if rotary else ("m", "N")
    unit = (length, f"{length}/s", f"{length}/s2", force, length)[what]
    return PlanRefusedError(
        f"experiment {experiment.name}: the bias velocity of "
        f"{experiment.bias[k]:.4g} {length}/s of {setting.model.names[k]} alone comes to a "
        f"{_WHAT[what]} of {taken[what, k]:.4g} {unit}, {allowed[what, k]:.4g} {unit} are allowed for "
        "all. Nothing of it was moved. Plan a smaller bias velocity or fewer periods."
    )
