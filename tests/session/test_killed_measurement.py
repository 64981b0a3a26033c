"""SIGKILL while axes are excited: what was measured until then is on the disk, and is rescued."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from fieldtool.records.recording import load
from fieldtool.records.session_folder import SessionFolder
from fieldtool.workflow.rescued import rescue

ROOT = Path(__file__).parents[2]
KILLED = """
import os, signal, sys
from pathlib import Path
from tests.faults.bench import Bench, Moment, command

class Killed(Bench):
    def _bring_about(self):
        os.kill(os.getpid(), signal.SIGKILL)

with Killed(Path(sys.argv[1]), Moment.SWEEP, lambda _: ()) as bench:
    command("measure", bench.profile, "--yes", "--out", bench.out)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_the_experiment_in_progress_is_not_lost(tmp_path, monkeypatch):
    ended = subprocess.run(
        [sys.executable, "-c", KILLED, str(tmp_path)], cwd=ROOT, timeout=120.0, check=False
    )
    assert ended.returncode == -signal.SIGKILL
    monkeypatch.setenv("FIELDTOOL_STATE_DIR", str(tmp_path / "notes"))
    folder = SessionFolder(tmp_path / "session")
    before = load(folder.recording)
    deadline = time.monotonic() + 10.0
    size = -1
    while folder.raw_rows.stat().st_size != size:  # another process copies what the killed one left
        size = folder.raw_rows.stat().st_size
        assert time.monotonic() < deadline
        time.sleep(0.3)
    said: list[str] = []
    rescue(folder, said.append)
    assert len(said) == 1
    assert "had been cut off while the axes moved" in said[0]
    after = load(folder.recording)
    cut = after.experiments[len(before.experiments) :]
    assert [one.complete for one in cut] == [False] * len(cut)
    moving = max(cut, key=lambda one: one.samples)
    assert moving.samples >= 40
    assert np.ptp(moving.position_reference[:, 0]) > 0
    assert np.ptp(moving.position[:, 0]) > 0
    assert not folder.raw_rows.exists()
    rescue(folder, said.append)
    assert len(said) == 1, "nothing is left"


def test_a_session_that_ended_leaves_nothing_beside_the_recording(tmp_path):
    from tests.faults.bench import Bench, Moment, command

    with Bench(tmp_path, Moment.SWEEP, lambda _: ()) as bench:
        code, said = command("measure", bench.profile, "--yes", "--out", bench.out)
        assert code == 0, said
        assert not SessionFolder(bench.out).raw_rows.exists()
        assert all(
            "cut off" not in one.name for one in load(bench.out / "recording.h5").experiments
        )
