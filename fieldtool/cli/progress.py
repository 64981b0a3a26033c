"""Lines of progress: what is being done, how far it is, how long the rest may take."""

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskProgressColumn, TextColumn
from rich.table import Column
from rich.text import Text

PACE_FROM = 0.03
"""Share done from which the pace says how long the rest will take."""


def short() -> Column:
    """Return a column that a line of progress always shows whole."""
    return Column(no_wrap=True)


def long() -> Column:
    """Return a column that is shown as far as there is room."""
    return Column(no_wrap=True, overflow="ellipsis", ratio=1)


def clock(seconds: float) -> str:
    """Return e.g. ``1 min 20 s``."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


class Left(ProgressColumn):
    """Time left, from the pace so far; it stays on the screen from the first tone on."""

    def render(self, task: Task) -> Text:
        """Return e.g. ``1 min 20 s left``."""
        if task.finished:
            return Text(f"{clock(task.elapsed or 0)} taken")
        if task.completed < PACE_FROM or not task.elapsed:
            return Text("measuring the pace")
        left = task.elapsed * (1 - task.completed) / task.completed
        return Text(f"{clock(left)} left")


def bar_of(console: Console) -> Progress:
    """Return a bar that fits terminals of any width, and goes when it has ended."""
    return Progress(
        BarColumn(bar_width=12, table_column=short()),
        TaskProgressColumn(table_column=short()),
        Left(table_column=short()),
        TextColumn("{task.description}", markup=False, table_column=long()),
        console=console,
        transient=True,
        expand=True,
        refresh_per_second=4,
    )


class ShareBar:
    """A bar that is told what is done and a share from 0 to 1; shown on terminals only."""

    def __init__(self, console: Console, what: str) -> None:
        self._bar, self._shown = bar_of(console), console.is_terminal
        self._task = self._bar.add_task(what, total=1.0)

    def __enter__(self) -> "ShareBar":
        if self._shown:
            self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._shown:
            self._bar.stop()

    def __call__(self, what: str, share: float) -> None:
        """Show what is done."""
        self._bar.update(self._task, completed=share, description=what)
