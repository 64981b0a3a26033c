"""Modal fit: from noisy responses to modes, masses, springs and couplings, without a prior."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh

from fieldtool.errors import NotEnoughDataError
from fieldtool.identify.chains.forward import spectra
from fieldtool.identify.chains.modal_chain import SEEN, reduce_modes, reduction_inputs
from fieldtool.identify.likelihood.refine import machine_response
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes.fit import fit_modes
from fieldtool.identify.modes.model import (
    ModalParts,
    modal_derivatives,
    modal_response,
    take_apart,
)
from fieldtool.identify.modes.poles import Responses, find_poles, start_poles
from fieldtool.identify.modes.sum_rule import sum_rule, sum_rule_jacobian
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from tests.seeds import fresh_seed

LENGTHS = {"branch 1": 3, "branch 2": 3, "branch 3": 3}


@pytest.fixture
def rng():
    return np.random.default_rng(fresh_seed())


def estimates(values):
    return tuple(Estimate(float(v)) for v in values)


def paper_machine(rng=None, spread=0.0):
    """Dampers 5e-4 s times the springs, each off by up to `spread`."""
    axes = []
    for i, (masses, springs) in enumerate(
        [((0.7, 2, 3), (1e3, 2e3)), ((4, 5, 6), (3e3, 4e3)), ((7, 8, 9), (5e3, 6e3))]
    ):
        off = 1.0 if rng is None else rng.uniform(1 - spread, 1 + spread, 2)
        dampers = 5e-4 * np.array(springs) * off
        name = f"branch {i + 1}"
        axes.append(
            AxisModel(name, "rotary", estimates(masses), estimates(springs), estimates(dampers))
        )
    pairs = (("branch 1", "branch 2", 1.0), ("branch 1", "branch 3", 2.0))
    pairs = (*pairs, ("branch 2", "branch 3", 3.0))
    return MachineModel(tuple(axes), tuple(Coupling((a, b), m) for a, b, m in pairs))


def measure(model, omega, noise, rng, delays=None):
    """Noise relative to each pair's size: the large responses of both axes at that frequency."""
    exact = machine_response(model, omega, delays)
    largest = np.abs(exact).max(axis=2)
    std = noise * np.sqrt(largest[:, :, None] * largest[:, None, :])
    error = rng.standard_normal((2, *exact.shape)) * std / np.sqrt(2.0)
    return ResponseMatrix(model.names, omega, exact + error[0] + 1j * error[1], std)


def around_the_modes():
    return np.sort(np.r_[np.geomspace(4.0, 205.0, 14), np.linspace(11.0, 54.0, 36)])


def relative_errors(found, truth):
    def values(model):
        chains = [e.value for a in model.axes for e in (*a.masses, *a.springs)]
        return np.array(chains), np.array([c.value for c in model.couplings])

    (chains, couplings), (true_chains, true_couplings) = values(found), values(truth)
    return np.abs(chains / true_chains - 1), np.abs(couplings / true_couplings - 1)


@pytest.mark.parametrize("spread", [0.0, 0.3])
@pytest.mark.parametrize("band", ["around the modes", "even"])
def test_paper_machine_from_noisy_responses(spread, band, rng):
    truth = paper_machine(rng, spread)
    omega = around_the_modes() if band == "around the modes" else np.geomspace(4.0, 205.0, 50)
    modal = fit_modes(measure(truth, omega, 1e-3, rng), 6)
    assert modal.excess < 1.5
    result = reduce_modes(modal, LENGTHS)
    chains, couplings = relative_errors(result.model, truth)
    assert chains.max() < 0.005
    assert couplings.max() < 0.01


def test_standard_errors_are_honest(rng):
    truth = paper_machine()
    omega, misses = around_the_modes(), []
    for _ in range(10):
        modal = fit_modes(measure(truth, omega, 5e-3, rng), 6, general=False)
        model = reduce_modes(modal, LENGTHS).model
        for found, true in zip(model.axes, truth.axes, strict=True):
            for e, t in zip(
                (*found.masses, *found.springs), (*true.masses, *true.springs), strict=True
            ):
                misses.append((e.value - t.value) / e.std)
        misses += [
            (c.value - t.value) / c.std
            for c, t in zip(model.couplings, truth.couplings, strict=True)
        ]
    assert 0.6 < np.sqrt(np.mean(np.square(misses))) < 1.6


def test_a_mode_that_one_motor_hardly_sees_is_found_through_the_others(rng):
    truth = paper_machine()
    modal = fit_modes(measure(truth, around_the_modes(), 1e-3, rng), 6)
    assert modal.omega[2] == pytest.approx(34.16101, rel=1e-3)
    weight = modal.phi[1, 2] ** 2 * 4.0
    assert weight == pytest.approx(0.00136, rel=0.3)


