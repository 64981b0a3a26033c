"""A session folder's report: whatever is there, read and put on one page."""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from drives.errors import DrivesError, ProfileError, UserStopError
from drives.parameters import load_journal
from drives.profile import MachineProfile, load_machine
from fieldtool.criticise.criticise import Criticised
from fieldtool.criticise.criticism_file import read_criticism
from fieldtool.criticise.pictured import pictures_of
from fieldtool.criticise.pictures_file import load_pictures
from fieldtool.design.tuning_file import read_tuning
from fieldtool.errors import FieldtoolError
from fieldtool.frf.response import load_band, load_responses
from fieldtool.records.files import read_text
from fieldtool.records.model import MachineModel
from fieldtool.records.model_file import read_model
from fieldtool.records.recording import Recording, experiment_names, load, recorded_seconds
from fieldtool.records.session_folder import SessionFolder
from fieldtool.report.contents import page_of
from fieldtool.report.material import Material
from fieldtool.report.page import write_page
from fieldtool.report.trial_file import read_trial
from fieldtool.workflow.models import is_simulated, prior_model, truth_model
from fieldtool.workflow.rescued import rescue

LARGEST_LOG = 64 * 1024 * 1024
LONGEST_NUMBER = 300
"""Digits of a whole number that is not beyond all others."""
T = TypeVar("T")


def report(folder_path: Path, out: Path | None = None) -> Path:
    """Write the report of a session folder, as far as the session has come; return its file.

    Parameters
    ----------
    folder_path : Path
    out : Path, optional
        HTML file; ``report.html`` in the folder otherwise.

    Raises
    ------
    FileFormatError
        If the folder holds nothing of a session.
    OutputError
        If the report can not be written.
    """
    folder = SessionFolder.existing(folder_path)
    out = out or folder.report
    write_page(page_of(material_of(folder)), out)
    return out


@contextmanager
def renewing_report(folder_path: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Renew the report that a session folder has when the work inside ends, however it ends.

    A folder without a report gets none.  Why the report is not renewed, a stop by the user included, is
    said, and noted at an error that is on its way; it is no error itself.
    """
    try:
        yield
    except BaseException as error:
        with suppress(Exception):  # nothing may hide why it ended
            _renew(SessionFolder(folder_path), error.add_note)
        raise
    _renew(SessionFolder(folder_path), say)


def _renew(folder: SessionFolder, say: Callable[[str], None]) -> None:
    if not (folder.report.is_file() and folder.events.is_file()):
        return
    try:
        report(folder.path)
    except (UserStopError, KeyboardInterrupt):  # the work that is reported had ended
        say(
            f"You stopped the report from being renewed, {folder.report} shows what was so before. To "
            f"renew it: `fieldtool report {folder.path}`"
        )
    except Exception as error:  # a defect of the report, too: what is reported was done
        say(f"The report was not renewed, {folder.report} shows what was so before: {error}")


def report_of_recording(source: Path, found: Criticised, recording: Recording, out: Path) -> None:
    """Write the report of a recording's criticism, where there is no session folder.

    Raises
    ------
    OutputError
        If the report can not be written.
    """
    criticism = found.criticism
    material = Material(
        source.name,
        recording=recording,
        model=criticism.model,
        criticism=criticism,
        pictures=pictures_of(found.found),
    )
    write_page(page_of(material), out)


def material_of(folder: SessionFolder) -> Material:
    """Read everything that a session folder holds; what can not be read is among what is missing.

    Raises
    ------
    UserStopError
        If the user asked to stop while a file was read: that is no fault of the file.
    """
    missing: list[str] = []

    def read(path: Path, reader: Callable[[Path], T], lacking: str) -> T | None:
        if not path.is_file():
            if lacking:
                missing.append(f"{path.name}: {lacking}")
            return None
        try:
            return reader(path)
        except UserStopError:
            raise
        except (FieldtoolError, DrivesError) as error:
            missing.append(f"{path.name} can not be read: {error}")
            return None

    try:
        rescue(folder)
    except FieldtoolError as error:
        missing.append(f"{folder.raw_rows.name} can not be put into the recording: {error}")
    machine = read(folder.machine, load_machine, "the machine's profile was not kept.")
    recording = read(folder.recording, load, "nothing was measured.")
    responses = read(folder.frequency_response, load_responses, "")
    model = read(
        folder.model,
        read_model,
        "the machine was not identified: `fieldtool identify` on this folder.",
    )
    events, lost = read(folder.events, _events, "what was done was not noted.") or ((), 0)
    if lost:
        missing.append(
            f"{folder.events.name}: lines that are no events (cut off, or damaged): {lost}."
        )
    criticism = None
    if model is not None:
        known = model
        criticism = read(
            folder.criticism,
            lambda path: read_criticism(path, known),
            "its simulation was not criticised: `fieldtool criticise` on this folder.",
        )
    trials = [found for path in folder.trials if (found := read(path, _trial, ""))]
    return Material(
        name=folder.path.resolve().name,
        machine=machine,
        simulated=machine is not None and is_simulated(machine),
        prior=_prior(machine),
        truth=truth_model(machine) if machine else None,
        recording=recording,
        trial_seconds=sum(seconds for seconds, _ in trials),
        trial_experiments=tuple(name for _, names in trials for name in names),
        responses=responses or {},
        band=read(folder.frequency_response, load_band, "") if responses else None,
        model=model,
        criticism=criticism,
        pictures=(read(folder.views, load_pictures, "") or ()) if criticism else (),
        tuning=read(
            folder.tuning,
            read_tuning,
            "no controller was designed: `fieldtool design` on this folder.",
        ),
        trial=read(folder.verification, read_trial, ""),
        journal=read(folder.journal, load_journal, ""),
        events=events,
        missing=tuple(missing),
    )


def _trial(path: Path) -> tuple[float, tuple[str, ...]]:
    """Return a trial's seconds, and the names of its experiments."""
    return recorded_seconds(path), experiment_names(path)


def _prior(machine: MachineProfile | None) -> MachineModel | None:
    try:
        return prior_model(machine) if machine else None
    except ProfileError:
        return None


def _whole(digits: str) -> int:
    """Return a whole number that can be shown and compared; raise ValueError if it is too large."""
    if len(digits) > LONGEST_NUMBER:
        raise ValueError
    return int(digits)


def _events(path: Path) -> tuple[tuple[Mapping[str, Any], ...], int]:
    """Read the log; return its events, and how many lines are none.

    Raises
    ------
    FileFormatError
        If it is no text, or too large.
    """
    lines = read_text(path, LARGEST_LOG).splitlines()
    out = []
    for line in lines:
        try:
            event = json.loads(line, parse_int=_whole)
        except (ValueError, RecursionError):
            continue
        if isinstance(event, dict):
            out.append(event)
    return tuple(out), len(lines) - len(out)
