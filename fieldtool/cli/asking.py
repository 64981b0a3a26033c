"""Asks a person before drives are written."""

from collections.abc import Callable, Sequence

import typer
from rich.console import Console

from drives.parameters import Change
from fieldtool.cli.output import told
from fieldtool.cli.screen import parameter_table_of
from fieldtool.cli.stop_key import StopKey, somebody_there
from fieldtool.errors import PlanRefusedError
from fieldtool.writeback.transaction import WriteBack


def may_write(
    console: Console, key: StopKey, *, yes: bool, store: bool
) -> Callable[[Sequence[Change]], bool]:
    """Return what shows old and new values and asks whether to write them.

    Without ``--yes`` and with nobody to ask it raises PlanRefusedError.
    """

    def ask(changes: Sequence[Change]) -> bool:
        key.check()
        if yes:
            return True
        planned = WriteBack((), tuple(changes), in_memory=False, stored=False, backup=None)
        console.print(parameter_table_of(planned, console.width))
        if not somebody_there():
            raise PlanRefusedError(
                "there is nobody to ask before the drives are written. Use --yes to write without "
                "asking. Nothing was written."
            )
        where = "working memory, and store them" if store else "working memory (not stored)"
        return typer.confirm(told(f"Write these parameters into the drives' {where}?"), err=True)

    return ask
