"""Recordings made directly from the simulated plant and its servo loops: no bus, for many cases.

The machine is drawn at random: one or two axes of one to three masses, modes of some 8 to 60 Hz,
and drives with a cascade that suits them.  It is moved as in a session: multisines of all axes at two
levels, two experiments a level, several periods each; then moves, where they are wanted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drives.sim.effects import ChainEffect, MachineEffect
from drives.sim.firmware import DriveHardware, Parameter, SimulatedAxes
from drives.sim.plant import ChainParameters, Plant, PlantParameters
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from fieldtool.records.recording import AxisInfo, Controller, Experiment, Recording

FloatArray = NDArray[np.float64]
PERIOD = 1e-3
"""s from SYNC to SYNC."""
INNER = 8
"""Inner steps a cycle."""
MULTISINE, PERIODS, RUN_IN = 4.0, 4, 1
"""Period, s; periods measured; periods before them."""
MOVES = 20.0
"""s."""
SLOW = 0.6
"""Hz: above it the multisines' acceleration is flat."""
LEVELS = (0.4, 1.0)
LINEAR_TARGETS = "linear_targets"
"""How a recording says that its drives go straight from target to target."""
COUNTS = 22
"""Bits of the encoder a turn."""
TORQUE_LAG = 0.22e-3
"""s: current loop and half an inner step."""


@dataclass(frozen=True)
class Machine:
    """A plant without anything hidden, its drives, and how far it may be moved."""

    plant: PlantParameters
    hardware: tuple[DriveHardware, ...]
    gains: tuple[tuple[float, float, float], ...]
    """position_p, velocity_p, velocity_i of each axis."""
    peak: tuple[float, ...]
    """Torque to use, N m."""
    travel: tuple[float, ...]
    """Largest move to either side, rad."""

    @property
    def names(self) -> tuple[str, ...]:
        """axis1, axis2 ..."""
        return tuple(f"axis{k + 1}" for k in range(len(self.hardware)))

    @property
    def model(self) -> MachineModel:
        """The machine as a model has it, exactly: nothing is hidden in it."""
        axes = tuple(
            AxisModel(
                name,
                "rotary",
                tuple(Estimate(m) for m in chain.masses),
                tuple(Estimate(k) for k in chain.springs),
                tuple(Estimate(c) for c in chain.dampers),
                Estimate(chain.viscous_friction),
            )
            for name, chain in zip(self.names, self.plant.chains, strict=True)
        )
        couplings = tuple(
            Coupling((self.names[a], self.names[b]), m) for a, b, m in self.plant.couplings
        )
        return MachineModel(axes, couplings)

    def with_effects(
        self, effects: dict[int, Sequence[ChainEffect]], between: Sequence[MachineEffect] = ()
    ) -> "Machine":
        """The same machine with these parts built in, by number of the axis."""
        chains = tuple(
            replace(chain, effects=tuple(effects.get(k, ())))
            for k, chain in enumerate(self.plant.chains)
        )
        return replace(self, plant=PlantParameters(chains, self.plant.couplings, tuple(between)))


def random_machine(rng: np.random.Generator, axes: int | None = None) -> Machine:
    """Draw a machine; its last masses are coupled where there are two axes."""
    count = axes or int(rng.integers(1, 3))
    chains = []
    for _ in range(count):
        length = int(rng.choice([1, 2, 3], p=[0.2, 0.5, 0.3]))
        masses = 0.03 * np.exp(rng.uniform(-0.7, 0.7, length))
        lowest = 2 * pi * rng.uniform(9.0, 22.0)
        springs = np.exp(rng.uniform(-0.3, 0.3, max(length - 1, 0)))
        if length > 1:
            bare = ChainParameters(tuple(masses), tuple(springs), (0.0,) * (length - 1))
            springs *= (lowest / Plant(PlantParameters((bare,))).eigenfrequencies[1]) ** 2
        dampers = springs * rng.uniform(2e-4, 6e-4)
        friction = float(rng.uniform(0.01, 0.05))
        chains.append(ChainParameters(tuple(masses), tuple(springs), tuple(dampers), friction))
    couplings = tuple(
        (a, b, float(rng.uniform(0.15, 0.4) * rng.choice([-1, 1]) * _ends(chains, a, b)))
        for a in range(count)
        for b in range(a + 1, count)
    )
    totals = [sum(chain.masses) for chain in chains]
    peak = tuple(float(150.0 * total) for total in totals)
    return Machine(
        PlantParameters(tuple(chains), couplings),
        tuple(
            DriveHardware(
                rated_torque=largest,
                torque_noise=1e-3 * largest,
                counts_per_unit=2**COUNTS / (2 * pi),
                peak_torque=4 * largest,
            )
            for largest in peak
        ),
        tuple((12.0, 30.0 * total, 200.0 * total) for total in totals),
        peak,
        (2.0,) * count,
    )


