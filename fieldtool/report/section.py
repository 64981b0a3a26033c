"""What a report is made of: sections of words, tables and plots, as plain values."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class Words:
    """Sentences, each a paragraph or, of the kind ``list``, an item."""

    sentences: tuple[str, ...]
    kind: Literal["plain", "list", "warning", "command"] = "plain"

    @property
    def is_a(self) -> str:
        """How the page shows it."""
        return "words"


@dataclass(frozen=True)
class Table:
    """A table; cells that look like numbers are set to the right."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""

    @property
    def is_a(self) -> str:
        """How the page shows it."""
        return "table"


@dataclass(frozen=True)
class Plot:
    """A figure as plotly has it: ``data`` and ``layout``, plain values."""

    figure: Mapping[str, Any]
    caption: str
    height: int = 300
    """Pixels."""

    @property
    def is_a(self) -> str:
        """How the page shows it."""
        return "plot"


@dataclass(frozen=True)
class Plots:
    """Plots side by side."""

    plots: tuple[Plot, ...]
    columns: int = 2

    @property
    def is_a(self) -> str:
        """How the page shows it."""
        return "plots"


Block = Words | Table | Plot | Plots


@dataclass(frozen=True)
class Section:
    """One part of a report."""

    title: str
    lead: str
    """What matters of it, in one sentence."""
    blocks: tuple[Block, ...] = ()
    folded: bool = False
    """Shown closed on a screen, open on paper."""
