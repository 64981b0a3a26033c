"""The plant against closed forms, eigenvalues, dense integration and the laws of conservation."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

from drives.sim.effects import ViscousFriction
from drives.sim.firmware import DriveHardware, SimulatedAxes
from drives.sim.plant import ChainParameters, Plant, PlantParameters
from tests.seeds import fresh_seed

PAPER_RESONANCES = [0, 0, 0, 24.62754, 29.58887, 34.16101, 44.92407, 48.60318, 51.28013]  # rad/s
PAPER_ANTIRESONANCES = {
    0: [13.10835, 25.28564, 29.75239, 43.61557, 46.88464, 49.33182],
    1: [14.93345, 27.05104, 34.14905, 43.13342, 47.94412, 51.27408],
    2: [15.63310, 27.55255, 33.54820, 43.38318, 48.11809, 51.16962],
}


def paper_machine(damping: float = 0.0) -> PlantParameters:
    masses = ((0.7, 2.0, 3.0), (4.0, 5.0, 6.0), (7.0, 8.0, 9.0))
    springs = ((1000.0, 2000.0), (3000.0, 4000.0), (5000.0, 6000.0))
    chains = tuple(
        ChainParameters(m, k, (damping * k[0], damping * k[1]))
        for m, k in zip(masses, springs, strict=True)
    )
    return PlantParameters(chains, ((0, 1, 1.0), (0, 2, 2.0), (1, 2, 3.0)))


@st.composite
def machines(draw: st.DrawFn) -> PlantParameters:
    """Chains of differing lengths with couplings weak enough to stay positive definite."""
    mass = st.floats(0.1, 10.0)
    chains = []
    for length in draw(st.lists(st.integers(1, 5), min_size=1, max_size=3)):
        links = length - 1
        chains.append(
            ChainParameters(
                tuple(draw(st.lists(mass, min_size=length, max_size=length))),
                tuple(draw(st.lists(st.floats(10.0, 1e5), min_size=links, max_size=links))),
                tuple(draw(st.lists(st.floats(0.0, 10.0), min_size=links, max_size=links))),
                draw(st.floats(0.0, 5.0)),
            )
        )
    last = [chain.masses[-1] for chain in chains]
    couplings = tuple(
        (a, b, draw(st.floats(-0.4, 0.4)) * (last[a] * last[b]) ** 0.5)
        for a in range(len(chains))
        for b in range(a + 1, len(chains))
    )
    return PlantParameters(tuple(chains), couplings)


def matrices_by_energy(parameters: PlantParameters) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M, C, K as Hessians of kinetic energy, dissipation and elastic energy: another route."""
    lengths = [len(c.masses) for c in parameters.chains]
    offset = np.cumsum([0, *lengths])

    def kinetic(v: np.ndarray) -> float:
        own = sum(
            0.5 * m * v[offset[i] + k] ** 2
            for i, c in enumerate(parameters.chains)
            for k, m in enumerate(c.masses)
        )
        return float(
            own
            + sum(
                m * v[offset[a + 1] - 1] * v[offset[b + 1] - 1] for a, b, m in parameters.couplings
            )
        )

    def between(values: str, x: np.ndarray) -> float:
        terms = (
            0.5 * e * (x[offset[i] + k] - x[offset[i] + k + 1]) ** 2
            for i, c in enumerate(parameters.chains)
            for k, e in enumerate(getattr(c, values))
        )
        return float(sum(terms))

    def lost(v: np.ndarray) -> float:
        ground = sum(
            0.5 * c.viscous_friction * v[offset[i]] ** 2 for i, c in enumerate(parameters.chains)
        )
        return float(between("dampers", v) + ground)

    def hessian(form: Callable[[np.ndarray], float]) -> np.ndarray:
        n = sum(lengths)
        e = np.eye(n)
        return np.array(
            [[form(e[i] + e[j]) - form(e[i]) - form(e[j]) for j in range(n)] for i in range(n)]
        )

    return hessian(kinetic), hessian(lost), hessian(lambda x: between("springs", x))


