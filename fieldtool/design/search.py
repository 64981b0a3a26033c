"""The search for one axis' parameters: structure first, then numbers, from good starts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize

from fieldtool.design.axis_problem import UNSTABLE, AxisProblem
from fieldtool.design.drive_side import DriveSide
from fieldtool.design.servo import Servo
from fieldtool.records.closed_loop import Biquad
from fieldtool.records.model import FloatArray

NOTCH, LOW_PASS = "notch", "low-pass"
INTEGRAL = (0.12, 2.0)
"""velocity_i over velocity_p position_p."""
DEPTH, POLE_DAMPING = (0.03, 1.0), (0.3, 2.0)
"""Of a notch: damping of the zeros over that of the poles; and that of the poles."""
WORTH = 0.98
"""Of the cost without it: a filter that does not bring as much is left out."""
LEAST_WORTH = 0.003
"""Of the move's duration: the same where the cost is about nothing."""
FIRST, ADDED, LAST, PRUNED = 220, 160, 160, 80
"""Evaluations: without filters, with one more, at the end, without one of them again."""
SPREAD, NEAR = 0.4, 0.15
SCALES = (0.4, 0.7, 1.0, 1.6, 2.5, 4.0)
"""Of position_p and velocity_p where the search begins."""
NEAR_SCALES = (0.5, 0.75, 1.0, 1.4, 2.0)
"""Of the same, where it begins again."""


@dataclass(frozen=True)
class Space:
    """What may be varied of one axis' controller, and between which bounds."""

    side: DriveSide
    mass: float
    slots: tuple[str, ...]
    """Kind of each torque filter in use."""
    lowest: float
    """rad/s, of filters."""
    highest: float

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest of the vector's entries; the logarithm of what is above 0."""
        side, log = self.side, np.log
        out = [self._range("position_p"), self._range("velocity_p")]
        out.append((float(log(INTEGRAL[0])), float(log(INTEGRAL[1]))))
        frequency = (float(log(self.lowest)), float(log(self.highest)))
        if side.has("velocity_filter"):
            low, high = self._range("velocity_filter")
            turn = float(log(2 * np.pi))
            out.append((max(low + turn, frequency[0]), min(high + turn, frequency[1])))
        for kind in self.slots:
            out.append(frequency)
            if kind == NOTCH:
                out.append((float(log(DEPTH[0])), float(log(DEPTH[1]))))
            out.append((float(log(POLE_DAMPING[0])), float(log(POLE_DAMPING[1]))))
        low, high = np.array(out, dtype=np.float64).T
        return low, high

    def _range(self, name: str) -> tuple[float, float]:
        """Return the logarithm of what the drive holds."""
        hold = self.side.hold_of(name)
        if hold is None:
            return -np.inf, np.inf
        low, high = hold.bounds
        least = hold.scale if hold.whole and hold.power > 0 else 0.0
        return (
            float(np.log(max(low, least, 1e-12))),
            float(np.log(high)) if high > 0 else -np.inf,
        )

    def vector(self, servo: Servo) -> FloatArray:
        """Return a controller as a vector."""
        loop, side = servo.loop, self.side
        ratio = loop.velocity_i / (loop.velocity_p * loop.position_p)
        out = [np.log(loop.position_p), np.log(loop.velocity_p), np.log(max(ratio, INTEGRAL[0]))]
        if side.has("velocity_filter"):
            corner = 2 * np.pi * servo.velocity_filter
            out.append(np.log(min(corner, self.highest)))
        for kind, biquad in zip(self.slots, loop.filters, strict=bool(side.filters)):
            d1, d0 = biquad.denominator
            w = np.sqrt(d0)
            out.append(np.log(w))
            if kind == NOTCH:
                out.append(np.log(max(biquad.numerator[1] / d1, DEPTH[0])))
            out.append(np.log(d1 / (2 * w)))
        return np.clip(np.array(out, dtype=np.float64), *self.bounds)

    def servo(self, x: FloatArray, template: Servo) -> Servo:
        """Return the controller of a vector; what is not varied is that of ``template``."""
        side = self.side
        position, velocity, ratio, *rest = np.exp(np.clip(x, *self.bounds)).tolist()
        corner = template.velocity_filter
        if side.has("velocity_filter"):
            corner = rest.pop(0) / (2 * np.pi)
        filters = []
        for kind in self.slots:
            f = rest.pop(0) / (2 * np.pi)
            if kind == NOTCH:
                depth, pole = rest.pop(0), rest.pop(0)
                filters.append(Biquad.notch(f, depth * pole, pole))
            else:
                filters.append(Biquad.low_pass(f, rest.pop(0)))
        loop = replace(
            template.loop,
            position_p=position,
            velocity_p=velocity,
            velocity_i=ratio * velocity * position,
            filters=tuple(filters) if side.filters else template.loop.filters,
        )
        return Servo(loop, corner, template.timing)

    def with_slot(self, kind: str) -> "Space":
        """Return the space with a filter more."""
        return replace(self, slots=(*self.slots, kind))


def slots_of(servo: Servo) -> tuple[str, ...]:
    """Return the kind of each torque filter of a controller."""
    return tuple(NOTCH if f.numerator[0] else LOW_PASS for f in servo.loop.filters)


@dataclass(frozen=True)
class Best:
    """The best controller found, and its cost."""

    space: Space
    servo: Servo
    cost: float


