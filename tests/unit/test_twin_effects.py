"""Effects of a model and the simulated parts made of them: two formulas, one torque."""

import numpy as np
import pytest
from pydantic import TypeAdapter

from drives.profile.effects import EffectProfile
from drives.sim.effects import FloatArray, Site
from drives.sim.element_kernel import _pulled, seen
from drives.sim.imperfect import shaft_tables
from drives.sim.machine import chain_effect
from fieldtool.criticise.effects import LIBRARY
from fieldtool.criticise.effects.base import Parameter
from fieldtool.criticise.simulate.motion import Motion
from fieldtool.workflow.twin_effects import MAKERS, rebuilt

SPRING, STEP = 190.0, 1.0 / 8000.0
ADAPTER = TypeAdapter(EffectProfile)


def part_of(effect, parameters, kind="rotary", location="motor"):
    """Return the simulated part that a model's effect becomes, checked as a profile's."""
    entry = {
        "effect": effect, "axis": "a", "location": location,
        "parameters": {k: {"value": v, "std": None, "unit": ""} for k, v in parameters.items()},
    }  # fmt: skip
    out = rebuilt((entry,), {"a": (kind, (SPRING,))})
    assert out.left_out == []
    (part,) = out.parts["a"]
    return chain_effect(ADAPTER.validate_python(part), kind)


def pulled(part, twist, velocity):
    """Return the force against a twist (or motion) of all elements of a part."""
    site = Site(0, (0.02, 0.03), (SPRING,), (0.03,), STEP)
    out = np.zeros(twist.size)
    for element in part.elements(site):
        values = np.zeros(6)
        values[: len(element.values)] = element.values
        memory = np.zeros(2)
        out += [
            _pulled(int(element.kind), values, memory, q, v, 0.0, STEP)
            for q, v in zip(twist, velocity, strict=True)
        ]
    return out


def effect_of(name, **values):
    parameters = tuple(Parameter(n, "", v, -1e9, 1e9, 1.0) for n, v in values.items())
    return LIBRARY[name](0, parameters)


def motion_at(position):
    column = position[:, None]
    zero = np.zeros_like(column)
    return Motion("e", 1e-3, column[:, 0], column, zero, zero, zero, column, zero, zero + 1)


def plain(effect, values) -> dict[str, float]:
    return {name: value for name, (value, _, _) in effect.plain(values).items()}


def test_gravity_pulls_the_same_way(fresh_rng):
    values = {"sine": fresh_rng.normal(), "cosine": fresh_rng.normal()}
    effect = effect_of("gravity", **values)
    q = fresh_rng.uniform(-4, 4, 50)
    part = part_of("gravity", plain(effect, values))
    assert pulled(part, q, np.zeros(50)) == pytest.approx(effect.torque(motion_at(q), values))


@pytest.mark.parametrize("kind", ["rotary", "linear"])
def test_cogging_has_its_place_size_and_pitch(fresh_rng, kind):
    values = {
        "sine": fresh_rng.normal(),
        "cosine": fresh_rng.normal(),
        "order": fresh_rng.uniform(2, 40),
    }
    effect = effect_of("cogging", **values)
    q = fresh_rng.uniform(-4, 4, 50)
    part = part_of("cogging", plain(effect, values), kind)
    wanted = effect.torque(motion_at(q), values)
    assert pulled(part, q, np.zeros(50)) == pytest.approx(wanted, abs=1e-4)


@pytest.mark.parametrize("kind", ["rotary", "linear"])
def test_an_encoder_error_shows_at_the_same_positions(fresh_rng, kind):
    size = 1e-4 * fresh_rng.uniform(0.5, 2.0)
    angle, order = fresh_rng.uniform(-3, 3), fresh_rng.uniform(2, 40)
    values = {"sine": size * np.cos(angle), "cosine": size * np.sin(angle), "order": order}
    effect = effect_of("encoder_error", **values)
    part = part_of("encoder_error", plain(effect, values), kind)
    shafts = shaft_tables([[part]], STEP)
    q = fresh_rng.uniform(-2, 2, 50)
    shown: FloatArray = np.array([seen(0, x, shafts) for x in q])
    wanted = size * np.sin(order * q + angle)
    assert shown - q == pytest.approx(wanted, abs=0.02 * size)