def test_matrices_of_the_paper_machine() -> None:
    plant = Plant(paper_machine())
    assert plant.mass_matrix[np.ix_([2, 5, 8], [2, 5, 8])].tolist() == [
        [3, 1, 2],
        [1, 6, 3],
        [2, 3, 9],
    ]
    assert plant.motors.tolist() == [0, 3, 6]
    assert plant.stiffness_matrix[:3, :3].tolist() == [
        [1000, -1000, 0],
        [-1000, 3000, -2000],
        [0, -2000, 2000],
    ]


@given(machines())
@settings(max_examples=40, deadline=None)
def test_matrices_agree_with_the_energies(parameters: PlantParameters) -> None:
    plant = Plant(parameters)
    M, C, K = matrices_by_energy(parameters)
    assert np.allclose(plant.mass_matrix, M, rtol=1e-12, atol=1e-12)
    assert np.allclose(plant.damping_matrix, C, rtol=1e-12, atol=1e-12)
    assert np.allclose(plant.stiffness_matrix, K, rtol=1e-12, atol=1e-9)


def test_resonances_and_antiresonances_of_the_paper() -> None:
    plant = Plant(paper_machine())
    assert np.allclose(plant.eigenfrequencies, PAPER_RESONANCES, atol=6e-6)
    for axis, printed in PAPER_ANTIRESONANCES.items():
        w = np.array(printed)
        below = plant.response(w - 2e-5)[:, axis, axis].real
        above = plant.response(w + 2e-5)[:, axis, axis].real
        assert np.all(below * above < 0.0), f"axis {axis}: no zero crossing at {w}"


@given(machines())
@settings(max_examples=40, deadline=None)
def test_eigenfrequencies_are_those_of_the_pencil(parameters: PlantParameters) -> None:
    plant = Plant(parameters)
    M, _, K = matrices_by_energy(parameters)
    squares = eigh(K, M, eigvals_only=True)
    free = len(parameters.chains)
    assert np.all(plant.eigenfrequencies[:free] == 0.0)
    assert np.allclose(plant.eigenfrequencies[free:], np.sqrt(squares[free:]), rtol=1e-8)


@pytest.mark.parametrize("friction", [0.0, 3.0])
def test_response_of_two_masses_in_closed_form(friction: float) -> None:
    m1, m2, k, c = 0.7, 2.3, 4000.0, 1.5
    plant = Plant(PlantParameters((ChainParameters((m1, m2), (k,), (c,), friction),)))
    w = np.geomspace(0.1, 1e4, 400)
    s = 1j * w
    link = c * s + k
    expected = (m2 * s**2 + link) / (
        (m1 * s**2 + friction * s + link) * (m2 * s**2 + link) - link**2
    )
    got = plant.response(w)
    assert got.shape == (400, 1, 1)
    assert np.max(np.abs(got[:, 0, 0] / expected - 1)) < 1e-9


@given(machines())
@settings(max_examples=30, deadline=None)
def test_response_is_symmetric_and_ends_in_the_motor_masses(parameters: PlantParameters) -> None:
    plant = Plant(parameters)
    G = plant.response([3.0, 1e6])
    assert np.allclose(G, np.swapaxes(G, 1, 2), rtol=1e-6, atol=1e-18)
    inverse = np.linalg.inv(plant.mass_matrix)[np.ix_(plant.motors, plant.motors)]
    assert np.allclose(G[1] * -(1e12), inverse, rtol=1e-3, atol=1e-3 * abs(inverse).max())


def test_response_at_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="above 0 rad/s"):
        Plant(paper_machine()).response([0.0, 1.0])


