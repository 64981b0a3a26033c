"""Locked and free responses from the matrix, against the machine with its motors really held."""

import numpy as np
import pytest

from fieldtool.frf.from_matrix import locked_response, locked_responses
from fieldtool.frf.matrix import OTHERS_FREE, OTHERS_LOCKED
from fieldtool.frf.response import FrequencyResponse


def held_machine(model, omega, free):
    """Response of the free motors, the other motors' rows and columns crossed out."""
    motors = model.first_masses
    held = [motors[k] for k in range(len(motors)) if k not in free]
    kept = [k for k in range(model.mass_matrix.shape[0]) if k not in held]
    places = [kept.index(motors[k]) for k in free]
    grid = np.ix_(kept, kept)
    mass, damping, stiffness = (
        matrix[grid] for matrix in (model.mass_matrix, model.damping_matrix, model.stiffness_matrix)
    )
    compliance = np.linalg.inv([stiffness + 1j * w * damping - w * w * mass for w in omega])
    return compliance[:, places][:, :, places]


def measured(model, rng, error=0.0):
    frequencies = np.linspace(0.7, 25.0, 40)
    omega = 2 * np.pi * frequencies
    M = len(model.axes)
    truth = held_machine(model, omega, range(M))
    size = np.abs(truth).reshape(len(omega), -1)
    mixing = rng.normal(size=(len(omega), M * M, M * M)) + 1j * rng.normal(
        size=(len(omega), M * M, M * M)
    )
    root = error * size[:, :, None] * (mixing / M + np.eye(M * M))
    covariance = root @ np.conj(np.swapaxes(root, 1, 2))
    std = np.sqrt(np.einsum("fkk->fk", covariance).real / 2).reshape(truth.shape)
    return FrequencyResponse(model.names, frequencies, truth, std, "solved", covariance), root


@pytest.mark.parametrize("free", [(0,), (2,), (0, 1), (1, 2), (0, 1, 2)])
def test_equals_the_machine_with_motors_held(fresh_rng, random_model, free):
    model = random_model(fresh_rng, (2, 3, 1))
    response, _ = measured(model, fresh_rng, 1e-6)
    found = locked_response(response, free)
    expected = held_machine(model, 2 * np.pi * response.frequencies, free)
    inside = np.ix_(range(40), free, free)
    assert np.allclose(
        found.response[inside], expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max()
    )
    assert np.count_nonzero(found.measured) == 40 * len(free) ** 2
    assert np.all(np.isfinite(found.covariance[found.measured.reshape(40, -1)].real).any(axis=1))


def test_errors_follow_the_full_covariance(fresh_rng, random_model):
    model = random_model(fresh_rng, (2, 2, 2))
    response, root = measured(model, fresh_rng, 1e-4)
    found = locked_response(response, ["axis1", "axis3"])
    inside = np.ix_(range(40), (0, 2), (0, 2))
    places = [0, 2, 6, 8]
    spread = found.covariance[np.ix_(range(40), places, places)]
    whiten = np.linalg.inv(np.linalg.cholesky(spread))
    powers = []
    for _ in range(60):
        noise = (fresh_rng.normal(size=(40, 9)) + 1j * fresh_rng.normal(size=(40, 9))) / np.sqrt(2)
        moved = response.response + np.einsum("fab,fb->fa", root, noise).reshape(40, 3, 3)
        other = FrequencyResponse(
            response.axes, response.frequencies, moved, response.std, "solved", response.covariance
        )
        error = (locked_response(other, [0, 2]).response - found.response)[inside].reshape(40, 4)
        powers.append(np.mean(np.abs(np.einsum("fab,fb->fa", whiten, error)) ** 2))
    assert 0.9 < np.mean(powers) < 1.1


def test_without_covariance_elements_count_as_independent(fresh_rng, random_model):
    response, _ = measured(random_model(fresh_rng, (2, 2)), fresh_rng, 1e-3)
    alone = FrequencyResponse(
        response.axes, response.frequencies, response.response, response.std, "solved"
    )
    found = locked_response(alone, 0)
    G, error = response.response, response.std
    side, back = -G[:, 0, 1] / G[:, 1, 1], -G[:, 1, 0] / G[:, 1, 1]
    expected = np.sqrt(
        error[:, 0, 0] ** 2
        + np.abs(side * error[:, 1, 0]) ** 2
        + np.abs(back * error[:, 0, 1]) ** 2
        + np.abs(side * back * error[:, 1, 1]) ** 2
    )
    assert np.allclose(found.std[:, 0, 0], expected, rtol=1e-9)


def test_all_conditions_have_the_names_of_the_sweeps(fresh_rng, random_model):
    response, _ = measured(random_model(fresh_rng, (1, 2, 2)), fresh_rng, 1e-3)
    found = locked_responses(response)
    pairs = [f"axis{a} + axis{b} free, {OTHERS_LOCKED}" for a, b in ((1, 2), (1, 3), (2, 3))]
    assert list(found) == [OTHERS_LOCKED, *pairs, OTHERS_FREE]
    assert all(one.condition == name for name, one in found.items())
    assert np.allclose(found[OTHERS_FREE].response, response.response)
    assert np.array_equal(np.any(found[OTHERS_LOCKED].measured, axis=0), np.eye(3, dtype=bool))
    assert list(locked_responses(measured(random_model(fresh_rng, (2,)), fresh_rng, 1e-3)[0])) == [
        OTHERS_FREE
    ]


def test_lines_that_are_not_whole_are_left_out(fresh_rng, random_model):
    response, _ = measured(random_model(fresh_rng, (1, 1)), fresh_rng, 1e-3)
    values, std = response.response.copy(), response.std.copy()
    values[3, 0, 1] = std[3, 0, 1] = np.nan
    part = FrequencyResponse(response.axes, response.frequencies, values, std, "solved")
    assert locked_response(part, 0).frequencies.size == 39


def test_moving_axes_are_named_once(fresh_rng, random_model):
    response, _ = measured(random_model(fresh_rng, (1, 1)), fresh_rng, 1e-3)
    with pytest.raises(KeyError, match="axis9"):
        locked_response(response, "axis9")
    with pytest.raises(ValueError, match="once"):
        locked_response(response, ["axis1", 0])
    with pytest.raises(ValueError, match="once"):
        locked_response(response, [])