@pytest.mark.parametrize(("effect", "sign"), [("hardening_spring", 1), ("softening_spring", -1)])
def test_springs_bend_alike_at_small_twists(fresh_rng, effect, sign):
    cubic = sign * fresh_rng.uniform(1e4, 1e5)
    part = part_of(effect, {"cubic": cubic}, location="spring 1")
    d = np.linspace(-0.3, 0.3, 41) * np.sqrt(SPRING / abs(cubic))
    assert pulled(part, d, np.zeros(41)) == pytest.approx(
        cubic * d**3, abs=0.12 * abs(cubic) * d.max() ** 3
    )


def test_a_gap_does_nothing_within_and_is_the_spring_beyond(fresh_rng):
    half = fresh_rng.uniform(1e-3, 5e-3)
    part = part_of("backlash", {"half_gap": half, "gap": 2 * half}, location="spring 1")
    d = np.linspace(-4, 4, 81) * half
    total = pulled(part, d, np.zeros(81)) + SPRING * d
    dead = SPRING * np.sign(d) * np.maximum(np.abs(d) - half, 0.0)
    assert total == pytest.approx(dead, abs=1e-9 * SPRING)


def test_every_effect_of_the_library_is_rebuilt_or_said_to_be_left_out():
    in_chains = {"viscous_friction", "coupling_spring", "coupling_inertia"}
    assert set(MAKERS) | in_chains == set(LIBRARY)


def test_what_has_no_part_is_said():
    effects = tuple(
        {"effect": name, "axis": "a", "parameters": parameters}
        for name, parameters in (
            ("torque_lag", {"time": {"value": -1e-3}}),
            ("measurement_delay", {"delay": {"value": -1e-3}}),
            ("coulomb_friction", {"stiffness": {"value": 12.0}}),
            ("periodic_disturbance", {"frequency": {"value": 12.0}}),
        )
    )
    out = rebuilt(effects, {"a": ("rotary", (SPRING,))})
    assert out.parts == {}
    assert len(out.left_out) == len(effects)
    assert all(sentence.endswith(".") for sentence in out.left_out)


def test_friction_with_directions_gives_its_dry_part_and_the_mean_of_its_viscous_one():
    parameters = {"coulomb_positive": 0.2, "coulomb_negative": 0.1, "viscous_positive": 0.02,
                  "viscous_negative": 0.04, "presliding": 1e-5, "rounding": 1e-3}  # fmt: skip
    entry = {"effect": "asymmetric_friction", "axis": "a", "parameters": parameters}
    out = rebuilt((entry,), {"a": ("rotary", ())})
    assert out.parts["a"][0]["coulomb_positive"] == 0.2
    assert out.viscous["a"] == pytest.approx(0.03)
    assert "mean" in out.left_out[0]


@pytest.mark.parametrize(
    ("told", "own", "effect"),
    [
        ("delay", "time", "measurement_delay"),
        ("gap", "play", "backlash"),
        ("limit", "torque", "torque_saturation"),
        ("scale", "factor", "torque_scale"),
        ("amplitude", "torque", "cogging"),
    ],
)
def test_profiles_read_the_names_of_models_and_the_plants_own(fresh_rng, told, own, effect):
    value = fresh_rng.uniform(1e-3, 1e-2)
    more = {"periods": 24.0} if effect == "cogging" else {}
    parts = [
        chain_effect(ADAPTER.validate_python({"effect": effect, name: value} | more), "rotary")
        for name in (told, own)
    ]
    assert parts[0] == parts[1]
    assert getattr(parts[0], own) == pytest.approx(value)
