"""What a session looks like on a terminal: where it is, how long it will take, what it found."""

from collections.abc import Callable, Mapping, Sequence
from itertools import zip_longest
from time import perf_counter
from types import TracebackType
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, ProgressColumn, Task, TextColumn
from rich.progress import Progress as Bar
from rich.table import Table
from rich.text import Text

from fieldtool.design.tuning import Tuning
from fieldtool.experiment.forecast import AxisForecast
from fieldtool.experiment.multisine.runner import MultisineProgress
from fieldtool.experiment.stepped.plan import SweepPlan
from fieldtool.experiment.stepped.runner import Progress
from fieldtool.identify.likelihood.expected import Expected
from fieldtool.records.model import Estimate, Kind, MachineModel
from fieldtool.workflow import SessionResult, parameter_table
from fieldtool.workflow.planning import PlannedFast
from fieldtool.writeback.transaction import WriteBack

UNITS = {
    "rotary": {
        "mass": "kg m2",
        "spring": "N m/rad",
        "damper": "N m s/rad",
        "position": "rad",
        "torque": "N m",
    },
    "linear": {"mass": "kg", "spring": "N/m", "damper": "N s/m", "position": "m", "torque": "N"},
}


Ask = Callable[[str], bool]
WIDE = 110
"""Columns that the table with the drives' own units needs."""
PACE_FROM = 0.03
"""Share done from which the pace says how long the rest will take."""
QUIET_INTERVAL = 5.0
"""Seconds between progress lines where there is no terminal."""
NUMBER_WIDTH = 9
"""Characters that a column of numbers is not made narrower than."""


class _Left(ProgressColumn):
    """Time left, from the pace so far; it stays on the screen from the first tone on."""

    def render(self, task: Task) -> Text:
        """Return e.g. ``1 min 20 s left``."""
        if task.finished:
            return Text(f"{_clock(task.elapsed or 0)} taken")
        if task.completed < PACE_FROM or not task.elapsed:
            return Text("measuring the pace")
        left = task.elapsed * (1 - task.completed) / task.completed
        return Text(f"{_clock(left)} left")


class TerminalScreen:
    """Shows a session with ``rich``; a context manager, so that the terminal is left in order."""

    def __init__(self, console: Console, ask: Ask | None = None) -> None:
        self.console, self._ask = console, ask
        self._bar: Bar | None = None
        self._task: Any = None
        self._last_shown = 0.0

    def __enter__(self) -> "TerminalScreen":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._close()

    def stage(self, title: str) -> None:
        """Show the title of a new stage."""
        self._close()
        self.console.print(Text(f"▶ {title}", style="bold"))

    def say(self, sentence: str) -> None:
        """Show a sentence."""
        console = self._bar.console if self._bar else self.console
        console.print(Text("  " + sentence), style="yellow" if "!" in sentence else "")

    def plan(self, plan: SweepPlan, expected: Sequence[AxisForecast], duration: float) -> None:
        """Show what will move, how far, and for how long."""
        sweeps = Table(title=None, box=None, padding=(0, 2))
        for title in ("axis moved", "how", "others floating", "tones", "Hz"):
            sweeps.add_column(title, style="cyan" if title == "axis moved" else "")
        for sweep in plan.sweeps:
            tones = [tone.frequency for tone in sweep.tones]
            _add(
                sweeps,
                sweep.driven,
                sweep.kind,
                ", ".join(sweep.free) or "none, all held",
                str(len(tones)),
                f"{min(tones):.2f} - {max(tones):.2f}",
            )
        self.console.print(sweeps)
        self._show_moves(expected)
        self.console.print(
            f"  Simulated with the prior model: every limit is kept. About {_clock(duration)} of "
            f"machine time, a cycle of {plan.cycle_time * 1000:g} ms."
        )

    def fast_plan(self, planned: PlannedFast) -> None:
        """Show what will move, how far, for how long, and how well it will tell."""
        self._close()
        table = Table(box=None, padding=(0, 2))
        for title in ("part", "experiments", "lines", "Hz", "period", "time"):
            table.add_column(title)
        for name, plan in (("pilot, weak", planned.pilot), ("main", planned.plan)):
            if plan is not None:
                f = plan.frequencies
                first = plan.experiments[0]
                _add(
                    table,
                    name,
                    f"{len(plan.experiments)}, all axes at once",
                    f"{f.size} odd, {first.detection.size} left out",
                    f"{f[0]:.2f} - {f[-1]:.2f}",
                    f"{first.period:.2f} s, {first.periods} times",
                    _clock(plan.duration),
                )
        self.console.print(table)
        self._show_moves(planned.moves)
        self.console.print(
            f"  Simulated with the {planned.rests_on}: every limit is kept. "
            f"{_clock(planned.duration)} of excitation, a cycle of "
            f"{planned.plan.cycle_time * 1000:g} ms; all axes stay under position control."
        )
        self.console.print(Text("  " + expected_text(planned.accuracy)))

    def _show_moves(self, expected: Sequence[AxisForecast]) -> None:
        peaks = Table(box=None, padding=(0, 2))
        for title in ("axis", "moves at most", "speed", "torque", "following error"):
            peaks.add_column(title)
        for axis in expected:
            _add(
                peaks,
                axis.axis,
                f"±{axis.excursion:.3g} {UNITS[axis.kind]['position']}",
                f"{axis.velocity:.3g} {UNITS[axis.kind]['position']}/s",
                f"{axis.torque:.3g} {UNITS[axis.kind]['torque']}",
                f"{axis.following_error:.3g} {UNITS[axis.kind]['position']}",
            )
        self.console.print(peaks)

    def progress(self, progress: Progress | MultisineProgress) -> None:
        """Move the bar."""
        if self._bar is None:
            self._bar = Bar(
                TextColumn("  this pass"),
                BarColumn(bar_width=20),
                TextColumn("{task.percentage:>3.0f} %"),
                _Left(),
                TextColumn("{task.description}", markup=False),
                console=self.console,
                transient=True,
                refresh_per_second=4,
            )
            self._bar.start()
            self._task = self._bar.add_task("", total=1.0)
        self._bar.update(
            self._task,
            completed=progress.done,
            description=_what_runs(progress),
        )
        if not self.console.is_terminal and perf_counter() - self._last_shown > QUIET_INTERVAL:
            self._last_shown = perf_counter()
            task = self._bar.tasks[0]
            self.console.print(
                Text(f"  {100 * progress.done:.0f} %, {_Left().render(task)}; {task.description}")
            )

    def ready(self) -> bool:
        """Ask a person at the terminal; a script has decided by its call."""
        if self._ask is None:
            return True
        return self._ask(
            "The axes will move as shown. Is everybody out of the machine's reach, and a hand on the "
            "emergency stop? Ctrl-C stops all axes."
        )

    def found(self, model: MachineModel, truth: MachineModel | None) -> None:
        """Show the identified machine."""
        self._close()
        self.console.print(model_table(model, truth))

    def designed(self, tuning: Tuning) -> None:
        """Show why the new parameters are what they are."""
        for axis in tuning.axes:
            self.console.print(Text(f"  {axis.axis}: {axis.reason}"))

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


