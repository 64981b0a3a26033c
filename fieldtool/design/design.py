"""The design: fastest parameters that each drive can hold and that every likely machine bears.

1. Start from the best of what is known: the rule (:mod:`fieldtool.design.start`), the present
   parameters, those of a softer response.
2. Axis after axis, search structure and numbers (:mod:`fieldtool.design.search`) against the cost of
   :mod:`fieldtool.design.axis_problem`, on several machines at once; then all axes once more.
3. Check on machines that were not looked at; where too many miss the margin, look at the worst of
   them too; in the end lower the gains.
4. Round to what the drives hold, check again, predict, and compare with the present parameters.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite

import numpy as np

from fieldtool.design.axis_motion import Fed
from fieldtool.design.axis_problem import UNSTABLE, AxisProblem
from fieldtool.design.drive_side import DriveSide
from fieldtool.design.grids import FAR_GAIN, Bounds, Grids, grids_of
from fieldtool.design.loops import Loops, system_matrix
from fieldtool.design.machine import Machine, respond
from fieldtool.design.moves import TestMove
from fieldtool.design.predict import Prediction, frequencies
from fieldtool.design.robust import (
    FRESH,
    MAY_FAIL,
    SLACK,
    check,
    fresh_check,
    machines_for,
    stable_on_all,
)
from fieldtool.design.rule import DesignError
from fieldtool.design.search import Best, again, pruned, refined, search, slots_of
from fieldtool.design.servo import Servo
from fieldtool.design.start import MOST_LOWERED, plain_start, slower
from fieldtool.design.waves import HalfWave
from fieldtool.records.model import FloatArray, MachineModel

NOISE_SHARE = 0.01
"""Of the torque limit: what the encoder's steps may make."""
UNKNOWN_TOP = 3.0
"""Highest frequency that counts as measured, over the highest mode, where nobody says."""
RIGID_TOP = 2 * np.pi * 30.0
"""rad/s: the same for a machine without modes.  A measurement of rigid axes stays far below it; a mode
that it did not see at w would have bent the response by (w / mode)^2 of its share."""
WITHIN = 0.998
"""Of a softer response's bandwidth: up to it the sensitivity stays below its level."""
INSIDE = 0.985
"""Of the bound: what the search keeps, so that rounding does not leave it."""
AGAIN, REPAIRED = 140, 100
"""Evaluations an axis in the second round, and after machines were added."""
SAMPLES = 1024
ROUNDS = 2
Advance = Callable[[str, float], None]


@dataclass(frozen=True)
class Does:
    """What an axis' loop does on the machine already: no bound but the margin's asks for less."""

    compliance: float = inf
    """Largest motor position per torque, rad/(N m) or m/N."""
    far: float = 0.0
    """Largest gain of the closed loop beyond the frequencies that were measured."""
    noise: float = 0.0
    """RMS of the torque that the encoder's steps make, N m or N."""


@dataclass(frozen=True)
class Softer:
    """What a softer response came to; this one is to be no slower on any axis."""

    servos: tuple[Servo, ...]
    prediction: Prediction
    """On the model's machine."""
    name: str
    """Of the response."""

    @property
    def bandwidths(self) -> tuple[float, ...]:
        """Hz, an axis each."""
        return tuple(axis.margins.bandwidth for axis in self.prediction.axes)


