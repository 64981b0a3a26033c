"""The three responses side by side: what they promise, what was not computed, and what is not had."""

from collections.abc import Callable
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from rich.console import Console

from fieldtool.cli.design import show_tuning
from fieldtool.design import decide
from fieldtool.design.decide import design
from fieldtool.design.design import Task
from fieldtool.design.drive_side import DriveSide
from fieldtool.design.rule import DesignError, rule
from fieldtool.design.servo import Servo
from fieldtool.design.tuning import AxisTuning, Choice, Tuning, as_parameters
from fieldtool.design.tuning_file import read_tuning, tuning_as_dict
from fieldtool.records.model import MachineModel
from fieldtool.records.yaml_file import write_yaml
from fieldtool.report import design_picture
from fieldtool.report.choices import choice_rows, choice_sentences, choice_titles
from fieldtool.report.material import Material
from fieldtool.report.part_parameters import parameters
from fieldtool.report.section import Table

RandomModel = Callable[..., MachineModel]
ROWS = {
    "bandwidth, Hz": lambda axis: axis["margins"]["bandwidth"],
    "peak of sensitivity": lambda axis: axis["margins"]["sensitivity_peak"],
    "step: settling, s": lambda axis: axis["step"]["settling_time"],
    "move: torque, N m": lambda axis: axis["peak_torque"],
}
"""Titles on the screen, and the same figure in tuning.yaml."""


def machine(random_model: RandomModel) -> tuple[MachineModel, list[DriveSide]]:
    model = random_model(np.random.default_rng(3), (2,))
    present = as_parameters(Servo(rule(model)[0]))
    mass = model.axes[0].total_mass
    return model, [DriveSide(model.axes[0].name, torque_limit=200.0 * mass, present=present)]


def refusing(monkeypatch: pytest.MonkeyPatch, step: str, *bounds: float) -> None:
    """Let a step of the design fail for responses with these bounds."""
    real = getattr(decide, step)

    def wrapped(*given: Any) -> Any:
        bound = given[0].bound if isinstance(given[0], Task) else given[3]
        if any(bound == pytest.approx(one) for one in bounds):
            raise DesignError("too much for this machine; nothing is written.")
        return real(*given)

    monkeypatch.setattr(decide, step, wrapped)


def shown(tuning: Tuning, width: int = 80) -> str:
    out = Console(file=StringIO(), width=width, highlight=False)
    show_tuning(out, tuning)
    assert isinstance(out.file, StringIO)
    return out.file.getvalue()


def column(tuning: Tuning, title: str) -> list[str]:
    k = choice_titles(tuning).index(title)
    return [row[k] for row in choice_rows(tuning)]


def test_all_three_are_there_and_the_stiffer_the_wider_and_the_nearer_to_the_bound(
    random_model: RandomModel,
) -> None:
    model, sides = machine(random_model)
    tuning = design(model, sides, compare=True)
    assert [one.response for one in tuning.responses] == ["soft", "normal", "stiff"]
    assert [one.bound for one in tuning.responses] == pytest.approx([1.4, 1.7, 2.0])
    predictions = [one.prediction for one in tuning.responses if one.prediction is not None]
    assert len(predictions) == 3
    for k in range(len(model.axes)):
        widths = [one.axes[k].margins.bandwidth for one in predictions]
        assert widths[1] >= 0.99 * widths[0]
        assert widths[2] >= 0.99 * widths[1]
        for one in tuning.responses:
            assert one.prediction is not None
            assert one.prediction.axes[k].margins.sensitivity_peak <= 1.02 * one.bound
    assert predictions[2].axes[0].margins.bandwidth > predictions[0].axes[0].margins.bandwidth
    # the chosen one is what it is without the others, and they are what they are by themselves
    alone = {name: design(model, sides, response=name) for name in ("normal", "stiff")}
    assert tuning.axes == alone["normal"].axes
    assert tuning.notes == alone["normal"].notes
    for one in tuning.responses[1:]:
        itself = alone[one.response].prediction
        assert one.prediction is not None
        assert itself is not None
        assert one.prediction.as_dict() == itself.as_dict()
    assert choice_rows(alone["stiff"]) == choice_rows(tuning), "nothing is left to compute"
    assert not any("not computed" in said for said in choice_sentences(alone["stiff"]))
    assert choice_titles(alone["stiff"])[-3:] == ("soft", "normal", "stiff *")


def test_what_was_not_computed_is_said_with_the_command_that_does(
    random_model: RandomModel,
) -> None:
    model, sides = machine(random_model)
    tuning = design(model, sides, response="soft", bound=1.9)
    assert choice_titles(tuning) == ("axis", "figure", "before", "soft *", "normal", "stiff")
    assert set(column(tuning, "normal")) == set(column(tuning, "stiff")) == {"-"}
    assert "-" not in column(tuning, "soft *")
    assert [one.prediction is None for one in tuning.responses] == [False, True, True]
    text = " ".join(shown(tuning).split())
    assert "normal and stiff: not computed in this design" in text
    assert "`fieldtool design FOLDER --response soft --bound 1.9 --compare`" in text


