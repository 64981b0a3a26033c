"""What is shown fits the terminal, loses no digit, and never fails on a name."""

from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from fieldtool.cli.design import show_tuning
from fieldtool.cli.screen import TerminalScreen, model_table, parameter_rows, show_result
from fieldtool.design.decide import design
from fieldtool.design.tuning import AxisTuning, Tuning
from fieldtool.design.tuning_file import read_tuning, tuning_as_dict
from fieldtool.experiment.forecast import AxisForecast
from fieldtool.experiment.stepped.plan import Sweep, SweepPlan, tone_near
from fieldtool.experiment.stepped.runner import Progress
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from fieldtool.records.yaml_file import write_yaml
from fieldtool.workflow import SessionResult
from fieldtool.writeback.transaction import WriteBack


def console(width: int = 120, terminal: bool = False) -> Console:
    return Console(file=StringIO(), width=width, force_terminal=terminal, highlight=False)


def text(of: Console) -> str:
    file = of.file
    assert isinstance(file, StringIO)
    return file.getvalue()


def model(first: str = "axis1") -> MachineModel:
    return MachineModel(
        (
            AxisModel(
                first, "rotary",
                (Estimate(0.7123456, 1.234e-3), Estimate(2.0)),
                (Estimate(1000.5, 2.0),),
                (Estimate(0.5, 0.01),),
            ),
            AxisModel("slide", "linear", (Estimate(12.5, 0.1),), ()),
        ),
        (Coupling((first, "slide"), -0.25, 0.01),),
    )  # fmt: skip


def shown(table: object, width: int = 120) -> str:
    out = console(width)
    out.print(table)
    return text(out)


def test_what_a_design_predicts_has_the_units_of_each_kind_of_axis(tmp_path: Path) -> None:
    machine = MachineModel(
        (
            AxisModel("table", "rotary", (Estimate(0.05),), (), ()),
            AxisModel("slide", "linear", (Estimate(12.0),), (), ()),
        )
    )
    out = console(200)
    write_yaml(tmp_path / "tuning.yaml", tuning_as_dict(design(machine, response="soft")))
    show_tuning(out, read_tuning(tmp_path / "tuning.yaml"))
    rotary, linear = text(out).split("predicted")[1:]
    assert "table" in rotary.partition("\n")[0]
    assert "slide" in linear.partition("\n")[0]
    for figure, units in (
        ("bandwidth", ("Hz", "Hz")),
        ("move: following error", ("rad", "m")),
        ("move: settling", ("s", "s")),
        ("last mass: vibration", ("rad", "m")),
        ("move: torque", ("N m", "N")),
        ("compliance", ("rad/(N m)", "m/N")),
        ("noise of torque", ("N m", "N")),
    ):
        for table, unit in zip((rotary, linear), units, strict=True):
            assert f"  {figure}, {unit}  " in table


def test_the_model_with_units_intervals_and_truth() -> None:
    truth = MachineModel(
        (
            AxisModel("axis1", "rotary", (Estimate(0.7), Estimate(2.0)), (Estimate(1000.0),),
                      (Estimate(0.5),)),
            AxisModel("slide", "linear", (Estimate(12.5),), ()),
        ),
        (Coupling(("slide", "axis1"), -0.2),),
    )  # fmt: skip
    lines = [" ".join(line.split()) for line in shown(model_table(model(), truth)).splitlines()]
    assert "axis1 mass 1 0.71235 0.0024 kg m2 0.7 +1.76 %" in lines
    assert "axis1 mass 2 2 not known kg m2 2 +0.00 %" in lines
    assert "axis1 spring 1 1000.5 3.9 N m/rad 1000 +0.05 %" in lines
    assert "slide mass 1 12.5 0.2 kg 12.5 +0.00 %" in lines
    assert "axis1 - slide coupling -0.25 0.02 kg m -0.2 +25.00 %" in lines
    both = Coupling(("axis1", "axis2"), 0.1)  # not of the first axis' kind
    turned = replace(
        model(),
        axes=(*reversed(model().axes), replace(model().axes[0], name="axis2")),
        couplings=(both,),
    )
    assert "axis1 - axis2 coupling 0.1 not known kg m2" in " ".join(
        shown(model_table(turned, None)).split()
    )
    plain = shown(model_table(model(), None))
    assert "truth" not in plain
    assert "0.71235" in plain


ROWS: list[dict[str, Any]] = [
    {"axis": "axis1", "name": "filter1_zero_damping", "unit": "1", "before": 0.123456,
     "after": 0.234567, "read_back": 0.234567},
    {"axis": "axis1", "name": "velocity_p", "unit": "N m s/rad", "before": -1234.56,
     "after": 2345.67, "read_back": None},
    {"axis": "axis1", "name": "position_p", "unit": "1/s", "before": 6.0, "after": 6.0,
     "read_back": 6.0},
]  # fmt: skip
RAW = {
    ("axis1", "filter1_zero_damping"): (123456, 234567),
    ("axis1", "velocity_p"): (-1234.5678, 2345.6789),
}


@pytest.mark.parametrize("width", [40, 60, 80, 100, 120, 200])
def test_no_line_is_wider_than_the_terminal_and_no_digit_is_lost(width: int) -> None:
    for table in (parameter_rows(ROWS, RAW), model_table(model(), model())):
        out = shown(table, width)
        assert max(len(line) for line in out.splitlines()) <= width
        assert "…" not in out
    if width >= 80:
        out = shown(parameter_rows(ROWS, RAW), width)
        for number in ("0.123456", "0.234567", "-1234.56", "2345.67", "123456", "234567"):
            assert number in out


