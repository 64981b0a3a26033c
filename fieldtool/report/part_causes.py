"""Causes, what is gained by knowing them, what is left, and what was rejected."""

from fieldtool.criticise.criticism import Criticism
from fieldtool.report.figures import bars_figure
from fieldtool.report.material import Material
from fieldtool.report.section import Block, Plot, Plots, Section, Table, Words
from fieldtool.report.verdict import error_titles, meaning
from fieldtool.report.words import axis_words, cause_words, effect_words, number_words, percent


def causes(material: Material) -> Section | None:
    """List the causes with their numbers and evidence, and the rivals that do as well."""
    criticism = material.criticism
    if criticism is None:
        return None
    if not criticism.causes:
        return Section("Causes", f"No cause is named. The verdict is {meaning(criticism)}.")
    rows = tuple(
        (
            effect_words(c.effect),
            c.axis_words,
            c.location,
            "\n".join(number_words(name, n) for name, n in c.parameters.items()),
            percent(c.gain),
        )
        for c in criticism.causes
    )
    columns = ("cause", "axis", "where", "numbers, 95 %", "explains of the torque")
    blocks: list[Block] = [
        Table(columns, rows),
        Words(tuple(f"{cause_words(c)}: {c.evidence}." for c in criticism.causes), "list"),
        *_ties(criticism),
    ]
    return Section("Causes", f"The verdict is {meaning(criticism)}.", tuple(blocks))


def _ties(criticism: Criticism) -> list[Block]:
    tied = [(c, t) for c in criticism.causes for t in c.ties]
    if not tied:
        return []
    rows = tuple(
        (
            cause_words(c),
            f"{effect_words(t.effect)} of {axis_words(t.axis)} ({t.location})",
            t.experiment,
        )
        for c, t in tied
    )
    return [
        Table(
            ("named", "explains the data as well", "what would tell them apart"),
            rows,
            "Ties: the data do not tell these apart",
        ),
        Words(("fieldtool measure MACHINE --to-distinguish FOLDER",), "command"),
    ]


def gain(material: Material) -> Section | None:
    """Compare the errors before and after on what no fit has seen."""
    criticism = material.criticism
    if criticism is None or not criticism.held_out.error_before:
        return None
    held = criticism.held_out
    kept = "whole experiments" if held.split == "experiments" else "stretches in time"
    unseen = Words((f"Kept unseen were {kept}: {', '.join(held.experiments)}.",))
    meaning = "An error is the RMS of measured minus simulated over the RMS of measured."
    torque, row = error_titles(criticism)
    if not criticism.causes:
        plain = tuple(
            (
                row[name],
                percent(one.before),
                percent(one.noise),
                percent(held.error_before[name].position),
            )
            for name, one in criticism.judged.items()
        )
        table = Table(("axis", f"{torque}: error", "noise floor", "position: error"), plain)
        return Section("The error on data that no fit has seen", meaning, (table, unseen))
    rows = tuple(
        (
            row[name],
            percent(one.before),
            percent(one.after),
            percent(one.noise),
            percent(held.explained.get(name)),
            percent(held.error_before[name].position),
            percent(held.error_after[name].position),
        )
        for name, one in criticism.judged.items()
    )
    unseen_only = {n: one for n, one in criticism.judged.items() if one.data == "unseen"}
    groups: dict[str, dict[str, float | None]] = {
        "before": {n: _hundredfold(one.before) for n, one in unseen_only.items()},
        "after": {n: _hundredfold(one.after) for n, one in unseen_only.items()},
        "noise floor": {n: _hundredfold(one.noise) for n, one in unseen_only.items()},
    }
    table = Table(
        (
            "axis",
            f"{torque}: error before",
            "after",
            "noise floor",
            "share of the explainable error that is explained",
            "position: error before",
            "after",
        ),
        rows,
    )
    plot = Plot(
        bars_figure(groups, "error of the torque, %"), "Error of the torque on unseen data", 260
    )
    return Section(
        "What is gained, on data that no fit has seen",
        meaning,
        (table, Plots((plot,), 2), unseen),
    )


def unexplained(material: Material) -> Section | None:
    """Describe what is left, without a name."""
    if material.criticism is None or not material.criticism.unexplained:
        return None
    return Section(
        "What is left",
        "This is more than noise, and none of the known causes explains it. It is described, not named.",
        (Words(tuple(f"{s}." for s in material.criticism.unexplained), "list"),),
    )


def rejected(material: Material) -> Section | None:
    """List what was tried and not named, with the reason, folded."""
    if material.criticism is None or not material.criticism.rejected:
        return None
    rows = tuple(
        (effect_words(r.effect), axis_words(r.axis), r.location, r.why)
        for r in material.criticism.rejected
    )
    count = len({r.effect for r in material.criticism.rejected})
    return Section(
        "What was rejected, and why",
        f"{count} other causes were tried, {len(rows)} of them by axis and place.",
        (Table(("cause", "axis", "where", "why not"), rows),),
        folded=True,
    )


def _hundredfold(share: float | None) -> float | None:
    return None if share is None else 100 * share
