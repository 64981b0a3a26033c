"""Every effect of the simulated machine against another integrator, a law or a known answer."""

import json
import re
from dataclasses import asdict, replace
from importlib.resources import files
from math import pi
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from drives.errors import ProfileError
from drives.profile import load_machine
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
from drives.sim.firmware import DriveHardware, Parameter, SimulatedAxes
from drives.sim.machine import simulated_machine
from drives.sim.plant import ChainParameters, Plant, PlantParameters

RATE = 8000
DRIVE = DriveHardware(
    rated_torque=10.0, torque_noise=0.0, counts_per_unit=2**24 / (2 * pi), peak_torque=300.0
)


def axes_of(*chains: ChainParameters, effects: tuple = ()) -> SimulatedAxes:
    return SimulatedAxes(PlantParameters(chains, (), effects), [DRIVE] * len(chains), seed=0)


def rigid(inertia: float, *effects: ChainEffect, friction: float = 0.0) -> ChainParameters:
    return ChainParameters((inertia,), (), (), friction, effects)


def two_mass(*effects: ChainEffect, spring: float = 300.0, damper: float = 0.05) -> ChainParameters:
    return ChainParameters((0.02, 0.05), (spring,), (damper,), 0.01, effects)


def trace(axes: SimulatedAxes, steps: int) -> np.ndarray:
    states = [axes.state]
    for _ in range(steps):
        axes.advance(1)
        states.append(axes.state)
    return np.array(states)


def released(chain: ChainParameters, state: np.ndarray, steps: int) -> np.ndarray:
    axes = axes_of(chain)
    axes.set_state(state)
    return trace(axes, steps)


def two_mass_motion(pull, state: np.ndarray, end: float, **options) -> np.ndarray:
    """State of the two-mass chain at the end, with pull(d, d') in its joint."""

    def rates(t: float, y: np.ndarray) -> list[float]:
        force = pull(y[1] - y[0], y[3] - y[2])
        return [y[2], y[3], (force - 0.01 * y[2]) / 0.02, -force / 0.05]

    solved = solve_ivp(rates, (0, end), state, "DOP853", rtol=1e-9, atol=1e-12, **options)
    return np.asarray(solved.y[:, -1])


def test_a_steady_slide_feels_the_stribeck_curve(fresh_rng: np.random.Generator) -> None:
    effect = StribeckFriction(0.4, 0.7, float(fresh_rng.uniform(0.05, 0.2)))
    for speed in effect.velocity * np.array([0.3, 1.0, 4.0]):
        axes = axes_of(rigid(0.02, effect))
        axes.set(0, Parameter.VELOCITY_P, 5.0)
        axes.set(0, Parameter.VELOCITY_I, 200.0)
        for sign in (1.0, -1.0):
            axes.follow_velocity(0, sign * speed, 100.0, 100.0)
            axes.advance(RATE)
            expected = 0.4 + 0.3 * np.exp(-((speed / effect.velocity) ** 2))
            assert axes.torque(0) == pytest.approx(sign * expected, rel=0.03)