def test_read_back_and_missing_values() -> None:
    out = shown(parameter_rows(ROWS, RAW), 160)
    first, second = (line for line in out.splitlines() if "filter1" in line or "velocity_p" in line)
    assert first.split()[-1] == "0.234567"
    assert second.split()[-1] == "2345.68"  # the drive's value is the last: nothing was read back


@pytest.mark.parametrize("name", ["[x]", "[/x]", "a[0]", "[bold]", "[red]r"])
def test_names_with_brackets_are_names(name: str) -> None:
    assert name in shown(model_table(model(name), model(name)))
    rows = [row | {"axis": name} for row in ROWS]
    assert name in shown(parameter_rows(rows, {}))
    with TerminalScreen(console()) as screen:
        screen.stage(f"Connect to {name}")
        screen.plan(plan(name), forecasts(name), 100.0)
        screen.progress(progress(0.5, name))
        screen.say(f"{name} is wrong!")
        out = text(screen.console)
    assert out.count(name) >= 5


def plan(name: str = "axis1") -> SweepPlan:
    tones = tuple(tone_near(f, 0.1, 0.004) for f in (1.0, 2.0, 9.5))
    return SweepPlan(
        0.004,
        (
            Sweep("direct, others free", name, ("slide",), tones),
            Sweep("direct, others locked", "slide", (), tones[:2]),
        ),
    )


def forecasts(name: str = "axis1") -> list[AxisForecast]:
    return [
        AxisForecast(name, "rotary", 0.5, 1.5, 20.0, 33.0, 0.1),
        AxisForecast("slide", "linear", 0.001, 0.2, 3.0, 40.0, 0.004),
    ]


def progress(done: float, name: str = "axis1") -> Progress:
    return Progress(1, 2, f"{name} direct, others free", 2, 3, 2.0, done, 61.4, 0.1)


def test_a_plan_on_the_screen() -> None:
    with TerminalScreen(console()) as screen:
        screen.plan(plan(), forecasts(), 3725.0)
        out = text(screen.console)
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert "axis1 direct, others free slide 3 1.00 - 9.51" in lines  # the nearest whole block
    assert "slide direct, others locked none, all held 2 1.00 - 2.00" in lines
    assert "axis1 ±0.5 rad 1.5 rad/s 33 N m 0.1 rad" in lines
    assert "slide ±0.001 m 0.2 m/s 40 N 0.004 m" in lines
    assert "62 min 05 s of machine time, a cycle of 4 ms." in " ".join(lines)


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_and_time_left_are_always_shown(terminal: bool) -> None:
    with TerminalScreen(console(terminal=terminal)) as screen:
        screen.stage("Measure")
        for done in (0.0, 0.1, 0.5, 0.9):
            screen.progress(progress(done))
        screen.say("A sentence in between")
        screen.stage("Next")  # closes the bar
        screen.progress(progress(0.0))
        out = text(screen.console)
    assert "Measure" in out
    assert "sweep 1/2" in out
    assert "2.00 Hz" in out
    assert "left" in out or "measuring the pace" in out
    assert "A sentence in between" in out


def test_the_terminal_is_left_in_order_when_a_session_fails() -> None:
    screen = TerminalScreen(console(terminal=True))

    def session() -> None:
        with screen:
            screen.progress(progress(0.3))
            raise RuntimeError("lost")

    with pytest.raises(RuntimeError, match="lost"):
        session()
    assert text(screen.console).count("\x1b[?25l") == text(screen.console).count("\x1b[?25h") == 1


@pytest.mark.parametrize("folder", ["/tmp/session", "/tmp/[a]", "/x/[/b]/c", "[bold]"])
def test_a_result_on_the_screen(folder: str) -> None:
    found = model()
    write_back = WriteBack((), (), in_memory=False, stored=False, backup=None)
    identified: Any = SimpleNamespace(notes=())
    tuning = Tuning((AxisTuning("axis1", {"velocity_p": 4.2}, 1.5, "total inertia 5"),))
    result = SessionResult(
        Path(folder),
        found,
        identified,
        tuning,
        write_back,
        found,
        754.0,
        61.5,
        (),
        moving_time=800.0,
    )
    out = console(200)
    show_result(out, result)
    assert f"Everything is in {folder}" in text(out)
    assert "Machine time 13 min 20 s, 12 min 34 s of it excitation; wall time 1 min 02 s." in text(
        out
    )
    told = result.as_dict()
    times = {"excitation_s": 754.0, "machine_s": 754.0, "moving_s": 800.0, "wall_s": 61.5}
    assert told["time"] == times
    assert (told["written"], told["stored"]) == (False, False)
    stored = replace(write_back, in_memory=True, stored=True)
    told = replace(result, write_back=stored).as_dict()
    assert (told["written"], told["stored"]) == (True, True)
    assert write_back.sentence in text(out)
    with TerminalScreen(console(200)) as screen:
        screen.found(result.model, result.truth)
        screen.designed(result.tuning)
        assert "total inertia" in text(screen.console)
        assert "0.71235" in text(screen.console)
