"""Tables on terminals of any width: no line is too wide, no word or number is cut, nothing is lost."""

from collections import Counter
from io import StringIO

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from rich.text import Text

from fieldtool.cli.progress import ShareBar
from fieldtool.cli.sheet import Sheet

WORDS = st.lists(st.text("abcdefgh", min_size=1, max_size=9), min_size=1, max_size=5).map(" ".join)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False).map(lambda x: f"{x:.4g}")
ROWS = st.lists(st.tuples(WORDS, NUMBERS, WORDS, NUMBERS), min_size=1, max_size=6)


def shown(sheet: Sheet, width: int) -> str:
    out = StringIO()
    Console(file=out, width=width, highlight=False).print(sheet)
    return out.getvalue()


@given(ROWS, st.integers(24, 120))
def test_every_word_and_number_is_there_whole(rows: list[tuple[str, ...]], width: int) -> None:
    sheet = Sheet("first", "one value", "second", "other", numbers=("one value", "other"))
    for row in rows:
        sheet.add(*row)
    out = shown(sheet, width)
    assert max(len(line) for line in out.splitlines()) <= width
    found = out.replace(";", " ").replace(":", " ").split()
    assert not Counter(word for row in rows for cell in row for word in cell.split()) - Counter(
        found
    )


def test_the_widest_column_gives_way_first_and_numbers_never() -> None:
    sheet = Sheet("axis", "found, and what to do", "value", numbers=("value",))
    sheet.add("table", "the drive has none of its own", "-0.000123456")
    assert sheet.natural_width == 5 + 29 + 12 + 3 * 2
    lines = shown(sheet, 40).splitlines()
    assert [line.split()[-1] for line in lines if "table" in line] == ["-0.000123456"]
    assert all(len(line) <= 40 for line in lines)


def test_what_has_no_room_for_a_table_is_said() -> None:
    sheet = Sheet("axis", "what", "value", numbers=("value",))
    sheet.add("table", "viscous_friction", "0.020001")
    assert shown(sheet, 24).split() == [
        "axis:",
        "table;",
        "what:",
        "viscous_friction;",
        "value:",
        "0.020001",
    ]


def test_brackets_are_no_markup_and_rows_may_end_early() -> None:
    sheet = Sheet("axis", "what")
    sheet.add("[bold]")
    sheet.add(Text("x", style="red"), "[/]")
    out = shown(sheet, 40)
    assert "[bold]" in out
    assert "[/]" in out


@pytest.mark.parametrize("width", [30, 40, 80])
def test_a_line_of_progress_is_one_line(width: int) -> None:
    out = StringIO()
    console = Console(
        file=out, width=width, force_terminal=True, highlight=False, color_system=None
    )
    with ShareBar(console, "choose lines and amplitudes: period 11 of at most 11, 4.69 s") as bar:
        bar("choose lines and amplitudes: period 12 of at most 12, 4.75 s", 0.64)
        bar._bar.refresh()
    frames = [line for line in out.getvalue().replace("\r", "\n").splitlines() if "64%" in line]
    assert frames
    assert all("64%" in line and "left" in line for line in frames)