def test_frequencies_damping_and_shapes_of_the_undamped_machine(rng):
    truth = paper_machine()
    modal = fit_modes(measure(truth, around_the_modes(), 1e-4, rng), 6)
    lam, modes = eigh(truth.stiffness_matrix, truth.mass_matrix)
    np.testing.assert_allclose(modal.omega, np.sqrt(lam[3:]), rtol=1e-3)
    np.testing.assert_allclose(modal.zeta, 2.5e-4 * np.sqrt(lam[3:]), rtol=0.05)
    shapes = modes[truth.first_masses][:, 3:]
    np.testing.assert_allclose(np.abs(modal.phi), np.abs(shapes), atol=2e-3)
    rigid = modes[truth.first_masses][:, :3]
    np.testing.assert_allclose(modal.rigid, rigid @ rigid.T, rtol=5e-3)


def test_spectra_and_gains_from_modes_are_the_forward_problem(rng):
    truth = paper_machine()
    modal = fit_modes(measure(truth, around_the_modes(), 1e-5, rng), 6, general=False)
    inputs = reduction_inputs(modal, LENGTHS)
    for axis, exact in zip(inputs.axes, spectra(truth), strict=True):
        np.testing.assert_allclose(axis.spectrum.resonances, exact.resonances, rtol=1e-4)
        np.testing.assert_allclose(axis.spectrum.antiresonances, exact.antiresonances, rtol=1e-4)
    assert inputs.axes[0].low_gain.value == pytest.approx(1 / 5.7, rel=1e-3)
    assert inputs.axes[0].high_gain.value == pytest.approx(1 / 0.7, rel=1e-3)
    assert [np.sign(g.value) for g in inputs.cross_gains] == [-1, -1, -1]


def test_motor_masses_from_the_data_sheet(rng):
    truth = paper_machine()
    modal = fit_modes(measure(truth, around_the_modes(), 1e-3, rng), 6)
    known = {a.name: Estimate(a.masses[0].value, 0.0) for a in truth.axes}
    result = reduce_modes(modal, LENGTHS, motor_masses=known)
    assert [a.masses[0].value for a in result.model.axes] == [0.7, 4.0, 7.0]
    assert relative_errors(result.model, truth)[0].max() < 0.01


def test_delay_and_friction(rng):
    truth = paper_machine()
    axes = tuple(
        replace(a, viscous_friction=Estimate(f))
        for a, f in zip(truth.axes, (0.4, 1.0, 2.0), strict=True)
    )
    truth = replace(truth, axes=axes)
    delays = np.array([1e-3, 2e-3, 0.0])
    data = measure(truth, around_the_modes(), 1e-3, rng, delays)
    modal = fit_modes(data, 6, fit_friction=True, fit_delay=True)
    np.testing.assert_allclose(modal.delays, delays, atol=2e-5)
    np.testing.assert_allclose(modal.friction, [0.4, 1.0, 2.0], rtol=0.15)
    chains, couplings = relative_errors(reduce_modes(modal, LENGTHS).model, truth)
    assert chains.max() < 0.02
    assert couplings.max() < 0.05


def test_a_prior_model_gives_the_same(rng):
    truth = paper_machine()
    data = measure(truth, around_the_modes(), 1e-3, rng)
    bare = replace(truth, axes=tuple(replace(a, dampers=()) for a in truth.axes))
    with_prior, without = fit_modes(data, 6, prior=bare), fit_modes(data, 6)
    np.testing.assert_allclose(with_prior.omega, without.omega, rtol=1e-6)


def test_columns_measured_at_different_frequencies(rng):
    truth = paper_machine()
    data = measure(truth, np.geomspace(4.0, 205.0, 150), 1e-3, rng)
    response, std = data.response.copy(), data.std.copy()
    for j in range(3):
        other = np.arange(150) % 3 != j
        response[other, :, j] = np.nan
        std[other, :, j] = np.nan
    modal = fit_modes(ResponseMatrix(data.names, data.omega, response, std), 6)
    chains, couplings = relative_errors(reduce_modes(modal, LENGTHS).model, truth)
    assert chains.max() < 0.01
    assert couplings.max() < 0.02


def test_one_column_gives_modes_but_not_the_chains(rng):
    truth = paper_machine()
    data = measure(truth, around_the_modes(), 1e-3, rng)
    response, std = data.response.copy(), data.std.copy()
    response[:, :, 1:] = np.nan
    std[:, :, 1:] = np.nan
    modal = fit_modes(ResponseMatrix(data.names, data.omega, response, std), 6)
    np.testing.assert_allclose(modal.omega[:2], [24.62754, 29.58887], rtol=2e-3)
    with pytest.raises(NotEnoughDataError, match="branch 2 and branch 2: no response between"):
        reduce_modes(modal, LENGTHS)
    with pytest.raises(NotEnoughDataError, match="friction needs every pair"):
        fit_modes(ResponseMatrix(data.names, data.omega, response, std), 6, fit_friction=True)


