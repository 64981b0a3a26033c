"""Forces of elements with a bend or a memory, and what stands between drive and shaft, compiled.

Forces are those of the middle of an inner step, as if the velocities at its beginning were constant
over it; the memory is brought to its end (exactly, where a differential equation stands behind).  They
are held over the step.  Elements are to be soft on its scale: stiffness times step squared well below
the masses.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drives.compiled import compiled
from drives.sim.effects.shapes import ElementKind

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class Elements(NamedTuple):
    """E elements, and F masses that they push."""

    kinds: IntArray
    """Shape (E,)."""
    ends: IntArray
    """Numbers of the two masses, shape (E, 2); -1 is ground."""
    slots: IntArray
    """Places of the two masses among those that are pushed, shape (E, 2)."""
    values: FloatArray
    """Shape (E, ELEMENT_VALUES)."""
    memory: FloatArray
    """Shape (E, ELEMENT_MEMORY), changed."""


class Shafts(NamedTuple):
    """What M motors and encoders add to the drives' own numbers."""

    scale: FloatArray
    """Torque of the motor over that reported, shape (M,)."""
    saturation: FloatArray
    """Torque that the motor never exceeds, N m, shape (M,); infinite: none."""
    lag: FloatArray
    """Decay of the torque's lag over a step, and its mean over the step, shape (M, 2); 0, 0: none."""
    lagged: FloatArray
    """Torque in the winding, N m, shape (M,), changed."""
    encoder: FloatArray
    """rad of track per rad, offsets of cosine and sine, shape (M, 3); 0: ideal."""
    delays: IntArray
    """Inner steps from encoder to the host, shape (M,)."""
    queue: FloatArray
    """Counts of the last D steps, shape (M, D), changed."""
    places: IntArray
    """Where the queues' newest entries are, shape (1,), changed."""


@compiled()
def _bristles(p, memory, velocity, step):  # type: ignore[no-untyped-def]
    sliding = p[0] if velocity >= 0.0 else p[1]
    sliding *= 1.0 + (p[2] - 1.0) * np.exp(-((velocity / p[3]) ** 2))
    before = memory[0]
    after = before + velocity * step
    if velocity != 0.0:
        settled = np.copysign(sliding / p[4], velocity)
        after = settled + (before - settled) * np.exp(-p[4] * abs(velocity) * step / sliding)
    memory[0] = after
    return p[4] * 0.5 * (before + after) + p[5] * (after - before) / step


@compiled()
def _gap(p, memory, twist, velocity):  # type: ignore[no-untyped-def]
    """What the joint pulls, less what the matrices have already."""
    linear = p[1] * twist + p[2] * velocity
    depth = abs(twist) - p[0]
    if depth <= 0.0:
        memory[0] = 0.0
        return -linear
    closing = velocity if twist > 0.0 else -velocity
    if memory[0] == 0.0:
        memory[0], memory[1] = 1.0, 1e-9
    memory[1] = max(memory[1], closing)
    lost = p[3] * closing / memory[1] * p[0] / (p[0] + depth)
    contact = p[1] * depth * max(1.0 + lost, 0.0) + p[2] * closing
    return np.copysign(max(contact, 0.0), twist) - linear