@dataclass(eq=False)
class Task:
    """What is to be designed, and what was found so far."""

    model: MachineModel
    sides: tuple[DriveSide, ...]
    moves: tuple[TestMove, ...]
    bound: float
    top: float
    """rad/s."""
    machines: list[Machine]
    rng: np.random.Generator
    advance: Advance
    softer: Softer | None = None
    most: float = 0.0
    """Bound of an axis that keeps its present parameters, for nothing else is as fast."""
    softens: bool = False
    """Whether a response was asked for that gives up stiffness."""
    plain: tuple[Best, ...] = ()
    """The rule's controllers, without filters: where a search for structure begins."""
    found: list[Best] = field(default_factory=list)
    does: list[Does] = field(default_factory=list)
    """What each axis' loop does already."""
    softest: dict[int, float] = field(default_factory=dict)
    """Largest compliance of axes that are to be as stiff as they are, rad/(N m) or m/N."""

    @property
    def servos(self) -> tuple[Servo, ...]:
        """The best controllers so far."""
        return tuple(best.servo for best in self.found)

    @property
    def present(self) -> tuple[Servo, ...] | None:
        """What the drives hold now; None where it can not be read of all of them."""
        known = tuple(now for side in self.sides if (now := side.present_servo) is not None)
        return known if len(known) == len(self.sides) else None

    def take(self, servos: Sequence[Servo]) -> None:
        """Go on from other controllers, as the drives hold them."""
        self.found = [
            Best(replace(best.space, slots=slots_of(servo) if side.filters else ()), servo, inf)
            for best, servo, side in zip(self.plain, servos, self.sides, strict=True)
        ]

    def limits(self, kept: Collection[int]) -> FloatArray:
        """Return the peak of sensitivity that each axis may have on every machine, shape (M,)."""
        kinds = [
            max(self.most, self.bound) if k in kept else self.bound for k in range(len(self.sides))
        ]
        return SLACK * np.array(kinds)

    def holds(self, servos: tuple[Servo, ...], kept: Collection[int]) -> bool:
        """Return whether controllers keep these limits on every machine of the task."""
        return bool(np.all(check(self.machines, servos).peaks <= self.limits(kept)))

    def bounds(self, axis: int) -> Bounds:
        """Return what one axis has to keep."""
        side, does = self.sides[axis], self.does[axis]
        widths = self.softer.bandwidths if self.softer else ()
        return Bounds(
            INSIDE * self.bound,
            max(NOISE_SHARE * side.torque_limit, does.noise),
            side.torque_limit,
            side.resolution,
            self.top,
            does.compliance,
            self.softest.get(axis, inf),
            max(FAR_GAIN, does.far),
            tuple(WITHIN * 2 * np.pi * width for width in widths),
        )


def find(
    model: MachineModel,
    sides: Sequence[DriveSide],
    moves: Sequence[TestMove],
    bound: float,
    top: float | None,
    seed: int,
    advance: Advance,
    softer: Softer | None = None,
) -> Task:
    """Return the task with the best controllers found, not yet rounded.

    Raises
    ------
    DesignError
        If nothing keeps the margin on all likely machines.
    """
    rng = np.random.default_rng(seed)
    machines = machines_for(model, rng)
    modes = np.concatenate([machines[0].modes, machines[0].held_modes])
    if top is None:
        top = UNKNOWN_TOP * float(modes.max()) if modes.size else RIGID_TOP
    elif not modes.size:
        top = max(top, RIGID_TOP)
    task = Task(model, tuple(sides), tuple(moves), bound, top, machines, rng, advance, softer)
    _start(task)
    for axis in range(len(task.sides)):
        task.advance(f"design {sides[axis].axis}", axis / len(task.sides))
        _searched(task, axis)
    for axis in range(len(task.sides)):
        improved(task, axis)
    _hold_for_others(task)
    return task


def _start(task: Task) -> None:
    """Put in controllers that are stable on every machine: the best of those that are known."""
    task.plain = plain_start(task.model, task.sides, task.machines, task.top)
    task.found = list(task.plain)
    present = task.present
    if present is not None and stable_on_all(task.machines, present):
        task.does = _does(task, present)
    else:
        task.does = [replace(one, far=0.0, noise=0.0) for one in _does(task, task.servos)]
    starts: list[tuple[Servo, ...]] = [task.servos]
    if task.softer is not None:
        starts.append(task.softer.servos)
    if present is not None and np.all(check(task.machines, present).peaks <= task.bound):
        starts.append(present)
    if len(starts) > 1:
        grids = _grids(task)
        totals = [_total(task, grids, servos) for servos in starts]
        task.take(starts[int(np.argmin(totals))])


def _does(task: Task, servos: tuple[Servo, ...]) -> list[Does]:
    """Return what stable loops do on the machine."""
    machine = task.machines[0]
    values = np.linalg.eigvals(system_matrix(machine, servos)).astype(np.complex128)
    loops = Loops(respond(machine, frequencies(machine, values)), servos)
    closed = np.abs(1 - loops.sensitivity[loops.response.omega > task.top])
    return [
        Does(
            float(np.abs(loops.compliance[:, k, k]).max()),
            float(closed[:, k].max(initial=0.0)),
            servo.torque_noise(side.resolution) if isfinite(side.resolution) else 0.0,
        )
        for k, (servo, side) in enumerate(zip(servos, task.sides, strict=True))
    ]


