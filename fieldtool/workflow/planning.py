"""Plan the fast measurement: how long, which lines, how strong, and how well it will tell."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.forecast import AxisForecast, Setting
from fieldtool.experiment.multisine.design import (
    MORE_PERIODS,
    PERIODS,
    PILOT_SHARE,
    ROUND,
    experiments_for,
    likely_torques,
    mode_band,
    settle_time,
    shortest_period,
    telling_lines,
)
from fieldtool.experiment.multisine.forecast import forecast_multisine, predicted_phasors
from fieldtool.experiment.multisine.plan import Lines, MultisinePlan
from fieldtool.experiment.multisine.unit_inputs import Shape
from fieldtool.identify.likelihood.expected import Excitation, Expected, Noise, expected_accuracy
from fieldtool.records.model import MachineModel
from fieldtool.workflow.best_spread import BestSpread

SECONDS, SHORTEST_SECONDS, SWINGS = 60.0, 12.0, 125.0
"""Of excitation in all, where nothing else is asked for: so many swings of the slowest mode, in these
bounds."""
PILOT_TIME = 0.18
"""Share of the time that a pilot of as many experiments as axes may take; else it is a single one."""
SHORTER = (0.125, 0.25, 0.5)
"""Of the longest period that the time allows: tried first, for they may tell enough."""
NEARLY, CANDIDATES = 0.8, 10
"""From this share of the longest period on, so many are tried: lines near to the resonances tell more
than a little more time."""
LONG_ENOUGH = 2.5
"""Of the shortest period, from which an experiment has a period more."""
PILOT_SHAPE = Shape(-0.75)
"""Spread of the pilot: the machine as last accepted is not worth a finer one."""
LENGTHS_SHARE = 0.7
"""Of the time that planning takes, for finding the period."""
Advance = Callable[[str, float], None]
MARGIN = 2.0
"""Standard errors that the accuracy that is wanted has to cover."""


@dataclass(frozen=True)
class Wanted:
    """Relative errors (95 %) that a measurement should stay below."""

    mass: float = 0.003
    spring: float = 0.003
    damper: float = 0.1
    coupling: float = 0.01

    def reached(self, expected: Expected) -> float:
        """Return the largest expected error over what is wanted; 1 or less is good."""
        limits: dict[str, float] = vars(self)
        return max(MARGIN * expected.relative(kind) / limit for kind, limit in limits.items())

    def mean(self, expected: Expected) -> float:
        """Return the mean over the parameters of expected error over what is wanted."""
        limits: dict[str, float] = vars(self)
        shares = [
            std / abs(value) / limits[p.kind]
            for p, value, std in zip(
                expected.parameters, expected.values, expected.std, strict=True
            )
            if value and p.kind in limits
        ]
        return MARGIN * float(np.mean(shares)) if shares else 0.0


@dataclass(frozen=True, eq=False)
class PlannedFast:
    """A plan that keeps all limits by the model that it rests on, and what it will tell."""

    plan: MultisinePlan
    moves: tuple[AxisForecast, ...]
    accuracy: Expected
    wanted: Wanted
    rests_on: str = "machine as last accepted"
    """Which model it was simulated with, in words."""
    pilot: MultisinePlan | None = None
    """Comes before it; None where it has been run."""

    @property
    def duration(self) -> float:
        """Seconds of excitation, with the pilot."""
        return self.plan.duration + (self.pilot.duration if self.pilot else 0.0)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``--json`` prints them."""
        kinds = ("mass", "spring", "damper", "coupling")
        return {
            "excitation_s": self.duration,
            "cycle_s": self.plan.cycle_time,
            "experiments": [
                {
                    "name": one.name,
                    "period_s": one.period,
                    "periods": one.periods,
                    "lines_hz": one.frequencies.tolist(),
                    "detection_hz": (one.detection / one.period).tolist(),
                }
                for plan in (self.pilot, self.plan)
                if plan is not None
                for one in plan.experiments
            ],
            "moves": [vars(one) for one in self.moves],
            "expected_relative_95": {
                kind: percent
                if np.isfinite(percent := 1.96 * self.accuracy.relative(kind))
                else None
                for kind in kinds
            },
        }

    @property
    def reached(self) -> float:
        """Largest expected error over what is wanted."""
        return self.wanted.reached(self.accuracy)


