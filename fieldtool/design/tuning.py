"""A design's result: parameters of all axes, and what they will do."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import sqrt
from pathlib import Path

import numpy as np

from drives.units import Kind
from fieldtool.design.drive_side import FILTERS, GAINS, DriveSide
from fieldtool.design.moves import TestMove
from fieldtool.design.predict import Prediction
from fieldtool.design.servo import OFF, Servo
from fieldtool.design.shaping import Shaping
from fieldtool.records.closed_loop import Biquad

RESPONSES: Mapping[str, float] = {"soft": 0.4, "normal": 0.7, "stiff": 1.0}
"""A technician's choices: how much of the room between 1 and the bound the peak of sensitivity uses."""
SOFTEST = min(RESPONSES, key=RESPONSES.__getitem__)
"""The response that is asked for because the machine is too lively as it is."""
BOUND = 2.0
"""Peak of sensitivity that no axis may exceed: 6 dB."""
MOST_BOUND = 3.0
"""That anybody may ask for; what goes beyond ``BOUND`` may be tried, and is never stored."""


def why_not_stored(bound: float, *, identified: bool) -> str:
    """Return why parameters are not stored even if they stand their trial; empty if they may be.

    Parameters
    ----------
    bound
        Of the peak of sensitivity, that they were designed for and are judged by.
    identified
        Whether the prediction rests on an identified model.
    """
    if not bound <= BOUND * (1 + 1e-9):
        return (
            f"their bound of the peak of sensitivity is {bound:.3g}, above {BOUND:g}: with so little "
            "margin they may be tried, and are never stored"
        )
    if not identified:
        return (
            "the session has no identified model (model.yaml), so their trial can not be compared with "
            "a prediction: measure, or `fieldtool identify`, first"
        )
    return ""


@dataclass(frozen=True)
class AxisTuning:
    """New parameters of one axis, by the names of drive profiles, physical units."""

    axis: str
    parameters: Mapping[str, float]
    sensitivity_peak: float
    """Of this axis' loop with all others closed, by the model."""
    reason: str
    """One sentence: how the numbers came about."""
    kind: Kind = "rotary"
    """Of the axis, on which units depend."""


@dataclass(frozen=True)
class TradePoint:
    """All axes' gains scaled together: what is gained and lost."""

    factor: float
    """Of velocity_p and position_p; velocity_i goes with its square."""
    bandwidth: tuple[float, ...]
    """Hz, an axis each."""
    sensitivity_peak: tuple[float, ...]
    """An axis each; infinite where the machine is not stable."""


@dataclass(frozen=True)
class Choice:
    """One of the three responses, as far as it was computed: what a technician chooses from."""

    response: str
    bound: float
    """Peak of sensitivity that it asks for."""
    prediction: Prediction | None = None
    """What its parameters do; None where there are none."""
    kept: tuple[str, ...] = ()
    """Axes whose present parameters it keeps."""
    instead: str = ""
    """Softer response whose parameters these are, for nothing better keeps the margin; empty: none."""
    refused: str = ""
    """Why it can not be had; empty where it can, or was not computed."""


@dataclass(frozen=True)
class Tuning:
    """New parameters of all axes."""

    axes: tuple[AxisTuning, ...]
    response: str = ""
    """A name of RESPONSES; empty where nobody chose."""
    bound: float = BOUND
    """Peak of sensitivity that was allowed."""
    moves: tuple[TestMove, ...] = ()
    """One an axis: what the prediction is of."""
    prediction: Prediction | None = None
    present: Prediction | None = None
    """Of the drives' parameters as they were; None where they could not be read."""
    trade: tuple[TradePoint, ...] = ()
    shaping: tuple[Shaping, ...] = ()
    """Advice for whatever makes the references; empty where no vibration is left."""
    notes: tuple[str, ...] = field(default=())
    """What a technician has to know, a sentence each."""
    responses: tuple[Choice, ...] = ()
    """From soft to stiff, the chosen one among them; empty where nobody chose."""
    by_hand: tuple[str, ...] = ()
    """Axes whose gains can not all be written: a person enters them, and a write is refused."""

    def write_words(self, folder: Path) -> str:
        """Say what brings the parameters in a session folder into the drives."""
        command = f"`fieldtool write {folder}`"
        if not self.by_hand:
            return f"{command} brings them into the drives."
        return (
            f"{command} is refused, for gains of {', '.join(self.by_hand)} can not be written: enter "
            "the new parameters of all axes with the makers' software."
        )


def as_parameters(servo: Servo, side: DriveSide | None = None) -> dict[str, float]:
    """Return a controller as parameters by name, of those that a drive has; filters not used are off.

    The cascade's gains are always there: where the drive can not be told, a person enters them.

    Parameters
    ----------
    servo
        The controller; its filters go to the drive's filters in order.
    side
        The drive; None: one that has everything.
    """
    side = side or DriveSide("")
    loop = servo.loop
    parameters = {
        "position_p": loop.position_p,
        "velocity_p": loop.velocity_p,
        "velocity_i": loop.velocity_i,
        "velocity_ff": loop.velocity_ff,
        "viscous_ff": loop.viscous_ff,
        "inertia_ff": loop.inertia_ff,
    }
    if servo.velocity_filter != OFF:
        parameters["velocity_filter"] = servo.velocity_filter
    parameters |= _filters(loop.filters, side.filters or FILTERS)
    return {n: value for n, value in parameters.items() if n in GAINS or side.has(n)}


def _filters(biquads: Sequence[Biquad], places: Sequence[int]) -> dict[str, float]:
    parameters = {f"filter{k}_type": 0.0 for k in places}
    for k, biquad in zip(places, biquads, strict=False):
        (n2, n1, n0), (d1, d0) = biquad.numerator, biquad.denominator
        w = sqrt(d0)
        parameters[f"filter{k}_type"] = 1.0 if n2 else 2.0
        parameters[f"filter{k}_frequency"] = w / (2 * np.pi)
        if n2:
            parameters[f"filter{k}_zero_damping"] = n1 / (2 * sqrt(n0 / n2) * n2)
        parameters[f"filter{k}_pole_damping"] = d1 / (2 * w)
    return parameters