def test_a_mode_too_many_is_not_believed(rng):
    truth = paper_machine()
    modal = fit_modes(measure(truth, around_the_modes(), 1e-3, rng), 7, general=False)
    assert np.sort(modal.significance)[0] < SEEN
    assert np.sort(modal.significance)[1] > 20.0
    with pytest.raises(NotEnoughDataError, match="only 6 of 7 modes rise out of the noise"):
        reduce_modes(modal, LENGTHS)


def test_rigid_axis_without_modes(rng):
    truth = MachineModel((AxisModel("x", "linear", estimates([2.5]), ()),))
    modal = fit_modes(measure(truth, np.linspace(5, 50, 10), 1e-3, rng), 0)
    (axis,) = reduce_modes(modal, {"x": 1}).model.axes
    assert axis.masses[0].value == pytest.approx(2.5, rel=2e-3)
    assert 0.0 < axis.masses[0].std < 2e-3


def test_too_few_lines_are_named(rng):
    with pytest.raises(NotEnoughDataError, match="can not give 6 modes"):
        fit_modes(measure(paper_machine(), np.array([10.0, 40.0]), 1e-3, rng), 6)


@pytest.mark.parametrize("friction", [False, True])
def test_derivatives_agree_with_differences(friction, rng):
    parts = ModalParts(3, np.ones((2, 2), bool), True, friction, True)
    x = np.concatenate(
        [
            [20.0, 30.0, 45.0],
            rng.uniform(0.005, 0.03, 3),
            rng.standard_normal(6),
            0.1 * rng.standard_normal(6),
            [0.3, 0.05, 0.4],
            [0.5, 0.2] if friction else [],
            [0.001, 0.002],
        ]
    )
    omega = np.linspace(5.0, 70.0, 9)
    derivatives = modal_derivatives(parts, x, omega)
    for k in range(x.size):
        step = np.zeros_like(x)
        step[k] = 1e-6 * max(abs(x[k]), 0.1)
        up, down = (modal_response(parts, x + s, omega) for s in (step, -step))
        slope = (up - down) / (2 * step[k])
        np.testing.assert_allclose(
            derivatives[..., k], slope, atol=1e-5 * np.abs(slope).max(), rtol=1e-5
        )


@pytest.mark.parametrize("friction", [False, True])
def test_sum_rule_derivatives_agree_with_differences(friction, rng):
    parts = ModalParts(3, np.ones((2, 2), bool), True, friction, False)
    x = rng.uniform(0.1, 1.0, parts.count)
    x[parts.slices["zeta"]] *= 0.3
    rows = sum_rule_jacobian(parts, x)
    for k in range(x.size):
        step = 1e-6 * np.eye(x.size)[k]
        up, down = (sum_rule(parts, x + s) * _scale(parts, x + s) for s in (step, -step))
        np.testing.assert_allclose(
            rows[:, k] * _scale(parts, x), (up - down) / 2e-6, rtol=1e-5, atol=1e-7
        )


def _scale(parts, x):
    v = take_apart(parts, x)
    size = np.sqrt((v.phi**2 / v.omega).sum(axis=1))
    return 1e-3 * np.array([size[0] ** 2, size[0] * size[1], size[1] ** 2])


def test_poles_are_found_exactly_without_noise():
    omega = np.linspace(1.0, 100.0, 60)
    true = np.array([-0.2 + 20j, -0.3 + 21j, -0.5 + 60j])
    s = 1j * omega[:, None]
    columns = [
        1.0 + sum(c[r] * s / ((s - p) * (s - p.conj())) for r, p in enumerate(true))
        for c in ([1, 2, 3], [1, -1, 0.5])
    ]
    data = Responses(omega, np.hstack(columns), np.ones((60, 2)))
    found = find_poles(data, start_poles(omega, 3))
    np.testing.assert_allclose(found.pairs, true, rtol=1e-8)


def test_wrong_shapes_and_noise_are_refused():
    omega = np.array([1.0, 2.0])
    values = np.ones((2, 1, 1), complex)
    with pytest.raises(ValueError, match=r"standard error of x over x at 0\.159155 Hz is 0"):
        ResponseMatrix(("x",), omega, values, np.zeros((2, 1, 1)))
    with pytest.raises(ValueError, match="must have shape"):
        ResponseMatrix(("x",), omega, values[:1], np.ones((2, 1, 1)))
    with pytest.raises(ValueError, match="positive numbers in rad/s"):
        ResponseMatrix(("x",), np.array([0.0, 1.0]), values, np.ones((2, 1, 1)))
    with pytest.raises(NotEnoughDataError, match="axis x: no frequency response"):
        ResponseMatrix(("x",), omega, values * np.nan, np.ones((2, 1, 1)))