def improve(problem: AxisProblem, best: Best, evaluations: int, spread: float = SPREAD) -> Best:
    """Return a controller at least as good, by a simplex (Nelder and Mead 1965) in its space."""
    space, template = best.space, best.servo
    start = space.vector(template)

    def cost(x: FloatArray) -> float:
        return problem.cost(space.servo(x, template))

    corners = np.vstack([start, start + spread * _directions(start.size)])
    low, high = space.bounds
    found = minimize(
        cost,
        start,
        method="Nelder-Mead",
        options={
            "maxfev": evaluations,
            "initial_simplex": np.clip(corners, low, high - 1e-3 * (np.isfinite(high))),
            "adaptive": True,
            "xatol": 2e-3,
            "fatol": 1e-4 * max(best.cost, 1e-3),
        },
    )
    if found.fun >= best.cost:
        return replace(best, servo=problem.fed_forward(template))
    return Best(space, problem.fed_forward(space.servo(found.x, template)), float(found.fun))


def search(problem: AxisProblem, start: Best, resonances: FloatArray) -> Best:
    """Return the best controller found for one axis.

    Parameters
    ----------
    problem
        What parameters cost.
    start
        A stable controller without filters.
    resonances
        rad/s, of the free machine: where a notch may help.
    """
    best = improve(problem, _scaled(problem, start, SCALES), FIRST)
    for _ in start.space.side.filters:
        tried = [
            improve(problem, _added(problem, best, kind, w), ADDED)
            for kind, w in _kinds(best, resonances)
        ]
        better = min(tried, key=lambda one: one.cost, default=best)
        if better.cost > best.cost - _worth(problem, best):
            break
        best = better
    return pruned(problem, refined(problem, best))


def refined(problem: AxisProblem, best: Best) -> Best:
    """Return a controller at least as good, near to one that is good."""
    return improve(problem, best, LAST, 0.5 * SPREAD)


def pruned(problem: AxisProblem, best: Best) -> Best:
    """Leave out the filters that bring nothing; the other numbers may make up for them."""
    for k in reversed(range(len(best.space.slots))):
        slots, filters = list(best.space.slots), list(best.servo.loop.filters)
        del slots[k], filters[k]
        loop = replace(best.servo.loop, filters=tuple(filters))
        servo = problem.fed_forward(replace(best.servo, loop=loop))
        without = Best(replace(best.space, slots=tuple(slots)), servo, problem.cost(servo))
        if without.cost < UNSTABLE:
            without = improve(problem, without, PRUNED, NEAR)
        if without.cost <= best.cost + _worth(problem, best):
            best = without
    return best


def _worth(problem: AxisProblem, best: Best) -> float:
    """Return what a filter has to bring."""
    return max((1 - WORTH) * abs(best.cost), LEAST_WORTH * problem.move.duration)


def again(problem: AxisProblem, best: Best, evaluations: int) -> Best:
    """Return a controller at least as good, from where it is and from the best of scaled gains."""
    near = improve(problem, best, evaluations // 2, NEAR)
    far = improve(problem, _scaled(problem, near, NEAR_SCALES, itself=False), evaluations)
    return min(near, far, key=lambda one: one.cost)


def _scaled(
    problem: AxisProblem, start: Best, scales: Sequence[float], *, itself: bool = True
) -> Best:
    """Return the best of a start with its gains scaled, with or without the start itself."""
    best = start if itself else replace(start, cost=np.inf)
    for outer in scales:
        for inner in scales:
            if not itself and outer == inner == 1.0:
                continue
            loop = start.servo.loop
            scaled = replace(
                loop,
                position_p=loop.position_p * outer,
                velocity_p=loop.velocity_p * inner,
                velocity_i=loop.velocity_i * outer * inner,
            )
            servo = replace(start.servo, loop=scaled)
            servo = start.space.servo(start.space.vector(servo), servo)
            cost = problem.cost(servo)
            if cost < best.cost:
                best = Best(start.space, servo, cost)
    return best


def _kinds(best: Best, resonances: FloatArray) -> list[tuple[str, float]]:
    space = best.space
    inside = resonances[(resonances > space.lowest) & (resonances < space.highest)]
    corner = min(max(8 * best.servo.loop.velocity_p / space.mass, space.lowest), space.highest)
    kinds = [(LOW_PASS, float(corner))]
    if space.side.notches and space.slots.count(NOTCH) < inside.size:
        kinds.append((NOTCH, float(inside[min(space.slots.count(NOTCH), inside.size - 1)])))
    return kinds


def _added(problem: AxisProblem, best: Best, kind: str, w: float) -> Best:
    f = w / (2 * np.pi)
    biquad = Biquad.notch(f, 0.3, 0.7) if kind == NOTCH else Biquad.low_pass(f, 0.7)
    space = best.space.with_slot(kind)
    loop = replace(best.servo.loop, filters=(*best.servo.loop.filters, biquad))
    servo = replace(best.servo, loop=loop)
    cost = problem.cost(servo)
    return Best(space, servo, cost if np.isfinite(cost) else 2 * UNSTABLE)


def _directions(size: int) -> FloatArray:
    """Return one step along each axis, alternating in sign: a simplex around its start."""
    return np.diag(np.where(np.arange(size) % 2 == 0, 1.0, -1.0))
