"""What an axis gives up for settling sooner: the path that it follows, and stiffness; sentences.

Also where a stiffer response brings no sooner settling.
"""

from math import inf, isfinite

from drives.units import unit_on
from fieldtool.design.drive_side import UNITS, DriveSide
from fieldtool.design.figures import strays
from fieldtool.design.no_worse import SOFTER, TICK, arrival, softer_than
from fieldtool.design.predict import AxisPrediction
from fieldtool.design.servo import Servo

STIFFEST = "stiff"


def given_up(
    side: DriveSide,
    new: AxisPrediction,
    was: AxisPrediction,
    servos: tuple[Servo, Servo],
    response: str,
) -> list[str]:
    """Return what new parameters do clearly worse than the present ones, a sentence or two each.

    Parameters
    ----------
    side
        The drive.
    new, was
        What the axis will do, and does with its present parameters.
    servos
        New and present controller.
    response
        That was asked for.
    """
    return _path(side, new, was) + _stiffness(side, new, was, servos, response)


def no_sooner(
    side: DriveSide, new: AxisPrediction, softer: AxisPrediction, names: tuple[str, str]
) -> list[str]:
    """Return a sentence where a stiffer response does not arrive sooner than a softer one.

    Parameters
    ----------
    side
        The drive.
    new, softer
        What the axis does with the two.
    names
        Of the two responses.
    """
    times = arrival(new), arrival(softer)
    if not isfinite(times[0]) or times[0] < times[1] - TICK:
        return []
    steps = [inf if one.step is None else one.step.settling_time for one in (new, softer)]
    step = f", after a step {steps[0]:.3g} s, {steps[1]:.3g} s" if isfinite(sum(steps)) else ""
    unit = unit_on(side.kind, "rad/(N m)")
    more = ""
    if softer.margins.sensitivity_peak < new.margins.sensitivity_peak:
        more = f" Where that does not matter, --response {names[1]} keeps more margin."
    return [
        f"{side.axis}: {names[0]} settles no sooner than {names[1]} here: {times[0]:.3g} s from the "
        f"beginning of its typical move, {times[1]:.3g} s with {names[1]}{step}; a torque or force "
        f"moves its motor by up to {new.compliance:.3g} {unit}, {softer.compliance:.3g} {unit}.{more}"
    ]


def _path(side: DriveSide, new: AxisPrediction, was: AxisPrediction) -> list[str]:
    if new.move is None or was.move is None or new.load is None or was.load is None:
        return []
    if not strays(new.move.following_error, was.move.following_error, new.move.band):
        return []
    unit = unit_on(side.kind, "rad")
    return [
        f"{side.axis}: on its typical move the motor is up to {new.move.following_error:.3g} {unit} "
        f"off its reference, {was.move.following_error:.3g} {unit} with the present parameters; the "
        f"last mass {new.load.following_error:.3g} {unit}, {was.load.following_error:.3g} {unit}. "
        "Feed-forward is chosen for an early arrival: where the path counts for more, keep the present "
        "parameters."
    ]


def _stiffness(
    side: DriveSide,
    new: AxisPrediction,
    was: AxisPrediction,
    servos: tuple[Servo, Servo],
    response: str,
) -> list[str]:
    found = []
    if softer_than(new, was):
        unit = unit_on(side.kind, "rad/(N m)")
        found.append(
            f"a torque or force moves its motor by up to {new.compliance:.3g} {unit}, "
            f"{was.compliance:.3g} {unit} with the present parameters"
        )
    integral, before = (servo.loop.position_p * servo.loop.velocity_i for servo in servos)
    if before > SOFTER * integral:
        unit = unit_on(side.kind, UNITS["pid_i"])
        found.append(
            "slow forces push it farther off: position_p times velocity_i, which works against them, is "
            f"{integral:.3g} {unit}, {before:.3g} {unit} with the present parameters"
        )
    if not found:
        return []
    other = (
        ""
        if response == STIFFEST
        else (f" Where that matters, compare --response {STIFFEST}, or keep the present ones.")
    )
    return [f"{side.axis}: gives up stiffness: {'; '.join(found)}.{other}"]
