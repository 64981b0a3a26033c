"""What a session looks like on a terminal: where it is, how long it will take, what it found."""

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from types import TracebackType
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress as Bar
from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.text import Text

from fieldtool.cli.design import show_tuning
from fieldtool.cli.output import indented, print_json
from fieldtool.cli.progress import Left, bar_of, clock, long, short
from fieldtool.cli.sheet import Sheet
from fieldtool.design.tuning import Tuning
from fieldtool.design.verdict import Comparison
from fieldtool.errors import NotPutBackError
from fieldtool.experiment.forecast import AxisForecast
from fieldtool.experiment.multisine.runner import MultisineProgress
from fieldtool.experiment.stepped.plan import SweepPlan
from fieldtool.experiment.stepped.runner import Progress
from fieldtool.identify.likelihood.expected import Expected
from fieldtool.records.model import MachineModel
from fieldtool.report.numbers import UNITS, ModelNumber, model_numbers
from fieldtool.report.words import AT_ONCE, percent
from fieldtool.workflow import SessionResult, parameter_table
from fieldtool.workflow.planning import PlannedFast
from fieldtool.workflow.verified import Verified
from fieldtool.writeback.transaction import WriteBack

Ask = Callable[[str], bool]
WIDE = 110
"""Columns that the table with the drives' own units needs."""
QUIET_INTERVAL = 5.0
"""Seconds between progress lines where there is no terminal."""


