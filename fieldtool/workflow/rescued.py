"""What axes did when a session was killed: on the disk while they move, in the recording afterwards."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from drives.canopen_drive import CanopenGroup
from fieldtool.errors import OutputError
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

    The file beside the recording is removed at the end, unless the recording could not be written.
    """
    rows = RawRows(folder.raw_rows, group.axes)
    lacking = False

    def keep(experiment: Experiment) -> None:
        nonlocal lacking
        try:
            recording.append(experiment)
        except OutputError:
            lacking = True
            raise
        rows.kept()
        folder.note("recorded", experiment=experiment.name, complete=experiment.complete)

    group.onlooker = rows
    try:
        yield keep
    finally:
        group.onlooker = None
        rows.close(all_kept=not lacking)


def rescue(folder: SessionFolder, say: Callable[[str], None] = lambda _: None) -> None:
    """Put what a killed session had measured of an experiment into its recording.

    Nothing is done where there is no such thing, or the session is still at work.

    Raises
    ------
    FileFormatError
        If the rows, or the recording, can not be read.
    OutputError
        If the recording can not be written.
    """
    if not folder.raw_rows.is_file() or not folder.recording.is_file() or is_at_work(folder.path):
        return
    recording = load(folder.recording)
    found = cut_off_rows(folder.raw_rows, recording)
    if found:
        with RecordingWriter(folder.recording, recording) as writer:
            for experiment in found:
                writer.append(experiment)
        rows = sum(experiment.samples for experiment in found)
        folder.note("rescued", rows=rows)
        say(
            f"The session had been cut off while the axes moved: {rows} rows of that motion are in "
            f"{folder.recording.name} now, as {', '.join(one.name for one in found)}."
        )
    folder.raw_rows.unlink(missing_ok=True)