def usual_seconds(model: MachineModel) -> float:
    """Return the seconds of excitation that a machine gets where nobody asks for another time."""
    return float(np.clip(SWINGS / mode_band(model)[0], SHORTEST_SECONDS, SECONDS))


@dataclass(frozen=True)
class Timing:
    """How the time is shared out."""

    pilot_period: float
    """s."""
    pilot_experiments: int
    """M, or 1 where the time is short."""
    periods: int
    """Of each main experiment; those of the pilot have PERIODS."""
    seconds_left: float
    """For the main experiments, their fade-out included."""


def timing(setting: Setting, seconds: float) -> Timing:
    """Share out the time: the pilot has as many experiments as axes where there is time for it.

    Where the time is not even enough for the shortest experiments, that much is taken.
    """
    axes, settle = len(setting.loops), settle_time(setting.model)
    seconds -= settle + ROUND  # the pilot ends with a fade-out, as the main experiments do
    least = _least_period(setting.model)
    longest = (PILOT_TIME * seconds / axes - settle) / PERIODS
    count, period = (
        (axes, ROUND * float(np.floor(longest / ROUND))) if longest >= least else (1, least)
    )
    left = max(float(seconds - count * (settle + PERIODS * period)), _least_main(setting))
    more = ((left - settle) / axes - settle) / MORE_PERIODS >= LONG_ENOUGH * least
    return Timing(period, count, MORE_PERIODS if more else PERIODS, left)


def _least_period(model: MachineModel) -> float:
    """Return the shortest period that is one of all cycle times, s."""
    return ROUND * float(np.ceil(shortest_period(model) / ROUND - 1e-9))


def _least_main(setting: Setting) -> float:
    """Return the seconds of the shortest main experiments, fade-out and final rest included."""
    settle, axes = settle_time(setting.model), len(setting.loops)
    return axes * (settle + PERIODS * _least_period(setting.model)) + settle + ROUND


def _enough(setting: Setting, times: Timing) -> float:
    """Return the seconds in all that leave enough for the shortest main experiments of this machine.

    The pilot is longer in a longer time, but takes no more than its share or what it took here.
    """
    settle, main = settle_time(setting.model), _least_main(setting)
    pilot = times.pilot_experiments * (settle + PERIODS * times.pilot_period)
    return float(np.ceil(settle + ROUND + max(main / (1 - PILOT_TIME), main + pilot)))


def plan_pilot(
    setting: Setting,
    cycle_time: float,
    times: Timing,
    seed: int,
    offsets: Sequence[bool] = (),
) -> MultisinePlan:
    """Return weak experiments that move all axes: they find noise, friction and modes.

    They are the first of the two amplitude levels.
    """
    plan = experiments_for(
        setting,
        cycle_time,
        times.pilot_period,
        PILOT_SHAPE,
        seed,
        count=times.pilot_experiments,
        name="pilot",
        share=PILOT_SHARE,
        offsets=offsets,
    )
    forecast_multisine(plan, setting)
    return plan