class TerminalScreen:
    """Shows a session with ``rich``; a context manager, so that the terminal is left in order."""

    def __init__(self, console: Console, ask: Ask | None = None) -> None:
        self.console, self._ask = console, ask
        self._bar: Bar | None = None
        self._busy: Bar | None = None
        self._task: Any = None
        self._busy_task: Any = None
        self._busy_since: float | None = None
        self._last_shown = 0.0
        self.left: tuple[str, ...] = ()
        """Axes whose drives are not as they were before the session."""
        self._left_words = ""

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

    def doing(self, what: str, share: float | None = None) -> None:
        """Show what is computed, and for how long already; lines from time to time without a "
        "terminal.
        """
        if not self.console.is_terminal:
            if self._busy_since is None:
                self._busy_since = self._last_shown = perf_counter()
            elif perf_counter() - self._last_shown > QUIET_INTERVAL:
                self._last_shown = perf_counter()
                done = "" if share is None else f"{100 * share:.0f} %, "
                self.console.print(
                    indented(f"{done}{clock(self._last_shown - self._busy_since)}; {what}")
                )
            return
        if self._busy is None:
            self._busy = Bar(
                SpinnerColumn(table_column=short()),
                TimeElapsedColumn(table_column=short()),
                TextColumn("{task.description}", markup=False, table_column=long()),
                console=self.console,
                expand=True,
                transient=True,
                refresh_per_second=8,
            )
            self._busy.start()
            self._busy_task = self._busy.add_task("")
        done = "" if share is None else f"{100 * share:.0f} %  "
        self._busy.update(self._busy_task, description=f"{done}{what}")

    def say(self, sentence: str) -> None:
        """Show a sentence."""
        console = self._bar.console if self._bar else self.console
        console.print(indented(sentence, "yellow" if "!" in sentence else ""))

    def plan(self, plan: SweepPlan, expected: Sequence[AxisForecast], duration: float) -> None:
        """Show what will move, how far, and for how long."""
        self._close()
        sweeps = Sheet(
            "axis moved", "how", "others floating", "tones", "Hz", numbers=("tones",), whole=("Hz",)
        )
        for sweep in plan.sweeps:
            tones = [tone.frequency for tone in sweep.tones]
            sweeps.add(
                sweep.driven,
                sweep.kind,
                ", ".join(sweep.free) or "none, all held",
                str(len(tones)),
                f"{min(tones):.2f} - {max(tones):.2f}",
            )
        self.console.print(sweeps)
        self._show_moves(expected)
        self.console.print(
            indented(
                f"Simulated with the prior model: every limit is kept. About {clock(duration)} of "
                f"machine time, a cycle of {plan.cycle_time * 1000:g} ms."
            )
        )

    def fast_plan(self, planned: PlannedFast) -> None:
        """Show what will move, how far, for how long, and how well it will tell."""
        self._close()
        titles = ("part", "experiments", "lines", "left out", "Hz", "periods", "time")
        table = Sheet(*titles, numbers=titles[1:4], whole=titles[4:])
        for name, plan in (("pilot, weak", planned.pilot), ("main", planned.plan)):
            if plan is not None:
                f = plan.frequencies
                first = plan.experiments[0]
                table.add(
                    name,
                    str(len(plan.experiments)),
                    str(f.size),
                    str(first.detection.size),
                    f"{f[0]:.2f} - {f[-1]:.2f}",
                    f"{first.periods} x {first.period:.2f} s",
                    clock(plan.duration),
                )
        self.console.print(table)
        self._show_moves(planned.moves)
        self.console.print(
            indented(
                f"Simulated with the {planned.rests_on}: every limit is kept. "
                f"{clock(planned.duration)} of excitation, a cycle of "
                f"{planned.plan.cycle_time * 1000:g} ms. All axes move at once, and stay under "
                "position control."
            )
        )
        self.console.print(indented(expected_text(planned.accuracy)))

    def _show_moves(self, expected: Sequence[AxisForecast]) -> None:
        titles = ("axis", "moves at most", "speed", "torque", "following error")
        peaks = Sheet(*titles, whole=titles[1:])
        for axis in expected:
            peaks.add(
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
            self._close()
            self._bar = bar_of(self.console)
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
                indented(f"{100 * progress.done:.0f} %, {Left().render(task)}; {task.description}")
            )

    def ready(self) -> bool:
        """Ask a person at the terminal; a script has decided by its call."""
        self._close()
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
        self._close()
        show_tuning(self.console, tuning)

    def verified(self, result: Verified) -> None:
        """Show old, predicted and new figures on one scale."""
        self._close()
        self.console.print(verification_table(result.axes))
        words = {"verified": "The new parameters stand their trial.", "restored": ""}
        if words.get(result.verdict):
            self.console.print(indented(f"{words[result.verdict]}"))

    def not_put_back(self, axes: Sequence[str], sentence: str) -> None:
        """Keep for the command's end what stands among the warnings already."""
        self.left, self._left_words = tuple(axes), sentence

    def print_json(self, data: Mapping[str, Any]) -> None:
        """Print what a command that moves axes has done as one JSON object."""
        print_json({**data, "not_put_back": list(self.left)})

    def end(self) -> None:
        """End a command that has done and shown all it was to.

        Raises
        ------
        NotPutBackError
            If drives still hold what the session had set for its time.
        """
        if self.left:
            raise NotPutBackError(f"{self._left_words}. All else was done.")

    def _close(self) -> None:
        self._busy_since = None
        if self._busy is not None:
            self._busy.stop()
            self._busy = None
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


def _what_runs(progress: Progress | MultisineProgress) -> str:
    """Return what is being measured now."""
    if isinstance(progress, Progress):
        where = f"sweep {progress.sweep}/{progress.sweeps}"
        return f"{where}: {progress.name}, {progress.frequency:.2f} Hz"
    part = f"period {progress.period}/{progress.periods}" if progress.period else "run-in"
    return f"{progress.experiment}/{progress.experiments} {progress.name}, {part}"


def expected_text(expected: Expected) -> str:
    """Return the accuracy to expect as one sentence: the worst of each kind, 95 %."""
    parts = [
        f"{plural} within {percent(share)}"
        for kind, plural in (
            ("mass", "masses"),
            ("spring", "springs"),
            ("coupling", "couplings"),
            ("damper", "dampers"),
        )
        if 0 < (share := 1.96 * expected.relative(kind)) < np.inf
    ]
    return f"To expect (95 %): {', '.join(parts)}." if parts else "To expect: nothing is told."


