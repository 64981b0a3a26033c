"""What effects that are not linear do to a design: sentences for a technician, with their numbers."""

from collections.abc import Mapping, Sequence
from typing import Any

from fieldtool.design.machine import DRY, PULLS, number
from fieldtool.design.moves import TestMove
from fieldtool.design.servo import Servo
from fieldtool.records.model import MachineModel


def notes_of(model: MachineModel, servos: Sequence[Servo], moves: Sequence[TestMove]) -> list[str]:
    """Return what the model's effects mean for the designed loops, a sentence each.

    Dry friction holds a motor up to its torque over the loop's stiffness away from the target until
    the integral has grown; with an integral it may then move past the target and stick again
    (hunting; Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30, 1994).
    """
    notes = []
    for effect in model.effects:
        kind, name = effect.get("effect"), effect.get("axis")
        if not isinstance(name, str) or name not in model.names:
            continue
        servo = servos[model.names.index(name)]
        rotary = model.axes[model.names.index(name)].kind == "rotary"
        unit, torque_unit = ("rad", "N m") if rotary else ("m", "N")
        if kind in DRY:
            notes += _friction(name, effect, servo, unit, torque_unit)
        elif kind in PULLS and (rotary or kind != "gravity"):
            size = abs(number(effect, PULLS[kind]))
            start = moves[model.names.index(name)].start
            what = f"{kind} of {size:.3g} {torque_unit}"
            notes.append(_pull(name, what, size, servo, unit, start))
        elif kind == "backlash":
            gap = number(effect, "gap") or 2 * number(effect, "half_gap")
            notes.append(
                f"{name}: the backlash of {gap:.3g} {unit} makes the last mass uncertain by as "
                "much, and small oscillations about a target are possible; the margin was kept "
                "with a softened joint as well."
            )
        elif kind == "measurement_delay" and number(effect, "delay") > 0:
            notes.append(
                f"{name}: positions come {1e3 * number(effect, 'delay'):.3g} ms late; nobody knows "
                "whether the drive's own loops get them as late, so the margin was kept both ways."
            )
    return notes


def _friction(
    name: str, effect: Mapping[str, Any], servo: Servo, unit: str, torque_unit: str
) -> list[str]:
    loop = servo.loop
    torque = max(
        number(effect, "torque"),
        number(effect, "breakaway"),
        number(effect, "coulomb_positive"),
        number(effect, "coulomb_negative"),
    )
    if torque <= 0:
        return []
    away = _away(servo, torque)
    if loop.velocity_i <= 0:
        return [f"{name}: dry friction may hold the motor up to {away:.3g} {unit} off its target."]
    return [
        f"{name}: dry friction of {torque:.3g} {torque_unit} may hold the motor up to {away:.3g} {unit} "
        f"off its target for about {loop.velocity_p / loop.velocity_i:.2g} s, and then let it creep or "
        "hunt; what is predicted of moves has it in."
    ]


def _pull(name: str, what: str, size: float, servo: Servo, unit: str, start: float | None) -> str:
    loop = servo.loop
    time = ""
    if loop.velocity_i > 0:
        time = f" for about {loop.velocity_p / loop.velocity_i:.2g} s after a move"
    known = "does not have it, for it is not known where they start"
    if start is not None:
        known = f"has it in, for moves that start at {start:.4g} {unit}"
    return (
        f"{name}: {what} may pull the motor up to {_away(servo, size):.3g} {unit} off its target{time}; "
        f"what is predicted of moves {known}. Where that is too far, a loop that gives way "
        "less holds it better: compare the compliance of the responses (`fieldtool design FOLDER "
        "--compare`) and of the present parameters."
    )


def _away(servo: Servo, torque: float) -> float:
    """Return how far a slow torque moves the motor before the integral takes it back."""
    loop = servo.loop
    return torque / (loop.velocity_p * loop.position_p + loop.velocity_i)
