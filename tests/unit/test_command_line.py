"""Whatever is typed: one of the documented exit codes and a sentence, never a traceback."""

import errno
import io
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import pytest
import typer
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drives.errors import (
    DriveFaultError,
    ProfileError,
    SafetyStopError,
    UserStopError,
    WriteBackError,
    WriteBackMixedError,
)
from fieldtool.cli.main import app, main
from fieldtool.cli.output import confirmed, console_of
from fieldtool.errors import NotEnoughDataError, OutputError

CODES = {0, 2, 3, 4, 5, 6, 7, 130}
NOTHING_MOVES = {"run": "--plan-only", "measure": "--plan-only", "check": "--no-move"}
NONSENSE = st.sampled_from(
    ["", " ", "-1", "0", "nan", "1e999", "-inf", "ü/…", "x" * 5000, "../..", "/dev/null", ".", "a\nb",
     "[bold]", "[/]", "\udcff", "--", "99999999999999999999", "0x", "~", "can0", "paper-3x3\t",
     "scrambled.h5", "scrambled.yaml", "empty.yaml", "folder"]
) | st.text(st.characters(exclude_characters="\0"), max_size=8)  # fmt: skip


def commands(group: Any, before: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*before, name))
        else:
            yield (*before, name), command


ALL = dict(commands(typer.main.get_command(app)))


@st.composite
def lines(draw: st.DrawFn, path: tuple[str, ...]) -> list[str]:
    """Return a command with nonsense for its arguments and some of its options."""
    words = [*path, *([NOTHING_MOVES[path[-1]]] if path[-1] in NOTHING_MOVES else [])]
    for parameter in ALL[path].params:
        if parameter.param_type_name == "argument":
            words.append(draw(NONSENSE))
        elif parameter.name not in ("help", "move", "yes") and (
            parameter.required or draw(st.integers(0, 5)) == 0
        ):
            words.append(parameter.opts[0])
            words += [] if getattr(parameter, "is_flag", False) else [draw(NONSENSE)]
    return words


@pytest.fixture
def somewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FIELDTOOL_STATE_DIR", str(tmp_path / "state"))
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty.yaml").write_text("")
    for name in ("scrambled.h5", "scrambled.yaml"):
        (tmp_path / name).write_bytes(bytes(range(256)) * 9)
    return tmp_path


@pytest.mark.parametrize("path", [p for p in ALL if p[-1] != "demo"], ids=" ".join)
def test_nonsense_is_refused_in_words(somewhere, path, capsys):
    @given(lines(path))
    @settings(
        max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
    )
    def tried(words: list[str]) -> None:
        with pytest.raises(SystemExit) as ended:
            main(words)
            raise SystemExit(0)
        said = capsys.readouterr()
        assert (ended.value.code or 0) in CODES, said.err
        assert "Traceback" not in said.err + said.out

    tried()


def test_every_command_has_help_that_says_what_it_does(capsys):
    for path, command in ALL.items():
        with pytest.raises(SystemExit) as ended:
            main([*path, "--help"])
        assert ended.value.code == 0
        assert command.help
        assert "Usage" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (
            OSError(errno.ENAMETOOLONG, "File name too long", "x" * 300),
            2,
            "x" * 80 + ": File name too",
        ),
        (PermissionError(errno.EACCES, "Permission denied", "a/b"), 2, "a/b: Permission denied"),
        (OSError(errno.ENOSPC, "No space left on device"), 3, "the output: No space left"),
        (OSError(errno.EROFS, "Read-only file system", "a/b"), 3, "a/b: Read-only file system"),
        (OSError(errno.EBADF, "Bad file descriptor"), 1, "This is a defect of fieldtool"),
        (ValueError("so"), 1, "unexpected ValueError: so."),
    ],
)
def test_what_the_operating_system_refuses_is_said(monkeypatch, capsys, error, code, said):
    def fails(**_: object) -> None:
        raise error

    cli = import_module("fieldtool.cli.main")
    monkeypatch.setattr(cli, "app", fails)
    monkeypatch.setattr(cli, "drop_output", lambda: None)
    with pytest.raises(SystemExit) as ended:
        main([])
    assert ended.value.code == code
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    "error",
    [
        ValueError("so"),
        OSError(errno.EBADF, "Bad file descriptor"),
        OSError(errno.EROFS, "Read-only file system", "a/b"),
        KeyboardInterrupt(),
    ],
)
def test_what_is_noted_of_the_machine_is_said_whatever_ended_the_command(
    monkeypatch, capsys, error
):
    def fails(**_: object) -> None:
        error.add_note("table: it MAY STILL BE ENABLED. Use the emergency stop.")
        raise error

    cli = import_module("fieldtool.cli.main")
    monkeypatch.setattr(cli, "app", fails)
    monkeypatch.setattr(cli, "drop_output", lambda: None)
    with pytest.raises(SystemExit):
        main([])
    said = capsys.readouterr().err
    assert said.count("fieldtool: table: it MAY STILL BE ENABLED. Use the emergency stop.") == 1
    assert "they were stopped" not in said


