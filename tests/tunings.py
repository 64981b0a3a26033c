"""Session folders with a tuning that was not designed, for what is tried, kept and written of it."""

import numpy as np
import yaml

from drives.profile import load_machine
from fieldtool.design.loops import Loops
from fieldtool.design.machine import machine_of, respond
from fieldtool.design.servo import Timing, servo_from_parameters
from fieldtool.records.model_file import write_model
from fieldtool.workflow.models import truth_model
from tests.session.conftest import GAINS

GOOD = {
    "table": {"velocity_p": 2.0, "velocity_i": 20.0, "position_p": 12.0, "velocity_ff": 1.0},
    "arm": {"velocity_p": 1.6, "velocity_i": 16.0, "position_p": 12.0, "velocity_ff": 1.0},
}
"""Faster than what is in the drives, with good margins."""


def begun(bench):
    """Begin a session folder with a good tuning and the true model; return the bench."""
    bench.out.mkdir()
    (bench.out / "machine.yaml").write_text(bench.profile.read_text())
    write_tuning(bench, GOOD)
    write_model(truth_model(load_machine(bench.profile)), bench.out / "model.yaml")
    return bench


def peaks(bench, parameters):
    """Of sensitivity, with the true model."""
    machine = machine_of(truth_model(load_machine(bench.profile)))
    servos = tuple(
        servo_from_parameters({**GAINS, **own}, Timing(0.22e-3, 0.0)) for own in parameters.values()
    )
    response = respond(machine, np.geomspace(1.0, 600.0, 4000))
    return np.abs(Loops(response, servos).sensitivity).max(axis=0).tolist()


def write_tuning(bench, parameters, designed=None):
    """Write a tuning that says what the designed parameters come to, these or others."""
    said = peaks(bench, designed or parameters)
    tuning = {
        "format": "fieldtool-tuning/1",
        "axes": [
            {"axis": axis, "parameters": dict(own), "sensitivity_peak": peak, "reason": "test"}
            for (axis, own), peak in zip(parameters.items(), said, strict=True)
        ],
    }
    (bench.out / "tuning.yaml").write_text(yaml.safe_dump(tuning))


def scale_model(path, factor):
    """Make all masses, springs and dampers of a model's file so many times as large."""
    data = yaml.safe_load(path.read_text())
    for axis in data["axes"]:
        for name in ("masses", "springs", "dampers"):
            for one in axis[name]:
                one["value"] *= factor
    for coupling in data["couplings"]:
        coupling["value"] *= factor
    path.write_text(yaml.safe_dump(data))
