"""The identified machine: its numbers, its responses, and what changed."""

from fieldtool.frf.matrix import OTHERS_FREE, SOLVED
from fieldtool.frf.response import FrequencyResponse
from fieldtool.records.model import MachineModel
from fieldtool.report.figures import response_figure
from fieldtool.report.material import Material
from fieldtool.report.numbers import model_numbers
from fieldtool.report.section import Plot, Plots, Section, Table, Words

MOST_PLOTS = 16
"""Responses that are drawn; of larger machines the ones on the diagonal."""


def numbers(material: Material) -> Section | None:
    """List every number of the model with its 95 % interval."""
    model = material.model
    if model is None:
        return None
    truth = {}
    if material.truth is not None:
        truth = {(n.axis, n.what): n.value.value for n in model_numbers(material.truth)}
    rows = []
    for n in model_numbers(model, material.torque_units):
        row = [n.axis, n.what, f"{n.value.value:.5g}", f"± {n.interval}", n.unit]
        if truth:
            true = truth.get((n.axis, n.what))
            row.append("" if true is None else f"{true:.5g}")
        rows.append(tuple(row))
    columns = ["axis", "what", "value", "95 % interval", "unit"]
    if truth:
        columns.append("simulated truth")
    chains = ", ".join(f"{a.name} {len(a.masses)}" for a in model.axes)
    return Section(
        "The machine",
        f"Masses in each chain: {chains}. Motor side first.",
        (
            Table(tuple(columns), tuple(rows)),
            Words(
                (
                    "An interval holds the true value in 95 of 100 such measurements, if the "
                    "machine is of this structure. A wrong scale of a drive's torque is in no "
                    "interval: it changes all masses, springs and dampers of its axis by one factor.",
                )
            ),
        ),
    )


def responses(material: Material) -> Section | None:
    """Draw what every motor does per torque of every motor."""
    model = material.model
    if model is None:
        return None
    measured = _measured(material)
    size = len(model.axes)
    places = [(i, j) for i in range(size) for j in range(size)]
    whole = len(places) <= MOST_PLOTS
    if not whole:
        places = [(k, k) for k in range(size)]
    plots = tuple(
        Plot(
            response_figure(
                measured, model, material.prior, material.band, (i, j), unit(model, i, j, material)
            ),
            f"{model.names[i]}: acceleration per "
            + ("its own torque" if i == j else f"torque of {model.names[j]}"),
            300,
        )
        for i, j in places
    )
    lead = (
        "Points are measured, with 95 % bars; the red line is the identified model with its 95 % band; "
        "grey is the machine as last accepted."
        if measured is not None
        else "There is no measured response: the model was fitted to the motion itself."
    )
    if not whole:
        lead += " Of this many axes, only the responses to their own torques are drawn."
    return Section(
        "Measured and modelled responses", lead, (Plots(plots, min(size, 3) if whole else 3),)
    )


def _measured(material: Material) -> FrequencyResponse | None:
    held = material.responses
    found = held.get(SOLVED) or held.get(OTHERS_FREE) or next(iter(held.values()), None)
    if found is None or material.model is None or found.axes != material.model.names:
        return None
    return found


def unit(model: MachineModel, i: int, j: int, material: Material) -> str:
    """Return the unit of the acceleration of axis i per torque of axis j."""
    units = material.torque_units
    if units and j < len(units) and units[j] == "A":
        return "rad/(A s²)" if model.axes[i].kind == "rotary" else "m/(A s²)"
    kinds = {model.axes[i].kind, model.axes[j].kind}
    if kinds == {"rotary"}:
        return "1/(kg m²)"
    return "1/kg" if kinds == {"linear"} else "1/(kg m)"


def changed(material: Material) -> Section | None:
    """Say what changed since the machine was last accepted."""
    if material.criticism is None or not material.criticism.changes:
        return None
    return Section(
        "What changed since the machine was last accepted",
        "Masses and springs that changed are new tooling or a worn part; what follows them is a "
        "fault or a property that the model did not have.",
        (Words(material.criticism.changes, "list"),),
    )
