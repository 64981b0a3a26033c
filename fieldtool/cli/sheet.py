"""A table for terminals of any width: words fold between words, numbers stay whole, nothing is cut."""

from collections.abc import Collection, Iterator

from rich.console import Console, ConsoleOptions, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

Cell = str | Text


class Sheet:
    """Rows of cells under titles, as wide as they need to be and the terminal allows.

    Where not even the longest words fit beside each other, every row becomes a sentence.

    Parameters
    ----------
    titles
        One a column.
    numbers
        Titles of columns that are set to the right and never folded.
    whole
        Titles of columns that are never folded.
    gap
        Spaces between two columns.
    """

    def __init__(
        self,
        *titles: str,
        numbers: Collection[str] = (),
        whole: Collection[str] = (),
        gap: int = 2,
    ) -> None:
        self._titles, self._gap = titles, gap
        self._numbers = [title in numbers for title in titles]
        self._whole = [title in numbers or title in whole for title in titles]
        self._rows: list[tuple[tuple[Text, ...], str]] = []

    def add(self, *cells: Cell, style: str = "") -> None:
        """Add a row; brackets in texts are no markup, and cells that are missing at its end empty."""
        filled = (*cells, *("",) * (len(self._titles) - len(cells)))
        texts = tuple(c if isinstance(c, Text) else Text(c) for c in filled)
        self._rows.append((texts, style))

    @property
    def natural_width(self) -> int:
        """Columns of the terminal with which nothing needs to be folded."""
        return sum(self._widest(k) for k in range(len(self._titles))) + self._gaps

    def __rich_console__(
        self, _console: Console, options: ConsoleOptions
    ) -> Iterator[RenderableType]:
        widths = self._widths(options.max_width)
        if widths is None:
            yield from self._sentences()
            return
        table = Table(box=None, padding=(0, 0, 0, self._gap), pad_edge=True)
        for title, width, number in zip(self._titles, widths, self._numbers, strict=True):
            table.add_column(
                title, width=width, justify="right" if number else "left", overflow="fold"
            )
        for cells, style in self._rows:
            table.add_row(*cells, style=style)
        yield table

    @property
    def _gaps(self) -> int:
        return self._gap * len(self._titles)

    def _texts(self, column: int) -> list[str]:
        return [line for cells, _ in self._rows for line in cells[column].plain.split("\n")]

    def _widest(self, column: int) -> int:
        lines = (self._titles[column], *self._texts(column))
        return max(Text(line).cell_len for line in lines)

    def _least(self, column: int) -> int:
        """Width with which no word, or with ``whole`` no line, is folded within."""
        lines = self._texts(column)
        parts = lines if self._whole[column] else [word for line in lines for word in line.split()]
        return max(
            (Text(part).cell_len for part in (*self._titles[column].split(), *parts)), default=0
        )

    def _widths(self, room: int) -> list[int] | None:
        """Width of each column: the widest give way first; None where there is no room for a table."""
        columns = range(len(self._titles))
        widths, least = [self._widest(k) for k in columns], [self._least(k) for k in columns]
        for _ in range(sum(widths) + self._gaps - room):
            wide = max(columns, key=lambda k: (widths[k] > least[k], widths[k]), default=0)
            if widths[wide] <= least[wide]:
                return None
            widths[wide] -= 1
        return widths

    def _sentences(self) -> Iterator[RenderableType]:
        for cells, style in self._rows:
            said = Text(style=style)
            for title, cell in zip(self._titles, cells, strict=True):
                if cell.plain.strip():
                    said.append("; " if said else "").append(f"{title}: " if title else "")
                    said.append_text(cell)
            yield Padding(said, (0, 0, 0, self._gap))
