"""The only place with conversion factors: quantities of profiles, and drive units to SI and back.

Inside everything is SI: rad, rad/s, N m on rotary axes; m, m/s, N on linear ones.
"""

import re
from dataclasses import dataclass
from math import isfinite, pi
from typing import Literal

Kind = Literal["rotary", "linear"]

UNITS: dict[str, dict[str, float]] = {
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": pi / 180, "rev": 2 * pi},
    "length": {"m": 1.0, "mm": 1e-3, "um": 1e-6},
    "angular velocity": {
        "rad/s": 1.0,
        "deg/s": pi / 180,
        "rpm": 2 * pi / 60,
        "rev/s": 2 * pi,
    },
    "velocity": {"m/s": 1.0, "mm/s": 1e-3, "m/min": 1 / 60},
    "angular acceleration": {"rad/s2": 1.0, "deg/s2": pi / 180, "rev/s2": 2 * pi},
    "acceleration": {"m/s2": 1.0, "mm/s2": 1e-3},
    "torque": {"N m": 1.0, "mN m": 1e-3, "kN m": 1e3},
    "force": {"N": 1.0, "kN": 1e3},
    "inertia": {"kg m2": 1.0, "kg cm2": 1e-4, "g cm2": 1e-7},
    "mass": {"kg": 1.0, "g": 1e-3},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
    "frequency": {"Hz": 1.0, "kHz": 1e3},
}
"""Dimension: unit and its value in SI."""

_NUMBER = r"\s*([-+]?(?:\d++\.?+\d*+|\.\d++)(?:[eE][-+]?\d++)?+)\s*+"
_QUANTITY = re.compile(_NUMBER + r"(\S.*?)\s*")
"""Number and unit; possessive, so that no digit of a bare number is taken for its unit."""


def parse_quantity(text: object, *dimensions: str) -> float:
    """Return the SI value of a text such as ``"90 deg/s"``.

    Parameters
    ----------
    text
        Number and unit.  A bare number is refused: a limit whose unit is guessed is no limit.
    dimensions
        Keys of ``UNITS`` that are allowed.

    Raises
    ------
    ValueError
        If there is no number, no unit, a unit of another dimension, or a number too large.
    """
    known = {unit: factor for d in dimensions for unit, factor in UNITS[d].items()}
    wanted = f"a number with one of the units {', '.join(known)}"
    power = isinstance(text, str) and "e" in text.lower() and re.fullmatch(_NUMBER, text)
    if power or (isinstance(text, int | float) and not isinstance(text, bool)):
        first, *others = known
        more = f" (or {', '.join(others)})" if others else ""
        raise ValueError(f"{text} has no unit: write it with one, as {text} {first}{more}")
    if not isinstance(text, str):
        raise ValueError(f"needs {wanted}, got {text!r}")  # noqa: TRY004
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise ValueError(f"needs {wanted}, got {text!r}")
    number, unit = match.groups()
    unit = unit.replace("·", " ").replace("*", " ").replace("N.m", "N m").replace("²", "2")
    unit = {"°": "deg", "Nm": "N m", "mNm": "mN m", "kNm": "kN m", "kgm2": "kg m2"}.get(unit, unit)
    if unit not in known and unit.startswith(","):
        point = f"{number}.{unit[1:]}"
        raise ValueError(f"write the number with a point: {point}, not {text}")
    if unit not in known:
        raise ValueError(f"unit {unit!r} does not fit: needs {wanted}")
    value = float(number) * known[unit]
    if not isfinite(value):
        raise ValueError(f"{text!r} is too large for a number; needs {wanted}")
    return value


