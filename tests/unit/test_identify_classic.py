"""The classic way on exact phasors of random machines, and what is said when a sweep is missing."""

from collections.abc import Callable
from itertools import combinations

import numpy as np
import pytest

from fieldtool.errors import NotEnoughDataError
from fieldtool.experiment.stepped.plan import tone_near
from fieldtool.frf.matrix import column_responses
from fieldtool.frf.phasors import Phasors
from fieldtool.frf.stepped.responses import SteppedResult
from fieldtool.identify.classic import held_gains, identify_classic, without_friction
from fieldtool.records.closed_loop import AxisLoop, ClosedLoop
from fieldtool.records.model import Estimate, MachineModel

RandomModel = Callable[..., MachineModel]
RELATIVE = 1e-6
"""Of the error that the phasors claim, and have."""


def modes(model: MachineModel) -> tuple[np.ndarray, list[np.ndarray]]:
    """Resonances, and antiresonances of each motor, Hz."""

    def hz(keep: list[int]) -> np.ndarray:
        at = np.ix_(keep, keep)
        squares = np.linalg.eigvals(
            np.linalg.solve(model.mass_matrix[at], model.stiffness_matrix[at])
        )
        found = np.sqrt(np.abs(squares)) / (2 * np.pi)
        return np.sort(found[found > 1e-2])

    every = list(range(model.mass_matrix.shape[0]))
    return hz(every), [hz([i for i in every if i != motor]) for motor in model.first_masses]


def phasors(
    model: MachineModel,
    driven: str,
    free: tuple[str, ...],
    frequencies: np.ndarray,
    rng: np.random.Generator,
) -> Phasors:
    loops = tuple(
        None
        if axis.name in free
        else AxisLoop(3.0, 12 * axis.total_mass, 36 * axis.total_mass, 0.0)
        for axis in model.axes
    )
    tones = [tone_near(float(f), 1.0, 0.002).frequency for f in frequencies]
    closed = ClosedLoop(model, loops)
    position, torque = closed.response(2 * np.pi * np.array(tones), model.names.index(driven))
    m = len(loops)
    values = np.hstack([position, torque])
    scale = np.hstack(
        [np.repeat(np.abs(v).max(axis=1, keepdims=True), m, axis=1) for v in (position, torque)]
    )
    error = RELATIVE * scale
    shape = values.shape
    values = values + error * (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)
    for k, loop in enumerate(loops):
        if loop is None:
            values[:, m + k] = 0.0
            error[:, m + k] = 0.0
    covariance = np.array([np.diag(row**2) for row in error]).astype(complex)
    return Phasors(
        f"{driven} {free}", model.names, (driven,), free, np.array(tones),
        values[:, :m], values[:, m:], covariance,
    )  # fmt: skip


def measured(model: MachineModel, rng: np.random.Generator) -> list[Phasors]:
    """All sweeps of the classic plan, on a grid of its own with points at the modes."""
    resonances, antiresonances = modes(model)
    every = np.concatenate([resonances, *antiresonances])
    low, high = (every.min(), every.max()) if every.size else (1.0, 2.0)
    names, found = model.names, []
    for k, name in enumerate(names):
        own = np.concatenate([resonances, antiresonances[k]])
        beside = np.concatenate([own * share for share in (0.996, 1.0, 1.004)])
        grid = np.unique(np.concatenate([np.geomspace(0.35 * low, 2.5 * high, 40), beside]))
        free = tuple(other for other in names if other != name)
        found.append(phasors(model, name, free, grid, rng))
    if len(names) > 1:
        grid = np.geomspace(0.18 * low, 0.42 * low, 8)
        found += [phasors(model, name, (), grid, rng) for name in names]
        found += [phasors(model, b, (a,), grid, rng) for a, b in combinations(names, 2)]
    return found


def stepped(found: list[Phasors]) -> SteppedResult:
    return SteppedResult(column_responses(found), tuple(found), ())


LENGTHS = [(1,), (2,), (4,), (1, 1), (2, 1), (1, 3), (2, 1, 2)]


