"""Sensitivities from sampled torques, against the known answer of a motor that is solved exactly.

Motor, loop, current loop and the stairs of the offset are integrated here by matrix exponentials in
continuous time; what is looked at sees only what a drive shows once a cycle.
"""

import numpy as np
import pytest
from scipy.linalg import expm

from fieldtool.design.measured import Excited, measured_sensitivity
from fieldtool.design.servo import Servo
from fieldtool.records.closed_loop import AxisLoop, Biquad

SAMPLES, STEP, CURRENT = 1000, 1e-3, 2 * np.pi * 1000.0
"""Cycles of a period, s, and rad/s of the current loop."""


def motor(inertia, position_p, velocity_p, velocity_i):
    """States q, v, integral, T; input: the torque that is added."""
    a = np.zeros((4, 4))
    a[0, 1] = 1.0
    a[1, 3] = 1 / inertia
    a[2, :2] = -position_p, -1.0
    a[3] = CURRENT * np.array(
        [-velocity_p * position_p, -velocity_p, velocity_i, -1.0],
    )
    return a, np.array([0.0, 0.0, 0.0, CURRENT])


def recorded(a, b, offset):
    """Return position and torque of a steady period, each sampled as the next offset takes effect."""
    whole = np.zeros((5, 5))
    whole[:4, :4], whole[:4, 4] = a, b
    held = expm(whole * STEP)
    eigen = np.linalg.matrix_power(held[:4, :4], SAMPLES)
    forced = np.zeros(4)
    for u in offset:
        forced = held[:4, :4] @ forced + held[:4, 4] * u
    x = np.linalg.solve(np.eye(4) - eigen, forced)
    rows = []
    for u in offset:
        rows.append(x)
        x = held[:4, :4] @ x + held[:4, 4] * u
    return np.array(rows)[:, 0], np.array(rows)[:, 3]


@pytest.mark.parametrize("stiffness", [30.0, 200.0, 500.0])
def test_the_steps_of_an_offset_do_not_pass_for_the_loop(fresh_rng, stiffness):
    """velocity_p over inertia, 1/s: the stiffer a loop, the more of what is sampled is not what acts."""
    inertia = float(np.exp(fresh_rng.uniform(np.log(1e-3), np.log(10.0))))
    velocity_p = stiffness * inertia
    position_p = stiffness * float(fresh_rng.uniform(0.05, 0.25))
    velocity_i = velocity_p * stiffness * float(fresh_rng.uniform(0.05, 0.2))
    a, b = motor(inertia, position_p, velocity_p, velocity_i)
    assert np.linalg.eigvals(a).real.max() < 0

    lines = np.unique(fresh_rng.integers(5, 80, 25)) * 2 + 1
    spectrum = np.zeros(SAMPLES // 2 + 1, dtype=complex)
    spectrum[lines] = np.exp(2j * np.pi * fresh_rng.uniform(size=lines.size))
    offset = np.fft.irfft(spectrum, SAMPLES)
    position, torque = recorded(a, b, offset)

    s = 2j * np.pi * lines / (SAMPLES * STEP)
    current = 1 / (1 + s / CURRENT)
    loop = current * (velocity_p + velocity_i / s) * (position_p + s) / (inertia * s**2)
    truth = np.abs(1 / (1 + loop))
    servo = Servo(AxisLoop(position_p, velocity_p, velocity_i))
    signals = Excited(lines, SAMPLES, STEP, position, torque, offset, 1 / CURRENT)
    found = measured_sensitivity(signals, servo)
    assert np.abs(found.size / (truth * np.abs(current)) - 1).max() < 0.03
    assert abs(found.peak / truth.max() - 1) < 0.03
    # what acts has the current loop's own response, which no offset shows without the loop's
    follows = np.abs(loop / (1 + loop))
    assert found.response is not None
    assert np.abs(found.response - follows).max() < 0.03 * max(1.0, follows.max())


def test_what_is_taken_off_passes_the_filters_at_its_own_frequency(fresh_rng):
    """All of it a notch far below, nothing of it a low-pass."""
    lines = np.arange(11, 160, 6)
    position, torque, offset = fresh_rng.normal(size=(3, SAMPLES))
    s = 2j * np.pi * lines / (SAMPLES * STEP)

    def taken_off(filters):
        """Torque, of what is looked at without its sampling and with it."""
        servo = Servo(AxisLoop(1.0, 1.0, 0.0, filters=filters))
        passed = np.ones_like(s)
        for one in filters:
            passed = passed * one.response(s)
        seen = [
            measured_sensitivity(
                Excited(lines, SAMPLES, STEP, position, torque, offset, lag), servo
            ).size
            for lag in (None, 2e-4)
        ]
        return np.abs(np.diff(seen, axis=0)[0] * passed)

    bare = taken_off(())
    assert bare.max() > 0.05
    assert np.allclose(taken_off((Biquad.notch(3.0, 0.1, 0.7),)), bare, rtol=0.05, atol=0.01)
    assert taken_off((Biquad.low_pass(10.0, 0.7),)).max() < 0.01 * bare.max()
