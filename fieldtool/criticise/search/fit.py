"""Fit a hypothesis to the rows that may be seen, by Gauss-Newton steps with damping."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.effects.base import Parameter
from fieldtool.criticise.search.hypothesis import Hypothesis, Simulator

FloatArray = NDArray[np.float64]
STEPS = 12
"""Most Gauss-Newton steps."""
ENOUGH, EXACTLY = 1e-4, 1e-7
"""Relative gain of a step from which it is the last, while searching and for what is reported."""
TRIES = 6
"""Dampings tried a step."""
LARGEST_FACTOR = 3.0
RENEWED = 0.6
"""Of the gain that a step promised: with less, the machine's derivatives are found anew."""
DERIVATIVE = 1e-3
"""Step of a derivative over the size of the number."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fitted hypothesis."""

    hypothesis: Hypothesis
    cost: float
    """Sum of squares of the weighted errors that were seen."""
    names: tuple[str, ...]
    """Of all free numbers: those of the machine, then ``EFFECT@AXIS.PARAMETER``."""
    values: FloatArray
    std: FloatArray
    """Standard errors, scaled by the misfit."""
    covariance: FloatArray

    def of_effect(self, place: int) -> Mapping[str, tuple[float, float]]:
        """Return value and standard error of each free number of one effect."""
        effect = self.hypothesis.effects[place]
        lead = f"{place}:{effect.name}."
        return {
            name.removeprefix(lead): (float(v), float(s))
            for name, v, s in zip(self.names, self.values, self.std, strict=True)
            if name.startswith(lead)
        }

    def error_of(self, place: int, weights: Mapping[str, float]) -> float:
        """Return the standard error of a weighted sum of numbers of one effect."""
        name = self.hypothesis.effects[place].name
        at = [self.names.index(f"{place}:{name}.{parameter}") for parameter in weights]
        w = np.array(list(weights.values()))
        return float(np.sqrt(max(w @ self.covariance[np.ix_(at, at)] @ w, 0.0)))


@dataclass(frozen=True)
class _Free:
    """One free number: of the machine (place -1) or of an effect."""

    name: str
    place: int
    index: int
    scale: float
    known: float
    """Standard error beforehand over the scale; infinite where nothing is known."""
    parameter: Parameter | None


def free_numbers(hypothesis: Hypothesis) -> list[_Free]:
    """List the numbers that a fit may change."""
    out = [
        _Free(v.name, -1, k, v.scale, v.known, None)
        for k, v in enumerate(hypothesis.machine.variables)
        if v.name not in hypothesis.off
    ]
    for place, effect in enumerate(hypothesis.effects):
        out += [
            _Free(f"{place}:{effect.name}.{p.name}", place, k, p.scale, np.inf, p)
            for k, p in enumerate(effect.parameters)
            if p.scale > 0.0
        ]
    return out


def vector_of(hypothesis: Hypothesis, free: list[_Free]) -> FloatArray:
    """Return the values of the free numbers."""
    return np.array(
        [
            hypothesis.base[f.index]
            if f.parameter is None
            else hypothesis.values[f.place][f.parameter.name]
            for f in free
        ]
    )


def with_vector(hypothesis: Hypothesis, free: list[_Free], vector: FloatArray) -> Hypothesis:
    """Return the hypothesis with other values, within their bounds."""
    base = hypothesis.base.copy()
    values = [dict(v) for v in hypothesis.values]
    for f, value in zip(free, vector, strict=True):
        if f.parameter is None:
            base[f.index] = value
        else:
            values[f.place][f.parameter.name] = f.parameter.clipped(float(value))
    base = hypothesis.machine.clipped(base)
    for k, name in enumerate(hypothesis.machine.names):
        if name in hypothesis.off:
            base[k] = 0.0
    return replace(hypothesis, base=base, values=tuple(values))


