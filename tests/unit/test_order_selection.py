"""The number of masses of every axis, on evidence; doubts where there are some."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh

from fieldtool.errors import IdentificationError, NotEnoughDataError
from fieldtool.identify.chains.order import select_order
from fieldtool.identify.likelihood.refine import machine_response
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes import fit as modal_fit
from fieldtool.identify.modes.poles import Poles
from fieldtool.identify.modes.search import _by_visibility, find_modes
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel


def frequencies(model):
    """Undamped, rad/s, rising."""
    lam = eigh(model.stiffness_matrix, model.mass_matrix, eigvals_only=True)[len(model.axes) :]
    return np.sqrt(np.abs(lam))


def with_noise(names, omega, exact, noise, rng):
    """Errors e = G dT of a torque that is measured with noise."""
    axes = len(names)
    parts = rng.standard_normal((2, *exact.shape))
    torque = noise * (parts[0] + 1j * parts[1]) / np.sqrt(2.0)
    outer = noise**2 * exact @ exact.conj().transpose(0, 2, 1)
    covariance = np.array([np.kron(each, np.eye(axes)) for each in outer])
    std = np.sqrt(np.einsum("fkk->fk", covariance).real).reshape(exact.shape)
    return ResponseMatrix(names, omega, exact + exact @ torque, std, covariance)


def measured(model, rng, noise=5e-4, lines=100, delays=None):
    w = frequencies(model)
    omega = np.linspace(0.3 * w.min(), 1.5 * w.max(), lines)
    return with_noise(model.names, omega, machine_response(model, omega, delays), noise, rng)


@pytest.mark.parametrize("lengths", [(3,), (3, 3, 3), (1, 3, 2), (2, 1, 4), (2, 1, 3, 2)])
def test_lengths_are_found_without_a_prior(lengths, random_model, fresh_rng):
    truth = random_model(fresh_rng, lengths, friction=True)
    found = select_order(measured(truth, fresh_rng), {a.name: a.kind for a in truth.axes})
    assert tuple(found.masses.values()) == lengths
    # once in a hundred times noise alone hints at one more mode
    assert not [doubt for doubt in found.doubts if "hint" not in doubt]
    assert found.refined.chi2 / found.refined.degrees_of_freedom < 1.3
    assert [a.kind for a in found.model.axes] == [a.kind for a in truth.axes]
    for axis, true in zip(found.model.axes, truth.axes, strict=True):
        for e, t in zip((*axis.masses, *axis.springs), (*true.masses, *true.springs), strict=True):
            assert e.value == pytest.approx(t.value, rel=0.02)
    if len(lengths) > 1:
        assert found.runner_up is not None
        assert found.runner_up.masses != lengths
        assert found.runner_up.difference > 30.0
        assert found.evidence[0].accepted


def test_two_axes_alone_can_not_tell_how_their_springs_are_split(random_model, fresh_rng):
    truth = random_model(fresh_rng, (3, 3))
    data = measured(truth, fresh_rng)
    found = select_order(data)
    assert sum(found.masses.values()) == 6
    assert any("can hardly tell the masses" in doubt for doubt in found.doubts)
    known = select_order(data, known={"axis1": 3})
    assert tuple(known.masses.values()) == (3, 3)
    assert not any("hardly tell" in doubt for doubt in known.doubts)
    assert tuple(select_order(data, prior=truth).masses.values()) == (3, 3)


def test_delays_are_found(random_model, fresh_rng):
    truth = random_model(fresh_rng, (2, 3, 2), friction=True)
    delays = np.array([1e-3, 2e-3, 1.5e-3])
    found = select_order(measured(truth, fresh_rng, delays=delays))
    assert tuple(found.masses.values()) == (2, 3, 2)
    np.testing.assert_allclose([d.value for d in found.refined.delays], delays, rtol=0.05)


def test_equal_axes_with_equal_modes(random_model, fresh_rng):
    one = random_model(fresh_rng, (3,), friction=True)
    twin = replace(one.axes[0], name="twin")
    truth = replace(one, axes=(one.axes[0], twin))
    found = select_order(measured(truth, fresh_rng), known={"axis1": 3})
    assert tuple(found.masses.values()) == (3, 3)


def test_a_mode_near_the_noise_is_named_as_a_doubt(fresh_rng, random_model):
    truth = random_model(fresh_rng, (3,), friction=True)
    masses = tuple(Estimate(m) for m in (6.0, 2.0, 0.2))
    truth = replace(truth, axes=(replace(truth.axes[0], masses=masses),))
    clear = find_modes(measured(truth, fresh_rng, 1e-4), 4).modal
    assert clear.omega.size == 2
    noise = 1e-4 * clear.significance.min() / 9.0
    doubted = 0
    for _ in range(20):
        found = select_order(measured(truth, fresh_rng, noise))
        doubted += any("Hz" in doubt for doubt in found.doubts)
        if found.masses["axis1"] == 3 and found.modal.significance.min() < 10.0:
            assert any("is in doubt" in doubt for doubt in found.doubts)
    assert doubted >= 3


def test_a_machine_that_is_none_is_refused(random_model, fresh_rng):
    truth = random_model(fresh_rng, (3, 3, 3), friction=True)
    w = frequencies(truth)
    omega = np.linspace(0.3 * w.min(), 1.5 * w.max(), 100)
    mass = truth.mass_matrix
    mass[1, 7] = mass[7, 1] = 0.3 * np.sqrt(mass[1, 1] * mass[7, 7])
    s = 1j * omega[:, None, None]
    whole = np.linalg.inv(s**2 * mass + s * truth.damping_matrix + truth.stiffness_matrix)
    motors = truth.first_masses
    data = with_noise(truth.names, omega, whole[:, motors][:, :, motors], 5e-4, fresh_rng)
    with pytest.raises(IdentificationError, match="closest are the masses") as refused:
        select_order(data)
    assert "Hz" in str(refused.value)


def test_known_lengths_that_do_not_fit_are_refused(random_model, fresh_rng):
    data = measured(random_model(fresh_rng, (3, 2, 2), friction=True), fresh_rng)
    with pytest.raises(IdentificationError, match="hold 4 modes"):
        select_order(data, known={"axis1": 2, "axis2": 2, "axis3": 2})
    with pytest.raises(ValueError, match="no axis z"):
        select_order(data, known={"z": 2})
    with pytest.raises(ValueError, match="at least one mass"):
        select_order(data, known={"axis1": 0})


def test_every_pair_must_be_measured(random_model, fresh_rng):
    data = measured(random_model(fresh_rng, (2, 2)), fresh_rng)
    response, std = data.response.copy(), data.std.copy()
    response[:, 0, 1] = response[:, 1, 0] = np.nan
    with pytest.raises(NotEnoughDataError, match="axis1 and axis2"):
        select_order(ResponseMatrix(data.names, data.omega, response, std))


def chain(name, masses, springs=(), dampers=(), friction=0.02):
    values = [tuple(Estimate(float(v)) for v in each) for each in (masses, springs, dampers)]
    return AxisModel(name, "rotary", *values, Estimate(friction))


def turntable(table, arm):
    return MachineModel((table, arm), (Coupling(("table", "arm"), 0.009),))


def seen_with(model, rng, omega, wrong=0.0, noise=1e-3):
    """Measured with noise; `wrong` is the share of a smooth error that no machine explains."""
    exact = machine_response(model, omega)
    data = with_noise(model.names, omega, exact, noise, rng)
    ripple = np.sin(9.0 * omega / omega.max() + rng.uniform(0.0, 6.0))[:, None, None]
    return replace(data, response=data.response + wrong * noise * ripple * exact)


def weights(order):
    return [m.value for axis in order.model.axes for m in axis.masses]


def test_motor_masses_of_the_prior_decide_where_the_responses_do_not(fresh_rng):
    table = chain("table", (0.02, 0.02, 0.03), (190, 600), (0.03, 0.03))
    truth = turntable(table, chain("arm", (0.04, 0.03), (250,), (0.03,)))
    prior = turntable(
        chain("table", (0.02, 0.025), (190,), (0.02,)), chain("arm", (0.04,), friction=0.01)
    )
    data = seen_with(truth, fresh_rng, 2 * np.pi * np.linspace(3.0, 50.0, 120), wrong=0.5)
    found = select_order(data, prior=prior)
    assert [axis.masses[0].value for axis in found.model.axes] == pytest.approx(
        [0.02, 0.04], rel=0.1
    )
    assert any("motor masses of the prior model decided" in doubt for doubt in found.doubts)
    found = select_order(data, prior=truth)
    assert tuple(found.masses.values()) == (3, 2)
    assert any("the prior model's lengths were taken" in doubt for doubt in found.doubts)
    assert weights(found) == pytest.approx([0.02, 0.02, 0.03, 0.04, 0.03], rel=0.1)
    found = select_order(data)
    assert any("most even masses and springs were taken" in doubt for doubt in found.doubts)


def test_a_joint_with_strong_damping_is_found_with_its_prior(fresh_rng):
    truth = turntable(chain("table", (0.02, 0.03), (190,), (1.0,)), chain("arm", (0.04,)))
    prior = turntable(
        chain("table", (0.02, 0.025), (190,), (0.02,), 0.01), chain("arm", (0.04,), friction=0.01)
    )
    prior = replace(prior, couplings=())
    data = seen_with(truth, fresh_rng, 2 * np.pi * np.linspace(2.0, 40.0, 120), wrong=1.0)
    found = select_order(data, prior=prior)
    assert tuple(found.masses.values()) == (2, 1)
    assert weights(found) == pytest.approx([0.02, 0.03, 0.04], rel=0.1)
    assert found.model.axes[0].springs[0].value == pytest.approx(190.0, rel=0.1)
    assert found.model.couplings[0].value == pytest.approx(0.009, rel=0.1)


def test_what_is_accepted_has_masses_and_springs_that_are_known(fresh_rng):
    table = chain("table", (0.02, 0.03), (190,), (1.0,))
    data = seen_with(
        turntable(table, chain("arm", (0.04,))), fresh_rng, 2 * np.pi * np.linspace(2.0, 40.0, 120)
    )
    long = turntable(chain("table", (0.02, 0.01, 0.02), (190, 1e5)), chain("arm", (0.04,)))
    try:
        found = select_order(data, prior=long)
    except IdentificationError:
        return
    for axis in found.model.axes:
        for each in (*axis.masses, *axis.springs):
            assert each.std < 0.5 * each.value


@pytest.mark.parametrize("with_prior", [True, False])
@pytest.mark.parametrize("wrong", [0.0, 1.0])
def test_rigid_axes_are_rigid(with_prior, wrong, fresh_rng):
    axes = [chain(n, (m,)) for n, m in (("table", 0.05), ("arm", 0.04), ("wrist", 0.04))]
    couplings = (Coupling(("table", "arm"), 0.009), Coupling(("arm", "wrist"), 0.006))
    truth = MachineModel(tuple(axes), couplings)
    data = seen_with(truth, fresh_rng, 2 * np.pi * np.linspace(1.0, 40.0, 120), wrong)
    found = select_order(data, prior=truth if with_prior else None)
    assert tuple(found.masses.values()) == (1, 1, 1)
    assert not [doubt for doubt in found.doubts if "is in doubt" in doubt]
    assert weights(found) == pytest.approx([0.05, 0.04, 0.04], rel=0.01)
    values = {c.axes: c.value for c in found.model.couplings}
    assert values["table", "arm"] == pytest.approx(0.009, rel=0.02)
    assert values["table", "wrist"] == pytest.approx(0.0, abs=2e-4)


@pytest.mark.parametrize(
    ("eigenvalues", "modes"),
    [((2.0, 1.0), 2), ((2.0, 0.1), 1), ((2.0, -1e9), 1), ((0.0, -1e9), 1), ((-1e9, -2e9), 1)],
)
@pytest.mark.parametrize("height", [4.0, 1e3])
def test_a_pole_that_pulls_where_it_should_push_is_one_mode(
    monkeypatch, eigenvalues, modes, height
):
    """Such residues are of noise."""
    omega = np.geomspace(1.0, 100.0, 20)
    data = ResponseMatrix(("a", "b"), omega, np.ones((20, 2, 2), complex), np.ones((20, 2, 2)))
    found = Poles(np.array([-0.1 + 10.0j]), np.zeros(0))
    residues = np.diag(eigenvalues)[:, :, None]
    monkeypatch.setattr(modal_fit, "pole_residues", lambda *_: residues)
    monkeypatch.setattr(modal_fit, "visibility", lambda *_: np.array([height]))
    poles = _by_visibility(data, found, np.zeros(2))
    assert poles.tolist() == [-0.1 + 10.0j] * (modes if height > 100 else 1)
