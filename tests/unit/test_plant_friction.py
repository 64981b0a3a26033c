"""Dry friction: it holds, it breaks away, it brakes, it never pushes; against other integrators."""

from dataclasses import replace
from importlib.resources import files
from itertools import pairwise
from math import pi
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from drives.errors import ProfileError
from drives.profile import load_machine
from drives.sim import stick_slip
from drives.sim.effects import CoulombFriction, Location
from drives.sim.firmware import DriveHardware, Parameter, SimulatedAxes
from drives.sim.machine import simulated_machine
from drives.sim.plant import ChainParameters, Plant, PlantParameters

H = 1.0 / 8000.0
DRIVE = DriveHardware(
    rated_torque=10.0, torque_noise=0.0, counts_per_unit=2**20 / (2 * pi), peak_torque=300.0
)


def rigid(inertia: float, torque: float, location: Location = "motor") -> ChainParameters:
    return ChainParameters((inertia,), (), (), effects=(CoulombFriction(torque, location),))


def axes_of(*chains: ChainParameters, couplings: tuple = ()) -> SimulatedAxes:
    return SimulatedAxes(PlantParameters(chains, couplings), [DRIVE] * len(chains), seed=0)


def without_friction(parameters: PlantParameters) -> PlantParameters:
    return replace(
        parameters, chains=tuple(replace(chain, effects=()) for chain in parameters.chains)
    )


def trace(axes: SimulatedAxes, steps: int) -> np.ndarray:
    """States before the first and after each inner step, shape (steps + 1, 2n)."""
    states = [axes.state]
    for _ in range(steps):
        axes.advance(1)
        states.append(axes.state)
    return np.array(states)


def random_machine(
    rng: np.random.Generator, *, damped: bool = True, motor: bool = True, load: bool = True
) -> PlantParameters:
    """One to three coupled chains of one to three masses with friction of 0.2 to 2 N m."""
    chains = []
    for length in rng.integers(1, 4, rng.integers(1, 4)):
        effects = [
            CoulombFriction(float(rng.uniform(0.2, 2.0)), location)
            for location, wanted in (("motor", motor), ("load", load))
            if wanted
        ]
        chains.append(
            ChainParameters(
                tuple(rng.uniform(0.2, 3.0, length)),
                tuple(rng.uniform(100.0, 5000.0, length - 1)),
                tuple(rng.uniform(0.0, 1.0, length - 1) * damped),
                float(rng.uniform(0.0, 0.3)) * damped,
                tuple(effects),
            )
        )
    count = len(chains)
    couplings = tuple(
        (a, b, float(rng.uniform(-0.4, 0.4) * (chains[a].masses[-1] * chains[b].masses[-1]) ** 0.5))
        for a in range(count)
        for b in range(a + 1, count)
    )
    return PlantParameters(tuple(chains), couplings)


def friction_of(parameters: PlantParameters) -> np.ndarray:
    """Friction on each mass, shape (n,), counted anew."""
    torques: list[float] = []
    for chain in parameters.chains:
        own = [0.0] * len(chain.masses)
        for effect in chain.effects:
            own[0 if effect.location == "motor" else -1] += effect.torque
        torques += own
    return np.array(torques)


# -- standing -----------------------------------------------------------------------------------------


def test_a_push_below_breakaway_moves_nothing_at_all_for_seconds() -> None:
    axes = axes_of(rigid(0.02, 0.5))
    start = np.array([0.1234567, 0.0])
    axes.set_state(start)
    for torque in (0.499999, -0.499999):
        axes.follow_torque(0, torque)
        axes.advance(5 * 8000)
        assert np.array_equal(axes.state, start)
    axes.follow_torque(0, 0.500001)
    axes.advance(8000)
    assert axes.state[0] > start[0]
    assert axes.state[1] == pytest.approx(1e-6 / 0.02, rel=0.01)


