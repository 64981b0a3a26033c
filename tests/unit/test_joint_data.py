"""Positions and torques as data: whitening, few experiments, agreement with the bound."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.phasors import Phasors
from fieldtool.identify.likelihood.expected import Excitation, Expected, Noise, expected_accuracy
from fieldtool.identify.likelihood.joint_data import frequencies_of, joint_spectra
from fieldtool.identify.likelihood.model_band import relative_std
from fieldtool.identify.likelihood.refine import RefinedModel, machine_response, refine
from fieldtool.records.model import Estimate, MachineModel

RandomModel = Callable[..., MachineModel]
TORQUE, POSITION = 2e-4, 2e-8
SAMPLES = 4  # E|2/N sum n exp|^2 = 4 s^2 / N: with N = 4 a phasor has the variance of a sample


def band(model: MachineModel, count: int) -> np.ndarray:
    """Lines around all modes, rad/s."""
    squares = np.linalg.eigvals(np.linalg.solve(model.mass_matrix, model.stiffness_matrix))
    modes = np.sqrt(np.sort(np.abs(squares))[len(model.axes) :])
    low, high = (modes[0], modes[-1]) if modes.size else (10.0, 50.0)
    return np.linspace(0.3 * low, 1.4 * high, count)


def noise_of(shape: tuple[int, ...], size: float, rng: np.random.Generator) -> np.ndarray:
    return size * (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


def experiments(
    model: MachineModel, omega: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[list[Phasors], list[np.ndarray]]:
    """Noisy phasors, and the true torques."""
    G, axes = machine_response(model, omega), len(model.axes)
    found, torques = [], []
    variance = np.diag([POSITION**2] * axes + [TORQUE**2] * axes).astype(complex)
    for e in range(count):
        torque = np.exp(2j * np.pi * rng.random((omega.size, axes)))
        position = np.einsum("fij,fj->fi", G, torque)
        torques.append(torque)
        found.append(
            Phasors(
                f"e{e}", model.names, model.names, (), omega / (2 * np.pi),
                position + noise_of(position.shape, POSITION, rng),
                torque + noise_of(torque.shape, TORQUE, rng),
                np.broadcast_to(variance, (omega.size, 2 * axes, 2 * axes)).copy(),
            )
        )  # fmt: skip
    return found, torques


def wrong(model: MachineModel, rng: np.random.Generator, share: float = 0.15) -> MachineModel:
    def off(values: Sequence[Estimate]) -> tuple[Estimate, ...]:
        return tuple(Estimate(v.value * float(np.exp(share * rng.normal()))) for v in values)

    axes = tuple(
        replace(a, masses=off(a.masses), springs=off(a.springs), dampers=off(a.dampers))
        for a in model.axes
    )
    return replace(model, axes=axes)


def fitted(start: MachineModel, phasors: list[Phasors]) -> RefinedModel:
    omega = frequencies_of(phasors)
    found = refine(
        start, joint_spectra(phasors, machine_response(start, omega)),
        fit_delay=True, fit_friction=True,
    )  # fmt: skip
    for _ in range(2):
        data = joint_spectra(phasors, machine_response(found.model, omega))
        found = refine(found.model, data, fit_delay=True, fit_friction=True)
    return found


def test_errors_of_the_true_machine_are_white(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    model = random_model(fresh_rng, (2, 3, 1))
    omega = band(model, 150)
    phasors, _ = experiments(model, omega, 4, fresh_rng)
    data = joint_spectra(phasors, machine_response(model, omega))
    residuals = data.residuals(machine_response(model, omega))
    assert residuals.size == data.count == 2 * 150 * 4 * 3
    assert 0.9 < np.mean(residuals**2) < 1.1
    jacobian = data.jacobian(np.ones((150, 3, 3, 1), complex))
    shifted = data.residuals(machine_response(model, omega) + 1e-9)
    np.testing.assert_allclose(shifted - residuals, 1e-9 * jacobian[:, 0], atol=1e-7)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_experiments_are_enough_with_a_model_to_begin_from(
    random_model: RandomModel, fresh_rng: np.random.Generator, count: int
) -> None:
    model = random_model(fresh_rng, (2, 2, 1))
    phasors, _ = experiments(model, band(model, 80), count, fresh_rng)
    found = fitted(wrong(model, fresh_rng, 0.08), phasors)
    assert found.chi2 / found.degrees_of_freedom < 1.6
    for axis, true in zip(found.model.axes, model.axes, strict=True):
        for value, wanted in zip(
            (*axis.masses, *axis.springs), (*true.masses, *true.springs), strict=True
        ):
            assert abs(value.value - wanted.value) < 6 * value.std + 1e-9


def test_the_fit_reaches_the_accuracy_that_was_expected(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    model = random_model(fresh_rng, (3, 2))
    omega = band(model, 60)
    phasors, torques = experiments(model, omega, 2, fresh_rng)
    found = fitted(wrong(model, fresh_rng, 0.05), phasors)
    plan = [Excitation(omega, torque, SAMPLES) for torque in torques]
    noise = Noise(np.full(2, TORQUE), np.full(2, POSITION))
    expected = expected_accuracy(model, plan, noise)
    by_name = dict(zip((p.name for p in expected.parameters), expected.std.tolist(), strict=True))
    reported = dict(zip(found.names, np.sqrt(np.diag(found.covariance)).tolist(), strict=True))
    assert set(by_name) == set(reported)
    for name, std in by_name.items():  # excess of chi2 widens the reported ones a little
        assert 0.85 < reported[name] / std < 1.35, name


def test_four_times_the_samples_halve_the_errors(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    model = random_model(fresh_rng, (2, 2))
    omega = band(model, 50)
    torque = np.exp(2j * np.pi * fresh_rng.random((50, 2)))

    def expect(samples: int, size: float) -> Expected:
        plan = [Excitation(omega, size * torque, samples)]
        return expected_accuracy(model, plan, Noise(np.full(2, 0.1), np.full(2, 1e-7)))

    one, longer, stronger = expect(1000, 1.0), expect(4000, 1.0), expect(1000, 2.0)
    np.testing.assert_allclose(longer.std, one.std / 2, rtol=1e-6)
    np.testing.assert_allclose(stronger.std, one.std / 2, rtol=1e-6)
    assert sum(w.sum() for w in one.worth) == pytest.approx(len(one.parameters), rel=1e-6)


def test_what_is_not_excited_is_not_expected(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    coupled = random_model(fresh_rng, (2, 2))
    model = replace(coupled, couplings=())
    omega = band(coupled, 40)
    torque = np.zeros((40, 2), complex)
    torque[:, 0] = 1.0  # the second axis rests
    noise = Noise(np.full(2, 0.1), np.full(2, 1e-7))
    found = expected_accuracy(model, [Excitation(omega, torque, 100)], noise)
    for parameter, std in zip(found.parameters, found.std, strict=True):
        assert np.isinf(std) == (parameter.axis == 1), parameter.name
    assert found.relative("mass") == np.inf
    with pytest.raises(ValueError, match="at least one experiment"):
        expected_accuracy(model, [], noise)


def test_no_experiment_is_refused(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    model = random_model(fresh_rng, (2,))
    with pytest.raises(NotEnoughDataError, match="no experiment"):
        joint_spectra([], machine_response(model, np.array([1.0])))


def test_the_band_of_a_model_is_the_scatter_of_machines_drawn_from_it(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    model = random_model(fresh_rng, (2, 1))
    phasors, _ = experiments(model, band(model, 40), 2, fresh_rng)
    found = fitted(model, phasors)
    omega = band(model, 7)
    claimed = relative_std(found, omega)
    from fieldtool.identify.likelihood.parameters import (
        machine_parameters,
        parameter_values,
        with_values,
    )

    every = machine_parameters(found.model, omega)
    delays = [d.value for d in found.delays]
    centre = parameter_values(found.model, every, delays)
    place = [[p.name for p in every].index(name) for name in found.names]
    drawn = []
    for values in fresh_rng.multivariate_normal(found.values, found.covariance, 600):
        changed = centre.copy()
        changed[place] = values
        machine, lag = with_values(found.model, every, changed)
        drawn.append(np.log(np.abs(machine_response(machine, omega, lag))))
    scatter = np.std(drawn, axis=0)
    np.testing.assert_allclose(claimed, scatter, rtol=0.25)
