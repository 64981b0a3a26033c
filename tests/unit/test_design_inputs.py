"""What a design is told of drives: from a backup as from the drive itself; what is said where not."""

import json
import re
import signal
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from importlib.resources import files
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from drives.canopen_drive import connect
from drives.errors import NotSupportedError, ProfileError
from drives.parameters import back_up, planned_changes, read_loop, save_backup
from drives.parameters.backup import checksum
from drives.profile import load_machine
from drives.sim.faults import SdoRefused
from drives.units import position_factor
from fieldtool.cli.main import main
from fieldtool.design.drive_side import GAINS, DriveSide
from fieldtool.design.notes import drive_notes
from fieldtool.design.predict import AxisPrediction
from fieldtool.design.rule import DesignError
from fieldtool.design.tuning_file import read_tuning
from fieldtool.errors import OutputError
from fieldtool.records.model_file import read_model, write_model
from fieldtool.records.recording import save
from fieldtool.records.session_folder import SessionFolder
from fieldtool.records.yaml_file import write_yaml
from fieldtool.workflow.design_inputs import drive_sides, moves_of, timing_of
from fieldtool.workflow.designing import redesign
from fieldtool.workflow.models import truth_model
from fieldtool.workflow.preparation import recording_header
from fieldtool.workflow.session import resolved
from fieldtool.writeback.transaction import changes_for
from tests.faces import machine_of, simulated


def session(tmp_path: Path, kinds: tuple[str, str], backup: bool = True) -> SessionFolder:
    """A session folder as a run leaves it: profile, backup, model."""
    folder = SessionFolder.create(tmp_path / "session")
    machine = machine_of(kinds, tmp_path)
    write_yaml(folder.machine, resolved(machine))
    model = truth_model(machine)
    assert model is not None
    write_model(model, folder.model)
    if backup:
        with simulated(machine), connect(machine) as group:
            save_backup(back_up(machine.name, group.drives), folder.parameters_before)
            save(recording_header(machine, group, 0.004, with_lengths=True), folder.recording)
    return folder


@pytest.mark.parametrize(
    "kinds",
    [("reference", "epos4"), ("novanta*", "reference"), ("epos4-dual-loop", "reference")],
    ids=str,
)
def test_present_parameters_are_those_that_the_drive_tells(
    tmp_path: Path, kinds: tuple[str, str]
) -> None:
    folder = session(tmp_path, kinds)
    machine = machine_of(kinds, tmp_path)
    sides = drive_sides(folder, machine, 0.004)
    with simulated(machine), connect(machine) as group:
        for side, drive in zip(sides, group.drives, strict=True):
            if side.present is None:
                pytest.fail(side.unreadable)
            told = read_loop(drive)
            assert {k: side.present[k] for k in told if k in side.present} == pytest.approx(told)
            assert side.tunable == drive.profile.tunable
            assert side.resolution == pytest.approx(drive.scaling.position)
            # what the design rounds to is what a write would leave in the drive
            wanted = {k: 1.2345 * v for k, v in told.items() if k in ("velocity_p", "inertia_ff")}
            wanted |= {k: told[k] for k in ("position_p", "velocity_p", "velocity_i")}
            held = side.held(wanted)
            for change in planned_changes(drive, {k: v for k, v in held.items() if k in wanted}):
                if change.name in held:
                    assert change.after == pytest.approx(held[change.name], rel=1e-6)


@pytest.mark.parametrize("wanted", [1e-7, 1e12])
@pytest.mark.parametrize("kinds", [("reference", "epos4"), ("copley+", "reference")])
def test_a_design_stays_within_what_the_drive_takes(
    tmp_path: Path, kinds: tuple[str, str], wanted: float
) -> None:
    """Copley's profile leaves the types of its objects to the drive's own EDS."""
    folder = session(tmp_path, kinds)
    machine = machine_of(kinds, tmp_path)
    with simulated(machine), connect(machine) as group:
        for side, drive in zip(drive_sides(folder, machine, 0.004), group.drives, strict=True):
            others = [n for n in ("velocity_ff", "filter1_frequency") if n in side.holds]
            asked = dict.fromkeys((*GAINS, *others), wanted)
            if "velocity_ff" in others:
                asked["velocity_ff"] = min(wanted, 1.0)  # no design has more
            held = side.held(asked)
            for change in planned_changes(drive, held):
                drive.write(
                    change.info, change.after_raw
                )  # the drive refuses what is out of its range


