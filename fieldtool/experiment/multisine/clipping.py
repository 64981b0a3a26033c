"""Whether a measured torque was cut off at a limit of the drive."""

import numpy as np

from fieldtool.records.model import FloatArray

TOP = 0.01
"""Of the largest value: how near to it a sample counts as at the limit; noise is smaller, mostly."""
IN_A_ROW = 3
"""Samples that sit there together, at least."""
PILED_UP = 6.0
"""Times as many samples there as in layers of the same thickness below: the peaks of a signal that is
not cut off come to 3 at most, those of many frequencies to less than one."""
LAYERS = 3
FEWEST = 10
"""Samples at the limit in all, at least."""


def clipped_samples(torque: FloatArray) -> int:
    """Return how many samples of a torque, shape (n,), sit at its largest value; 0 if not cut off.

    Both signs are looked at on their own.  A torque that stays at one value most of the time (an axis
    that stands) is not taken for one that is cut off.
    """
    return _at_the_top(torque) + _at_the_top(-torque)


def _at_the_top(torque: FloatArray) -> int:
    largest = float(torque.max())
    apart = np.diff(np.unique(torque))
    apart = apart[apart > 1e-6 * np.abs(torque).max(initial=0.0)]
    if largest <= 0 or apart.size == 0 or largest < 0.5 * float(np.abs(torque).max()):
        return 0
    thickness = max(TOP * largest, 1.5 * float(apart.min()))
    depth = (largest - torque) / thickness
    top = depth <= 1
    below = np.count_nonzero((depth > 1) & (depth <= 1 + LAYERS)) / LAYERS
    edges = np.flatnonzero(np.diff(np.concatenate([[False], top, [False]])))
    lengths = edges[1::2] - edges[::2]
    count = int(lengths[lengths >= IN_A_ROW].sum())
    usual = np.median(torque) < largest * (1 - (1 + LAYERS) * TOP)
    return count if usual and count >= FEWEST and count > PILED_UP * below else 0