def model_table(
    model: MachineModel, truth: MachineModel | None, torque_units: Sequence[str] = ()
) -> Sheet:
    """Return all numbers of a model with their 95 % intervals.

    Parameters
    ----------
    model, truth
        Identified model, and what a simulated machine really is.
    torque_units
        One an axis; N m or N where left out.
    """
    more = () if truth is None else ("simulated truth", "error")
    numbers = ("value", "± (95 %)", *more)
    table = Sheet("axis", "what", *numbers[:2], "unit", *more, numbers=numbers, gap=1)
    true: dict[tuple[str, str], float] = {}
    if truth is not None:
        true = {_place(n): n.value.value for n in model_numbers(truth)}
    for n in model_numbers(model, torque_units):
        cells = [n.axis, n.what, f"{n.value.value:.5g}", n.interval, n.unit]
        known = true.get(_place(n))
        if truth is not None and known is None and n.what == "coupling":
            known = 0.0
        if known is not None:
            error = f"{100 * (n.value.value / known - 1):+.2f} %" if known else ""
            cells += [f"{known:g}", error]
        table.add(*cells)
    return table


def _place(number: ModelNumber) -> tuple[str, str]:
    """What tells a number from all others; two axes in either order."""
    return " - ".join(sorted(number.axis.split(" - "))), number.what


def parameter_rows(
    rows: Sequence[Mapping[str, Any]], drive_units: Mapping[Any, Any] | None
) -> Sheet:
    """Return old and new parameters, in the drives' units too where given, and what was read back."""
    in_drive = () if drive_units is None else ("old (drive)", "new (drive)")
    numbers = ("old", "new", *in_drive, "read back")
    table = Sheet("axis", "parameter", *numbers[:2], "unit", *numbers[2:], numbers=numbers, gap=1)
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
        table.add(*cells, style="dim" if row["before"] == row["after"] else "")
    return table


def _plain(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def show_result(console: Console, result: SessionResult, *, listed: bool = False) -> None:
    """Show the parameters, unless they were listed just now, and where everything is."""
    if result.write_back is not None:
        if not listed:
            console.print(Text("\nController parameters", style="bold"))
        show_parameters(console, result.write_back, listed=listed)
        if not result.write_back.in_memory:
            console.print(indented(result.tuning.write_words(result.folder)))
    console.print(
        Text(
            f"\nMachine time {clock(result.moving_time)}, {clock(result.machine_time)} of it "
            f"excitation; wall time {clock(result.wall_time)}. Everything is in {result.folder}; "
            "report.html there, opened in a browser, shows what was found."
        )
    )


def show_parameters(console: Console, write_back: WriteBack, *, listed: bool = False) -> None:
    """Show old and new parameters, what was read back, and where the new ones are."""
    if not listed:
        console.print(parameter_table_of(write_back, console.width))
    console.print(indented(write_back.sentence))


def parameter_table_of(write_back: WriteBack, width: int) -> Sheet:
    """Return old and new parameters, in the drives' own units too where the terminal is wide enough."""
    raw = {(c.axis, c.name): (c.before_raw, c.after_raw) for c in write_back.changes}
    return parameter_rows(parameter_table(write_back), raw if width >= WIDE else None)


_FIGURES = (
    ("settles in", "settling_time", "s"),
    ("overshoot", "overshoot", ""),
    ("vibration after", "vibration", ""),
    ("following error", "following_error", ""),
    ("sensitivity peak", "sensitivity_peak", ""),
)
"""Title, name, unit that stands with each number: ``at once`` has none."""


def verification_table(axes: Sequence[Comparison]) -> Sheet:
    """Return each axis' figures before, as predicted, and after the write."""
    numbers = ("before", "predicted", "after")
    table = Sheet("axis", "figure", *numbers, "unit", numbers=numbers, gap=1)
    for one in axes:
        for title, name, unit in _FIGURES:
            cells = [
                ""
                if figures is None or (value := getattr(figures, name)) is None
                else AT_ONCE
                if name == "settling_time" and value == 0
                else f"{value:.3g} {unit}".rstrip()
                for figures in (one.before, one.predicted, one.after)
            ]
            has_none = unit or name == "sensitivity_peak"
            table.add(one.axis, title, *cells, "" if has_none else one.unit)
    return table
