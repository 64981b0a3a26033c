"""The elastic machine with its linear effects, and its response to motor torques and load forces."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from fieldtool.design.rule import DesignError
from fieldtool.records.model import FloatArray, MachineModel

ComplexArray = NDArray[np.complexfloating[Any, Any]]
DRY = ("coulomb_friction", "stribeck_friction", "asymmetric_friction")
PULLS = {"cogging": "amplitude", "gravity": "torque"}
"""Largest torque or force, by its name, of what goes with the position."""
RIGID = 1e-9
"""Of the largest eigenvalue: below it a mode is rigid motion."""
SINGULAR = 1e-12
"""Smallest eigenvalue of the masses' matrix with a diagonal of 1 that a machine has at least."""


@dataclass(frozen=True)
class Dry:
    """Dry friction between a mass and ground."""

    place: int
    """Degree of freedom."""
    forward: float
    """Torque or force against a motion forward, N m or N, at least 0."""
    backward: float
    """The same against a motion backward."""
    extra: float = 0.0
    """What breakaway takes more than sliding."""
    velocity: float = 1.0
    """At which that has fallen to 1 / e of it, rad/s or m/s."""


@dataclass(frozen=True)
class Pull:
    """What goes with the position q of a mass, and its motor holds: ``torque sin(order q + phase)``."""

    place: int
    """Degree of freedom."""
    torque: float
    """N m or N."""
    order: float
    """rad of phase per rad or m."""
    phase: float
    """rad."""

    def at(self, position: FloatArray) -> FloatArray:
        """Return the torque or force at positions, shape of ``position``."""
        return np.asarray(self.torque * np.sin(self.order * position + self.phase))


@dataclass(frozen=True, eq=False)
class Machine:
    """Matrices of M axes with n degrees of freedom, the model's linear effects among them."""

    names: tuple[str, ...]
    mass: FloatArray
    """(n, n)."""
    damping: FloatArray
    stiffness: FloatArray
    loss: FloatArray
    """(n, n): what structural damping adds to the stiffness as imaginary part."""
    motors: NDArray[np.intp]
    """(M,) degree of freedom of each motor."""
    loads: NDArray[np.intp]
    """(M,) of each chain's last mass."""
    scale: FloatArray
    """(M,): torque of the motor over that which the drive reports."""
    lag: FloatArray
    """(M,) s: first-order lag from the reported torque to that of the motor."""
    delay: FloatArray
    """(M,) s: by which a position is measured later than torque."""
    dry: tuple[Dry, ...] = ()
    """Dry friction, which no response in frequency has."""
    pulls: tuple[Pull, ...] = ()
    """Gravity and cogging, which none has either."""

    @property
    def places(self) -> list[int]:
        """Degrees of freedom of what is dry, then of what pulls."""
        return [dry.place for dry in self.dry] + [pull.place for pull in self.pulls]

    def axis_of(self, place: int) -> int:
        """Return the axis whose motor or last mass a degree of freedom is."""
        return int(np.flatnonzero((self.motors == place) | (self.loads == place))[0])

    @property
    def inertias(self) -> FloatArray:
        """All masses of each axis, from its motor to its last one, kg m2 or kg, shape (M,)."""
        own = np.diag(self.mass)
        chains = zip(self.motors, self.loads, strict=True)
        return np.array([own[first : last + 1].sum() for first, last in chains])

    @property
    def modes(self) -> FloatArray:
        """Undamped elastic modes of the free machine, rad/s, rising; empty where it is rigid."""
        values = eigh(self.stiffness, self.mass, eigvals_only=True)
        return np.sqrt(values[values > RIGID * max(float(values[-1]), 1e-300)])

    @property
    def held_modes(self) -> FloatArray:
        """Modes with all motors held, rad/s, rising: what swings when the loops are stiff."""
        free = np.setdiff1d(np.arange(self.mass.shape[0]), self.motors)
        if free.size == 0:
            return np.zeros(0)
        inner = np.ix_(free, free)
        values = eigh(self.stiffness[inner], self.mass[inner], eigvals_only=True)
        return np.sqrt(values[values > 0])


@dataclass(frozen=True, eq=False)
class Response:
    """Positions per torque and force at F frequencies, all loops open.

    The motor's lag and scale are in the columns of torques, so that torques are those that drives
    report.
    """

    omega: FloatArray
    """(F,) rad/s, above 0."""
    motors: ComplexArray
    """(F, M, M): motors per motor torque."""
    loads: ComplexArray
    """(F, M, M): last masses per motor torque."""


