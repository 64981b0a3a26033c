"""The loops over samples, compiled: hidden masses driven by measured motors, and closed loops.

State z of the hidden masses: positions, velocities, branch states.  Between samples the motors'
motion u is a straight line, for which the linear part is exact (first-order hold); the forces g of
elements that are not linear are taken at both ends of a sub-step and joined by a straight line,
too (exponential Runge-Kutta method of second order, Cox and Matthews, J. Comput. Phys. 176, 2002).
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CUBIC, GAP, STEP, DRY = 1, 2, 3, 4
"""As :class:`fieldtool.criticise.simulate.structure.Law`."""


@njit(cache=True)  # type: ignore[untyped-decorator]
def march(step: FloatArray, forced: FloatArray, start: FloatArray) -> FloatArray:
    """Return z of z[k+1] = step z[k] + forced[k] from z[0] = start, (n, S)."""
    n, size = forced.shape
    states = np.empty((n, size))
    z = start.copy()
    following = np.empty(size)
    for k in range(n):
        for i in range(size):
            states[k, i] = z[i]
        for i in range(size):
            total = forced[k, i]
            for j in range(size):
                total += step[i, j] * z[j]
            following[i] = total
        for i in range(size):
            z[i] = following[i]
    return states


@njit(cache=True)  # type: ignore[untyped-decorator]
def forces(
    laws: IntArray,
    ends: IntArray,
    values: FloatArray,
    x: FloatArray,
    v: FloatArray,
    t: float,
    out: FloatArray,
) -> None:
    """Write the forces of all elements on all masses into ``out``, (n,)."""
    for i in range(out.size):
        out[i] = 0.0
    for e in range(laws.size):
        a, b = ends[e, 0], ends[e, 1]
        p0, p1, p2 = values[e, 0], values[e, 1], values[e, 2]
        s, rate = -x[a], -v[a]
        if b >= 0:
            s += x[b]
            rate += v[b]
        pull = 0.0
        if laws[e] == CUBIC:
            pull = p0 * s * s * s
        elif laws[e] == GAP:
            if s > p2:
                pull = -p0 * p2
            elif s < -p2:
                pull = p0 * p2
            else:
                pull = -p0 * s - p1 * rate
        elif laws[e] == STEP:
            if t >= p1:
                pull = p0 * s
        elif laws[e] == DRY:
            pull = p0 * np.tanh(rate / p1)
        out[a] += pull
        if b >= 0:
            out[b] -= pull


@njit(cache=True)  # type: ignore[untyped-decorator]
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
    n, size = inputs.shape[0], start.size
    count, M, H = motors.size + hidden.size, motors.size, hidden.size
    states, pushed = np.empty((n, size)), np.empty((n, count))
    z, ahead, moved = start.copy(), np.empty(size), np.empty(size)
    x, v = np.empty(count), np.empty(count)
    g, g_ahead = np.empty(count), np.empty(count)
    u, u_next = np.empty(3 * M), np.empty(3 * M)
    h = (clock[1] - clock[0]) / substeps
    for k in range(n):
        for i in range(size):
            states[k, i] = z[i]
        following = k + 1 if k + 1 < n else k
        for part in range(substeps):
            share, share_next = part / substeps, (part + 1) / substeps
            for i in range(3 * M):
                rise = inputs[following, i] - inputs[k, i]
                u[i] = inputs[k, i] + share * rise
                u_next[i] = inputs[k, i] + share_next * rise
            for i in range(M):
                x[motors[i]], v[motors[i]] = u[i], u[M + i]
            for i in range(H):
                x[hidden[i]], v[hidden[i]] = z[i], z[H + i]
            forces(laws, ends, values, x, v, clock[k] + part * h, g)
            if part == 0:
                for i in range(count):
                    pushed[k, i] = g[i]
            for i in range(size):
                total = 0.0
                for j in range(size):
                    total += step[i, j] * z[j]
                for j in range(3 * M):
                    total += of_start[i, j] * u[j] + of_end[i, j] * u_next[j]
                for j in range(H):
                    total += (of_force_start[i, j] + of_force_end[i, j]) * g[hidden[j]]
                ahead[i] = total
            for i in range(M):
                x[motors[i]], v[motors[i]] = u_next[i], u_next[M + i]
            for i in range(H):
                x[hidden[i]], v[hidden[i]] = ahead[i], ahead[H + i]
            forces(laws, ends, values, x, v, clock[k] + (part + 1) * h, g_ahead)
            for i in range(size):
                total = ahead[i]
                for j in range(H):
                    total += of_force_end[i, j] * (g_ahead[hidden[j]] - g[hidden[j]])
                moved[i] = total
            for i in range(size):
                z[i] = moved[i]
    return states, pushed


@njit(cache=True)  # type: ignore[untyped-decorator]
def slider(
    position: FloatArray, forward: FloatArray, backward: FloatArray, reach: float
) -> FloatArray:
    """Return the force of a spring in series with a dry slider (Jenkins element), (n,).

    It yields at ``forward`` (n,) moving up and at -``backward`` (n,) moving down; between, it changes by
    the mean of both over ``reach`` per distance.
    """
    out = np.empty(position.size)
    force = 0.0
    for k in range(position.size):
        if k > 0:
            stiffness = (abs(forward[k]) + abs(backward[k])) / (2.0 * reach)
            force += stiffness * (position[k] - position[k - 1])
        up, down = max(forward[k], 0.0), -max(backward[k], 0.0)
        if force > up:
            force = up
        elif force < down:
            force = down
        out[k] = force
    return out
