"""What can go wrong in the tool, as a tree; what drives do wrong stands in ``drives.errors``.

::

    FieldtoolError
    ├── FileFormatError          a file is not what it should be (file, line, column, what to do)
    ├── OutputError              a folder or file can not be written
    ├── NoSuchAxisError          an axis was named that the recording does not have
    ├── NoSuchToolError          a tool set was named that the machine does not have
    ├── UnfinishedWriteError     a write-back was cut off and has to be taken back first
    ├── NotPutBackError          drives hold what a session had set for its time
    ├── PlanRefusedError         the experiment would leave a limit, or nothing safe is possible
    └── IdentificationError      the data do not allow the answer
        ├── LoopUnstableError    a position loop became unstable while it was measured
        ├── NotAChainError       the modes can not come from chains driven at their ends
        └── NotEnoughDataError   too few lines, too much noise, nothing moved
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LONGEST = 1000
"""Characters of a message about a file."""


class FieldtoolError(Exception):
    """Root of all that the tool itself refuses; its message is one sentence for a person."""


@contextmanager
def noting(sentence: str) -> Iterator[None]:
    """Have whatever is raised inside say this besides, if there is anything to say."""
    try:
        yield
    except BaseException as error:
        if sentence:
            error.add_note(sentence)
        raise


class FileFormatError(FieldtoolError):
    """A file is not what it should be.

    Scenarios: a missing column, text where a number belongs, a wrong sample period, an unknown key.
    """

    def __init__(self, path: Path | str, message: str, line: int | None = None) -> None:
        self.path, self.line = Path(path), line
        where = f"{path}:{line}" if line is not None else f"{path}"
        super().__init__(f"{where}: {_presentable(message)}")


def _presentable(message: str) -> str:
    """Return what a file's own words can not spoil: no control characters, no pages of text."""
    shown = "".join(c if c.isprintable() else " " for c in message)
    return (
        shown if len(shown) <= LONGEST else f"{shown[: LONGEST // 2]} ... {shown[-LONGEST // 2 :]}"
    )


class OutputError(FieldtoolError):
    """A result can not be written: disk full, no such folder, no permission."""


class NoSuchAxisError(FieldtoolError):
    """An axis was named that is not there; the message lists those that are."""


class NoSuchToolError(FieldtoolError):
    """A tool set was named that is not there; the message lists those that are."""


class UnfinishedWriteError(FieldtoolError):
    """A write-back into these drives was cut off; nothing else may be done before it is taken back."""


class NotPutBackError(FieldtoolError):
    """Drives still hold what a session had set for its time; it did all else, or did not write."""


class PlanRefusedError(FieldtoolError):
    """The experiment was refused before anything moved."""


class IdentificationError(FieldtoolError):
    """The data do not allow the answer that was asked for."""


class LoopUnstableError(IdentificationError):
    """An oscillation of a position loop grew by itself while it was measured; the axes were stopped."""

    def __init__(self, message: str, *, axis: str, frequency: float) -> None:
        self.axis = axis
        self.frequency = frequency
        """Of the growing oscillation, Hz."""
        super().__init__(message)


class NotAChainError(IdentificationError):
    """The modes can not come from chains of masses and springs driven at their ends."""


class NotEnoughDataError(IdentificationError):
    """Too few frequencies, too much noise, or nothing moved."""