def machine_of(model: MachineModel) -> Machine:
    """Return a model's matrices, with those of its effects that are linear.

    ``extra_mode, coupling_spring, coupling_inertia, stiffness_change, structural_damping,
    asymmetric_friction`` (its viscous part), ``torque_scale, torque_lag, measurement_delay`` are in;
    the others have no linear part (:mod:`fieldtool.design.nonlinear` says what they do).  Dry friction
    stands beside the matrices.

    Raises
    ------
    DesignError
        If inertia between axes is more than their masses allow.
    """
    m = len(model.axes)
    parts = _parts_of(model)
    if not _positive(parts.mass):
        raise DesignError(_too_coupled(model))
    return Machine(
        model.names,
        parts.mass,
        parts.damping,
        parts.stiffness,
        parts.loss,
        model.first_masses,
        model.last_masses,
        parts.of_axis("torque_scale", "scale", 1.0, m),
        np.maximum(parts.of_axis("torque_lag", "time", 0.0, m), 0.0),
        np.maximum(parts.of_axis("measurement_delay", "delay", 0.0, m), 0.0),
        tuple(dry for effect in model.effects if (dry := _dry(model, effect)) is not None),
        tuple(pull for effect in model.effects if (pull := _pull(model, effect)) is not None),
    )


def standing(machine: Machine, at: Sequence[float | None]) -> Machine:
    """Return a machine whose positions count from where its axes stand.

    Parameters
    ----------
    machine
        As the drives tell positions.
    at
        Position of each axis, rad or m; None: not known, and what goes with it is left out.
    """
    pulls = []
    for pull in machine.pulls:
        where = at[machine.axis_of(pull.place)]
        if where is not None:
            pulls.append(replace(pull, phase=pull.phase + pull.order * where))
    return replace(machine, pulls=tuple(pulls))


def is_machine(model: MachineModel) -> bool:
    """Return whether a model's masses, with the inertia of its effects, are those of a machine."""
    return _positive(_parts_of(model).mass)


def _positive(mass: FloatArray) -> bool:
    """Return whether masses are positive definite, whatever their sizes and units."""
    size = np.diag(mass)
    if not np.all(size > 0):
        return False
    root = np.sqrt(size)
    return float(np.linalg.eigvalsh(mass / np.outer(root, root))[0]) > SINGULAR


def _too_coupled(model: MachineModel) -> str:
    named = [
        f"{number(e, 'inertia'):.4g} of {' - '.join(e['axis'])} at the "
        f"{'motors' if e.get('location') == 'motor' else 'last masses'}"
        for e in model.effects
        if e.get("effect") == "coupling_inertia"
    ]
    return (
        "the model's mass matrix is not positive definite with its effects (coupling_inertia "
        f"{', '.join(named) or 'none'}): no machine is that, and nothing is written. Correct the "
        "coupling, or the masses that it joins, in model.yaml, or measure and criticise anew."
    )


def _dry(model: MachineModel, effect: Mapping[str, Any]) -> Dry | None:
    """Return the dry friction that an effect is; None where it is none."""
    kind, name = effect.get("effect"), effect.get("axis")
    if kind not in DRY or name not in model.names:
        return None
    places = model.last_masses if effect.get("location") == "load" else model.first_masses
    torque = max(number(effect, "torque"), 0.0)
    forward, backward, extra, velocity = torque, torque, 0.0, 1.0
    if kind == "stribeck_friction":
        extra = max(number(effect, "breakaway") - torque, 0.0)
        velocity = number(effect, "velocity")
    elif kind == "asymmetric_friction":
        forward = max(number(effect, "coulomb_positive"), 0.0)
        backward = max(number(effect, "coulomb_negative"), 0.0)
    if max(forward, backward, extra) <= 0:
        return None
    place = int(places[model.names.index(str(name))])
    return Dry(place, forward, backward, extra, velocity if velocity > 0 else 1.0)


def _pull(model: MachineModel, effect: Mapping[str, Any]) -> Pull | None:
    """Return what an effect's torque is by position; None where it does not go with it."""
    kind, name = effect.get("effect"), effect.get("axis")
    if kind not in PULLS or name not in model.names:
        return None
    axis = model.names.index(str(name))
    if kind == "gravity" and model.axes[axis].kind == "linear":
        return None  # a weight is the same everywhere
    places = model.last_masses if effect.get("location") == "load" else model.first_masses
    return Pull(
        int(places[axis]),
        number(effect, PULLS[kind]),
        number(effect, "order", 1.0),
        number(effect, "phase"),
    )


