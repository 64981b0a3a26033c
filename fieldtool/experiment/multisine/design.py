"""Design of the fast plan: which lines, how strong, how long, for one machine and its limits.

All loops stay closed and all axes move at once, so what limits one axis' excitation is what the
others pass on to it as well.  Amplitudes are chosen so that the torque of every motor is spread over
the lines by a simple rule, then one factor an axis brings each axis as near to its limits as the
others, by the prior model.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.forecast import (
    allowed_peaks,
    experiment_peaks,
    offset_response,
    scaled_to_limits,
)
from fieldtool.experiment.multisine.phases import orthogonal_phases
from fieldtool.experiment.multisine.plan import (
    MultisinePlan,
    orthogonal_experiments,
    random_odd_lines,
)
from fieldtool.experiment.stepped.design import undamped_modes
from fieldtool.records.closed_loop import AxisLoop, ComplexArray
from fieldtool.records.model import FloatArray, MachineModel

IntArray = NDArray[np.int_]
CYCLE_TIMES = (0.001, 0.002, 0.004, 0.005, 0.008, 0.01)
"""Cycle times to choose from, seconds; the shortest that fits, because every sample counts."""
CYCLES_A_PERIOD = 10
"""At the highest line, at least."""
LOW, HIGH = 0.3, 1.5
"""Lines reach from LOW times the lowest to HIGH times the highest mode or antiresonance."""
FEWEST_LINES = 8
"""Excited lines, whatever the time."""
DETECTION_SHARE = 0.2
"""Of the odd lines in the band, left out to see distortion."""
SETTLE_LINES = 0.5
"""Run-in before the periods that count, in periods of the lowest line."""
SETTLE_AT_LEAST = 0.6
"""And at least so many seconds."""
PERIODS = 2
"""Whole periods of each experiment: the least that tell noise from signal."""
MORE_PERIODS = 3
"""Where there is time: what decays is told from what repeats better than by two."""
SHARE_OF_LIMITS = 0.65
"""Of every limit that the plan may use by the model that it rests on."""
PILOT_SHARE = 0.2
"""The same for the pilot, which rests on the machine as last accepted."""
CREST = 2.5
"""Peak over root mean square that amplitudes reckon with before the plan is simulated."""
WEAK = 0.35
"""Of the largest torque at any line that a controller asks for per reference, its axis locked: where
it is less, behind its filters, a torque offset excites the axis if its drive takes one."""
BIAS_SHARE = 0.8
"""Of the travel and of the velocity limit that a bias velocity may use."""
BIAS_MARGIN = 1.2
"""Bias velocity over the excitation's largest velocity."""
LEAST_FACTOR = 0.1
"""Below it the excitation would be too weak beside what a bias velocity gains."""
BEYOND, SMOOTH = 8.0, 0.05
"""A drive takes torque offsets once a cycle.  Their steps must not reach the torque, which is sampled
at the same rate: at so many times the highest line, below the rate of the cycles, the drive's filters
may pass so much."""
LEVELLINGS = 3
"""Of simulating the plan and scaling each axis' input."""
ROUNDS = 8
"""Of bringing the axes' factors to one level."""


@dataclass(frozen=True)
class Shape:
    """How the torque is spread over the lines: by a power of the frequency."""

    slope: float
    """0: each line the same; -1: falling with the frequency."""

    def amplitudes(self, omega: FloatArray) -> FloatArray:
        """Return relative torques, shape (L,)."""
        middle = float(np.sqrt(omega[0] * omega[-1]))
        relative: FloatArray = (omega / middle) ** self.slope
        return relative


SHAPES = (Shape(-0.75), Shape(-0.5), Shape(0.0))
"""To choose from, by the accuracy to expect."""


def fast_cycle_times(model: MachineModel, shortest: float) -> tuple[float, ...]:
    """Return the cycle times that fit both the bus and the modes, the best one first.

    Raises
    ------
    PlanRefusedError
        If the modes are too fast for the bus.
    """
    needed = longest_cycle(model)
    fitting = tuple(t for t in CYCLE_TIMES if shortest - 1e-9 <= t <= needed)
    if not fitting:
        raise PlanRefusedError(
            f"the fastest mode needs a cycle of {needed * 1000:.2g} ms or less, the bus allows "
            f"{shortest * 1000:g} ms or more. Use a higher bit rate or fewer axes on the bus."
        )
    return fitting


def longest_cycle(model: MachineModel) -> float:
    """Return the longest cycle that the highest line allows, s."""
    return 1 / (CYCLES_A_PERIOD * HIGH * mode_band(model)[1])


def mode_band(model: MachineModel) -> tuple[float, float]:
    """Return the lowest and the highest resonance or antiresonance, Hz; 1 and 4 for rigid axes."""
    resonances, antiresonances = undamped_modes(model)
    every = np.concatenate([resonances, *antiresonances]) / (2 * np.pi)
    if resonances.size == 0 or every.size == 0:
        return 1.0, 4.0
    return float(every.min()), float(every.max())


