"""Asks a person before drives are written."""

from collections.abc import Sequence

from rich.console import Console

from drives.errors import UserStopError
from drives.parameters import Change
from fieldtool.cli.output import confirmed
from fieldtool.cli.screen import parameter_table_of
from fieldtool.cli.stop_key import StopKey, somebody_there
from fieldtool.errors import PlanRefusedError
from fieldtool.writeback.transaction import WriteBack


class WriteQuestion:
    """Shows old and new values, and asks whether to write them.

    Raises
    ------
    PlanRefusedError
        Without ``--yes``, where there is nobody to ask.
    """

    def __init__(self, console: Console, key: StopKey, *, yes: bool, store: bool) -> None:
        self._console, self._key, self._yes, self._store = console, key, yes, store
        self.refused = False
        """Whether the answer was no."""

    def __call__(self, changes: Sequence[Change]) -> bool:
        """Return whether to write."""
        self._key.check()
        if self._yes:
            return True
        planned = WriteBack((), tuple(changes), in_memory=False, stored=False, backup=None)
        self._console.print(parameter_table_of(planned, self._console.width))
        if not somebody_there():
            raise PlanRefusedError(
                "there is nobody to ask before the drives are written. Use --yes to write without "
                "asking. Nothing was written."
            )
        where = "working memory, and store them" if self._store else "working memory (not stored)"
        self.refused = not confirmed(f"Write these parameters into the drives' {where}?")
        return not self.refused

    def end(self) -> None:
        """End a command that was refused here, after it has shown what it found.

        Raises
        ------
        UserStopError
            If the answer was no.
        """
        if self.refused:
            raise UserStopError(
                "not written, as you answered; the drives hold their old parameters."
            )
