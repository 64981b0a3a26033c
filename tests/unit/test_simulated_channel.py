"""A simulated machine's channel is a file beside its profile, or a machine's name."""

from pathlib import Path

import pytest
import yaml

from drives.bus import close_bus, open_bus
from drives.canopen_drive import connect
from drives.profile import MachineProfile, load_machine
from fieldtool.workflow.session import resolved
from tests.session.conftest import one_axis, two_axes


def written(path: Path, profile: dict, channel: str, **bus: str) -> Path:
    path.parent.mkdir(exist_ok=True)
    profile["bus"] |= {"channel": channel, **bus}
    path.write_text(yaml.safe_dump(profile), encoding="utf-8")
    return path


def axes_of(machine: MachineProfile) -> tuple[str, ...]:
    with connect(machine) as group:
        return group.axes


def test_a_file_beside_the_profile_is_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the current folder is, and whatever has the same name there."""
    other = written(tmp_path / "here" / "own.yaml", one_axis(), "own.yaml")
    written(tmp_path / "there" / "own.yaml", two_axes(), "own.yaml")
    monkeypatch.chdir(other.parent)
    machine = load_machine("../there/own.yaml")
    assert axes_of(machine) == ("table", "arm")
    assert axes_of(load_machine("own.yaml")) == ("table",)
    kept = tmp_path / "session" / "machine.yaml"
    kept.parent.mkdir()
    kept.write_text(yaml.safe_dump(resolved(machine)), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert axes_of(load_machine(kept)) == ("table", "arm")


def test_what_is_no_file_there_stays_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert load_machine("paper-3x3").bus.channel == "paper-3x3"
    copied = written(tmp_path / "a" / "copy.yaml", one_axis(), "sim/own.yaml")
    written(tmp_path / "sim" / "own.yaml", one_axis(), "own.yaml")
    monkeypatch.chdir(tmp_path)  # a path from the current folder, as sessions kept it before
    close_bus(open_bus(load_machine(copied).bus))
    longest = written(tmp_path / "a" / "long.yaml", one_axis(), "x" * 5000)
    assert load_machine(longest).bus.channel == "x" * 5000


def test_an_adapters_channel_is_a_name(tmp_path: Path) -> None:
    (tmp_path / "can0").write_text("")
    path = written(tmp_path / "real.yaml", one_axis(), "can0", interface="socketcan")
    assert load_machine(path).bus.channel == "can0"
