"""Draw an effect at random, and give it a size that is a wanted multiple of the noise floor.

The size is measured without the tool: the torque that the machine *without* the effect would have needed
for the motion that was measured, by the plant's own dynamic stiffness at every frequency, is taken off
the measured torque, both without noise.  What is left, and what other numbers of the machine would not
explain either, over the noise of the torque in the same band, in the axis where that is largest, is the
visibility.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import pi

import numpy as np
from numpy.typing import NDArray

from drives.sim.effects import (
    AsymmetricFriction,
    Backlash,
    ChainEffect,
    Cogging,
    CoulombFriction,
    CouplingInertia,
    CouplingSpring,
    EncoderError,
    ExtraMode,
    Gravity,
    HardeningSpring,
    MachineEffect,
    MeasurementDelay,
    PeriodicDisturbance,
    SofteningSpring,
    StiffnessChange,
    StribeckFriction,
    StructuralDamping,
    TorqueLag,
    TorqueSaturation,
    TorqueScale,
)
from drives.sim.firmware import SimulationDivergedError
from drives.sim.plant import Plant
from fieldtool.records.recording import Recording
from tests.hidden.plant_recordings import MULTISINE, PERIOD, Machine, random_machine, record

FloatArray = NDArray[np.float64]
BAND = (0.3, 60.0)
"""Hz."""
ATTEMPTS = 12
REFITS, SETTLED = 6, 1.05
"""Steps in which the machine's own numbers are fitted to what is hidden; power gained, to go on."""


@dataclass(frozen=True)
class Hidden:
    """What was hidden."""

    effect: str
    axis: int
    """From 0."""
    part: ChainEffect | MachineEffect
    visibility: float
    """Of it alone, times the noise floor."""


@dataclass(frozen=True)
class Case:
    """A machine, what is hidden in it, and what was measured."""

    seed: int
    machine: Machine
    """Without anything hidden."""
    hidden: tuple[Hidden, ...]
    recording: Recording


Maker = Callable[[Machine, int, float, np.random.Generator], ChainEffect | MachineEffect]
"""Makes a part from machine, axis, relative size (about 1 is large) and random numbers."""


def _joint(machine: Machine, axis: int, rng: np.random.Generator) -> int:
    return int(rng.integers(1, len(machine.plant.chains[axis].masses)))


def _twist(machine: Machine, axis: int, joint: int) -> float:
    """Twist of a joint under the torque in use, roughly, rad."""
    chain = machine.plant.chains[axis]
    beyond = sum(chain.masses[joint:]) / sum(chain.masses)
    return 0.15 * machine.peak[axis] * beyond / chain.springs[joint - 1]


def _where(rng: np.random.Generator, motor: float = 0.7) -> str:
    return "motor" if rng.random() < motor else "load"


def _total(machine: Machine, axis: int) -> float:
    return sum(machine.plant.chains[axis].masses)


def _periods(rng: np.random.Generator) -> float:
    return float(rng.choice([8, 12, 16, 18, 24]))


def _phase(rng: np.random.Generator) -> float:
    return float(rng.uniform(0, 2 * pi))


def _between_lines(rng: np.random.Generator) -> float:
    """Hz, off multiples of the period's frequency: there nobody can tell it from the excitation."""
    return float(
        (rng.integers(3.0 * MULTISINE, 40.0 * MULTISINE) + rng.uniform(0.3, 0.7)) / MULTISINE
    )


def _other(machine: Machine, axis: int) -> tuple[int, int]:
    return (axis, 1 - axis)


