"""The fast plan on a gantry of linear axes, and drives whose own following error window is tight."""

import pytest
import yaml

from fieldtool.records.model_file import read_model

FEED = 0.02
"""m a revolution, 2 ** 20 counts: the reference drive's own window is then 2 mm."""


def linear(name, node_id, masses, springs, travel):
    return {
        "name": name,
        "kind": "linear",
        "node_id": node_id,
        "drive": "reference",
        "feed": FEED,
        "limits": {
            "travel": [f"-{travel} m", f"{travel} m"],
            "velocity": "1 m/s",
            "acceleration": "20 m/s2",
            "torque": "300 N",
            "following_error": "0.05 m",
        },
        "prior": {
            "masses": list(masses),
            "springs": list(springs),
            "dampers": [30.0] * len(springs),
            "viscous_friction": 5.0,
        },
    }


def truth(masses, springs):
    return {
        "masses": list(masses),
        "springs": list(springs),
        "dampers": [40.0] * len(springs),
        "viscous_friction": 8.0,
        "rated_torque": 200,
        "peak_torque": 600,
        "torque_noise": 0.2,
        "encoder_counts_per_rev": 2**20,
        "gains": {
            "position_p": 15,
            "velocity_p": 500,
            "velocity_i": 3000,
            "velocity_ff": 1,
            "velocity_filter": 150,
        },
    }


def gantry():
    return {
        "format": "fieldtool-machine/1",
        "name": "gantry",
        "bus": {"interface": "fieldsim", "channel": "?", "bitrate": 1_000_000},
        "axes": [
            linear("x", 11, [8.0, 5.0], [9.0e4], 0.4),
            linear("y", 12, [6.0], [], 0.3),
        ],
        "couplings": [{"axes": ["x", "y"], "value": 0.6}],
        "simulation": {
            "seed": 5,
            "axes": [truth([8.0, 6.0], [9.0e4]), truth([6.0], [])],
            "couplings": [{"axes": ["x", "y"], "value": 0.9}],
        },
    }


@pytest.mark.parametrize("window", ["the drive's default", "off"])
def test_linear_axes_are_identified_within_the_drives_own_window(make_bench, window):
    objects = (
        {} if window == "the drive's default" else {n: {(0x6065, 0): 2**32 - 1} for n in (11, 12)}
    )
    bench = make_bench(gantry(), objects)
    outcome = bench.command(
        "run", bench.profile, "--no-write", "--yes", "--out", bench.out, "--time", 20
    )
    assert outcome.code == 0, outcome.err + outcome.out
    said = " ".join(outcome.out.split()) + " ".join(outcome.err.split())
    assert ("window (0x6065) is 0.002 m, the profile allows 0.05 m" in said) == (not objects)
    model = read_model(bench.out / "model.yaml")
    x, y = model.axes
    assert (x.kind, y.kind) == ("linear", "linear")
    for value, true in zip((*x.masses, *y.masses, *x.springs), (8, 6, 6, 9.0e4), strict=True):
        assert value.value == pytest.approx(true, rel=0.01)
        assert abs(value.value - true) < 6 * value.std
    assert model.couplings[0].value == pytest.approx(0.9, rel=0.05)
    if not objects:
        for one in bench.recording().experiments:
            error = abs(one.position_reference - one.position).max()
            assert error < 0.002
    assert bench.powered() == {}
    assert bench.changed() == {}


def test_a_tight_window_of_a_rotary_axis_is_kept(make_bench, profile_of_one):
    machine = yaml.safe_load(yaml.safe_dump(profile_of_one))
    bench = make_bench(machine, {11: {(0x6065, 0): 30_000}})
    outcome = bench.command("measure", bench.profile, "--yes", "--out", bench.out, "--time", 12)
    assert outcome.code == 0, outcome.err + outcome.out
    assert "table: the drive's own following error window (0x6065)" in " ".join(outcome.out.split())
    assert all(one.complete for one in bench.recording().experiments)
