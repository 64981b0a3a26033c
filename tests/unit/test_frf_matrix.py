"""Responses from phasors: a machine with known matrices must come out again."""

from dataclasses import replace

import numpy as np
import pytest

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.matrix import (
    OTHERS_FREE,
    OTHERS_LOCKED,
    SOLVED,
    column_responses,
    condition_of,
    solved_response,
)
from fieldtool.frf.phasors import Phasors
from fieldtool.frf.stepped.responses import stepped_responses
from fieldtool.records.recording import AxisInfo, Experiment, Recording, Segment
from tests.seeds import fresh_seed

AXES = ("a", "b", "c")
FREQUENCIES = np.array([1.0, 2.5, 4.0])


def compliance(frequencies: np.ndarray = FREQUENCIES) -> np.ndarray:
    """G (F, 3, 3) of three masses with friction, springs between them."""
    M = np.diag([1.0, 2.0, 3.0])
    K = np.array([[200.0, -200, 0], [-200, 500, -300], [0, -300, 300]])
    s = 2j * np.pi * frequencies[:, None, None]
    return np.linalg.inv(s * s * M + s * (0.002 * K + 0.5 * np.eye(3)) + K)


def experiment(
    driven: str,
    free: tuple[str, ...],
    lock: complex | None = None,
    noise: float = 0.0,
    seed: int = 0,
) -> Phasors:
    """Drive one axis with torque 1; a held axis has torque -lock * position (None: rigid)."""
    rng = np.random.default_rng(seed)
    held = [AXES.index(x) for x in AXES if x != driven and x not in free]
    j = AXES.index(driven)
    position, torque = [], []
    for G in compliance():
        tau = np.zeros(3, dtype=complex)
        tau[j] = 1.0
        if held:
            A = G[np.ix_(held, held)]
            if lock is not None:
                A = A + np.eye(len(held)) / lock
            tau[held] = -np.linalg.solve(A, G[held, j])
        position.append(G @ tau)
        torque.append(tau)
    theta, tau_ = np.array(position), np.array(torque)
    std_p, std_t = noise * np.abs(theta).max(), noise
    shape = theta.shape

    def error(std: float) -> np.ndarray:
        return std * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))

    covariance = np.diag([2 * std_p**2] * 3 + [2 * std_t**2] * 3).astype(complex)
    return Phasors(
        f"{driven} driven, {free} free", AXES, (driven,), free, FREQUENCIES,
        theta + error(std_p), tau_ + error(std_t),
        np.broadcast_to(covariance, (FREQUENCIES.size, 6, 6)),
    )  # fmt: skip


def others(axis: str) -> tuple[str, ...]:
    return tuple(x for x in AXES if x != axis)


def test_conditions_have_names() -> None:
    assert condition_of(experiment("a", ("b", "c"))) == OTHERS_FREE
    assert condition_of(experiment("a", ())) == OTHERS_LOCKED
    assert condition_of(experiment("c", ("a",))) == "a + c free, others locked"


def test_columns_with_others_free_are_the_compliance() -> None:
    found = column_responses([experiment(axis, others(axis)) for axis in AXES])
    assert list(found) == [OTHERS_FREE]
    np.testing.assert_allclose(found[OTHERS_FREE].response, compliance(), rtol=1e-10)
    assert found[OTHERS_FREE].measured.all()


def test_locked_responses_have_a_diagonal_only_and_pairs_four_elements() -> None:
    found = column_responses(
        [experiment("a", ()), experiment("b", ()), experiment("a", ("b",)), experiment("b", ("a",))]
    )
    locked, pair = found[OTHERS_LOCKED], found["a + b free, others locked"]
    assert locked.measured.any(axis=0).tolist() == np.diag([True, True, False]).tolist()
    f, response, _ = pair.element("b", "a")
    np.testing.assert_array_equal(f, FREQUENCIES)
    G = compliance()
    reduced = G - G[:, :, 2:3] @ G[:, 2:3, :] / G[:, 2:3, 2:3]
    np.testing.assert_allclose(response, reduced[:, 1, 0], rtol=1e-10)
    np.testing.assert_allclose(pair.element("a", "b")[1], reduced[:, 0, 1], rtol=1e-10)
    assert pair.measured.any(axis=0).sum() == 4


def test_axes_that_give_way_are_corrected_by_solving() -> None:
    soft = [experiment(axis, (), lock=500.0 + 30j) for axis in AXES]
    found = solved_response(soft)
    assert found.condition == SOLVED
    np.testing.assert_allclose(found.response, compliance(), rtol=1e-9)
    mixed = [experiment("a", ("b", "c")), experiment("b", (), 900.0), experiment("c", ("a",), 50j)]
    np.testing.assert_allclose(solved_response(mixed).response, compliance(), rtol=1e-9)


