"""The design: fastest parameters that each drive can hold and that every likely machine bears.

1. Start from the rule (:mod:`fieldtool.design.rule`), or from the present parameters where they keep
   the margin, lowered until they are stable on every machine looked at.
2. Axis after axis, search structure and numbers (:mod:`fieldtool.design.search`) against the cost of
   :mod:`fieldtool.design.axis_problem`, on several machines at once; then all axes once more.
3. Check on machines that were not looked at; where too many miss the margin, look at the worst of
   them too; in the end lower the gains.
4. Round to what the drives hold, check again, predict, and compare with the present parameters.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite

import numpy as np

from fieldtool.design.axis_problem import AxisProblem, Bounds, Grids, grids_of
from fieldtool.design.drive_side import PID, DriveSide
from fieldtool.design.loops import Loops, system_matrix
from fieldtool.design.machine import Machine, machine_of, respond
from fieldtool.design.moves import TestMove, typical_move
from fieldtool.design.predict import frequencies
from fieldtool.design.robust import FRESH, MAY_FAIL, check, fresh_check, machines_for, stable_on_all
from fieldtool.design.rule import DesignError, rule
from fieldtool.design.search import Best, Space, again, search
from fieldtool.design.servo import Servo
from fieldtool.design.waves import HalfWave
from fieldtool.records.model import MachineModel

NOISE_SHARE = 0.01
"""Of the torque limit: what the encoder's steps may make."""
UNKNOWN_TOP = 3.0
"""Highest frequency that counts as measured, over the highest mode, where nobody says."""
RIGID_TOP = 2 * np.pi * 30.0
"""rad/s: the same for a machine without modes."""
INSIDE = 0.985
"""Of the bound: what the search keeps, so that rounding does not leave it."""
AGAIN, REPAIRED = 140, 100
"""Evaluations an axis in the second round, and after machines were added."""
LOWERED, MOST_LOWERED = 0.85, 12
SAMPLES = 1024
ROUNDS = 2
Advance = Callable[[str, float], None]


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
    found: list[Best] = field(default_factory=list)
    softest: list[float] = field(default_factory=list)
    """Compliance of each axis that new parameters should not exceed."""

    @property
    def servos(self) -> tuple[Servo, ...]:
        """The best controllers so far."""
        return tuple(best.servo for best in self.found)

    def bounds(self, axis: int, bound: float) -> Bounds:
        """Return what one axis has to keep."""
        side = self.sides[axis]
        noise = NOISE_SHARE * side.torque_limit
        soft = self.softest[axis] if self.softest else inf
        return Bounds(bound, noise, side.torque_limit, side.resolution, self.top, soft)


def default_moves(model: MachineModel, sides: Sequence[DriveSide]) -> tuple[TestMove, ...]:
    """Return moves for a model alone: a radian in some periods of its lowest mode."""
    modes = machine_of(model).modes
    w = float(modes[0]) if modes.size else 20.0
    moves = []
    for axis, side in zip(model.axes, sides, strict=True):
        torque = side.torque_limit if isfinite(side.torque_limit) else inf
        fast = typical_move(axis.name, (0.0, 1.0), 2.0 * w, 0.2 * w * w, torque, axis.total_mass)
        moves.append(fast)
    return tuple(moves)


