"""model.yaml survives the disk, and a faulty one is refused with file and line."""

from math import inf, isnan
from pathlib import Path

import numpy as np
import pytest

from fieldtool.cli.main import main
from fieldtool.errors import FileFormatError, OutputError
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from fieldtool.records.model_file import read_model, write_model
from fieldtool.records.recording import save
from tests.unit.late_axis import recorded

MODEL = MachineModel(
    axes=(
        AxisModel(
            "x",
            "rotary",
            (Estimate(2.5e-7, 1e-5), Estimate(1 / 3)),
            (Estimate(1234.5678901234567, 1.0),),
            (Estimate(1e-3, 1e-20),),
            Estimate(0.02, 0.001),
        ),
        AxisModel("slide", "linear", (Estimate(95.1),), ()),
    ),
    couplings=(Coupling(("x", "slide"), -0.25, 0.01),),
    effects=(
        {
            "effect": "measurement_delay",
            "axis": "x",
            "parameters": {"delay": {"value": 1.1e-4, "std": 1e-6, "unit": "s"}},
        },
    ),
)


def test_a_model_survives_the_disk_exactly(tmp_path: Path) -> None:
    write_model(MODEL, tmp_path / "model.yaml")
    again = read_model(tmp_path / "model.yaml")
    assert again.as_dict() == MODEL.as_dict()
    assert again.axes[0].masses[0] == MODEL.axes[0].masses[0]
    assert isnan(again.axes[0].masses[1].std)
    assert again.effects == MODEL.effects


def test_plain_numbers_stand_for_estimates(tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    path.write_text(
        "format: fieldtool-model/1\n"
        "axes: [{name: x, kind: rotary, masses: [1, 2.0], springs: [{value: 1e3}]}]\n"
    )
    axis = read_model(path).axes[0]
    assert [mass.value for mass in axis.masses] == [1.0, 2.0]
    assert axis.springs[0].value == 1000.0


def test_an_error_that_is_infinite_is_told_from_one_that_is_not_given(tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    axis = AxisModel("x", "rotary", (Estimate(1.0), Estimate(2.0, inf)), (Estimate(3.0, inf),))
    write_model(MachineModel((axis,)), path)
    assert path.read_text().count("std: null") == 2
    axis = read_model(path).axes[0]
    assert isnan(axis.masses[0].std)
    assert (axis.masses[1].std, axis.springs[0].std) == (inf, inf)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("fieldtool-model/1", "fieldtool-model/2", r"model\.yaml:1: 'format'"),
        ("kind: linear", "kind: round", r"model\.yaml:\d+: 'axis .*, kind'.*'round'"),
        ("kind: linear", "knid: linear", r"model\.yaml:\d+: the key 'axis .*, knid' is not known"),
        (
            "value: 95.1",
            "value: heavy",
            r"model\.yaml:\d+: 'axis .*, masses, number 1.*not 'heavy'",
        ),
        ("value: 95.1", "value: .inf", r"model\.yaml:\d+: .*finite"),
        (
            "value: -0.25",
            "value: yes",
            r"model\.yaml:\d+: 'couplings, number 1, value': expected a number",
        ),
        ("measurement_delay", "time_lag", r"model\.yaml:\d+: 'effects, number \d, effect'"),
        (
            "axis: x\n",
            "axis: q\n",
            r"model\.yaml:\d+: effect \w+ is on axis 'q', the axes are x, s",
        ),
        ("springs: []", "springs: [1.0]", "1 masses need 0 springs, got 1"),
    ],
)
def test_a_faulty_model_is_refused_with_the_line(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    path = tmp_path / "model.yaml"
    write_model(MODEL, path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(FileFormatError, match=words):
        read_model(path)


@pytest.mark.parametrize(
    ("axis", "line", "words"),
    [
        (
            "kind: rotary\n  masses: [1.0, -2.0]\n  springs: [5.0]",
            5,
            "mass 2 .* is -2 kg m2, .*above 0",
        ),
        ("kind: linear\n  masses: [0, 2.0]\n  springs: [5.0]", 5, "mass 1 .* is 0 kg, .*above 0"),
        (
            "kind: rotary\n  masses: [1, 2]\n  springs: [-5]",
            6,
            "spring 1 .* is -5 N m/rad, .*above 0",
        ),
        ("kind: linear\n  masses: [1, 2]\n  springs: [0.0]", 6, "spring 1 .* is 0 N/m, .*above 0"),
    ],
)
def test_what_no_machine_can_have_is_refused_with_line_axis_and_unit(
    tmp_path: Path, axis: str, line: int, words: str
) -> None:
    path = tmp_path / "model.yaml"
    path.write_text(f"format: fieldtool-model/1\naxes:\n- name: x\n  {axis}\n")
    with pytest.raises(FileFormatError, match=rf"model\.yaml:{line}: axis 'x': {words}.*identify"):
        read_model(path)


def test_a_damper_below_zero_is_read(tmp_path: Path) -> None:
    """Fits find small ones so, within their errors, and what was written has to be read."""
    path = tmp_path / "model.yaml"
    text = "{name: x, kind: rotary, masses: [1, 2], springs: [5], dampers: [{value: -1e-3, std: 1e-2}]}"
    path.write_text(f"format: fieldtool-model/1\naxes: [{text}]\n")
    assert read_model(path).axes[0].dampers[0].value == -1e-3


@pytest.mark.parametrize(
    ("value", "sound"), [(1.4, True), (-1.4, True), (1.42, False), (-3, False)]
)
def test_couplings_beyond_their_masses_are_refused(
    tmp_path: Path, value: float, sound: bool
) -> None:
    path = tmp_path / "model.yaml"
    path.write_text(
        "format: fieldtool-model/1\n"
        "axes: [{name: x, kind: rotary, masses: [1]}, {name: y, kind: linear, masses: [2]}]\n"
        f"couplings:\n- axes: [x, y]\n  value: {value}\n"
    )
    if sound:
        assert read_model(path).couplings[0].value == value
        return
    with pytest.raises(FileFormatError, match=r"yaml:5: .*axes x and y, -?[\d.]+ kg m, .*correct"):
        read_model(path)


def test_a_spring_that_can_not_be_ends_the_command_with_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_model(MODEL, tmp_path / "model.yaml")
    text = (tmp_path / "model.yaml").read_text()
    (tmp_path / "model.yaml").write_text(text.replace("1234.56789", "-1234.56789"))
    save(recorded(np.random.default_rng(1), 0.0), tmp_path / "recording.h5")
    with pytest.raises(SystemExit) as ended:
        main(["criticise", str(tmp_path / "recording.h5"), "--model", str(tmp_path / "model.yaml")])
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert "spring 1 (motor side first) is -1234.57 N m/rad" in said
    assert "Traceback" not in said


def test_a_coupling_to_nowhere_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    path.write_text(
        "format: fieldtool-model/1\n"
        "axes: [{name: x, kind: rotary, masses: [1]}]\n"
        "couplings: [{axes: [x, y], value: 1}]\n"
    )
    with pytest.raises(FileFormatError, match="coupling x - y does not join two axes"):
        read_model(path)


def test_missing_and_unwritable(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="can not be opened"):
        read_model(tmp_path / "model.yaml")
    with pytest.raises(OutputError, match="there is no folder"):
        write_model(MODEL, tmp_path / "no" / "model.yaml")
