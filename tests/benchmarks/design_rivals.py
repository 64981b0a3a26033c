"""Other ways to gains: relay tuning, symmetric optimum, a shaper alone, a global search."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import differential_evolution

from fieldtool.design.figures import MoveFigures, move_figures
from fieldtool.design.loops import Loops, stable, system_matrix
from fieldtool.design.machine import Machine, machine_of, respond
from fieldtool.design.moves import TestMove
from fieldtool.design.predict import frequencies
from fieldtool.design.servo import Servo, Timing
from fieldtool.design.shaping import impulses, vibration_left
from fieldtool.design.waves import HalfWave
from fieldtool.records.closed_loop import AxisLoop, Biquad
from fieldtool.records.model import FloatArray, MachineModel

DAMPINGS_OF_SHAPER = 0.1
"""Klipper's own choice of the damping ratio."""


def relay(model: MachineModel, timing: Timing) -> tuple[Servo, ...]:
    """Ziegler-Nichols: velocity loop to its ultimate gain (as a relay finds it), then position loop.

    Axis after axis with the others at rest under a weak loop, as a relay test does it; PI by 0.45 Ku
    and Tu / 1.2, position P by 0.5 Ku.  Ziegler and Nichols, Trans. ASME 64, 1942; Astrom and
    Hagglund, Automatica 20, 1984.
    """
    machine = machine_of(model)
    weak = [Servo(AxisLoop(0.5, 2.0 * a.total_mass, 0.0), 500.0, timing) for a in model.axes]
    return tuple(
        _relay_axis(machine, weak, k, axis.total_mass) for k, axis in enumerate(model.axes)
    )


def _relay_axis(machine: Machine, weak: list[Servo], k: int, mass: float) -> Servo:
    def with_loop(loop: AxisLoop) -> tuple[Servo, ...]:
        tried = list(weak)
        tried[k] = replace(weak[k], loop=loop)
        return tuple(tried)

    ku = _ultimate(machine, lambda gain: with_loop(AxisLoop(1e-3, gain, 0.0)), mass)
    values = np.linalg.eigvals(system_matrix(machine, with_loop(AxisLoop(1e-3, 0.999 * ku, 0.0))))
    values = values[np.abs(values.imag) > 1.0]
    period = 2 * np.pi / abs(values[np.argmax(values.real)].imag)
    kv, ki = 0.45 * ku, 0.45 * ku * 1.2 / period
    kp = 0.5 * _ultimate(machine, lambda gain: with_loop(AxisLoop(gain, kv, ki)), 1.0)
    return with_loop(AxisLoop(kp, kv, ki))[k]


def _ultimate(machine: Machine, servos, start: float) -> float:  # type: ignore[no-untyped-def]
    """Return the gain at which the loops begin to swing."""
    low, high = 1e-3 * start, 1e-3 * start
    while stable(machine, servos(high)) and high < 1e7 * start:
        low, high = high, 2 * high
    for _ in range(40):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if stable(machine, servos(middle)) else (low, middle)
    return low


def symmetric_optimum(
    model: MachineModel, timing: Timing, velocity_filter: float
) -> tuple[Servo, ...]:
    """Return gains on the total inertia: Kessler 1958, with all small delays in one sum.

    velocity_p = J / (2 T), velocity_i = velocity_p / (4 T), position_p = 1 / (8 T).
    """
    t = timing.lag + 0.5 * timing.period + 1 / (2 * np.pi * velocity_filter)
    return tuple(
        Servo(
            AxisLoop(1 / (8 * t), a.total_mass / (2 * t), a.total_mass / (8 * t * t)),
            velocity_filter,
            timing,
        )
        for a in model.axes
    )


