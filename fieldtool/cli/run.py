"""``fieldtool run``, ``demo`` and ``measure``: what moves all axes."""

from typing import Annotated

import typer
from rich.console import Console

from drives.profile import MachineProfile
from fieldtool import workflow
from fieldtool.cli.asking import WriteQuestion
from fieldtool.cli.bus_options import Bitrate, Channel, Interface, on_bus
from fieldtool.cli.distinguish import ToDistinguish, tell_apart
from fieldtool.cli.options import (
    Machine,
    Motor,
    Out,
    Plan,
    PlanOnly,
    ResponseChoice,
    Seconds,
    Store,
    Verify,
    Write,
    Yes,
    options_of,
    session_folder,
)
from fieldtool.cli.output import Json, console_of, print_json
from fieldtool.cli.screen import TerminalScreen, show_result
from fieldtool.cli.stop_key import may_move, stop_key
from fieldtool.cli.stoppable import StoppableScreen
from fieldtool.cli.tracing import TraceFile, TraceWanted, trace_path
from fieldtool.errors import noting


def run(
    machine: Machine,
    plan: Plan = "fast",
    write: Write = False,
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
    folder = session_folder(out, machine)
    traced = trace_path(trace, trace_file, folder)
    options = options_of(
        plan, write, store, motor_inertia, seconds, traced, verify, response=response
    )
    console = console_of(as_json)
    if plan_only:
        profile = on_bus(machine, interface, channel, bitrate)
        _show_plan(profile, options, console, as_json)
        return
    with stop_key() as key, TerminalScreen(console, may_move(yes)) as screen:
        ask = WriteQuestion(console, key, yes=yes, store=store)
        result = workflow.run(
            on_bus(machine, interface, channel, bitrate),
            folder,
            options,
            screen=StoppableScreen(screen, key),
            confirm=ask,
            stop_requested=key,
        )
    with noting("" if result.write_back is None else result.write_back.way_back):
        show_result(console, result, listed=ask.refused)
        if as_json:
            screen.print_json(result.as_dict())
    ask.end()
    screen.end()


def demo(
    plan: Plan = "fast",
    write: Write = True,
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
    folder = session_folder(out, machine)
    traced = trace_path(trace, trace_file, folder)
    options = options_of(plan, False, False, "measured", seconds, traced)
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
                screen, key, console, as_json,
            )  # fmt: skip
        screen.end()
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
            screen=StoppableScreen(screen, key),
            stop_requested=key,
        )
    console.print(f"{seconds:.0f} s of excitation; the recording is in {folder}")
    if as_json:
        times = {"excitation_s": seconds, "machine_s": seconds}
        screen.print_json({"folder": str(folder), "time": times})
    screen.end()


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