def respond(machine: Machine, omega: FloatArray) -> Response:
    """Return the open machine's response at frequencies ``omega``, shape (F,), rad/s, above 0."""
    n, m = machine.mass.shape[0], machine.motors.size
    s = 1j * omega[:, None, None]
    dynamic = machine.stiffness + 1j * machine.loss + s * machine.damping + s * s * machine.mass
    torques = np.zeros((n, m))
    torques[machine.motors, np.arange(m)] = 1.0
    q = np.linalg.solve(dynamic, np.broadcast_to(torques, (omega.size, n, m)))
    q = q * (machine.scale / (1 + s * machine.lag))
    return Response(omega, q[:, machine.motors], q[:, machine.loads])


def number(effect: Mapping[str, Any], name: str, otherwise: float = 0.0) -> float:
    """Return a parameter of an effect as ``model.yaml`` has it: a number, or one with its error."""
    given = (effect.get("parameters") or {}).get(name, otherwise)
    return float(given["value"] if isinstance(given, Mapping) else given)


def spring_of(model: MachineModel, effect: Mapping[str, Any]) -> tuple[int, int]:
    """Return axis and number of the spring that an effect is in, both from 0."""
    axis = model.names.index(str(effect["axis"]))
    words = str(effect.get("location") or "spring 1").split()
    last = len(model.axes[axis].springs) - 1
    place = int(words[1]) - 1 if len(words) == 2 and words[1].isdigit() else 0
    return axis, max(min(place, last), 0)


def _parts_of(model: MachineModel) -> "_Parts":
    parts = _Parts(model)
    for effect in model.effects:
        parts.add(effect)
    return parts


class _Parts:
    """Matrices that grow with the effects."""

    def __init__(self, model: MachineModel) -> None:
        self.model = model
        self.mass, self.damping = model.mass_matrix, model.damping_matrix
        self.stiffness = model.stiffness_matrix
        self.loss = np.zeros_like(self.mass)

    def of_axis(self, effect: str, name: str, otherwise: float, count: int) -> FloatArray:
        """Return one number an axis, of an effect that an axis has at most once."""
        values = np.full(count, otherwise)
        for one in self.model.effects:
            if one.get("effect") == effect and one.get("axis") in self.model.names:
                values[self.model.names.index(str(one["axis"]))] = number(one, name, otherwise)
        return values

    def add(self, effect: Mapping[str, Any]) -> None:
        """Put one effect's linear part in."""
        model, kind = self.model, effect.get("effect")
        if kind in ("coupling_spring", "coupling_inertia"):
            a, b = (self._mass(str(name), effect) for name in effect["axis"])
            if kind == "coupling_inertia":
                self.mass[a, b] += number(effect, "inertia")
                self.mass[b, a] += number(effect, "inertia")
            else:
                _between(self.stiffness, a, b, number(effect, "stiffness"))
        elif kind == "extra_mode":
            self._hang(self._mass(str(effect["axis"]), effect), effect)
        elif kind in ("stiffness_change", "structural_damping"):
            axis, k = spring_of(model, effect)
            if model.axes[axis].springs:
                a = int(model.first_masses[axis]) + k
                spring = model.axes[axis].springs[k].value
                if kind == "stiffness_change":
                    _between(self.stiffness, a, a + 1, spring * number(effect, "change"))
                else:
                    _between(self.loss, a, a + 1, spring * number(effect, "loss_factor"))
        elif kind == "asymmetric_friction":
            a = self._mass(str(effect["axis"]), effect)
            both = number(effect, "viscous_positive") + number(effect, "viscous_negative")
            self.damping[a, a] += max(both / 2, 0.0)

    def _mass(self, axis: str, effect: Mapping[str, Any]) -> int:
        k = self.model.names.index(axis)
        at_motor = effect.get("location") == "motor"
        if effect.get("effect") == "coupling_spring":
            at_motor = False  # it joins last masses
        elif effect.get("effect") == "asymmetric_friction":
            at_motor = effect.get("location") != "load"
        places = self.model.first_masses if at_motor else self.model.last_masses
        return int(places[k])

    def _hang(self, at: int, effect: Mapping[str, Any]) -> None:
        """Add a mass on a spring; its degree of freedom is the last one."""
        mass, w = number(effect, "mass"), 2 * np.pi * number(effect, "frequency")
        if mass <= 0 or w <= 0:
            return
        n = self.mass.shape[0]
        for name in ("mass", "damping", "stiffness", "loss"):
            setattr(self, name, np.pad(getattr(self, name), (0, 1)))
        self.mass[n, n] = mass
        _between(self.stiffness, at, n, mass * w * w)
        _between(self.damping, at, n, 2 * number(effect, "damping_ratio") * mass * w)


def _between(matrix: FloatArray, a: int, b: int, value: float) -> None:
    matrix[np.ix_([a, b], [a, b])] += value * np.array([[1.0, -1.0], [-1.0, 1.0]])
