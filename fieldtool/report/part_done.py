"""What was done and when, what is missing, warnings, and the log."""

import re
from collections.abc import Mapping
from datetime import datetime
from typing import Any

from fieldtool.experiment.multisine.passes import AS_IT_CAME
from fieldtool.records.recording import Experiment, Recording
from fieldtool.report.material import Event, Material
from fieldtool.report.section import Block, Section, Table, Words

KINDS = {
    "multisine": "multisine",
    "stepped_sine": "stepped sines",
    "moves": "moves",
    "other": "other",
}
MOST_EVENTS = 400
"""Events that are shown, the last ones."""
DEEPEST = 10
"""Lists and mappings inside each other of which the innermost are shown."""


def facts(material: Material) -> tuple[tuple[str, str], ...]:
    """Return what was done, in short."""
    out: list[tuple[str, str]] = []
    for event in material.events_of("session"):
        options = event.get("options")
        command = str(event.get("command") or "session")
        plan = ""
        if isinstance(options, Mapping) and command not in ("write", "tools"):
            plan = f", {options.get('plan')} plan"
        out.append((_clock(event), f"{command}{plan}"))
    machine = material.machine
    if machine is not None:
        axes = ", ".join(f"{a.name} ({a.kind}, node {a.node_id})" for a in machine.axes)
        out.append(("Axes", axes))
        out.append(("Bus", f"{machine.bus.interface} {machine.bus.channel}, "
                           f"{machine.bus.bitrate} bit/s"))  # fmt: skip
    elif material.axes:
        out.append(("Axes", ", ".join(material.axes)))
    drives = {(str(e.get("axis")), str(e.get("name"))) for e in material.events_of("drive")}
    if drives:
        out.append(("Drives", "; ".join(f"{axis}: {name}" for axis, name in sorted(drives))))
    if material.recording is not None:
        out.append(("Measured", _measured(material.recording)))
    if material.trial_seconds:
        tried = f"{_tried(material)}, {material.trial_seconds:.3g} s of machine time"
        out.append(("Tried", tried))
    return tuple(out)


def _tried(material: Material) -> str:
    """Say which parameters moved the axes in trials; what a kill cut off may be of either."""
    kinds = {re.split("[:,]", name)[0] for name in material.trial_experiments}
    if "after" in kinds:
        return "old and new parameters"
    return "old parameters" if kinds == {"before"} else "parameters"


def _measured(recording: Recording) -> str:
    as_they_came = {e.name for e in recording.experiments if e.name.endswith(AS_IT_CAME)}
    every = [e for e in recording.experiments if e.name + AS_IT_CAME not in as_they_came]
    seconds = sum(e.samples for e in every) * recording.sample_period
    cut = sum(_cut(e) for e in every)
    more = f", {cut} of them cut short" if cut else ""
    return (
        f"{len(every)} experiments{more}, {seconds:.3g} s of machine time, a "
        f"sample every {recording.sample_period * 1000:g} ms"
    )


def missing(material: Material) -> Section | None:
    """Say what is not there, and how a session ended that did not come to its end."""
    ended = material.ended
    if ended is None and not material.missing:
        return None
    return Section(
        "What is missing" if material.missing else "How it ended",
        "Not everything is there." if ended is None else _cut_short(material, ended),
        (
            *([] if ended is None else [Words((str(ended["text"]),), "warning")]),
            Words(material.missing, "list"),
        ),
    )


def _cut_short(material: Material, ended: Event) -> str:
    begun = material.events_of("session")
    who = "This session"
    if len(begun) > 1:
        who = f"The session's last command, {begun[-1].get('command')} of {_clock(begun[-1])},"
    if ended.get("error") == "WriteBackError":
        return f"{who} took the new parameters back."
    return f"{who} did not come to its end."


def done(material: Material) -> Section | None:
    """List machine, limits, drives and experiments."""
    blocks: list[Block] = []
    if material.machine is not None:
        rows = []
        for axis in material.machine.axes:
            p = "rad" if axis.kind == "rotary" else "m"
            t = "N m" if axis.kind == "rotary" else "N"
            low, high = axis.limits.travel
            rows.append(
                (
                    axis.name,
                    str(axis.node_id),
                    axis.drive,
                    f"{low:.4g} to {high:.4g} {p}",
                    f"{axis.limits.velocity:.4g} {p}/s",
                    f"{axis.limits.torque:.4g} {t}",
                    f"{axis.limits.following_error:.4g} {p}",
                )
            )
        columns = (
            "axis",
            "node",
            "drive profile",
            "travel",
            "velocity",
            "torque",
            "following error",
        )
        blocks.append(Table(columns, tuple(rows), "Axes and their limits"))
    if material.recording is not None:
        step = material.recording.sample_period
        blocks.append(
            Table(
                ("experiment", "kind", "driven", "time", "period", "note"),
                tuple(_experiment(e, step) for e in material.recording.experiments),
                "Experiments",
            )
        )
    if not blocks:
        return None
    return Section("What was done", "", tuple(blocks))


def _cut(e: Experiment) -> bool:
    return not e.complete and not e.name.endswith(AS_IT_CAME)


def _experiment(e: Experiment, step: float) -> tuple[str, ...]:
    note = f"cut short. {e.note}".strip() if _cut(e) else e.note
    period = f"{e.period:.3g} s" if e.period else ""
    return e.name, KINDS[e.kind], ", ".join(e.driven), f"{e.samples * step:.3g} s", period, note


def warnings(material: Material) -> Section | None:
    """List every warning once."""
    texts = [str(e.get("text")) for e in material.events_of("warning")]
    if material.criticism is not None:
        texts += material.criticism.notes
    texts = list(dict.fromkeys(texts))
    if not texts:
        return None
    return Section("Warnings and notes", "", (Words(tuple(texts), "list"),))


def log(material: Material) -> Section | None:
    """List what happened, folded."""
    if not material.events:
        return None
    shown = material.events[-MOST_EVENTS:]
    left_out = len(material.events) - len(shown)
    rows = tuple((_clock(e), str(e.get("event")), _details(e)) for e in shown)
    lead = f"{left_out} earlier events are in events.jsonl." if left_out else ""
    return Section("Events", lead, (Table(("time", "event", "details"), rows),), folded=True)


def _details(event: Event) -> str:
    parts = []
    for key, value in event.items():
        if key in ("time", "event", "rows"):
            continue
        parts.append(f"{key} {_plain(value)}")
    return "; ".join(parts)


def _plain(value: Any, depth: int = 0) -> str:
    if depth > DEEPEST:
        return "..."
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {_plain(v, depth + 1)}" for k, v in value.items() if v is not None)
    if isinstance(value, list):
        return ", ".join(_plain(v, depth + 1) for v in value) or "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _clock(event: Event) -> str:
    try:
        time = datetime.fromisoformat(str(event.get("time"))).astimezone()
    except (ValueError, OverflowError, OSError):  # no time, or none of this computer's calendar
        return str(event.get("time"))
    return time.strftime("%Y-%m-%d %H:%M:%S")