def test_without_a_backup_the_design_stands_and_says_so(tmp_path: Path) -> None:
    folder = session(tmp_path, ("reference", "reference"), backup=False)
    tuning = redesign(folder.path, picture=tmp_path / "design.png")
    assert tuning.present is None
    assert any("no parameters-before.yaml" in note for note in tuning.notes)
    assert (tmp_path / "design.png").read_bytes()[:4] == b"\x89PNG"
    folder.parameters_before.write_text("nonsense: [")
    machine = load_machine(folder.machine)
    assert all("parameters-before.yaml" in s.unreadable for s in drive_sides(folder, machine))


def test_a_report_that_is_there_is_renewed_by_a_design(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = session(tmp_path, ("reference", "reference"))
    folder.note("session", command="measure")
    main_code(["design", str(folder.path), "--response", "soft"])
    assert not folder.report.exists()
    folder.report.write_text("an older state")
    main_code(["design", str(folder.path), "--response", "soft"])
    page = folder.report.read_text(encoding="utf-8")
    assert "Commissioning report" in page
    assert "position_p" in page
    capsys.readouterr()

    def fails(*_: object) -> None:
        raise OutputError("no room")

    monkeypatch.setattr("fieldtool.workflow.reporting.write_page", fails)
    main_code(["design", str(folder.path), "--response", "soft"])
    said = " ".join(capsys.readouterr().out.split())
    assert "The report was not renewed, " in said
    assert "shows what was so before: no room" in said
    assert folder.report.read_text(encoding="utf-8") == page


def test_a_stop_while_the_report_is_renewed_does_not_hide_a_design(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = session(tmp_path, ("reference", "reference"))
    folder.note("session", command="measure")
    folder.report.write_text("an older state")

    def stopped(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("fieldtool.workflow.reporting.write_page", stopped)
    assert main_code(["design", str(folder.path), "--response", "soft", "--json"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["axes"]
    said = " ".join(told.err.split())
    assert f"To renew it: `fieldtool report {folder.path}`" in said
    assert f"Kept in {folder.path}; " in said

    def fails(*_: object) -> None:
        raise OutputError("no room")

    monkeypatch.setattr("fieldtool.workflow.designing.draw_design", fails)
    picture = ("--png", str(tmp_path / "design.png"))
    assert main_code(["design", str(folder.path), "--response", "soft", *picture]) == 3
    said = " ".join(capsys.readouterr().err.split())
    assert said.startswith("fieldtool: no room")
    assert f"To renew it: `fieldtool report {folder.path}`" in said
    assert folder.report.read_text(encoding="utf-8") == "an older state"


def test_the_command_says_what_is_there_and_what_will_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = session(tmp_path, ("reference", "reference"))
    main_code(["design", str(folder.path), "--response", "soft", "--json"])
    told = capsys.readouterr()
    shown = " ".join(told.err.split())
    for name, unit in (("position_p", "1/s"), ("velocity_p", "N m s/rad"), ("inertia_ff", "kg m2")):
        assert re.search(rf"{name} [0-9.e+-]+ {unit} ", shown), name
    data = yaml.safe_load(told.out)
    assert data["response"] == "soft"
    assert data["bound"] == pytest.approx(1.4)
    for axis in data["prediction"]["axes"]:
        assert axis["margins"]["sensitivity_peak"] <= 1.4 * 1.02
    assert data["present"]["stable"] is True
    assert yaml.safe_load(folder.tuning.read_text()) == data
    there = {one["response"]: one["prediction"] is not None for one in data["responses"]}
    assert there == {"soft": True, "normal": False, "stiff": False}
    assert (
        "normal and stiff: not computed in this design; `fieldtool design FOLDER --response soft"
        in shown
    )
    main_code(["design", str(folder.path), "--response", "soft", "--compare", "--json"])
    compared = yaml.safe_load(capsys.readouterr().out)
    assert all(one["prediction"] or one["refused"] for one in compared["responses"])
    assert compared | {"responses": []} == data | {"responses": []}, "the parameters are the same"
    assert main_code(["design", str(folder.path), "--response", "wild"]) == 2
    for bound in ("1", "3.1", "nan"):
        assert main_code(["design", str(folder.path), "--bound", bound]) == 2
    before = folder.tuning.read_bytes()
    folder.model.unlink()
    assert main_code(["design", str(folder.path)]) == 2
    assert folder.tuning.read_bytes() == before


def main_code(arguments: list[str]) -> int:
    try:
        main(arguments)
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


def test_moves_and_timing_of_profiles(tmp_path: Path) -> None:
    machine = machine_of(("reference", "reference"), tmp_path)
    model = truth_model(machine)
    assert model is not None
    usual = moves_of(machine, model)
    for move, axis, chain in zip(usual, machine.axes, model.axes, strict=True):
        assert move.velocity <= 0.5 * axis.limits.velocity
        assert move.acceleration * chain.total_mass <= 0.5 * axis.limits.torque * (1 + 1e-9)
    data = yaml.safe_load(machine.path.read_text())
    data["axes"][0]["typical_move"] = {
        "distance": 0.2,
        "velocity": 2.0,
        "acceleration": 40.0,
        "band": 0.001,
    }
    path = tmp_path / "moving.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    move = moves_of(load_machine(path), model)[0]
    assert (move.distance, move.velocity, move.settling_band) == (0.2, 2.0, 0.001)
    assert move.jerk == pytest.approx(40.0 / (0.25 * 2.0 / 40.0))
    data["axes"][0]["typical_move"]["velocity"] = 1e6
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    with pytest.raises(Exception, match=r"1e.06 is more than the limits allow"):
        load_machine(path)
    from drives.canopen_drive.group import profile_of

    known = timing_of(profile_of(machine.axes[0], machine), 0.002)
    assert (known.lag, known.period, known.cycle) == (
        pytest.approx(0.22e-3),
        pytest.approx(0.125e-3),
        0.002,
    )
    silent = profile_of(machine.axes[0], machine).model_copy(
        update={"torque_lag": 0.0, "loop_period": "unknown"}
    )
    assert timing_of(silent).lag == pytest.approx(1e-3)
    assert np.isfinite(timing_of(silent).period)


def held_before(folder: SessionFolder, drive: int, values: dict[str, int]) -> None:
    """Change what the backup has of a drive, by object."""
    data = yaml.safe_load(folder.parameters_before.read_text())
    items = data["drives"][drive]["objects"]
    told = {item["object"] for item in items}
    items += [{"object": one, "type": "UNSIGNED32", "name": "added", "value": 0}
              for one in values if one not in told]  # fmt: skip
    for item in items:
        item["value"] = values.get(item["object"], item["value"])
    data["checksum"] = checksum(data["drives"])
    folder.parameters_before.write_text(yaml.safe_dump(data, sort_keys=False))


@pytest.mark.parametrize(("counts", "revolutions"), [(2**20, 1), (10 * 2**20, 10), (2**20, 0)])
def test_the_step_of_a_linear_axis_is_the_drives_own(
    tmp_path: Path, counts: int, revolutions: int
) -> None:
    """Of an encoder that is told for some motor revolutions together, as the drive reckons it."""
    folder = session(tmp_path, ("reference", "reference"))
    held_before(folder, 0, {"0x608F:01": counts, "0x608F:02": revolutions})
    folder.recording.unlink()
    data = yaml.safe_load(folder.machine.read_text())
    axis = data["axes"][0] | {"kind": "linear", "feed": 0.4}
    axis["limits"] |= {"travel": ["-0.3 m", "0.3 m"], "velocity": "1 m/s", "following_error": "0.05 m",
                       "acceleration": "10 m/s2", "torque": "200 N"}  # fmt: skip
    axis.pop("encoder_counts_per_rev", None)
    data["axes"][0] = axis
    folder.machine.write_text(yaml.safe_dump(data, sort_keys=False))
    side = drive_sides(folder, load_machine(folder.machine))[0]
    step = position_factor("linear", counts, revolutions or 1, 0.4)
    assert side.resolution == pytest.approx(step, rel=1e-12)


def test_a_pid_that_no_cascade_is_can_not_be_compared(tmp_path: Path) -> None:
    folder = session(tmp_path, ("reference", "epos4"))
    held_before(folder, 1, {"0x30A1:02": 4_000_000_000})
    machine = load_machine(folder.machine)
    side = drive_sides(folder, machine)[1]
    assert side.present is None
    assert "none that position P and velocity PI could be" in side.unreadable


@pytest.mark.parametrize(
    ("kind", "held", "said"),
    [
        ("epos4-dual-loop", {"0x30AE:22": 5000}, set()),
        (
            "epos4",
            {"0x30A1:04": 5000, "0x30A1:05": 0},
            {
                "viscous_ff (5000 in the drive's own units) stays as it is in the drive",
                "inertia_ff is 0 in the drive and stays so",
            },
        ),
        (
            "epos4",
            {"0x30A1:04": 0, "0x30A1:05": 77},
            {
                "viscous_ff is 0 in the drive and stays so",
                "inertia_ff (77 in the drive's own units) stays as it is in the drive",
            },
        ),
        ("reference", {}, set()),
    ],
)
def test_feed_forward_that_no_design_chooses_is_said(
    tmp_path: Path, kind: str, held: dict[str, int], said: set[str]
) -> None:
    """Only what is not 0 makes moves differ from their prediction."""
    folder = session(tmp_path, (kind, "reference"))
    held_before(folder, 0, held)
    side = drive_sides(folder, load_machine(folder.machine))[0]
    assert side.present_servo is not None
    none = AxisPrediction("table", None, None, None, None, 0.0, 0.0, 0.0)  # type: ignore[arg-type]
    notes = [note for note in drive_notes(side, none, {}) if "_ff " in note]
    assert {note.removeprefix("table: ").split(":")[0] for note in notes} == said
    for note in notes:
        assert ("does not have it" in note) == (" stays as it is " in note)


def test_feed_forward_that_nobody_read_is_said(tmp_path: Path) -> None:
    folder = session(tmp_path, ("epos4", "reference"), backup=False)
    side = drive_sides(folder, load_machine(folder.machine))[0]
    none = AxisPrediction("table", None, None, None, None, 0.0, 0.0, 0.0)  # type: ignore[arg-type]
    assert any("viscous_ff (not known) stays as it is" in n for n in drive_notes(side, none, {}))


@pytest.mark.parametrize("unit", [0xFA040300, 0x00040300])
def test_a_gain_of_another_unit_than_the_profiles_is_not_read(tmp_path: Path, unit: int) -> None:
    folder = session(tmp_path, ("reference", "epos4"))
    held_before(folder, 1, {"0x30A1:09": unit})
    side = drive_sides(folder, load_machine(folder.machine))[1]
    assert side.is_pid
    if unit == 0xFA040300:
        assert side.present is not None
    else:
        assert side.present is None
        assert (
            f"pid_i: its unit is known only while object 0x30A1:09 is {0xFA040300}"
            in side.unreadable
        )
        assert f"the drive has {unit}." in side.unreadable
        assert "pid_i" not in side.holds
        assert f"arm: its present parameters can not be compared: {side.unreadable}" in (
            redesign(folder.path, "soft").notes
        )


def test_parameters_are_designed_for_the_controllers_own_cycle_where_the_profile_has_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = session(tmp_path, ("reference", "reference"))
    seen = []

    def noted(_model: object, sides: Sequence[DriveSide], *_: object, **__: object) -> None:
        seen.append([side.timing.cycle for side in sides])
        raise DesignError("seen enough")

    monkeypatch.setattr("fieldtool.workflow.designing.design", noted)
    for line in ("", "controller_cycle: 2 ms\n"):
        folder.machine.write_text(folder.machine.read_text() + line)
        with pytest.raises(DesignError):
            redesign(folder.path)
    assert seen == [[0.004, 0.004], [0.002, 0.002]]
    for wrong, told in (("0 ms", "above"), ("2", "has no unit"), ("2 s", "at most 0.1")):
        text = folder.machine.read_text().replace("2 ms", wrong)
        (tmp_path / "wrong.yaml").write_text(text)
        with pytest.raises(ProfileError, match=f"controller_cycle: .*{told}"):
            load_machine(tmp_path / "wrong.yaml")


def lacking(folder: SessionFolder, change: Callable[[dict[str, Any]], None]) -> None:
    """Give the first axis a drive profile of its own, changed."""
    text = files("profiles").joinpath("drives", "reference.yaml").read_text(encoding="utf-8")
    profile = yaml.safe_load(text)
    profile["eds"] = str(files("profiles").joinpath("drives", profile["eds"]))
    change(profile["parameters"])
    path = folder.path / "own.yaml"
    path.write_text(yaml.safe_dump(profile, sort_keys=False))
    data = yaml.safe_load(folder.machine.read_text())
    data["axes"][0]["drive"] = str(path)
    folder.machine.write_text(yaml.safe_dump(data, sort_keys=False))


def no_velocity_i(parameters: dict[str, Any]) -> None:
    del parameters["velocity_i"]


def velocity_i_in_steps_of_velocity_p(parameters: dict[str, Any]) -> None:
    parameters["velocity_i"] |= {"scale": 0.5, "times": {"velocity_p": 1}}


def test_a_gain_in_steps_of_another_is_rounded_as_the_drive_is_written(tmp_path: Path) -> None:
    """The other one is written with it, and is not what the drive holds now."""
    folder = session(tmp_path, ("reference", "reference"))
    lacking(folder, velocity_i_in_steps_of_velocity_p)
    machine = load_machine(folder.machine)
    side = drive_sides(folder, machine)[0]
    assert side.present is not None
    wanted = {n: f * side.present[n] for n, f in zip(GAINS, (1.1, 1.37, 0.0), strict=True)}
    wanted["velocity_i"] = 3.3 * wanted["velocity_p"]
    held = side.held(wanted)
    with simulated(machine), connect(machine) as group:
        written = {c.name: c for c in planned_changes(group.drives[0], held)}
    for name in GAINS:
        assert written[name].after == pytest.approx(held[name], rel=1e-9)
    assert written["velocity_i"].after_raw == 7  # 6.6 steps
    assert held["velocity_i"] == pytest.approx(7 * 0.5 * written["velocity_p"].after)


def no_zero_damping(parameters: dict[str, Any]) -> None:
    for k in (1, 2):
        del parameters[f"filter{k}_zero_damping"]


def no_filter_frequency(parameters: dict[str, Any]) -> None:
    del parameters["filter1_frequency"]


def filter_of_another_unit(parameters: dict[str, Any]) -> None:
    condition = {"object": "0x2020:01", "type": "UNSIGNED8", "equals": 99}
    parameters["filter1_type"] |= {"only_if": condition}


def filter_types_of_its_own(parameters: dict[str, Any]) -> None:
    parameters["filter1_type"] |= {"scale": 7.0}


def little_velocity_p(parameters: dict[str, Any]) -> None:
    parameters["velocity_p"] |= {"minimum": 1000.0, "maximum": 2000.0}


def doubtful(share: float) -> Callable[[SessionFolder], None]:
    """Give all masses and springs of the model a standard error."""

    def spoil(folder: SessionFolder) -> None:
        model = read_model(folder.model)
        axes = tuple(
            replace(
                axis,
                masses=tuple(replace(one, std=share * one.value) for one in axis.masses),
                springs=tuple(replace(one, std=share * one.value) for one in axis.springs),
            )
            for axis in model.axes
        )
        folder.model.unlink()
        write_model(replace(model, axes=axes), folder.model)

    return spoil


@pytest.mark.parametrize(
    ("spoil", "options", "code", "said"),
    [
        (
            doubtful(0.29),
            ("--response", "soft", "--bound", "1.14"),
            3,
            ("on every machine that the model allows", "Keep the present ones, or try --response"),
        ),
        (doubtful(0.4), (), 5, ("table mass 1 is", "is not known", "--time")),
        (doubtful(inf), (), 5, ("table mass 1 is", "+- inf: that is not known", "--time")),
        (
            lambda folder: lacking(folder, no_velocity_i),
            (),
            0,
            ("table: its drive profile has no velocity_i that can be written", "maker's software"),
        ),
        (
            lambda folder: lacking(folder, little_velocity_p),
            (),
            3,
            ("ranges are too small: table: velocity_p", "(the drive holds 1000 to 2000 N m s/rad)",
             "other units or ranges"),
        ),
        (
            lambda folder: folder.parameters_before.write_text("nonsense: ["),
            (),
            0,
            ("table: its present parameters can not be compared", "parameters-before.yaml"),
        ),
    ],
    ids=["margin", "unknown", "untold", "parameter", "ranges", "unreadable"],
)  # fmt: skip
def test_what_stands_against_a_design_is_said_with_what_can_still_be_done(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    spoil: Callable[[SessionFolder], object],
    options: tuple[str, ...],
    code: int,
    said: tuple[str, ...],
) -> None:
    folder = session(tmp_path, ("reference", "reference"))
    spoil(folder)
    assert main_code(["design", str(folder.path), *options]) == code
    told = capsys.readouterr()
    text = " ".join((told.out + told.err).split())
    for words in said:
        assert words in text
    assert folder.tuning.is_file() == (code == 0)


@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("design", "--png"),
        ("identify", "--picture"),
        ("criticise", "--picture"),
        ("criticise", "--report"),
        ("report", "--out"),
    ],
)
@pytest.mark.parametrize(
    ("name", "words"),
    [
        (".", "is a folder"),
        ("none/one.png", "there is no folder"),
        ("model.yaml/one.png", "there is no folder"),
        (f"{'n' * 250}.png", "can not be written"),
    ],
)
def test_a_file_that_can_not_be_written_is_refused_before_anything(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    command: str,
    option: str,
    name: str,
    words: str,
) -> None:
    """A design anew had taken the place of the one before by then."""
    folder = session(tmp_path, ("reference", "reference"), backup=False)
    folder.tuning.write_text("as it was")
    before = sorted(folder.path.iterdir())
    assert main_code([command, str(folder.path), option, str(folder.path / name)]) == 2
    said = capsys.readouterr().err
    assert option in said
    assert words in " ".join(said.replace("│", " ").split())
    assert folder.tuning.read_text() == "as it was"
    assert sorted(folder.path.iterdir()) == before


@pytest.mark.parametrize("kind", ["elmo-gold", "cia402*", "reference"])
def test_what_a_write_refuses_is_entered_by_hand(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    """It was said that `fieldtool write` brings it into the drives."""
    folder = session(tmp_path, (kind, "reference"))
    assert main_code(["design", str(folder.path), "--response", "soft"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    tuning = read_tuning(folder.tuning)
    machine = machine_of((kind, "reference"), tmp_path)
    refused = kind != "reference"
    outcome = pytest.raises(NotSupportedError) if refused else nullcontext()
    with simulated(machine), connect(machine) as group, outcome:
        changes_for(group.drives, tuning)
    assert tuning.by_hand == (("table",) if refused else ())
    note = "table: its drive profile has no position_p, velocity_p, velocity_i that can be written"
    assert (note in said) is refused
    write = f"`fieldtool write {folder.path}`"
    end = f"{write} is refused, for gains of table can not be written: enter the new parameters of"
    assert (f"Kept in {folder.path}; {end}" in said) is refused
    assert (f"Kept in {folder.path}; {write} brings them into the drives." in said) is not refused


def crossed(model: dict[str, Any]) -> None:
    model["axes"].reverse()


def lost(model: dict[str, Any]) -> None:
    del model["axes"][1], model["couplings"]
    model["effects"] = [one for one in model["effects"] if one["axis"] == "table"]


def renamed(model: dict[str, Any]) -> None:
    model["axes"][0]["name"] = "disk"
    del model["couplings"], model["effects"]


def straight(model: dict[str, Any]) -> None:
    model["axes"][0]["kind"] = "linear"


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (crossed, "arm (rotary), table (rotary)"),
        (lost, "table (rotary)"),
        (renamed, "disk (rotary), arm (rotary)"),
        (straight, "table (linear), arm (rotary)"),
    ],
)
def test_no_controller_is_designed_from_another_machines_model(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    spoil: Callable[[dict[str, Any]], None],
    found: str,
) -> None:
    folder = session(tmp_path, ("reference", "reference"))
    data = yaml.safe_load(folder.model.read_text())
    spoil(data)
    folder.model.write_text(yaml.safe_dump(data, sort_keys=False))
    assert main_code(["design", str(folder.path)]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert f"model.yaml: has the axes {found}, the machine " in told
    assert " has table (rotary), arm (rotary): " in told
    assert not folder.tuning.exists()


@pytest.mark.parametrize(
    ("change", "kind", "why"),
    [
        (no_filter_frequency, 0, ""),
        (no_filter_frequency, 1, "filter 1 is on, and filter1_frequency can not be read in SI"),
        (no_zero_damping, 1, "filter 1 is on, and filter1_zero_damping can not be read in SI"),
        (no_zero_damping, 2, ""),
        (lambda _: None, 1, ""),
        (
            lambda _: None,
            3,
            "filter 1 is of type 3 (filter1_type, object 0x2020:01, drive profile ",
        ),
        (
            filter_of_another_unit,
            0,
            "whether filter 1 is on can not be read (filter1_type, object 0x20",
        ),
    ],
)
def test_a_filter_that_is_on_and_not_known_is_said(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], kind: int, why: str
) -> None:
    folder = session(tmp_path, ("reference", "reference"))
    lacking(folder, change)
    held_before(folder, 0, {"0x2020:01": kind})
    side = drive_sides(folder, load_machine(folder.machine))[0]
    assert side.unreadable.startswith(why)
    assert (side.present_servo is None) == bool(side.unreadable) == bool(why)


def test_a_filter_at_no_frequency_that_can_not_be_set_is_said(tmp_path: Path) -> None:
    folder = session(tmp_path, ("reference", "reference"))
    lacking(folder, lambda _: None)
    held_before(folder, 0, {"0x2020:01": 1, "0x2020:02": 0})
    assert not drive_sides(folder, load_machine(folder.machine))[0].unreadable  # a design sets it
    own = folder.path / "own.yaml"
    own.write_text(own.read_text() + "gains_via: read-only\n")
    tuning = redesign(folder.path, "soft")
    assert any("filter 1 is on, at 0 Hz, and can not be set" in note for note in tuning.notes)


@pytest.mark.parametrize("held", [3, 255])
def test_a_filter_of_an_unknown_type_is_said_of_the_backup(tmp_path: Path, held: int) -> None:
    """It counted as off: what it does to the loop was left out."""
    folder = session(tmp_path, ("reference", "reference"))
    held_before(folder, 1, {"0x2021:01": held})
    tuning = redesign(folder.path, "soft")
    assert tuning.present is None
    said = [note for note in tuning.notes if "can not be compared" in note]
    assert said == [
        f"arm: its present parameters can not be compared: filter 2 is of type {held} (filter2_type, "
        "object 0x2021:01, drive profile reference), and only 0 (off), 1 (notch) and 2 (low-pass) are "
        "known. Set one of them in the drive, or correct the drive profile."
    ]


@pytest.mark.parametrize(
    ("change", "kind", "refused", "said"),
    [
        (no_filter_frequency, 1, (), "table: nobody knows what a target would do: filter 1 is on, and "
         "filter1_frequency can not be read in SI units"),
        (filter_types_of_its_own, 1, (), "table: nobody knows what a target would do: filter 1 is of "
         "type 7 (filter1_type, object 0x2020:01, drive profile"),
        (lambda _: None, 1, (0x2020, 2), "table, object 0x2020:02"),
        (lambda _: None, 0, (0x2020, 1), "table, object 0x2020:01"),
    ],
)  # fmt: skip
def test_nothing_moves_where_a_drive_does_not_tell_its_filters(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[dict[str, Any]], None],
    kind: int,
    refused: tuple[int, ...],
    said: str,
) -> None:
    machine = machine_of(("reference", "reference"), tmp_path)
    folder = SessionFolder.create(tmp_path)
    lacking(folder, change)
    with simulated(machine) as running:
        node = running.node(machine.axes[0].node_id)
        node.dictionary.force(0x2020, 1, kind)
        if refused:
            running.inject(SdoRefused(node.node_id, *refused, code=0x06020000))
        out = tmp_path / "measured"
        assert main_code(["measure", str(machine.path), "--yes", "--out", str(out)]) == 3
        assert running.sync_count == 0, "nothing moved"
    told = " ".join(capsys.readouterr().err.split())
    assert said in told
    assert "Traceback" not in told
    assert "defect" not in told
