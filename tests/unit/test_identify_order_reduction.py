"""Order reduction: random machines, error bounds, standard errors, refusals."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtool.errors import NotAChainError
from fieldtool.identify.chains.forward import gains, spectra
from fieldtool.identify.chains.lanczos import lanczos_step
from fieldtool.identify.chains.order_reduction import (
    AxisModes,
    CrossGain,
    coupling_from_gains,
    reduce_chain,
    reduce_machine,
)
from fieldtool.identify.chains.spectrum import Spectrum
from fieldtool.records.model import AxisModel, Estimate, MachineModel
from tests.seeds import fresh_seed

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def load(name):
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


exact_modes = load("exact_modes")
bench = load("bench_order_reduction")


@pytest.fixture
def rng():
    return np.random.default_rng(fresh_seed())


def simple(masses, springs, **known):
    model = MachineModel(
        (
            AxisModel(
                "x",
                "linear",
                tuple(Estimate(float(m)) for m in masses),
                tuple(Estimate(float(k)) for k in springs),
            ),
        )
    )
    g = gains(model)
    return AxisModes(
        spectra(model)[0], len(masses), Estimate(g.low[0]), Estimate(g.high[0]), **known
    )


@pytest.mark.parametrize("axes", [1, 2, 3, 4])
def test_random_machines_come_apart_within_1e6_and_within_their_bounds(axes, rng):
    for masses in ([1] * axes, [2] * axes, [3] * axes, [4] * axes, None):
        lengths = rng.integers(1, 5, axes) if masses is None else masses
        model = exact_modes.random_machine(rng, axes, lengths)
        for known in (False, True):
            errors, bounds, off, off_bounds = bench.errors_and_bounds(model, known)
            assert errors.max() < 1e-6
            assert np.all(errors <= bounds)
            assert np.all(off <= off_bounds)


def test_chains_of_six_masses(rng):
    worst = []
    for _ in range(12):  # one in twenty is so ill-conditioned that its error is above
        model = exact_modes.random_machine(rng, 2, [6, 6])
        errors, bounds, _, _ = bench.errors_and_bounds(model)
        assert np.all(errors <= bounds)
        worst.append(errors.max())
    assert np.median(worst) < 1e-4


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.floats(0.3, 10.0), min_size=2, max_size=4),
    st.lists(st.floats(100.0, 1e4), min_size=3, max_size=3),
)
def test_one_chain_of_any_masses(masses, springs):
    springs = springs[: len(masses) - 1]
    axis = AxisModel(
        "x",
        "linear",
        tuple(Estimate(m) for m in masses),
        tuple(Estimate(k) for k in springs),
    )
    errors, bounds, _, _ = bench.errors_and_bounds(MachineModel((axis,)))
    assert np.all(errors <= bounds)


def test_exact_modes_agree_with_the_forward_problem(rng):
    model = exact_modes.random_machine(rng, 3, [3, 1, 2])
    for exact, double in zip(exact_modes.exact_spectra(model), spectra(model), strict=True):
        np.testing.assert_allclose(exact.resonances, double.resonances, rtol=1e-13)
        np.testing.assert_allclose(exact.antiresonances, double.antiresonances, rtol=1e-13)


def test_one_mass_is_the_low_frequency_gain():
    spectrum = Spectrum("x", np.array([0.0]), np.zeros(0))
    chain = reduce_chain(AxisModes(spectrum, 1, Estimate(0.25)))
    np.testing.assert_array_equal(chain.masses, [4.0])
    assert chain.springs.size == 0


def test_two_masses_by_the_closed_formula():
    chain = reduce_chain(simple([2, 3], [600]))
    np.testing.assert_allclose(chain.masses, [2, 3])
    np.testing.assert_allclose(chain.springs, [600])


def test_lanczos_vectors_stay_orthogonal(rng):
    lam = np.append(0.0, np.sort(rng.uniform(1, 1e6, 30)))
    step = lanczos_step(lam, rng.uniform(0.1, 1.0, 31))
    np.testing.assert_allclose(step.u1 @ step.u2, 0.0, atol=1e-15)
    np.testing.assert_allclose(step.u1 @ (lam * step.u2), -step.b12, rtol=1e-12)


@pytest.mark.parametrize("known", [False, True])
def test_derivatives_agree_with_differences(known, rng):
    worst = np.inf
    while (
        worst > 1e6
    ):  # beyond it differences tell nothing: a mode and an antiresonance all but meet
        model = exact_modes.random_machine(rng, 2, [4, 3])
        axes, _ = bench.machine_inputs(model, spectra(model), known)
        chain = reduce_chain(axes[0])
        modes = axes[0]
        lam, lam0 = modes.spectrum.resonances[1:], modes.spectrum.antiresonances
        last = modes.motor_mass if known else modes.high_gain
        inputs = np.concatenate([lam, lam0, [modes.low_gain.value, last.value]])
        worst = np.abs(chain.sensitivity.jacobian * inputs / chain.values[:, None]).max()

    def values(x):
        n = lam.size
        spectrum = Spectrum("x", np.append(0.0, x[:n]), x[n:-2])
        low, first = Estimate(x[-2]), Estimate(x[-1])
        given = (None, first) if known else (first, None)
        return reduce_chain(AxisModes(spectrum, modes.masses, low, *given)).values

    for k, value in enumerate(inputs):
        gap = np.diff(np.sort(np.concatenate([[0.0], lam, lam0]))).min()
        step = min(1e-6 * value, 1e-3 * gap if k < inputs.size - 2 else np.inf)
        change = np.zeros_like(inputs)
        change[k] = step
        slope = (values(inputs + change) - values(inputs - change)) / (2 * step)
        np.testing.assert_allclose(
            chain.sensitivity.jacobian[:, k] * value / chain.values,
            slope * value / chain.values,
            rtol=2e-3,
            atol=1e-4 * np.abs(chain.sensitivity.jacobian * inputs / chain.values[:, None]).max(),
        )


def test_standard_errors_agree_with_repeated_noise(rng):
    relative = 1e-6
    closest = 0.0
    while closest < 1e3 * relative:  # the law holds where noise does not swap neighbouring modes
        model = exact_modes.random_machine(rng, 2, [2, 3])
        axes, cross = bench.machine_inputs(model, spectra(model))
        closest = min(
            float(
                np.min(np.diff(np.sort([*s.resonances[1:], *s.antiresonances])) / s.resonances[-1])
            )
            for s in (axis.spectrum for axis in axes)
        )
    noisy = []
    for axis in axes:
        s = axis.spectrum
        both = np.concatenate([s.resonances[1:], s.antiresonances])
        spectrum = Spectrum(s.axis, s.resonances, s.antiresonances, np.diag((relative * both) ** 2))
        low = Estimate(axis.low_gain.value, relative * axis.low_gain.value)
        high = Estimate(axis.high_gain.value, relative * axis.high_gain.value)
        noisy.append(AxisModes(spectrum, axis.masses, low, high))
    cross = [CrossGain(c.axes, c.value, relative * abs(c.value)) for c in cross]
    claimed = reduce_machine(noisy, cross)
    draws = []
    for _ in range(300):
        drawn = []
        for axis in noisy:
            s = axis.spectrum
            lam, lam0 = (
                x * (1 + relative * rng.standard_normal(x.size))
                for x in (s.resonances, s.antiresonances)
            )
            gains_now = [
                Estimate(g.value * (1 + relative * rng.standard_normal()))
                for g in (axis.low_gain, axis.high_gain)
            ]
            drawn.append(AxisModes(Spectrum(s.axis, lam, lam0), axis.masses, *gains_now))
        crossed = [
            CrossGain(c.axes, c.value * (1 + relative * rng.standard_normal())) for c in cross
        ]
        result = reduce_machine(drawn, crossed)
        draws.append(
            [
                *(v for c in result.chains for v in c.values),
                *(c.value for c in result.model.couplings),
            ]
        )
    std = np.sqrt(np.diag(claimed.covariance))
    np.testing.assert_allclose(np.std(draws, axis=0) / std, 1.0, atol=0.25)
    assert claimed.model.axes[0].masses[0].std == pytest.approx(std[0])
    assert claimed.model.couplings[0].std == pytest.approx(std[-1])


@pytest.mark.parametrize("coupling", [-1.3, -1e-9, 1e-9, 0.2, 1.3])
def test_coupling_has_the_opposite_sign_of_the_gain(coupling):
    total = np.array([[2.0, coupling], [coupling, 1.5]])
    cross = np.linalg.inv(total)[0, 1]
    assert np.sign(cross) == -np.sign(coupling)
    assert coupling_from_gains(1 / 2.0, 1 / 1.5, cross) == pytest.approx(coupling, rel=1e-12)


def test_too_few_modes_are_named():
    modes = simple([1, 2], [100])
    with pytest.raises(NotAChainError, match="3 masses need at least 2 flexible modes, 1"):
        reduce_chain(AxisModes(modes.spectrum, 3, modes.low_gain, modes.high_gain))


def test_gains_that_do_not_fit_are_named():
    modes = simple([1, 2, 3], [100, 200])
    with pytest.raises(NotAChainError, match=r"axis x: mass 3 comes out as -.*check A_L and A_H"):
        reduce_chain(AxisModes(modes.spectrum, 3, Estimate(1.0), modes.high_gain))


def test_couplings_that_no_machine_can_have_are_named():
    axes, chains = [], []
    for name in "xyz":
        model = MachineModel((AxisModel(name, "linear", (Estimate(1.0),), ()),))
        axes.append(AxisModes(spectra(model)[0], 1, Estimate(1.0)))
        chains.append(name)
    cross = [CrossGain(p, 2.0) for p in (("x", "y"), ("x", "z"), ("y", "z"))]
    with pytest.raises(NotAChainError, match="larger than the last masses"):
        reduce_machine(axes, cross)


def test_a_value_lost_in_rounding_says_so():
    chain = simple([1, 1, 1], [1e6, 1e-4])
    result = reduce_machine([chain])
    assert any("rounding" in note for note in result.notes)
    truth = np.array([1, 1, 1, 1e6, 1e-4])
    assert np.all(np.abs(result.chains[0].values / truth - 1) <= result.chains[0].relative_bounds)


def test_missing_gain_is_refused():
    modes = simple([1, 2], [100])
    with pytest.raises(ValueError, match="need the high-frequency gain A_H, or the motor's mass"):
        AxisModes(modes.spectrum, 2, modes.low_gain)