@dataclass(frozen=True)
class AxisScaling:
    """What one drive's units are worth: SI value = drive value times factor."""

    position: float
    """rad or m per position unit of 0x6064, 0x607A."""
    velocity: float
    """rad/s or m/s per velocity unit of 0x606C; NaN where nobody knows."""
    torque: float
    """N m or N per unit of 0x6071, 0x6077 (one per mille of the rated torque)."""

    def __post_init__(self) -> None:
        if not (self.position > 0 and self.torque > 0) or self.velocity <= 0:
            raise ValueError(f"scale factors must be positive, got {self}")

    def position_units(self, value: float) -> int:
        """Position in drive units, nearest."""
        return round(value / self.position)

    def torque_units(self, value: float) -> int:
        """Torque in drive units, nearest."""
        return round(value / self.torque)


def position_factor(kind: Kind, counts: int, revolutions: int, feed: float | None) -> float:
    """Return rad (or m) of the axis per position unit.

    Parameters
    ----------
    kind
        Of the axis.
    counts, revolutions
        0x608F: encoder increments in so many motor revolutions.
    feed
        Metres per encoder revolution of a linear motor's scale; needed on linear axes only.

    Raises
    ------
    ValueError
        If a number is zero, or the feed of a linear axis is not known.
    """
    if min(counts, revolutions) <= 0:
        raise ValueError(f"0x608F = {counts}/{revolutions} must be positive")
    if kind == "rotary":
        return 2 * pi * revolutions / counts
    if feed is None or feed <= 0:
        raise ValueError("a linear axis needs `feed` in the machine profile, metres a revolution")
    return feed * revolutions / counts


_PREFIXES = range(-6, 7)
_NUMERATORS = {0xB4: "rev", 0xB5: "inc", 0x10: "rad", 0x41: "deg"}
_DENOMINATORS = {0x03: 1.0, 0x47: 60.0}
"""Seconds; codes of SI units in object 0x60A9 (CiA 303-2): second and minute."""


def velocity_factor(unit: str, position: float, counts: float, coded: int | None = None) -> float:
    """Return rad/s (or m/s) per velocity unit of 0x606C and 0x60FF.

    Parameters
    ----------
    unit
        As drive profiles have it.
    position
        Rad (or m) per position unit.
    counts
        Position units per motor revolution.
    coded
        Value of 0x60A9: prefix in bits 31 to 24, numerator 23 to 16, denominator 15 to 8; needed for
        the unit ``0x60A9`` alone.

    Raises
    ------
    ValueError
        If the code is missing or means no velocity that is known here.
    """
    rpm = position * counts / 60
    match unit:
        case "position units/s":
            return position
        case "rpm":
            return rpm
        case "0.001 rpm":
            return rpm / 1000
        case "counts * 512 / 1875":
            return rpm * 1875 / (512 * counts)
        case "0x60A9" if coded is not None:
            return _decoded_velocity(coded, position, counts)
    raise ValueError(f"velocity unit {unit} can not be told")


def _decoded_velocity(coded: int, position: float, counts: float) -> float:
    prefix = (coded >> 24 & 0xFF) - (0x100 if coded >> 31 & 1 else 0)
    numerator = _NUMERATORS.get(coded >> 16 & 0xFF)
    seconds = _DENOMINATORS.get(coded >> 8 & 0xFF)
    if numerator is None or seconds is None or prefix not in _PREFIXES:
        raise ValueError(f"0x60A9 = 0x{coded:08X} is no velocity unit that is known here")
    turn = position * counts
    worth = {"rev": turn, "inc": position, "rad": turn / (2 * pi), "deg": turn / 360}[numerator]
    return float(worth * 10.0**prefix / seconds)


_ON_LINEAR_AXES = {
    "N m s/rad": "N s/m",
    "N m/rad": "N/m",
    "N m/(rad s)": "N/(m s)",
    "N m": "N",
    "kg m2": "kg",
    "rad": "m",
    "rad/s": "m/s",
    "rad/s2": "m/s2",
    "rad/s3": "m/s3",
    "N m/A": "N/A",
    "rad/(N m)": "m/N",
}


def unit_on(kind: Kind, rotary_unit: str) -> str:
    """Return how a unit that profiles give for rotary axes is written on an axis of this kind."""
    return rotary_unit if kind == "rotary" else _ON_LINEAR_AXES.get(rotary_unit, rotary_unit)