def test_the_screen_the_file_and_the_report_have_the_same_numbers(
    tmp_path: Path, random_model: RandomModel
) -> None:
    model, sides = machine(random_model)
    tuning = design(model, sides, compare=True)
    data = tuning_as_dict(tuning)
    titles = choice_titles(tuning)
    assert titles == ("axis", "figure", "before", "soft", "normal *", "stiff")
    rows = {(row[0], row[1]): dict(zip(titles, row, strict=True)) for row in choice_rows(tuning)}
    sources = {"before": data["present"]} | {
        one["response"] + " *" * (one["response"] == data["response"]): one["prediction"]
        for one in data["responses"]
    }
    assert set(data["responses"][0]) == {
        "response", "bound", "prediction", "kept", "instead", "refused"
    }  # fmt: skip
    for title, source in sources.items():
        for axis in source["axes"]:
            for name, of in ROWS.items():
                assert rows[axis["axis"], name][title] == f"{of(axis):.3g}"
    text = shown(tuning)
    lines = text.splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 80
    head = next(line for line in lines if "normal *" in line)
    assert head.split() == ["axis", "figure", "before", "soft", "normal", "*", "stiff"]
    for row in choice_rows(tuning):
        assert " ".join(row) in " ".join(text.split())
    # the file, and the report that is made of it
    write_yaml(tmp_path / "tuning.yaml", data)
    again = read_tuning(tmp_path / "tuning.yaml")
    assert tuning_as_dict(again) == data
    assert choice_rows(again) == choice_rows(tuning)
    section = parameters(Material("x", tuning=again, events=()))
    assert section is not None
    [table] = [one for one in section.blocks if isinstance(one, Table) and one.columns == titles]
    assert list(table.rows) == choice_rows(tuning)
    # a file of before there was a choice
    old = yaml.safe_load((tmp_path / "tuning.yaml").read_text())
    del old["responses"]
    write_yaml(tmp_path / "tuning.yaml", old)
    earlier = read_tuning(tmp_path / "tuning.yaml")
    assert earlier.responses == ()
    assert choice_rows(earlier) == choice_sentences(earlier) == []
    assert "normal *" not in shown(earlier)


def test_a_response_that_is_a_softer_one_says_so(
    random_model: RandomModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, sides = machine(random_model)
    refusing(monkeypatch, "no_worse", 2.0)
    tuning = design(model, sides, compare=True)
    assert [one.instead for one in tuning.responses] == ["", "", "normal"]
    assert column(tuning, "stiff = normal") == column(tuning, "normal *")
    [said] = [one for one in choice_sentences(tuning) if one.startswith("stiff = normal: ")]
    assert said.endswith("these are the normal one's parameters.")
    asked = design(model, sides, response="stiff")
    assert asked.axes[0].parameters == tuning.axes[0].parameters
    assert choice_titles(asked)[-1] == "stiff = normal *"
    assert sum("these are the normal one's parameters" in said for said in asked.notes) == 1
    assert not any(one.startswith("stiff = ") for one in choice_sentences(asked)), "once is enough"


@pytest.mark.parametrize(("bound", "name"), [(2.0, "stiff"), (1.4, "soft")])
def test_a_response_that_can_not_be_had_costs_no_other(
    random_model: RandomModel, monkeypatch: pytest.MonkeyPatch, bound: float, name: str
) -> None:
    model, sides = machine(random_model)
    refusing(monkeypatch, "find", bound)
    tuning = design(model, sides, compare=True)
    assert tuning.response == "normal"
    assert set(column(tuning, name)) == {"-"}
    assert [one.response for one in tuning.responses if one.prediction is None] == [name]
    [said] = [one for one in choice_sentences(tuning) if one.startswith(name)]
    assert said.startswith(f"{name} can not be had; by itself it is refused: too much for this")
    assert not any("not computed" in one for one in choice_sentences(tuning))
    with pytest.raises(DesignError, match="too much"):
        design(model, sides, response=name)


def test_progress_tells_the_response_and_never_goes_back(random_model: RandomModel) -> None:
    model, sides = machine(random_model)
    for compare, names in ((False, ["soft", "normal"]), (True, ["soft", "normal", "stiff"])):
        told: list[tuple[str, float]] = []
        design(model, sides, compare=compare, advance=lambda *one, told=told: told.append(one))
        shares = [share for _, share in told]
        assert shares == sorted(shares)
        assert shares[-1] <= 1
        assert list(dict.fromkeys(text.partition(":")[0] for text, _ in told)) == names


def test_a_response_that_keeps_present_parameters_says_of_which_axes() -> None:
    tuning = Tuning(
        (AxisTuning("table", {"velocity_p": 4.2}, 1.5, "why"),),
        "normal",
        responses=(
            Choice("soft", 1.4, kept=("table", "arm")),
            Choice("normal", 1.7, kept=("arm",)),
        ),
    )
    said = choice_sentences(tuning)
    assert said[0] == "soft keeps the present parameters of table and arm."
    assert not any(one.startswith("normal keeps") for one in said), "the design's own notes do"


def test_the_picture_of_the_trade_has_what_else_there_is(
    tmp_path: Path, random_model: RandomModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(design_picture, "save_picture", lambda figure, *_: drawn.append(figure))
    model, sides = machine(random_model)
    refusing(monkeypatch, "no_worse", 2.0)
    tuning = design(model, sides, compare=True)
    design_picture.draw_design(tuning, {}, tmp_path / "design.png")
    told = {one.get_text(): one.xy for one in drawn[0].axes[3].texts if isinstance(one, Annotation)}
    assert set(told) == {"before", "soft"}, "stiff is what was chosen: normal"
    for name, one in (("before", tuning.present), ("soft", tuning.responses[0].prediction)):
        assert one is not None
        margins = one.axes[0].margins
        assert told[name] == (margins.bandwidth, margins.sensitivity_peak)
