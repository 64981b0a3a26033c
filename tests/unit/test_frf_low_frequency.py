"""The apparent mass at low frequency is free of friction and of the first elasticity."""

import numpy as np
import pytest

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.low_frequency import dynamic_stiffness_low
from tests.seeds import fresh_seed

F = np.array([0.5, 0.7, 1.0, 1.4, 2.0, 2.5])
TOTAL = 5.0


def measured(
    seed: int, noise: float, friction: float, antiresonance: float = 6.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, torque, std of a two-mass axis with Coulomb-like friction in phase with speed."""
    rng = np.random.default_rng(seed)
    w = 2 * np.pi * F
    mass = 2.0 + 3.0 / (1 - (F / antiresonance) ** 2)
    position = 0.1 * np.exp(0.7j) * np.ones(F.size)
    torque = position * (-mass * w**2) + 1j * friction * position / np.abs(position)
    std = noise * np.abs(position / torque)
    error = std * (rng.standard_normal(F.size) + 1j * rng.standard_normal(F.size))
    return torque * (position / torque + error), torque, std


@pytest.mark.parametrize("friction", [0.0, 0.5, 3.0])
def test_mass_and_its_error(friction: float) -> None:
    start = fresh_seed() // 2
    z = []
    for seed in range(start, start + 200):
        position, torque, std = measured(seed, 3e-4, friction)
        found = dynamic_stiffness_low(F, position, torque, std)
        z.append((found.mass - TOTAL) / found.std)
    assert abs(np.mean(z)) < 0.8
    assert 0.3 < np.std(z) < 1.2
    assert found.mass == pytest.approx(TOTAL, rel=0.02)


def test_friction_is_seen_in_its_share() -> None:
    shares = [
        dynamic_stiffness_low(F, *measured(0, 1e-6, friction)).friction_share
        for friction in (0.0, 3.0)
    ]
    assert np.all(np.abs(shares[0]) < 1e-4)
    assert np.all(np.diff(shares[1]) < 0)
    assert shares[1][0] > 0.4


def test_the_degree_rises_with_the_elasticity() -> None:
    stiff = dynamic_stiffness_low(F, *measured(1, 1e-3, 0.1, antiresonance=500.0))
    soft = dynamic_stiffness_low(F, *measured(1, 1e-5, 0.1, antiresonance=6.0))
    assert stiff.degree == 0
    assert soft.degree == 3
    assert dynamic_stiffness_low(F, *measured(1, 1e-5, 0.1), degree=1).scatter > 10


def test_too_little_and_upside_down() -> None:
    position, torque, std = measured(0, 1e-3, 0.0)
    with pytest.raises(NotEnoughDataError, match="6 frequencies are too few"):
        dynamic_stiffness_low(F, position, torque, std, degree=6)
    with pytest.raises(NotEnoughDataError, match="disagree in sign"):
        dynamic_stiffness_low(F, position, -torque, std)
    with pytest.raises(ValueError, match="above 0"):
        dynamic_stiffness_low(F, position, torque, 0 * std)
    with pytest.raises(ValueError, match="one shape"):
        dynamic_stiffness_low(F[:3], position, torque, std)
    with pytest.raises(NotEnoughDataError, match="0 frequencies"):
        dynamic_stiffness_low(F[:0], position[:0], torque[:0], std[:0])