@given(machines(), st.floats(1e-5, 0.05), st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_step_is_exact_for_held_forces(parameters: PlantParameters, step: float, seed: int) -> None:
    plant = Plant(parameters)
    M, C, K = matrices_by_energy(parameters)
    n = plant.size
    random = np.random.default_rng(seed)
    state, force = random.standard_normal(2 * n), 100.0 * random.standard_normal(n)
    inverse = np.linalg.inv(M)

    def rates(_: float, x: np.ndarray) -> np.ndarray:
        return np.concatenate([x[n:], inverse @ (force - C @ x[n:] - K @ x[:n])])

    dense = solve_ivp(rates, (0.0, step), state, method="DOP853", rtol=1e-12, atol=1e-13)
    A, B = plant.discretise(step)
    assert A.shape == (2 * n, 2 * n)
    assert B.shape == (2 * n, n)
    got, expected = A @ state + B @ force, dense.y[:, -1]
    assert np.allclose(got, expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max())


@given(machines(), st.floats(1e-5, 0.01))
@settings(max_examples=20, deadline=None)
def test_two_half_steps_are_one_step(parameters: PlantParameters, step: float) -> None:
    plant = Plant(parameters)
    half_a, half_b = plant.discretise(step / 2)
    A, B = plant.discretise(step)
    assert np.allclose(half_a @ half_a, A, rtol=1e-9, atol=1e-9 * np.abs(A).max())
    assert np.allclose(half_a @ half_b + half_b, B, rtol=1e-9, atol=1e-9 * np.abs(B).max())


def test_rigid_axis_in_closed_form() -> None:
    step, m, d = 0.02, 2.0, 3.0
    A, B = Plant(PlantParameters((ChainParameters((m,), (), ()),))).discretise(step)
    assert np.allclose(A, np.array([[1, step], [0, 1]]), rtol=1e-15)
    assert np.allclose(B, np.array([[step**2 / (2 * m)], [step / m]]), rtol=1e-14)
    A, B = Plant(PlantParameters((ChainParameters((m,), (), (), d),))).discretise(step)
    decay = np.exp(-d / m * step)
    assert np.allclose(A, np.array([[1, m / d * (1 - decay)], [0, decay]]), rtol=1e-13)
    assert np.allclose(B[1], (1 - decay) / d, rtol=1e-12)


@pytest.mark.parametrize("step", [0.0, -1e-3, float("nan"), float("inf")])
def test_step_that_is_none_is_refused(step: float) -> None:
    with pytest.raises(ValueError, match="finite and above 0"):
        Plant(paper_machine()).discretise(step)


# -- conservation over many steps, through the compiled loop ------------------------------------------


def free_machine(parameters: PlantParameters) -> SimulatedAxes:
    drive = DriveHardware(rated_torque=1.0, torque_noise=0.0, counts_per_unit=1e3)
    return SimulatedAxes(parameters, [drive] * len(parameters.chains), seed=0)


def chain_momenta(plant: Plant, state: np.ndarray) -> np.ndarray:
    momenta = plant.mass_matrix @ state[plant.size :]
    return np.add.reduceat(momenta, plant.motors)


@pytest.mark.parametrize(
    ("far_away", "tolerance"),
    [(0.0, 2e-8), (1e3, 1e-7)],  # rad; N m s: positions far away are rounded more coarsely
)
def test_energy_and_momentum_are_kept(far_away: float, tolerance: float) -> None:
    seed = fresh_seed()
    axes = free_machine(paper_machine())
    plant = axes.plant
    state = np.random.default_rng(seed).standard_normal(2 * plant.size)
    state[: plant.size] += far_away
    axes.set_state(state)
    energy, momenta = plant.energy(state), chain_momenta(plant, state)
    for _ in range(20):
        axes.advance(10_000)
        assert abs(plant.energy(axes.state) / energy - 1.0) < 1e-9
        assert np.all(np.abs(chain_momenta(plant, axes.state) - momenta) < tolerance)


@given(machines())
@settings(max_examples=10, deadline=None)
def test_energy_of_undamped_random_machines_is_kept(parameters: PlantParameters) -> None:
    chains = tuple(
        ChainParameters(c.masses, c.springs, (0.0,) * len(c.springs)) for c in parameters.chains
    )
    axes = free_machine(PlantParameters(chains, parameters.couplings))
    state = np.linspace(-1.0, 1.0, 2 * axes.plant.size)
    state[-1] = 2.0
    axes.set_state(state)
    axes.advance(100_000)
    assert abs(axes.plant.energy(axes.state) / axes.plant.energy(state) - 1.0) < 1e-9


def test_damped_machine_loses_energy_and_ends_turning_as_one() -> None:
    axes = free_machine(paper_machine(damping=5e-3))
    state = np.random.default_rng(4).standard_normal(18)
    axes.set_state(state)
    momenta = chain_momenta(axes.plant, state)
    energies = [axes.plant.energy(state)]
    for _ in range(40):
        axes.advance(2000)
        energies.append(axes.plant.energy(axes.state))
    # Less than 1e-12 of the energy may come back by rounding once nothing is left to damp.
    assert np.all(np.diff(energies) < 1e-12 * energies[0])
    velocities = axes.state[9:].reshape(3, 3)
    assert np.allclose(velocities, velocities[:, :1], atol=1e-6)
    assert np.allclose(chain_momenta(axes.plant, axes.state), momenta, atol=1e-9)


# -- what is refused ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("masses", "springs", "dampers", "friction", "message"),
    [
        ((), (), (), 0.0, "at least one mass"),
        ((1.0, 1.0), (), (), 0.0, "2 masses has 1 springs, got 0"),
        ((1.0, 1.0), (1.0,), (), 0.0, "2 masses has 1 dampers, got 0"),
        ((1.0, 0.0), (1.0,), (0.0,), 0.0, r"masses\[1\] is 0.0 kg"),
        ((1.0, float("nan")), (1.0,), (0.0,), 0.0, r"masses\[1\]"),
        ((1.0, 1.0), (-1.0,), (0.0,), 0.0, r"springs\[0\] is -1.0 N/m"),
        ((1.0, 1.0), (float("inf"),), (0.0,), 0.0, r"springs\[0\]"),
        ((1.0, 1.0), (1.0,), (-0.1,), 0.0, r"dampers\[0\] is -0.1"),
        ((1.0,), (), (), -1.0, r"viscous_friction\[0\] is -1.0"),
    ],
)
def test_chains_that_can_not_be(
    masses: tuple[float, ...],
    springs: tuple[float, ...],
    dampers: tuple[float, ...],
    friction: float,
    message: str,
) -> None:
    with pytest.raises(ValueError, match=message):
        ChainParameters(masses, springs, dampers, friction)


@pytest.mark.parametrize(
    ("couplings", "message"),
    [
        (((0, 0, 0.1),), "does not join two of the 3 chains"),
        (((0, 3, 0.1),), "does not join"),
        (((-1, 0, 0.1),), "does not join"),
        (((0, 1, 0.1), (1, 0, 0.1)), "given twice"),
        (((0, 1, 1.0),), "below 1, the geometric mean"),
        (((0, 1, float("nan")),), "positive definite"),
        (((0, 1, -0.9), (0, 2, -0.9), (1, 2, -0.9)), "indefinite"),
    ],
)
def test_couplings_that_can_not_be(
    couplings: tuple[tuple[int, int, float], ...], message: str
) -> None:
    rigid = ChainParameters((1.0,), (), ())
    with pytest.raises(ValueError, match=message):
        PlantParameters((rigid, rigid, rigid), couplings)


def test_machine_without_chains_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one chain"):
        PlantParameters(())


@pytest.mark.parametrize(("mass", "coefficient"), [(-1, 1.0), (0, -1.0), (0, float("nan"))])
def test_friction_that_can_not_be(mass: int, coefficient: float) -> None:
    with pytest.raises(ValueError, match="viscous friction"):
        ViscousFriction(mass, coefficient)
