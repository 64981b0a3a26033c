"""Commands and exit codes.

0 done; 2 wrong use or profile; 3 refused before motion; 4 stopped for safety; 5 data not good enough
to identify; 6 write-back failed and was restored; 7 write-back failed and could not be restored, or all
was done but drives hold what was set for its time; 130 stopped by the user, machine safe.  Whatever
ended a command: 4 if a drive may still be enabled, unless it is about a write (6 and 7).
"""

import sys
import tempfile
import traceback
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime
from errno import (
    EACCES,
    EDQUOT,
    EFBIG,
    EINVAL,
    EIO,
    EISDIR,
    ELOOP,
    ENAMETOOLONG,
    ENOSPC,
    ENOTDIR,
    EPERM,
    EROFS,
)
from io import TextIOWrapper
from pathlib import Path
from typing import NoReturn

import typer
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
    may_be_enabled,
)
from fieldtool.cli.check import check
from fieldtool.cli.criticise import criticise
from fieldtool.cli.design import design
from fieldtool.cli.identify import compare, identify
from fieldtool.cli.output import drop_output, told
from fieldtool.cli.profile import profile_app
from fieldtool.cli.recordings import export, import_
from fieldtool.cli.replay import replay_command
from fieldtool.cli.report import report
from fieldtool.cli.run import demo, measure, run
from fieldtool.cli.scan import scan
from fieldtool.cli.simulate import simulate
from fieldtool.cli.tools import tools_app
from fieldtool.cli.write import restore, write
from fieldtool.errors import (
    FieldtoolError,
    FileFormatError,
    IdentificationError,
    NoSuchAxisError,
    NoSuchToolError,
    NotPutBackError,
    OutputError,
    PlanRefusedError,
)

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Commissioning of elastic multi-axis machines over CANopen drives.",
)

EXIT_CODES: tuple[tuple[type[Exception], int], ...] = (
    (UserStopError, 130),
    (WriteBackMixedError, 7),
    (NotPutBackError, 7),
    (WriteBackError, 6),
    (SafetyStopError, 4),
    (IdentificationError, 5),
    (ProfileError, 2),
    (FileFormatError, 2),
    (NoSuchAxisError, 2),
    (NoSuchToolError, 2),
    (PlanRefusedError, 3),
    (OutputError, 3),
    (NothingMovedError, 3),
    (BusError, 3),
    (SdoError, 3),
    (FieldtoolError, 3),
    (DrivesError, 3),
)

STOPPED = 4
ABOUT_A_WRITE = {6, 7}
"""Codes that stay what they are where a drive may still be enabled: they say what drives hold."""
NAMED_BADLY = {ENAMETOOLONG, EACCES, EPERM, ELOOP, ENOTDIR, EISDIR, EINVAL}
"""What the operating system says of a name that was given, or of the rights to what it names."""
NO_ROOM = {ENOSPC, EDQUOT, EFBIG, EROFS, EIO}
"""What it says of a place where nothing can be written."""
LONGEST_NAME = 80

app.command()(run)
app.command()(demo)
app.command()(measure)
app.command()(identify)
app.command()(compare)
app.command()(write)
app.command()(restore)
app.command("import")(import_)
app.command()(export)
app.command()(scan)
app.command()(check)
app.command("replay")(replay_command)
app.command()(criticise)
app.command()(design)
app.command()(report)
app.command()(simulate)
app.add_typer(profile_app, name="profile")
app.add_typer(tools_app, name="tools")


def exit_code(error: BaseException, otherwise: int = 1) -> int:
    """Return the exit code of an error; ``otherwise`` if it is none of the tool's own.

    No code that is read as a machine at rest is returned where a drive may still be enabled.
    """
    code = next((code for kind, code in EXIT_CODES if isinstance(error, kind)), otherwise)
    return STOPPED if may_be_enabled(error) and code not in ABOUT_A_WRITE else code


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; errors become one sentence on standard error and an exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # what its encoding has no letters for, become marks
            stream.reconfigure(errors="replace")
    try:
        # matrices here are small: threads of linear algebra only stand in each other's way
        with threadpool_limits(limits=1):
            app(args=None if arguments is None else list(arguments))
    except (FieldtoolError, DrivesError) as error:
        _tell(f"{error}")
        _tell_notes(error)
        sys.exit(exit_code(error))
    except KeyboardInterrupt as error:
        _tell("stopped by the user")
        _tell_notes(error)
        sys.exit(exit_code(error, 130))
    except OSError as error:
        known = NAMED_BADLY | NO_ROOM if error.filename is not None else {ENOSPC}
        if error.errno not in known:
            _defect(error)
        where = "the output" if error.filename is None else str(error.filename)
        drop_output()
        _tell(f"{where[:LONGEST_NAME]}: {error.strerror}")
        _tell_notes(error)
        sys.exit(exit_code(error, 2 if error.errno in NAMED_BADLY else 3))
    except Exception as error:  # a defect of the tool: still one sentence, and nothing lost
        _defect(error)


def _defect(error: Exception) -> NoReturn:
    """Say what is known of the machine, that the tool has a defect, and keep its details."""
    _tell_notes(error)
    stopped = (
        "Axes were told to stop, not all have said that they did: see above."
        if may_be_enabled(error)
        else "If axes were moving, they were stopped."
    )
    _tell(
        f"unexpected {type(error).__name__}: {error}. {stopped} "
        f"This is a defect of fieldtool; please report it{_kept(traceback.format_exc())}"
    )
    sys.exit(exit_code(error))


def _notes(error: BaseException) -> tuple[str, ...]:
    """Return what is to be said besides an error, each sentence once."""
    return tuple(dict.fromkeys(getattr(error, "__notes__", ())))


def _tell_notes(error: BaseException) -> None:
    for note in _notes(error):
        _tell(note)


def _tell(sentence: str) -> None:
    """Say something on standard error; the terminal may be gone."""
    with suppress(OSError):
        sys.stderr.write(told(f"fieldtool: {sentence}") + "\n")


def _kept(details: str) -> str:
    """Keep what a defect leaves in a file; return where, in words."""
    file = Path(tempfile.gettempdir()) / f"fieldtool-defect-{datetime.now():%Y%m%d-%H%M%S}.txt"
    try:
        file.write_text(details, encoding="utf-8")
    except OSError:
        return ""
    return f" with {file}"
