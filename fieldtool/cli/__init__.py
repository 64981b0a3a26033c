"""The command line: arguments in, tables and progress out, exit codes."""

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; see ``fieldtool.cli.main``.

    The commands are loaded here and not with this package, so that Ctrl-C in the first second, too,
    ends with one sentence.
    """
    try:
        from fieldtool.cli.main import main as run
    except KeyboardInterrupt:
        sys.stderr.write("fieldtool: stopped by the user; nothing was moved\n")
        sys.exit(130)
    run(arguments)
