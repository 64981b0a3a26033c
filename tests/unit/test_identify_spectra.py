"""Fits to spectra of whole records against machines stepped in time with known answers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import butter, lfilter

from fieldtool.errors import NotEnoughDataError
from fieldtool.identify.likelihood.least_squares import standard_errors
from fieldtool.identify.likelihood.parameters import machine_parameters, parameter_values
from fieldtool.identify.moves.spectra import Spectra, TorquePart, refine_spectra, torque_residuals
from fieldtool.records.model import Estimate, MachineModel

STEP, ROWS, TOP = 0.001, 6000, 30.0
POSITION_NOISE, TORQUE_NOISE = 2e-5, 0.3
OFFSETS = (1.5, -0.7)


def _positions(model: MachineModel, torque, rng):
    """Step the machine from a random state; torques are held."""
    n, first = len(model.mass_matrix), model.first_masses
    inverse = np.linalg.inv(model.mass_matrix)
    system = np.zeros((2 * n + len(first), 2 * n + len(first)))
    system[:n, n : 2 * n] = np.eye(n)
    system[n : 2 * n, :n] = -inverse @ model.stiffness_matrix
    system[n : 2 * n, n : 2 * n] = -inverse @ model.damping_matrix
    system[n : 2 * n, 2 * n :] = inverse[:, first]
    stepped = expm(system * STEP)
    state = rng.normal(0.0, 0.02, 2 * n)
    position = np.zeros(torque.shape)
    for k, one in enumerate(torque):
        position[k] = state[first]
        state = stepped[: 2 * n, : 2 * n] @ state + stepped[: 2 * n, 2 * n :] @ one
    return position


def _spectra(model, rng, experiments=1):
    """Random smooth torques of all axes; the recorded ones have an offset, and both are noisy."""
    M = len(model.axes)
    filtered = butter(2, 20.0 * 2 * STEP)
    acting = [
        20.0 * lfilter(*filtered, rng.normal(size=(ROWS, M)), axis=0) for _ in range(experiments)
    ]
    position = np.array([_positions(model, one, rng) for one in acting])
    position = position + POSITION_NOISE * rng.normal(size=position.shape)
    torque = np.array(acting) + OFFSETS[:M] + TORQUE_NOISE * rng.normal(size=position.shape)
    lines = np.arange(1, int(TOP * ROWS * STEP))
    spectrum = np.fft.rfft(torque, axis=1) / ROWS
    shape = (experiments, lines.size, M)
    parts = tuple(
        TorquePart(f"{name}.torque_offset", j, np.zeros(shape[:2], complex), np.ones(experiments))
        for j, name in enumerate(model.names)
    )
    return Spectra(
        names=model.names,
        sample_period=STEP,
        rows=ROWS,
        omega=2 * np.pi * lines / (ROWS * STEP),
        position=(np.fft.rfft(position, axis=1) / ROWS)[:, lines],
        torque=spectrum[:, lines],
        position_variance=np.full(shape, POSITION_NOISE**2 / ROWS),
        torque_variance=np.full(shape, TORQUE_NOISE**2 / ROWS),
        mean_torque=spectrum[:, 0].real,
        parts=parts,
    )


def _off(model, rng):
    """The same machine, every mass and spring up to 20 % off."""
    axes = tuple(
        replace(
            axis,
            masses=tuple(Estimate(m.value * rng.uniform(0.8, 1.2)) for m in axis.masses),
            springs=tuple(Estimate(k.value * rng.uniform(0.9, 1.1)) for k in axis.springs),
        )
        for axis in model.axes
    )
    return replace(model, axes=axes)


def _truth(model, found):
    listed = machine_parameters(model, np.array([1.0, 2.0]))
    values = parameter_values(model, listed, [STEP / 2] * len(model.axes))
    known = dict(zip([p.name for p in listed], values, strict=True))
    known |= {f"{n}.torque_offset": offset for n, offset in zip(model.names, OFFSETS, strict=False)}
    return np.array([known[name] for name in found.names])


@pytest.mark.parametrize("lengths", [(1,), (2,), (2, 1)])
def test_truth_lies_within_the_stated_errors(lengths, fresh_rng, random_model):
    model = random_model(fresh_rng, lengths, friction=True)
    spectra = _spectra(model, fresh_rng, experiments=2)
    found = refine_spectra(
        _off(model, fresh_rng),
        spectra,
        fit_delay=True,
        fit_friction=True,
        fit_load_friction=True,
    )
    apart = (found.values - _truth(model, found)) / standard_errors(found.covariance)
    assert np.max(np.abs(apart)) < 6.0, dict(zip(found.names, apart, strict=True))
    assert 0.7 < found.chi2 / found.degrees_of_freedom < 1.3
    known = standard_errors(found.covariance) / np.abs(found.values)
    assert known[found.names.index("axis1.mass[1]")] < 0.05


def test_errors_are_those_of_many_repetitions(fresh_rng, random_model):
    model = random_model(fresh_rng, (2,), friction=True)
    apart = []
    for _ in range(15):
        spectra = _spectra(model, fresh_rng)
        found = refine_spectra(model, spectra, fit_delay=True, fit_friction=True)
        apart.append((found.values - _truth(model, found)) / standard_errors(found.covariance))
    size = np.sqrt(np.mean(np.square(apart)))  # of 15 times 8 numbers
    assert 0.6 < size < 1.6


def test_robust_errors_agree_where_noise_is_as_stated(fresh_rng, random_model):
    model = random_model(fresh_rng, (2,), friction=True)
    spectra = _spectra(model, fresh_rng)
    plain = refine_spectra(model, spectra, fit_delay=True, fit_friction=True)
    robust = refine_spectra(model, spectra, fit_delay=True, fit_friction=True, robust=True)
    ratio = standard_errors(robust.covariance) / standard_errors(plain.covariance)
    assert np.allclose(robust.values, plain.values, rtol=1e-6)
    assert np.all(ratio > 0.999)
    assert np.median(ratio) < 2.0


def test_robust_errors_grow_with_a_disturbance_of_low_frequency(fresh_rng, random_model):
    model = random_model(fresh_rng, (1,), friction=True)
    spectra = _spectra(model, fresh_rng)
    slow = spectra.omega < 2 * np.pi * 5.0
    extra = fresh_rng.normal(size=(2, slow.sum())) * 10.0 * TORQUE_NOISE / np.sqrt(ROWS)
    torque = spectra.torque.copy()
    torque[0, slow, 0] += extra[0] + 1j * extra[1]
    disturbed = replace(spectra, torque=torque)
    plain = refine_spectra(model, disturbed, fit_friction=True, delays=[STEP / 2])
    robust = refine_spectra(model, disturbed, fit_friction=True, delays=[STEP / 2], robust=True)
    friction = plain.names.index("axis1.viscous_friction")
    grown = standard_errors(robust.covariance) / standard_errors(plain.covariance)
    assert grown[friction] > 1.2


def test_records_of_different_length_count_together(fresh_rng, random_model):
    model = random_model(fresh_rng, (2,), friction=True)
    one, other = _spectra(model, fresh_rng), _spectra(model, fresh_rng)
    alone = refine_spectra(model, one, fit_friction=True, delays=[STEP / 2])
    both = refine_spectra(model, [one, other], fit_friction=True, delays=[STEP / 2])
    assert np.all(standard_errors(both.covariance) < standard_errors(alone.covariance))


def test_a_prior_is_one_more_measurement(fresh_rng, random_model):
    model = random_model(fresh_rng, (2,), friction=True)
    spectra = _spectra(model, fresh_rng)
    mass = model.axes[0].masses[0].value
    sharp = {"axis1.mass[1]": Estimate(mass * 1.05, mass * 1e-7)}
    found = refine_spectra(model, spectra, priors=sharp, fit_delay=True, fit_friction=True)
    assert found.values[found.names.index("axis1.mass[1]")] == pytest.approx(mass * 1.05, rel=1e-3)
    with pytest.raises(ValueError, match="no parameter"):
        refine_spectra(model, spectra, priors={"axis1.mass[9]": Estimate(1.0, 1.0)})


def test_what_is_left_of_the_torque_is_its_noise(fresh_rng, random_model):
    model = random_model(fresh_rng, (1,), friction=True)
    spectra = _spectra(model, fresh_rng)
    found = refine_spectra(model, spectra, fit_delay=True, fit_friction=True)
    (left,) = torque_residuals(found, spectra)
    expected = spectra.torque_variance + left.from_position
    assert np.mean(np.abs(left.residual) ** 2 / expected) == pytest.approx(1.0, abs=0.5)


def test_a_spring_that_nothing_excites_is_called_unknown(fresh_rng, random_model):
    model = random_model(fresh_rng, (2,), friction=True)
    spectra = _spectra(model, fresh_rng)
    kept = spectra.omega < 2 * np.pi * 1.5
    low = replace(
        spectra,
        omega=spectra.omega[kept],
        position=spectra.position[:, kept],
        torque=spectra.torque[:, kept],
        position_variance=spectra.position_variance[:, kept],
        torque_variance=spectra.torque_variance[:, kept] * 100.0,
        parts=tuple(replace(p, spectrum=p.spectrum[:, kept]) for p in spectra.parts),
    )
    found = refine_spectra(model, low, delays=[STEP / 2])
    reasons = " ".join(one.reason for one in found.unknown)
    assert "axis1.damper[1]" in reasons
    assert "Hz" in reasons


def test_other_axes_and_too_little_data_are_refused(fresh_rng, random_model):
    model = random_model(fresh_rng, (2,), friction=True)
    spectra = _spectra(model, fresh_rng)
    with pytest.raises(ValueError, match="axes"):
        refine_spectra(model, replace(spectra, names=("other",)))
    few = replace(
        spectra,
        omega=spectra.omega[:3],
        position=spectra.position[:, :3],
        torque=spectra.torque[:, :3],
        position_variance=spectra.position_variance[:, :3],
        torque_variance=spectra.torque_variance[:, :3],
        parts=(),
    )
    with pytest.raises(NotEnoughDataError, match="measure longer"):
        refine_spectra(model, few)
    with pytest.raises(ValueError, match="torque must be finite"):
        replace(spectra, torque=spectra.torque * np.nan)