def test_a_mass_that_stands_does_not_creep_while_the_load_swings() -> None:
    chain = ChainParameters((0.02, 0.05), (300.0,), (0.0,), effects=(CoulombFriction(2.0),))
    axes = axes_of(chain)
    axes.set_state(np.array([0.3, 0.3 + 1.99 / 300.0, 0.0, 0.0]))
    states = trace(axes, 8000)
    assert np.all(states[:, 0] == 0.3)
    assert np.all(states[:, 2] == 0.0)
    time = H * np.arange(states.shape[0])
    swing = 0.3 + 1.99 / 300.0 * np.cos((300.0 / 0.05) ** 0.5 * time)
    np.testing.assert_allclose(states[:, 1], swing, atol=1e-10)


def test_a_load_wound_up_beyond_friction_breaks_the_motor_away() -> None:
    chain = ChainParameters((0.02, 0.05), (300.0,), (0.0,), effects=(CoulombFriction(2.0),))
    axes = axes_of(chain)
    axes.set_state(np.array([0.3, 0.3 + 2.01 / 300.0, 0.0, 0.0]))
    assert np.any(trace(axes, 80)[:, 0] != 0.3)


# -- one mass by hand ---------------------------------------------------------------------------------


@pytest.mark.parametrize("location", ["motor", "load"])
def test_coasting_brakes_at_friction_over_inertia(
    location: Location, fresh_rng: np.random.Generator
) -> None:
    for _ in range(6):
        inertia, torque = fresh_rng.uniform(0.01, 1.0), fresh_rng.uniform(0.1, 3.0)
        deceleration = torque / inertia
        speed = deceleration * fresh_rng.uniform(0.05, 0.25) * fresh_rng.choice([-1.0, 1.0])
        axes = axes_of(rigid(inertia, torque, location))
        axes.set_state(np.array([1.0, speed]))
        states = trace(axes, 2400)
        time = H * np.arange(states.shape[0])
        left = np.maximum(abs(speed) - deceleration * time, 0.0)
        np.testing.assert_allclose(states[:, 1], np.sign(speed) * left, atol=1e-9 * abs(speed))
        distance = np.sign(speed) * (speed**2 - left**2) / (2 * deceleration)
        np.testing.assert_allclose(states[:, 0], 1.0 + distance, atol=1e-4 * deceleration * H**2)
        assert states[-1, 1] == 0.0


def test_a_constant_push_accelerates_by_what_friction_leaves() -> None:
    axes = axes_of(rigid(0.5, 2.0))
    axes.follow_torque(0, 5.0)
    axes.advance(400)
    before = axes.state[1]
    axes.advance(4000)
    assert axes.state[1] - before == pytest.approx((5.0 - 2.0) / 0.5 * 0.5, rel=1e-9)


def test_the_fundamental_of_friction_under_a_sine_is_4_over_pi_of_it() -> None:
    inertia, torque, frequency = 0.02, 2.0, 5.0
    axes = axes_of(rigid(inertia, torque))
    for parameter, value in (
        (Parameter.POSITION_P, 60.0),
        (Parameter.VELOCITY_P, 6.0),
        (Parameter.VELOCITY_FF, 1.0),
        (Parameter.INERTIA_FF, inertia),
    ):
        axes.set(0, parameter, value)
    cycles, omega = 1600, 2 * pi * frequency
    positions, torques = np.empty(2 * cycles), np.empty(2 * cycles)
    for k in range(2 * cycles):
        axes.follow_position(0, np.sin(omega * (k + 1) * H), 1)
        axes.advance(1)
        positions[k], torques[k] = axes.state[0], axes.torque(0)
    wave = np.exp(-1j * omega * H * np.arange(cycles)) * 2 / cycles
    position, drive = wave @ positions[cycles:], wave @ torques[cycles:]
    friction = drive + omega**2 * inertia * position
    velocity = 1j * omega * position
    in_phase = friction / (velocity / abs(velocity))
    assert in_phase.real == pytest.approx(4 * torque / pi, rel=0.005)
    assert abs(in_phase.imag) < 0.015 * torque


# -- chains against other integrators -----------------------------------------------------------------


