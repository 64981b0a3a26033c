"""The loops over samples, compiled: hidden masses driven by measured motors, and closed loops.

State z of the hidden masses: positions, velocities, branch states.  Between samples the motors'
motion u is a straight line, for which the linear part is exact (first-order hold); the forces g of
elements that are not linear are taken at both ends of a sub-step and joined by a straight line,
too (exponential Runge-Kutta method of second order, Cox and Matthews, J. Comput. Phys. 176, 2002).
"""

import numpy as np
from numpy.typing import NDArray

from drives.compiled import compiled

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CUBIC, GAP, STEP, DRY, SOFT = 1, 2, 3, 4, 5
"""As :class:`fieldtool.criticise.simulate.structure.Law`."""


@compiled()
def plus_row(total: float, matrix: FloatArray, row: int, vector: FloatArray) -> float:
    """Return total plus one row of a matrix times a vector, added up in order."""
    for j in range(vector.size):
        total += matrix[row, j] * vector[j]
    return total


@compiled()
def march(step: FloatArray, pushes: FloatArray, start: FloatArray) -> FloatArray:
    """Return the states (n, S) of z[k+1] = step z[k] + pushes[k] from z[0] = start."""
    n, size = pushes.shape[0] + 1, start.size
    z = np.empty((n, size))
    z[0] = start
    for k in range(n - 1):
        for i in range(size):
            z[k + 1, i] = plus_row(pushes[k, i], step, i, z[k])
    return z


@compiled()
def ring(step: FloatArray, starts: FloatArray, rows: int) -> FloatArray:
    """Return the states (F, rows, S) that nothing pushes, from each initial one (F, S)."""
    count, size = starts.shape
    z = np.empty((count, rows, size))
    for first in range(count):
        z[first, 0] = starts[first]
        for k in range(rows - 1):
            for i in range(size):
                z[first, k + 1, i] = plus_row(0.0, step, i, z[first, k])
    return z


@compiled()
def both_ways(sections: FloatArray, at_rest: FloatArray, values: FloatArray) -> FloatArray:
    """Filter the columns of (n, M) forward and backward; no phase is left, (n, M).

    ``sections`` (K, 6) are those of a filter, ``at_rest`` (K, 2) their states for a constant 1.  Both
    ends are continued by their mirror image through the end, 3 rows for each order.
    """
    n, M = values.shape
    K = sections.shape[0]
    more = min(3 * (2 * K + 1), n - 1)
    out = np.empty((n + 2 * more, M))
    for c in range(M):
        for k in range(more):
            out[k, c] = 2.0 * values[0, c] - values[more - k, c]
            out[n + more + k, c] = 2.0 * values[n - 1, c] - values[n - 2 - k, c]
        for k in range(n):
            out[more + k, c] = values[k, c]
    state = np.empty((M, K, 2))
    last = n + 2 * more - 1
    for way in range(2):
        first = 0 if way == 0 else last
        for c in range(M):
            for s in range(K):
                state[c, s, 0] = at_rest[s, 0] * out[first, c]
                state[c, s, 1] = at_rest[s, 1] * out[first, c]
        for k in range(last + 1):
            row = k if way == 0 else last - k
            for c in range(M):
                x = out[row, c]
                for s in range(K):
                    y = sections[s, 0] * x + state[c, s, 0]
                    state[c, s, 0] = sections[s, 1] * x - sections[s, 4] * y + state[c, s, 1]
                    state[c, s, 1] = sections[s, 2] * x - sections[s, 5] * y
                    x = y
                out[row, c] = x
    return out[more : more + n]


@compiled(error_model="numpy")
def pull(
    law: int, values: FloatArray, s: float, rate: float, t: float, span: float, elapsed: float
) -> float:
    """Return the force with which an element pulls its ends together.

    ``t`` is when the sample began, ``elapsed`` the time since, ``span`` that to the next sample.
    """
    p0, p1, p2, p3 = float(values[0]), float(values[1]), float(values[2]), float(values[3])
    if law == CUBIC:
        return p0 * s * s * s
    if law == GAP:
        linear = p0 * s + p1 * rate
        if s > p2:
            return max(0.0, p0 * (s - p2) + (p1 + p3) * rate) - linear
        if s < -p2:
            return min(0.0, p0 * (s + p2) + (p1 + p3) * rate) - linear
        return -linear
    if law == STEP:
        return p0 * s if t + elapsed * span >= p1 else 0.0
    if law == SOFT:
        return p1 * s * (1.0 / float(np.sqrt(1.0 - 2.0 * p0 * s * s / p1)) - 1.0)
    return p0 * float(np.tanh(rate / p1))


