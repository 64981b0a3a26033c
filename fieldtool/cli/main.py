"""Commands and exit codes.

0 done; 2 wrong use or profile; 3 refused before motion; 4 stopped for safety; 5 data not good enough
to identify; 6 write-back failed and was restored; 7 write-back failed and could not be restored; 130
stopped by the user, machine safe.
"""

import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated, ParamSpec

import typer
from rich.console import Console
from threadpoolctl import threadpool_limits

from drives.errors import (
    BusError,
    DrivesError,
    NothingMovedError,
    ProfileError,
    SafetyStopError,
    SdoError,
    UserStopError,
    WriteBackError,
    WriteBackMixedError,
)
from drives.profile import MachineProfile
from fieldtool import workflow
from fieldtool.cli.asking import may_write
from fieldtool.cli.bus_options import Bitrate, Channel, Interface, on_bus
from fieldtool.cli.check import check
from fieldtool.cli.criticise import criticise
from fieldtool.cli.design import ResponseChoice, check_response, design
from fieldtool.cli.distinguish import ToDistinguish, tell_apart
from fieldtool.cli.output import Json, console_of, indented, print_json
from fieldtool.cli.profile import profile_app
from fieldtool.cli.replay import replay_command
from fieldtool.cli.report import report
from fieldtool.cli.restored import show_restored
from fieldtool.cli.scan import scan
from fieldtool.cli.screen import (
    TerminalScreen,
    model_table,
    show_parameters,
    show_result,
)
from fieldtool.cli.simulate import simulate
from fieldtool.cli.stop_key import StopKey, may_move, stop_key
from fieldtool.cli.tools import tools_app
from fieldtool.cli.tracing import TraceFile, TraceWanted, trace_path
from fieldtool.errors import (
    FieldtoolError,
    FileFormatError,
    IdentificationError,
    NoSuchAxisError,
    OutputError,
    PlanRefusedError,
)
from fieldtool.records.session_folder import SessionFolder

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Commissioning of elastic multi-axis machines over CANopen drives.",
)

EXIT_CODES: tuple[tuple[type[Exception], int], ...] = (
    (UserStopError, 130),
    (WriteBackMixedError, 7),
    (WriteBackError, 6),
    (SafetyStopError, 4),
    (IdentificationError, 5),
    (ProfileError, 2),
    (FileFormatError, 2),
    (NoSuchAxisError, 2),
    (PlanRefusedError, 3),
    (OutputError, 3),
    (NothingMovedError, 3),
    (BusError, 3),
    (SdoError, 3),
    (FieldtoolError, 3),
    (DrivesError, 3),
)

Machine = Annotated[str, typer.Argument(help="Name of a machine profile, or path of its file.")]
Out = Annotated[
    Path | None, typer.Option("--out", help="Session folder; a new one in sessions/ otherwise.")
]
Yes = Annotated[bool, typer.Option("--yes", help="Do not ask before moving and writing.")]
Verify = Annotated[
    bool,
    typer.Option(
        "--verify/--no-verify",
        help="Try old and new parameters on the machine by small moves; what fails is taken back.",
    ),
]
Store = Annotated[
    bool, typer.Option("--store", help="Keep the new parameters in non-volatile memory too.")
]
Plan = Annotated[
    str,
    typer.Option(
        "--plan",
        help="How to measure: fast (all axes at once under position control, about a minute) or classic "
        "(stepped sines; axes float in turn, about an hour).",
    ),
]
Seconds = Annotated[
    float | None,
    typer.Option(
        "--time", help="Seconds of excitation that the fast plan may take.", min=1.0, max=1800.0
    ),
]
PlanOnly = Annotated[
    bool, typer.Option("--plan-only", help="Show what would be measured, and end there.")
]
Motor = Annotated[
    str,
    typer.Option(
        "--motor-inertia",
        help="measured: from the high-frequency gain; data-sheet: from the machine profile.",
    ),
]


P = ParamSpec("P")


class _StoppableScreen:
    """A screen at which a session ends, if the user asked for it, before anything else is shown.

    Sentences are shown all the same: they may be what a motion that was stopped has to say.
    """

    def __init__(self, screen: workflow.Screen, key: StopKey) -> None:
        self._screen, self._key = screen, key
        self.say, self.progress, self.ready = screen.say, screen.progress, screen.ready
        self.stage = self._unless_stopped(screen.stage)
        self.doing = self._unless_stopped(screen.doing)
        self.plan = self._unless_stopped(screen.plan)
        self.fast_plan = self._unless_stopped(screen.fast_plan)
        self.found = self._unless_stopped(screen.found)
        self.designed = self._unless_stopped(screen.designed)
        self.verified = screen.verified

    def _unless_stopped(self, show: Callable[P, None]) -> Callable[P, None]:
        def shown(*arguments: P.args, **named: P.kwargs) -> None:
            self._key.check()
            show(*arguments, **named)

        return shown


