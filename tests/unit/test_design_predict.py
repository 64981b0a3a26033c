"""Predictions against three other routes: margins by hand, a state space in time, simulated firmware."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lsim

from drives.sim.effects import CoulombFriction
from drives.sim.firmware import DriveHardware, Parameter, SimulatedAxes
from drives.sim.plant import ChainParameters, PlantParameters
from fieldtool.design.decide import design
from fieldtool.design.drive_side import DriveSide
from fieldtool.design.figures import move_figures
from fieldtool.design.loops import Loops, stable, system_matrix
from fieldtool.design.machine import machine_of, respond
from fieldtool.design.margins import margins_of
from fieldtool.design.moves import TestMove, typical_move
from fieldtool.design.predict import predict
from fieldtool.design.rule import rule, sensitivity_peak
from fieldtool.design.servo import Servo, Timing, servo_from_parameters
from fieldtool.records.closed_loop import AxisLoop, Biquad, ClosedLoop
from fieldtool.records.model import AxisModel, Estimate, MachineModel

RandomModel = Callable[..., MachineModel]
LENGTHS = [(1,), (2,), (3,), (2, 1), (1, 3), (2, 3, 1)]


def plant_of(model, friction=None):
    """The simulated machine of the same values, with dry friction at (axis, place) if wanted."""
    friction = friction or {}
    chains = tuple(
        ChainParameters(
            *(tuple(e.value for e in part) for part in (a.masses, a.springs, a.dampers)),
            effects=tuple(
                CoulombFriction(torque, place)
                for (axis, place), torque in friction.items()
                if axis == a.name
            ),
        )
        for a in model.axes
    )
    names = model.names
    couplings = tuple(
        (names.index(c.axes[0]), names.index(c.axes[1]), c.value) for c in model.couplings
    )
    return PlantParameters(chains, couplings)


def moves_of(model: MachineModel) -> list[TestMove]:
    return [typical_move(a.name, (-2, 2), 4.0, 40.0, 100.0, a.total_mass) for a in model.axes]


def test_margins_of_an_integrator_with_delay() -> None:
    """L = K exp(-s T) / s: phase margin 90 - K T, gain margin pi / (2 K T), both by hand."""
    K, T = 10.0, 0.05
    omega = np.geomspace(0.1, 500, 4000)
    L = K * np.exp(-1j * omega * T) / (1j * omega)
    found = margins_of(omega, 1 / (1 + L))
    assert found.phase_margin == pytest.approx(90 - np.degrees(K * T), abs=0.1)
    assert found.delay_margin == pytest.approx((np.pi / 2 - K * T) / K, rel=0.005)
    assert found.gain_margin == pytest.approx(np.pi / (2 * K * T), rel=0.01)
    assert found.gain_reduction == 0.0
    assert found.sensitivity_peak == pytest.approx(np.abs(1 / (1 + L)).max())


@pytest.mark.parametrize("lengths", LENGTHS, ids=str)
def test_without_delay_as_the_state_space_in_time(
    lengths: tuple[int, ...], random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    """The move by sines that go there and back, and by matrix exponentials from rest."""
    model = random_model(fresh_rng, lengths, friction=bool(fresh_rng.integers(2)))
    loops = [replace(loop, inertia_ff=0.0) for loop in rule(model)]
    servos = [Servo(loop) for loop in loops]
    moves = moves_of(model)
    found = predict(model, servos, moves)
    assert found.stable == ClosedLoop(model, tuple(loops)).stable
    for k, axis in enumerate(found.axes):
        assert axis.margins.sensitivity_peak == pytest.approx(
            sensitivity_peak(model, loops, k), rel=0.02
        )
        step = 5e-4
        references = np.zeros((int(axis.curves.time[-1] / step) + 1, len(lengths)))
        t = np.arange(references.shape[0]) * step
        references[:, k] = moves[k].at(t)[0]
        position, torque = ClosedLoop(model, tuple(loops)).simulate(references, step)
        size = np.abs(references[:, k] - position[:, k]).max()
        there = np.interp(t, axis.curves.time, axis.curves.position)
        assert there == pytest.approx(position[:, k], abs=0.02 * size)
        # the torque's stairs in the one come from its reference's corners
        assert axis.peak_torque == pytest.approx(np.abs(torque[:, k]).max(), rel=0.05)
        others = np.arange(len(lengths)) != k
        pushed, way, _ = axis.beside[:, others]
        slight = 0.01 * axis.peak_torque
        assert pushed == pytest.approx(np.abs(torque).max(axis=0)[others], rel=0.05, abs=slight)
        assert way == pytest.approx(np.abs(position).max(axis=0)[others], rel=0.05, abs=0.01 * size)
        speed = np.abs(np.gradient(position, step, axis=0)).max(axis=0)
        fastest = 0.01 * speed[k]
        assert axis.beside[2] == pytest.approx(speed, rel=0.05, abs=fastest)


@pytest.mark.parametrize("lengths", [(2,), (1, 2)], ids=str)
def test_stability_and_sensitivity_as_the_eigenvalues_say(
    lengths: tuple[int, ...], random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    """Gains raised until the eigenvalues cross: the sensitivity's peak grows beyond all bounds there."""
    model = random_model(fresh_rng, lengths)
    machine = machine_of(model)
    timing = Timing(2e-3, 1e-3)
    loops = rule(model)

    def servos(factor: float) -> tuple[Servo, ...]:
        first = replace(loops[0], velocity_p=factor * loops[0].velocity_p)
        return tuple(Servo(x, 200.0, timing) for x in (first, *loops[1:]))

    low, high = 1.0, 1e4
    assert stable(machine, servos(low))
    assert not stable(machine, servos(high))
    for _ in range(60):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if stable(machine, servos(middle)) else (low, middle)
    values = np.linalg.eigvals(system_matrix(machine, servos(low)))
    w = abs(values[np.argmax(values.real)].imag)
    near = Loops(respond(machine, w * np.linspace(0.98, 1.02, 4001)), servos(low))
    assert np.abs(near.sensitivity[:, 0]).max() > 30
    # and the loop's margin tells the factor from afar
    margin = predict(model, servos(1.0), moves_of(model)).axes[0].margins.gain_margin
    assert margin == pytest.approx(low, rel=0.05)


