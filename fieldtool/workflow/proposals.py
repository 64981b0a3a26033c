"""Experiments that tell rivals apart, within the limits: other sizes, frequencies, speeds, travels."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.design import (
    HIGH,
    LOW,
    experiments_for,
    mode_band,
    with_bias,
)
from fieldtool.experiment.multisine.excitation import signals
from fieldtool.experiment.multisine.forecast import forecast_multisine, predicted_phasors
from fieldtool.experiment.multisine.plan import Lines, MultisineExperiment, MultisinePlan
from fieldtool.experiment.multisine.unit_inputs import Shape
from fieldtool.records.recording import Experiment

SIZES = (0.5, 0.2)
"""Of the excitation, where the amplitude tells."""
SLOW = 1.0 / 3.0
"""Of the speeds, where the speed tells."""
HIGHEST = 0.1
"""Of the sample rate: highest line, where the frequency tells."""
MOST_LINES = 40
WIDE_LINES = 8
LONGER = 2.0
"""Periods of slow and wide experiments over those of the others."""
SEED = 61


@dataclass(frozen=True, eq=False)
class Proposal:
    """Some experiments, and what is other with them."""

    words: str
    plan: MultisinePlan


@dataclass(frozen=True, eq=False)
class Ground:
    """What proposals rest on."""

    setting: Setting
    main: MultisinePlan
    """The usual experiments."""
    axes: tuple[int, ...]
    """Those that the rivals are about."""
    offsets: Sequence[bool]
    """Which drives take a torque offset."""


def proposals(ground: Ground, pair: frozenset[str]) -> Iterator[Proposal]:
    """Return experiments that keep all limits, those first that are known to tell these effects apart.

    Parameters
    ----------
    ground : Ground
    pair : frozenset of str
        Names of the rivals.
    """
    first = FIRST.get(pair, ())
    for make in (*first, *(m for m in EVERY if m not in first)):
        with suppress(PlanRefusedError):
            found = make(ground)
            if found is not None:
                plan = _twice(found.plan)
                forecast_multisine(plan, ground.setting)
                yield Proposal(found.words, plan)


def _twice(plan: MultisinePlan) -> MultisinePlan:
    """Repeat the experiments of a single axis: one of two alike is kept unseen by the judge."""
    if plan.experiments[0].axes > 1:
        return plan
    again = tuple(replace(one, name=f"{one.name} again") for one in plan.experiments)
    return replace(plan, experiments=(*plan.experiments, *again))


def _sizes(ground: Ground) -> Proposal | None:
    """Make the same excitation weaker, twice."""
    experiments = tuple(
        replace(one.scaled(size), name=f"{round(100 * size)} percent {k + 1}")
        for size in SIZES
        for k, one in enumerate(ground.main.experiments)
    )
    words = f"the usual excitation at {SIZES[0]:.0%} and {SIZES[1]:.0%} of its size"
    return Proposal(words, replace(ground.main, experiments=experiments))


def _frequencies(ground: Ground) -> Proposal | None:
    """Excite above the modes."""
    step, period = ground.main.cycle_time, ground.main.experiments[0].period
    low, high = HIGH * mode_band(ground.setting.model)[1], HIGHEST / step
    if high < 1.5 * low:
        return None
    plan = experiments_for(
        ground.setting,
        step,
        period,
        Shape(0.0),
        SEED,
        name="high",
        offsets=ground.offsets,
        periods=ground.main.experiments[0].periods,
        lines=_thinned(low * period, high * period),
    )
    return Proposal(f"higher frequencies, {low:.3g} to {high:.3g} Hz", plan)


def _thinned(first: float, last: float) -> Lines:
    """Odd lines of a band, evenly spread where there are more than a few."""
    odd = np.arange(int(first) | 1, int(last) + 1, 2, dtype=np.int_)
    if odd.size > MOST_LINES:
        odd = odd[np.unique(np.linspace(0, odd.size - 1, MOST_LINES).round().astype(int))]
    return odd, np.empty(0, dtype=np.int_)


def _speeds(ground: Ground) -> Proposal | None:
    """Let the axes move at two constant speeds under a weak excitation."""
    found = with_bias(ground.main, ground.setting, ground.axes)
    if found is None:
        return None
    fast = found[0].experiments
    experiments = tuple(
        replace(one.scaled(size), bias=size * one.bias, name=f"{name} {k + 1}")
        for name, size in (("fast", 1.0), ("slow", SLOW))
        for k, one in enumerate(fast)
    )
    top = max(float(np.abs(one.bias).max()) for one in fast)
    unit = "rad/s" if ground.setting.model.axes[ground.axes[0]].kind == "rotary" else "m/s"
    words = f"constant speeds of {SLOW * top:.2g} and {top:.2g} {unit} under the excitation"
    return Proposal(words, replace(ground.main, experiments=experiments))


def _wide(ground: Ground) -> Proposal | None:
    """Move slowly over much of the travel."""
    step = ground.main.cycle_time
    usual = ground.main.experiments[0]
    period = step * round(LONGER * usual.period / step)
    last = max(2 * WIDE_LINES - 1, int(LOW * mode_band(ground.setting.model)[0] * period))
    lines = np.arange(1, last + 1, 2, dtype=np.int_)[:WIDE_LINES]
    plan = experiments_for(
        ground.setting,
        step,
        period,
        Shape(-1.0),
        SEED + 1,
        name="wide",
        periods=2,
        lines=(lines, np.empty(0, dtype=np.int_)),
    )
    return Proposal(f"slow and wide moves, {1 / period:.2g} to {lines[-1] / period:.2g} Hz", plan)


Maker = Callable[[Ground], Proposal | None]
EVERY: tuple[Maker, ...] = (_sizes, _speeds, _frequencies, _wide)
FIRST: dict[frozenset[str], tuple[Maker, ...]] = {
    frozenset({"measurement_delay", "torque_lag"}): (_frequencies,),
    frozenset({"cogging", "encoder_error"}): (_speeds, _wide),
    frozenset({"gravity", "cogging"}): (_wide,),
    frozenset({"hardening_spring", "backlash"}): (_sizes,),
    frozenset({"softening_spring", "backlash"}): (_sizes,),
    frozenset({"coulomb_friction", "stribeck_friction"}): (_speeds,),
    frozenset({"coulomb_friction", "asymmetric_friction"}): (_speeds,),
    frozenset({"coulomb_friction", "backlash"}): (_speeds, _sizes),
    frozenset({"structural_damping", "viscous_friction"}): (_frequencies,),
    frozenset({"coupling_spring", "coupling_inertia"}): (_wide, _frequencies),
}
"""What is tried first, by the names of the rivals."""


def expected_data(plan: MultisinePlan, setting: Setting) -> tuple[Experiment, ...]:
    """Return what would be recorded of a plan by the machine without effects, without noise."""
    return tuple(_expected(one, setting) for one in plan.experiments)


def _expected(one: MultisineExperiment, setting: Setting) -> Experiment:
    rows = one.periods * one.samples
    time = np.asarray(one.cycle_time * np.arange(rows), dtype=np.float64)
    position, torque = (
        np.tile(signals(phasors, one.lines, one.samples), (one.periods, 1))
        for phasors in predicted_phasors(one, setting)
    )
    drift = one.bias * (time[:, None] - time[-1] / 2)
    names = setting.model.names
    reference = np.tile(one.one_period(), (one.periods, 1)) + drift
    return Experiment(
        name=one.name,
        kind="multisine",
        driven=names,
        free=(),
        period=one.period,
        time=time,
        position=position + drift + setting.centre,
        torque=torque + one.bias * np.array([a.viscous_friction.value for a in setting.model.axes]),
        position_reference=reference + setting.centre,
    )
