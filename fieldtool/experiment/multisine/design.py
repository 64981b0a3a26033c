"""Design of the fast plan: which lines, how strong, how long, for one machine and its limits.

All loops stay closed and all axes move at once, so what limits one axis' excitation is what the
others pass on to it as well.  A spread (see ``unit_inputs``) chooses the inputs of all axes at all
lines so that they just use a share of the limits; the plan is simulated with the model that it rests
on, and spread anew by the peaks that it really has.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.forecast import (
    allowed_peaks,
    experiment_peaks,
    scaled_to_limits,
)
from fieldtool.experiment.multisine.phases import orthogonal_phases
from fieldtool.experiment.multisine.plan import (
    Lines,
    MultisinePlan,
    least_needed_out,
    orthogonal_experiments,
    random_odd_lines,
)
from fieldtool.experiment.multisine.unit_inputs import CREST, Spread, unit_inputs
from fieldtool.experiment.stepped.design import undamped_modes
from fieldtool.records.closed_loop import ComplexArray
from fieldtool.records.model import FloatArray, MachineModel

CYCLE_TIMES = (0.001, 0.002, 0.004, 0.005, 0.008, 0.01)
"""Cycle times to choose from, seconds; the shortest that fits, because every sample counts."""
ROUND = 0.04
"""Seconds: a whole number of each of these cycles."""
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
BIAS_SHARE = 0.8
"""Of the limits that an excitation with a bias velocity may use."""
BIAS_MARGIN = 1.2
"""Bias velocity over the excitation's largest velocity."""
LEAST_FACTOR = 0.1
"""Below it the excitation would be too weak beside what a bias velocity gains."""
PHASINGS = 2
"""Of choosing phases for the outputs that are near to a limit."""
LEVELLINGS = 3
"""Of simulating the plan and spreading its inputs anew."""
ROUNDS = 8
"""Of finding the largest excitation beside a bias velocity."""


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
            f"the fastest mode needs a cycle of {needed * 1000:.3g} ms or less, the bus allows "
            f"{shortest * 1000:g} ms or more. Use a higher bit rate, fewer axes on the bus, or a "
            "smaller `shortest_cycle` in the machine profile."
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
    """Return the seconds of run-in before the periods that count, a whole number of ROUND."""
    seconds = max(SETTLE_AT_LEAST, SETTLE_LINES / (LOW * mode_band(model)[0]))
    return ROUND * float(np.ceil(seconds / ROUND - 1e-9))


def shortest_period(model: MachineModel) -> float:
    """Return the period that has FEWEST_LINES odd lines in the band of the modes, s."""
    low, high = mode_band(model)
    return max(2 * (FEWEST_LINES - 1) / (HIGH * high - LOW * low), 1 / (2 * low))


def lines_for(model: MachineModel, period: float, rng: np.random.Generator) -> Lines:
    """Return excited odd lines, and odd lines left out, over the band of a machine's modes."""
    return random_odd_lines(*_band(model, period), DETECTION_SHARE, rng)


def telling_lines(
    setting: Setting, period: float, spread: Spread, offsets: Sequence[bool] = ()
) -> Lines:
    """Return excited odd lines, and odd lines left out: of each group the one that is needed least.

    Where a spread puts its power depends on what it is after; the line of a group with the least
    power is left out.
    """
    first, last = _band(setting.model, period)
    odd = np.arange(first, last + 1, 2, dtype=np.int_)
    inputs = unit_inputs(setting, odd, period, offsets)
    size = spread(inputs).sizes(SHARE_OF_LIMITS, np.full((5, len(setting.loops)), CREST))
    taken = np.einsum("qlij,lj->l", inputs.power, size**2)
    return least_needed_out(odd, taken, DETECTION_SHARE)


def _band(model: MachineModel, period: float) -> tuple[int, int]:
    """First and last odd line of the band of a machine's modes."""
    low, high = mode_band(model)
    first = max(1, int(np.floor(LOW * low * period)) | 1)
    last = int(np.ceil(HIGH * high * period)) | 1
    return first, max(last, first + 2 * (FEWEST_LINES - 1))