def by_events(chain: ChainParameters, push: float, state: np.ndarray, end: float) -> np.ndarray:
    """State of one chain under a constant motor torque: LSODA between events that it finds."""
    m, k, c = (np.array(v) for v in (chain.masses, chain.springs, chain.dampers))
    n, friction = m.size, friction_of(PlantParameters((chain,)))

    def pushed(x: np.ndarray) -> np.ndarray:
        spring = k * np.diff(x[:n]) + c * np.diff(x[n:])
        force = np.append(spring, 0.0) - np.insert(spring, 0, 0.0)
        force[0] += push - chain.viscous_friction * x[n]
        return force

    x, time = state.copy(), 0.0
    slide = np.where(friction > 0, np.sign(x[n:]), 0.0)
    while time < end:
        force = pushed(x)
        standing = (friction > 0) & (slide == 0)
        slide[standing] = np.where(np.abs(force) > friction, np.sign(force), 0.0)[standing]
        x[n:] += 1e-9 * slide * standing  # else it may be seen to stop at once, by rounding
        standing = (friction > 0) & (slide == 0)
        events = []
        for i in np.flatnonzero(friction > 0):
            if standing[i]:
                events.append(lambda t, y, i=i: friction[i] - abs(pushed(y)[i]))
            else:
                events.append(lambda t, y, i=i: y[n + i] * slide[i])
            events[-1].terminal, events[-1].direction = True, -1

        def rates(t: float, y: np.ndarray, standing: np.ndarray = standing) -> np.ndarray:
            acceleration = np.where(standing, 0.0, (pushed(y) - friction * slide) / m)
            return np.concatenate([y[n:], acceleration])

        solved = solve_ivp(
            rates, (time, end), x, "DOP853", events=events, rtol=1e-9, atol=1e-11, max_step=5e-3
        )
        time, x = solved.t[-1], solved.y[:, -1]
        if solved.status == 1:
            for i, times in zip(np.flatnonzero(friction > 0), solved.t_events, strict=True):
                if times.size and not standing[i]:
                    slide[i], x[n + i] = 0.0, 0.0
                elif times.size:
                    slide[i] = np.sign(pushed(x)[i])
                    x[n + i] = 1e-9 * slide[i]
    return x


@pytest.mark.parametrize("where", [("motor",), ("load",), ("motor", "load")])
@pytest.mark.parametrize("length", [2, 3])
def test_a_chain_goes_as_an_integrator_with_events_says(
    where: tuple[Location, ...], length: int, fresh_rng: np.random.Generator
) -> None:
    rng = fresh_rng
    links = length - 1
    chain = ChainParameters(
        tuple(rng.uniform(0.3, 2.0, length)),
        tuple(rng.uniform(200.0, 2000.0, links)),
        tuple(rng.uniform(1.0, 4.0, links)),
        0.1,
        tuple(CoulombFriction(float(rng.uniform(1.0, 8.0)), location) for location in where),
    )
    state = np.concatenate([rng.uniform(-0.02, 0.02, length), rng.uniform(-1.0, 1.0, length)])
    axes = axes_of(chain)
    axes.set_state(state)
    for end in (0.2, 0.6):
        axes.advance(round(8000 * end) - round(8000 * axes.time))
        expected = by_events(chain, 0.0, state, end)
        np.testing.assert_allclose(axes.state[:length], expected[:length], atol=5e-6)
        np.testing.assert_allclose(axes.state[length:], expected[length:], atol=2e-5)


