"""The first sentence of a report: what matters, for people who read no further."""

from fieldtool.criticise.criticism import Criticism, HeldOut
from fieldtool.report.material import Material
from fieldtool.report.words import cause_words, listed, percent

MEANING = {
    "adequate": (
        "adequate: what the simulation leaves is noise, or below 1 % of the torque, on data that no fit "
        "has seen"
    ),
    "explained": (
        "explained: the causes account for at least 90 % of the error's power beyond noise, on data "
        "that no fit has seen"
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


def verdict(material: Material) -> tuple[str, str]:
    """Return one plain sentence, and its tone: good, mixed or open."""
    if material.criticism is not None:
        tried = f" {material.trial.sentence}" if material.trial is not None else ""
        return f"{_of(material.criticism)}{tried}", TONES[material.criticism.verdict]
    stopped = _stopped(material)
    if material.model is not None:
        return f"The machine was identified; its simulation was not criticised.{stopped}", "open"
    if material.recording is not None:
        return f"The machine was measured; it was not identified.{stopped}", "open"
    return f"Nothing was measured.{stopped}", "open"


def _of(criticism: Criticism) -> str:
    held = criticism.held_out
    told = [n for n, error in held.error_before.items() if error.torque is not None]
    worst = max(told, key=lambda n: held.error_before[n].torque or 0.0, default="")
    untold = "".join(f" {sentence}." for sentence in _untold(criticism))
    if not worst or (untold and not criticism.causes):
        return f"The verdict is: {MEANING[criticism.verdict]}.{untold or _still(held)}"
    before, after = held.error_before[worst].torque, held.error_after[worst].torque
    noise = held.noise_floor[worst]
    beyond = "" if noise is None else f" (noise {percent(noise)})"
    if criticism.verdict == "adequate":
        return (
            f"The simulation does as the machine does: at most {percent(after)} of the torque of unseen "
            f"data is not explained{beyond}, which is noise or does not matter.{_still(held)}"
        )
    if not criticism.causes:
        return (
            f"The simulation is wrong by {percent(before)} of the torque of {worst}{beyond}, and "
            "none of the known causes explains it."
        )
    named = listed([cause_words(c) for c in criticism.causes])
    ties = " Another cause would explain the data as well (see below)." if any(
        c.ties for c in criticism.causes
    ) else ""  # fmt: skip
    how = "explains" if len(criticism.causes) == 1 else "explain"
    partly = " in part" if criticism.verdict == "partly explained" else ""
    return (
        f"The simulation was wrong by {percent(before)} of the torque of {worst}; {named} {how} "
        f"it{partly}: with it, {percent(after)} is left{beyond}.{ties}{untold}"
    )


def _untold(criticism: Criticism) -> tuple[str, ...]:
    """Return what is unexplained of axes that the unseen data say nothing of."""
    errors = criticism.held_out.error_before
    axes = tuple(f"{name}: " for name, error in errors.items() if error.torque is None)
    return tuple(s for s in criticism.unexplained if s.startswith(axes))


def _still(held: HeldOut) -> str:
    """Say which axes the unseen data say nothing of."""
    axes = [name for name, error in held.error_before.items() if error.torque is None]
    return f" They say nothing of {listed(axes)}." if axes else ""


def _stopped(material: Material) -> str:
    ended = material.events_of("ended")
    if ended and ended[-1].get("text"):
        return f" The session ended early: {ended[-1]['text']}"
    return ""
