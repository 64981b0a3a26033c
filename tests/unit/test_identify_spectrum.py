"""Spectra: what alternates, what does not, and the weights of equation (13)."""

import numpy as np
import pytest
from scipy.linalg import eigh

from fieldtool.errors import NotAChainError
from fieldtool.identify.chains.forward import gains, spectra
from fieldtool.identify.chains.spectrum import Spectrum, without_cancelling_pairs
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel


def chain(name, masses, springs):
    return AxisModel(
        name,
        "linear",
        tuple(Estimate(float(m)) for m in masses),
        tuple(Estimate(float(k)) for k in springs),
    )


def two_axes(coupling=0.5):
    return MachineModel(
        (chain("x", [1, 2, 3], [100, 300]), chain("y", [2, 1], [500])),
        (Coupling(("x", "y"), coupling),),
    )


def test_spectrum_agrees_with_eigenvalues_of_the_matrices():
    model = two_axes()
    for axis, spectrum in enumerate(spectra(model)):
        lam, modes = eigh(model.stiffness_matrix, model.mass_matrix)
        free = np.arange(5) != model.first_masses[axis]
        lam0 = eigh(
            model.stiffness_matrix[np.ix_(free, free)],
            model.mass_matrix[np.ix_(free, free)],
            eigvals_only=True,
        )
        np.testing.assert_allclose(spectrum.resonances[1:], lam[2:], rtol=1e-12)
        np.testing.assert_allclose(spectrum.antiresonances, lam0[1:], rtol=1e-12)
        shares = modes[model.first_masses[axis]] ** 2 * model.axes[axis].masses[0].value
        np.testing.assert_allclose(
            spectrum.weights, [shares[:2].sum(), *shares[2:]], rtol=1e-10, atol=1e-15
        )


def test_weights_add_up_to_one():
    for spectrum in spectra(two_axes()):
        assert spectrum.weights.sum() == pytest.approx(1.0, abs=1e-14)


def test_an_axis_without_coupling_sees_only_itself():
    model = MachineModel((chain("x", [1, 2], [100]), chain("y", [2, 1, 1], [500, 400])))
    assert [s.resonances.size for s in spectra(model)] == [2, 3]


def test_equal_axes_see_one_of_two_equal_modes():
    axes = tuple(chain(n, [1, 2], [100]) for n in "xyz")
    pairs = (("x", "y"), ("x", "z"), ("y", "z"))
    model = MachineModel(axes, tuple(Coupling(p, 0.4) for p in pairs))
    assert [s.resonances.size for s in spectra(model)] == [3, 3, 3]


def test_cross_gain_is_the_response_with_two_axes_free():
    model = two_axes(0.5)
    total = np.array([[6.0, 0.5], [0.5, 3.0]])
    np.testing.assert_allclose(gains(model).cross[0, 1], np.linalg.inv(total)[0, 1])
    np.testing.assert_allclose(gains(model).low, [1 / 6, 1 / 3])


def test_a_missed_mode_is_named_in_hertz():
    hertz = 2 * np.pi
    with pytest.raises(NotAChainError, match=r"axis z.*between 0 and 10 Hz there are 0"):
        Spectrum.from_angular("z", np.array([0, 10, 30]) * hertz, np.array([15, 20]) * hertz)


def test_lists_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="one antiresonance fewer, got 2"):
        Spectrum("x", np.array([0.0, 4.0]), np.array([1.0, 5.0]))
    with pytest.raises(ValueError, match="rigid body at 0"):
        Spectrum("x", np.array([1.0, 4.0]), np.array([2.0]))
    with pytest.raises(ValueError, match="finite"):
        Spectrum("x", np.array([0.0, np.nan]), np.array([2.0]))


def test_extra_rigid_bodies_are_dropped():
    spectrum = Spectrum.from_angular("x", np.array([0, 0, 0, 3.0]), np.array([0, 0, 2.0]))
    np.testing.assert_array_equal(spectrum.resonances, [0, 9])
    np.testing.assert_array_equal(spectrum.antiresonances, [4])


def test_leaving_out_a_pair_keeps_the_covariance_of_the_rest():
    spectrum = Spectrum(
        "x",
        np.array([0.0, 100.0, 400.0]),
        np.array([99.99, 300.0]),
        covariance=np.diag([1.0, 2.0, 3.0, 4.0]),
    )
    shorter = without_cancelling_pairs(spectrum, 0.01)
    np.testing.assert_array_equal(shorter.resonances, [0, 400])
    np.testing.assert_array_equal(np.diag(shorter.covariance), [2.0, 4.0])
    assert shorter.left_out == ((100.0, 99.99),)
    assert without_cancelling_pairs(spectrum, 1e-6).left_out == ()


def test_a_coupling_larger_than_its_masses_is_refused():
    with pytest.raises(ValueError, match="not positive definite"):
        spectra(two_axes(coupling=1.8))
