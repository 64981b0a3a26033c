"""Files that can not be written: one sentence, and nothing half-made beside it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs limits of a process")
LIMIT = 1000
"""Bytes that a file may have at most."""
SCRIPT = """
import io, os, resource, sys
from pathlib import Path
from matplotlib.figure import Figure
from fieldtool.errors import OutputError
from fieldtool.records.files import write_new
from fieldtool.report.picture_file import save_picture

folder = Path(sys.argv[1])
figure = Figure()
figure.subplots().plot([0, 1])
figure.savefig(io.BytesIO(), format="png")  # what that imports, the other user may not read
resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
if {limit} > 10**6 and os.geteuid() == 0:
    os.setuid(65534)  # the administrator may write everywhere
for write in (
    lambda: save_picture(figure, folder / "picture.png", 100),
    lambda: write_new(folder / "new.yaml", 2000 * "long "),
):
    try:
        write()
    except OutputError as error:
        print(error)
"""


def run(script: str, *arguments: object) -> str:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)],
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    )
    return done.stdout


def test_what_has_no_room_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "picture.png").write_bytes(b"the one before")
    said = run(SCRIPT.format(limit=LIMIT), tmp_path).splitlines()
    assert len(said) == 2
    assert all("no room for" in one for one in said)
    assert [one.name for one in tmp_path.iterdir()] == ["picture.png"]
    assert (tmp_path / "picture.png").read_bytes() == b"the one before"


def test_a_folder_without_rights_is_named(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir()
    closed.chmod(0o555)
    said = run(SCRIPT.format(limit=10**9), closed).splitlines()
    assert len(said) == 2
    assert all(str(closed) in one and "Permission denied" in one for one in said)
    assert list(closed.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [("scan", "turntable-arm", "--profile", "new.yaml"), ("measure", "turntable-arm", "--yes")],
    ids=["scan", "measure"],
)
def test_commands_on_a_disk_without_room_end_with_a_sentence(tmp_path: Path, words) -> None:
    """``measure`` before anything moves: there is no room for the backup."""
    import resource

    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(sys.path),
        "FIELDTOOL_STATE_DIR": str(tmp_path / "notes"),
    }
    done = subprocess.run(
        [sys.executable, "-m", "fieldtool", *words],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, LIMIT)),
    )
    said = " ".join(done.stderr.split())
    assert done.returncode in (2, 3), said
    assert "Traceback" not in said
    assert "defect" not in said
    assert "can not be written" in said or "can not be kept" in said
    assert not (tmp_path / "new.yaml").exists()
