"""Recordings that lack something, or can not be: criticised as far as possible, or one sentence."""

import json
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest

from fieldtool.cli.main import main
from fieldtool.criticise.evidence import lines
from fieldtool.records.model_file import write_model
from fieldtool.records.recording import save
from tests.unit.late_axis import FINE, MODEL, STEP, recorded

DELAY = 4 * STEP / FINE


@pytest.fixture(scope="module")
def good():
    return recorded(np.random.default_rng(11), DELAY)


@pytest.fixture
def criticise(tmp_path, capsys):
    """Criticise a recording with the right model at the command line; return code, JSON and words."""

    def run(recording, *options):
        path = tmp_path / "recording.h5"
        if recording is not None:
            save(recording, path)
        write_model(MODEL, tmp_path / "model.yaml")
        arguments = ["criticise", str(path), *options]
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        assert "defect" not in said.err
        return ended.value.code, said.out, said.err

    run.model = ["--model", str(tmp_path / "model.yaml"), "--json"]
    return run


def changed(recording, change):
    return replace(recording, experiments=tuple(change(e) for e in recording.experiments))


def test_without_controllers_and_in_amperes_it_says_what_it_reckons_with(good, criticise):
    """Half an A a N m: the model may be in A as well, and the masses stay in these units."""
    axes = tuple(replace(a, controller=None, torque_unit="A") for a in good.axes)
    code, out, _ = criticise(replace(good, axes=axes), *criticise.model)
    assert code == 0
    criticism = json.loads(out)["criticism"]
    (cause,) = criticism["causes"]
    assert (cause["effect"], cause["axis"]) == ("measurement_delay", "b")
    assert cause["parameters"]["delay"]["value"] == pytest.approx(DELAY, rel=0.05)
    for name in ("a", "b"):
        assert any(
            n.startswith(f"{name}: the recording states no controller") for n in criticism["notes"]
        )


def test_one_experiment_is_cut_in_time_and_the_noise_is_said_to_be_unknown(good, criticise):
    code, out, _ = criticise(replace(good, experiments=good.experiments[:1]), *criticise.model)
    assert code == 0
    criticism = json.loads(out)["criticism"]
    assert criticism["held_out"]["split"] == "time"
    assert criticism["held_out"]["noise_floor"] == {"a": None, "b": None}
    notes = " ".join(criticism["notes"])
    assert "cut in time" in notes
    assert "holds a period twice, so the noise is not known" in notes
    assert [c["effect"] for c in criticism["causes"]] == ["measurement_delay"]


def test_a_drive_at_its_limit_is_noticed(good, criticise):
    limit = 0.6 * np.max([np.abs(e.torque).max(axis=0) for e in good.experiments], axis=0)

    def clipped(e):
        return replace(e, torque=np.clip(e.torque, -limit, limit))

    code, out, _ = criticise(changed(good, clipped), *criticise.model)
    assert code == 0
    notes = json.loads(out)["criticism"]["notes"]
    assert any(n.startswith("a: its torque is at the same largest value in") for n in notes)
    code, _, err = criticise(changed(good, clipped))  # without a model
    assert code == 5
    assert "the torque of a is saturated" in err
    assert "--model model.yaml" in err


@pytest.mark.parametrize(
    ("change", "hint"),
    [
        (
            lambda e: replace(e, position=np.degrees(e.position)),
            "degrees would make a factor of 57",
        ),
        (lambda e: replace(e, torque=1000 * e.torque), "thousandths one of 1000"),
    ],
    ids=["degrees as rad", "mN m as N m"],
)
def test_units_that_can_not_be_are_refused_and_get_no_cause(good, criticise, change, hint):
    code, _, err = criticise(changed(good, change), *criticise.model)
    assert code == 5
    assert err.startswith("fieldtool: a: its torque is")
    assert "a unit is wrong" in err
    assert hint in err
    assert err.count("\n") == 1


def coarse(e, size=1.0):
    """An experiment as seen by an encoder of 2500 counts, with all its motions made smaller."""
    step = 2 * np.pi / 2500
    position = step * np.round(size * e.position / step)
    return replace(e, position=position, torque=size * e.torque)


def test_a_coarse_encoder_is_no_wrong_unit(good, criticise):
    """Its steps, differentiated twice, are many times the torque that was measured."""
    code, _, err = criticise(changed(good, coarse), *criticise.model)
    assert "a unit is wrong" not in err
    assert code == 0, err


