"""Torque that a structure needs for the motion that was measured.

The motors follow the measured positions; the hidden masses (loads behind springs) move as the
structure lets them.  This system is stable whatever the machine's rigid-body modes do, so
it holds for records in open loop, too: the torque that is measured less the torque that is needed
is what the model does not know, as a torque at each motor.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from fieldtool.criticise.simulate.kernels import march, march_bent, ring
from fieldtool.criticise.simulate.motion import Motion
from fieldtool.criticise.simulate.structure import Law, Structure

FloatArray = NDArray[np.float64]
LARGEST_TURN, LARGEST_TURN_GAP = 0.25, 0.1
"""Of the fastest hidden mode in one sub-step, rad, where elements are not linear, or jump."""
MOST_SUBSTEPS = 32
FADED = 1e-3
"""Of its first size: a free motion counts as gone."""
FEWEST_FREE = 100
"""Rows of a free motion at least."""


@dataclass(frozen=True, eq=False)
class HiddenSystem:
    """z' = A z + B u + G g of the hidden masses, u = (q, q', q'') of the motors."""

    structure: Structure
    rates: FloatArray
    """A, (S, S)."""
    inputs: FloatArray
    """B, (S, 3 M)."""
    pushed: FloatArray
    """G, (S, H)."""

    @classmethod
    def of(cls, structure: Structure) -> "HiddenSystem":
        """Cut the structure at its motors."""
        hidden, motors = structure.hidden, structure.motors
        H, M, W = hidden.size, motors.size, len(structure.branches)
        M_, C = structure.mass, structure.damping
        inverse = np.linalg.inv(M_[np.ix_(hidden, hidden)])
        size = 2 * H + W
        rates, inputs = np.zeros((size, size)), np.zeros((size, 3 * M))
        rates[:H, H : 2 * H] = np.eye(H)
        stiff, stiff_w = _with_branches(structure)
        rates[H : 2 * H, :H] = -inverse @ stiff[np.ix_(hidden, hidden)]
        rates[H : 2 * H, H : 2 * H] = -inverse @ C[np.ix_(hidden, hidden)]
        rates[H : 2 * H, 2 * H :] = -inverse @ stiff_w[hidden]
        inputs[H : 2 * H, :M] = -inverse @ stiff[np.ix_(hidden, motors)]
        inputs[H : 2 * H, M : 2 * M] = -inverse @ C[np.ix_(hidden, motors)]
        inputs[H : 2 * H, 2 * M :] = -inverse @ M_[np.ix_(hidden, motors)]
        place = {int(dof): (k, rates) for k, dof in enumerate(hidden)}
        place |= {int(dof): (k, inputs) for k, dof in enumerate(motors)}
        for w, branch in enumerate(structure.branches):
            for dof, sign in ((branch.first, -1.0), (branch.second, 1.0)):
                column, matrix = place[dof]
                matrix[2 * H + w, column] += sign / branch.time
            rates[2 * H + w, 2 * H + w] = -1.0 / branch.time
        pushed = np.zeros((size, H))
        pushed[H : 2 * H] = inverse
        return cls(structure, rates, inputs, pushed)

    def held(self, step: float) -> tuple[FloatArray, ...]:
        """Return Ad, and for inputs and forces what their values at both ends of a step add."""
        size, forced = self.rates.shape[0], np.hstack([self.inputs, self.pushed])
        many = forced.shape[1]
        block = np.zeros((size + 2 * many, size + 2 * many))
        block[:size, :size] = self.rates * step
        block[:size, size : size + many] = forced * step
        block[size : size + many, size + many :] = np.eye(many)
        exponential = expm(block)
        whole = exponential[:size, size : size + many]
        late = exponential[:size, size + many :]
        early, cut = whole - late, self.inputs.shape[1]
        return (
            np.ascontiguousarray(exponential[:size, :size]),
            np.ascontiguousarray(early[:, :cut]),
            np.ascontiguousarray(late[:, :cut]),
            np.ascontiguousarray(early[:, cut:]),
            np.ascontiguousarray(late[:, cut:]),
        )

    def free_torques(self, step: float, rows: int) -> FloatArray:
        """Return the motors' torques for each initial hidden state, motors at rest, (2 H, n, M).

        What has faded to :data:`FADED` of its size is left out, and n is no more than ``rows``.
        """
        starts = np.eye(self.rates.shape[0])[: 2 * self.structure.hidden.size]
        return self.free_from(starts, step, self.audible(step, rows))

    def free_from(self, starts: FloatArray, step: float, rows: int) -> FloatArray:
        """Return the motors' torques for each initial state (F, S), motors at rest, (F, rows, M)."""
        size = self.rates.shape[0]
        advance = np.ascontiguousarray(expm(self.rates * step)) if size else np.zeros((0, 0))
        return np.asarray(ring(advance, starts, rows) @ self.readout[0].T)

    def audible(self, step: float, rows: int) -> int:
        """Return the rows after which a free motion has faded, no more than ``rows``."""
        slowest = -float(np.linalg.eigvals(self.rates).real.max(initial=-np.inf))
        if slowest * rows * step > -np.log(FADED):
            rows = min(rows, max(FEWEST_FREE, int(np.ceil(-np.log(FADED) / (slowest * step)))))
        return rows

    @cached_property
    def readout(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """What turns states, inputs and forces into the motors' torques: (M, S), (M, 3 M), (M, N)."""
        s = self.structure
        hidden, motors = s.hidden, s.motors
        H, M = hidden.size, motors.size
        stiff, stiff_w = _with_branches(s)
        inertia = s.mass[np.ix_(motors, hidden)]
        of_state = inertia @ self.rates[H : 2 * H]
        of_state[:, :H] += stiff[np.ix_(motors, hidden)]
        of_state[:, H : 2 * H] += s.damping[np.ix_(motors, hidden)]
        of_state[:, 2 * H :] += stiff_w[motors]
        of_input = inertia @ self.inputs[H : 2 * H]
        of_input += np.hstack([m[np.ix_(motors, motors)] for m in (stiff, s.damping, s.mass)])
        of_force = np.zeros((M, s.mass.shape[0]))
        of_force[:, hidden] = inertia @ self.pushed[H : 2 * H]
        of_force[np.arange(M), motors] = -1.0
        return of_state, of_input, of_force


@dataclass(frozen=True, eq=False)
class Driven:
    """A structure, ready to be driven by motions of one step: what all of them have in common."""

    structure: Structure
    system: HiddenSystem
    step: float
    """Of the motions, s."""

    @classmethod
    def of(cls, structure: Structure, step: float) -> "Driven":
        """Cut the structure at its motors."""
        return cls(structure, HiddenSystem.of(structure), step)

    @cached_property
    def substeps(self) -> int:
        """Sub-steps that resolve the fastest swing; what only decays is exact, follows the masses."""
        rates = np.linalg.eigvals(self.system.rates)
        fastest = float(np.abs(rates[rates.imag != 0.0]).max(initial=0.0))
        gap = any(e.law is Law.GAP for e in self.structure.elements)
        turn = fastest * self.step / (LARGEST_TURN_GAP if gap else LARGEST_TURN)
        return int(np.clip(np.ceil(turn), 1, MOST_SUBSTEPS))

    @cached_property
    def tables(self) -> tuple[FloatArray, ...]:
        """What one step, or one sub-step where there are elements, adds to the state."""
        return self.system.held(self.step / (self.substeps if self.structure.elements else 1))

    def needed(self, motion: Motion) -> FloatArray:
        """Return the torque that each motor needs for the measured motion, (n, M).

        The hidden masses start with their springs as relaxed as the first row lets them, at their
        motor's velocity; what this is wrong by decays with their damping (see
        :meth:`HiddenSystem.free_torques`).
        """
        u, structure = motion.inputs, self.structure
        of_state, of_input, of_force = self.system.readout
        if structure.hidden.size == 0 and not structure.elements:
            return np.asarray(u @ of_input.T)
        start = _start(structure, motion)
        if not structure.elements:
            advance, early, late, _, _ = self.tables
            pushes = motion.driven[:-1] @ early.T + motion.driven[1:] @ late.T
            return np.asarray(u @ of_input.T + march(advance, pushes, start) @ of_state.T)
        z, g = march_bent(
            *self.tables,
            motion.driven,
            start,
            motion.clock,
            self.substeps,
            structure.motors.astype(np.int64),
            structure.hidden.astype(np.int64),
            np.array([int(e.law) for e in structure.elements], dtype=np.int64),
            np.array([(e.first, e.second) for e in structure.elements], dtype=np.int64),
            np.array([e.values for e in structure.elements], dtype=np.float64),
        )
        return np.asarray(u @ of_input.T + z @ of_state.T + g @ of_force.T)


def needed_torque(structure: Structure, motion: Motion) -> FloatArray:
    """Return the torque that each motor needs for the measured motion, (n, M)."""
    return Driven.of(structure, motion.step).needed(motion)


def dynamic_stiffness(structure: Structure, omega: FloatArray) -> NDArray[np.complex128]:
    """Return torque of motor [row] per position of motor [column], (L, M, M), without elements."""
    w = omega[:, None, None]
    whole = structure.stiffness + 1j * w * structure.damping - w**2 * structure.mass
    hidden, motors = structure.hidden, structure.motors
    out = whole[:, motors[:, None], motors]
    if hidden.size:
        # A hair of damping, so that no line falls on an undamped mode of the hidden masses.
        inner = whole[:, hidden[:, None], hidden] + 1e-6j * np.abs(structure.stiffness).max()
        moved = np.linalg.solve(inner, whole[:, hidden[:, None], motors])
        out = out - whole[:, motors[:, None], hidden] @ moved
    return np.asarray(out)


def passed_on(structure: Structure, omega: float) -> NDArray[np.complex128]:
    """Return what motor [row] needs besides per torque on the last mass of axis [column], (M, M).

    The motors' motion is given; where the last mass is the motor, it needs that torque less.
    """
    whole = structure.stiffness + 1j * omega * structure.damping - omega**2 * structure.mass
    hidden, motors = structure.hidden, structure.motors
    out = -np.eye(motors.size, dtype=complex)
    inner = whole[np.ix_(hidden, hidden)] + 1e-6j * np.abs(structure.stiffness).max(initial=0.0)
    for axis, end in enumerate(structure.ends):
        if end in hidden:
            side = (hidden == end).astype(complex)
            out[:, axis] = whole[np.ix_(motors, hidden)] @ np.linalg.solve(inner, side)
    return out


def _start(structure: Structure, motion: Motion) -> FloatArray:
    """Each hidden mass where its chain's motor is, at the same velocity."""
    hidden = structure.hidden
    H = hidden.size
    z = np.zeros(2 * H + len(structure.branches))
    nearest = np.searchsorted(structure.motors, hidden, side="right") - 1
    beyond = hidden > structure.ends[-1]
    for k in np.flatnonzero(beyond):
        row = structure.stiffness[hidden[k]]
        base = int(np.argmin(row[: structure.ends[-1] + 1]))
        nearest[k] = int(np.searchsorted(structure.motors, base, side="right") - 1)
    z[:H] = motion.position[0, nearest]
    z[H : 2 * H] = motion.velocity[0, nearest]
    return z


def _with_branches(structure: Structure) -> tuple[FloatArray, FloatArray]:
    """Return K with the branches' springs, (N, N), and their forces per branch state, (N, W)."""
    stiff = structure.stiffness.copy()
    states = np.zeros((stiff.shape[0], len(structure.branches)))
    for w, branch in enumerate(structure.branches):
        a, b, k = branch.first, branch.second, branch.stiffness
        stiff[np.ix_([a, b], [a, b])] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
        states[a, w], states[b, w] = k, -k
    return stiff, states