def fit(
    simulator: Simulator,
    hypothesis: Hypothesis,
    steps: int = STEPS,
    shared: FloatArray | None = None,
    enough: float = ENOUGH,
) -> Fitted:
    """Fit all free numbers to the rows of role ``fit``.

    Parameters
    ----------
    simulator : Simulator
    hypothesis : Hypothesis
        Start values.
    steps : int
        Most steps.
    shared : ndarray
        Derivatives with respect to the machine's numbers at a hypothesis nearby, (rows, all
        variables): taken for the first steps, which saves most of the time.
    enough : float
        Relative gain of a step from which it is the last.  What the data hardly tell apart is where
        it belongs only if this is small.
    """
    free = free_numbers(hypothesis)
    scales = np.array([f.scale for f in free])
    known = np.array([1.0 / f.known for f in free])
    current = hypothesis
    vector = vector_of(current, free)
    origin = vector_of(replace(hypothesis, base=hypothesis.machine.start), free)
    r = simulator.residual(current, "fit")
    cost = float(r @ r)
    damping, jacobian = 1e-6, np.zeros((r.size, len(free)))
    machine = np.array([f.parameter is None for f in free])
    own = shared is None
    old = None
    if shared is not None:
        old = shared[:, [f.index for f in free if f.parameter is None]]
    for turn in range(steps if np.isfinite(cost) else 0):
        fresh = old is None
        jacobian = derivatives(simulator, current, free, r, old)
        old = jacobian[:, machine]
        rows = np.vstack([jacobian, np.diag(known)])
        side = np.concatenate([r, known * (vector - origin) / scales])
        before = cost + float(np.sum((known * (vector - origin) / scales) ** 2))
        size = np.linalg.norm(rows, axis=0)
        size[size == 0.0] = 1.0
        rows /= size
        values, vectors = np.linalg.eigh(rows.T @ rows)
        values = np.maximum(values, 0.0)
        projected = vectors.T @ (rows.T @ side)
        better = False
        for _ in range(TRIES):
            step = projected / (values + damping)
            move = -(vectors @ step) / size
            tried = with_vector(current, free, _limited(free, vector, scales * move))
            if not tried.machine.physical(tried.base):
                damping = max(10 * damping, 1e-6)
                continue
            reached = vector_of(tried, free)
            r_tried = simulator.residual(tried, "fit")
            after = float(r_tried @ r_tried)
            total = after + float(np.sum((known * (reached - origin) / scales) ** 2))
            if np.isfinite(total) and total < before:
                better = True
                break
            damping = max(10 * damping, 1e-6)
        if not better:
            if fresh:
                break
            old, damping = None, 1e-6
            continue
        gained = before - total
        promised = float(np.sum((values + 2 * damping) * step**2))
        current, vector, r, cost = tried, reached, r_tried, after
        damping = max(damping / 10, 1e-9)
        if gained < enough * max(before, 1e-300) and (own or fresh or turn >= 1):
            break
        if gained < RENEWED * promised:
            old = None
    count = simulator.degrees("fit")
    return _result(current, free, vector, scales, jacobian, known, cost, count)


def strain(fitted: Fitted) -> float:
    """Return by how much a fit asks for zeros of the torques that are not likely: squares, added up."""
    hypothesis = fitted.hypothesis
    return float(
        sum(
            ((value - v.value) / (v.scale * v.known)) ** 2
            for v, value in zip(hypothesis.machine.variables, hypothesis.base, strict=True)
            if v.name.endswith(".offset")
        )
    )


def _limited(free: list[_Free], vector: FloatArray, move: FloatArray) -> FloatArray:
    """Let no number that bends the torque become more than thrice, or less than a third, of itself."""
    moved = vector + move
    for k, f in enumerate(free):
        if f.parameter is not None and not f.parameter.linear and f.parameter.low >= 0.0:
            moved[k] = min(max(moved[k], vector[k] / LARGEST_FACTOR), vector[k] * LARGEST_FACTOR)
    return moved


def derivatives(
    simulator: Simulator,
    hypothesis: Hypothesis,
    free: list[_Free],
    r: FloatArray,
    old: FloatArray | None,
) -> FloatArray:
    """Return the change of the weighted errors per size of each free number, (rows, P).

    Those of the machine's numbers are ``old`` where that is given, (rows, free ones of the machine).
    """
    vector = vector_of(hypothesis, free)
    columns: list[FloatArray] = []
    for k, f in enumerate(free):
        if f.parameter is None and old is not None:
            columns.append(old[:, len(columns)])
            continue
        step = DERIVATIVE * f.scale
        if f.parameter is not None and vector[k] + step > f.parameter.high:
            step = -step
        moved = vector.copy()
        moved[k] += step
        tried = with_vector(hypothesis, free, moved)
        change = (simulator.residual(tried, "fit") - r) / (step / f.scale)
        # Where a machine beside the one at hand runs away, no step is taken towards it.
        columns.append(change if np.all(np.isfinite(change)) else np.zeros_like(change))
    return np.column_stack(columns)


def machine_derivatives(simulator: Simulator, hypothesis: Hypothesis) -> FloatArray:
    """Return the derivatives with respect to every variable of the machine, (rows, V)."""
    bare = replace(hypothesis)
    all_free = [
        _Free(v.name, -1, k, v.scale, v.known, None) for k, v in enumerate(bare.machine.variables)
    ]
    r = simulator.residual(bare, "fit")
    return derivatives(simulator, bare, all_free, r, None)


def _result(
    hypothesis: Hypothesis,
    free: list[_Free],
    vector: FloatArray,
    scales: FloatArray,
    jacobian: FloatArray,
    known: FloatArray,
    cost: float,
    count: int,
) -> Fitted:
    # What is known beforehand is as sure as it is, however well the data are explained.
    level = max(cost / max(count - len(free), 1), 1e-300)
    rows = np.vstack([jacobian / np.sqrt(level), np.diag(known)])
    size = np.linalg.norm(rows, axis=0)
    size[size == 0.0] = 1.0
    _, s, vt = np.linalg.svd(rows / size, full_matrices=False)
    inverse = (vt.T / np.maximum(s, 1e-9 * s[0]) ** 2) @ vt
    shape = scales / size
    covariance = inverse * np.outer(shape, shape)
    std = np.sqrt(np.diag(covariance))
    return Fitted(hypothesis, cost, tuple(f.name for f in free), vector, std, covariance)
