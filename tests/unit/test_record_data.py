"""Spectra of whole records: free motion explains transients, and what is left is noise."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.linalg import eigh

from fieldtool.frf.held_targets import LINEAR_TARGETS, folded_phasors, folds
from fieldtool.frf.multisine.matrix import joint_response
from fieldtool.identify.likelihood.least_squares import standard_errors
from fieldtool.identify.likelihood.parameters import (
    machine_parameters,
    parameter_values,
    with_values,
)
from fieldtool.identify.likelihood.record_data import RecordData
from fieldtool.identify.likelihood.record_spectrum import Spectrum, spectrum_of
from fieldtool.identify.likelihood.refine import RefinedModel, machine_response, refine
from fieldtool.identify.modes.scan import noise_limit
from fieldtool.identify.multisine.sliding import HARMONICS, directions
from fieldtool.identify.multisine.whole_records import WholeRecords
from fieldtool.records.closed_loop import AxisLoop, Biquad, ClosedLoop
from fieldtool.records.model import Estimate, MachineModel
from fieldtool.records.recorded import AxisInfo, Controller, Experiment, Recording

STEP, FINE = 0.002, 16
TORQUE, POSITION = 0.02, 3e-7
PERIOD = 1.5


@dataclass
class Shaken:
    """A machine under its loops, shaken from rest, without noise."""

    model: MachineModel
    recording: Recording


def shaken(rng, model, *, count=2, periods=2, settle=0.2, drift=0.0, late=0):
    """Multisines of all axes from rest; torques are recorded `late` fine steps after they acted."""
    rows = round((settle + periods * PERIOD) / STEP) * FINE
    time = (np.arange(rows) - round(settle / STEP) * FINE) * STEP / FINE
    lines = np.arange(1, 40, 2)
    waves = np.exp(2j * np.pi * np.outer(time, lines / PERIOD))
    loops = tuple(
        AxisLoop(rng.uniform(5, 9), axis.total_mass * rng.uniform(10, 20), rng.uniform(5, 50), 0.0)
        for axis in model.axes
    )
    experiments = []
    for number in range(count):
        phases = np.exp(2j * np.pi * rng.random((lines.size, len(loops))))
        size = 0.01 / np.maximum(lines / PERIOD, 2)[:, None]
        reference = np.real(waves @ (phases * size)) + drift * (time - time[0])[:, None]
        position, torque = ClosedLoop(model, loops).simulate(reference, STEP / FINE)
        torque = np.roll(torque, late, axis=0)
        torque[:late] = torque[late]
        experiments.append(
            Experiment(
                f"m{number + 1}", "multisine", model.names, (), PERIOD,
                np.arange(rows // FINE) * STEP, position[::FINE].copy(), torque[::FINE].copy(),
                position_reference=reference[::FINE].copy(),
            )
        )  # fmt: skip
    axes = tuple(AxisInfo(axis.name, "rotary") for axis in model.axes)
    return Shaken(model, Recording(STEP, axes, tuple(experiments)))


def with_noise(recording, rng):
    experiments = tuple(
        replace(
            one,
            position=one.position + POSITION * rng.normal(size=one.position.shape),
            torque=one.torque + TORQUE * rng.normal(size=one.torque.shape),
        )
        for one in recording.experiments
    )
    return replace(recording, experiments=experiments)


def known_noise(model: MachineModel, one: Spectrum, rows: int) -> np.ndarray:
    """Covariance of the equation error of white noise: 4 s^2 / N an amplitude."""
    G = machine_response(model, one.omega)
    torque, position = 4 * TORQUE**2 / rows, 4 * POSITION**2 / rows
    return torque * G @ G.conj().transpose(0, 2, 1) + position * np.eye(G.shape[1])


def data_of(recording: Recording, model: MachineModel, top: float = 26.0) -> RecordData:
    spectra = []
    for one in recording.experiments:
        bins = np.arange(1, int(top * (one.samples - 1) * STEP))
        spectra.append(spectrum_of(one.position, one.torque, STEP, bins))
    rows = recording.experiments[0].samples
    noise = tuple(known_noise(model, one, rows) for one in spectra)
    return RecordData(model.names, tuple(spectra), noise)


@pytest.mark.parametrize("drift", [0.0, 0.5])
def test_transients_leave_nothing_at_the_true_machine(random_model, fresh_rng, drift):
    model = random_model(fresh_rng, (3, 2), friction=True)
    data = data_of(shaken(fresh_rng, model, drift=drift).recording, model)
    left = data.residuals(model, np.zeros(2))
    moved = [np.linalg.norm(one.position, axis=1) for one in data.spectra]
    noise = [np.sqrt(np.einsum("fii->f", c).real) for c in data.covariance]
    clear = np.median(np.concatenate(moved) / np.concatenate(noise))
    assert np.sqrt(np.mean(left**2)) < 2e-4 * clear
    heavier = replace(
        model.axes[0], masses=tuple(replace(m, value=m.value * 1.01) for m in model.axes[0].masses)
    )
    wrong = replace(model, axes=(heavier, *model.axes[1:]))
    assert np.linalg.norm(data.residuals(wrong, np.zeros(2))) > 20 * np.linalg.norm(left)


def test_a_delayed_torque_is_explained_by_its_delay(random_model, fresh_rng):
    model = random_model(fresh_rng, (2, 2))
    data = data_of(shaken(fresh_rng, model, late=10).recording, model)
    delay = np.full(2, -10 * STEP / FINE)  # recorded after it acted
    explained, not_explained = (
        np.linalg.norm(data.residuals(model, d)) for d in (delay, np.zeros(2))
    )
    assert explained < 0.02 * not_explained


def test_derivatives_are_those_of_the_residuals(random_model, fresh_rng):
    """At the true machine, where what the states do besides is second order."""
    model = random_model(fresh_rng, (3, 1, 2), friction=True)
    data = data_of(shaken(fresh_rng, model).recording, model)
    parameters, delays = machine_parameters(model, data.omega), [1e-5, 0.0, -2e-5]
    values = parameter_values(model, parameters, delays)
    analytic = data.jacobian(model, np.array(delays), parameters)
    for k, p in enumerate(parameters):
        change = 1e-5 * (abs(values[k]) or p.scale)
        ends = []
        for sign in (1.0, -1.0):
            moved = values.copy()
            moved[k] += sign * change
            ends.append(data.residuals(*with_values(model, parameters, moved)))
        numeric = (ends[0] - ends[1]) / (2 * change)
        error = np.linalg.norm(numeric - analytic[:, k])
        assert error < 0.02 * np.linalg.norm(analytic[:, k]), p.name


def as_found(model: MachineModel) -> RefinedModel:
    """The machine as if a fit had found it."""
    axes = len(model.axes)
    none = np.zeros(0)
    zero = tuple(a.viscous_friction for a in model.axes)
    return RefinedModel(
        model, (replace(zero[0], value=0.0),) * axes, (), none, np.zeros((0, 0)), 0.0, 1, ()
    )


def test_intervals_are_honest_and_noise_is_found_between_the_lines(random_model, fresh_rng):
    model = random_model(fresh_rng, (2, 2))
    truth = shaken(fresh_rng, model, periods=3)
    pulls, ratios = [], []
    for _ in range(24):
        recording = with_noise(truth.recording, fresh_rng)
        records = WholeRecords(recording, joint_response(recording).lines, np.zeros(2))
        data = records.data(as_found(model), run_in=True)
        rows = recording.experiments[0].samples - 1
        for one, covariance in zip(data.spectra, data.covariance, strict=True):
            power = np.einsum("fii->fi", covariance).real
            ratios.append(power / np.einsum("fii->fi", known_noise(model, one, rows)).real)
        found = refine(model, data, fit_delay=True)
        values = parameter_values(model, machine_parameters(model, data.omega), [0.0, 0.0])
        named = dict(
            zip((p.name for p in machine_parameters(model, data.omega)), values, strict=True)
        )
        error = found.values - np.array([named[name] for name in found.names])
        pulls.append(error / standard_errors(found.covariance))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.12)
    assert 0.75 < np.sqrt(np.mean(np.square(pulls))) < 1.3


def test_periods_without_a_run_in_serve_as_well(random_model, fresh_rng):
    """Nothing before the first period: the row after the last one follows from the period before."""
    model = random_model(fresh_rng, (2, 1))
    truth = shaken(fresh_rng, model, settle=0.0).recording
    records = WholeRecords(truth, joint_response(with_noise(truth, fresh_rng)).lines, np.zeros(2))
    for run_in in (True, False):
        data = records.data(as_found(model), run_in=run_in)
        assert data.spectra[0].duration == pytest.approx(2 * PERIOD)
        found = refine(model, data)
        for one, other in zip(found.model.axes, model.axes, strict=True):
            for a, b in zip(one.masses, other.masses, strict=True):
                assert abs(a.value - b.value) < 5 * a.std + 1e-3 * b.value


def test_a_machine_that_has_settled_is_taken_to_be_settled(random_model, fresh_rng):
    """Then the states at the ends cost nothing; from rest they are free."""
    model = random_model(fresh_rng, (2, 1), friction=True)
    whole = shaken(fresh_rng, model, periods=16, count=2).recording
    keep, whole = 3 * round(PERIOD / STEP), with_noise(whole, fresh_rng)
    late = [cut(one, slice(-keep, None)) for one in whole.experiments]
    early = [cut(one, slice(0, keep)) for one in whole.experiments]
    for experiments in (late, early):
        recording = replace(whole, experiments=tuple(experiments))
        records = WholeRecords(recording, joint_response(recording).lines, np.zeros(2))
        data = records.data(as_found(model), run_in=True)
        assert data.spread is not None
        for spread in data.spread:
            if experiments is early:
                assert spread is None or np.linalg.norm(spread) > 1e-3
            else:  # a lightly damped machine may swing a little yet
                assert spread is not None
                assert np.linalg.norm(spread) < 1e-3
        found = refine(model, data, fit_friction=True)
        for one, other in zip(found.model.axes, model.axes, strict=True):
            for a, b in zip(one.masses, other.masses, strict=True):
                assert abs(a.value - b.value) < 5 * a.std + 1e-4 * b.value
        free = experiments is early or any(np.any(spread) for spread in data.spread)
        assert data.eliminated(model) == (2 * 2 * 3 if free else 0)


def cut(one, rows):
    """Some rows of an experiment, its time from 0."""
    return replace(
        one,
        time=one.time[rows] - one.time[rows][0],
        position=one.position[rows],
        torque=one.torque[rows],
        position_reference=one.position_reference[rows],
    )


def test_directions_of_a_whole_record(fresh_rng):
    time = np.arange(3000) * STEP
    rates, phases = np.array([0.7, 1.9, 3.3]), fresh_rng.uniform(0, 6.0, 3)
    angle = 2 * np.pi * np.outer(time, rates) + phases
    position = (np.sin(angle) / rates).sum(axis=1) + 0.3 * time
    velocity = 2 * np.pi * np.cos(angle).sum(axis=1) + 0.3
    noisy = position + 1e-5 * fresh_rng.normal(size=time.size)
    one = Experiment("m", "other", ("x",), (), None, time, noisy[:, None], 0 * noisy[:, None])
    signs = directions(one, STEP, 3.3, np.zeros(1))[:, 0]
    clear = np.abs(velocity) > 0.02 * np.abs(velocity).max()
    end = int(1 / (HARMONICS * 3.3 * STEP))  # a period of the fastest that is kept
    assert np.mean(signs != np.sign(velocity)) < 0.02
    clear[:end] = clear[-end:] = False
    assert np.array_equal(signs[clear], np.sign(velocity[clear]))


def test_folded_images_row_by_row_are_those_of_phasors(fresh_rng):
    rate, phase = 6.0, fresh_rng.uniform(0, 6.0)
    time = np.arange(1000) * STEP
    reference = 0.01 * np.cos(2 * np.pi * rate * time + phase)[:, None]
    zero = np.zeros_like(reference)
    one = Experiment(
        "m", "multisine", ("x",), (), 0.5, time, zero, zero, position_reference=reference
    )
    axes = (AxisInfo("x", "rotary", controller=Controller(10.0, 8.0, 5.0, 100.0)),)
    recording = Recording(STEP, axes, (one,), source={LINEAR_TARGETS: "x=0.0003"})
    (fold,) = folds(recording)
    course = fold.course(reference[:, 0], fold.size)[500:]
    wave = np.exp(-2j * np.pi * rate * time[500:])
    expected = folded_phasors(
        recording, np.array([rate]), np.array([[0.01 * np.exp(1j * phase)]], complex)
    )[0, 0]
    assert 2 * np.mean(course * wave) == pytest.approx(expected, rel=2e-3)


def _bent(model, rng, filters, step, share=0.0):
    """A recording of a machine whose targets bend at every SYNC, a share of them in its torques."""
    period, settle = 1.0, 0.1
    rows = round((settle + 3 * period) / step)
    lines = np.arange(1, 30, 2)
    waves = np.exp(
        2j * np.pi * np.outer((np.arange(rows) - round(settle / step)) * step, lines / period)
    )
    gains = [(12.0, axis.total_mass * 25.0, 10.0) for axis in model.axes]
    loop = ClosedLoop(model, tuple(AxisLoop(*each, 0.0, filters=filters) for each in gains))
    axes = tuple(
        AxisInfo(axis.name, "rotary", controller=Controller(*each, 1e3))
        for axis, each in zip(model.axes, gains, strict=True)
    )
    lag = "?" if share else "0.00064"
    source = {LINEAR_TARGETS: " ".join(f"{name}={lag}" for name in model.names)}
    recording = Recording(step, axes, (), source=source)
    experiments = []
    for number in range(2):
        phases = np.exp(2j * np.pi * rng.random((lines.size, 2)))
        reference = np.real(waves @ (0.01 / np.maximum(lines, 3)[:, None] * phases))
        position, torque = loop.simulate(reference, step)
        sent = np.vstack([reference[1:], reference[-1:]])  # one SYNC before they are reached
        for fold in folds(recording):
            torque[:, fold.axis] += fold.course(sent[:, fold.axis], share)
        experiments.append(
            Experiment(
                f"m{number}", "multisine", model.names, (), period, np.arange(rows) * step,
                position + 1e-9 * rng.normal(size=position.shape),
                torque + 1e-5 * rng.normal(size=torque.shape), position_reference=sent,
            )
        )  # fmt: skip
    return replace(recording, experiments=tuple(experiments))


def test_a_current_loops_lag_biases_no_mass(random_model, fresh_rng):
    """Torques behind a low-pass: their share of the bends is fitted."""
    lag = Biquad.low_pass(500.0, 1.0)  # 0.64 ms at low frequencies
    wrong: list[list[float]] = [[], []]
    for _ in range(4):
        model = random_model(fresh_rng, (2, 1))
        recording = _bent(model, fresh_rng, (lag,), 0.004)
        records = WholeRecords(recording, joint_response(recording).lines, np.zeros(2))
        data = records.data(as_found(model), run_in=True)
        assert len(data.parts) == 2
        for errors, given in zip(wrong, (data, replace(data, parts=())), strict=True):
            found = refine(model, given, fit_delay=True).model
            pairs = zip(found.axes, model.axes, strict=True)
            errors += [a.total_mass / b.total_mass - 1.0 for a, b in pairs]
    print(wrong)
    with_parts, without = (np.linalg.norm(errors) for errors in wrong)
    assert with_parts < 0.9 * without  # about half of it; noise leaves it below 0.77 in 20000 draws


def test_a_share_that_nothing_is_known_of_is_found(random_model, fresh_rng):
    share = fresh_rng.uniform(-0.9, -0.2)  # beside the 1 that a loop without lag shows by itself
    model = random_model(fresh_rng, (2, 1))
    recording = _bent(model, fresh_rng, (), 0.002, share)
    records = WholeRecords(recording, joint_response(recording).lines, np.zeros(2))
    found = as_found(model)
    for _ in range(2):
        data = records.data(found, run_in=True)
        found = refine(found.model, data, fit_delay=True)
        records = records.sized(data, found)
    print(share, [size for _, size in records.folds])
    for fold, size in records.folds:
        assert fold.kind == "bends"
        assert size == pytest.approx(1.0 + share, abs=0.02)


def test_a_small_mode_shows_in_what_a_machine_without_it_leaves(random_model, fresh_rng):
    plain = random_model(fresh_rng, (2, 1), friction=True)
    plain = replace(plain, couplings=())
    axis, hertz = plain.axes[0], fresh_rng.uniform(9.0, 14.0)
    small = 0.03 * axis.masses[1].value
    spring = small * (2 * np.pi * hertz) ** 2
    longer = replace(
        axis,
        masses=(*axis.masses, Estimate(small)),
        springs=(*axis.springs, Estimate(spring)),
        dampers=(*axis.dampers, Estimate(0.02 * np.sqrt(small * spring))),
    )
    whole = replace(plain, axes=(longer, plain.axes[1]))
    recording = with_noise(shaken(fresh_rng, whole).recording, fresh_rng)
    omega = np.sqrt(eigh(whole.stiffness_matrix, whole.mass_matrix, eigvals_only=True)[2:])
    place = float(omega[np.argmin(np.abs(omega - 2 * np.pi * hertz))])
    gains = []
    for model in (plain, whole):
        data = data_of(recording, whole)
        found = refine(model, data, fit_friction=True, fit_load_friction=True, fit_delay=True)
        parameters = [p for p in machine_parameters(model, data.omega) if p.name in found.names]
        gains.append(data.gain_of_mode(found.model, found.delay_values, parameters, place, 0.01))
    noise = noise_limit(20, 2, 1e-6)
    assert gains[1] < noise < 3 * noise < gains[0]


def test_a_coupling_that_is_left_out_shows_in_what_is_left(random_model, fresh_rng):
    truth = random_model(fresh_rng, (2, 2), friction=True)
    recording = with_noise(shaken(fresh_rng, truth).recording, fresh_rng)
    data, gains = data_of(recording, truth), []
    for value in (0.0, truth.couplings[0].value):
        model = replace(truth, couplings=(replace(truth.couplings[0], value=value),))
        listed = machine_parameters(model, data.omega)
        (coupling,) = (p for p in listed if p.kind == "coupling")
        found = refine(
            model, data, fixed=[coupling.name], fit_friction=True, fit_load_friction=True
        )
        fitted = [p for p in listed if p.name in found.names]
        gains.append(data.gain_of_parameter(found.model, found.delay_values, fitted, coupling))
    assert gains[1] < 25 < 100 < gains[0]
