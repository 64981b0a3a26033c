"""What was measured is in the recording or beside it, whatever ends the saving of it."""

import signal
from types import SimpleNamespace

import numpy as np
import pytest

from drives.api import Capture
from drives.errors import UserStopError
from fieldtool.errors import OutputError
from fieldtool.experiment.axes import keep_all, keep_whatever_happens
from fieldtool.records.recording import AxisInfo, Experiment, Recording, RecordingWriter, load
from fieldtool.records.session_folder import SessionFolder
from fieldtool.workflow.rescued import keeping, rescue

STEP, ROWS = 0.002, 60
HEADER = Recording(STEP, (AxisInfo("a", "rotary"),))
NAMES = ("one", "two", "three")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("FIELDTOOL_STATE_DIR", str(tmp_path / "notes"))
    return SessionFolder(tmp_path)


@pytest.fixture
def measured(fresh_rng):
    """One motion in three experiments, number by number."""
    return fresh_rng.normal(size=(3, ROWS, 1))


def save(folder, measured, during, keep_them):
    """Save them as a session does that has just measured them; ``during`` is called in each append."""
    group = SimpleNamespace(axes=("a",), onlooker=None)
    with RecordingWriter(folder.recording, HEADER) as recording:
        append = recording.append

        def disturbed(experiment):
            during(experiment.name)
            append(experiment)

        recording.append = disturbed
        with keeping(folder, recording, group) as keep:
            group.onlooker.begin(STEP)
            for k, rows in enumerate(measured):
                words = np.zeros((ROWS, 1), dtype=np.uint16)
                group.onlooker.take(Capture(k * ROWS, rows, rows, rows, words))
            time = STEP * np.arange(ROWS)
            experiments = [
                Experiment(
                    name, "other", ("a",), (), None, time, rows, rows, position_reference=rows
                )
                for name, rows in zip(NAMES, measured, strict=True)
            ]
            keep_them(experiments, keep)


@pytest.mark.parametrize(
    "error",
    [UserStopError("stopped"), MemoryError(), KeyboardInterrupt(), OutputError("a", "no room")],
)
def test_what_did_not_come_into_the_recording_stays_beside_it(folder, measured, error):
    def during(name):
        if name == "two":
            raise error

    with pytest.raises(type(error)):
        save(folder, measured, during, keep_all)
    assert [one.name for one in load(folder.recording).experiments] == ["one"]
    assert folder.raw_rows.exists()
    rescue(folder)
    _, rest = load(folder.recording).experiments
    assert np.array_equal(rest.position, np.concatenate(measured[1:]))


def test_one_that_failed_is_not_forgotten_for_one_that_did_not(folder, measured):
    def during(name):
        if name == "two":
            raise MemoryError

    def each(experiments, keep):
        cause = UserStopError("stopped")
        for experiment in experiments:
            keep_whatever_happens([experiment], keep, cause)
        assert cause.__notes__ == ["what was recorded last could not be kept: MemoryError"]

    save(folder, measured, during, each)
    assert [one.name for one in load(folder.recording).experiments] == ["one", "three"]
    assert folder.raw_rows.exists()


def test_ctrl_c_waits_until_all_is_saved(folder, measured):
    def during(name):
        if name == "two":
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        save(folder, measured, during, keep_all)
    assert tuple(one.name for one in load(folder.recording).experiments) == NAMES
    assert not folder.raw_rows.exists()