def test_the_peak_of_all_loops_together_has_no_unit(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    """One axis told in another unit of length: its masses, gains and couplings are other numbers."""
    model = random_model(fresh_rng, (1, 2))
    machine, unit = machine_of(model), float(fresh_rng.uniform(10.0, 1000.0))
    scale = np.where(np.arange(machine.mass.shape[0]) < machine.motors[1], 1.0, unit)
    both = np.outer(scale, scale)
    parts = {n: getattr(machine, n) * both for n in ("mass", "damping", "stiffness", "loss")}
    loops, moves = rule(model), moves_of(model)
    second = loops[1]
    told = replace(
        second,
        velocity_p=unit**2 * second.velocity_p,
        velocity_i=unit**2 * second.velocity_i,
        inertia_ff=unit**2 * second.inertia_ff,
    )
    timing = Timing(1e-3, 1e-3)
    way = moves[1]
    short = replace(
        way,
        distance=way.distance / unit,
        velocity=way.velocity / unit,
        acceleration=way.acceleration / unit,
        jerk=way.jerk / unit,
    )
    peaks = [
        predict(one, [Servo(x, 500.0, timing) for x in both_loops], both_moves).sensitivity_peak
        for one, both_loops, both_moves in (
            (machine, loops, moves),
            (replace(machine, **parts), (loops[0], told), [moves[0], short]),
        )
    ]
    assert peaks[0] > 1.0
    assert peaks[1] == pytest.approx(peaks[0], rel=1e-3)


def test_the_delay_of_the_state_space_is_that_of_the_frequency_response() -> None:
    """exp(A t) of the closed loops against the inverse transform of the frequency response."""
    chain = AxisModel(
        "x", "rotary", (Estimate(0.02), Estimate(0.03)), (Estimate(190.0),), (Estimate(0.05),)
    )
    machine = machine_of(MachineModel((chain,)))
    loop = AxisLoop(12.0, 1.2, 10.0, filters=(Biquad.notch(20.0, 0.2, 0.7),))
    servo = Servo(loop, 150.0, Timing(1e-3, 0.5e-3))
    A = system_matrix(machine, (servo,))
    kick = np.zeros(A.shape[0])
    kick[2] = 1 / 0.02  # an impulse of torque at the motor
    omega = np.arange(1, 60000) * 2 * np.pi / 30.0
    compliance = Loops(respond(machine, omega), (servo,)).compliance[:, 0, 0]
    for t in (0.02, 0.1, 0.35):
        by_time = float((expm(A * t) @ kick)[0])
        by_frequency = float(np.sum((compliance * np.exp(1j * omega * t)).real) * 2 / 30.0)
        assert by_time == pytest.approx(by_frequency, abs=1e-3)


def cascades_of(model: MachineModel, rng: np.random.Generator) -> list[dict[str, float]]:
    return [
        {
            "position_p": loop.position_p,
            "velocity_p": loop.velocity_p,
            "velocity_i": loop.velocity_i,
            "velocity_ff": 1.0,
            "viscous_ff": float(rng.uniform(0, 1)) * loop.velocity_p,
            "inertia_ff": 0.7 * loop.inertia_ff,
            "velocity_filter": float(rng.uniform(40, 400)),
            "filter1_type": 2.0,
            "filter1_frequency": float(rng.uniform(60, 200)),
            "filter1_zero_damping": 0.1,
            "filter1_pole_damping": 0.7,
        }
        for loop in rule(model)
    ]


def moved_by_firmware(plant, values, k: int, targets, cycle: float, rate: float):
    """Motor positions of axis k, cycle by cycle, while its targets are sent; the others stand."""
    hardware = DriveHardware(1000.0, 0.0, 2**23 / (2 * np.pi))
    axes = SimulatedAxes(plant, [hardware] * len(values), 1, rate)
    for i, one in enumerate(values):
        for name, value in one.items():
            axes.set(i, Parameter[name.upper()], value)
        axes.follow_position(i, 0.0, 32)
    position = np.zeros(targets.size)
    for n in range(targets.size):
        position[n] = axes.position(k)
        # a target is reached a cycle after it was sent
        for i in range(len(values)):
            target = targets[min(n + 1, targets.size - 1)] if i == k else 0.0
            axes.follow_position(i, target, 32)
        axes.advance(32)
    return position


@pytest.mark.parametrize("lengths", [(1,), (2,), (2, 1), (2, 3)], ids=str)
def test_simulated_firmware_does_as_predicted(
    lengths: tuple[int, ...], random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    """Sampled loops, rounded positions, stairs of torque: the figures are those predicted."""
    model = random_model(fresh_rng, lengths)
    cycle, rate = 0.004, 8000.0
    values = cascades_of(model, fresh_rng)
    timing = Timing(0.22e-3, 1 / rate, cycle)
    found = predict(model, [servo_from_parameters(v, timing) for v in values], moves_of(model))
    if not found.stable:
        pytest.skip("a random filter makes this machine unstable")
    k = int(fresh_rng.integers(len(lengths)))
    curves = found.axes[k].curves
    t = np.arange(int(curves.time[-1] / cycle)) * cycle
    targets = moves_of(model)[k].at(t)[0]
    position = moved_by_firmware(plant_of(model), values, k, targets, cycle, rate)
    expected = np.interp(t, curves.time, curves.position)
    size = found.axes[k].move.following_error
    assert position == pytest.approx(expected, abs=0.03 * size + 1e-5)


@pytest.mark.parametrize("lengths", [(1,), (2,), (3, 1)], ids=str)
def test_dry_friction_is_in_what_is_predicted_of_moves(
    lengths: tuple[int, ...], random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    """Out and back in the simulated firmware with exact sticking, against time stepping in the model."""
    model = random_model(fresh_rng, lengths)
    cycle, rate = 0.004, 8000.0
    values = cascades_of(model, fresh_rng)
    for one in values:
        one["filter1_type"] = 0.0
    timing = Timing(0.22e-3, 1 / rate, cycle)
    servos = [servo_from_parameters(v, timing) for v in values]
    moves = moves_of(model)
    friction = {
        (axis.name, place): float(fresh_rng.uniform(0.02, 0.2))
        * move.acceleration
        * axis.total_mass
        for axis, move in zip(model.axes, moves, strict=True)
        for place in (["motor", "load"] if len(axis.masses) > 1 else ["motor"])
    }
    effects = tuple(
        {"effect": "coulomb_friction", "axis": name, "location": place,
         "parameters": {"torque": {"value": torque, "std": None, "unit": "N m"}}}
        for (name, place), torque in friction.items()
    )  # fmt: skip
    found = predict(replace(model, effects=effects), servos, moves)
    smooth = predict(model, servos, moves)
    k = int(fresh_rng.integers(len(lengths)))
    curves, move = found.axes[k].curves, found.axes[k].move
    t = np.arange(int(curves.time[-1] / cycle)) * cycle
    out = moves[k].at(t)[0]
    targets = np.concatenate([out, out[-1] - out])
    position = moved_by_firmware(plant_of(model, friction), values, k, targets, cycle, rate)
    expected = np.interp(t, curves.time, curves.position)
    plain = np.interp(t, smooth.axes[k].curves.time, smooth.axes[k].curves.position)
    apart = np.abs(position[: t.size] - expected).max()
    assert apart <= 0.03 * move.following_error + 1e-5
    assert np.abs(position[: t.size] - plain).max() > 2 * apart  # the friction matters
    band = moves[k].settling_band
    measured = [
        move_figures(t, out, position[: t.size], band),
        move_figures(t, out, out[-1] - position[t.size :], band),
    ]
    worst = max(one.following_error for one in measured)
    assert move.following_error == pytest.approx(worst, rel=0.05)


def test_noise_of_an_encoder_as_the_firmware_makes_it() -> None:
    """A velocity of 1e-3 of a count a step dithers the count; torque noise is its RMS."""
    rng = np.random.default_rng(3)
    step, rate = 1e-4, 8000.0
    servo = Servo(AxisLoop(30.0, 2.0, 0.0), 100.0, Timing(0.0, 1 / rate))
    rounded = step * (rng.random(400_000) - 0.5)
    velocity = np.diff(rounded, prepend=0.0) * rate
    share = 1 - np.exp(-2 * np.pi * 100.0 / rate)
    filtered = np.zeros_like(velocity)
    for n in range(1, velocity.size):
        filtered[n] = filtered[n - 1] + share * (velocity[n] - filtered[n - 1])
    torque = 2.0 * (30.0 * rounded + filtered)
    assert servo.torque_noise(step) == pytest.approx(torque[100:].std(), rel=0.03)


@pytest.mark.parametrize("filters", [(), (Biquad.low_pass(300.0, 0.5),)], ids=["bare", "low-pass"])
def test_a_count_makes_the_torque_that_the_firmware_makes_of_it(
    filters: tuple[Biquad, ...],
) -> None:
    """One step of the encoder of an axis that is held, cycle by cycle as a drive computes it."""
    rate, resolution = 8000.0, 2 * np.pi / 2**14
    loop = AxisLoop(60.0, 2.0, 0.0, filters=filters)
    late = 1 - np.exp(-2 * np.pi * 130.0 / rate)
    speed, told = 0.0, []
    for n in range(400):
        moved = rate * resolution if n == 1 else 0.0
        speed += late * (moved - speed)
        told.append(2.0 * (60.0 * resolution * (n >= 1) + speed))
    torque = np.array(told)
    for one in filters:
        system = (np.trim_zeros(one.numerator, "f"), (1.0, *one.denominator))
        torque = lsim(system, torque, np.arange(400) / rate)[1]
    found = Servo(loop, 130.0, Timing(0.0, 1 / rate)).count_torque(resolution)
    assert found == pytest.approx(np.abs(torque).max(), rel=0.07)


def test_noise_of_rounded_targets_as_the_firmware_makes_it() -> None:
    """A slow target in whole counts: its differences, fed forward, are the motor's torque."""
    step, cycle = 1e-4, 0.002
    loop = AxisLoop(0.0, 2.0, 0.0, 1.0, 0.5, viscous_ff=3.0)
    servo = Servo(loop, timing=Timing(0.0, 0.125e-3, cycle))
    axes = SimulatedAxes(
        PlantParameters((ChainParameters((1e9,), (), ()),)),
        [DriveHardware(1e6, 0.0, 1e9, 1e9)],
        1,
    )
    for name in ("velocity_p", "velocity_ff", "viscous_ff", "inertia_ff"):
        axes.set(0, Parameter[name.upper()], getattr(loop, name))
    torque = []
    for n in range(3000):
        # a parabola: its whole counts are rounded as if by chance
        axes.follow_position(0, step * round(0.3 * n + 3.7e-4 * n * n), 16)
        for _ in range(16):
            axes.advance(1)
            torque.append(axes.torque(0))
    found = np.std(torque[100:])
    assert found == pytest.approx(servo.target_noise(step), rel=0.1)


def test_an_unstable_machine_has_no_moves() -> None:
    model = MachineModel(
        (
            AxisModel(
                "x", "rotary", (Estimate(1.0), Estimate(1.0)), (Estimate(400.0),), (Estimate(0.01),)
            ),
        )
    )
    servo = Servo(AxisLoop(50.0, 500.0, 9000.0), 10.0, Timing())
    (axis,) = predict(model, [servo], moves_of(model)).axes
    found = predict(model, [servo], moves_of(model))
    assert not found.stable
    assert axis.move is None
    assert found.as_dict()["sensitivity_peak"] is None
    assert found.of("x").as_dict()["move"] is None


def test_effects_of_an_extended_model_act() -> None:
    """Lag, scale, an added mode, a coupling spring: each as written by hand into the equations."""
    one = AxisModel("x", "rotary", (Estimate(1.0),), ())
    other = AxisModel("y", "rotary", (Estimate(2.0),), ())
    effects = (
        {
            "effect": "torque_lag",
            "axis": "x",
            "parameters": {"time": {"value": 0.01, "std": 1e-4, "unit": "s"}},
        },
        {"effect": "torque_scale", "axis": "x", "parameters": {"scale": 1.2}},
        {
            "effect": "extra_mode",
            "axis": "y",
            "location": "load",
            "parameters": {"mass": 0.5, "frequency": 3.0, "damping_ratio": 0.1},
        },
        {
            "effect": "coupling_spring",
            "axis": ["x", "y"],
            "location": "load",
            "parameters": {"stiffness": 7.0},
        },
    )
    machine = machine_of(MachineModel((one, other), (), effects))
    w = 2 * np.pi * 2.0
    s, spring = 1j * w, 0.5 * (6 * np.pi) ** 2
    damper = 2 * 0.1 * 0.5 * 6 * np.pi
    hung = 0.5 * s**2 * (spring + damper * s) / (0.5 * s**2 + spring + damper * s)
    by_hand = np.linalg.inv(
        np.array([[s**2 + 7.0, -7.0], [-7.0, 2 * s**2 + hung + 7.0]])
    ) @ np.diag([1.2 / (1 + 0.01 * s), 1.0])
    assert respond(machine, np.array([w])).motors[0] == pytest.approx(by_hand)


def test_the_peak_of_sensitivity_is_that_of_the_simulated_firmware(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    """A sine of torque is added in the sampled loops at the designed peak; what acts is S times it."""
    model = random_model(fresh_rng, (2, 1))
    timing, rate = Timing(0.22e-3, 0.125e-3, 0.004), 8000.0
    sides = [DriveSide(a.name, None, timing, 500.0 * a.total_mass, 1e-6) for a in model.axes]
    tuning = design(model, sides, response="stiff")
    assert tuning.prediction is not None
    hardware = DriveHardware(1000.0, 0.0, 2**30 / (2 * np.pi))
    k = int(fresh_rng.integers(2))
    margins = tuning.prediction.axes[k].margins
    axes = SimulatedAxes(plant_of(model), [hardware] * 2, 1, rate)
    for i, one in enumerate(tuning.axes):
        for name, value in one.parameters.items():
            axes.set(i, Parameter[name.upper()], value)
        axes.follow_position(i, 0.0, 32)
    w = 2 * np.pi * margins.peak_frequency
    size = 0.2 * model.axes[k].total_mass
    count = int(rate * max(8.0, 40 * 2 * np.pi / w))
    torque = np.empty(count)
    for n in range(count):
        axes.set(k, Parameter.TORQUE_OFFSET, size * np.sin(w * n / rate))
        for i in range(2):
            if n % 32 == 0:
                axes.follow_position(i, 0.0, 32)
        axes.advance(1)
        torque[n] = axes.torque(k)
    last = np.arange(count)[int(0.6 * count) :]
    basis = np.column_stack([np.sin(w * last / rate), np.cos(w * last / rate)])
    gain = np.hypot(*np.linalg.lstsq(basis, torque[last], rcond=None)[0]) / size
    shape = np.prod(
        [
            abs(f.response(np.array([1j * w]))[0])
            for f in sides[k].servo(tuning.axes[k].parameters).loop.filters
        ]
    )
    assert gain / shape == pytest.approx(margins.sensitivity_peak, rel=0.05)