def klipper_choice(frequency: float) -> tuple[str, FloatArray, FloatArray]:
    """Return the shaper that Klipper's rule would take for one resonance, its amplitudes and times.

    Least score of remaining vibration and smoothing among ZV, MZV, ZVD, EI at damping 0.1.
    """
    best = None
    for name in ("ZV", "MZV", "ZVD", "EI"):
        a, t = impulses(name, frequency, DAMPINGS_OF_SHAPER)
        left = max(
            vibration_left(a, t, f, DAMPINGS_OF_SHAPER)
            for f in frequency * np.array([0.95, 1.0, 1.05])
        )
        centre = float(a @ t)
        smoothing = float(a @ (t - centre) ** 2)
        score = smoothing * frequency**2 * (left**1.5 + 0.2 * left + 0.01)
        if best is None or score < best[0]:
            best = (score, name, a, t)
    assert best is not None
    return best[1], best[2], best[3]


def moved(
    machine: Machine,
    servos: tuple[Servo, ...],
    moves: Sequence[TestMove],
    shapers: Sequence[tuple[FloatArray, FloatArray] | None] | None = None,
) -> list[tuple[MoveFigures, MoveFigures]]:
    """Return figures of motor and last mass of each axis' move, with shaped references where given."""
    values = np.linalg.eigvals(system_matrix(machine, servos))
    out = []
    for k, move in enumerate(moves):
        wave = HalfWave(move.duration + min(8 / max(-values.real.max(), 1e-3), 40.0), 8192)
        s = 1j * wave.omega
        drive = wave.spectrum(wave.move(move))
        shaper = None if shapers is None else shapers[k]
        shaped = drive
        if shaper is not None:
            a, t = shaper
            shaped = drive * (a[:, None] * np.exp(-t[:, None] * s)).sum(axis=0)
        loops = Loops(respond(machine, wave.omega), servos)
        motor, load, _ = loops.motion(k, servos[k].reference_gain(s) * shaped)
        reference, band = move.at(wave.time)[0], move.settling_band
        ended = reference
        if shaper is not None:
            a, t = shaper
            ended = sum(ai * move.at(wave.time - ti)[0] for ai, ti in zip(a, t, strict=True))
        pair = []
        for spectrum in (motor, load):
            position = wave.signal(spectrum) + 0.5 * move.distance
            figures = move_figures(wave.time, reference, position, band)
            # what swings once the shaped reference has ended, too
            swing = move_figures(wave.time, ended, position, band)
            pair.append(replace(figures, residual_peak=swing.residual_peak))
        out.append((pair[0], pair[1]))
    return out


def peaks(machine: Machine, servos: tuple[Servo, ...]) -> FloatArray:
    """Return the peak of sensitivity of each axis; infinite where the machine is not stable."""
    if not stable(machine, servos):
        return np.full(len(servos), np.inf)
    values = np.linalg.eigvals(system_matrix(machine, servos))
    loops = Loops(respond(machine, frequencies(machine, values)), servos)
    return np.abs(loops.sensitivity).max(axis=0)


