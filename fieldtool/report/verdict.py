"""The first sentence of a report: what matters, for people who read no further."""

from collections.abc import Sequence

from fieldtool.criticise.criticism import Base, Criticism, Judged
from fieldtool.report.in_drives import trial_sentence
from fieldtool.report.material import Material
from fieldtool.report.words import cause_words, listed, percent

MEANING = {
    "adequate": ("adequate: what the simulation leaves is noise, or below 1 % of the torque"),
    "explained": (
        "explained: the causes account for at least 90 % of the error's power beyond noise"
    ),
    "partly explained": (
        "partly explained: causes were found, and something is left that none of the known ones explains"
    ),
    "unexplained": (
        "unexplained: the simulation is wrong by more than noise, and no known cause explains it"
    ),
}
"""What the words of a criticism's verdict mean."""
TONES = {
    "adequate": "good",
    "explained": "good",
    "partly explained": "mixed",
    "unexplained": "mixed",
}


def meaning(criticism: Criticism) -> str:
    """Say what the verdict means, and which data it rests on."""
    return f"{MEANING[criticism.verdict]}, {_data(criticism)}"


def _data(criticism: Criticism) -> str:
    unseen, whole = _of_data(criticism, "unseen"), _of_data(criticism, "all")
    if not unseen and whole:
        return "on all data: what no fit has seen tells nothing"
    beside = f" (of {listed(whole)} on all data)" if whole else ""
    return f"on data that no fit has seen{beside}"


def _of_data(criticism: Criticism, data: Base) -> list[str]:
    return [name for name, one in criticism.judged.items() if one.data == data]


def verdict(material: Material) -> tuple[str, str]:
    """Return one plain sentence, and its tone: good, mixed or open."""
    if material.criticism is not None:
        said = f"{_of(material.criticism)} {trial_sentence(material)}".rstrip()
        return said, TONES[material.criticism.verdict]
    stopped = _stopped(material)
    if material.model is not None:
        return f"The machine was identified; its simulation was not criticised.{stopped}", "open"
    if material.recording is not None:
        return f"The machine was measured; it was not identified.{stopped}", "open"
    return f"Nothing was measured.{stopped}", "open"


def _of(criticism: Criticism) -> str:
    judged, unseen = criticism.judged, _of_data(criticism, "unseen")
    decide = [name for name, one in judged.items() if one.decides]
    if criticism.verdict == "adequate":
        if not unseen:
            return f"The verdict is: {meaning(criticism)}.{_not_unseen(criticism)}"
        most = judged[max(unseen, key=lambda n: judged[n].after or 0.0)]
        return (
            f"The simulation does as the machine does: at most {percent(most.after)} of the torque of "
            f"unseen data is not explained{_noise(most)}, which is noise or does not matter."
            f"{_not_unseen(criticism)}"
        )
    # without a cause, what decided is told; with causes, what they are of
    of_causes = {n for c in criticism.causes for n in c.axes}
    about = [n for n in unseen if n in (of_causes if criticism.causes else decide)]
    if not about:
        return f"The verdict is: {meaning(criticism)}.{_sentences(criticism, decide)}"
    worst = max(about, key=lambda n: judged[n].before or 0.0)
    one = judged[worst]
    if not criticism.causes:
        untold = [n for n in decide if n not in unseen]
        return (
            f"The simulation is wrong by {percent(one.before)} of the torque of {worst}{_noise(one)} on "
            f"unseen data, and none of the known causes explains it.{_sentences(criticism, untold)}"
        )
    named = listed([cause_words(c) for c in criticism.causes])
    ties = " Another cause would explain the data as well (see below)." if any(
        c.ties for c in criticism.causes
    ) else ""  # fmt: skip
    how = "explains" if len(criticism.causes) == 1 else "explain"
    partly = " in part" if one.decides else ""
    others = _sentences(criticism, [n for n in decide if n != worst])
    return (
        f"The simulation was wrong by {percent(one.before)} of the torque of {worst} on unseen data; "
        f"{named} {how} it{partly}: with it, {percent(one.after)} is left{_noise(one)}.{ties}{others}"
    )


def _noise(one: Judged) -> str:
    return "" if one.noise is None else f" (noise {percent(one.noise)})"


def _sentences(criticism: Criticism, axes: Sequence[str]) -> str:
    """Return what is unexplained of some axes."""
    mine = tuple(f"{name}: " for name in axes)
    return "".join(f" {s}." for s in criticism.unexplained if s.startswith(mine))


def _not_unseen(criticism: Criticism) -> str:
    """Say which axes the unseen data say nothing of, and what all data say of them."""
    axes = [name for name, one in criticism.judged.items() if one.data != "unseen"]
    said = f" They say nothing of {listed(axes)}." if axes else ""
    for name in _of_data(criticism, "all"):
        one = criticism.judged[name]
        said += f" All data leave {percent(one.after)} of the torque of {name}{_noise(one)}."
    return said


def _stopped(material: Material) -> str:
    ended = material.ended
    if ended is None:
        return ""
    early = (
        "" if ended.get("error") == "WriteBackError" else " early"
    )  # all was done, and taken back
    return f" The session ended{early}: {ended['text']}"


def error_titles(criticism: Criticism) -> tuple[str, dict[str, str]]:
    """Return what the torque is called in a table of errors, and what each axis' row is.

    What is told of all data is marked, once where that is so of all axes.
    """
    whole = {name for name, one in criticism.judged.items() if one.data == "all"}
    if whole and len(whole) == len(criticism.judged):
        return "torque, all data", {name: name for name in whole}
    return "torque", {
        name: f"{name} (torque: all data)" if name in whole else name for name in criticism.judged
    }
