"""How much a torque hisses while its axis stands: noise of its measurement, told from a swing."""

from collections.abc import Sequence

import numpy as np

WHITE = 1.5
"""Times the variance that first differences have at least where samples do not depend on each other; of
white noise 2, of a sine 4 sin(pi f T)^2: less up to two ninths of the sampling rate."""
PEAKED = 2.0
"""Times the standard deviation that the largest of many samples of noise reaches; a sine 1.4."""


def hiss(samples: Sequence[float]) -> float:
    """Return the standard deviation of white noise; 0 where the samples are something else.

    Parameters
    ----------
    samples
        Of a torque while the axis stands, (n,); some fifty at least.
    """
    values = np.array(samples, dtype=np.float64)
    away = values - np.median(values)
    deviation = float(np.std(away))
    if deviation == 0 or np.var(np.diff(values)) < WHITE * deviation**2:
        return 0.0
    return deviation if np.abs(away).max() > PEAKED * deviation else 0.0