@compiled()
def _pulled(kind, p, memory, twist, velocity, time, step):  # type: ignore[no-untyped-def]
    """Force against the twist (or motion) of one element."""
    if kind == ElementKind.BRISTLES:
        return _bristles(p, memory, velocity, step)
    if kind == ElementKind.GAP:
        return _gap(p, memory, twist, velocity)
    if kind == ElementKind.HARDENING:
        return p[0] * (p[1] * np.sinh(min(max(twist / p[1], -30.0), 30.0)) - twist)
    if kind == ElementKind.SOFTENING:
        return p[0] * (p[1] * np.tanh(twist / p[1]) - twist)
    if kind == ElementKind.MAXWELL:
        middle = velocity + 0.5 * (velocity - memory[1])
        memory[1] = velocity
        before, settled = memory[0], p[0] * p[1] * middle
        memory[0] = settled + (before - settled) * np.exp(-step / p[1])
        return 0.5 * (before + memory[0])
    if kind == ElementKind.SPRING_STEP:
        return p[0] * min(max((time - p[1]) / p[2], 0.0), 1.0) * twist
    if kind == ElementKind.PENDULUM:
        return p[0] * (p[1] * np.sin(twist) + p[2] * np.cos(twist))
    if kind == ElementKind.CONSTANT:
        return -p[0]
    if kind == ElementKind.MAGNETS:
        x = p[1] * twist + p[2]
        return p[0] * np.exp(p[3] * np.cos(x)) * np.sin(x)
    # a rotor: it turns by one step
    if memory[0] == 0.0 and memory[1] == 0.0:
        memory[0], memory[1] = np.cos(p[1] * time + p[2]), np.sin(p[1] * time + p[2])
    c, s = np.cos(p[1] * step), np.sin(p[1] * step)
    x, y = memory[0], memory[1]
    size = 1.5 - 0.5 * (x * x + y * y)
    memory[0], memory[1] = size * (x * c - y * s), size * (x * s + y * c)
    return -p[0] * x


@compiled()
def element_forces(state, elements, time, step, forces):  # type: ignore[no-untyped-def]
    """Write the forces of all elements, shape (F,), for a state (q, q'), shape (2n,)."""
    size = state.size // 2
    forces[:] = 0.0
    for e in range(elements.kinds.size):
        first, second = elements.ends[e, 0], elements.ends[e, 1]
        if second < 0:
            velocity = state[size + first]
            twist = state[first] + 0.5 * step * velocity
            pull = _pulled(
                elements.kinds[e],
                elements.values[e],
                elements.memory[e],
                twist,
                velocity,
                time,
                step,
            )
            forces[elements.slots[e, 0]] -= pull
        else:
            velocity = state[size + second] - state[size + first]
            twist = state[second] - state[first] + 0.5 * step * velocity
            pull = _pulled(
                elements.kinds[e],
                elements.values[e],
                elements.memory[e],
                twist,
                velocity,
                time,
                step,
            )
            forces[elements.slots[e, 0]] += pull
            forces[elements.slots[e, 1]] -= pull


@compiled()
def delivered(axis, torque, shafts):  # type: ignore[no-untyped-def]
    """Mean torque at the shaft over a step for the mean torque that the drive reports."""
    given = torque * shafts.scale[axis]
    limit = shafts.saturation[axis]
    if limit < np.inf:
        given /= (1.0 + (given / limit) ** 6) ** (1.0 / 6.0)
    behind = shafts.lagged[axis] - given
    shafts.lagged[axis] = given + shafts.lag[axis, 0] * behind
    return given + shafts.lag[axis, 1] * behind


@compiled()
def seen(axis, position, shafts):  # type: ignore[no-untyped-def]
    """Position that the encoder shows of the shaft's."""
    rate = shafts.encoder[axis, 0]
    if rate == 0.0:
        return position
    x = rate * position
    cosine, sine = np.cos(x), np.sin(x)
    c, s = cosine + shafts.encoder[axis, 1], sine + shafts.encoder[axis, 2]
    return position + np.arctan2(s * cosine - c * sine, c * cosine + s * sine) / rate


@compiled()
def queue_counts(axis, counts, shafts):  # type: ignore[no-untyped-def]
    """Put an axis' counts into its queue, at the newest place."""
    shafts.queue[axis, shafts.places[0]] = counts


@compiled()
def late_counts(shafts, counts):  # type: ignore[no-untyped-def]
    """Overwrite counts, shape (M,), by what has come out of the queues."""
    length = shafts.queue.shape[1]
    for axis in range(counts.size):
        if shafts.delays[axis] > 0:
            place = (shafts.places[0] - shafts.delays[axis]) % length
            counts[axis] = np.int64(shafts.queue[axis, place])