def test_an_axis_that_hardly_counts_is_no_defect(good, criticise):
    def second(e):
        small = coarse(e, 0.02)
        position = np.column_stack([0.02 * e.position[:, 0], small.position[:, 1]])
        return replace(small, position=position)

    code, _, err = criticise(changed(good, second), *criticise.model)
    assert code == 0, err


def test_where_steps_hide_every_torque_nothing_is_said_of_it(good, criticise, monkeypatch):
    """All lines of one axis, then of both, have no weight."""
    weighed = lines._weighed

    def without(axes):
        def changed_weights(shape, noise):
            found = weighed(shape, noise)
            return replace(found, weight=np.where(np.isin([0, 1], axes), 0.0, found.weight))

        return changed_weights

    monkeypatch.setattr(lines, "_weighed", without([0]))
    code, out, _ = criticise(good, *criticise.model)
    assert code == 0
    criticism = json.loads(out)["criticism"]
    assert criticism["where"][0].startswith("a: nothing can be said of its torque")
    before = criticism["held_out"]["error_before"]
    assert before["a"]["torque"] is None
    assert before["b"]["torque"] > 0.0
    code, out, _ = criticise(good, *criticise.model[:2])
    assert "hidden" in out
    monkeypatch.setattr(lines, "_weighed", without([0, 1]))
    code, _, err = criticise(good, *criticise.model)
    assert code == 5
    assert "So it is with all axes" in err


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        (
            "time",
            "row 500: the time step is 0.004 s, the sample period 0.001 s: 3 sample(s) missing",
        ),
        ("position", "position of axis number 1 in row 700 is no finite number"),
    ],
)
def test_missing_samples_are_named_with_their_row(good, criticise, tmp_path, name, sentence):
    path = tmp_path / "recording.h5"
    save(good, path)
    with h5py.File(path, "a") as file:
        group = file["experiments/0000"]
        values = group[name][()]
        if name == "time":
            values[500:] += 0.003
        else:
            values[700, 1] = np.nan
        del group[name]
        group[name] = values
    code, _, err = criticise(None, *criticise.model)
    assert code == 2
    assert sentence in err


@pytest.mark.parametrize("what", ["nothing", "at rest", "too short"])
def test_where_nothing_moves_there_is_nothing_to_compare(good, criticise, what):
    first = good.experiments[0]
    still = replace(first, position=np.zeros_like(first.position))
    rows = slice(0, 150)
    short = replace(
        first, period=None, time=first.time[rows], position=first.position[rows],
        torque=first.torque[rows], position_reference=None,
    )  # fmt: skip
    kept = {"nothing": (), "at rest": (still,), "too short": (short,)}[what]
    code, _, err = criticise(replace(good, experiments=kept), *criticise.model)
    assert code == 5
    assert "there is nothing to compare a simulation with" in err


def test_a_motor_heavier_than_all_its_axis_is_a_wrong_unit(good, criticise):
    """Torques in N m that are said to be in mN m, and no model to compare with: the data sheet tells."""
    axes = tuple(replace(a, motor_inertia=0.02) for a in good.axes)
    one = replace(good, axes=axes[1:], experiments=tuple(_only_b(e) for e in good.experiments))
    code, _, err = criticise(changed(one, lambda e: replace(e, torque=e.torque / 1000)))
    assert code == 5
    assert "by the data sheet" in err


def _only_b(e):
    return replace(
        e, driven=("b",), position=e.position[:, 1:], torque=e.torque[:, 1:],
        position_reference=e.position_reference[:, 1:],
    )  # fmt: skip


@pytest.mark.parametrize("name", ["folder of CSV files", "empty folder", "nothing"])
def test_a_wrong_place_is_told_from_a_session(criticise, tmp_path, name):
    path = tmp_path / "recording.h5"
    if name != "nothing":
        path.mkdir()
    if name == "folder of CSV files":
        (path / "recording.yaml").write_text("format: fieldtool-recording/1\n")
    code, _, err = criticise(None)
    assert code == 2
    wanted = {
        "folder of CSV files": "fieldtool import",
        "empty folder": "no session folder",
        "nothing": "does not exist",
    }
    assert wanted[name] in err
    shutil.rmtree(path, ignore_errors=True)