def experiments_for(
    setting: Setting,
    cycle_time: float,
    period: float,
    spread: Spread,
    seed: int,
    *,
    count: int | None = None,
    name: str = "fast",
    share: float = SHARE_OF_LIMITS,
    offsets: Sequence[bool] = (),
    periods: int = PERIODS,
    lines: Lines | None = None,
) -> MultisinePlan:
    """Return orthogonal experiments that use this share of the limits.

    Parameters
    ----------
    setting
        Model, loops and limits that the amplitudes rest on.
    cycle_time, period
        Seconds; the period is rounded to whole cycles.
    spread
        How the inputs are spread over axes and lines.
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
    lines
        Excited ones and those left out; random ones without.

    Raises
    ------
    PlanRefusedError
        If the loops are not stable by the model, or nothing fits the limits.
    """
    samples = max(4, round(period / cycle_time))
    excited, detection = lines or lines_for(
        setting.model, samples * cycle_time, np.random.default_rng(seed)
    )
    inputs = unit_inputs(setting, excited, samples * cycle_time, offsets)
    spreading = spread(inputs)
    crest = np.full((5, inputs.by_torque.shape[1]), CREST)
    size = spreading.sizes(share, crest)
    found: list[tuple[float, MultisinePlan]] = []
    for _ in range(PHASINGS):
        experiments = orthogonal_experiments(
            excited,
            detection,
            np.where(inputs.by_torque, 0.0, size),
            torque=np.where(inputs.by_torque, size, 0.0).astype(np.complex128),
            cycle_time=cycle_time,
            samples=samples,
            periods=periods,
            settle=round(settle_time(setting.model) / cycle_time),
            seed=seed,
            name=name,
            weights=inputs.tightest(size, crest),
        )
        plan = MultisinePlan(cycle_time, tuple(experiments[:count]), ())
        for _ in range(LEVELLINGS):  # by the crest factors that these phases have
            use = (experiment_peaks(plan, setting) / allowed_peaks(setting)).max(axis=0)
            fitting = share / float(use.max())
            found.append((spreading.loss(fitting * size), plan.scaled(fitting)))
            level = inputs.use(size, np.ones_like(crest))
            there = level > 0
            crest[there] = np.sqrt(crest[there] * use[there] / level[there])
            new = spreading.sizes(share, crest)
            plan, size = _resized(plan, new / size), new
    return scaled_to_limits(min(found, key=lambda one: one[0])[1], setting, share)


def _resized(plan: MultisinePlan, factor: FloatArray) -> MultisinePlan:
    """Return the plan with each line of each axis' input multiplied, (L, M)."""
    experiments = tuple(
        replace(one, reference=one.reference * factor, torque=one.torque * factor)
        for one in plan.experiments
    )
    return replace(plan, experiments=experiments)


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
    biased = _biased(plan, factor, peaks[1], chosen)
    use = float((experiment_peaks(biased, setting) / allowed_peaks(setting)).max())
    if use > BIAS_SHARE:  # of following error or torque: all of them grow with the factor
        factor *= BIAS_SHARE / use
        biased = _biased(plan, factor, peaks[1], chosen)
    return (biased, factor) if factor >= LEAST_FACTOR else None


def _biased(
    plan: MultisinePlan, factor: float, fastest: FloatArray, axes: Sequence[int]
) -> MultisinePlan:
    """Return the plan times a factor, with the bias velocities that it needs on these axes."""
    bias = np.zeros(fastest.size)
    bias[axes] = BIAS_MARGIN * factor * fastest[axes]
    signs = (1, -1)  # to and fro, so that the axis ends about where it began
    experiments = tuple(
        replace(one.scaled(factor), bias=signs[k % 2] * bias)
        for k, one in enumerate(plan.experiments)
    )
    return replace(plan, experiments=experiments)


def likely_torques(
    setting: Setting,
    period: float,
    spread: Spread,
    lines: Lines,
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
    inputs = unit_inputs(setting, lines[0], period, offsets)
    axes = inputs.by_torque.shape[1]
    size = spread(inputs).sizes(share, np.full((5, axes), CREST))
    mixing = orthogonal_phases(axes, axes)
    torques = tuple(
        np.einsum("lij,lj->li", inputs.torque, size * mixing[:, e]) for e in range(axes)
    )
    return inputs.omega, torques