def _what_runs(progress: Progress | MultisineProgress) -> str:
    """Return what is being measured now."""
    if isinstance(progress, Progress):
        where = f"sweep {progress.sweep}/{progress.sweeps}"
        return f"{where}: {progress.name}, {progress.frequency:.2f} Hz"
    part = f"period {progress.period} of {progress.periods}" if progress.period else "run-in"
    return f"experiment {progress.experiment}/{progress.experiments}: {progress.name}, {part}"


def expected_text(expected: Expected) -> str:
    """Return the accuracy to expect as one sentence: the worst of each kind, 95 %."""
    parts = [
        f"{plural} within {percent:.2g} %"
        for kind, plural in (
            ("mass", "masses"),
            ("spring", "springs"),
            ("coupling", "couplings"),
            ("damper", "dampers"),
        )
        if 0 < (percent := 196 * expected.relative(kind)) < np.inf
    ]
    return f"To expect (95 %): {', '.join(parts)}." if parts else "To expect: nothing is told."


def _add(table: Table, *cells: str, style: str = "") -> None:
    """Add a row of plain text: brackets in names are no markup."""
    table.add_row(*(Text(cell) for cell in cells), style=style)


def _column(table: Table, title: str, *, words: bool) -> None:
    """Add a column that loses nothing on a narrow terminal: words that do not fit are folded.

    Numbers stay whole as long as there is any room: half a number is a wrong number.
    """
    if words:
        table.add_column(title, overflow="fold")
    else:
        table.add_column(title, justify="right", overflow="fold", min_width=NUMBER_WIDTH)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def units_of(kind: Kind, torque_unit: str) -> dict[str, str]:
    """Return the units of masses, springs and dampers for a torque in N m, N, or A (motor current)."""
    if torque_unit != "A":
        return UNITS[kind]
    position = UNITS[kind]["position"]
    return {
        "mass": f"A s2/{position}",
        "spring": f"A/{position}",
        "damper": f"A s/{position}",
        "position": position,
    }


