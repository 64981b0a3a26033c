"""Judge what the tiny moves of the direction check showed; nothing moves here."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drives.api import AxisLimits
from fieldtool.experiment.checks.finding import Finding, Status
from fieldtool.records.recording import Experiment

TORQUE_SHARE = 0.5
"""Share of the torque limit above which a tiny slow move needs too much."""
HOLDING_SHARE = 0.3
"""Share of the torque limit above which an axis at rest is said to be held against a load."""
FOLLOWED = 0.8, 1.2
"""Moved over commanded within which an axis follows well."""


@dataclass(frozen=True)
class TinyMove:
    """One axis' move in the direction check, SI."""

    commanded: float
    """Largest distance of the target from where it began."""
    moved: float
    """Mean distance of the position while the target is there, in the direction commanded."""
    holding: float
    """Mean torque before the move."""
    needed: float
    """Largest torque while it moved, apart from holding."""


def tiny_move(experiment: Experiment, axis: int) -> TinyMove:
    """Return what an axis did in its own direction check."""
    target = np.asarray(experiment.position_reference)[:, axis]
    position = np.asarray(experiment.position)[:, axis]
    torque = np.asarray(experiment.torque)[:, axis]
    away = target - target[0]
    size = float(np.abs(away).max())
    there = np.flatnonzero(np.abs(away) >= size * (1 - 1e-9))
    first = int(np.flatnonzero(away)[0]) if size else 1
    sign = float(np.sign(away[there[0]])) if size else 1.0
    holding = float(torque[: max(first, 1)].mean())
    return TinyMove(
        size,
        sign * float(position[there].mean() - position[0]),
        holding,
        float(np.abs(torque[first:] - holding).max()),
    )


def judge_move(
    name: str, move: TinyMove, limits: AxisLimits, unit: str, torque_unit: str
) -> tuple[Finding, ...]:
    """Judge direction and distance, torque needed, and torque at rest of one axis."""
    ratio = move.moved / move.commanded if move.commanded else 0.0
    followed: Status = "pass" if FOLLOWED[0] <= ratio <= FOLLOWED[1] else "warn"
    needed, holding = move.needed / limits.torque, abs(move.holding) / limits.torque
    hard = needed > TORQUE_SHARE
    held = holding > HOLDING_SHARE
    return (
        Finding(
            "direction",
            followed,
            f"{move.commanded:.3g} {unit} commanded, {move.moved:.3g} {unit} moved, the torque's sign "
            "is right",
            name,
            ""
            if followed == "pass"
            else "It follows badly: friction, weak gains, or a wrong encoder resolution?",
        ),
        Finding(
            "brake and friction",
            "warn" if hard else "pass",
            f"a slow move of {move.commanded:.3g} {unit} needs {move.needed:.3g} {torque_unit}, "
            f"{100 * needed:.2g} % of the limit",
            name,
            "Does its brake drag, or is it blocked? Look before you measure." if hard else "",
        ),
        Finding(
            "load at rest",
            "warn" if held else "pass",
            f"{move.holding:.3g} {torque_unit} hold it, {100 * holding:.2g} % of the limit",
            name,
            "A steady load, such as gravity, takes much of the torque: never let it float "
            "(`may_float: false`), and raise the torque limit if the motor allows it."
            if held
            else "",
        ),
    )


def judged_moves(
    experiments: Sequence[Experiment],
    names: Sequence[str],
    limits: Sequence[AxisLimits],
    units: Sequence[str],
    torque_units: Sequence[str],
) -> tuple[Finding, ...]:
    """Judge every axis' own move among the experiments of a direction check that went well."""
    findings: list[Finding] = []
    for k, name in enumerate(names):
        own = [e for e in experiments if e.complete and e.driven == (name,)]
        if own:
            move = tiny_move(own[-1], k)
            findings += judge_move(name, move, limits[k], units[k], torque_units[k])
    return tuple(findings)