class Global:
    """The best controllers of the same structure, by differential evolution on the true machine.

    Twelve numbers an axis: three gains, velocity filter, notch (3), low-pass (2), second notch (3), and
    both feed-forwards; bounds on sensitivity, noise, torque and high frequencies as the design has them.
    """

    def __init__(
        self,
        model: MachineModel,
        moves: Sequence[TestMove],
        timing: Timing,
        bound: float,
        top: float,
        noise: Sequence[float],
        torque: Sequence[float],
        resolution: float,
    ) -> None:
        self.machine, self.moves, self.timing, self.bound = machine_of(model), moves, timing, bound
        self.masses = [a.total_mass for a in model.axes]
        self.noise, self.torque, self.resolution, self.top = noise, torque, resolution, top
        modes = np.concatenate([self.machine.modes, self.machine.held_modes, [2 * np.pi]])
        self.w = float(modes.min())
        beside = (modes[:, None] * (1 + 0.03 * np.linspace(-1, 1, 9))).ravel()
        self.response = respond(
            self.machine,
            np.sort(
                np.concatenate(
                    [np.geomspace(0.02 * self.w, 20 * modes.max() + 10 * top, 160), beside]
                )
            ),
        )
        longest = max(m.duration for m in moves)
        self.wave = HalfWave(longest + max(longest, 6 * 2 * np.pi / self.w), 1024)
        self.slow = respond(self.machine, self.wave.omega)
        self.targets = [self.wave.spectrum(self.wave.move(m)) for m in moves]

    def bounds(self) -> list[tuple[float, float]]:
        out = []
        for _ in self.moves:
            frequency = (np.log(self.w), np.log(max(30 * self.w, 3 * self.top)))
            shape = (np.log(0.03), 0.0)
            pole = (np.log(0.3), np.log(2.0))
            out += [
                (np.log(0.02 * self.w), np.log(5 * self.w)),
                (np.log(0.02 * self.w), np.log(30 * self.w)),
                (np.log(0.01), np.log(2.0)),
                (np.log(self.w), np.log(2 * np.pi * 3000)),
                frequency, shape, pole, frequency, shape, pole,
                (0.0, 1.0), (0.0, 1.3),
            ]  # fmt: skip
        return out

    def servos(self, x: FloatArray) -> tuple[Servo, ...]:
        out = []
        for k, y in enumerate(x.reshape(len(self.moves), 12)):
            kp, kv = np.exp(y[0]), self.masses[k] * np.exp(y[1])
            filters = tuple(
                Biquad.notch(
                    np.exp(y[i]) / (2 * np.pi), np.exp(y[i + 1] + y[i + 2]), np.exp(y[i + 2])
                )
                for i in (4, 7)
                if y[i + 1] < -0.02
            )
            loop = AxisLoop(kp, kv, np.exp(y[2]) * kp * kv, y[10], y[11] * self.masses[k], filters)
            out.append(Servo(loop, np.exp(y[3]) / (2 * np.pi), self.timing))
        return tuple(out)

    def cost(self, x: FloatArray) -> float:
        servos = self.servos(x)
        loops = Loops(self.response, servos)
        size = np.abs(loops.sensitivity)
        excess = max(0.0, size.max() / self.bound - 1)
        far = self.response.omega > self.top
        if far.any():
            excess = max(excess, np.abs(1 - loops.sensitivity[far]).max() / 0.5 - 1)
        for servo, most in zip(servos, self.noise, strict=True):
            excess = max(excess, servo.torque_noise(self.resolution) / most - 1)
        if excess > 1 or not stable(self.machine, servos):
            return 1e3 * (1 + min(excess, 1e3))
        slow = Loops(self.slow, servos)
        s = 1j * self.wave.omega
        total = 0.0
        for k, move in enumerate(self.moves):
            drive = servos[k].reference_gain(s) * self.targets[k]
            motor, load, torque = slow.motion(k, drive)
            excess = max(excess, np.abs(self.wave.signal(torque)).max() / self.torque[k] - 1)
            reference = self.wave.move(move)
            arrival = 0.0
            for q in (motor, load):
                error = np.abs(self.wave.signal(q) - reference)
                outside = np.flatnonzero(error > move.settling_band)
                last = outside[-1] if outside.size else 0
                arrival = max(arrival, self.wave.time[last])
                left = error[self.wave.time >= move.duration]
                total += 0.02 * np.log1p(left.max() / move.settling_band)
            total += arrival / move.duration
            stiff = np.abs(loops.compliance[:, k, k]).max() * self.masses[k] * self.w**2
            total += 0.002 * np.log(stiff)
        return float(total + 30 * excess)

    def search(self, generations: int, size: int, seed: int) -> tuple[Servo, ...]:
        found = differential_evolution(
            self.cost, self.bounds(), maxiter=generations, popsize=size, seed=seed, tol=1e-8,
            mutation=(0.4, 0.9), recombination=0.8, polish=False, init="sobol",
        )  # fmt: skip
        return self.servos(found.x)
