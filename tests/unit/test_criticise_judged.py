"""Verdict, sentences, tables and report speak of the same axis by the same data."""

from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from fieldtool.cli.criticise import show_criticism
from fieldtool.criticise.criticise import criticise
from fieldtool.criticise.criticism import Cause, Judged
from fieldtool.criticise.criticism_file import read_criticism
from fieldtool.criticise.pictured import pictures_of
from fieldtool.criticise.pictures_file import NOISE_ONLY
from fieldtool.records.model import AxisModel, Estimate, MachineModel
from fieldtool.records.recording import AxisInfo, Experiment, Recording
from fieldtool.records.yaml_file import write_yaml
from fieldtool.report.material import Material
from fieldtool.report.part_causes import gain
from fieldtool.report.verdict import verdict

STEP, MASS = 2e-3, 5.0
LINES = np.array([2.0, 3.0, 5.0, 7.0, 9.0, 11.0])


def recorded(experiments, axes):
    infos = tuple(AxisInfo(n, "linear", torque_unit="N", position_unit="m") for n in axes)
    model = MachineModel(tuple(AxisModel(n, "linear", (Estimate(MASS),), ()) for n in axes))
    return Recording(STEP, infos, tuple(experiments)), model


def swinging(time, sizes, rng, lines=LINES):
    """Position and torque of free masses."""
    phase = rng.uniform(0, 6, (len(sizes), lines.size))
    omega = 2 * np.pi * lines
    waves = np.cos(omega * time[:, None, None] + phase)
    position = np.array(sizes) * np.sum(waves / omega**2, axis=2)
    return position, -MASS * np.array(sizes) * np.sum(waves, axis=2)


@pytest.fixture(scope="module")
def apart():
    """Only what is kept unseen has an error of a, and only what fits see one of b."""
    rng, time, experiments = np.random.default_rng(5), np.arange(4000) * STEP, []
    for number, name in enumerate("aab"):
        sizes = [1.0 if axis == name else 0.2 for axis in "ab"]
        position, torque = swinging(time, sizes, rng, np.array([0.4, 0.6, 0.9, 1.3, 1.7, 2.1]))
        size = np.std(torque, axis=0)
        torque += 1e-3 * size * rng.standard_normal(torque.shape)
        while_on = np.abs(time - 4) < 3
        if number == 1:
            torque[:, 0] += 0.018 * size[0] * while_on * np.sin(2 * np.pi * 1.5 * time)
        if number == 2:
            torque[:, 1] += 0.3 * size[1] * while_on * np.sin(2 * np.pi * 1.5 * time)
        position += 1e-6 * rng.standard_normal(position.shape)
        experiments.append(
            Experiment(
                f"e{number}", "moves", (name,), (), None, time + 10 * number, position, torque,
                position_reference=None,
            )
        )  # fmt: skip
    return criticise(*recorded(experiments, "ab")).criticism


def repeated(sizes, noise, error):
    """Two axes in one multisine three times; an error that repeats in the last, which is kept unseen.

    ``noise`` and ``error`` are shares of the torque, one an axis.
    """
    rng, rows, periods, experiments = np.random.default_rng(6), 500, 8, []
    time = np.arange(rows * periods) * STEP
    position, clean = swinging(time, sizes, rng)
    size = np.std(clean, axis=0)
    for number in range(3):
        torque = clean + noise * size * rng.standard_normal(clean.shape)
        if number == 2:
            wrong = np.sum(
                [np.cos(2 * np.pi * f * time + rng.uniform(0, 6)) for f in range(1, 12)], axis=0
            )
            torque += np.array(error) * size * (wrong / np.std(wrong))[:, None]
        moved = position + 1e-8 * rng.standard_normal(position.shape)
        experiments.append(
            Experiment(
                f"e{number}", "multisine", ("a", "b"), (), rows * STEP, time + 10 * number, moved,
                torque, position_reference=None,
            )
        )  # fmt: skip
    return recorded(experiments, "ab")


def screen(criticism):
    out = StringIO()
    show_criticism(Console(width=200, file=out), criticism)
    return out.getvalue()


def shown(share):
    return f"{100 * share:.2g} %"


