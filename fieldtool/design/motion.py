"""A move and a step in time: from the response in frequency, with dry friction and weights beside it."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldtool.design.dragged import dragged, rubbing
from fieldtool.design.figures import MoveFigures, StepFigures, move_figures, step_figures
from fieldtool.design.loops import Loops
from fieldtool.design.machine import Machine, respond
from fieldtool.design.moves import TestMove
from fieldtool.design.servo import Servo
from fieldtool.design.waves import HalfWave
from fieldtool.records.model import FloatArray

ComplexArray = NDArray[np.complexfloating[Any, Any]]
DECAYS = 6.0
"""Time constants after which a response has come to rest."""
MOST_SAMPLES = 2**14
LONGEST = 60.0
"""s: no response is looked at for longer."""
LONGEST_STUCK = 6.0
"""s: nobody waits longer for an integrator to overcome friction."""


@dataclass(frozen=True, eq=False)
class Curves:
    """Histories of one axis, for pictures and comparison."""

    time: FloatArray
    """s."""
    reference: FloatArray
    """Of the move, rad or m, from 0."""
    position: FloatArray
    """Motor."""
    back: FloatArray
    """Motor on the way back, told as if it were the way out: another one with friction or weights."""
    load: FloatArray
    """Last mass."""
    torque: FloatArray
    """N m or N."""
    step_time: FloatArray
    step: FloatArray
    """Motor after a unit step of the reference, without feed-forward."""

    def figures(self, band: float, watched: float = inf) -> MoveFigures:
        """Return the motor's figures on its move, of the ways out and back the worse ones.

        Parameters
        ----------
        band, watched
            As :func:`fieldtool.design.figures.move_figures` wants them.
        """
        ways = [self.position] if self.back is self.position else [self.position, self.back]
        return _worst([move_figures(self.time, self.reference, way, band, watched) for way in ways])


@dataclass(frozen=True, eq=False)
class Moved:
    """What an axis does on its move and after a step."""

    motor: MoveFigures
    load: MoveFigures
    step: StepFigures
    """Without dry friction and weights."""
    peak_torque: float
    curves: Curves
    beside: FloatArray
    """Largest torque, distance and speed of every axis' motor on this move, (3, M): of those whose
    references stand still; without dry friction, which holds them back, and weights."""


def moved(
    machine: Machine,
    servos: tuple[Servo, ...],
    axis: int,
    move: TestMove,
    eigenvalues: ComplexArray,
) -> Moved:
    """Return what an axis does on its move; the references of the others stand still.

    With dry friction, or torques that go with the position, it moves out and back, and figures are the
    worse ones of both: before it goes back the integrator holds what friction left of the move out.

    Parameters
    ----------
    machine, servos
        Loops closed; stable.  Positions count from where the axes stand.
    axis
        Index.
    move
        Of the axis.
    eigenvalues
        Of the closed loops, rad/s.
    """
    beyond = move.duration
    if machine.dry:
        beyond += min(_stuck(machine, servos, move), LONGEST_STUCK)
    wave = _wave(eigenvalues, beyond, move.duration / 200)
    drive = wave.spectrum(wave.move(move))
    loops = Loops(respond(machine, wave.omega), servos)
    s = 1j * wave.omega
    phasors = loops.moved(axis, servos[axis].reference_gain(s) * drive)
    motors, torques = (wave.signal(one.T) for one in phasors)
    load = wave.signal(loops.load(axis, phasors[1]))
    step = servos[axis].step_gain(s) * wave.spectrum(wave.step(1.0))
    stepped = wave.signal(loops.compliance[:, axis, axis] * step) + 0.5
    half, time = 0.5 * move.distance, wave.time
    reference = move.at(time)[0]
    ways = [(motors[axis] + half, load + half, torques[axis])]
    if machine.dry or machine.pulls:
        rubbed = rubbing(machine, loops.response, *phasors)
        ways = _dragged_ways(machine, servos, axis, wave, rubbed, half, ways[0])
    (motor, last, torque), back = ways[0], ways[-1][0]
    curves = Curves(time, reference, motor, back, last, torque, time, stepped)
    band = move.settling_band
    speeds = np.gradient(motors, time, axis=1)
    return Moved(
        curves.figures(band),
        _worst([move_figures(time, reference, way[1], band) for way in ways]),
        step_figures(time, stepped, 1.0),
        max(float(np.abs(way[2]).max()) for way in ways),
        curves,
        np.abs([torques, motors, speeds]).max(axis=2),
    )


def _dragged_ways(
    machine: Machine,
    servos: tuple[Servo, ...],
    axis: int,
    wave: HalfWave,
    rubbed: ComplexArray,
    half: float,
    way: tuple[FloatArray, FloatArray, FloatArray],
) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Return motor, last mass and torque of the way out and of that back, friction and weights included.

    The way back is told as if it were a way out; ``half`` is half the way.
    """
    dry = len(machine.dry)
    out = wave.signal(1j * wave.omega * rubbed.T[:dry]).T
    path = wave.signal(rubbed.T[dry:]).T
    middle = np.array([half * (machine.axis_of(pull.place) == axis) for pull in machine.pulls])
    step = wave.duration / wave.samples
    added = dragged(
        machine,
        servos,
        axis,
        step,
        np.concatenate([out, -out]),
        np.concatenate([middle + path, middle - path]),
    )
    n = wave.samples
    motor, load, torque = way
    first = (motor + added.motor[:n], load + added.load[:n], torque + added.torque[:n])
    back = (motor - added.motor[n:], load - added.load[n:], torque - added.torque[n:])
    return [first, back]


def _stuck(machine: Machine, servos: tuple[Servo, ...], move: TestMove) -> float:
    """Return the time that an integrator takes to turn friction round from the edge of the band, s."""
    longest = 0.0
    for dry in machine.dry:
        for motor, load, servo in zip(machine.motors, machine.loads, servos, strict=True):
            if dry.place in (motor, load):
                rate = servo.loop.velocity_i * servo.loop.position_p * move.settling_band
                turned = dry.forward + dry.backward + 2 * dry.extra
                longest = max(longest, turned / rate if rate > 0 else LONGEST_STUCK)
    return longest


def _worst(figures: Sequence[MoveFigures]) -> MoveFigures:
    """Return the largest of each figure."""
    return MoveFigures(
        **{one.name: max(getattr(f, one.name) for f in figures) for one in fields(MoveFigures)}
    )


def _wave(values: ComplexArray, beyond: float, shortest: float) -> HalfWave:
    """Return samples for a response of a machine with these eigenvalues.

    Parameters
    ----------
    values
        Eigenvalues, rad/s.
    beyond
        s, of the reference and of what else is to be seen.
    shortest
        s: no sample is longer.
    """
    duration = beyond + min(DECAYS / max(-float(values.real.max()), 1e-6), LONGEST)
    matters = np.abs(values)[-values.real < 1e3 / duration + 20 / beyond]
    fastest = float(matters.max()) if matters.size else 1 / shortest
    step = min(shortest, 0.5 / fastest)
    samples = 2 ** int(np.ceil(np.log2(min(max(duration / step, 256), MOST_SAMPLES))))
    return HalfWave(duration, samples)
