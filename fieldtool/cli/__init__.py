"""The command line: arguments in, tables and progress out, exit codes."""

from fieldtool.cli.main import main

__all__ = ["main"]
