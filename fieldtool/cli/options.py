"""Options that several commands share, and what they come to."""

from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from fieldtool import workflow
from fieldtool.design.tuning import RESPONSES
from fieldtool.errors import OutputError
from fieldtool.records.files import check_writable

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
ResponseChoice = Annotated[
    str,
    typer.Option(
        "--response",
        help=f"How near to the bound the new parameters go: {', '.join(RESPONSES)}.",
    ),
]
Write = Annotated[
    bool, typer.Option("--write/--no-write", help="Write the new parameters into the drives.")
]
Session = Annotated[Path, typer.Argument(help="Session folder.")]
Source = Annotated[Path, typer.Argument(help="Session folder, or recording (FILE.h5).")]


def session_folder(out: Path | None, name: str) -> Path:
    """Return the folder that was asked for, or a new one named after machine and time."""
    if out is not None:
        return out
    return Path("sessions") / f"{Path(name).stem}-{datetime.now():%Y%m%d-%H%M%S}"


def options_of(
    plan: str,
    write: bool,
    store: bool,
    motor: str,
    seconds: float | None = None,
    trace: Path | None = None,
    verify: bool = True,
    response: str = "normal",
) -> workflow.Options:
    """Return what a session is to do.

    Raises
    ------
    typer.BadParameter
        If options contradict each other, or name what there is none of.
    """
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
        verify=tried(verify, store),
    )


def check_response(response: str) -> None:
    """Refuse a response that there is none of."""
    if response not in RESPONSES:
        raise typer.BadParameter(f"--response is one of {', '.join(RESPONSES)}, got {response!r}")


def check_output(option: str, file: Path | None) -> None:
    """Refuse a file that could not be written, before anything is computed for it."""
    if file is None:
        return
    try:
        check_writable(file)
    except OutputError as error:
        raise typer.BadParameter(f"{option}: {error}") from None


def tried(verify: bool, store: bool) -> bool:
    """Return whether new parameters are tried; what is stored has to be."""
    if store and not verify:
        raise typer.BadParameter("only parameters that were tried on the machine are stored")
    return verify
