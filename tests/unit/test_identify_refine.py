"""Maximum-likelihood fit of masses, springs, dampers, couplings, delay and friction."""

from dataclasses import replace

import numpy as np
import pytest

from fieldtool.errors import IdentificationError, NotEnoughDataError
from fieldtool.identify.features import chain_features
from fieldtool.identify.likelihood.least_squares import Fit
from fieldtool.identify.likelihood.parameters import (
    machine_parameters,
    parameter_values,
    with_values,
)
from fieldtool.identify.likelihood.refine import (
    _open_directions,
    machine_response,
    refine,
    response_derivatives,
)
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from tests.seeds import fresh_seed


@pytest.fixture
def rng():
    return np.random.default_rng(fresh_seed())


def estimates(values):
    return tuple(Estimate(float(v)) for v in values)


def axis(name, masses, springs, dampers=(), friction=0.0, load_friction=0.0):
    return AxisModel(
        name,
        "rotary",
        estimates(masses),
        estimates(springs),
        estimates(dampers),
        Estimate(friction),
        Estimate(load_friction),
    )


def two_axes():
    return MachineModel(
        (
            axis("x", [1.0, 2.0, 1.5], [3000.0, 5000.0], [1.0, 2.0], 0.5, 0.3),
            axis("y", [2.0, 3.0], [8000.0], [4.0], 1.0, 0.7),
        ),
        (Coupling(("x", "y"), -0.4),),
    )


def bench(scale=1.0):
    """Two masses; torque in units of `scale`."""
    values = np.array([0.02, 0.02, 500.0, 0.02, 0.01]) * scale
    return MachineModel((axis("m", values[:2], values[2:3], values[3:4], values[4]),))


def measure(model, omega, noise, rng, delays=None):
    exact = machine_response(model, omega, delays)
    std = noise * np.abs(exact)
    error = rng.standard_normal((2, *exact.shape)) * std / np.sqrt(2.0)
    return ResponseMatrix(model.names, omega, exact + error[0] + 1j * error[1], std)


def disturbed(model, rng, by=0.1):
    """All parameters off by up to `by`, dampers and friction not known."""

    def off(values):
        return tuple(Estimate(e.value * rng.uniform(1 - by, 1 + by)) for e in values)

    axes = tuple(AxisModel(a.name, a.kind, off(a.masses), off(a.springs), ()) for a in model.axes)
    return replace(model, axes=axes)


def test_response_is_the_inverse_of_the_dynamic_stiffness():
    model, omega = two_axes(), np.array([10.0, 60.0])
    stiffness = model.stiffness_matrix + 1j * 60.0 * model.damping_matrix
    whole = np.linalg.inv(stiffness - 3600.0 * model.mass_matrix)
    motors = model.first_masses
    np.testing.assert_allclose(machine_response(model, omega)[1], whole[np.ix_(motors, motors)])


def test_derivatives_agree_with_differences():
    model, omega = two_axes(), np.linspace(10.0, 120.0, 7)
    parameters = machine_parameters(model, omega)
    values = parameter_values(model, parameters, [1e-3, 2e-3])
    names = [p.name for p in parameters]
    delays = values[[names.index("x.delay"), names.index("y.delay")]]
    derivatives = response_derivatives(model, omega, delays, parameters)
    for k in range(values.size):
        step = np.zeros_like(values)
        step[k] = 1e-5 * abs(values[k])
        up, down = (
            machine_response(m, omega, d)
            for m, d in (with_values(model, parameters, values + s) for s in (step, -step))
        )
        slope = (up - down) / (2 * step[k])
        np.testing.assert_allclose(
            derivatives[..., k], slope, rtol=1e-6, atol=1e-6 * np.abs(slope).max()
        )


def test_parameters_go_in_and_out():
    model = two_axes()
    parameters = machine_parameters(model, np.array([10.0]))
    values = parameter_values(model, parameters, [1e-3, 2e-3])
    same, delays = with_values(model, parameters, values)
    np.testing.assert_array_equal(same.mass_matrix, model.mass_matrix)
    np.testing.assert_array_equal(same.stiffness_matrix, model.stiffness_matrix)
    np.testing.assert_array_equal(same.damping_matrix, model.damping_matrix)
    np.testing.assert_array_equal(delays, [1e-3, 2e-3])
    assert parameters[0].name == "x.mass[1]"
    assert parameters[-1].name == "coupling[x,y]"


def test_everything_at_once_within_its_standard_errors(rng):
    truth, delays = two_axes(), np.array([1e-3, 5e-4])
    omega = np.geomspace(8.0, 250.0, 60)
    misses = []
    for _ in range(6):
        data = measure(truth, omega, 2e-3, rng, delays)
        found = refine(
            disturbed(truth, rng),
            data,
            fit_delay=True,
            fit_friction=True,
            fit_load_friction=True,
        )
        parameters = machine_parameters(truth, omega)
        values = parameter_values(truth, parameters, list(delays))
        true = dict(zip([p.name for p in parameters], values, strict=True))
        assert set(found.names) == set(true)
        misses += list(
            (found.values - [true[n] for n in found.names]) / np.sqrt(np.diag(found.covariance))
        )
        assert 0.7 < found.chi2 / found.degrees_of_freedom < 1.3
        assert found.unknown == ()
    assert 0.7 < np.sqrt(np.mean(np.square(misses))) < 1.4