@compiled(error_model="numpy")
def stretch(
    ends: IntArray,
    place: IntArray,
    z: FloatArray,
    hidden: int,
    moved: FloatArray,
    rise: FloatArray,
    parts: float,
) -> tuple[float, float]:
    """Return by how much an element is longer than at rest, and how fast that grows.

    Its two ends are masses, -1 the ground; ``place`` as in :func:`march_bent`.  The motors are where
    they were at the sample, ``moved`` (3 M,), and ``parts`` times ``rise`` further.
    """
    s, rate, M = 0.0, 0.0, rise.size // 3
    for end in range(2):
        if ends[end] >= 0:
            sign = -1.0 if end == 0 else 1.0
            j = place[ends[end]]
            if j >= M:
                s += sign * z[j - M]
                rate += sign * z[hidden + j - M]
            else:
                s += sign * (moved[j] + parts * rise[j])
                rate += sign * (moved[M + j] + parts * rise[M + j])
    return s, rate


@compiled(error_model="numpy")
def march_bent(
    step: FloatArray,
    of_start: FloatArray,
    of_end: FloatArray,
    of_force_start: FloatArray,
    of_force_end: FloatArray,
    inputs: FloatArray,
    start: FloatArray,
    clock: FloatArray,
    substeps: int,
    motors: IntArray,
    hidden: IntArray,
    laws: IntArray,
    ends: IntArray,
    values: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return z (n, S) and the elements' forces on all masses (n, N), at the samples.

    ``of_start`` and ``of_end`` (S, 3 M) are for the inputs at both ends of a sub-step, ``of_force_*``
    (S, H) for the forces on the hidden masses; ``inputs`` (n, 3 M) are q, q', q'' of the motors.
    """
    n, size, E = inputs.shape[0], start.size, laws.size
    count, M, H = motors.size + hidden.size, motors.size, hidden.size
    states, pushed = np.empty((n, size)), np.zeros((n, count))
    # Where each mass finds its motion: the number of a motor, or M + the number of a hidden mass.
    place = np.empty(count, dtype=np.int64)
    for i in range(M):
        place[motors[i]] = i
    for i in range(H):
        place[hidden[i]] = M + i
    # What one unit of an element's pull, at either end of a sub-step, does to the state.
    early, late = np.zeros((E, size)), np.zeros((E, size))
    for e in range(E):
        for end in range(2):
            dof = ends[e, end]
            if dof >= 0 and place[dof] >= M:
                sign = 1.0 if end == 0 else -1.0
                for i in range(size):
                    early[e, i] += sign * of_force_start[i, place[dof] - M]
                    late[e, i] += sign * of_force_end[i, place[dof] - M]
    z, ahead = start.copy(), np.empty(size)
    middle, rising, rise = np.empty(size), np.empty(size), np.empty(3 * M)
    now, then = np.empty(E), np.empty(E)
    period = clock[1] - clock[0]
    for k in range(n):
        for i in range(size):
            states[k, i] = z[i]
        following = k + 1 if k + 1 < n else k
        for j in range(3 * M):
            rise[j] = (inputs[following, j] - inputs[k, j]) / substeps
        for i in range(size):
            middle[i], rising[i] = 0.0, 0.0
            for j in range(3 * M):
                both = of_start[i, j] + of_end[i, j]
                middle[i] += both * inputs[k, j] + of_end[i, j] * rise[j]
                rising[i] += both * rise[j]
        for part in range(substeps):
            for e in range(E):
                s, rate = stretch(ends[e], place, z, H, inputs[k], rise, part)
                now[e] = pull(laws[e], values[e], s, rate, clock[k], period, part / substeps)
                if part == 0:
                    pushed[k, ends[e, 0]] += now[e]
                    if ends[e, 1] >= 0:
                        pushed[k, ends[e, 1]] -= now[e]
            for i in range(size):
                total = plus_row(middle[i] + part * rising[i], step, i, z)
                for e in range(E):
                    total += (early[e, i] + late[e, i]) * now[e]
                ahead[i] = total
            for e in range(E):
                s, rate = stretch(ends[e], place, ahead, H, inputs[k], rise, part + 1)
                later = (part + 1) / substeps
                then[e] = pull(laws[e], values[e], s, rate, clock[k], period, later)
            for i in range(size):
                total = ahead[i]
                for e in range(E):
                    total += late[e, i] * (then[e] - now[e])
                z[i] = total
    return states, pushed


@compiled()
def slider(
    position: FloatArray, forward: FloatArray, backward: FloatArray, reach: float
) -> FloatArray:
    """Return the force of dry friction that builds up over a distance after each turn, (n,).

    It nears ``forward`` (n,) moving up and -``backward`` (n,) moving down, and what it lacks falls to
    1/e within ``reach``.
    Source: Dahl, AIAA Journal 14, 1976, p. 1675 (exponent 1).
    """
    out = np.empty(position.size)
    force = 0.0
    for k in range(position.size):
        if k > 0:
            moved = position[k] - position[k - 1]
            goal = forward[k] if moved > 0.0 else -backward[k]
            if moved != 0.0:
                force = goal + (force - goal) * np.exp(-abs(moved) / reach)
        out[k] = force
    return out
