"""Torque that a structure needs for the motion that was measured.

The motors follow the measured positions; the hidden masses (loads behind springs) move as the
structure lets them.  This system is stable whatever the machine's rigid-body modes do, so
it holds for records in open loop, too: the torque that is measured less the torque that is needed
is what the model does not know, as a torque at each motor.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from fieldtool.criticise.simulate.kernels import march, march_bent
from fieldtool.criticise.simulate.motion import Motion
from fieldtool.criticise.simulate.structure import Structure

FloatArray = NDArray[np.float64]
LARGEST_TURN = 0.25
"""Of the fastest hidden mode in one sub-step, rad, where elements are not linear."""
MOST_SUBSTEPS = 32


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
        """Return the motors' torques for each initial hidden state, motors at rest, (2 H, n, M)."""
        H = self.structure.hidden.size
        advance = self.held(step)[0]
        none = np.zeros((rows, self.rates.shape[0]))
        out = np.empty((2 * H, rows, self.structure.motors.size))
        still = np.zeros((rows, self.inputs.shape[1]))
        for k in range(2 * H):
            start = np.zeros(self.rates.shape[0])
            start[k] = 1.0
            out[k] = self.torque(march(advance, none, start), still, None)
        return out

    def torque(self, z: FloatArray, u: FloatArray, g: FloatArray | None) -> FloatArray:
        """Return the motors' torques, (n, M), for states (n, S), inputs (n, 3 M) and forces (n, N)."""
        s = self.structure
        hidden, motors = s.hidden, s.motors
        H, M = hidden.size, motors.size
        stiff, stiff_w = _with_branches(s)
        rows = [s.mass[motors], s.damping[motors], stiff[motors]]
        q, v, a = u[:, :M], u[:, M : 2 * M], u[:, 2 * M :]
        out = a @ rows[0][:, motors].T + v @ rows[1][:, motors].T + q @ rows[2][:, motors].T
        if H:
            moved = z @ self.rates[H : 2 * H].T + u @ self.inputs[H : 2 * H].T
            if g is not None:
                moved = moved + g[:, hidden] @ self.pushed[H : 2 * H].T
            out += moved @ rows[0][:, hidden].T + z[:, H : 2 * H] @ rows[1][:, hidden].T
            out += z[:, :H] @ rows[2][:, hidden].T + z[:, 2 * H :] @ stiff_w[motors].T
        if g is not None:
            out = out - g[:, motors]
        return np.asarray(out, dtype=np.float64)


def needed_torque(structure: Structure, motion: Motion) -> FloatArray:
    """Return the torque that each motor needs for the measured motion, (n, M).

    The hidden masses start with their springs as relaxed as the first row lets them, at their motor's
    velocity; what this is wrong by decays with their damping (see :meth:`HiddenSystem.free_torques`).
    """
    u = np.hstack([motion.position, motion.velocity, motion.acceleration])
    if structure.hidden.size == 0 and not structure.elements:
        return HiddenSystem.of(structure).torque(np.zeros((motion.rows, 0)), u, None)
    system = HiddenSystem.of(structure)
    start = _start(structure, motion)
    driven = _compensated(u)
    if not structure.elements:
        advance, early, late, _, _ = system.held(motion.step)
        following = np.vstack([driven[1:], driven[-1:]])
        z = march(advance, driven @ early.T + following @ late.T, start)
        return system.torque(z, u, None)
    substeps = _substeps(system, motion.step)
    tables = system.held(motion.step / substeps)
    z, g = march_bent(
        *tables,
        np.ascontiguousarray(driven),
        start,
        motion.clock,
        substeps,
        structure.motors.astype(np.int64),
        structure.hidden.astype(np.int64),
        np.array([int(e.law) for e in structure.elements], dtype=np.int64),
        np.array([(e.first, e.second) for e in structure.elements], dtype=np.int64),
        np.array([e.values for e in structure.elements], dtype=np.float64),
    )
    return system.torque(z, u, g)


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


def _compensated(u: FloatArray) -> FloatArray:
    """Straight lines between samples are weaker than the motion by (w Ts)**2 / 12; take that back."""
    out = u.copy()
    out[1:-1] -= (u[2:] - 2.0 * u[1:-1] + u[:-2]) / 12.0
    return out


def _substeps(system: HiddenSystem, step: float) -> int:
    fastest = float(np.abs(np.linalg.eigvals(system.rates)).max(initial=0.0))
    return int(np.clip(np.ceil(fastest * step / LARGEST_TURN), 1, MOST_SUBSTEPS))


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