def test_asymmetric_friction_brakes_by_its_direction(fresh_rng: np.random.Generator) -> None:
    forward, backward = fresh_rng.uniform(0.1, 1.0, 2)
    effect = AsymmetricFriction(float(forward), float(backward))
    for sign, torque in ((1.0, forward), (-1.0, backward)):
        speed = sign * 0.9 * torque / 0.02 * 0.2
        states = released(rigid(0.02, effect), np.array([0.0, speed]), RATE // 10)
        slope = (states[-1, 1] - states[200, 1]) / ((RATE // 10 - 200) / RATE)
        assert slope == pytest.approx(-sign * torque / 0.02, rel=1e-3)
        long = released(rigid(0.02, effect), np.array([0.0, speed]), RATE)
        assert abs(long[-1, 1]) < 1e-6  # it stands
        assert np.ptp(long[-800:, 0]) < 1e-6


def test_a_push_below_breakaway_moves_bristles_by_less_than_a_count() -> None:
    axes = axes_of(rigid(0.02, StribeckFriction(0.4, 0.6, 0.1)))
    axes.follow_torque(0, 0.35)
    axes.advance(4 * RATE)
    assert 0.0 < axes.state[0] < 2 * pi / 2**17
    assert abs(axes.state[1]) < 1e-7


def test_within_its_play_a_joint_transmits_nothing() -> None:
    chain = two_mass(Backlash(0.1))
    states = released(chain, np.array([0.0, 0.02, 0.0, 0.5]), 300)
    assert states[-1, 3] == pytest.approx(0.5, abs=1e-4)
    assert states[-1, 0] == pytest.approx(0.0, abs=1e-5)


def test_an_impact_gives_back_what_restitution_says(fresh_rng: np.random.Generator) -> None:
    for e in (0.95, 0.8, 0.5):
        speed = fresh_rng.uniform(0.005, 0.05)
        chain = replace(two_mass(Backlash(0.02, restitution=e), damper=0.0), viscous_friction=0.0)
        states = released(chain, np.array([0.0, 0.00999, 0.0, speed]), 1200)
        relative = states[:, 3] - states[:, 2]
        after = relative[np.argmax(relative < 0.0) :]
        twist = states[:, 1] - states[:, 0]
        apart = after[np.abs(twist[-after.size :]) < 0.01]
        assert -apart[0] / speed == pytest.approx(e, abs=0.03)
        momentum = 0.02 * states[:, 2] + 0.05 * states[:, 3]
        np.testing.assert_allclose(momentum, momentum[0], rtol=1e-9)


@pytest.mark.parametrize("kind", ["hardening", "softening"])
def test_bent_springs_go_as_another_integrator_says(
    kind: str, fresh_rng: np.random.Generator
) -> None:
    stretch = float(fresh_rng.uniform(0.01, 0.03))
    bend = np.sinh if kind == "hardening" else np.tanh
    effect = HardeningSpring(stretch) if kind == "hardening" else SofteningSpring(stretch)
    state = np.array([0.0, 0.03, 0.0, 0.0])
    states = released(two_mass(effect), state, 800)
    expected = two_mass_motion(
        lambda d, v: 300.0 * stretch * bend(d / stretch) + 0.05 * v, state, 0.1
    )
    np.testing.assert_allclose(states[-1, :2], expected[:2], atol=4e-4)


def test_structural_damping_has_one_loss_factor_over_decades(
    fresh_rng: np.random.Generator,
) -> None:
    """Two masses on a joint ring down at a rate that is the same share of every frequency."""
    loss = float(fresh_rng.uniform(0.02, 0.08))
    for spring in (30.0, 300.0, 3000.0):
        chain = ChainParameters((0.02, 0.05), (spring,), (0.0,), 0.0, (StructuralDamping(loss),))
        omega = (spring * (1 / 0.02 + 1 / 0.05)) ** 0.5
        periods = 10
        steps = round(periods * 2 * pi / omega * RATE)
        twist = np.diff(released(chain, np.array([0.0, 0.02, 0.0, 0.0]), steps)[:, :2])[:, 0]
        turns = np.flatnonzero(np.diff(twist)[:-1] * np.diff(twist)[1:] < 0) + 1
        swings = np.abs(np.diff(twist[turns]))  # from peak to trough: the middle creeps
        decay = 2 * np.log(swings[0] / swings[-1]) / (swings.size - 1)
        assert decay / pi == pytest.approx(loss, rel=0.1)


def test_a_screw_that_comes_loose_lowers_the_frequency() -> None:
    chain = ChainParameters((0.02, 0.05), (300.0,), (0.0,), 0.0, (StiffnessChange(0.5, 0.5, 0.01),))
    twist = np.diff(released(chain, np.array([0.0, 0.01, 0.0, 0.0]), RATE)[:, :2])[:, 0]
    crossings = np.flatnonzero(np.diff(np.sign(twist))) / RATE
    before, after = crossings[crossings < 0.5], crossings[crossings > 0.52]
    ratio = np.mean(np.diff(after)) / np.mean(np.diff(before))
    assert ratio == pytest.approx(2**0.5, rel=0.02)


def test_a_pendulum_swings_as_its_equation_says() -> None:
    inertia, torque, angle = 0.05, 2.0, 0.6
    axes = axes_of(rigid(inertia, Gravity(torque, angle), friction=0.05))
    axes.set_state(np.array([1.0, 0.0]))
    assert np.array_equal(trace(axes, 400)[-1], [1.0, 0.0])  # the brake holds it
    axes.follow_torque(0, 0.0)
    axes.advance(4000)

    def rates(t: float, y: np.ndarray) -> list[float]:
        return [y[1], (-torque * np.sin(y[0] + angle) - 0.05 * y[1]) / inertia]

    expected = solve_ivp(rates, (0, 0.5), [1.0, 0.0], rtol=1e-9, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(axes.state, expected, atol=5e-3)
    axes.off(0)
    axes.advance(80)
    assert axes.state[1] == 0.0


def test_a_weight_on_a_linear_axis_falls() -> None:
    axes = axes_of(rigid(2.0, Gravity(19.62, None)))
    axes.follow_torque(0, 0.0)
    axes.advance(RATE)
    assert axes.state[1] == pytest.approx(-9.81, rel=1e-3)


def test_cogging_has_its_first_harmonic_at_its_amplitude(fresh_rng: np.random.Generator) -> None:
    effect = Cogging(0.3, 12.0, float(fresh_rng.uniform(0, 6)), sharpness=1.0)
    axes = axes_of(rigid(0.5, effect))
    for parameter, value in ((Parameter.VELOCITY_P, 50.0), (Parameter.VELOCITY_I, 5000.0)):
        axes.set(0, parameter, value)
    axes.follow_velocity(0, 2.0, 100.0, 100.0)
    axes.advance(RATE)
    positions, torques = np.empty(2 * RATE), np.empty(2 * RATE)
    before = axes.state[1]
    for k in range(2 * RATE):
        speed = axes.state[1]
        axes.advance(1)
        positions[k] = axes.state[0]
        torques[k] = axes.torque(0) - 0.5 * (axes.state[1] - speed) * RATE
    assert abs(before - 2.0) < 0.1
    whole = positions < positions[0] + 2 * pi / 12 * int(
        (positions[-1] - positions[0]) * 12 / 2 / pi
    )
    x, y = positions[whole], torques[whole]
    weight = np.gradient(x)
    waves = [2 * np.sum(y * np.exp(-12j * h * x) * weight) / np.sum(weight) for h in (1, 2)]
    assert abs(waves[0]) == pytest.approx(0.3, rel=0.02)
    assert 0.05 < abs(waves[1]) / abs(waves[0]) < 0.6


def test_a_rotor_pushes_at_its_frequency() -> None:
    axes = axes_of(rigid(0.5, PeriodicDisturbance(0.4, 7.0, 1.1)))
    speed = trace(axes, 8 * RATE)[:, 1]
    acceleration = np.diff(speed) * RATE
    time = np.arange(acceleration.size) / RATE
    wave = 2 * np.mean(0.5 * acceleration * np.exp(-2j * pi * 7.0 * time))
    assert abs(wave) == pytest.approx(0.4, rel=1e-3)
    assert np.angle(wave) == pytest.approx(1.1, abs=0.01)


@pytest.mark.parametrize("location", ["motor", "load"])
def test_an_extra_mode_is_a_mass_on_a_spring(location) -> None:
    mode = ExtraMode(0.01, 20.0, 0.05, location)
    chain = two_mass(mode)
    plant = Plant(PlantParameters((chain,)))
    m = np.diag([0.02, 0.05, 0.01])
    k = np.zeros((3, 3))
    on = 0 if location == "motor" else 1
    for a, b, s in ((0, 1, 300.0), (on, 2, 0.01 * (2 * pi * 20.0) ** 2)):
        k[a, a] += s
        k[b, b] += s
        k[a, b] -= s
        k[b, a] -= s
    expected = np.sqrt(np.abs(np.linalg.eigvals(np.linalg.solve(m, k)).real))
    np.testing.assert_allclose(plant.eigenfrequencies, np.sort(expected), atol=1e-3)
    assert released(chain, np.array([0, 0.01, 0, 0, 0, 0.0]), 50).shape == (51, 6)


def test_springs_and_inertias_between_axes_stand_in_the_matrices() -> None:
    chains = (two_mass(), two_mass())
    parameters = PlantParameters(
        chains, (), (CouplingSpring((0, 1), 50.0, 0.2), CouplingInertia((0, 1), 0.004))
    )
    plant = Plant(parameters)
    assert plant.mass_matrix[0, 2] == plant.mass_matrix[2, 0] == 0.004
    assert plant.stiffness_matrix[1, 3] == -50.0
    assert plant.damping_matrix[1, 3] == -0.2
    assert np.count_nonzero(plant.eigenfrequencies == 0.0) == 1
    with pytest.raises(ValueError, match="not two of the 2 chains"):
        PlantParameters(chains, (), (CouplingSpring((0, 2), 50.0),))


def accelerated(effect: ChainEffect, torque: float, steps: int = 800) -> SimulatedAxes:
    axes = axes_of(rigid(0.02, effect))
    axes.follow_torque(0, torque)
    axes.advance(steps)
    return axes


def test_a_motor_gives_its_share_of_the_torque() -> None:
    axes = accelerated(TorqueScale(0.8), 1.0)
    before = axes.state[1]
    axes.advance(800)
    assert axes.state[1] - before == pytest.approx(0.8 / 0.02 * 0.1, rel=1e-9)
    assert axes.torque(0) == pytest.approx(1.0)


def test_a_saturated_motor_gives_no_more() -> None:
    for torque, given in ((0.2, 0.2), (1.0, 2.0 ** (-1 / 6)), (20.0, 1.0)):
        axes = accelerated(TorqueSaturation(1.0), torque)
        before = axes.state[1]
        axes.advance(80)
        assert axes.state[1] - before == pytest.approx(given / 0.02 * 0.01, rel=1e-3)


def test_a_lag_delays_the_momentum_by_its_time_constant() -> None:
    lag, plain = accelerated(TorqueLag(0.004), 1.0), accelerated(TorqueScale(1.0), 1.0)
    missing = (plain.state[1] - lag.state[1]) * 0.02
    assert missing == pytest.approx(1.0 * 0.004, rel=1e-6)


def test_the_host_gets_the_position_late_and_the_loops_do_not(
    fresh_rng: np.random.Generator,
) -> None:
    steps = int(fresh_rng.integers(1, 30))
    axes = axes_of(rigid(0.02, MeasurementDelay(steps / RATE)))
    axes.follow_torque(0, 0.05)
    shown, true = [], []
    for _ in range(200):
        axes.advance(1)
        shown.append(int(axes.latch()[0][0]))
        true.append(axes.position_counts(0))
    assert shown[steps:] == true[:-steps]
    assert shown[:steps] == [0] * steps


def test_an_encoder_with_offsets_errs_by_a_sine_of_the_position() -> None:
    effect = EncoderError(1e-3, 16.0, 0.7)
    places = np.linspace(-7.0, 7.0, 400)
    errors = []
    for place in places:
        axes = axes_of(rigid(0.02, effect))
        axes.set_state(np.array([place, 0.0]))
        errors.append(axes.position(0) - place)
    first = 2 * np.mean(errors * np.exp(-16j * places))
    expected = 1e-3 * np.sin(0.7 - 16.0 * places)
    np.testing.assert_allclose(errors, expected, atol=3e-5)
    assert abs(first) == pytest.approx(1e-3, rel=0.1)


def test_an_ideal_shaft_and_no_element_change_nothing(fresh_rng: np.random.Generator) -> None:
    """The loop with elements and the plain one go alike, dry friction included."""
    for friction in ((), (CoulombFriction(0.3), CoulombFriction(0.2, "load"))):
        chain = two_mass(*friction)
        bent = replace(chain, effects=(*friction, TorqueScale(1.0), HardeningSpring(1e9)))
        states = []
        for each in (chain, bent):
            axes = axes_of(each)
            axes.set(0, Parameter.VELOCITY_P, 0.5)
            axes.set_state(np.array([0.1, 0.11, 1.0, -1.0]))
            axes.follow_velocity(0, 2.0, 50.0, 50.0)
            axes.advance(3000)
            states.append(axes.state)
        np.testing.assert_allclose(states[0], states[1], atol=1e-9)


def test_parts_that_can_not_be_are_refused() -> None:
    for build, words in (
        (lambda: StribeckFriction(1.0, 0.5, 0.1), "breakaway"),
        (lambda: AsymmetricFriction(-1.0, 0.5), "forward"),
        (lambda: Backlash(0.0), "play"),
        (lambda: StiffnessChange(float("nan"), 1.0), "factor"),
        (lambda: Gravity(1.0, location="middle"), "location"),  # type: ignore[arg-type]
        (lambda: EncoderError(0.5, 16.0), "amplitude"),
        (lambda: CouplingSpring((1, 1), 5.0), "two different"),
        (lambda: axes_of(rigid(0.1, Backlash(0.1))), "joint 1 does not exist"),
        (lambda: axes_of(rigid(0.1, TorqueScale(1.0), TorqueScale(2.0))), "two effects"),
    ):
        with pytest.raises(ValueError, match=words):
            build()


# -- where it is said ---------------------------------------------------------------------------------


def profile_text(axis_effects: str, machine_effects: str = "[]") -> str:
    text = files("profiles").joinpath("machines", "turntable-arm.yaml").read_text("utf-8")
    text = text.replace("  seed: 7\n", f"  seed: 7\n  effects: {machine_effects}\n")
    first = "    - masses: [0.02, 0.03]\n"
    return text.replace(first, f"{first}      effects: {axis_effects}\n")


def test_a_profile_names_every_effect(tmp_path: Path) -> None:
    wanted = (
        StribeckFriction(0.4, 0.6, 0.1, "load"),
        AsymmetricFriction(0.3, 0.2),
        Backlash(0.01, 1, 0.5),
        HardeningSpring(0.1),
        SofteningSpring(0.2),
        StructuralDamping(0.05),
        StiffnessChange(0.7, 3.0),
        Gravity(2.0, 0.3),
        Cogging(0.1, 12.0),
        PeriodicDisturbance(0.1, 7.0),
        ExtraMode(0.01, 20.0),
        TorqueScale(0.9),
        TorqueSaturation(3.0),
        TorqueLag(0.001),
        MeasurementDelay(0.002),
        EncoderError(0.001, 16.0),
    )
    parts = []
    for effect in wanted:
        words = re.sub(r"(?<!^)(?=[A-Z])", "_", type(effect).__name__).lower()
        fields = {k: v for k, v in asdict(effect).items() if k not in ("brake", "band", "linear")}
        parts.append({"effect": words, **fields})
    between = [
        {"effect": "coupling_spring", "axes": ["table", "arm"], "spring": 5.0},
        {"effect": "coupling_inertia", "axes": ["arm", "table"], "inertia": 0.001},
    ]
    path = tmp_path / "machine.yaml"
    path.write_text(profile_text(json.dumps(parts), json.dumps(between)))
    machine = simulated_machine(load_machine(path))
    assert machine.drives[0].chain.effects == wanted
    assert machine.effects == (CouplingSpring((0, 1), 5.0), CouplingInertia((1, 0), 0.001))
    assert Plant(machine.plant).size == 4


@pytest.mark.parametrize(
    ("axis", "between", "message"),
    [
        ("[{effect: backlash, joint: 2, play: 0.1}]", "[]", "joint 2 does not exist"),
        (
            "[{effect: stribeck_friction, torque: 1, breakaway: 0.5, velocity: 1}]",
            "[]",
            "breakaway",
        ),
        ("[{effect: encoder_error, amplitude: 0.2, periods: 16}]", "[]", "1/periods"),
        ("[]", "[{effect: coupling_spring, axes: [table, leg], spring: 5}]", "table - leg"),
        ("[]", "[{effect: backlash, play: 5}]", "coupling_spring"),
    ],
)
def test_an_effect_that_can_not_be_is_refused_with_its_line(
    axis: str, between: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "machine.yaml"
    path.write_text(profile_text(axis, between))
    with pytest.raises(ProfileError, match=message) as caught:
        load_machine(path)
    assert caught.value.line is not None
