"""The rule that a design begins with, by hand, and its margins by a Nyquist computation of its own."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh

from fieldtool.design.rule import (
    DesignError,
    lowest_antiresonance,
    rule,
    sensitivity_peak,
)
from fieldtool.design.servo import Servo
from fieldtool.design.tuning import AxisTuning, as_parameters
from fieldtool.records.closed_loop import AxisLoop, ClosedLoop, loop_from_parameters
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel

RandomModel = Callable[..., MachineModel]


def axis(
    masses: tuple[float, ...],
    springs: tuple[float, ...],
    dampers: tuple[float, ...],
    name: str = "x",
) -> AxisModel:
    return AxisModel(
        name,
        "rotary",
        tuple(Estimate(v) for v in masses),
        tuple(Estimate(v) for v in springs),
        tuple(Estimate(v) for v in dampers),
    )


def ruled(model: MachineModel) -> list[AxisTuning]:
    loops = rule(model)
    return [
        AxisTuning(a.name, as_parameters(Servo(loop)), sensitivity_peak(model, loops, k), "rule")
        for k, (a, loop) in enumerate(zip(model.axes, loops, strict=True))
    ]


def test_the_rule_by_hand_for_two_masses() -> None:
    """J = 5; w_a = sqrt(1200 / 3) = 20 rad/s; w_v = 14 rad/s."""
    model = MachineModel((axis((2.0, 3.0), (1200.0,), (2.0,)),))
    assert lowest_antiresonance(model.axes[0]) == pytest.approx(20.0)
    (tuned,) = ruled(model)
    found = dict(tuned.parameters)
    lowered = found["velocity_p"] / (5 * 14)
    steps = np.log(lowered) / np.log(0.85)
    assert steps == pytest.approx(round(steps), abs=1e-9)
    assert found["velocity_p"] == pytest.approx(5 * 14 * lowered)
    assert found["velocity_i"] == pytest.approx(5 * 14 * 14 / 4 * lowered**2)
    assert found["position_p"] == pytest.approx(14 / 4 * lowered)
    assert (found["velocity_ff"], found["inertia_ff"]) == (1.0, 5.0)
    assert (found["filter1_type"], found["filter2_type"]) == (0.0, 0.0)


def test_a_well_damped_stiff_axis_needs_no_lowering() -> None:
    """Load much lighter than the motor: the rule's numbers stand as they are."""
    model = MachineModel((axis((10.0, 0.1), (90.0,), (1.0,)),))
    (tuned,) = ruled(model)
    w = 0.7 * 30
    assert tuned.parameters["velocity_p"] == pytest.approx(10.1 * w)
    assert tuned.parameters["velocity_i"] == pytest.approx(10.1 * w * w / 4)
    assert tuned.parameters["position_p"] == pytest.approx(w / 4)


@pytest.mark.parametrize("stiff", [None, 1e9])
def test_a_rigid_or_very_stiff_axis_takes_the_fixed_bandwidth(stiff: float | None) -> None:
    one = axis((3.0,), (), ()) if stiff is None else axis((1.5, 1.5), (stiff,), (50.0,))
    (tuned,) = ruled(MachineModel((one,)))
    w = 2 * np.pi * 8
    assert tuned.parameters["velocity_p"] == pytest.approx(3 * w)
    assert tuned.parameters["position_p"] == pytest.approx(w / 4)
    # rigid: S = s^3 / (s^3 + w (s + w / 4)^2), whatever the mass
    s = 1j * w * np.geomspace(0.01, 100, 20_000)
    peak = np.abs(s**3 / (s**3 + w * (s + w / 4) ** 2)).max()
    assert tuned.sensitivity_peak == pytest.approx(peak, rel=2e-3)


def nyquist_distance(model: MachineModel, loops: list[AxisLoop], k: int) -> float:
    """Smallest distance of one axis' open loop from -1, the other loops closed.

    By modal sums instead of solving: undamped modes would not do with dampers, so the first-order
    form is diagonalised, with the other controllers in it as states.  The grid follows the poles.
    """
    m = len(loops)
    opened: list[AxisLoop | None] = [one if i != k else None for i, one in enumerate(loops)]
    A = ClosedLoop(model, tuple(opened)).system_matrix()
    n = model.mass_matrix.shape[0]
    b = np.zeros(A.shape[0])
    b[n : 2 * n] = np.linalg.inv(model.mass_matrix)[:, model.first_masses[k]]
    c = np.zeros(A.shape[0])
    c[model.first_masses[k]] = 1.0
    poles = np.linalg.eigvals(ClosedLoop(model, tuple(loops)).system_matrix())
    grid = [np.geomspace(np.abs(poles).min() / 10, np.abs(poles).max() * 10, 1500)]
    for pole in poles[poles.imag > 0]:
        around = np.abs(pole.imag) + np.linspace(-6, 6, 61) * max(-pole.real, 1e-9)
        grid.append(around[around > 0])
    loop, nearest = loops[k], np.inf
    assert m
    for w in np.concatenate(grid):
        s = 1j * w
        P = c @ np.linalg.solve(s * np.eye(A.shape[0]) - A, b)
        C = (loop.velocity_p + loop.velocity_i / s) * (loop.position_p + s)
        for f in loop.filters:
            num, den = np.polyval(f.numerator, s), np.polyval([1.0, *f.denominator], s)
            C *= num / den
        nearest = min(nearest, abs(1 + C * P))
    return float(nearest)