MAKERS: Mapping[str, Maker] = {
    "coulomb_friction": lambda m, a, s, r: CoulombFriction(0.1 * s * m.peak[a], _where(r)),
    "stribeck_friction": lambda m, a, s, r: StribeckFriction(
        t := 0.1 * s * m.peak[a], t * float(r.uniform(1.6, 2.5)), float(r.uniform(0.08, 0.3))
    ),
    "asymmetric_friction": lambda m, a, s, r: AsymmetricFriction(
        *r.permutation([0.1 * s * m.peak[a], 0.1 * s * m.peak[a] * r.uniform(0.3, 0.7)]).tolist()
    ),
    "backlash": lambda m, a, s, r: Backlash(
        float(s * _twist(m, a, j := _joint(m, a, r))), j, float(r.uniform(0.4, 0.9))
    ),
    "hardening_spring": lambda m, a, s, r: HardeningSpring(
        float(_twist(m, a, j := _joint(m, a, r)) / s**0.5), j
    ),
    "softening_spring": lambda m, a, s, r: SofteningSpring(
        float(_twist(m, a, j := _joint(m, a, r)) / s**0.5), j
    ),
    "structural_damping": lambda m, a, s, r: StructuralDamping(min(0.15 * s, 0.5), _joint(m, a, r)),
    "stiffness_change": lambda m, a, s, r: StiffnessChange(
        float(1 / (1 + s)), float(r.uniform(46.0, 60.0)), 0.05, _joint(m, a, r)
    ),
    "gravity": lambda m, a, s, r: Gravity(0.2 * s * m.peak[a], float(r.uniform(-1.5, 1.5))),
    "cogging": lambda m, a, s, r: Cogging(0.1 * s * m.peak[a], _periods(r), _phase(r)),
    "periodic_disturbance": lambda m, a, s, r: PeriodicDisturbance(
        0.1 * s * m.peak[a], _between_lines(r), _phase(r)
    ),
    "extra_mode": lambda m, a, s, r: ExtraMode(
        0.3 * s * _total(m, a), float(r.uniform(5.0, 40.0)), float(r.uniform(0.01, 0.05))
    ),
    "torque_scale": lambda m, a, s, r: TorqueScale(float((1 + 0.3 * s) ** r.choice([-1, 1]))),
    "torque_saturation": lambda m, a, s, r: TorqueSaturation(0.4 * m.peak[a] / (0.3 + s)),
    "torque_lag": lambda m, a, s, r: TorqueLag(min(0.01 * s, 0.05)),
    "measurement_delay": lambda m, a, s, r: MeasurementDelay(min(max(0.01 * s, 1.25e-4), 0.03)),
    "encoder_error": lambda m, a, s, r: EncoderError(
        min(2e-3 * s, 0.2 / (p := _periods(r))), p, _phase(r)
    ),
    "coupling_spring": lambda m, a, s, r: CouplingSpring(_other(m, a), 30.0 * s * _total(m, a)),
    "coupling_inertia": lambda m, a, s, r: CouplingInertia(
        _other(m, a), 0.3 * s / (1 + s) * min(c.masses[0] for c in m.plant.chains)
    ),
}
"""By the name that files use."""

ELASTIC = {
    "backlash",
    "hardening_spring",
    "softening_spring",
    "structural_damping",
    "stiffness_change",
}
OF_TWO = {"coupling_spring", "coupling_inertia", "torque_scale"}
"""A single axis' torque scale is no other thing than other masses and springs."""


def suits(effect: str, machine: Machine, axis: int) -> bool:
    """Whether a machine has a place for an effect, where it can be told from the machine's numbers."""
    if effect in ELASTIC:
        return len(machine.plant.chains[axis].masses) > 1
    if effect == "coupling_inertia" and max(len(c.masses) for c in machine.plant.chains) == 1:
        return False  # the motors are the ends, whose coupling the machine has anyway
    return effect not in OF_TWO or len(machine.hardware) == 2


def built_in(machine: Machine, parts: list[tuple[int, ChainEffect | MachineEffect]]) -> Machine:
    """The machine with parts at their axes."""
    own: dict[int, list[ChainEffect]] = {}
    between: list[MachineEffect] = []
    for axis, part in parts:
        if isinstance(part, CouplingSpring | CouplingInertia):
            between.append(part)
        else:
            own.setdefault(axis, []).append(part)
    return machine.with_effects(own, between)


def unexplained(machine: Machine, recording: Recording) -> list[FloatArray]:
    """What the machine as it is says of no torque: spectra in the band, (lines, M) an experiment."""
    plant = Plant(machine.plant)
    found = []
    for experiment in recording.experiments:
        rows = slice(None)
        if experiment.period is not None:
            rows = slice(-round(MULTISINE / PERIOD), None)
        position, torque = experiment.position[rows], experiment.torque[rows]
        frequency = np.fft.rfftfreq(position.shape[0], PERIOD)
        inside = (frequency >= BAND[0]) & (frequency <= BAND[1])
        q = np.fft.rfft(position, axis=0)[inside] / position.shape[0]
        t = np.fft.rfft(torque, axis=0)[inside] / position.shape[0]
        response = plant.response(2 * pi * frequency[inside])
        found.append(t - np.linalg.solve(response, q[..., None])[..., 0])
    return found


def visibility(
    machine: Machine, hidden: Machine, seed: int, plain: list[FloatArray] | None = None
) -> float:
    """Largest unexplained torque over the noise in its band, of experiments and axes.

    What other numbers of the machine's own masses, springs, dampers and couplings would explain, however
    far they are, is taken off: nobody could call that an effect.
    """
    if plain is None:
        plain = unexplained(machine, record(machine, seed, noise=False, short=True))
    measured = record(hidden, seed, noise=False, short=True)
    noise = np.array([h.torque_noise for h in machine.hardware])
    error = _stacked([-p for p in plain], noise) + _left(machine, measured, noise)
    for _ in range(REFITS):
        others = nearby(machine)
        columns = np.column_stack([_left(o, measured, noise) for o, _ in others])
        columns -= _left(machine, measured, noise)[:, None]
        step = -np.linalg.lstsq(columns, error, rcond=1e-10)[0]
        left = error + columns @ step
        if error @ error < SETTLED * (left @ left):
            break
        moved = _moved(machine, np.clip(step * [size for _, size in others], -0.3, 0.3))
        reached = _stacked([-p for p in plain], noise) + _left(moved, measured, noise)
        if not reached @ reached < error @ error:
            break
        machine, error = moved, reached
    share = 2.0 * PERIOD * (BAND[1] - BAND[0])
    lines = left.reshape(2, -1, noise.size)
    return float(np.sqrt(2.0 * np.max(np.sum(lines**2, axis=(0, 1))) / share))


