"""New controller parameters, and what later stages say of them where their files are there."""

from collections.abc import Mapping, Sequence
from math import isclose
from typing import Any

from fieldtool.design.tuning import Tuning
from fieldtool.report.choices import choice_rows, choice_sentences, choice_titles
from fieldtool.report.in_drives import state
from fieldtool.report.material import Material
from fieldtool.report.section import Block, Section, Table, Words

ROUNDED = 1e-2
"""Relative difference that comes of what drives can hold."""


def parameters(material: Material) -> Section | None:
    """Show parameters before and after, and why they are what they are."""
    if material.tuning is None:
        return None
    blocks: list[Block] = []
    rows = _rows(material)
    if rows:
        columns = ("axis", "parameter", "before", "after", "unit", "read back")
        count = len(columns) if any(row.get("read_back") is not None for row in rows) else -1
        blocks.append(Table(columns[:count], tuple(_row(row)[:count] for row in rows)))
    else:
        blocks.append(
            Table(
                ("axis", "parameter", "designed"),
                tuple(
                    (axis.axis, name, f"{value:.6g}")
                    for axis in material.tuning.axes
                    for name, value in axis.parameters.items()
                ),
            )
        )
    if _designed_since(material.tuning, rows):
        blocks.append(
            Words(
                (
                    "Other parameters than these were designed afterwards; tuning.yaml holds them, and "
                    "they were not written. What follows is said of them:",
                ),
                "warning",
            )
        )
    blocks.append(
        Words(
            tuple(
                f"{axis.axis}: {axis.reason} Peak of sensitivity {axis.sensitivity_peak:.2f} ("
                f"{material.tuning.bound:g} or less was asked for)."
                for axis in material.tuning.axes
            ),
            "list",
        )
    )
    if rows_of := choice_rows(material.tuning):
        blocks.append(
            Table(
                choice_titles(material.tuning),
                tuple(rows_of),
                "The three responses, as predicted: what more bandwidth costs in margin.",
            )
        )
        blocks.append(Words(tuple(choice_sentences(material.tuning)), "list"))
    if material.tuning.notes:
        blocks.append(Words(tuple(material.tuning.notes), "list"))
    return Section("Controller parameters", state(material), tuple(blocks))


def _rows(material: Material) -> list[Mapping[str, Any]]:
    """Parameters of the last write that was done; of the last that was thought of where none was."""
    noted, best = None, None
    for event in material.events:
        if event.get("event") == "parameters":
            noted = event.get("rows")
            best = noted if best is None else best
        elif event.get("event") == "write" and event.get("written"):
            best = noted
    if not any(e.get("written") for e in material.events_of("write")):
        best = noted
    return [row for row in best if isinstance(row, Mapping)] if isinstance(best, list) else []


def _designed_since(tuning: Tuning, rows: Sequence[Mapping[str, Any]]) -> bool:
    """Whether the tuning has other values than were written, beyond what drives round."""
    written = {(str(row.get("axis")), str(row.get("name"))): row.get("after") for row in rows}
    for axis in tuning.axes:
        for name, value in axis.parameters.items():
            other = written.get((axis.axis, name))
            if isinstance(other, int | float) and not isclose(
                other, value, rel_tol=ROUNDED, abs_tol=ROUNDED
            ):
                return True
    return False


def _row(row: Mapping[str, Any]) -> tuple[str, ...]:
    unit = str(row.get("unit") or "")
    return (
        str(row.get("axis")),
        str(row.get("name")),
        _number(row.get("before")),
        _number(row.get("after")),
        "" if unit == "1" else unit,
        _number(row.get("read_back")),
    )


def _number(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, int | float) else str(value)
