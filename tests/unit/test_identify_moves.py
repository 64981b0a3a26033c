"""Machines identified from moves: simulated ones with known answers, and a real axis."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from fieldtool.errors import NotEnoughDataError
from fieldtool.identify.likelihood.least_squares import standard_errors
from fieldtool.identify.likelihood.parameters import machine_parameters, parameter_values
from fieldtool.identify.moves.identify import identify_moves
from fieldtool.records.csv_folder import read_folder
from fieldtool.records.model import Estimate, MachineModel
from fieldtool.records.recording import AxisInfo, Controller, Experiment, Recording

STEP = 0.001


def _moves(rows, axes, rng, count=16):
    """Smooth moves to random places, each axis at its own times."""
    time = np.arange(rows) * STEP
    columns = np.zeros((rows, axes))
    for j in range(axes):
        at, places = 0.0, rng.uniform(-1.0, 1.0, count)
        for start, place in zip(
            np.sort(rng.uniform(0.1, rows * STEP - 0.4, count)), places, strict=True
        ):
            s = np.clip((time - start) / rng.uniform(0.1, 0.3), 0.0, 1.0)
            columns[:, j] += (place - at) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
            at = place
    return columns


def _record(model: MachineModel, reference, rng, *, coulomb=0.0, offset=0.0, name="moves", delay=0):
    """Step the machine with a position and velocity loop; friction acts within the step."""
    n, first, M = len(model.mass_matrix), model.first_masses, len(model.axes)
    inverse, inner = np.linalg.inv(model.mass_matrix), 4
    system = np.zeros((2 * n + M, 2 * n + M))
    system[:n, n : 2 * n] = np.eye(n)
    system[n : 2 * n, :n] = -inverse @ model.stiffness_matrix
    system[n : 2 * n, n : 2 * n] = -inverse @ model.damping_matrix
    system[n : 2 * n, 2 * n :] = inverse[:, first]
    stepped = expm(system * STEP / inner)
    total = np.array([axis.total_mass for axis in model.axes])
    state, before = np.zeros(2 * n), np.zeros(M)
    rows = reference.shape[0]
    position, torque = np.zeros((rows, M)), np.zeros((rows, M))
    forward = np.gradient(reference, axis=0) / STEP
    for k in range(rows):
        position[k] = state[first] + 2e-6 * rng.normal(size=M)
        velocity = (position[k] - before) / STEP
        before = position[k]
        torque[k] = total * 40.0 * (15.0 * (reference[k] - position[k]) + forward[k] - velocity)
        acting = torque[max(k - delay, 0)] - offset
        for _ in range(inner):
            rub = coulomb * np.tanh(state[n + first] / 0.02)
            state = stepped[: 2 * n, : 2 * n] @ state + stepped[: 2 * n, 2 * n :] @ (acting - rub)
    return Experiment(
        name=name,
        kind="moves",
        driven=model.names,
        free=(),
        period=None,
        time=np.arange(rows) * STEP,
        position=position,
        torque=torque + 0.02 * rng.normal(size=torque.shape),
        position_reference=reference,
    )


def _recording(model, *experiments, **settings):
    axes = tuple(
        AxisInfo(
            a.name,
            a.kind,
            len(a.masses),
            torque_unit="N" if a.kind == "linear" else "N m",
            position_unit="m" if a.kind == "linear" else "rad",
            **settings,
        )
        for a in model.axes
    )
    return Recording(STEP, axes, experiments)


def _lengths(model):
    return {axis.name: len(axis.masses) for axis in model.axes}


def _apart(found, model, **known):
    """Error over standard error of all that is known, by name."""
    listed = machine_parameters(model, np.array([1.0, 2.0]))
    values = parameter_values(model, listed, [STEP / 2] * len(model.axes))
    truth = dict(zip([p.name for p in listed], values, strict=True)) | known
    std = standard_errors(found.refined.covariance)
    return {
        name: (value - truth[name]) / error
        for name, value, error in zip(found.refined.names, found.refined.values, std, strict=True)
        if name in truth
    }


def _relative(found, model):
    """Largest relative error of masses and springs."""
    return max(
        abs(a.value / b.value - 1.0)
        for one, other in zip(found.model.axes, model.axes, strict=True)
        for a, b in zip(one.masses + one.springs, other.masses + other.springs, strict=True)
    )


TRUE = {"axis1.delay": 1.5 * STEP, "axis1.torque_offset": 1.0, "axis1.coulomb_friction": 4.0}


def test_a_rigid_axis_with_friction(fresh_rng, random_model):
    model = random_model(fresh_rng, (1,), friction=False)
    model = replace(model, axes=(replace(model.axes[0], viscous_friction=Estimate(3.0)),))
    record = _record(
        model, _moves(10000, 1, fresh_rng), fresh_rng, coulomb=4.0, offset=1.0, delay=1
    )
    found = identify_moves(_recording(model, record), _lengths(model))
    assert _relative(found, model) < 0.01
    by_name = dict(zip(found.refined.names, found.refined.values, strict=True))
    assert by_name["axis1.coulomb_friction"] == pytest.approx(4.0, rel=0.35)  # 1 % of the torque
    assert by_name["axis1.torque_offset"] == pytest.approx(1.0, abs=0.3)
    assert by_name["axis1.delay"] == pytest.approx(1.5 * STEP, abs=0.4 * STEP)
    apart = _apart(found, model, **TRUE)
    assert max(abs(v) for v in apart.values()) < 8.0, apart
    effects = {effect["effect"]: effect["parameters"] for effect in found.model.effects}
    assert effects["coulomb_friction"]["torque"]["value"] == by_name["axis1.coulomb_friction"]
    assert effects["coulomb_friction"]["torque"]["unit"] == "N m"
    assert effects["measurement_delay"]["delay"]["unit"] == "s"
    assert MachineModel.from_dict(found.model.as_dict()).names == model.names


def test_elastic_axes_without_a_prior_model(fresh_rng, random_model):
    model = random_model(fresh_rng, (2, 1), friction=False)
    record = _record(model, _moves(16000, 2, fresh_rng, count=20), fresh_rng)
    found = identify_moves(_recording(model, record), _lengths(model))
    assert _relative(found, model) < 0.01
    assert found.response is not None
    assert not any(name.endswith("coulomb_friction") for name in found.refined.names)
    apart = _apart(found, model)
    assert max(abs(v) for v in apart.values()) < 8.0, apart


def test_a_prior_model_serves_as_start(fresh_rng, random_model):
    model = random_model(fresh_rng, (2,), friction=False)
    prior = replace(
        model,
        axes=(
            replace(
                model.axes[0],
                masses=tuple(Estimate(1.15 * m.value) for m in model.axes[0].masses),
                springs=tuple(Estimate(1.1 * k.value) for k in model.axes[0].springs),
                dampers=(),
            ),
        ),
    )
    record = _record(model, _moves(10000, 1, fresh_rng), fresh_rng)
    found = identify_moves(_recording(model, record), _lengths(model), prior=prior)
    assert found.response is None
    assert _relative(found, model) < 0.01


def test_two_records_of_different_length(fresh_rng, random_model):
    model = random_model(fresh_rng, (1,), friction=False)
    records = [
        _record(model, _moves(rows, 1, fresh_rng), fresh_rng, name=f"moves{rows}")
        for rows in (6000, 7000)
    ]
    found = identify_moves(_recording(model, *records), _lengths(model))
    assert found.experiments == ("moves6000", "moves7000")
    assert _relative(found, model) < 0.01


def test_nothing_moves(fresh_rng, random_model):
    model = random_model(fresh_rng, (1,))
    record = _record(model, np.zeros((2000, 1)), fresh_rng)
    with pytest.raises(NotEnoughDataError, match="never moves"):
        identify_moves(_recording(model, record), _lengths(model))


def test_a_blocked_axis(fresh_rng, random_model):
    model = random_model(fresh_rng, (1,))
    record = _record(model, _moves(2000, 1, fresh_rng), fresh_rng)
    still = replace(record, position=np.full((2000, 1), 0.3))
    with pytest.raises(NotEnoughDataError, match="never moves"):
        identify_moves(_recording(model, still), _lengths(model))


def test_a_short_record(fresh_rng, random_model):
    model = random_model(fresh_rng, (1,))
    record = _record(model, _moves(2000, 1, fresh_rng)[:150], fresh_rng)
    with pytest.raises(NotEnoughDataError, match="150 rows"):
        identify_moves(_recording(model, record), _lengths(model))


@pytest.mark.parametrize("known", [True, False])
def test_a_torque_at_its_limit(known, fresh_rng, random_model):
    model = random_model(fresh_rng, (1,), friction=False)
    record = _record(model, _moves(4000, 1, fresh_rng), fresh_rng)
    limit = float(np.quantile(np.abs(record.torque), 0.8))
    clipped = replace(record, torque=np.clip(record.torque, -limit, limit))
    settings = {"controller": Controller(15.0, 80.0, 0.0, limit)} if known else {}
    with pytest.raises(NotEnoughDataError, match="at its limit"):
        identify_moves(_recording(model, clipped, **settings), _lengths(model))


def test_a_torque_of_the_wrong_sign(fresh_rng, random_model):
    model = random_model(fresh_rng, (1,), friction=False)
    record = _record(model, _moves(4000, 1, fresh_rng), fresh_rng)
    turned = replace(record, torque=-record.torque)
    with pytest.raises(NotEnoughDataError, match="sign"):
        identify_moves(_recording(model, turned), _lengths(model))


def test_a_prior_of_other_axes(fresh_rng, random_model):
    model = random_model(fresh_rng, (1,), friction=False)
    record = _record(model, _moves(4000, 1, fresh_rng), fresh_rng)
    other = replace(model, axes=(replace(model.axes[0], name="other"),))
    with pytest.raises(NotEnoughDataError, match="prior model"):
        identify_moves(_recording(model, record), _lengths(model), prior=other)


def _emps():
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    folder = Path(os.environ.get("FIELDTOOL_DATA", beside)) / "emps"
    if not folder.is_dir():
        pytest.skip("no real measurements beside the project; set FIELDTOOL_DATA")
    return read_folder(folder)


def test_a_real_axis_agrees_with_its_published_figures():
    found = identify_moves(_emps(), {"carriage": 1})
    std = dict(zip(found.refined.names, standard_errors(found.refined.covariance), strict=True))
    value = dict(zip(found.refined.names, found.refined.values, strict=True))
    published = {
        "carriage.mass[1]": 95.1089,
        "carriage.viscous_friction": 203.50,
        "carriage.coulomb_friction": 20.39,
        "carriage.torque_offset": -3.165,
        "carriage.delay": 0.70e-3,
    }
    for name, expected in published.items():
        assert abs(value[name] - expected) < 1.96 * std[name], name
        assert std[name] < (0.005 if name.endswith("]") else 0.3) * abs(value[name]), name
    assert found.left[0] < 0.042  # 4.083 % published


def test_halves_of_a_real_record_agree():
    recording = _emps()
    whole = recording.experiments[0]
    halves = []
    for part in (slice(0, whole.samples // 2), slice(whole.samples // 2, None)):
        half = replace(
            whole,
            time=whole.time[part],
            position=whole.position[part],
            torque=whole.torque[part],
            position_reference=None,
        )
        halves.append(identify_moves(replace(recording, experiments=(half,)), {"carriage": 1}))
    one, other = (half.refined for half in halves)
    std = np.hypot(standard_errors(one.covariance), standard_errors(other.covariance))
    assert np.max(np.abs(one.values - other.values) / std) < 3.0