@pytest.mark.parametrize(
    ("error", "safe", "unsafe"),
    [
        (UserStopError("stopped"), 130, 4),
        (KeyboardInterrupt(), 130, 4),
        (DriveFaultError("does not enable"), 3, 4),
        (OutputError("no room"), 3, 4),
        (ProfileError("a.yaml", "wrong"), 2, 4),
        (PermissionError(errno.EACCES, "Permission denied", "a/b"), 2, 4),
        (OSError(errno.EROFS, "Read-only file system", "a/b"), 3, 4),
        (ValueError("so"), 1, 4),
        (NotEnoughDataError("noise"), 5, 4),
        (SafetyStopError("a limit"), 4, 4),
        (WriteBackError("refused"), 6, 6),
        (WriteBackMixedError("refused", {}), 7, 7),
    ],
)
def test_no_exit_code_says_safe_where_a_drive_may_still_be_enabled(
    monkeypatch, capsys, error, safe, unsafe
):
    def fails(**_: object) -> None:
        raise error

    cli = import_module("fieldtool.cli.main")
    monkeypatch.setattr(cli, "app", fails)
    monkeypatch.setattr(cli, "drop_output", lambda: None)
    for code, note in ((safe, "arm: could not be put back"), (unsafe, "it MAY STILL BE ENABLED")):
        error.add_note(note)
        with pytest.raises(SystemExit) as ended:
            main([])
        assert ended.value.code == code
        assert note in capsys.readouterr().err


def test_no_answer_at_all_is_a_no(monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    assert not confirmed("Move the machine now?")
    assert "Move the machine now?" in capsys.readouterr().err


def test_texts_are_no_markup(capsys):
    console_of(False).print("[/] [bold] :smile: 1")
    assert capsys.readouterr().out.strip() == "[/] [bold] :smile: 1"


@pytest.mark.parametrize(
    ("words", "encoding"),
    [(["tools", "list", "paper-3x3"], "cp1252"), (["profile", "schema", "machine"], "ascii")],
)
def test_an_output_that_is_closed_ends_the_command_as_a_stop_does(tmp_path, words, encoding):
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run(
        [sys.executable, "-m", "fieldtool", *words],
        stdout=write,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONIOENCODING": encoding, "FIELDTOOL_STATE_DIR": str(tmp_path)},
        check=False,
        timeout=60,
    )
    os.close(write)
    assert ended.returncode == 130
    assert (
        ended.stderr.decode().strip() == "fieldtool: the output was closed before its end: stopped."
    )


def test_nothing_heavy_is_loaded_before_a_stop_can_be_told():
    """Ctrl-C in the first second ends with one sentence: what takes that second is loaded inside."""
    script = "import sys, fieldtool.cli; print({'numpy', 'can', 'typer'} & set(sys.modules))"
    ended = subprocess.run(
        [sys.executable, "-c", script], check=True, capture_output=True, text=True
    )
    assert ended.stdout.strip() == "set()"


def test_the_python_interface_is_what_the_package_names():
    import fieldtool

    assert fieldtool.run is import_module("fieldtool.workflow").run
    assert all(hasattr(fieldtool, name) for name in fieldtool.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'walk'"):
        getattr(fieldtool, "walk")  # noqa: B009