def test_the_axis_that_decides_is_the_one_that_sentences_and_report_name(apart):
    assert apart.verdict == "unexplained"
    a, b = apart.judged["a"], apart.judged["b"]
    assert (a.data, a.decides) == ("unseen", True)
    assert (b.data, b.decides) == ("unseen", False)
    (sentence,) = apart.unexplained
    assert sentence.startswith(f"a: {shown(a.after)} of the torque of unseen data is not explained")
    for name, one in apart.judged.items():
        assert one.before == apart.held_out.error_before[name].torque
        (where,) = [s for s in apart.where if s.startswith(f"{name}: ")]
        assert where.startswith(f"{name}: {shown(one.before)} of the torque of unseen data ")
    words, _ = verdict(Material("x", criticism=apart))
    assert f"wrong by {shown(a.before)} of the torque of a on unseen data" in words
    assert "on data that no fit has seen)" in screen(apart).splitlines()[0]


def test_an_error_that_only_seen_data_have_is_told_beside_the_verdict(apart):
    (note,) = [n for n in apart.notes if "of the torque of all data" in n]
    assert note.startswith("b: ")
    assert f"{shown(apart.judged['b'].after)} of that of unseen data, by which it is judged" in note


def test_an_error_that_all_data_drown_in_their_noise_has_its_sentence_and_its_pictures():
    found = criticise(*repeated((1.0, 1.0), noise=0.02, error=(0.0, 0.014)))
    criticism, b = found.criticism, found.criticism.judged["b"]
    assert criticism.verdict == "unexplained"
    assert found.after[1].overall[0] < 1.5 * found.after[1].overall[1]
    (sentence,) = criticism.unexplained
    assert sentence.startswith(f"b: {shown(b.after)} of the torque of unseen data is not explained")
    assert f"(noise {shown(b.noise)})" in sentence
    quiet = {p.axis for p in pictures_of(found.found) if p.sentence == NOISE_ONLY}
    assert quiet == {"a"}


def test_the_report_names_the_axis_that_decides_and_not_one_with_more_noise():
    noise = np.array([0.3, 0.01])
    criticism = criticise(*repeated((1.0, 1.0), noise, error=(0.0, 0.02))).criticism
    assert criticism.judged["a"].before > criticism.judged["b"].before
    words, _ = verdict(Material("x", criticism=criticism))
    assert f"wrong by {shown(criticism.judged['b'].before)} of the torque of b" in words
    assert "torque of a" not in words


@pytest.mark.parametrize("judged", ["unseen", "all"])
def test_noise_that_an_axis_is_judged_with_is_not_called_unknown(judged):
    """One sweep, which does not repeat, is among what fits see; b may move in that alone."""
    both = (1.0, 1.0)
    recording, model = repeated(
        both if judged == "unseen" else (1.0, 0.0), noise=0.02, error=(0.0, 0.0)
    )
    time = recording.experiments[0].time
    position, torque = swinging(time, both, np.random.default_rng(7))
    torque += 0.01 * np.random.default_rng(8).standard_normal(torque.shape)
    sweep = Experiment(
        "s", "stepped_sine", ("b",), (), None, time + 40, position, torque, position_reference=None
    )
    recording = replace(recording, experiments=(*recording.experiments, sweep))
    criticism = criticise(recording, model).criticism
    assert criticism.judged["a"].noise is not None
    assert criticism.judged["b"].data == judged
    unknown = [n for n in criticism.notes if "is not known" in n]
    if judged == "unseen":
        assert not unknown
    else:
        assert unknown == [
            "Not every stretch that is compared holds a period twice, so the noise of b is not known: "
            "what is not explained may in part be noise."
        ]


CAUSE = Cause("coulomb_friction", "a", "motor", {}, "", 0.16, 1e-9)
EXPLAINED = Judged("unseen", 0.16, 0.001, 0.001, decides=False)


