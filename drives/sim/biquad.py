"""Second-order filters of the torque reference, as servo drives have them.

    notch     (s2 + 2 zn w s + w2) / (s2 + 2 zd w s + w2)
    low-pass                  w2 / (s2 + 2 zd w s + w2)

Both pass a constant unchanged.  They are made discrete by the bilinear transform
s = c (z - 1) / (z + 1) with c = w / tan(w h / 2), which puts the frequency w of the filter exactly
where it was asked for.
"""

from dataclasses import dataclass
from enum import IntEnum
from math import pi, tan


class FilterType(IntEnum):
    """Value of FILTER1_TYPE and FILTER2_TYPE."""

    OFF = 0
    NOTCH = 1
    LOW_PASS = 2


@dataclass(frozen=True)
class Biquad:
    """y = b0 x + b1 x[-1] + b2 x[-2] - a1 y[-1] - a2 y[-2]."""

    b0: float
    b1: float
    b2: float
    a1: float
    a2: float


def biquad(
    kind: FilterType, frequency: float, zero_damping: float, pole_damping: float, rate: float
) -> Biquad:
    """Coefficients of one filter.

    Parameters
    ----------
    kind
        Off passes everything.
    frequency
        Hz, above 0 and below half the rate.
    zero_damping, pole_damping
        Damping ratios zn (notch only, at least 0) and zd (above 0).
    rate
        Hz at which the filter runs.

    Raises
    ------
    ValueError
        If a value is outside these limits.
    """
    if kind == FilterType.OFF:
        return Biquad(1.0, 0.0, 0.0, 0.0, 0.0)
    if not 0.0 < frequency < 0.5 * rate:
        raise ValueError(
            f"filter frequency {frequency} Hz must be above 0 and below {0.5 * rate} Hz, half the "
            "rate of the loop"
        )
    if not (zero_damping >= 0.0 and pole_damping > 0.0):
        raise ValueError(
            f"filter damping ratios are {zero_damping} (zero, at least 0) and {pole_damping} "
            "(pole, above 0)"
        )
    # With t = tan(w h / 2) the transform gives polynomials 1 +- 2 z t + t2 and 2 (t2 - 1).
    t = tan(pi * frequency / rate)
    middle = 2.0 * (t * t - 1.0)
    scale = 1.0 + 2.0 * pole_damping * t + t * t
    a1, a2 = middle / scale, (1.0 - 2.0 * pole_damping * t + t * t) / scale
    if kind == FilterType.LOW_PASS:
        return Biquad(t * t / scale, 2.0 * t * t / scale, t * t / scale, a1, a2)
    return Biquad(
        (1.0 + 2.0 * zero_damping * t + t * t) / scale,
        middle / scale,
        (1.0 - 2.0 * zero_damping * t + t * t) / scale,
        a1,
        a2,
    )
