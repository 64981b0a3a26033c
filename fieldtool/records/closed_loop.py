"""An elastic model under its drives' loops: what references do, in frequency and in time.

Each axis that is not free has a cascade, as servo drives have it::

    e = position_p (r - q) + velocity_ff r' - q'
    torque = filters( velocity_p e + velocity_i integral(e) + viscous_ff r' + inertia_ff r'' + offset )

q is the motor's position, r its reference, offset a torque that the host adds.  Drives run these
loops at several kHz with a current loop of about 1 kHz; both are left out here, which holds while
modes and loop bandwidths stay below some 100 Hz.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from fieldtool.records.model import FloatArray, MachineModel

ComplexArray = NDArray[np.complex128]
RIGID = 1e-5
"""Of the largest eigenvalue: below it is the rigid motion of a floating axis (a double zero)."""
ROUNDING = 1e-10
"""Of the largest eigenvalue: growth that only rounding shows."""


@dataclass(frozen=True)
class Biquad:
    """(n2 s^2 + n1 s + n0) / (s^2 + d1 s + d0), a filter of the torque reference."""

    numerator: tuple[float, float, float]
    """n2, n1, n0."""
    denominator: tuple[float, float]
    """d1, d0."""

    @classmethod
    def notch(cls, frequency: float, zero_damping: float, pole_damping: float) -> "Biquad":
        """Return a notch at a frequency in Hz."""
        w = 2 * np.pi * frequency
        return cls((1.0, 2 * zero_damping * w, w * w), (2 * pole_damping * w, w * w))

    @classmethod
    def low_pass(cls, frequency: float, damping: float) -> "Biquad":
        """Return a second-order low-pass with its corner at a frequency in Hz."""
        w = 2 * np.pi * frequency
        return cls((0.0, 0.0, w * w), (2 * damping * w, w * w))

    def response(self, s: NDArray[np.complexfloating[Any, Any]]) -> ComplexArray:
        """Return the value at complex frequencies s, rad/s."""
        n2, n1, n0 = self.numerator
        d1, d0 = self.denominator
        return np.asarray((n2 * s * s + n1 * s + n0) / (s * s + d1 * s + d0))


@dataclass(frozen=True)
class AxisLoop:
    """One drive's controller, SI."""

    position_p: float
    """1/s."""
    velocity_p: float
    """N m s/rad or N s/m."""
    velocity_i: float
    """N m/rad or N/m."""
    velocity_ff: float = 1.0
    """Share of the reference's velocity that is fed forward."""
    inertia_ff: float = 0.0
    """kg m2 or kg."""
    filters: tuple[Biquad, ...] = ()
    viscous_ff: float = 0.0
    """N m s/rad or N s/m: torque per velocity of the reference, against friction."""

    def filtered(self, s: NDArray[np.complexfloating[Any, Any]]) -> ComplexArray:
        """Return the filters' gain at complex frequencies, rad/s, shape of ``s``."""
        gain = np.ones(s.shape, dtype=np.complex128)
        for biquad in self.filters:
            gain = gain * biquad.response(s)
        return gain

    def torque_shape(self, s: complex) -> complex:
        """Return the filters' gain at a complex frequency, rad/s."""
        return complex(self.filtered(np.array([s]))[0])

    def gain_of_reference(self, s: complex) -> complex:
        """Return torque per reference with the axis locked, at a complex frequency, rad/s."""
        share = (self.position_p + s * self.velocity_ff) / (self.position_p + s)
        fed = self.viscous_ff * s + self.inertia_ff * s * s
        return self.gain(s) * share + self.torque_shape(s) * fed

    def gain(self, s: complex) -> complex:
        """Return torque per position error at a complex frequency, rad/s."""
        pi = self.velocity_p + self.velocity_i / s
        return pi * (self.position_p + s) * self.torque_shape(s)


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A model and one loop an axis; None where the axis floats."""

    model: MachineModel
    loops: tuple[AxisLoop | None, ...]

    def __post_init__(self) -> None:
        if len(self.loops) != len(self.model.axes):
            raise ValueError(f"{len(self.model.axes)} axes need as many loops")

    def response(self, omega: FloatArray, axis: int) -> tuple[ComplexArray, ComplexArray]:
        """Return what a unit sine reference of one axis does at steady state.

        Parameters
        ----------
        omega
            Frequencies, shape (F,), rad/s, positive.
        axis
            Index of the axis whose reference moves; the others' references stand still.

        Returns
        -------
        position, torque
            Phasors of all motors, shape (F, M).
        """
        model, m = self.model, len(self.loops)
        mass, damping, stiffness = (
            model.mass_matrix,
            model.damping_matrix,
            model.stiffness_matrix,
        )
        motors = model.first_masses
        position = np.empty((omega.size, m), dtype=np.complex128)
        torque = np.empty_like(position)
        for f, w in enumerate(omega):
            s = 1j * w
            dynamic = stiffness + s * damping + s * s * mass
            load = np.zeros(dynamic.shape[0], dtype=np.complex128)
            gain = np.zeros(m, dtype=np.complex128)
            drive = 0j
            for k, loop in enumerate(self.loops):
                if loop is None:
                    continue
                gain[k] = loop.gain(s)
                if k == axis:
                    drive = loop.gain_of_reference(s)
            dynamic[motors, motors] += gain
            load[motors[axis]] = drive
            q = np.linalg.solve(dynamic, load)[motors]
            position[f] = q
            torque[f] = -gain * q
            torque[f, axis] += drive
        return position, torque

    def compliance(self, omega: FloatArray, axis: int) -> ComplexArray:
        """Return one axis' motor position per torque on it, its own loop open, the others closed.

        Parameters
        ----------
        omega
            Frequencies, shape (F,), rad/s, positive.
        axis
            Index of the axis.

        Returns
        -------
        ndarray
            Shape (F,), rad/(N m) or m/N.
        """
        model = self.model
        motors = model.first_masses
        result = np.empty(omega.size, dtype=np.complex128)
        load = np.zeros(model.mass_matrix.shape[0])
        load[motors[axis]] = 1.0
        mass, damping, stiffness = (
            model.mass_matrix,
            model.damping_matrix,
            model.stiffness_matrix,
        )
        for f, w in enumerate(omega):
            s = 1j * w
            dynamic = stiffness + s * damping + s * s * mass
            for k, loop in enumerate(self.loops):
                if loop is not None and k != axis:
                    dynamic[motors[k], motors[k]] += loop.gain(s)
            result[f] = np.linalg.solve(dynamic, load)[motors[axis]]
        return result

    def system_matrix(self) -> FloatArray:
        """Return A of x' = A x with all references at rest; its eigenvalues tell stability."""
        return self._matrices()[0]

    @property
    def stable(self) -> bool:
        """Whether no motion grows, the rigid motion of floating axes left out.

        A floating chain without dampers, not coupled to a controlled axis, swings for ever; its
        eigenvalues come out beside the imaginary axis by rounding, and do not count as growing.
        """
        values = np.linalg.eigvals(self.system_matrix())
        scale = float(np.abs(values).max())
        moving = values[np.abs(values) > RIGID * scale]
        return bool(np.all(moving.real < ROUNDING * scale))

    def simulate(
        self, references: FloatArray, step: float, torque_offset: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return motor positions and torques along sampled references, from rest.

        Parameters
        ----------
        references
            Shape (n, M), rad or m, relative to the start, linear from sample to sample.
        step
            Seconds between samples.
        torque_offset
            Added to the torques that the loops ask for, before their filters, shape (n, M), N m or N,
            held from sample to sample; on a floating axis it does nothing.

        Returns
        -------
        position, torque
            Shape (n, M) each.
        """
        a, b_r, b_v, c_x, c_r, c_v = self._matrices()
        n, m = references.shape
        size = a.shape[0]
        # Exact for references that are linear between samples: x' = A x + (Br r0 + Bv v) + Br v t.
        block = np.zeros((size + 2 * m, size + 2 * m))
        block[:size, :size] = a
        block[:size, size : size + m] = b_r
        block[:size, size + m : size + 2 * m] = b_v
        block[size : size + m, size + m : size + 2 * m] = np.eye(m)
        exponential = expm(block * step)
        f = np.ascontiguousarray(exponential[:size, :size])
        g_r = exponential[:size, size : size + m]
        g_v = exponential[:size, size + m : size + 2 * m]
        velocity = np.diff(references, axis=0, append=references[-1:]) / step
        forced = references @ g_r.T + velocity @ g_v.T
        direct = np.zeros((n, m))
        if torque_offset is not None:
            b_t, c_t = self._offset_matrices()
            held = np.block([[a, b_t], [np.zeros((m, size + m))]])
            forced += torque_offset @ expm(held * step)[:size, size:].T
            direct = torque_offset @ c_t.T
        states = np.empty((n, size))
        x = np.zeros(size)
        for k in range(n):
            states[k] = x
            x = f @ x + forced[k]
        position = states[:, self.model.first_masses]
        torque = states @ c_x.T + references @ c_r.T + velocity @ c_v.T + direct
        return position, torque

    def _offset_matrices(self) -> tuple[FloatArray, FloatArray]:
        """Return B_t and C_t: what torque offsets u add to x' and to the torques."""
        model, m = self.model, len(self.loops)
        n = model.mass_matrix.shape[0]
        b_t, c_t = np.zeros((self.system_matrix().shape[0], m)), np.zeros((m, m))
        place = 2 * n
        for k, loop in enumerate(self.loops):
            if loop is None:
                continue
            place += 1
            share = 1.0
            for biquad in loop.filters:
                b_t[place + 1, k] = share
                share *= biquad.numerator[0]
                place += 2
            c_t[k, k] = share
        b_t[n : 2 * n] += np.linalg.inv(model.mass_matrix)[:, model.first_masses] @ c_t
        return b_t, c_t

    def _matrices(self) -> tuple[FloatArray, ...]:
        """Return A, B_r, B_v, C_x, C_r, C_v: torques are C_x x + C_r r + C_v r'.

        State: positions, velocities, one integrator a controlled axis, two states a filter.
        """
        model, m = self.model, len(self.loops)
        mass, damping, stiffness = (
            model.mass_matrix,
            model.damping_matrix,
            model.stiffness_matrix,
        )
        n = mass.shape[0]
        extra = sum(1 + 2 * len(loop.filters) for loop in self.loops if loop is not None)
        size = 2 * n + extra
        a = np.zeros((size, size))
        b_r, b_v = np.zeros((size, m)), np.zeros((size, m))
        c_x, c_r, c_v = np.zeros((m, size)), np.zeros((m, m)), np.zeros((m, m))
        a[:n, n : 2 * n] = np.eye(n)
        a[n : 2 * n, :n] = -np.linalg.solve(mass, stiffness)
        a[n : 2 * n, n : 2 * n] = -np.linalg.solve(mass, damping)
        place = 2 * n
        for k, loop in enumerate(self.loops):
            if loop is None:
                continue
            motor = model.first_masses[k]
            error = np.zeros(size)
            error[motor], error[n + motor] = -loop.position_p, -1.0
            a[place] = error
            b_r[place, k], b_v[place, k] = loop.position_p, loop.velocity_ff
            row = loop.velocity_p * error
            row[place] += loop.velocity_i
            row_r = loop.velocity_p * loop.position_p
            row_v = loop.velocity_p * loop.velocity_ff + loop.viscous_ff
            place += 1
            for biquad in loop.filters:
                (n2, n1, n0), (d1, d0) = biquad.numerator, biquad.denominator
                a[place, place + 1] = 1.0
                a[place + 1] = row
                a[place + 1, place] -= d0
                a[place + 1, place + 1] -= d1
                b_r[place + 1, k], b_v[place + 1, k] = row_r, row_v
                row, row_r, row_v = n2 * row, n2 * row_r, n2 * row_v
                row[place] += n0 - n2 * d0
                row[place + 1] += n1 - n2 * d1
                place += 2
            c_x[k], c_r[k, k], c_v[k, k] = row, row_r, row_v
        inverse = np.linalg.inv(mass)[:, model.first_masses]
        a[n : 2 * n] += inverse @ c_x
        b_r[n : 2 * n] += inverse @ c_r
        b_v[n : 2 * n] += inverse @ c_v
        return a, b_r, b_v, c_x, c_r, c_v


def loop_from_parameters(values: Mapping[str, float], filters: Sequence[int] = (1, 2)) -> AxisLoop:
    """Return the loop that a drive's parameters describe.

    Parameters
    ----------
    values
        By name, physical units: position_p, velocity_p, velocity_i, velocity_ff, viscous_ff,
        inertia_ff, filterK_type (0 off, 1 notch, 2 low-pass), filterK_frequency, filterK_zero_damping,
        filterK_pole_damping.
    filters
        Numbers K of the filters to look for.

    Raises
    ------
    KeyError
        If a loop gain is missing.
    """
    biquads = []
    for k in filters:
        kind = round(values.get(f"filter{k}_type", 0.0))
        if kind == 1:
            biquads.append(
                Biquad.notch(
                    values[f"filter{k}_frequency"],
                    values[f"filter{k}_zero_damping"],
                    values[f"filter{k}_pole_damping"],
                )
            )
        elif kind == 2:
            biquads.append(
                Biquad.low_pass(values[f"filter{k}_frequency"], values[f"filter{k}_pole_damping"])
            )
    return AxisLoop(
        values["position_p"],
        values["velocity_p"],
        values["velocity_i"],
        values.get("velocity_ff", 0.0),
        values.get("inertia_ff", 0.0),
        tuple(biquads),
        values.get("viscous_ff", 0.0),
    )