def model_table(
    model: MachineModel, truth: MachineModel | None, torque_units: Sequence[str] = ()
) -> Table:
    """Return masses, springs, dampers and couplings with their 95 % intervals.

    Parameters
    ----------
    model, truth
        Identified model, and what a simulated machine really is.
    torque_units
        One an axis; N m or N where left out.
    """
    units = [
        units_of(axis.kind, torque_units[k] if torque_units else "")
        for k, axis in enumerate(model.axes)
    ]
    table = Table(box=None, padding=(0, 1))
    for title in ("axis", "what", "value", "± (95 %)", "unit"):
        _column(table, title, words=title in ("axis", "what", "unit"))
    if truth is not None:
        _column(table, "simulated truth", words=False)
        _column(table, "error", words=False)
    for k, axis in enumerate(model.axes):
        true_axis = truth.axes[k] if truth else None
        for what, plural in (
            ("mass", "masses"),
            ("spring", "springs"),
            ("damper", "dampers"),
        ):
            values: Sequence[Estimate] = getattr(axis, plural)
            known: Sequence[Estimate | None] = (
                getattr(true_axis, plural) if true_axis else [None] * len(values)
            )
            for j, (value, true) in enumerate(zip_longest(values, known[: len(values)])):
                _row(table, axis.name, f"{what} {j + 1}", value, units[k][what], true, truth)
        for what, friction in (
            ("viscous friction, motor", axis.viscous_friction),
            ("viscous friction, load", axis.load_friction),
        ):
            if friction.value != 0.0:
                true_friction = None
                if true_axis is not None:
                    true_friction = (
                        true_axis.load_friction if "load" in what else true_axis.viscous_friction
                    )
                _row(
                    table,
                    axis.name,
                    what,
                    friction,
                    units[k]["damper"],
                    true_friction,
                    truth,
                )
    true_couplings: Mapping[tuple[str, ...], float] = (
        {tuple(sorted(c.axes)): c.value for c in truth.couplings} if truth else {}
    )
    for c in model.couplings:
        true_value = true_couplings.get(tuple(sorted(c.axes)), 0.0) if truth else None
        _row(
            table,
            " - ".join(c.axes),
            "coupling",
            Estimate(c.value, c.std),
            units[0]["mass"],
            Estimate(true_value) if true_value is not None else None,
            truth,
        )
    for effect in model.effects:
        words = str(effect["effect"]).replace("_", " ")
        for name, found in effect["parameters"].items():
            value = Estimate(float(found["value"]), float(found.get("std", float("nan"))))
            _row(table, str(effect["axis"]), f"{words}, {name}", value, found["unit"], None, truth)
    return table


def _row(
    table: Table,
    axis: str,
    what: str,
    value: Estimate,
    unit: str,
    true: Estimate | None,
    truth: MachineModel | None,
) -> None:
    interval = f"{1.96 * value.std:.2g}" if value.std == value.std else "not known"
    cells = [axis, what, f"{value.value:.5g}", interval, unit]
    if truth is not None and true is not None:
        error = f"{100 * (value.value / true.value - 1):+.2f} %" if true.value else ""
        cells += [f"{true.value:g}", error]
    _add(table, *cells)


def parameter_rows(
    rows: Sequence[Mapping[str, Any]], drive_units: Mapping[Any, Any] | None
) -> Table:
    """Return old and new parameters, in the drives' units too where given, and what was read back."""
    table = Table(box=None, padding=(0, 1))
    in_drive = () if drive_units is None else ("old (drive)", "new (drive)")
    for title in ("axis", "parameter", "old", "new", "unit", *in_drive, "read back"):
        _column(table, title, words=title in ("axis", "parameter", "unit"))
    for row in rows:
        cells = [
            row["axis"],
            row["name"],
            f"{row['before']:.6g}",
            f"{row['after']:.6g}",
            row["unit"] if row["unit"] != "1" else "",
        ]
        if drive_units is not None:
            cells += [_plain(v) for v in drive_units.get((row["axis"], row["name"]), ("", ""))]
        cells.append("" if row["read_back"] is None else f"{row['read_back']:.6g}")
        _add(table, *cells, style="dim" if row["before"] == row["after"] else "")
    return table


def _plain(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def show_result(console: Console, result: SessionResult) -> None:
    """Show the parameters, and where everything is."""
    if result.write_back is not None:
        console.print("\n[bold]Controller parameters[/bold]")
        show_parameters(console, result.write_back)
    console.print(
        Text(
            f"\nMachine time {_clock(result.machine_time)}, wall time {_clock(result.wall_time)}. "
            f"Everything is in {result.folder}; responses.png there shows measurement and model."
        )
    )


def show_parameters(console: Console, write_back: WriteBack) -> None:
    """Show old and new parameters, what was read back, and where the new ones are."""
    console.print(parameter_table_of(write_back, console.width))
    console.print(Text(f"  {write_back.sentence}"))


def parameter_table_of(write_back: WriteBack, width: int) -> Table:
    """Return old and new parameters, in the drives' own units too where the terminal is wide enough."""
    raw = {(c.axis, c.name): (c.before_raw, c.after_raw) for c in write_back.changes}
    return parameter_rows(parameter_table(write_back), raw if width >= WIDE else None)
