"""The session folder: where every stage leaves its result and finds that of the one before."""

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fieldtool.errors import FileFormatError, OutputError


@dataclass(frozen=True)
class SessionFolder:
    """Names of the files of one session."""

    path: Path

    @classmethod
    def create(cls, path: Path) -> "SessionFolder":
        """Make the folder, and see that it can be written, before anything is measured.

        Raises
        ------
        OutputError
            If it can not be made or written.
        """
        try:
            path.mkdir(parents=True, exist_ok=True)
            probe = path / ".writable"
            try:
                probe.write_bytes(b"x" * 4096)
            finally:
                probe.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(
                f"{path}: results can not be written here ({error.strerror}). Make it "
                "writable, or choose another folder (--out). Nothing was moved."
            ) from error
        return cls(path)

    @classmethod
    def existing(cls, path: Path) -> "SessionFolder":
        """Return a folder that holds something of a session.

        Raises
        ------
        FileFormatError
            If there is no such folder, or nothing of a session is in it.
        """
        folder = cls(path)
        try:
            path.stat()
        except PermissionError as error:
            raise FileFormatError(path, f"can not be looked into ({error.strerror}).") from None
        except OSError:
            raise FileFormatError(
                path,
                "does not exist. Give the folder of a session (--out of a run), or one of its files.",
            ) from None
        if not path.is_dir():
            raise FileFormatError(path, "is a file. Give the folder of a session.")
        if (path / "recording.yaml").is_file():
            raise FileFormatError(
                path,
                "holds a recording as CSV files. Make it one file first: "
                f"`fieldtool import {path} -o FILE.h5`, then give FILE.h5.",
            )
        if not any(p.is_file() for p in (folder.machine, folder.recording, folder.events)):
            raise FileFormatError(
                path,
                "is no session folder: neither machine.yaml nor recording.h5 is in it. "
                "`fieldtool run` and `fieldtool measure` make one.",
            )
        return folder

    @classmethod
    def of_source(cls, source: Path) -> "SessionFolder | None":
        """Return the session folder that was given, or None where it is a file (a recording).

        Raises
        ------
        FileFormatError
            If there is neither, or the folder is none of a session.
        """
        if source.is_file():
            return None
        folder = cls.existing(source)
        folder.needed(folder.recording, "`fieldtool measure`")
        return folder

    def needed(self, path: Path, made_by: str) -> Path:
        """Return one of the folder's files, which a stage cannot do without.

        Raises
        ------
        FileFormatError
            If it is not there: with what makes it.
        """
        if not path.is_file():
            raise FileFormatError(
                self.path, f"holds no {path.name}; {made_by} makes it. Nothing was done."
            )
        return path

    @property
    def machine(self) -> Path:
        """Resolved machine profile."""
        return self.path / "machine.yaml"

    @property
    def profile(self) -> Path:
        """Machine profile, which has to be there.

        Raises
        ------
        FileFormatError
            If it is not.
        """
        return self.needed(self.machine, "`fieldtool run`, `measure` and others")

    @property
    def parameters_before(self) -> Path:
        """Backup of all drives' parameters."""
        return self.path / "parameters-before.yaml"

    @property
    def recording(self) -> Path:
        """Raw data."""
        return self.path / "recording.h5"

    @property
    def raw_rows(self) -> Path:
        """What axes did in a motion whose experiments are not in the recording."""
        return self.path / "recording-cut-off.rows"

    @property
    def frequency_response(self) -> Path:
        """Responses."""
        return self.path / "frequency-response.h5"

    @property
    def model(self) -> Path:
        """Identified model."""
        return self.path / "model.yaml"

    @property
    def criticism(self) -> Path:
        """What the simulation of the model gets wrong, and why."""
        return self.path / "criticism.yaml"

    @property
    def criticism_picture(self) -> Path:
        """The errors before and after."""
        return self.path / "criticism.png"

    @property
    def views(self) -> Path:
        """The errors before and after, as numbers."""
        return self.path / "criticism-views.h5"

    @property
    def report(self) -> Path:
        """Everything on one page."""
        return self.path / "report.html"

    @property
    def tuning(self) -> Path:
        """Designed parameters."""
        return self.path / "tuning.yaml"

    @property
    def journal(self) -> Path:
        """What was written to the drives."""
        return self.path / "write-journal.yaml"

    @property
    def verification(self) -> Path:
        """What new parameters did on the machine, against the old ones and the prediction."""
        return self.path / "verification.yaml"

    @property
    def trials(self) -> tuple[Path, ...]:
        """Raw data of the trials of parameters, of each write that was tried."""
        return tuple(sorted(self.path.glob("verification*.h5")))

    @property
    def verification_picture(self) -> Path:
        """Moves and sensitivities before, predicted and after."""
        return self.path / "verification.png"

    @property
    def events(self) -> Path:
        """What happened, one JSON object a line."""
        return self.path / "events.jsonl"

    @property
    def picture(self) -> Path:
        """Measured and modelled responses."""
        return self.path / "responses.png"

    def note(self, event: str, **details: Any) -> None:
        """Append one event to the log; a log that can not be written stops nothing."""
        line = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event}
        try:
            with self.events.open("a", encoding="utf-8") as log:
                log.write(json.dumps({**line, **details}, default=str) + "\n")
        except OSError:
            return