def test_two_masses_with_unknown_torque_constant(rng):
    omega = 2 * np.pi * np.geomspace(8.0, 200.0, 60)
    for scale in (1.0, 17.0):
        data = measure(bench(scale), omega, 0.01, rng, np.array([1e-3]))
        found = refine(disturbed(bench(scale), rng, 0.3), data, fit_delay=True, fit_friction=True)
        features = chain_features(found)
        for estimate, true in (
            (features.antiresonances[0], np.sqrt(25000.0) / (2 * np.pi)),
            (features.resonances[0], np.sqrt(50000.0) / (2 * np.pi)),
            (features.inertia_ratio, 1.0),
        ):
            assert abs(estimate.value - true) < 5 * estimate.std
            assert 0 < estimate.std < 0.03 * true
        poles = np.roots(_determinant(bench(1.0).axes[0]))
        slow = poles[poles.imag > 1.0][0]
        ratio = features.damping_ratios[0]
        assert abs(ratio.value + slow.real / abs(slow)) < 5 * ratio.std
        assert found.delays[0].value == pytest.approx(1e-3, abs=1e-4)


def _determinant(a):
    """Characteristic polynomial of two masses with friction at the motor."""
    m1, m2, k, d, c = 0.02, 0.02, 500.0, 0.02, 0.01
    assert (a.masses[0].value, a.springs[0].value) == (m1, k)
    one, other, joint = [m1, d + c, k], [m2, d, k], [d, k]
    return np.polysub(np.polymul(one, other), np.polymul(joint, joint))


def test_fixed_parameters_keep_their_value(rng):
    truth = two_axes()
    data = measure(truth, np.geomspace(8.0, 250.0, 60), 1e-3, rng)
    start = replace(disturbed(truth, rng))
    axes = (replace(start.axes[0], masses=truth.axes[0].masses), start.axes[1])
    found = refine(replace(start, axes=axes), data, fixed=["x.mass[1]"], fit_friction=True)
    assert "x.mass[1]" not in found.names
    assert found.model.axes[0].masses[0].value == 1.0
    assert np.isnan(found.model.axes[0].masses[0].std)


def test_what_is_known_besides_counts_as_a_measurement(rng):
    truth = bench()
    low = 2 * np.pi * np.geomspace(1.0, 4.0, 10)  # far below the resonance: only the sum of masses
    data = measure(truth, low, 0.05, rng)
    exact = machine_response(truth, low)
    alone = refine(truth, ResponseMatrix(("m",), low, exact, 0.05 * np.abs(exact)))
    assert any("m.mass" in name for u in alone.unknown for name in u.parameters)
    assert any("only combinations" in u.reason for u in alone.unknown)
    prior = {"m.mass[1]": Estimate(0.02, 0.0002)}
    helped = refine(disturbed(truth, rng, 0.2), data, priors=prior)
    assert helped.model.axes[0].masses[0].value == pytest.approx(0.02, abs=0.001)
    assert 0.00015 < helped.model.axes[0].masses[0].std < 0.0005


def test_misfit_enlarges_standard_errors(rng):
    truth = bench()
    omega = 2 * np.pi * np.geomspace(8.0, 200.0, 60)
    data = measure(truth, omega, 0.01, rng)
    optimistic = ResponseMatrix(data.names, data.omega, data.response, data.std / 10.0)
    one, other = (refine(truth, d, fit_friction=True) for d in (data, optimistic))
    assert other.chi2 / other.degrees_of_freedom > 50
    np.testing.assert_allclose(np.diag(other.covariance), np.diag(one.covariance), rtol=0.6)


def test_wrong_names_and_too_little_data_are_refused(rng):
    truth = bench()
    data = measure(truth, 2 * np.pi * np.geomspace(8.0, 200.0, 20), 0.01, rng)
    with pytest.raises(ValueError, match=r"no parameter 'm.mass'; there are m.mass\[1\]"):
        refine(truth, data, fixed=["m.mass"])
    with pytest.raises(ValueError, match="the data have axes"):
        refine(two_axes(), data)
    with pytest.raises(ValueError, match="must be positive"):
        refine(truth, data, priors={"m.mass[1]": Estimate(-1.0, 0.1)})
    few = ResponseMatrix(data.names, data.omega[:1], data.response[:1], data.std[:1])
    with pytest.raises(NotEnoughDataError, match="2 measured numbers can not give 4 parameters"):
        refine(truth, few)
    pushed = (Estimate(-0.02), *truth.axes[0].masses[1:])
    backwards = replace(truth, axes=(replace(truth.axes[0], masses=pushed),))
    with pytest.raises(IdentificationError, match=r"can not begin: m has masses -0\.02"):
        refine(backwards, data)


def test_features_are_those_of_one_axis(rng):
    data = measure(two_axes(), np.geomspace(8.0, 250.0, 60), 1e-3, rng)
    found = refine(two_axes(), data)
    with pytest.raises(ValueError, match="the model has x, y"):
        chain_features(found)


def test_what_hardly_leaves_a_trace_can_change_together_by_any_amount():
    faint = 1e-200 * np.array([[1.0, -1.0], [0.5, 0.5]])
    jacobian = np.zeros((4, 3))
    jacobian[0, 0], jacobian[1:3, 1:] = 1.0, faint
    known, *others = [p for p in machine_parameters(bench(), np.ones(1)) if p.logarithmic][:3]
    solution = Fit(np.zeros(3), jacobian, np.full(4, 1e120))
    found = _open_directions(solution, [known, *others], np.full(3, True))
    assert [one.parameters for one in found] == [tuple(p.name for p in others)] * 2
    assert all(np.isinf(one.relative_std) for one in found)
    assert "can change together (by any amount) without" in found[0].reason