def _ends(chains: Sequence[ChainParameters], a: int, b: int) -> float:
    return float((chains[a].masses[-1] * chains[b].masses[-1]) ** 0.5)


def record(
    machine: Machine,
    seed: int,
    *,
    noise: bool = True,
    short: bool = False,
    with_moves: bool = False,
) -> Recording:
    """Measure: multisines at two levels, two experiments each; moves at two speeds where asked for.

    Parameters
    ----------
    machine
        With or without something hidden.
    seed
        Of references and noise; the references depend on nothing else but the machine's limits.
    noise
        Whether the torque has its measurement noise.
    short
        One period of one multisine only, to see the size of an effect.
    with_moves
        Moves of 20 s at two speeds after the multisines.
    """
    rng = np.random.default_rng(seed)
    count = len(machine.hardware)
    multisines = []
    realisations = 2 if count == 1 else 1
    phases = rng.uniform(0.0, 2 * pi, (len(LEVELS) * realisations, count, _lines().size))
    for k, level in enumerate(np.repeat(LEVELS, realisations)):
        for e in range(count):
            turn = np.angle(np.exp(2j * pi * e * np.arange(count) / count))
            courses = np.column_stack(
                [level * _multisine(machine, a, phases[k, a] + turn[a]) for a in range(count)]
            )
            periodic = np.tile(courses, (RUN_IN + (1 if short else PERIODS), 1))
            rise = np.minimum(np.arange(periodic.shape[0]) / 1000.0, 1.0)[:, None]
            multisines.append((f"multisine {len(multisines) + 1}", periodic * rise))
    moves = []
    for k, speed in enumerate((0.6, 3.0) if with_moves else ()):
        courses = np.column_stack([_moves(rng, travel, speed) for travel in machine.travel])
        moves.append((f"moves {k + 1}", courses))
    if short:
        multisines = multisines[-1:]
    axes = _switched_on(machine, seed, noise)
    measured = []
    for experiments, periodic in ((multisines, True), (moves, False)):
        for name, reference in experiments:
            measured.append(_measured(machine, axes, name, reference, periodic=periodic))
            _back_to_start(axes, reference[-1])
    return Recording(
        PERIOD,
        tuple(_info(machine, a) for a in range(count)),
        tuple(measured),
        source={LINEAR_TARGETS: " ".join(f"{name}={TORQUE_LAG}" for name in machine.names)},
    )


def _lines() -> NDArray[np.int64]:
    """Odd lines of the period, one in ten of them left out, up to 70 Hz."""
    odd = np.arange(1, int(70 * MULTISINE), 2)
    return odd[np.arange(odd.size) % 10 != 7]


def _multisine(machine: Machine, axis: int, phases: FloatArray) -> FloatArray:
    """Return the reference, one period, from which a rigid axis makes the motion that is wanted."""
    lines = _lines()
    omega = 2 * pi * lines / MULTISINE
    total = sum(machine.plant.chains[axis].masses)
    moved = 1.0 / (1.0 + (omega / (2 * pi * SLOW)) ** 2)
    torque = total * omega**2 * moved
    position, proportional, integral = machine.gains[axis]
    velocity_loop = proportional + integral / (1j * omega)
    asked = (total * (1j * omega) ** 2 + velocity_loop * (position + 1j * omega)) / (
        velocity_loop * position
    )
    scale = min(
        0.8 * machine.peak[axis] / np.abs(_course(torque, phases)).max(),
        0.4 * machine.travel[axis] / np.abs(_course(moved, phases)).max(),
    )
    return scale * _course(moved * asked, phases)