def _folder(out: Path | None, name: str) -> Path:
    if out is not None:
        return out
    return Path("sessions") / f"{Path(name).stem}-{datetime.now():%Y%m%d-%H%M%S}"


def _options(
    plan: str,
    write: bool,
    store: bool,
    motor: str,
    seconds: float | None = None,
    trace: Path | None = None,
    verify: bool = True,
    response: str = "normal",
) -> workflow.Options:
    check_response(response)
    if plan not in ("classic", "fast"):
        raise typer.BadParameter(f"no plan is called {plan!r}; there are: fast, classic")
    if plan == "classic" and seconds is not None:
        raise typer.BadParameter(
            "--time is for the fast plan; the classic plan takes what it needs"
        )
    if motor not in ("measured", "data-sheet"):
        raise typer.BadParameter(f"--motor-inertia is measured or data-sheet, got {motor!r}")
    return workflow.Options(
        plan="classic" if plan == "classic" else "fast",
        excitation_time=seconds,
        write=write,
        store=store,
        response=response,
        motor_inertia="measured" if motor == "measured" else "data sheet",
        trace=trace,
        verify=_tried(verify, store),
    )


def _tried(verify: bool, store: bool) -> bool:
    if store and not verify:
        raise typer.BadParameter("only parameters that were tried on the machine are stored")
    return verify


@app.command()
def run(
    machine: Machine,
    plan: Plan = "fast",
    write: Annotated[
        bool, typer.Option("--write/--no-write", help="Write the new parameters into the drives.")
    ] = False,
    yes: Yes = False,
    store: Store = False,
    verify: Verify = True,
    motor_inertia: Motor = "measured",
    seconds: Seconds = None,
    response: ResponseChoice = "normal",
    plan_only: PlanOnly = False,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    trace: TraceWanted = False,
    trace_file: TraceFile = None,
    out: Out = None,
    as_json: Json = False,
) -> None:
    """MOVES THE MACHINE. Measure, identify, design and, with --write, write back."""
    folder = _folder(out, machine)
    traced = trace_path(trace, trace_file, folder)
    options = _options(
        plan, write, store, motor_inertia, seconds, traced, verify, response=response
    )
    console = console_of(as_json)
    if plan_only:
        profile = on_bus(machine, interface, channel, bitrate)
        _show_plan(profile, options, console, as_json)
        return
    with stop_key() as key, TerminalScreen(console, may_move(yes)) as screen:
        result = workflow.run(
            on_bus(machine, interface, channel, bitrate),
            folder,
            options,
            screen=_StoppableScreen(screen, key),
            confirm=may_write(console, key, yes=yes, store=store),
            stop_requested=key,
        )
    show_result(console, result)
    if as_json:
        print_json(result.as_dict())


@app.command()
def demo(
    plan: Plan = "fast",
    write: Annotated[
        bool, typer.Option("--write/--no-write", help="Write the new parameters into the drives.")
    ] = True,
    store: Store = False,
    machine: Annotated[
        str, typer.Option("--machine", help="Another packaged simulated machine.")
    ] = "paper-3x3",
    seconds: Seconds = None,
    response: ResponseChoice = "normal",
    trace: TraceWanted = False,
    trace_file: TraceFile = None,
    out: Out = None,
    as_json: Json = False,
) -> None:
    """Do the whole job on the packaged simulated machine: no hardware, no arguments."""
    run(
        machine,
        plan,
        write,
        yes=True,
        store=store,
        motor_inertia="measured",
        seconds=seconds,
        response=response,
        trace=trace,
        trace_file=trace_file,
        out=out,
        as_json=as_json,
    )


@app.command()
def measure(
    machine: Machine,
    plan: Plan = "fast",
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before moving.")] = False,
    seconds: Seconds = None,
    plan_only: PlanOnly = False,
    to_distinguish: ToDistinguish = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    trace: TraceWanted = False,
    trace_file: TraceFile = None,
    out: Out = None,
    as_json: Json = False,
) -> None:
    """MOVES THE MACHINE. Measure only; the recording is in the session folder."""
    folder = _folder(out, machine)
    traced = trace_path(trace, trace_file, folder)
    options = _options(plan, False, False, "measured", seconds, traced)
    console = console_of(as_json)
    if to_distinguish is not None:
        if plan_only:
            raise typer.BadParameter(
                "--plan-only and --to-distinguish: leave --plan-only and --yes out; the plan is "
                "shown, and nothing moves without your answer"
            )
        with stop_key() as key, TerminalScreen(console, may_move(yes)) as screen:
            tell_apart(
                on_bus(machine, interface, channel, bitrate), to_distinguish, folder, options,
                _StoppableScreen(screen, key), key, console, as_json,
            )  # fmt: skip
        return
    if plan_only:
        profile = on_bus(machine, interface, channel, bitrate)
        _show_plan(profile, options, console, as_json)
        return
    with stop_key() as key, TerminalScreen(console, may_move(yes)) as screen:
        seconds = workflow.measure(
            on_bus(machine, interface, channel, bitrate),
            folder,
            options,
            screen=_StoppableScreen(screen, key),
            stop_requested=key,
        )
    console.print(f"{seconds:.0f} s of machine time; the recording is in {folder}")
    if as_json:
        print_json({"folder": str(folder), "time": {"machine_s": seconds}})