def find(
    model: MachineModel,
    sides: Sequence[DriveSide],
    moves: Sequence[TestMove],
    bound: float,
    top: float | None,
    seed: int,
    advance: Advance,
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
    task = Task(model, tuple(sides), tuple(moves), bound, top, machines, rng, advance)
    _start(task)
    for axis in _order(task):
        task.advance(f"design {sides[axis].axis}", axis / len(task.sides))
        _one(task, axis, INSIDE * bound, first=True)
    for axis in _order(task):
        _one(task, axis, INSIDE * bound, first=False)
    _hold_for_others(task)
    return task


def _order(task: Task) -> list[int]:
    return list(range(len(task.sides)))


def _start(task: Task) -> None:
    """Put in controllers that are stable on every machine."""
    modes = np.concatenate([task.machines[0].modes, task.machines[0].held_modes])
    lowest = 0.3 * float(modes.min()) if modes.size else 2 * np.pi
    for loop, axis, side in zip(rule(task.model), task.model.axes, task.sides, strict=True):
        highest = 0.8 * np.pi / (side.timing.period or 1e-4)
        space = Space(side, axis.total_mass, (), lowest, min(highest, 30 * task.top))
        present = side.present or {}
        whole = all(name in side.holds for name in PID)
        share = 1.0 if side.has("velocity_ff") or whole else present.get("velocity_ff", 0.0)
        inertia = axis.total_mass if side.has("inertia_ff") else present.get("inertia_ff", 0.0)
        fed = replace(loop, velocity_ff=share, inertia_ff=inertia)
        servo = side.servo(
            {"position_p": 1.0, "velocity_p": 1.0, "velocity_i": 1.0}
            | {f"filter{k}_type": 0.0 for k in side.filters}
        )
        corner = servo.velocity_filter
        if side.has("velocity_filter"):
            corner = space.highest / (2 * np.pi)
        kept = servo.loop.filters  # of a drive whose filters can not be set
        servo = Servo(replace(fed, filters=kept), corner, side.timing)
        if not kept:
            servo = space.servo(space.vector(servo), servo)  # within what the drive holds
        task.found.append(Best(space, servo, inf))
    for _ in range(MOST_LOWERED):
        if stable_on_all(task.machines, task.servos):
            break
        task.found = [replace(best, servo=slower(best.servo)) for best in task.found]
    else:
        raise DesignError(
            "no gains were found that are stable on every machine that the model's uncertainty allows; "
            "nothing is written. Measure longer (--time), or give the number of masses with `fieldtool "
            "identify FOLDER --masses AXIS=N`."
        )
    known = tuple(now for side in task.sides if (now := side.present_servo) is not None)
    plain = len(known) == len(task.sides) and not any(now.loop.filters for now in known)
    if plain and np.all(check(task.machines, known).peaks <= task.bound):
        _take_better(task, known)
    base = known if len(known) == len(task.sides) and stable_on_all(task.machines, known) else None
    task.softest = _compliances(task.machines[0], base or task.servos)


def _compliances(machine: Machine, servos: tuple[Servo, ...]) -> list[float]:
    """Return the largest motor position per torque of each axis."""
    values = np.linalg.eigvals(system_matrix(machine, servos)).astype(np.complex128)
    closed = Loops(respond(machine, frequencies(machine, values)), servos).compliance
    return [float(np.abs(closed[:, k, k]).max()) for k in range(len(servos))]


def _take_better(task: Task, present: tuple[Servo, ...]) -> None:
    """Begin with the present controllers where together they cost less than the rule's."""
    grids = _grids(task)
    costs = []
    for servos in (task.servos, present):
        total = 0.0
        for axis in range(len(task.sides)):
            total += _problem(task, grids, servos, axis, task.bound).cost(servos[axis])
        costs.append(total)
    if costs[1] < costs[0]:
        task.found = [
            replace(best, servo=servo) for best, servo in zip(task.found, present, strict=True)
        ]


def slower(servo: Servo, factor: float = LOWERED) -> Servo:
    """Return a controller with lower gains, its loops as far apart as before."""
    loop = servo.loop
    lowered = replace(
        loop,
        position_p=loop.position_p * factor,
        velocity_p=loop.velocity_p * factor,
        velocity_i=loop.velocity_i * factor**2,
    )
    return replace(servo, loop=lowered)


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
    return grids_of(task.machines, low, high, HalfWave(duration, SAMPLES))


def _problem(
    task: Task, grids: Grids, servos: tuple[Servo, ...], axis: int, bound: float
) -> AxisProblem:
    side = task.sides[axis]
    free = (side.has("velocity_ff"), side.has("inertia_ff"))
    mass = task.model.axes[axis].total_mass
    return AxisProblem(grids, servos, axis, task.moves, task.bounds(axis, bound), free, mass)


def _one(task: Task, axis: int, bound: float, *, first: bool, evaluations: int = AGAIN) -> None:
    """Improve one axis; the others stay."""
    problem = _problem(task, _grids(task), task.servos, axis, bound)
    best = task.found[axis]
    best = replace(best, cost=problem.cost(best.servo))
    found = (
        search(problem, best, task.machines[0].modes)
        if first
        else again(problem, best, evaluations)
    )
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
        for axis in _order(task):
            _one(task, axis, INSIDE * task.bound, first=False, evaluations=REPAIRED)
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