def test_too_few_or_dependent_experiments_are_refused() -> None:
    one = experiment("a", ("b", "c"))
    with pytest.raises(NotEnoughDataError, match="no frequency has 3 independent experiments"):
        solved_response([one, one, one])
    with pytest.raises(NotEnoughDataError, match="no experiment drives exactly one axis"):
        column_responses([])
    silent = replace(one, torque=np.zeros((3, 3), dtype=complex))
    with pytest.raises(NotEnoughDataError, match="axis a shows no torque at 1 Hz"):
        column_responses([silent])


@pytest.mark.parametrize("how", ["columns", "solved"])
def test_the_standard_error_is_the_scatter_of_repetitions(how: str) -> None:
    start = fresh_seed() // 2
    errors, claimed = [], []
    for repetition in range(200):
        seeds = [start + 3 * repetition + k for k in range(3)]
        if how == "columns":
            group = [
                experiment(x, others(x), noise=1e-3, seed=s)
                for x, s in zip(AXES, seeds, strict=True)
            ]
            found = column_responses(group)[OTHERS_FREE]
        else:
            group = [
                experiment(x, (), lock=400.0, noise=1e-3, seed=s)
                for x, s in zip(AXES, seeds, strict=True)
            ]
            found = solved_response(group)
        errors.append(found.response - compliance())
        claimed.append(found.std)
    true = np.sqrt(np.mean(np.abs(errors) ** 2, axis=0) / 2)
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(claimed), axis=0)), true, rtol=0.3)
    ratio = np.mean(np.square(claimed)) / np.mean(true**2)
    assert ratio == pytest.approx(1.0, abs=0.15)


def test_what_was_measured_twice_is_averaged_by_weight() -> None:
    exact = experiment("a", ("b", "c"), noise=1e-6)
    rough = replace(
        experiment("a", ("b", "c"), noise=1e-2, seed=5), frequencies=FREQUENCIES * (1 + 1e-9)
    )
    found = column_responses([exact, rough])[OTHERS_FREE]
    assert found.frequencies.size == 3
    np.testing.assert_allclose(
        found.element("a", "a")[1], exact.position[:, 0] / exact.torque[:, 0], rtol=1e-6
    )


def test_from_time_signals_to_the_response() -> None:
    """Stepped sines of a known response; also segments that had not settled are left out."""
    seed = fresh_seed()
    rng = np.random.default_rng(seed)
    period, frequencies = 0.004, np.array([0.9, 2.3, 5.1])
    G = compliance(frequencies)
    experiments = []
    for j, axis in enumerate(AXES):
        rows, segments, start = [], [], 0
        for k, f in enumerate(frequencies):
            n = round(10 / f / period)
            t = np.arange(n) * period
            turn = np.exp(2j * np.pi * f * t + 1j * rng.uniform(0, 6))
            tau = np.zeros((n, 3))
            tau[:, j] = turn.real
            rows.append(np.hstack([np.real(turn[:, None] * G[k, :, j]), tau]))
            segments += [Segment(start, start + n, f, 10)]
            start += n
            rows.append(rng.standard_normal((50, 6)))  # not settled: to be left out
            segments += [Segment(start, start + 50, 7.0, None, settled=False)]
            start += 50
        data = np.vstack(rows)
        data += 1e-5 * rng.standard_normal(data.shape)
        experiments.append(
            Experiment(
                axis,
                "stepped_sine",
                (axis,),
                others(axis),
                None,
                np.arange(start) * period,
                data[:, :3],
                data[:, 3:],
                segments=tuple(segments),
            )
        )
    recording = Recording(period, tuple(AxisInfo(a, "rotary") for a in AXES), tuple(experiments))
    result = stepped_responses(recording)
    found = result.responses[OTHERS_FREE]
    np.testing.assert_array_equal(found.frequencies, frequencies)
    assert np.all(np.abs(found.response - G) < 6 * np.sqrt(2) * found.std)
    assert np.median(found.std / np.abs(G)) < 1e-2
    np.testing.assert_allclose(solved_response(result.phasors).response, G, atol=3e-5)
    assert len(result.quality) == 9
    assert all(q.steady for q in result.quality)


def test_no_stepped_sine_is_said() -> None:
    with pytest.raises(NotEnoughDataError, match="no stepped-sine experiment with a settled"):
        stepped_responses(Recording(0.01, (AxisInfo("a", "rotary"),)))