def _show_plan(
    machine: MachineProfile, options: workflow.Options, console: Console, as_json: bool
) -> None:
    """Show the fast plan for a machine; nothing moves."""
    if options.plan != "fast":
        raise typer.BadParameter("--plan-only is for the fast plan")
    with TerminalScreen(console) as screen:
        planned = workflow.plan(machine, options, screen=screen)
    if as_json:
        print_json(planned.as_dict())


@app.command()
def identify(
    source: Annotated[Path, typer.Argument(help="Session folder, or recording (FILE.h5).")],
    masses: Annotated[
        list[str] | None, typer.Option("--masses", help="Chain length, as AXIS=N; may be repeated.")
    ] = None,
    motor_inertia: Motor = "measured",
    seconds: Seconds = None,
    plan_only: Annotated[
        bool,
        typer.Option("--plan-only", help="Show what the next measurement should be, as well."),
    ] = False,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", help="Draw measured and modelled response (FILE.png)."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Identify masses, springs, couplings and dampers from a recording."""
    console = console_of(as_json)
    options = _options("fast", False, False, motor_inertia, seconds)
    planned, lengths = None, _lengths(masses or [])
    with TerminalScreen(console) as screen:
        screen.doing("find modes and numbers of masses, fit masses, springs, couplings and dampers")
        if plan_only:
            found, planned = workflow.next_plan(source, options, lengths)
        else:
            found = workflow.identify(source, options, lengths)
    if picture is not None:
        workflow.draw(found, picture)
    console.print(model_table(found.model, None, found.torque_units))
    if found.chain is not None:
        for line in found.chain.sentences:
            console.print(indented(line))
    for note in found.notes:
        console.print(indented(f"{note}"))
    if planned is not None:
        with TerminalScreen(console) as screen:
            screen.stage("What the next measurement should be")
            screen.fast_plan(planned)
    if as_json:
        data = {"model": found.model.as_dict(), "notes": list(found.notes)}
        print_json({**data, "plan": planned.as_dict()} if planned is not None else data)


@app.command()
def compare(
    recording: Annotated[Path, typer.Argument(help="Recording (FILE.h5) with a load-side signal.")],
    model: Annotated[
        Path | None, typer.Option("--model", help="model.yaml; identified otherwise.")
    ] = None,
    low: Annotated[float, typer.Option(help="Lowest frequency to compare, Hz.")] = 11.0,
    high: Annotated[float, typer.Option(help="Highest frequency to compare, Hz.")] = 200.0,
    as_json: Json = False,
) -> None:
    """Predict a signal that no fit has seen (the load side), and print the error."""
    console = console_of(as_json)
    comparisons = workflow.compare(recording, model, (low, high))
    for c in comparisons:
        console.print(
            f"{c.experiment}: load-side response, {c.frequencies.size} lines from {low:g} to {high:g} "
            f"Hz, never used in the fit: median error {c.median_db:.2f} dB and "
            f"{c.median_degrees:.2f} degrees."
        )
    if as_json:
        print_json(
            {
                "comparisons": [
                    {
                        "experiment": c.experiment,
                        "lines": int(c.frequencies.size),
                        "median_db": c.median_db,
                        "median_degrees": c.median_degrees,
                    }
                    for c in comparisons
                ]
            }
        )


@app.command()
def write(
    folder: Annotated[Path, typer.Argument(help="Session folder with a tuning.")],
    yes: Yes = False,
    store: Store = False,
    verify: Verify = True,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    trace: TraceWanted = False,
    trace_file: TraceFile = None,
) -> None:
    """MOVES THE MACHINE. Write the session folder's tuning: backup, write, read back, try."""
    console = console_of(False)
    traced = trace_path(trace, trace_file, folder)
    options = workflow.Options(write=True, store=store, verify=_tried(verify, store), trace=traced)
    with stop_key() as key, TerminalScreen(console, may_move(yes)) as screen:
        stoppable = _StoppableScreen(screen, key)
        ask = may_write(console, key, yes=yes, store=store)
        profile = on_bus(SessionFolder.existing(folder).profile, interface, channel, bitrate)
        result = workflow.write(
            folder, options, ask, screen=stoppable, machine=profile, stop_requested=key
        )
    show_parameters(console, result)


@app.command()
def restore(
    backup: Annotated[Path, typer.Argument(help="Backup file, or the session folder with it.")],
    machine: Annotated[
        str | None, typer.Option("--machine", help="Machine profile; the session's otherwise.")
    ] = None,
    store: Annotated[
        bool, typer.Option("--store", help="Store the restored parameters too.")
    ] = False,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    same_drives: Annotated[
        bool,
        typer.Option(
            "--same-drives",
            help="You know that drives without a serial number are those of the backup.",
        ),
    ] = False,
    without: Annotated[
        list[str] | None,
        typer.Option(
            "--without",
            help="Leave this axis as it is: its drive is gone or was exchanged; may be repeated.",
        ),
    ] = None,
    trace: TraceWanted = False,
    trace_file: TraceFile = None,
    as_json: Json = False,
) -> None:
    """Bring a backup of the drives' parameters back, or take back a write that was cut off."""
    folder = backup.parent if backup.is_file() else backup
    if machine is None:
        machine = str(SessionFolder.existing(folder).profile)
    traced = trace_path(trace, trace_file, folder)
    console = console_of(as_json)
    with stop_key(), TerminalScreen(console) as screen:
        profile = on_bus(machine, interface, channel, bitrate)
        restored = workflow.restore(
            profile, backup, store, traced, same_drives, without or (), screen
        )
    show_restored(console, restored)
    if as_json:
        print_json(restored.as_dict())


@app.command("import")
def import_(
    folder: Annotated[Path, typer.Argument(help="Folder with recording.yaml and CSV files.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Recording to write (FILE.h5).")],
) -> None:
    """Turn a folder with recording.yaml and CSV files into a recording."""
    recording = workflow.import_folder(folder, out)
    rows = sum(e.samples for e in recording.experiments)
    console_of(False).print(f"{out}: {len(recording.experiments)} experiments, {rows} rows.")


@app.command()
def export(
    recording: Annotated[Path, typer.Argument(help="Recording (FILE.h5).")],
    folder: Annotated[Path, typer.Argument(help="Folder to write.")],
) -> None:
    """Turn a recording into a folder with recording.yaml and CSV files."""
    workflow.export_folder(recording, folder)
    console_of(False).print(f"{folder} written.")


app.command()(scan)
app.add_typer(profile_app, name="profile")
app.add_typer(tools_app, name="tools")
app.command()(check)
app.command("replay")(replay_command)
app.command()(criticise)
app.command()(design)
app.command()(report)
app.command()(simulate)


def _lengths(masses: Sequence[str]) -> dict[str, int]:
    lengths = {}
    for text in masses:
        name, equals, count = text.partition("=")
        if not equals or not count.isdigit() or not 1 <= int(count) <= 16:
            raise typer.BadParameter(f"--masses takes AXIS=N with N from 1 to 16, got {text!r}")
        if name in lengths:
            raise typer.BadParameter(f"--masses names {name} twice")
        lengths[name] = int(count)
    return lengths


def exit_code(error: BaseException) -> int:
    """Return the exit code of an error."""
    return next((code for kind, code in EXIT_CODES if isinstance(error, kind)), 1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; errors become one sentence on standard error and an exit code."""
    try:
        # matrices here are small: threads of linear algebra only stand in each other's way
        with threadpool_limits(limits=1):
            app(args=None if arguments is None else list(arguments))
    except (FieldtoolError, DrivesError) as error:
        sys.stderr.write(f"fieldtool: {error}\n")
        for note in dict.fromkeys(getattr(error, "__notes__", ())):
            sys.stderr.write(f"fieldtool: {note}\n")
        sys.exit(exit_code(error))
    except KeyboardInterrupt:
        sys.stderr.write("fieldtool: stopped by the user\n")
        sys.exit(130)
    except Exception as error:  # a defect of the tool: still one sentence, and nothing lost
        report = (
            Path(tempfile.gettempdir()) / f"fieldtool-defect-{datetime.now():%Y%m%d-%H%M%S}.txt"
        )
        report.write_text(traceback.format_exc(), encoding="utf-8")
        sys.stderr.write(
            f"fieldtool: unexpected {type(error).__name__}: {error}. If axes were moving, they were "
            f"stopped. This is a defect of fieldtool; please report it with {report}\n"
        )
        sys.exit(1)
