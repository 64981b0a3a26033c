"""Where a search begins: the rule's gains as each drive holds them, lowered until they are stable."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf

import numpy as np

from fieldtool.design.drive_side import GAINS, DriveSide
from fieldtool.design.machine import Machine
from fieldtool.design.robust import stable_on_all
from fieldtool.design.rule import DesignError, rule
from fieldtool.design.search import Best, Space
from fieldtool.design.servo import Servo
from fieldtool.records.closed_loop import AxisLoop
from fieldtool.records.model import AxisModel, MachineModel

LOWERED, MOST_LOWERED = 0.85, 12
HIGHEST = 30.0
"""Highest frequency of a filter, over the highest one that was measured."""


def plain_start(
    model: MachineModel, sides: Sequence[DriveSide], machines: Sequence[Machine], top: float
) -> tuple[Best, ...]:
    """Return controllers without filters that are stable on every machine, one an axis.

    Parameters
    ----------
    model
        The machine.
    sides
        One an axis.
    machines
        That the controllers are to be stable on; the first one is the model's.
    top
        rad/s: highest frequency that was measured.

    Raises
    ------
    DesignError
        If there are none, or a drive holds none.
    """
    for side in sides:
        side.check_gains()
    modes = np.concatenate([machines[0].modes, machines[0].held_modes])
    lowest = 0.3 * float(modes.min()) if modes.size else 2 * np.pi
    ruled = rule(model)
    found = [
        _begin(loop, axis, side, lowest, top)
        for loop, axis, side in zip(ruled, model.axes, sides, strict=True)
    ]
    for _ in range(MOST_LOWERED):
        if stable_on_all(machines, tuple(best.servo for best in found)):
            return tuple(found)
        found = [replace(best, servo=slower(best.servo)) for best in found]
    outside = [
        f"{side.axis}: {words}"
        for loop, side in zip(ruled, sides, strict=True)
        for words in side.out_of_range({name: getattr(loop, name) for name in GAINS})
    ]
    if outside:
        raise DesignError(
            f"no gains that are stable fit into what the drives hold, whose ranges are too small: "
            f"{'; '.join(outside)}. Nothing is written. Choose other units or ranges in the drive, or "
            "enter gains by hand."
        )
    raise DesignError(
        "no gains were found that are stable on every machine that the model's uncertainty allows; "
        "nothing is written. Measure longer (--time), or give the number of masses with `fieldtool "
        "identify FOLDER --masses AXIS=N`."
    )


def _begin(loop: AxisLoop, axis: AxisModel, side: DriveSide, lowest: float, top: float) -> Best:
    highest = 0.8 * np.pi / (side.timing.period or 1e-4)
    space = Space(side, axis.total_mass, (), lowest, min(highest, HIGHEST * top))
    present = side.present or {}
    share = 1.0 if side.has("velocity_ff") or side.is_pid else present.get("velocity_ff", 0.0)
    inertia = axis.total_mass if side.has("inertia_ff") else present.get("inertia_ff", 0.0)
    viscous = axis.total_friction if side.has("viscous_ff") else present.get("viscous_ff", 0.0)
    servo = side.servo(
        {"position_p": 1.0, "velocity_p": 1.0, "velocity_i": 1.0}
        | {f"filter{k}_type": 0.0 for k in side.filters}
    )
    corner = servo.velocity_filter
    if side.has("velocity_filter"):
        corner = space.highest / (2 * np.pi)
    kept = servo.loop.filters  # of a drive whose filters can not be set
    fed = replace(loop, velocity_ff=share, viscous_ff=viscous, inertia_ff=inertia, filters=kept)
    servo = Servo(fed, corner, side.timing)
    return Best(space, space.servo(space.vector(servo), servo), inf)  # within what the drive holds


def slower(servo: Servo, factor: float = LOWERED) -> Servo:
    """Return a controller with lower gains, its loops as far apart as before."""
    loop = servo.loop
    lowered = replace(
        loop,
        position_p=loop.position_p * factor,
        velocity_p=loop.velocity_p * factor,
        velocity_i=loop.velocity_i * factor**2,
    )
    return replace(servo, loop=lowered)
