"""What axes did when a session was killed: on the disk while they move, in the recording afterwards."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from drives.canopen_drive import CanopenGroup
from fieldtool.records.raw_rows import RawRows, cut_off_rows
from fieldtool.records.recording import Experiment, RecordingWriter, load
from fieldtool.records.session_folder import SessionFolder
from fieldtool.writeback.unfinished import is_at_work

Keep = Callable[[Experiment], None]


@contextmanager
def keeping(
    folder: SessionFolder, recording: RecordingWriter, group: CanopenGroup
) -> Iterator[Keep]:
    """Save what axes do while they move; give what takes experiments into the recording.

    The file beside the recording is removed at the end, unless an experiment could not be brought into
    the recording, whatever the reason was.
    """
    rows = RawRows(_rows_of(recording.path), group.axes)
    lacking = False

    def keep(experiment: Experiment) -> None:
        nonlocal lacking
        before, lacking = lacking, True  # until it is there: what ends this here may be anything
        recording.append(experiment)
        rows.kept()
        folder.note("recorded", experiment=experiment.name, complete=experiment.complete)
        lacking = before

    group.onlooker = rows
    try:
        yield keep
    finally:
        group.onlooker = None
        rows.close(all_kept=not lacking)


def _rows_of(recording: Path) -> Path:
    """Return the file beside a recording for what is not in it yet: as ``SessionFolder.raw_rows``."""
    return recording.with_name(f"{recording.stem}-cut-off.rows")


def rescue(folder: SessionFolder, say: Callable[[str], None] = lambda _: None) -> None:
    """Put what a killed session had measured of an experiment into its recording: of a trial too.

    Nothing is done where there is no such thing, or the session is still at work.

    Raises
    ------
    FileFormatError
        If the rows, or the recording, can not be read.
    OutputError
        If the recording can not be written.
    """
    for path in (folder.recording, *sorted(folder.path.glob("verification*.h5"))):
        if _rows_of(path).is_file() and path.is_file() and not is_at_work(folder.path):
            _rescue(folder, path, say)


def _rescue(folder: SessionFolder, path: Path, say: Callable[[str], None]) -> None:
    recording = load(path)
    found = cut_off_rows(_rows_of(path), recording)
    if found:
        with RecordingWriter(path, recording) as writer:
            for experiment in found:
                writer.append(experiment)
        rows = sum(experiment.samples for experiment in found)
        folder.note("rescued", rows=rows)
        say(
            f"The session had been cut off while the axes moved: {rows} rows of that motion are in "
            f"{path.name} now, as {', '.join(one.name for one in found)}."
        )
    _rows_of(path).unlink(missing_ok=True)