def by_small_steps(
    parameters: PlantParameters, state: np.ndarray, end: float, step: float
) -> np.ndarray:
    """Moreau's time stepping: implicit in the friction's impulses, first order."""
    plant = Plant(without_friction(parameters))
    n, friction = plant.size, friction_of(parameters)
    mass, held = plant.mass_matrix, np.flatnonzero(friction)
    # implicit midpoint for springs and dampers
    left = mass + 0.5 * step * plant.damping_matrix + 0.25 * step**2 * plant.stiffness_matrix
    inverse = np.linalg.inv(left)
    mobility = inverse[np.ix_(held, held)]
    largest = step * friction[held]
    q, v, impulse = state[:n].copy(), state[n:].copy(), np.zeros(held.size)
    for _ in range(round(end / step)):
        force = plant.stiffness_matrix @ (q + 0.25 * step * v) + 0.5 * plant.damping_matrix @ v
        free = inverse @ (mass @ v - step * force)
        for _ in range(50):
            before = impulse.copy()
            for i in range(held.size):
                slip = free[held[i]] + mobility[i] @ impulse
                wanted = impulse[i] - slip / mobility[i, i]
                impulse[i] = min(max(wanted, -largest[i]), largest[i])
            if np.max(np.abs(impulse - before)) <= 1e-9 * largest.max():
                break
        new = free + inverse[:, held] @ impulse
        q, v = q + 0.5 * step * (v + new), new
    return np.concatenate([q, v])


def test_coupled_machines_go_as_small_steps_say(fresh_rng: np.random.Generator) -> None:
    parameters = random_machine(fresh_rng)
    size = Plant(parameters).size
    state = np.concatenate([np.zeros(size), fresh_rng.uniform(-1.0, 1.0, size)])
    axes = SimulatedAxes(parameters, [DRIVE] * len(parameters.chains), seed=0)
    axes.set_state(state)
    axes.advance(2400)
    expected = by_small_steps(parameters, state, 0.3, 5e-5)
    np.testing.assert_allclose(axes.state[:size], expected[:size], atol=1e-4)
    np.testing.assert_allclose(axes.state[size:], expected[size:], atol=3e-3)


def test_friction_that_is_nearly_nothing_changes_nearly_nothing(
    fresh_rng: np.random.Generator,
) -> None:
    parameters = random_machine(fresh_rng)
    tiny = tuple(
        replace(chain, effects=tuple(replace(e, torque=1e-9) for e in chain.effects))
        for chain in parameters.chains
    )
    machines = (without_friction(parameters), replace(parameters, chains=tiny))
    size, drives = Plant(parameters).size, [DRIVE] * len(parameters.chains)
    plain, rubbing = (SimulatedAxes(machine, drives, seed=0) for machine in machines)
    state = np.concatenate([np.zeros(size), fresh_rng.uniform(-1.0, 1.0, size)])
    for axes in (plain, rubbing):
        axes.set_state(state)
        axes.advance(2000)
    np.testing.assert_allclose(rubbing.state, plain.state, atol=1e-7)


def test_without_friction_nothing_is_changed_in_any_bit(fresh_rng: np.random.Generator) -> None:
    parameters = random_machine(fresh_rng)
    none = tuple(
        replace(chain, effects=(CoulombFriction(0.0), CoulombFriction(0.0, "load")))
        for chain in parameters.chains
    )
    machines = (without_friction(parameters), replace(parameters, chains=none))
    states = []
    for machine in machines:
        axes = SimulatedAxes(machine, [DRIVE] * len(machine.chains), seed=0)
        axes.follow_torque(0, 3.0)
        axes.advance(800)
        states.append(axes.state)
    assert np.array_equal(*states)


# -- laws -----------------------------------------------------------------------------------------------


def test_energy_never_grows_and_what_is_lost_is_friction_times_path(
    fresh_rng: np.random.Generator,
) -> None:
    for _ in range(5):
        parameters = random_machine(fresh_rng, damped=False)
        axes = SimulatedAxes(parameters, [DRIVE] * len(parameters.chains), seed=0)
        plant = axes.plant
        axes.set_state(
            np.concatenate([np.zeros(plant.size), fresh_rng.uniform(-2.0, 2.0, plant.size)])
        )
        states = trace(axes, 1600)
        energies = np.array([plant.energy(state) for state in states])
        assert np.all(np.diff(energies) <= 1e-11 * energies[0])
        path = np.abs(np.diff(states[:, : plant.size], axis=0)).sum(axis=0)
        lost = friction_of(parameters) @ path
        assert energies[0] - energies[-1] == pytest.approx(lost, rel=1e-3, abs=1e-4 * energies[0])