def settle_time(model: MachineModel) -> float:
    """Return the seconds of run-in before the periods that count."""
    return max(SETTLE_AT_LEAST, SETTLE_LINES / (LOW * mode_band(model)[0]))


def shortest_period(model: MachineModel) -> float:
    """Return the period that has FEWEST_LINES odd lines in the band of the modes, s."""
    low, high = mode_band(model)
    return max(2 * (FEWEST_LINES - 1) / (HIGH * high - LOW * low), 1 / (2 * low))


def lines_for(
    model: MachineModel, period: float, rng: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """Return excited odd lines, and odd lines left out, over the band of a machine's modes."""
    low, high = mode_band(model)
    first = max(1, int(np.floor(LOW * low * period)) | 1)
    last = int(np.ceil(HIGH * high * period)) | 1
    return random_odd_lines(first, max(last, first + 2 * (FEWEST_LINES - 1)), DETECTION_SHARE, rng)


def experiments_for(
    setting: Setting,
    cycle_time: float,
    period: float,
    shape: Shape,
    seed: int,
    *,
    count: int | None = None,
    name: str = "fast",
    share: float = SHARE_OF_LIMITS,
    offsets: Sequence[bool] = (),
    periods: int = PERIODS,
) -> MultisinePlan:
    """Return orthogonal experiments that use this share of the limits.

    Parameters
    ----------
    setting
        Model, loops and limits that the amplitudes rest on.
    cycle_time, period
        Seconds; the period is rounded to whole cycles.
    shape
        How the torque is spread.
    seed
        Of the random lines and phases.
    count
        Only so many of the M experiments (a short pilot needs one).
    name
        Of the experiments; they are numbered.
    share
        Of every limit.
    offsets
        Which axes' drives take a torque offset; none without.
    periods
        Whole periods of each experiment.

    Raises
    ------
    PlanRefusedError
        If the loops are not stable by the model, or nothing fits the limits.
    """
    samples = max(4, round(period / cycle_time))
    lines, detection = lines_for(setting.model, samples * cycle_time, np.random.default_rng(seed))
    inputs = _inputs(setting, lines, samples * cycle_time, offsets)
    size = inputs.sizes(shape, share)
    experiments = orthogonal_experiments(
        lines,
        detection,
        np.where(inputs.by_torque, 0.0, size),
        torque=np.where(inputs.by_torque, size, 0.0).astype(np.complex128),
        cycle_time=cycle_time,
        samples=samples,
        periods=periods,
        settle=round(settle_time(setting.model) / cycle_time),
        seed=seed,
        name=name,
        weights=inputs.tightest(size),
    )
    plan = MultisinePlan(cycle_time, tuple(experiments[:count]), ())
    return scaled_to_limits(_levelled(plan, setting, share), setting, share)


def _levelled(plan: MultisinePlan, setting: Setting, share: float) -> MultisinePlan:
    """Return the plan with each axis' input scaled until its own peak is at the share of a limit."""
    for _ in range(LEVELLINGS):
        use = (experiment_peaks(plan, setting) / allowed_peaks(setting)).max(axis=(0, 1))
        factor = np.clip(share / use, 0.5, 2.0) ** 0.8
        plan = replace(
            plan,
            experiments=tuple(
                replace(one, reference=one.reference * factor, torque=one.torque * factor)
                for one in plan.experiments
            ),
        )
    return plan


def with_bias(
    plan: MultisinePlan, setting: Setting, axes: Sequence[int]
) -> tuple[MultisinePlan, float] | None:
    """Return the plan on top of constant velocities, so that these axes never reverse.

    Friction that only turns its sign with the velocity is then a constant and stays out of the
    response.  The velocities are as high as the travel allows; where the excitation is faster than
    that, it is made weaker.

    Parameters
    ----------
    plan
        Without bias.
    setting
        Its limits and its model.
    axes
        Which ones have dry friction.

    Returns
    -------
    plan, factor
        And by what the excitation was multiplied, at most 1; None where the travel leaves less than
        LEAST_FACTOR.
    """
    peaks = experiment_peaks(plan, setting).max(axis=0)  # (5, M): excursion, velocity, ...
    room = 2 * allowed_peaks(setting)[0]
    seconds = max(one.rows for one in plan.experiments) * plan.cycle_time
    chosen = list(axes)
    factor = 1.0
    for _ in range(ROUNDS):  # a weaker excitation leaves more of the travel
        highest = (BIAS_SHARE * room - 2 * factor * peaks[0])[chosen] / seconds
        fastest = BIAS_SHARE * allowed_peaks(setting)[1][chosen] - factor * peaks[1][chosen]
        highest = np.minimum(highest, fastest)
        factor = float(min(1.0, np.min(highest / (BIAS_MARGIN * peaks[1][chosen]))))
        if factor < LEAST_FACTOR:
            return None
    bias = np.zeros(len(setting.loops))
    bias[chosen] = BIAS_MARGIN * factor * peaks[1][chosen]
    signs = (1, -1)  # to and fro, so that the axis ends about where it began
    experiments = tuple(
        replace(one.scaled(factor), bias=signs[k % 2] * bias)
        for k, one in enumerate(plan.experiments)
    )
    return replace(plan, experiments=experiments), factor


def likely_torques(
    setting: Setting,
    period: float,
    shape: Shape,
    seed: int,
    *,
    share: float = SHARE_OF_LIMITS,
    offsets: Sequence[bool] = (),
) -> tuple[FloatArray, tuple[ComplexArray, ...]]:
    """Return what :func:`experiments_for` comes near to, without the work on phases.

    Returns
    -------
    omega, torques
        Lines (L,), rad/s, and the motors' torque phasors (L, M) in each of the M experiments.
    """
    lines, _ = lines_for(setting.model, period, np.random.default_rng(seed))
    inputs = _inputs(setting, lines, period, offsets)
    size = inputs.sizes(shape, share)
    mixing = orthogonal_phases(size.shape[1], size.shape[1])
    torques = tuple(
        np.einsum("lij,lj->li", inputs.torque, size * mixing[:, e]) for e in range(size.shape[1])
    )
    return inputs.omega, torques


def smooth(loop: AxisLoop, omega: float) -> bool:
    """Return whether a drive's filters leave nothing of steps that come at this rate, rad/s."""
    return abs(loop.torque_shape(1j * omega)) < SMOOTH


def _inputs(
    setting: Setting, lines: NDArray[np.int64], period: float, offsets: Sequence[bool]
) -> "_Inputs":
    """Choose how each axis is excited at each line, and what a unit of that does."""
    loop = setting.closed_loop(())
    axes = len(setting.loops)
    offsets = offsets or (False,) * axes
    omega = (2 * np.pi / period * lines).astype(np.float64)
    shape = (omega.size, axes, axes)
    position, torque = np.zeros(shape, np.complex128), np.zeros(shape, np.complex128)
    by_torque = np.zeros((omega.size, axes), dtype=np.bool_)
    for k in range(axes):
        position[:, :, k], torque[:, :, k] = loop.response(omega, k)
        if offsets[k] and smooth(setting.loops[k], BEYOND * omega[-1]):
            passed = np.abs([setting.loops[k].gain_of_reference(1j * w) for w in omega])
            by_torque[:, k] = passed < WEAK * passed.max()
            unit = np.zeros((omega.size, axes), dtype=np.complex128)
            unit[:, k] = 1.0
            moved, pushed = offset_response(loop, omega, unit)
            there = by_torque[:, k]
            position[there, :, k], torque[there, :, k] = moved[there], pushed[there]
    return _Inputs(setting, omega, by_torque, position, torque)


@dataclass(frozen=True, eq=False)
class _Inputs:
    """What a unit input of each axis does at each line, by the model."""

    setting: Setting
    omega: FloatArray
    by_torque: NDArray[np.bool_]
    """Where the input is a torque offset and not a position reference, (L, M)."""
    position: ComplexArray
    """(L, M motors, M inputs)."""
    torque: ComplexArray
    """(L, M motors, M inputs)."""

    def sizes(self, shape: Shape, share: float) -> FloatArray:
        """Return inputs (L, M): torques by the shape, all axes equally near to their limits."""
        own = np.abs(np.einsum("lkk->lk", self.torque))
        size: FloatArray = shape.amplitudes(self.omega)[:, None] / own
        for _ in range(ROUNDS):
            use = self._use(size).max(axis=0)
            size = size * np.clip(share / use, 0.25, 4.0) ** 0.7
        return size

    def tightest(self, size: FloatArray) -> ComplexArray:
        """Return each axis' output that is nearest to its limit, for a unit input, (L, M, M)."""
        chosen = self._use(size).argmax(axis=0)
        outputs = self._outputs()
        columns = [outputs[q][:, k, :] for k, q in enumerate(chosen)]
        weights: ComplexArray = np.stack(columns, axis=2)
        return weights

    def _outputs(self) -> ComplexArray:
        """All that has a limit, as a share of it, for a unit input: (5, L, M motors, M inputs)."""
        w = self.omega[:, None, None]
        limits, centre = self.setting.limits, self.setting.centre
        room = [
            min(c - one.travel[0], one.travel[1] - c) for c, one in zip(centre, limits, strict=True)
        ]

        def of(values: Sequence[float]) -> FloatArray:
            return np.array(values)[None, :, None]

        reference = np.eye(len(limits)) * ~self.by_torque[:, None, :]
        outputs: ComplexArray = np.stack(
            [
                self.position / of(room),
                self.position * w / of([one.velocity for one in limits]),
                self.position * w**2 / of([one.acceleration for one in limits]),
                self.torque / of([one.torque for one in limits]),
                (reference - self.position) / of([one.following_error for one in limits]),
            ]
        )
        return outputs

    def _use(self, size: FloatArray) -> FloatArray:
        """Return the share of each limit that each axis uses, shape (5, M).

        Orthogonal experiments share out each input's power: on average an axis moves by the root
        sum of squares of what all inputs pass on to it.
        """
        power = np.sum(np.abs(self._outputs() * size[None, :, None, :]) ** 2, axis=(1, 3))
        use: FloatArray = CREST * np.sqrt(power / 2)
        return use
