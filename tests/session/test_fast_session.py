"""The fast plan as a user meets it: planned, measured, stopped, and what it says of dry friction."""

from importlib.resources import files

import pytest
import yaml

TABLE, ARM = 11, 12


@pytest.fixture
def turntable():
    text = files("profiles").joinpath("machines/turntable-arm.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text)


@pytest.mark.parametrize("f", [0.0, 0.1, 0.3, 1.0, 2.0, 3.0])
def test_explore_friction(make_bench, turntable, f):
    if f:
        for axis in turntable["simulation"]["axes"][:1]:
            axis["effects"] = [{"effect": "coulomb_friction", "location": "motor", "torque": f}]
    bench = make_bench(turntable)
    o = bench.run()
    print(f, o.code, o.out, o.err)
    print(bench.powered(), bench.changed())