def test_coupled_axes_come_to_rest_together_and_stay(fresh_rng: np.random.Generator) -> None:
    for _ in range(3):
        coupling = float(fresh_rng.uniform(0.1, 0.25))
        axes = axes_of(
            *(rigid(float(fresh_rng.uniform(0.5, 1.0)), 2.0, "load") for _ in range(3)),
            couplings=((0, 1, coupling), (0, 2, -coupling), (1, 2, coupling)),
        )
        axes.set_state(np.concatenate([np.zeros(3), fresh_rng.uniform(-1.0, 1.0, 3)]))
        axes.advance(16000)
        rest = axes.state
        assert np.array_equal(rest[3:], np.zeros(3))
        for axis, push in enumerate(fresh_rng.uniform(-1.99, 1.99, 3)):
            axes.follow_torque(axis, push)
        axes.advance(8000)
        assert np.array_equal(axes.state, rest)


def test_coupled_rigid_axes_obey_the_law_of_friction(fresh_rng: np.random.Generator) -> None:
    """What is missing in tau = M a is friction: within limits at rest, against motion else."""
    seen_standing = seen_freed = 0
    for _ in range(20):
        limits = fresh_rng.uniform(0.5, 2.0, 3)
        inertias = fresh_rng.uniform(0.5, 1.0, 3)
        a, b, c = fresh_rng.uniform(-0.22, 0.22, 3)
        axes = axes_of(
            *(rigid(float(m), float(f)) for m, f in zip(inertias, limits, strict=True)),
            couplings=((0, 1, a), (0, 2, b), (1, 2, c)),
        )
        push = limits * fresh_rng.uniform(-1.2, 1.2, 3)
        push[0] *= 15.0
        for axis in range(3):
            axes.follow_torque(axis, push[axis])
        axes.advance(400)
        states = trace(axes, 3)
        mass = np.diag(inertias)
        for i, j, value in ((0, 1, a), (0, 2, b), (1, 2, c)):
            mass[i, j] = mass[j, i] = value
        for before, after in pairwise(states[:, 3:]):
            friction = mass @ (after - before) / H - push
            slides = (before != 0.0) | (after != 0.0)
            np.testing.assert_allclose(
                friction[slides], -(limits * np.sign(after))[slides], atol=1e-7
            )
            assert np.all(np.abs(friction) <= limits + 1e-7)
        pushed = np.abs(push) > limits
        seen_standing += int(np.sum(~slides))
        seen_freed += int(np.sum(slides & ~pushed))
    assert seen_standing > 0
    assert seen_freed > 0, "no mass was dragged along by its neighbours; the case is not tested"


def test_a_stop_leaves_the_momentum_of_coupled_masses_alone(
    fresh_rng: np.random.Generator,
) -> None:
    """Axis 1 has no friction and no push, so row 1 of M q' stays through every stop of axis 0."""
    for _ in range(5):
        first, second = fresh_rng.uniform(0.5, 1.0, 2)
        coupling = float(fresh_rng.uniform(0.2, 0.4))
        free = ChainParameters((float(second),), (), ())
        axes = axes_of(rigid(float(first), 2.0), free, couplings=((0, 1, coupling),))
        velocities = fresh_rng.uniform(0.1, 0.5, 2)
        axes.set_state(np.array([0.0, 0.0, *velocities]))
        axes.advance(4000)
        after = axes.state[2:]
        assert after[0] == 0.0
        momentum = coupling * velocities[0] + second * velocities[1]
        assert second * after[1] == pytest.approx(momentum, rel=1e-11)


# -- how it is stepped ----------------------------------------------------------------------------------


def controlled(parameters: PlantParameters) -> SimulatedAxes:
    axes = SimulatedAxes(parameters, [DRIVE] * len(parameters.chains), seed=0)
    for axis in range(axes.axes):
        axes.set(axis, Parameter.POSITION_P, 3.0)
        axes.set(axis, Parameter.VELOCITY_P, 20.0)
        axes.set(axis, Parameter.VELOCITY_I, 40.0)
    return axes


