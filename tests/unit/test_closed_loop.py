"""A model under its loops, four ways: phasors, time steps, a state space of scipy's, eigenvalues.

The state space here is put together from the equations in the docstring of ``closed_loop``, with
references and their first two derivatives as inputs, and shares no code with it.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from scipy.linalg import block_diag, expm, matrix_balance

from fieldtool.records.closed_loop import AxisLoop, Biquad, ClosedLoop, loop_from_parameters
from fieldtool.records.model import AxisModel, Estimate, MachineModel

RandomModel = Callable[..., MachineModel]
TWO_PI = 2 * np.pi


def loop_for(total: float, rng: np.random.Generator, filters: tuple[Biquad, ...] = ()) -> AxisLoop:
    w = TWO_PI * rng.uniform(0.5, 1.2)
    feed, inertia = rng.uniform(0, 1), total * rng.uniform(0, 1)
    viscous = total * w * rng.uniform(0, 1)
    return AxisLoop(w / 4, total * w, total * w * w / 4, feed, inertia, filters, viscous)


def random_filters(rng: np.random.Generator) -> tuple[Biquad, ...]:
    return (
        Biquad.notch(rng.uniform(15, 25), 0.2, 0.6),
        Biquad.low_pass(rng.uniform(60, 90), 0.7),
    )[: int(rng.integers(0, 3))]


def state_space(closed: ClosedLoop) -> tuple[np.ndarray, ...]:
    """A, B, C, D from references, their velocities and accelerations to positions and torques.

    The mechanics alone, then one controller an axis from a transfer function that ``signal``
    turns into a state space, closed by the linear algebra of a feedback connection.
    """
    model, m = closed.model, len(closed.loops)
    M, D, K = model.mass_matrix, model.damping_matrix, model.stiffness_matrix
    n = M.shape[0]
    inverse = np.linalg.inv(M)
    pick = np.zeros((n, m))
    pick[model.first_masses, np.arange(m)] = 1.0
    Ap = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ K, -inverse @ D]])
    Bp = np.vstack([np.zeros((n, m)), inverse @ pick])
    Cq = np.hstack([pick.T, np.zeros((m, n))])  # positions
    Cv = np.hstack([np.zeros((m, n)), pick.T])  # velocities
    shapes, pi = [], []
    p, kff, cff, jff = np.zeros((4, m))
    for k, loop in enumerate(closed.loops):
        num, den = np.array([1.0]), np.array([1.0])
        if loop is None:
            pi.append((np.zeros((1, 1)),) * 4)
            shapes.append(pi[-1])
            continue
        for biquad in loop.filters:
            num = np.polymul(num, np.trim_zeros(biquad.numerator, "f"))
            den = np.polymul(den, [1.0, *biquad.denominator])
        pi.append(
            signal.tf2ss(
                np.polymul([loop.velocity_p, loop.velocity_i], num), np.polymul([1, 0], den)
            )
        )
        shapes.append(signal.tf2ss(num, den))
        p[k], kff[k] = loop.position_p, loop.velocity_ff
        cff[k], jff[k] = loop.viscous_ff, loop.inertia_ff
    held = np.array([loop is not None for loop in closed.loops], dtype=float)
    A1, B1, C1, D1 = (block_diag(*[s[i] for s in pi]) for i in range(4))
    A2, B2, C2, D2 = (block_diag(*[s[i] for s in shapes]) for i in range(4))
    # e = P (r - q) + kff v - q',  torque = C1 x1 + D1 e + C2 x2 + D2 (cff v + jff a)
    E = -np.diag(p) @ Cq - np.diag(held) @ Cv
    n1, n2 = A1.shape[0], A2.shape[0]
    A = np.block(
        [
            [Ap + Bp @ D1 @ E, Bp @ C1, Bp @ C2],
            [B1 @ E, A1, np.zeros((n1, n2))],
            [np.zeros((n2, 2 * n + n1)), A2],
        ]
    )
    Ein = np.hstack([np.diag(p), np.diag(kff), np.zeros((m, m))])
    Ain = np.hstack([np.zeros((m, m)), np.diag(cff), np.diag(jff)])
    torque_in = D1 @ Ein + D2 @ Ain
    B = np.vstack([Bp @ torque_in, B1 @ Ein, B2 @ Ain])
    C = np.block([[Cq, np.zeros((m, n1 + n2))], [D1 @ E, C1, C2]])
    D = np.vstack([np.zeros((m, 3 * m)), torque_in])
    # filters in companion form differ by ten decades in their states: brought to one size
    balanced, transform = matrix_balance(A, permute=False)
    size = np.diag(transform)
    return balanced, B / size[:, None], C * size, D


def by_state_space(closed: ClosedLoop, omega: np.ndarray, axis: int) -> np.ndarray:
    A, B, C, D = state_space(closed)
    m = len(closed.loops)
    result = np.empty((omega.size, 2 * m), dtype=complex)
    for f, w in enumerate(omega):
        s = 1j * w
        u = np.zeros(3 * m, dtype=complex)
        u[[axis, m + axis, 2 * m + axis]] = 1.0, s, s * s
        result[f] = C @ np.linalg.solve(s * np.eye(A.shape[0]) - A, B @ u) + D @ u
    return result


@pytest.fixture
def closed(random_model: RandomModel, fresh_rng: np.random.Generator) -> ClosedLoop:
    lengths = tuple(int(n) for n in fresh_rng.integers(1, 5, size=int(fresh_rng.integers(1, 4))))
    model = random_model(fresh_rng, lengths, friction=bool(fresh_rng.integers(0, 2)))
    loops: list[AxisLoop | None] = [
        loop_for(axis.total_mass, fresh_rng, random_filters(fresh_rng)) for axis in model.axes
    ]
    if len(loops) > 1 and fresh_rng.integers(0, 2):
        loops[0] = None
    print(lengths, [None if one is None else len(one.filters) for one in loops])
    return ClosedLoop(model, tuple(loops))


@pytest.mark.parametrize("_run", range(8))
def test_phasors_are_those_of_a_state_space(
    closed: ClosedLoop, fresh_rng: np.random.Generator, _run: int
) -> None:
    omega = TWO_PI * np.geomspace(0.2, 60, 40)
    axis = len(closed.loops) - 1
    position, torque = closed.response(omega, axis)
    other = by_state_space(closed, omega, axis)
    m = len(closed.loops)
    for found, expected in ((position, other[:, :m]), (torque, other[:, m:])):
        scale = np.abs(expected).max(axis=1, keepdims=True)
        np.testing.assert_allclose(found / scale, expected / scale, atol=1e-7)
    for k, loop in enumerate(closed.loops):
        if loop is None:
            assert np.all(torque[:, k] == 0)


@pytest.mark.parametrize("_run", range(4))
def test_eigenvalues_are_those_of_a_state_space(closed: ClosedLoop, _run: int) -> None:
    ours = np.linalg.eigvals(closed.system_matrix())
    theirs = np.linalg.eigvals(state_space(closed)[0])
    scale = np.abs(ours).max()
    # the second state space has more states: the inertia feed-forward's filters, each its poles
    for value in ours[np.abs(ours) > 1e-4 * scale]:
        assert np.abs(theirs - value).min() < 1e-4 * abs(value) + 1e-6 * scale


@pytest.mark.parametrize("_run", range(3))
def test_time_steps_are_those_of_lsim(
    closed: ClosedLoop, fresh_rng: np.random.Generator, _run: int
) -> None:
    m, n, step = len(closed.loops), 400, 0.004
    loops = tuple(
        None if one is None else replace(one, viscous_ff=0.0, inertia_ff=0.0)
        for one in closed.loops
    )  # lsim can not have the impulses of a bent reference's acceleration
    closed = ClosedLoop(closed.model, loops)
    growth = float(np.linalg.eigvals(closed.system_matrix()).real.max()) * n * step
    if growth > 3.0:  # rounding grows along: two ways of stepping can not agree in its digits
        closed = ClosedLoop(
            closed.model,
            tuple(
                None
                if one is None
                else replace(one, velocity_p=0.02 * one.velocity_p, velocity_i=0.0, filters=())
                for one in loops
            ),
        )
    references = np.zeros((n, m))
    references[:, -1] = np.interp(np.arange(n), np.arange(0, n, 40), fresh_rng.normal(size=10))
    references[0] = 0.0
    position, torque = closed.simulate(references, step)
    fine = 16  # lsim's velocity input must be a step within one of its own steps: hold it there
    t = np.arange((n - 1) * fine + 1) * step / fine
    r = np.array([np.interp(t, np.arange(n) * step, references[:, k]) for k in range(m)]).T
    v = np.repeat(np.diff(references, axis=0) / step, fine, axis=0)
    A, B, C, D = state_space(closed)
    x = np.zeros(A.shape[0])
    size, width = A.shape[0], B.shape[1]
    block = np.zeros((size + 2 * width, size + 2 * width))
    block[:size, :size], block[:size, size : size + width] = A, B
    block[size : size + width, size + width :] = np.eye(width)
    e = expm(block * step / fine)
    expected = np.empty((n, 2 * m))
    for k in range(t.size):
        velocity = v[min(k, v.shape[0] - 1)] if k < v.shape[0] else np.zeros(m)
        u = np.concatenate([r[k], velocity, np.zeros(m)])
        if k % fine == 0:
            expected[k // fine] = C @ x + D @ u
        slope = np.concatenate([velocity, np.zeros(2 * m)])
        x = e[:size, :size] @ x + e[:size, size : size + width] @ u
        x = x + e[:size, size + width :] @ slope
    for found, wanted in ((position, expected[:, :m]), (torque, expected[:, m:])):
        np.testing.assert_allclose(found, wanted, atol=1e-8 * np.abs(wanted).max())


@pytest.mark.parametrize("_run", range(4))
def test_a_long_sine_settles_to_the_phasors(
    random_model: RandomModel, fresh_rng: np.random.Generator, _run: int
) -> None:
    model = random_model(fresh_rng, (2, 1), friction=True)
    loops = tuple(
        replace(
            loop_for(a.total_mass, fresh_rng, random_filters(fresh_rng)),
            velocity_ff=0.0,
            viscous_ff=0.0,
            inertia_ff=0.0,
        )
        for a in model.axes
    )
    closed = ClosedLoop(model, loops)
    slowest = -np.linalg.eigvals(closed.system_matrix()).real.max()
    assert slowest > 0
    step, period = 0.001, 250
    frequency = 1 / (step * period)
    n = int(np.ceil(18 / slowest / step / period) + 1) * period
    assert n < 200_000
    references = np.zeros((n, 2))
    references[:, 0] = np.sin(TWO_PI * np.arange(n) / period)
    position, torque = closed.simulate(references, step)
    carrier = 2 / period * np.exp(-1j * TWO_PI * np.arange(period) / period) * 1j
    last = [carrier @ values[-period:] for values in (position, torque)]
    exact = closed.response(np.array([TWO_PI * frequency]), 0)
    for found, wanted in zip(last, exact, strict=True):
        # references are linear between samples: (pi f T)^2 / 3 too small, 5e-5 here
        scale = np.abs(wanted[0]).max()
        np.testing.assert_allclose(found / scale, wanted[0] / scale, atol=1e-4)


def test_compliance_is_one_axis_alone() -> None:
    """A rigid axis: 1 / (-w2 m + jw c); and a two-mass axis by its textbook formula."""
    w = np.array([1.0, 10.0, 100.0])
    rigid = MachineModel((AxisModel("x", "rotary", (Estimate(2.0),), (), (), Estimate(3.0)),))
    loop = AxisLoop(1.0, 2.0, 3.0)
    np.testing.assert_allclose(
        ClosedLoop(rigid, (loop,)).compliance(w, 0), 1 / (-2 * w**2 + 3j * w), rtol=1e-12
    )
    m1, m2, k, d = 1.0, 2.0, 5000.0, 4.0
    two = MachineModel(
        (AxisModel("x", "linear", (Estimate(m1), Estimate(m2)), (Estimate(k),), (Estimate(d),)),)
    )
    s = 1j * w
    spring = k + s * d
    wanted = (m2 * s**2 + spring) / (m1 * m2 * s**4 + (m1 + m2) * s**2 * spring)
    np.testing.assert_allclose(ClosedLoop(two, (None,)).compliance(w, 0), wanted, rtol=1e-9)


@pytest.mark.parametrize("_run", range(4))
def test_compliance_closed_by_hand_is_the_response(closed: ClosedLoop, _run: int) -> None:
    axis = len(closed.loops) - 1
    omega = TWO_PI * np.geomspace(0.3, 40, 30)
    loop = closed.loops[axis]
    assert loop is not None
    plain = replace(loop, velocity_ff=1.0, viscous_ff=0.0, inertia_ff=0.0)
    loops = (*closed.loops[:axis], plain)
    position, _ = ClosedLoop(closed.model, loops).response(omega, axis)
    gain = np.array([plain.gain(1j * w) for w in omega])
    open_loop = gain * ClosedLoop(closed.model, loops).compliance(omega, axis)
    np.testing.assert_allclose(position[:, axis], open_loop / (1 + open_loop), rtol=1e-8)


def test_filters_are_notch_and_low_pass() -> None:
    notch, low = Biquad.notch(40.0, 0.1, 0.5), Biquad.low_pass(80.0, 0.7)
    f = np.array([0.01, 40.0, 1e6])
    np.testing.assert_allclose(np.abs(notch.response(TWO_PI * 1j * f)), [1, 0.2, 1], rtol=1e-6)
    f = np.array([0.01, 80.0, 8000.0])
    np.testing.assert_allclose(np.abs(low.response(TWO_PI * 1j * f)), [1, 1 / 1.4, 1e-4], rtol=1e-3)
    w = TWO_PI * np.geomspace(1, 500, 50)
    _, expected = signal.freqs(notch.numerator, [1.0, *notch.denominator], w)
    np.testing.assert_allclose(notch.response(1j * w), expected, rtol=1e-12)


def test_stable_with_floating_axes_and_without_dampers(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    """An undamped chain that floats uncoupled swings for ever; that is not unstable."""
    for _ in range(30):
        model = random_model(fresh_rng, (2, 4), damped=False)
        alone = replace(model, couplings=())
        driven = loop_for(model.axes[0].total_mass, fresh_rng)
        assert ClosedLoop(alone, (driven, None)).stable
        assert ClosedLoop(model, (driven, None)).stable
        assert ClosedLoop(model, (None, None)).stable


@pytest.mark.parametrize("_run", range(5))
def test_unstable_loops_are_seen(
    random_model: RandomModel, fresh_rng: np.random.Generator, _run: int
) -> None:
    model = random_model(fresh_rng, (3, 2))
    good = [loop_for(axis.total_mass, fresh_rng) for axis in model.axes]
    assert ClosedLoop(model, tuple(good)).stable
    for bad in (
        replace(good[0], velocity_p=-good[0].velocity_p),
        replace(good[0], filters=(Biquad.low_pass(1.0, 0.1),)),
    ):
        closed = ClosedLoop(model, (bad, good[1]))
        assert not closed.stable
        assert np.linalg.eigvals(state_space(closed)[0]).real.max() > 0


def test_the_border_of_stability_of_a_rigid_axis_by_routh() -> None:
    """m s3 + kp s2 + (ki + kp p) s + ki p: stable exactly while kp (ki + kp p) > m ki p."""
    rigid = MachineModel((AxisModel("x", "rotary", (Estimate(2.0),), ()),))
    kp, ki = 3.0, 40.0
    border = kp * ki / (2.0 * ki - kp**2)
    for factor, stable in ((0.999, True), (1.001, False)):
        loop = AxisLoop(border * factor, kp, ki)
        assert ClosedLoop(rigid, (loop,)).stable is stable


def test_a_loop_for_each_axis_is_needed(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    with pytest.raises(ValueError, match="2 axes need as many loops"):
        ClosedLoop(random_model(fresh_rng, (1, 2)), (None,))


def test_loop_from_parameters() -> None:
    values = {
        "position_p": 6.0, "velocity_p": 30.0, "velocity_i": 60.0, "velocity_ff": 0.5,
        "viscous_ff": 0.7, "inertia_ff": 2.0, "filter1_type": 1.0, "filter1_frequency": 40.0,
        "filter1_zero_damping": 0.1, "filter1_pole_damping": 0.5, "filter2_type": 2.0,
        "filter2_frequency": 80.0, "filter2_zero_damping": 0.3, "filter2_pole_damping": 0.7,
    }  # fmt: skip
    assert loop_from_parameters(values) == AxisLoop(
        6.0, 30.0, 60.0, 0.5, 2.0, (Biquad.notch(40.0, 0.1, 0.5), Biquad.low_pass(80.0, 0.7)), 0.7
    )
    values |= {"filter1_type": 0.0, "filter2_type": 0.0}
    assert loop_from_parameters(values).filters == ()
    assert loop_from_parameters({"position_p": 1, "velocity_p": 2, "velocity_i": 3}) == AxisLoop(
        1, 2, 3, 0.0, 0.0
    )
    with pytest.raises(KeyError, match="velocity_i"):
        loop_from_parameters({"position_p": 1.0, "velocity_p": 2.0})