def _left(machine: Machine, measured: Recording, noise: FloatArray) -> FloatArray:
    return _stacked(unexplained(machine, measured), noise)


def _stacked(spectra: list[FloatArray], noise: FloatArray) -> FloatArray:
    """Real and imaginary parts of all lines over the noise of their axes, end to end."""
    whole = np.concatenate(spectra) / noise
    return np.concatenate([whole.real.ravel(), whole.imag.ravel()])


def nearby(machine: Machine) -> list[tuple[Machine, float]]:
    """Machines of which one number each is a little larger, and by how much relative to itself."""
    count = len(_numbers(machine))
    size = [1e-3 if place[1] == "viscous_friction" else 1e-4 for place in _numbers(machine)]
    return [(_moved(machine, size[j] * np.eye(count)[j]), size[j]) for j in range(count)]


def _numbers(machine: Machine) -> list[tuple[int, str, int]]:
    """Where each number stands: chain, kind, place; a coupling's chain is -1."""
    out: list[tuple[int, str, int]] = []
    for k, chain in enumerate(machine.plant.chains):
        for name in ("masses", "springs", "dampers"):
            out += [(k, name, j) for j in range(len(getattr(chain, name)))]
        out.append((k, "viscous_friction", 0))
    return out + [(-1, "couplings", j) for j in range(len(machine.plant.couplings))]


def _moved(machine: Machine, relative: FloatArray) -> Machine:
    """The machine with each number larger by a share of itself."""
    chains, couplings = list(machine.plant.chains), list(machine.plant.couplings)
    for (k, name, j), more in zip(_numbers(machine), relative, strict=True):
        if name == "couplings":
            a, b, m = couplings[j]
            couplings[j] = (a, b, m * (1.0 + more))
        elif name == "viscous_friction":
            friction = chains[k].viscous_friction * (1.0 + more)
            chains[k] = replace(chains[k], viscous_friction=friction)
        else:
            values = list(getattr(chains[k], name))
            values[j] *= 1.0 + more
            chains[k] = replace(chains[k], **{name: tuple(values)})
    plant = replace(machine.plant, chains=tuple(chains), couplings=tuple(couplings))
    return replace(machine, plant=plant)


def sized(machine: Machine, effect: str, axis: int, wanted: float, seed: int) -> Hidden | None:
    """Draw an effect of a visibility within 20 % of the wanted one; None where none is as large."""
    size, before = 0.1, None
    plain = unexplained(machine, record(machine, seed, noise=False, short=True))
    for _ in range(ATTEMPTS):
        part = MAKERS[effect](machine, axis, size, np.random.default_rng(seed))
        seen = replace(part, time=0.0) if isinstance(part, StiffnessChange) else part
        found = visibility(machine, built_in(machine, [(axis, seen)]), seed, plain)
        if 0.8 <= found / wanted <= 1.25:
            return Hidden(effect, axis, part, found)
        slope = 1.0
        if before is not None and found > 0 and size != before[0]:
            slope = np.log(found / before[1]) / np.log(size / before[0])
        before = (size, max(found, 1e-9))
        step = np.log(wanted / max(found, 1e-9)) / min(max(slope, 0.4), 2.5)
        size *= float(np.exp(np.clip(step, -3.0, 2.0)))
        if size > 30.0:
            return None
    return None


def draw(
    seed: int,
    effects: tuple[str | None, ...] = (None,),
    wanted: float | None = None,
    axes: int | None = None,
) -> Case:
    """Draw a machine and hide effects in it, at axes drawn at random.

    Parameters
    ----------
    seed
        Of everything.
    effects
        Names; None is one at random.
    wanted
        Visibility of each; at random between 6 and 60 otherwise.
    axes
        Of the machine; one or two at random otherwise.
    """
    rng = np.random.default_rng(seed)
    while True:
        machine = random_machine(rng, axes)
        hidden: list[Hidden] = []
        for name in effects:
            chosen = name or str(rng.choice(list(MAKERS)))
            axis = int(rng.integers(len(machine.hardware)))
            size = wanted or float(np.exp(rng.uniform(np.log(6.0), np.log(60.0))))
            if not suits(chosen, machine, axis) or chosen in {h.effect for h in hidden}:
                break
            one = sized(machine, chosen, axis, size, int(rng.integers(2**31)))
            if one is None:
                break
            hidden.append(one)
        if len(hidden) < len(effects):
            continue
        whole = built_in(machine, [(h.axis, h.part) for h in hidden])
        try:
            recording = record(whole, int(rng.integers(2**31)))
        except SimulationDivergedError:
            continue  # its loops do not stand what was hidden: nobody could measure it
        return Case(seed, machine, tuple(hidden), recording)
