"""All chains at once: from modes to machines of any lengths, and what the structure tells."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh

from fieldtool.errors import NotAChainError, NotEnoughDataError
from fieldtool.identify.chains.block_lanczos import chain_rows
from fieldtool.identify.chains.block_reduction import reduce_blocks
from fieldtool.identify.modes.model import ModalModel, ModalParts
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel


def modes_of_matrices(names, mass, stiffness, motors, std=1e-5, damping=0.0):
    """Exact modes, known to relative errors `std`, as a fit gives them; damping of C = d K."""
    lam, shapes = eigh(stiffness, mass)
    axes, n = len(motors), lam.size - len(motors)
    parts = ModalParts(n, np.ones((axes, axes), bool), True, False, False)
    at_motors = shapes[motors]
    omega, phi = np.sqrt(lam[axes:]), at_motors[:, axes:]
    rigid = at_motors[:, :axes] @ at_motors[:, :axes].T
    size = np.sqrt(np.diag(rigid))
    i, j = parts.upper
    errors = (
        std
        * np.r_[
            omega,
            np.ones(n),
            np.repeat(size, n),
            np.repeat(size, n),
            size[i] * size[j],
        ]
    )
    return ModalModel(
        names,
        parts,
        omega,
        0.5 * damping * omega,
        phi,
        np.zeros_like(phi),
        rigid,
        np.zeros(axes),
        np.zeros(axes),
        np.diag(errors**2),
        1.0,
        1,
    )


def modes_of(model, std=1e-5, damping=0.0):
    return modes_of_matrices(
        model.names,
        model.mass_matrix,
        model.stiffness_matrix,
        list(model.first_masses),
        std,
        damping,
    )


def lengths_of(model):
    return {axis.name: len(axis.masses) for axis in model.axes}


def numbers(model):
    chains = [e for a in model.axes for e in (*a.masses, *a.springs)]
    return [*chains, *(Estimate(c.value, c.std) for c in model.couplings)]


def values(model):
    return np.array([e.value for e in numbers(model)])


def paper_machine():
    chains = [((0.7, 2, 3), (1e3, 2e3)), ((4, 5, 6), (3e3, 4e3)), ((7, 8, 9), (5e3, 6e3))]
    axes = tuple(
        AxisModel(
            f"b{k + 1}",
            "rotary",
            tuple(Estimate(float(m)) for m in masses),
            tuple(Estimate(float(s)) for s in springs),
        )
        for k, (masses, springs) in enumerate(chains)
    )
    pairs = (("b1", "b2", 1.0), ("b1", "b3", 2.0), ("b2", "b3", 3.0))
    return MachineModel(axes, tuple(Coupling((a, b), m) for a, b, m in pairs))


def test_paper_machine_with_its_couplings():
    truth = paper_machine()
    reduced = reduce_blocks(modes_of(truth), lengths_of(truth))
    np.testing.assert_allclose(values(reduced.model), values(truth), rtol=1e-11)
    assert reduced.notes == ()
    assert reduced.constraints == 12


def test_chains_of_any_lengths(random_model, fresh_rng):
    for _ in range(50):
        lengths = tuple(int(n) for n in fresh_rng.integers(1, 5, int(fresh_rng.integers(1, 5))))
        truth = random_model(fresh_rng, lengths, spread=0.7)
        reduced = reduce_blocks(modes_of(truth), lengths_of(truth))
        np.testing.assert_allclose(
            values(reduced.model), values(truth), rtol=1e-8, atol=1e-9, err_msg=str(lengths)
        )
        assert reduced.notes == ()


def test_a_motor_that_is_its_own_end_is_coupled_to_long_chains(random_model, fresh_rng):
    truth = random_model(fresh_rng, (1, 4, 1))
    lam, shapes = eigh(truth.stiffness_matrix, truth.mass_matrix)
    lam[:3] = 0.0
    rows = chain_rows(lam[None], shapes[truth.first_masses][None], (1, 4, 1))
    np.testing.assert_allclose(rows.mass_matrix[0], truth.mass_matrix, atol=1e-9)
    np.testing.assert_allclose(
        rows.stiffness_matrix(lam[None])[0], truth.stiffness_matrix, atol=1e-5
    )


def test_standard_errors_agree_with_disturbed_modes(random_model, fresh_rng):
    truth = random_model(fresh_rng, (3, 1, 2))
    std = 1e-5
    exact = modes_of(truth, std)
    expected = np.array([e.std for e in numbers(reduce_blocks(exact, lengths_of(truth)).model)])
    errors = np.sqrt(np.diag(exact.covariance))
    found = []
    for _ in range(120):
        x = exact.parameters + errors * fresh_rng.standard_normal(errors.size)
        at, n = exact.parts.slices, exact.omega.size
        rigid = np.empty((3, 3))
        i, j = exact.parts.upper
        rigid[i, j] = rigid[j, i] = x[at["rigid"]]
        moved = ModalModel(
            exact.names,
            exact.parts,
            x[at["omega"]],
            exact.zeta,
            x[at["phi"]].reshape(3, n),
            exact.chi,
            rigid,
            exact.friction,
            exact.delays,
            exact.covariance,
            1.0,
            1,
        )
        found.append(values(reduce_blocks(moved, lengths_of(truth)).model))
    ratio = np.std(found, axis=0) / expected
    assert ratio.min() > 0.65
    assert ratio.max() < 1.45


def test_dampers_from_the_damping_of_modes(random_model, fresh_rng):
    truth = random_model(fresh_rng, (3, 2))
    reduced = reduce_blocks(modes_of(truth, damping=5e-4), lengths_of(truth))
    for axis in reduced.model.axes:
        springs = np.array([k.value for k in axis.springs])
        np.testing.assert_allclose([d.value for d in axis.dampers], 5e-4 * springs, rtol=1e-6)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("one", "other"), [((0, 2), (2, 2)), ((0, 1), (1, 1)), ((1, 3), (2, 3))])
def test_an_inertia_between_inner_masses_is_named(one, other, sign, random_model, fresh_rng):
    truth = random_model(fresh_rng, (4, 4, 4))
    mass = truth.mass_matrix
    a, b = (4 * i + k - 1 for i, k in (one, other))
    mass[a, b] = mass[b, a] = sign * 0.2 * np.sqrt(mass[a, a] * mass[b, b])
    first = first_violation(truth, mass, truth.stiffness_matrix)
    assert first.kind == "inertia"
    assert set(first.places) == {(f"axis{i + 1}", k) for i, k in (one, other)}
    assert first.value == pytest.approx(sign * 0.2, rel=0.05)
    assert "a coupling in an unexpected place" in first.sentence


@pytest.mark.parametrize(("one", "other"), [((0, 2), (2, 2)), ((1, 1), (2, 1))])
def test_a_spring_between_inner_masses_is_named(one, other, random_model, fresh_rng):
    truth = random_model(fresh_rng, (3, 3, 3))
    stiffness = truth.stiffness_matrix
    a, b = (3 * i + k - 1 for i, k in (one, other))
    # moves that strain the chains as a rigid body does not, so that the rigid modes stay free
    x = np.zeros(9)
    x[[a, a + 1, b, b + 1]] = 1.0, -1.0, -1.0, 1.0
    stiffness = stiffness + 0.1 * stiffness[a, a] * np.outer(x, x)
    first = first_violation(truth, truth.mass_matrix, stiffness)
    assert first.kind == "spring"
    assert set(first.places) == {(f"axis{i + 1}", k) for i, k in (one, other)}


def first_violation(truth, mass, stiffness):
    modal = modes_of_matrices(truth.names, mass, stiffness, list(truth.first_masses))
    try:
        reduced = reduce_blocks(modal, lengths_of(truth))
    except NotAChainError as error:
        pytest.fail(f"not even a machine: {error}")
    assert reduced.misfit > 1000.0 * reduced.constraints
    assert reduced.notes
    return next(t for t in reduced.structure if t.significant)


def test_noise_raises_no_false_alarm(random_model, fresh_rng):
    truth = random_model(fresh_rng, (3, 2, 2))
    reduced = reduce_blocks(modes_of(truth, std=1e-3), lengths_of(truth))
    assert not any(t.significant for t in reduced.structure)
    assert all(t.std > 0.0 for t in reduced.structure)


def test_wrong_lengths_show(random_model, fresh_rng):
    truth = random_model(fresh_rng, (2, 3, 3))
    try:
        reduced = reduce_blocks(modes_of(truth), {"axis1": 3, "axis2": 2, "axis3": 3})
    except NotAChainError:
        return
    assert reduced.notes
    assert reduced.misfit > 1000.0 * reduced.constraints


def test_what_is_wrong_with_the_question_is_said(random_model, fresh_rng):
    truth = random_model(fresh_rng, (2, 3))
    modal = modes_of(truth)
    with pytest.raises(ValueError, match="axis2"):
        reduce_blocks(modal, {"axis1": 2})
    with pytest.raises(ValueError, match="have 4 modes, 3 were fitted"):
        reduce_blocks(modal, {"axis1": 3, "axis2": 3})
    pairs = np.eye(2, dtype=bool)
    parts = ModalParts(3, pairs, True, False, False)
    half = ModalModel(
        modal.names,
        parts,
        modal.omega,
        modal.zeta,
        modal.phi,
        modal.chi,
        modal.rigid,
        modal.friction,
        modal.delays,
        np.eye(parts.count),
        1.0,
        1,
    )
    with pytest.raises(NotEnoughDataError, match="axis1 and axis2"):
        reduce_blocks(half, {"axis1": 2, "axis2": 3})


@pytest.mark.parametrize("friction", [1e100, 1e200])
def test_what_a_fit_gone_astray_says_is_not_known(friction):
    truth = paper_machine()
    astray = replace(modes_of(truth), friction=np.array([friction, 0.0, 0.0]))
    result = reduce_blocks(astray, lengths_of(truth))
    assert all(np.isinf(e.std) for e in numbers(result.model))
    assert np.isinf(result.misfit)


@pytest.mark.parametrize("seen", [0.0, 1e-200, 1e-100])
def test_a_mode_without_what_is_in_phase_is_no_machine_of_chains(seen):
    truth = paper_machine()
    modal = modes_of(truth)
    phi, chi = modal.phi.copy(), np.zeros_like(modal.phi)
    phi[:, 2] *= seen
    chi[:, 2] = 0.1
    assert reduce_blocks(replace(modal, phi=phi, chi=chi), lengths_of(truth)).misfit > 1e6
