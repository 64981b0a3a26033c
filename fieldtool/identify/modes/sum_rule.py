"""What every machine's modes obey: a push at rest starts no velocity.

G(s) falls with 1 / s**2, so the 1 / s parts of all modes cancel: sum_r Q_r / (w_r sqrt(1 - zeta_r**2))
is zero, or X where friction acts at the motors (:mod:`fieldtool.identify.modes.model`).  As
further measurements, good to 0.1 %, these relations keep out-of-phase shapes from standing in for
delays.
"""

import numpy as np
from numpy.typing import NDArray

from fieldtool.identify.modes.model import (
    ModalParts,
    ModalValues,
    friction_share,
    friction_share_derivatives,
    take_apart,
)

FloatArray = NDArray[np.float64]
ACCURACY = 1e-3
"""Of the relations, relative to the sum of phi**2 / w."""


def sum_rule(parts: ModalParts, x: FloatArray) -> FloatArray:
    """Residuals of the relations, one per measured pair of axes.

    None where they hold by themselves: chi is 0, or X is not known as friction acts at loads too.
    """
    if not parts.general or parts.load_friction:
        return np.zeros(0)
    v = take_apart(parts, x)
    i, j = parts.upper
    products = v.phi[i] * v.chi[j] + v.chi[i] * v.phi[j]
    total = (products / _damped(v)).sum(axis=1)
    if parts.friction:
        total = total - friction_share(v)[i, j]
    return np.asarray(total / _sizes(parts, v), dtype=np.float64)


def sum_rule_jacobian(parts: ModalParts, x: FloatArray) -> FloatArray:
    """Derivatives of :func:`sum_rule`; the sizes are taken as fixed."""
    if not parts.general or parts.load_friction:
        return np.zeros((0, parts.count))
    v = take_apart(parts, x)
    i, j = parts.upper
    rows = np.zeros((i.size, parts.count))
    at, damped, each = parts.slices, _damped(v), np.arange(parts.modes)
    for k, (a, b) in enumerate(zip(i, j, strict=True)):
        products = (v.phi[a] * v.chi[b] + v.chi[a] * v.phi[b]) / damped
        rows[k, at["omega"]] = -products / v.omega
        rows[k, at["zeta"]] = products * v.zeta / (1.0 - np.minimum(v.zeta**2, 0.9))
        for c, d in ((a, b), (b, a)):
            rows[k, at["phi"].start + c * parts.modes + each] += v.chi[d] / damped
            rows[k, at["chi"].start + c * parts.modes + each] += v.phi[d] / damped
    if parts.friction:
        rows -= friction_share_derivatives(parts, v)[i, j]
    return np.asarray(rows / _sizes(parts, v)[:, None], dtype=np.float64)


def _damped(v: ModalValues) -> FloatArray:
    return np.asarray(v.omega * np.sqrt(np.maximum(1.0 - v.zeta**2, 0.1)), dtype=np.float64)


def _sizes(parts: ModalParts, v: ModalValues) -> FloatArray:
    sizes = np.sqrt((v.phi**2 / v.omega).sum(axis=1))
    i, j = parts.upper
    return np.asarray(ACCURACY * np.maximum(sizes[i] * sizes[j], 1e-300), dtype=np.float64)
