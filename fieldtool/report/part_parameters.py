"""New controller parameters, and what later stages say of them where their files are there."""

from collections.abc import Mapping
from typing import Any

from fieldtool.report.material import Material
from fieldtool.report.section import Block, Section, Table, Words


def parameters(material: Material) -> Section | None:
    """Show parameters before and after, and why they are what they are."""
    if material.tuning is None:
        return None
    blocks: list[Block] = []
    noted = material.events_of("parameters")
    rows = noted[-1].get("rows") if noted else None
    if isinstance(rows, list) and rows:
        table = tuple(_row(row) for row in rows if isinstance(row, Mapping))
        columns = ("axis", "parameter", "before", "after", "unit", "read back")
        blocks.append(Table(columns, table))
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
    return Section("Controller parameters", _state(material), tuple(blocks))


def _state(material: Material) -> str:
    written = material.events_of("write")
    if not written or not written[-1].get("written"):
        return "Designed; nothing was written into the drives."
    if written[-1].get("stored"):
        return "Written into the drives, read back, and stored in their non-volatile memory."
    return (
        "Written into the drives' working memory and read back; not stored: a power cycle brings "
        "the old ones back."
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
