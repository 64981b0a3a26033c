"""Models, recordings and machines of other axes are refused, also where only the kind differs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drives.profile import load_machine
from fieldtool.cli.main import main
from fieldtool.errors import FileFormatError, NotEnoughDataError
from fieldtool.identify.moves.identify import identify_moves
from fieldtool.records.model import MachineModel
from fieldtool.records.model_file import write_model
from fieldtool.records.recording import AxisInfo, Recording, save
from fieldtool.records.same_axes import axes_differ
from fieldtool.records.session_folder import SessionFolder
from fieldtool.records.yaml_file import write_yaml
from fieldtool.workflow.criticising import alike
from fieldtool.workflow.distinguishing import question_of
from fieldtool.workflow.models import prior_model
from tests.session.conftest import two_axes
from tests.unit.late_axis import MODEL, recorded


def straight(model: MachineModel, k: int) -> MachineModel:
    """The same numbers, one axis linear."""
    axes = list(model.axes)
    axes[k] = replace(axes[k], kind="linear")
    return replace(model, axes=tuple(axes))


def test_the_first_axis_that_differs_is_named() -> None:
    assert axes_differ(MODEL.axes, "the other", MODEL.axes) == ""
    for found, words in (
        (straight(MODEL, 1).axes, "axis 2 is b (linear) here, b (rotary) there"),
        (MODEL.axes[::-1], "axis 1 is b (rotary) here, a (rotary) there"),
        (MODEL.axes[:1], "axis 2 is missing here, b (rotary) there"),
        ((*MODEL.axes, replace(MODEL.axes[0], name="c")), "axis 3 is c (rotary) here, missing"),
    ):
        assert words in axes_differ(found, "the other", MODEL.axes)


def test_a_linear_model_of_a_rotary_axis_is_not_criticised(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], fresh_rng: np.random.Generator
) -> None:
    recording, model = tmp_path / "recording.h5", tmp_path / "model.yaml"
    save(recorded(fresh_rng, 0.0), recording)
    write_model(straight(MODEL, 1), model)
    with pytest.raises(SystemExit) as ended:
        main(["criticise", str(recording), "--model", str(model)])
    said = " ".join(capsys.readouterr().err.split())
    assert ended.value.code == 5
    assert "the model has the axes a (rotary), b (linear), the recording has a (rotary), b" in said
    assert "axis 2 is b (linear) here, b (rotary) there. Give both the same names and kinds" in said


def test_a_prior_of_another_kind_starts_nothing(fresh_rng: np.random.Generator) -> None:
    lengths = {axis.name: len(axis.masses) for axis in MODEL.axes}
    with pytest.raises(NotEnoughDataError, match=r"prior model .* axis 1 is a \(linear\) here"):
        identify_moves(recorded(fresh_rng, 0.0), lengths, prior=straight(MODEL, 0))
    assert alike(straight(MODEL, 0), MODEL) is None
    assert alike(MODEL, MODEL) is not None


@pytest.mark.parametrize("which", ["model", "recording"])
def test_a_session_of_another_kind_asks_this_machine_nothing(tmp_path: Path, which: str) -> None:
    write_yaml(tmp_path / "bench.yaml", two_axes())
    machine = load_machine(tmp_path / "bench.yaml")
    model = prior_model(machine)
    axes = [AxisInfo(axis.name, axis.kind) for axis in machine.axes]
    if which == "model":
        model = straight(model, 1)
    else:
        axes[1] = AxisInfo("arm", "linear", torque_unit="N", position_unit="m")
    folder = SessionFolder.create(tmp_path / "session")
    write_model(model, folder.model)
    save(Recording(0.004, tuple(axes), ()), folder.recording)
    folder.criticism.touch()
    with pytest.raises(FileFormatError) as refused:
        question_of(folder.path, machine)
    assert refused.value.path == getattr(folder, which)
    assert "axis 2 is arm (linear) here, arm (rotary) there." in str(refused.value)