def _total(task: Task, grids: Grids, servos: tuple[Servo, ...]) -> float:
    """Return the cost of all axes' controllers."""
    return sum(_problem(task, grids, servos, axis).cost(servo) for axis, servo in enumerate(servos))


def _grids(task: Task) -> Grids:
    servos, nominal = task.servos, task.machines[0]
    values = np.linalg.eigvals(system_matrix(nominal, servos))
    slow = max(-float(values.real.max()), 1e-3)
    longest = max(move.duration for move in task.moves)
    modes = np.concatenate([nominal.modes, nominal.held_modes])
    slowest = 2 * np.pi / float(modes.min()) if modes.size else 0.0
    duration = longest + min(max(4.0 / slow, longest, 4 * slowest), 6 * longest + 10 * slowest)
    low = 0.05 * min(float(np.abs(values).min()) + slow, 2 * np.pi / duration)
    high = max(10 * task.top, 5 * float(modes.max()) if modes.size else 0.0)
    kept = [WITHIN * 2 * np.pi * width for width in task.softer.bandwidths] if task.softer else []
    return grids_of(task.machines, low, high, HalfWave(duration, SAMPLES), kept)


def _problem(task: Task, grids: Grids, servos: tuple[Servo, ...], axis: int) -> AxisProblem:
    side = task.sides[axis]
    model = task.model.axes[axis]
    chosen = side.has("velocity_ff"), side.has("inertia_ff"), side.has("viscous_ff")
    fed = Fed(*chosen, model.total_mass, model.total_friction)
    return AxisProblem(grids, servos, axis, task.moves, task.bounds(axis), fed)


def _searched(task: Task, axis: int) -> None:
    """Search structure and numbers of one axis; the others stay."""
    problem, best = _begun(task, axis)
    resonances = task.machines[0].modes
    plain = task.plain[axis]
    plain = replace(plain, cost=problem.cost(plain.servo))
    if best.servo == plain.servo:
        found = search(problem, plain, resonances)
    else:
        found = refined(problem, best)
        if plain.cost < UNSTABLE:
            found = min(search(problem, plain, resonances), found, key=lambda one: one.cost)
    _take(task, axis, found)


def improved(task: Task, axis: int, evaluations: int = AGAIN) -> None:
    """Improve the numbers of one axis, and leave out the filters that bring nothing."""
    problem, best = _begun(task, axis)
    _take(task, axis, pruned(problem, again(problem, best, evaluations)))


def _begun(task: Task, axis: int) -> tuple[AxisProblem, Best]:
    problem = _problem(task, _grids(task), task.servos, axis)
    best = task.found[axis]
    return problem, replace(best, cost=problem.cost(best.servo))


def _take(task: Task, axis: int, found: Best) -> None:
    tried = [*task.servos]
    tried[axis] = found.servo
    if stable_on_all(task.machines, tuple(tried)):  # what the grid did not see
        task.found[axis] = found


def _hold_for_others(task: Task) -> None:
    """Check on machines that were not looked at, and repair.

    Raises
    ------
    DesignError
        If the margin is missed on too many of them whatever is done.
    """
    for _ in range(ROUNDS):
        task.advance("check on other machines that the model allows", 0.9)
        checked = fresh_check(task.model, task.servos, task.rng)
        if not np.any(checked.missed(task.bound)):
            return
        task.machines += checked.worst(2)
        if not stable_on_all(task.machines, task.servos):
            task.found = [replace(b, servo=slower(b.servo)) for b in task.found]
        for axis in range(len(task.sides)):
            improved(task, axis, REPAIRED)
    checked = fresh_check(task.model, task.servos, task.rng)
    for _ in range(MOST_LOWERED):
        missed = checked.missed(task.bound)
        if not np.any(missed > MAY_FAIL):
            return
        task.advance("lower the gains", 0.92)
        task.found = [
            replace(best, servo=slower(best.servo)) if missed[k] > 0 else best
            for k, best in enumerate(task.found)
        ]
        checked = check(checked.worst(FRESH), task.servos)
    raise DesignError(
        "the model's uncertainty does not allow the margin: on some machines that it allows, the peak "
        f"of sensitivity stays above {task.bound:.3g} whatever the gains; nothing is written. Measure "
        "longer (--time), allow more with --bound, or give the number of masses (`fieldtool identify "
        "FOLDER --masses AXIS=N`)."
    )