def follow_waves(axes: SimulatedAxes, cycles: int, parts: tuple[int, ...]) -> np.ndarray:
    for cycle in range(cycles):
        for axis in range(axes.axes):
            axes.follow_position(axis, 0.02 * np.sin(0.01 * (axis + 1) * cycle), sum(parts))
        for steps in parts:
            axes.advance(steps)
    return axes.state


def test_parts_of_a_call_make_no_difference(fresh_rng: np.random.Generator) -> None:
    parameters = random_machine(fresh_rng)
    once = follow_waves(controlled(parameters), 500, (8,))
    assert np.array_equal(once, follow_waves(controlled(parameters), 500, (1, 0, 2, 5)))


def test_tables_that_are_made_anew_make_no_difference(
    fresh_rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    parameters = random_machine(fresh_rng)
    kept = follow_waves(controlled(parameters), 100, (8,))
    monkeypatch.setattr(stick_slip, "_LARGEST_TABLES", 0)
    assert np.array_equal(kept, follow_waves(controlled(parameters), 100, (8,)))


# -- where it is said -----------------------------------------------------------------------------------


def test_friction_is_refused_where_it_is_no_friction() -> None:
    for torque in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="finite and at least 0"):
            CoulombFriction(torque)
    with pytest.raises(ValueError, match="must be motor"):
        CoulombFriction(1.0, "middle")  # type: ignore[arg-type]


def test_frictions_at_one_mass_add_up() -> None:
    chain = ChainParameters(
        (1.0,), (), (), effects=(CoulombFriction(0.5), CoulombFriction(0.25, "load"))
    )
    assert np.array_equal(Plant(PlantParameters((chain,))).breakaway, [0.75])


def profile_with(folder: Path, *lines: str) -> tuple[Path, int]:
    """The packaged machine with these lines in its first simulated axis; number of the first."""
    text = files("profiles").joinpath("machines", "turntable-arm.yaml").read_text("utf-8")
    kept = text.splitlines()
    here = kept.index("    - masses: [0.02, 0.03]") + 1
    path = folder / "machine.yaml"
    path.write_text("\n".join([*kept[:here], *("      " + line for line in lines), *kept[here:]]))
    return path, here + 1


def test_a_profile_gives_its_chains_friction(tmp_path: Path) -> None:
    path, _ = profile_with(
        tmp_path,
        "effects:",
        "  - effect: coulomb_friction",
        "    torque: 0.5",
        "  - {effect: coulomb_friction, location: load, torque: 0.25}",
    )
    first, second = (drive.chain for drive in simulated_machine(load_machine(path)).drives)
    assert first.effects == (CoulombFriction(0.5), CoulombFriction(0.25, "load"))
    assert second.effects == ()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("effect: coulomb_friktion", "coulomb_friction"),
        ("efect: coulomb_friction", "effect"),
        ("torq: 0.5", r"axis .*, effects, number 1, torq is not a known key"),
        ("location: middle", r"effects, number 1, location.*motor or load"),
        ("torque: -0.5", r"effects, number 1, torque.*at least 0"),
        ("torque: .nan", r"effects, number 1, torque.*finite"),
        ("torque: 0.5 N m", r"effects, number 1, torque.*number"),
    ],
)
def test_a_wrong_effect_is_refused_with_file_and_line(
    tmp_path: Path, wrong: str, message: str
) -> None:
    right = {"effect": "effect: coulomb_friction", "torque": "torque: 0.5"}
    key = wrong.split(":", maxsplit=1)[0]
    right |= {"effect" if key == "efect" else "torque" if key == "torq" else key: wrong}
    lines = list(right.values())
    path, line = profile_with(
        tmp_path, "effects:", "  - " + lines[0], *("    " + s for s in lines[1:])
    )
    with pytest.raises(ProfileError, match=message) as caught:
        load_machine(path)
    assert caught.value.path == path
    assert caught.value.line == line + 1 + lines.index(wrong)
    print(caught.value)
