"""The local polynomial method against machines stepped in time, open loop and closed."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import butter, lfilter

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.local import local_response
from fieldtool.records.model import MachineModel
from fieldtool.records.recording import AxisInfo, Experiment, Recording

STEP = 0.002


def _stepper(model: MachineModel):
    """Matrices of one step with held torques."""
    n, M = len(model.mass_matrix), len(model.axes)
    inverse = np.linalg.inv(model.mass_matrix)
    system = np.zeros((2 * n + M, 2 * n + M))
    system[:n, n : 2 * n] = np.eye(n)
    system[n : 2 * n, :n] = -inverse @ model.stiffness_matrix
    system[n : 2 * n, n : 2 * n] = -inverse @ model.damping_matrix
    system[n : 2 * n, 2 * n :] = inverse[:, model.first_masses]
    stepped = expm(system * STEP)
    return stepped[: 2 * n, : 2 * n], stepped[: 2 * n, 2 * n :]


def _sampled_response(model: MachineModel, frequencies):
    """Exact response of the stepped machine, (F, M, M)."""
    Ad, Bd = _stepper(model)
    z = np.exp(2j * np.pi * frequencies * STEP)[:, None, None]
    return np.linalg.solve(z * np.eye(len(Ad)) - Ad, np.broadcast_to(Bd, (z.shape[0], *Bd.shape)))[
        :, model.first_masses
    ]


def _record(model, rows, rng, *, torque=None, reference=None, noise=0.0, disturbance=0.0, name="e"):
    """Step the machine by torques, or with a stiff loop after a reference."""
    Ad, Bd = _stepper(model)
    M, first = len(model.axes), model.first_masses
    total = np.array([axis.total_mass for axis in model.axes])
    state = rng.normal(0.0, 1e-3, len(Ad))
    position, applied = np.zeros((rows, M)), np.zeros((rows, M))
    before = state[first].copy()
    for k in range(rows):
        position[k] = state[first] + noise * rng.normal(size=M)
        if reference is None:
            applied[k] = torque[k]
        else:
            velocity = (position[k] - before) / STEP
            applied[k] = total * 40.0 * (20.0 * (reference[k] - position[k]) - velocity)
            before = position[k].copy()
        state = Ad @ state + Bd @ (applied[k] + disturbance * rng.normal(size=M))
    return Experiment(
        name=name,
        kind="other",
        driven=model.names,
        free=(),
        period=None,
        time=np.arange(rows) * STEP,
        position=position,
        torque=applied,
        position_reference=reference,
    )


def _recording(model, *experiments):
    axes = tuple(
        AxisInfo(
            a.name,
            a.kind,
            torque_unit="N" if a.kind == "linear" else "N m",
            position_unit="m" if a.kind == "linear" else "rad",
        )
        for a in model.axes
    )
    return Recording(STEP, axes, experiments)


def _drift_free(rng, rows, axes, top):
    """Smooth random torques or references up to `top`, Hz."""
    b, a = butter(2, [0.5 * 2 * STEP, top * 2 * STEP], btype="band")
    return lfilter(b, a, rng.normal(size=(rows, axes)), axis=0)


@pytest.mark.parametrize("lengths", [(2,), (2, 1)])
@pytest.mark.parametrize("experiments", [1, 2])
def test_open_loop_errors_are_as_stated(lengths, experiments, fresh_rng, random_model):
    model = random_model(fresh_rng, lengths, friction=True)
    records = [
        _record(
            model,
            16000 + 2000 * k,
            fresh_rng,
            torque=20.0 * _drift_free(fresh_rng, 16000 + 2000 * k, len(lengths), 60.0),
            noise=3e-6,
            name=f"e{k}",
        )
        for k in range(experiments)
    ]
    found = local_response(_recording(model, *records))
    truth = _sampled_response(model, found.frequencies)
    used = found.frequencies > 3.0  # a band is narrow there, compared with the slow poles
    flat = (found.response - truth).reshape(truth.shape[0], -1)[used]
    white = np.linalg.solve(np.linalg.cholesky(found.covariance[used]), flat[..., None])
    size = np.mean(np.abs(white) ** 2, axis=(1, 2))
    assert used.sum() > 20
    assert np.median(size) < 2.0
    assert np.median(size) > 0.3


def test_bands_rise_and_do_not_crowd(fresh_rng, random_model):
    model = random_model(fresh_rng, (1,), friction=True)
    torque = 20.0 * _drift_free(fresh_rng, 12000, 1, 60.0)
    found = local_response(_recording(model, _record(model, 12000, fresh_rng, torque=torque)))
    assert np.all(np.diff(found.frequencies) >= 12.0 / (12000 * STEP))


def test_closed_loop_lines_without_excitation_are_left_out(fresh_rng, random_model):
    model = random_model(fresh_rng, (2,), friction=True)
    reference = _drift_free(fresh_rng, 16000, 1, 8.0)
    steep = butter(6, 10.0 * 2 * STEP)
    reference = lfilter(*steep, reference, axis=0)
    record = _record(model, 16000, fresh_rng, reference=reference, noise=1e-4, disturbance=1.0)
    found = local_response(_recording(model, record))
    truth = _sampled_response(model, found.frequencies)[:, 0, 0]
    apart = np.abs(found.response[:, 0, 0] - truth) / found.complex_std[:, 0, 0]
    assert found.frequencies.max() < 60.0  # the torque goes on up to 250 Hz: noise in the loop
    assert np.median(apart[found.frequencies > 3.0]) < 2.5


def test_a_reference_that_never_changes_is_named(fresh_rng, random_model):
    model = random_model(fresh_rng, (1, 1), friction=True)
    reference = _drift_free(fresh_rng, 8000, 2, 20.0)
    reference[:, 1] = 0.0
    record = _record(model, 8000, fresh_rng, reference=reference, noise=1e-5)
    with pytest.raises(NotEnoughDataError, match="axis2 never changes"):
        local_response(_recording(model, record))


def test_torques_in_a_fixed_ratio_are_refused(fresh_rng, random_model):
    model = random_model(fresh_rng, (1, 1), friction=True)
    torque = 20.0 * _drift_free(fresh_rng, 8000, 1, 60.0) * np.array([1.0, 0.5])
    with pytest.raises(NotEnoughDataError, match="record"):
        local_response(_recording(model, _record(model, 8000, fresh_rng, torque=torque)))


def test_a_short_record_is_refused(fresh_rng, random_model):
    model = random_model(fresh_rng, (1, 1), friction=True)
    torque = fresh_rng.normal(size=(40, 2))
    with pytest.raises(NotEnoughDataError, match="too short"):
        local_response(_recording(model, _record(model, 40, fresh_rng, torque=torque)))


def test_no_experiment_is_refused(fresh_rng, random_model):
    model = random_model(fresh_rng, (1,))
    with pytest.raises(NotEnoughDataError, match="no experiment"):
        local_response(_recording(model))
