"""Powers that tell most: against known answers, a general solver, and what random powers reach."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from fieldtool.identify.best_input import best_powers, weighted_error
from tests.seeds import fresh_seed

STRONG = 1e3
"""Of the rows: what is known before is nothing beside it."""


def test_two_parameters_with_an_input_each() -> None:
    """Least a / sqrt(p) + b / sqrt(q) with p + q = 1: p / q is (a / b) to the power of 2/3."""
    rows = STRONG * np.eye(2).reshape(2, 1, 2)
    powers = best_powers(rows, np.array([8.0, 1.0]), np.ones((1, 2)))
    assert powers == pytest.approx([0.8, 0.2], rel=1e-3)


def test_a_line_that_tells_nothing_gets_nothing() -> None:
    rows = STRONG * np.array([[[1.0, 0.0]], [[0.0, 1.0]], [[0.0, 0.0]]])
    powers = best_powers(rows, np.ones(2), np.ones((1, 3)))
    assert powers[2] < 1e-3
    assert powers[:2] == pytest.approx([0.5, 0.5], rel=1e-2)


def test_inputs_of_limits_of_their_own_use_them_fully() -> None:
    rows = STRONG * np.eye(2).reshape(2, 1, 2)
    powers = best_powers(rows, np.array([5.0, 1.0]), np.diag([2.0, 0.5]))
    assert powers == pytest.approx([0.5, 2.0], rel=0.1)  # the smooth maximum leaves a little


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_no_random_powers_do_better(seed: int) -> None:
    rng = np.random.default_rng(seed)
    N, R, P, C = (int(rng.integers(*span)) for span in ((4, 12), (1, 4), (1, 4), (1, 4)))
    rows = STRONG * rng.standard_normal((N, R, P)) * rng.uniform(0.1, 3, (N, 1, 1))
    weights, loads = rng.uniform(0, 2, P) + 0.1, rng.uniform(0.1, 2, (C, N))
    best = best_powers(rows, weights, loads)
    assert np.max(loads @ best) == pytest.approx(1.0)
    reached = weighted_error(rows, weights, best)
    for _ in range(50):
        other = rng.exponential(1, N)
        other /= np.max(loads @ other)
        assert weighted_error(rows, weights, other) > 0.93 * reached


def test_a_general_solver_finds_hardly_more() -> None:
    rng = np.random.default_rng(fresh_seed())
    over = []
    for _ in range(7):
        rows = STRONG * rng.standard_normal((8, 2, 3))
        weights, loads = rng.uniform(0.5, 2, 3), rng.uniform(0.2, 2, (3, 8))
        best = weighted_error(rows, weights, best_powers(rows, weights, loads))
        over.append(best / generally(rows, weights, loads))
    assert np.median(over) < 1.01
    assert np.max(over) < 1.2


def generally(rows: np.ndarray, weights: np.ndarray, loads: np.ndarray) -> float:
    """Least error that sequential quadratic programming finds."""
    found = minimize(
        lambda p: 1e3 * weighted_error(rows, weights, np.maximum(p, 0)),
        0.5 / loads.max(axis=0) / rows.shape[0],
        method="SLSQP",
        bounds=[(0, None)] * rows.shape[0],
        constraints={"type": "ineq", "fun": lambda p: 1 - loads @ p},
        options={"maxiter": 500, "ftol": 1e-12},
    )
    powers = np.maximum(found.x, 0)
    return weighted_error(rows, weights, powers / max(1.0, np.max(loads @ powers)))
