"""The torque that a measured motion needs: against closed loops, and against a general integrator."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fieldtool.criticise.simulate.inverse import HiddenSystem, dynamic_stiffness, needed_torque
from fieldtool.criticise.simulate.motion import motions_of
from fieldtool.criticise.simulate.structure import Element, Law, Structure
from fieldtool.records.closed_loop import AxisLoop, ClosedLoop
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from fieldtool.records.recording import AxisInfo, Experiment, Recording

STEP = 1e-3


def numbers(*values):
    return tuple(Estimate(v) for v in values)


def two_axes():
    return MachineModel(
        (
            AxisModel(
                "a", "rotary", numbers(0.02, 0.03), numbers(190.0), numbers(0.03), Estimate(0.02)
            ),
            AxisModel("b", "rotary", numbers(0.04), (), (), Estimate(0.015)),
        ),
        (Coupling(("a", "b"), 0.009),),
    )


def recorded(position, torque, names=("a", "b")):
    n = len(position)
    experiment = Experiment(
        "moves", "moves", tuple(names), (), None, STEP * np.arange(n), position, torque
    )
    return Recording(STEP, tuple(AxisInfo(name, "rotary") for name in names), (experiment,))


def motion_of(position, torque, names=("a", "b")):
    recording = recorded(position, torque, names)
    return motions_of(recording, recording.experiments, 40.0)[0]


def test_the_needed_torque_is_that_of_the_closed_loop_it_moved_in(fresh_rng):
    rng = fresh_rng
    sub, n = 32, 4000
    time = np.arange(n * sub) * STEP / sub
    reference = np.zeros((n * sub, 2))
    for axis in range(2):
        for frequency in rng.uniform(0.5, 20.0, 8):
            reference[:, axis] += 0.02 * np.sin(2 * np.pi * frequency * time + rng.uniform(0, 6))
    reference *= np.minimum(time / 0.5, 1.0)[:, None] ** 3
    model = two_axes()
    loops = (AxisLoop(15.0, 1.2, 8.0), AxisLoop(15.0, 1.2, 8.0))
    position, torque = ClosedLoop(model, loops).simulate(reference, STEP / sub)
    torque[1:] = (torque[1:] + torque[:-1]) / 2.0  # a reference bends at every row
    motion = motion_of(position[::sub], torque[::sub])
    needed = needed_torque(Structure.of(model), motion)
    inner = slice(20, -20)
    error = np.sqrt(np.mean((needed - motion.torque)[inner] ** 2, axis=0))
    assert np.all(error < 3e-3 * np.std(motion.torque, axis=0))


@pytest.mark.parametrize(
    ("law", "values"),
    [(Law.CUBIC, (4e4, 0.0, 0.0)), (Law.GAP, (190.0, 0.03, 0.004)), (Law.STEP, (60.0, 1.0, 0.0))],
)
def test_bent_springs_move_the_hidden_mass_as_a_general_integrator_says(law, values):
    model = MachineModel(
        (AxisModel("a", "rotary", numbers(0.02, 0.03), numbers(190.0), numbers(0.03)),)
    )
    structure = Structure.of(model).with_elements(Element(law, 0, 1, values))
    time = STEP * np.arange(2500)

    def motor(t):
        return 0.05 * np.sin(2 * np.pi * 7.0 * t) + 0.03 * np.sin(2 * np.pi * 3.1 * t)

    def motor_speed(t):
        return 0.05 * 2 * np.pi * 7.0 * np.cos(
            2 * np.pi * 7.0 * t
        ) + 0.03 * 2 * np.pi * 3.1 * np.cos(2 * np.pi * 3.1 * t)

    def spring(t, s, rate):
        if law == Law.CUBIC:
            return 190.0 * s + 4e4 * s**3 + 0.03 * rate
        if law == Law.GAP:
            beyond = np.sign(s) * max(abs(s) - 0.004, 0.0)
            return 190.0 * beyond + (0.03 * rate if beyond else 0.0)
        return (190.0 + (60.0 if t >= 1.0 else 0.0)) * s + 0.03 * rate

    def rates(t, x):
        return [x[1], -spring(t, x[0] - motor(t), x[1] - motor_speed(t)) / 0.03]

    reference = solve_ivp(
        rates, (0, time[-1]), [0.0, motor_speed(0.0)], t_eval=time, rtol=1e-8, atol=1e-10,
        max_step=2e-4,
    )  # fmt: skip
    motion = motion_of(motor(time)[:, None], np.zeros((time.size, 1)), ("a",))
    needed = needed_torque(structure, motion)[:, 0]
    load = np.gradient(reference.y[1], STEP)
    expected = 0.02 * motion.acceleration[:, 0] + 0.03 * load
    inner = slice(30, -30)
    error = np.sqrt(np.mean((needed - expected)[inner] ** 2))
    assert error < 0.02 * np.std(expected[inner])


def test_free_motions_are_what_an_initial_state_adds():
    structure = Structure.of(two_axes())
    system = HiddenSystem.of(structure)
    courses = system.free_torques(STEP, 400)
    assert courses.shape == (2, 400, 2)
    # A load that is one radian ahead pulls the motor with the spring.
    assert courses[0, 0, 0] == pytest.approx(-190.0)


def test_dynamic_stiffness_is_the_inverse_of_the_response(fresh_rng):
    model = two_axes()
    omega = fresh_rng.uniform(5.0, 200.0, 4)
    stiff = dynamic_stiffness(Structure.of(model), omega)
    motors = model.first_masses
    for w, z in zip(omega, stiff, strict=True):
        whole = model.stiffness_matrix + 1j * w * model.damping_matrix - w**2 * model.mass_matrix
        response = np.linalg.inv(whole)[np.ix_(motors, motors)]
        assert np.allclose(z @ response, np.eye(2), atol=1e-3)