@pytest.mark.parametrize("lengths", [(1,), (2,), (4,), (2, 3), (1, 2), (3, 1, 2)], ids=str)
def test_margins_of_random_machines(
    lengths: tuple[int, ...], random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    model = random_model(fresh_rng, lengths, friction=bool(fresh_rng.integers(0, 2)))
    tuning = ruled(model)
    loops = [loop_from_parameters(one.parameters) for one in tuning]
    closed = ClosedLoop(model, tuple(loops))
    assert np.linalg.eigvals(closed.system_matrix()).real.max() < 0
    for k, tuned in enumerate(tuning):
        distance = nyquist_distance(model, loops, k)
        assert 1 / distance <= 2.0 * 1.01
        assert tuned.sensitivity_peak == pytest.approx(1 / distance, rel=0.03)
        bandwidth = tuned.parameters["velocity_p"] / model.axes[k].total_mass
        assert bandwidth <= 0.7 * lowest_antiresonance(model.axes[k]) * (1 + 1e-9)
        assert tuned.axis == model.axes[k].name


@pytest.mark.parametrize("fast", [1e3, 1e5, 1e7, 1e9])
def test_the_peak_is_found_far_below_the_modes(fast: float) -> None:
    """A rigid axis' loop is at 8 Hz, also where another axis' modes are far above."""
    model = MachineModel(
        (axis((3.0,), (), ()), axis((1.0, 1.0), (fast,), (1e-4 * fast,), "stiff")),
        (Coupling(("x", "stiff"), 0.3),),
    )
    w = 2 * np.pi * 8
    loops = [AxisLoop(w / 4, a.total_mass * w, a.total_mass * w * w / 4) for a in model.axes]
    for k in range(2):
        found = sensitivity_peak(model, loops, k)
        assert found == pytest.approx(1 / nyquist_distance(model, loops, k), rel=0.02)


def test_the_lowest_antiresonance_is_the_chain_with_its_motor_held() -> None:
    chain = axis((2.0, 3.0, 4.0), (500.0, 700.0), (0.1, 0.1))
    M, K = np.diag([3.0, 4.0]), np.array([[1200.0, -700.0], [-700.0, 700.0]])
    assert lowest_antiresonance(chain) == pytest.approx(np.sqrt(eigh(K, M, eigvals_only=True)[0]))
    assert lowest_antiresonance(axis((2.0,), (), ())) == np.inf


def test_parameters_are_the_loop_and_back() -> None:
    model = MachineModel((axis((2.0, 0.5), (5000.0,), (8.0,)),))
    tuning = ruled(model)
    for tuned in tuning:
        loop = loop_from_parameters(tuned.parameters)
        again = as_parameters(Servo(loop))
        assert set(again) == set(tuned.parameters)
        for name, value in again.items():
            assert value == pytest.approx(tuned.parameters[name])
    plain = as_parameters(Servo(AxisLoop(1.0, 2.0, 3.0)))
    assert plain["filter1_type"] == plain["filter2_type"] == 0.0
    assert loop_from_parameters(plain) == AxisLoop(1.0, 2.0, 3.0, 1.0, 0.0)


def test_a_machine_that_nothing_can_hold_is_refused() -> None:
    """A mass matrix that is not positive has motion that grows without a cause."""
    model = MachineModel(
        (axis((1.0, 1.0), (500.0,), (0.5,)), axis((1.0, 1.0), (700.0,), (0.5,), "y")),
        (Coupling(("x", "y"), 1.5),),
    )
    with pytest.raises(DesignError, match="Check the model"):
        ruled(model)
    negative = replace(model, couplings=())
    negative = replace(
        negative,
        axes=(axis((1.0, 1.0), (500.0,), (-60.0,)), negative.axes[1]),
    )
    with pytest.raises(DesignError, match="nothing is written"):
        ruled(negative)