@pytest.mark.parametrize("lengths", LENGTHS, ids=str)
def test_random_machines_come_back(
    lengths: tuple[int, ...], random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    model = random_model(fresh_rng, lengths)
    kinds = {axis.name: axis.kind for axis in model.axes}
    counts = {axis.name: len(axis.masses) for axis in model.axes}
    result = identify_classic(stepped(measured(model, fresh_rng)), counts, kinds)
    assert result.model.names == model.names
    for found, true in zip(result.model.axes, model.axes, strict=True):
        assert found.kind == true.kind
        for what in ("masses", "springs", "dampers"):
            pairs = zip(getattr(found, what), getattr(true, what), strict=True)
            for k, (value, wanted) in enumerate(pairs):
                rel = 2e-3 if what != "dampers" else 2e-2
                assert value.value == pytest.approx(wanted.value, rel=rel), (found.name, what, k)
                assert 0 < value.std < 0.1 * value.value
        assert found.viscous_friction.value == 0.0
    by_axes = {tuple(sorted(c.axes)): c.value for c in result.model.couplings}
    for coupling in model.couplings:
        found_value = by_axes[tuple(sorted(coupling.axes))]
        assert found_value == pytest.approx(coupling.value, rel=1e-2)
    assert len(result.low_masses) == (len(lengths) if len(lengths) > 1 else 0)
    assert len(result.cross_gains) == len(model.couplings)
    assert result.damping_ratios.size == sum(n - 1 for n in lengths)
    # the order reduction alone, before the fit to all points, is near as well
    for found, true in zip(result.reduced.model.axes, model.axes, strict=True):
        for value, wanted in zip(found.masses, true.masses, strict=True):
            assert value.value == pytest.approx(wanted.value, rel=0.03)


def test_the_motors_friction_is_found(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    model = without_friction(random_model(fresh_rng, (2, 1)))
    axes = tuple(
        type(axis)(axis.name, axis.kind, axis.masses, axis.springs, axis.dampers, Estimate(0.8))
        for axis in model.axes
    )
    model = MachineModel(axes, model.couplings)
    kinds = {axis.name: axis.kind for axis in axes}
    result = identify_classic(stepped(measured(model, fresh_rng)), {"axis1": 2, "axis2": 1}, kinds)
    for found, true in zip(result.model.axes, axes, strict=True):
        assert found.viscous_friction.value == pytest.approx(0.8, rel=0.05)
        for value, wanted in zip(found.masses, true.masses, strict=True):
            assert value.value == pytest.approx(wanted.value, rel=5e-3)
    assert all(a.viscous_friction.value == 0 for a in without_friction(result.model).axes)


def test_gains_of_held_sweeps_do_not_depend_on_how_firmly_axes_are_held(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    """1 / A_L is the mass of an axis alone, A_C the inverse of the masses' 2 x 2 matrix."""
    model = random_model(fresh_rng, (2, 1, 2))
    low, cross = held_gains(stepped(measured(model, fresh_rng)))
    for mass, axis in zip(low, model.axes, strict=True):
        assert mass.mass == pytest.approx(axis.total_mass, rel=2e-3)
        assert abs(mass.mass - axis.total_mass) < 6 * mass.std + 1e-6 * axis.total_mass
    couplings = {tuple(sorted(c.axes)): c.value for c in model.couplings}
    for (a, b), gain in zip(combinations(model.axes, 2), cross, strict=True):
        m = couplings[tuple(sorted((a.name, b.name)))]
        wanted = np.linalg.inv([[a.total_mass, m], [m, b.total_mass]])[0, 1]
        assert gain.gain == pytest.approx(wanted, rel=2e-2)
        assert np.sign(gain.gain) == -np.sign(m)


@pytest.mark.parametrize("missing", ["axis1", "axis2"])
def test_a_missed_held_sweep_is_named(
    missing: str, random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    model = random_model(fresh_rng, (2, 1))
    kinds = {axis.name: axis.kind for axis in model.axes}
    kept = [
        p for p in measured(model, fresh_rng) if not (p.driven == (missing,) and len(p.free) < 1)
    ]
    if missing == "axis2":  # also driven in the cross-coupled sweep, which counts as free here
        kept = [p for p in kept if p.free != ()] + [p for p in kept if p.driven == ("axis1",)]
    with pytest.raises(NotEnoughDataError, match=f"no sweep drives {missing} with other axes held"):
        identify_classic(stepped(kept), {"axis1": 2, "axis2": 1}, kinds)


def test_held_sweeps_at_other_frequencies_can_not_be_solved(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    model = random_model(fresh_rng, (2, 2, 1))
    found = [p for p in measured(model, fresh_rng) if len(p.free) == 2]
    for k, name in enumerate(model.names):
        grid = np.geomspace(0.3, 0.8, 6) * (1 + 0.01 * k)
        found.append(phasors(model, name, (), grid, fresh_rng))
    with pytest.raises(NotEnoughDataError, match=r"Measure every axis at the same frequencies"):
        held_gains(stepped(found))


def test_nothing_floats(random_model: RandomModel, fresh_rng: np.random.Generator) -> None:
    model = random_model(fresh_rng, (2, 1))
    held = [p for p in measured(model, fresh_rng) if p.free == ()]
    with pytest.raises(NotEnoughDataError, match="no sweep lets the other axes float"):
        identify_classic(stepped(held), {"axis1": 2, "axis2": 1}, {})