def plan_main(
    setting: Setting,
    cycle_time: float,
    noise: Noise,
    times: Timing,
    wanted: Wanted,
    seed: int,
    offsets: Sequence[bool] = (),
    advance: Advance = lambda *_: None,
) -> PlannedFast:
    """Return the shortest plan that reaches what is wanted, or the best one in the time.

    Parameters
    ----------
    setting
        Model that the plan rests on, loops, limits.
    cycle_time
        s.
    noise
        Of single samples.
    times
        How the time is shared out.
    wanted
        Accuracy.
    seed
        Of the random phases.
    offsets
        Which axes' drives take a torque offset.
    advance
        Told what is computed, and a number from 0 to 1.

    Raises
    ------
    PlanRefusedError
        If the machine can not be excited within its limits.
    """
    chosen: _Candidate | None = None
    counts = sorted({times.periods, PERIODS}, reverse=True)  # a slower machine than was thought
    tried = ((n, _periods(setting, cycle_time, times, n)) for n in counts)
    count, lengths = next((one for one in tried if one[1]), (PERIODS, []))
    for k, period in enumerate(lengths):
        advance(
            f"choose lines and amplitudes: period {k + 1} of at most {len(lengths)}, {period:.3g} s",
            LENGTHS_SHARE * k / len(lengths),
        )
        found = _candidate(setting, noise, period, count, cycle_time, wanted, offsets)
        if chosen is None or found.loss < chosen.loss:
            chosen = found
        if chosen.reached <= 1.0 and fine_enough(chosen.period, setting.model):
            break
    if chosen is None:
        raise PlanRefusedError(
            f"the slowest motion of this machine ({mode_band(setting.model)[0]:.3g} Hz) needs periods "
            f"of {shortest_period(setting.model):.3g} s or more, {_least_main(setting):.3g} s of main "
            f"experiments in all; {times.seconds_left:.3g} s were left for them: allow more time "
            f"(--time {_enough(setting, times):.0f})"
        )
    advance("choose phases, and simulate the experiments within the limits", LENGTHS_SHARE)
    plan = experiments_for(
        setting,
        cycle_time,
        chosen.period,
        chosen.spread,
        seed,
        offsets=offsets,
        periods=count,
        lines=chosen.lines,
    )
    return PlannedFast(
        plan,
        forecast_multisine(plan, setting),
        expected_accuracy(setting.model, excitations(plan, setting), noise),
        wanted,
    )


def _periods(setting: Setting, cycle_time: float, times: Timing, count: int) -> list[float]:
    """Return the periods to try, s, rising, whole numbers of cycles; `count` of them are run."""
    settle, least = settle_time(setting.model), shortest_period(setting.model)
    each = (times.seconds_left - settle - cycle_time) / len(setting.loops) - settle
    longest = each / count * (1 + 1e-9)
    shares = (*SHORTER, *np.linspace(NEARLY, 1.0, CANDIDATES))
    cycles = {int(np.floor(longest * share / cycle_time)) for share in shares}
    return [n * cycle_time for n in sorted(cycles) if n * cycle_time >= least]


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A period, and what it is likely to tell."""

    period: float
    spread: BestSpread
    lines: Lines
    reached: float
    """Largest expected error over what is wanted."""
    loss: float
    """What is made small: the mean over all parameters of expected error over wanted error."""


def _candidate(
    setting: Setting,
    noise: Noise,
    period: float,
    periods: int,
    cycle_time: float,
    wanted: Wanted,
    offsets: Sequence[bool],
) -> _Candidate:
    samples = periods * round(period / cycle_time)
    spread = BestSpread(noise, samples, vars(wanted))
    lines = telling_lines(setting, period, spread, offsets)
    omega, torques = likely_torques(setting, period, spread, lines, offsets=offsets)
    likely = [Excitation(omega, torque, samples) for torque in torques]
    expected = expected_accuracy(setting.model, likely, noise)
    return _Candidate(period, spread, lines, wanted.reached(expected), wanted.mean(expected))


def fine_enough(period: float, model: MachineModel) -> bool:
    """Return whether odd lines are no farther apart than the narrowest mode is wide."""
    return 2.0 / period <= narrowest_mode(model)[1]


def narrowest_mode(model: MachineModel) -> tuple[float, float]:
    """Return frequency and half-power width of the narrowest resonance, Hz; inf if there is none."""
    n = model.mass_matrix.shape[0]
    mass = np.linalg.inv(model.mass_matrix)
    system = np.block(
        [
            [np.zeros((n, n)), np.eye(n)],
            [-mass @ model.stiffness_matrix, -mass @ model.damping_matrix],
        ]
    )
    values = np.linalg.eigvals(system)
    swinging = values[values.imag > 1e-3 * np.abs(values).max()]
    if swinging.size == 0:
        return np.inf, np.inf
    narrow = swinging[np.argmax(swinging.real)]
    return float(np.abs(narrow) / (2 * np.pi)), float(-2 * narrow.real / (2 * np.pi))


def excitations(plan: MultisinePlan, setting: Setting) -> tuple[Excitation, ...]:
    """Return what the motors will feel in each experiment, by the setting's model."""
    return tuple(
        Excitation(
            2 * np.pi * one.frequencies,
            predicted_phasors(one, setting)[1],
            one.periods * one.samples,
        )
        for one in plan.experiments
    )