@pytest.mark.parametrize("data", ["unseen", "all"])
def test_a_cause_explains_its_axis_whole_where_another_axis_is_what_is_left(apart, data):
    sentence = f"b: 3 % of the torque of {data} data is not explained"
    criticism = replace(
        apart,
        verdict="partly explained",
        causes=(CAUSE,),
        unexplained=(sentence,),
        judged={"a": EXPLAINED, "b": Judged(data, 0.03, 0.03, 0.001, decides=True)},
    )
    words, _ = verdict(Material("x", criticism=criticism))
    assert "in part" not in words
    assert f"{sentence}." in words
    judged = {**criticism.judged, "a": replace(EXPLAINED, decides=True)}
    assert "in part" in verdict(Material("x", criticism=replace(criticism, judged=judged)))[0]


def test_an_axis_that_all_data_judge_has_their_figures_in_the_tables(apart):
    judged = {**apart.judged, "b": Judged("all", 0.123, 0.123, None, decides=True)}
    criticism = replace(apart, judged=judged)
    (row,) = [r for r in screen(criticism).splitlines() if "b (torque: all data)" in r]
    assert row.count("12.3 %") == 2
    assert "on data that no fit has seen (of b on all data)" in screen(criticism)
    table = gain(Material("x", criticism=criticism)).blocks[0]
    assert table.rows[1][:2] == ("b (torque: all data)", "12 %")


def test_all_data_that_judge_all_axes_are_named_once_in_a_table(apart):
    judged = {name: replace(one, data="all") for name, one in apart.judged.items()}
    criticism = replace(apart, judged=judged)
    assert len(judged) > 1
    shown = screen(criticism)
    assert shown.count("all data error before") == 1
    assert "(torque: all data)" not in shown
    table = gain(Material("x", criticism=criticism)).blocks[0]
    assert [row[0] for row in table.rows] == list(judged)
    assert [title for title in table.columns if "all data" in title] == [
        f"torque, all data: error{' before' if criticism.causes else ''}"
    ]


def test_what_axes_are_judged_by_is_read_back_and_files_without_it_are_read(apart, tmp_path):
    file, plain = tmp_path / "criticism.yaml", apart.as_dict()
    write_yaml(file, plain)
    assert read_criticism(file, apart.model).judged == apart.judged
    del plain["judged"]
    write_yaml(file, plain)
    old = read_criticism(file, apart.model)
    assert {n: (j.data, j.after) for n, j in old.judged.items()} == {
        n: (j.data, j.after) for n, j in apart.judged.items()
    }
    words, _ = verdict(Material("x", criticism=old))
    assert f"wrong by {shown(apart.judged['a'].before)} of the torque of a on unseen data" in words


def without_judged(criticism, folder, still=""):
    """Return it as a file reads that has no ``judged``, and no torque of the axis that is ``still``."""
    plain = criticism.as_dict()
    del plain["judged"]
    for errors in (plain["held_out"]["error_before"], plain["held_out"]["error_after"]):
        if still:
            errors[still]["torque"] = None
    write_yaml(folder / "criticism.yaml", plain)
    return read_criticism(folder / "criticism.yaml", criticism.model)


@pytest.mark.parametrize("unexplained", [(), ("b: 3 % of the torque is not explained",)])
def test_a_file_without_judged_never_says_whole_of_what_is_explained_in_part(
    apart, tmp_path, unexplained
):
    partly = replace(apart, verdict="partly explained", causes=(CAUSE,), unexplained=unexplained)
    words, _ = verdict(Material("x", criticism=without_judged(partly, tmp_path)))
    assert "explains it in part: " in words
    assert all(f"{sentence}." in words for sentence in unexplained)
    whole = replace(partly, verdict="explained")
    words, _ = verdict(Material("x", criticism=without_judged(whole, tmp_path)))
    assert "explains it: " in words


@pytest.mark.parametrize("causes", [(), (CAUSE,)])
def test_a_file_without_judged_keeps_what_it_says_of_an_axis_without_torque(
    apart, tmp_path, causes
):
    sentence = "b: 12 % of the torque of all data is not explained"
    left = replace(
        apart,
        verdict="partly explained" if causes else "unexplained",
        causes=causes,
        unexplained=(sentence,),
    )
    words, _ = verdict(Material("x", criticism=without_judged(left, tmp_path, still="b")))
    assert f"{sentence}." in words