def _course(sizes: NDArray[np.complexfloating[Any, Any]], phases: FloatArray) -> FloatArray:
    """One period of a sum of waves at the lines."""
    rows = round(MULTISINE / PERIOD)
    spectrum = np.zeros(rows // 2 + 1, dtype=complex)
    spectrum[_lines()] = sizes * np.exp(1j * phases)
    return np.asarray(0.5 * rows * np.fft.irfft(spectrum, rows))


def _moves(rng: np.random.Generator, travel: float, speed: float) -> FloatArray:
    """Moves between random places with smooth starts and stops, and rests between them."""
    rows = round(MOVES / PERIOD)
    course, place = [], 0.0
    while sum(part.size for part in course) < rows:
        target = float(rng.uniform(-travel, travel))
        duration = max(abs(target - place) * 1.9 / speed, 0.15)
        x = np.arange(round(duration / PERIOD)) / round(duration / PERIOD)
        course.append(place + (target - place) * x**3 * (10 - 15 * x + 6 * x * x))
        course.append(np.full(round(float(rng.uniform(0.05, 0.3)) / PERIOD), target))
        place = target
    whole = np.concatenate(course)[:rows]
    back = round(1.0 / PERIOD)
    fade = 0.5 + 0.5 * np.cos(pi * np.arange(back) / back)
    whole[-back:] *= fade
    return whole


def _switched_on(machine: Machine, seed: int, noise: bool) -> SimulatedAxes:
    hardware = [h if noise else replace(h, torque_noise=0.0) for h in machine.hardware]
    axes = SimulatedAxes(machine.plant, hardware, seed)
    for axis, (position, proportional, integral) in enumerate(machine.gains):
        for parameter, value in (
            (Parameter.POSITION_P, position),
            (Parameter.VELOCITY_P, proportional),
            (Parameter.VELOCITY_I, integral),
            (Parameter.VELOCITY_FILTER, 200.0),
            (Parameter.VELOCITY_FF, 0.0),
        ):
            axes.set(axis, parameter, value)
        axes.follow_position(axis, 0.0, INNER)
    axes.advance(8000)
    return axes


def _back_to_start(axes: SimulatedAxes, place: FloatArray) -> None:
    """Go to the middle and rest there, unrecorded."""
    rows = round(0.5 / PERIOD)
    for k in range(2 * rows):
        left = 0.5 + 0.5 * np.cos(pi * min(k + 1, rows) / rows)
        for axis in range(axes.axes):
            axes.follow_position(axis, float(place[axis] * left), INNER)
        axes.advance(INNER)


def _measured(
    machine: Machine, axes: SimulatedAxes, name: str, reference: FloatArray, *, periodic: bool
) -> Experiment:
    rows, count = reference.shape
    counts, torques = np.empty((rows, count)), np.empty((rows, count))
    shown = np.empty((rows, count))
    for k in range(rows):
        seen, torque, _ = axes.latch()
        counts[k], torques[k] = seen, torque
        shown[k] = reference[k]
        for axis in range(count):
            following = reference[min(k + 1, rows - 1), axis]
            axes.follow_position(axis, float(following), INNER)
        axes.advance(INNER)
    units = np.array([h.counts_per_unit for h in machine.hardware])
    rated = np.array([h.rated_torque for h in machine.hardware])
    return Experiment(
        name=name,
        kind="multisine" if periodic else "moves",
        driven=machine.names,
        free=(),
        period=MULTISINE if periodic else None,
        time=np.arange(rows) * PERIOD,
        position=(counts + 0.5) / units,
        torque=torques * rated / 1000.0,
        position_reference=shown,
    )


def _info(machine: Machine, axis: int) -> AxisInfo:
    position, proportional, integral = machine.gains[axis]
    drive = machine.hardware[axis]
    return AxisInfo(
        name=machine.names[axis],
        kind="rotary",
        masses=len(machine.plant.chains[axis].masses),
        motor_inertia=machine.plant.chains[axis].masses[0],
        rated_torque=drive.rated_torque,
        encoder_counts_per_rev=round(drive.counts_per_unit * 2 * pi),
        controller=Controller(position, proportional, integral, drive.peak_torque),
    )
