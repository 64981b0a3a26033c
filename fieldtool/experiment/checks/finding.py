"""What a check found."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

from drives.errors import BusError, DrivesError, NodeAbsentError, UserStopError

Status = Literal["pass", "warn", "fail", "not tried"]
WORST: tuple[Status, ...] = ("fail", "warn", "not tried", "pass")
"""From bad to good."""


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    check: str
    """What was checked."""
    status: Status
    found: str
    """What is so, with values and units."""
    axis: str = ""
    """Name of the axis; empty for what belongs to the whole machine."""
    todo: str = ""
    """What to do about it; empty where there is nothing to do."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``--json`` prints them."""
        return {
            "axis": self.axis or None,
            "check": self.check,
            "status": self.status,
            "found": self.found,
            "todo": self.todo or None,
        }


def worst(findings: Iterable[Finding]) -> Status:
    """Return the worst status; ``pass`` if there is nothing."""
    statuses = {one.status for one in findings}
    return next((status for status in WORST if status in statuses), "pass")


class Findings:
    """A list of findings that grows while a machine is checked."""

    def __init__(self) -> None:
        self.all: list[Finding] = []

    def note(self, check: str, status: Status, found: str, axis: str = "", todo: str = "") -> None:
        """Add one."""
        self.all.append(Finding(check, status, found, axis, todo))

    def add(self, findings: Iterable[Finding]) -> None:
        """Add several."""
        self.all += findings

    @property
    def failed(self) -> bool:
        """Whether anything failed."""
        return any(one.status == "fail" for one in self.all)

    @contextmanager
    def failing(self, check: str, axis: str) -> Iterator[list[bool]]:
        """Make an error of a drive a finding; the list that is given gets an entry if there was none.

        Raises
        ------
        BusError
            If the bus is gone: then nothing else can be checked either.
        UserStopError
            If the user asked to stop.
        """
        went: list[bool] = []
        try:
            yield went
        except (BusError, UserStopError):
            raise
        except DrivesError as error:
            absent = isinstance(error, NodeAbsentError)
            text = str(error).removeprefix(f"{axis}: ")
            self.note(check, "fail", text, axis, "See `fieldtool scan`." if absent else "")
        else:
            went.append(True)
