"""New controller parameters, and what later stages say of them where their files are there."""

from collections.abc import Mapping, Sequence
from math import isclose
from typing import Any

from fieldtool.design.tuning import Tuning
from fieldtool.report.material import Material
from fieldtool.report.section import Block, Section, Table, Words
from fieldtool.writeback.earlier import FIRST_BACKUP

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
    if material.tuning.notes:
        blocks.append(Words(tuple(material.tuning.notes), "list"))
    return Section("Controller parameters", _state(material), tuple(blocks))


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


def _state(material: Material) -> str:
    written = [event for event in material.events_of("write") if event.get("written")]
    if not material.events:
        return "Designed; whether they were written is not known: there is no log."
    if not written:
        return "Designed; nothing was written into the drives."
    last = [e for e in material.events if e in written or e.get("event") == "restored"][-1]
    if last.get("event") == "restored":
        without = last.get("without")
        but = ", ".join(map(str, without)) if isinstance(without, list) else ""
        backup = last.get("backup", FIRST_BACKUP)
        old = "the old ones were" if backup == FIRST_BACKUP else f"what {backup} holds was"
        return (
            f"Written into the drives and read back; afterwards {old} brought back "
            f"(`fieldtool restore`){f', but for {but}' if but else ''}."
        )
    if written[-1].get("stored"):
        return "Written into the drives, read back, and stored in their non-volatile memory."
    return (
        "Written into the drives' working memory and read back; not stored: a power cycle brings "
        "back what was stored."
    )


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
