"""Whether an axis' torque and motion can belong together, by the machine as last accepted.

Before anything is identified the prior model says roughly what a torque does.  An encoder that does
not count lets the loop push harder and harder; a torque scale that is wrong makes everything ten times
too heavy or too light.  Both are told from the small moves of the direction check.
"""

from dataclasses import dataclass

import numpy as np

from drives.api import FloatArray

BLIND_SPEED, BLIND_WAY = 0.5, 0.1
"""Shares of the velocity limit and of the travel: further a torque may not have taken an axis, by the
prior model, whose encoder shows no motion at all."""
BLIND_TORQUE = 0.1
"""Share of the torque limit that it has to have reached: less may be dry friction."""
FAR_OFF = 4.0
"""Factor between measured and prior inertia beyond which one of the two must be wrong."""
SURE = 3.0
"""Standard errors by which it has to be beyond that factor."""
LEAST_SPEED = 0.3
"""Share of a move's peak speed above which friction surely pushes one way."""
MOST_FRICTION = 0.5
"""Share of the torque for inertia that friction and springs may take in a move that is judged: with
more, friction that builds up looks like inertia."""
TAPER = 0.25
"""Share of a move's rows over which what is left of its fit may hang together."""
LONGEST_LAG = 0.3
"""s by which an axis may follow its targets."""


class BlindPush:
    """Adds up what the torque would have done to an axis that shows no motion.

    Friction or a brake may hold the axis; then the torque does nothing.  But if the encoder does not
    count, the axis is on its way, and nobody sees it.  Valid while the axis is told to move.

    Parameters
    ----------
    inertia
        Of the whole axis by the prior model, kg m2 or kg.
    step
        Seconds from row to row.
    speed, way
        How fast (1/s) and how far it may be at most.
    slack
        Motion within which its encoder counts as showing none.
    holding
        Torque that holds the axis at rest: weight, or friction.
    """

    def __init__(
        self, inertia: float, step: float, speed: float, way: float, slack: float, holding: float
    ) -> None:
        self._share, self._step = step / inertia, step
        self._speed, self._way, self._slack = speed, way, slack
        self._bases = np.array([0.0, holding])
        self._seen: float | None = None
        self.moved = False
        """Whether the encoder has shown any motion."""
        self._speeds, self._ways = np.zeros(2), np.zeros(2)

    def take(self, position: FloatArray, torque: FloatArray) -> bool:
        """Take rows of the axis, each of shape (n,); return whether it is pushed blindly too far.

        Weight is told from friction by nothing here: the smaller of what either would mean counts.
        """
        for p, tau in zip(position.tolist(), torque.tolist(), strict=True):
            if self._seen is None or abs(p - self._seen) > self._slack:
                self.moved = self._seen is not None
                self._seen, self._speeds, self._ways = p, np.zeros(2), np.zeros(2)
                continue
            self._speeds = self._speeds + self._share * (tau - self._bases)
            self._ways = self._ways + self._step * self._speeds
        fast, far = np.abs(self._speeds).min(), np.abs(self._ways).min()
        return bool(fast > self._speed or far > self._way)


@dataclass(frozen=True)
class MoveInertia:
    """What inertia a small move shows, kg m2 or kg."""

    value: float
    std: float
    acceleration: float
    """Mean size in the move, 1/s2."""
    friction: float
    """Mean size of the torque that is not inertia's, N m or N."""

    def factor_off(self, prior: float) -> float | None:
        """Return how many times the prior inertia it surely is, if far beyond belief; else None."""
        at_least = max(self.value - SURE * self.std, 0.0)
        at_most = max(self.value + SURE * self.std, 0.0)
        heavy = at_least > FAR_OFF * prior and self._clear(self.value)
        light = at_most < prior / FAR_OFF and self._clear(prior)
        return self.value / prior if heavy or light else None

    def _clear(self, inertia: float) -> bool:
        """Whether such an inertia would make most of the torque."""
        return self.friction < MOST_FRICTION * abs(inertia) * self.acceleration


def inertia_of_move(
    reference: FloatArray, position: FloatArray, torque: FloatArray, step: float
) -> MoveInertia:
    """Fit inertia, viscous and dry friction, a spring and a constant to a smooth move there and back.

    Parameters
    ----------
    reference, position, torque
        Of one axis, each of shape (n,), SI.
    step
        Seconds from row to row.
    """
    lag = _lag(reference, position, step)
    path = np.interp(np.arange(reference.size) - lag, np.arange(reference.size), reference)
    speed = np.gradient(path, step)
    acceleration = np.gradient(speed, step)
    sliding = np.abs(speed) > LEAST_SPEED * np.abs(speed).max()
    columns = np.stack([acceleration, speed, np.sign(speed), path - path[0], np.ones_like(path)])
    matrix, wanted = columns.T[sliding], torque[sliding]
    scale = np.maximum(np.abs(matrix).max(axis=0), 1e-300)
    found, *_ = np.linalg.lstsq(matrix / scale, wanted, rcond=None)
    rest = wanted - (matrix / scale) @ found
    free = np.sqrt(rest.size / max(rest.size - 5, 1))
    weights = np.linalg.pinv(matrix / scale)[0]
    others = (matrix / scale)[:, 1:4] @ found[1:4]
    size = float(np.abs(matrix[:, 0]).mean())
    steps = np.diff(np.unique(torque))
    rounding = float(steps.min()) / 2 / size if steps.size else float("inf")
    fitted = float(free * coefficient_std(weights, rest) / scale[0])
    return MoveInertia(
        float(found[0] / scale[0]),
        float(np.hypot(fitted, rounding)),
        size,
        float(np.abs(others - others.mean()).mean()),
    )


def coefficient_std(weights: FloatArray, rest: FloatArray) -> float:
    """Return the standard error of a weighted sum of rows, from what a fit leaves in them.

    What is left is no white noise where the motor cogs or its load swings: neighbouring rows are off
    together.  Their covariance is that of the rest, tapered over a quarter of the rows (Newey and
    West 1987, A simple, positive semi-definite covariance matrix).

    Parameters
    ----------
    weights, rest
        Each of shape (n,).
    """
    n = rest.size
    products = [
        np.fft.irfft(np.square(np.abs(np.fft.rfft(one, 2 * n))))[:n] for one in (weights, rest)
    ]
    taper = np.clip(1.0 - np.arange(n) / max(TAPER * n, 1.0), 0.0, None)
    sums = taper * products[0] * products[1] / n
    return float(np.sqrt(max(sums[0] + 2.0 * sums[1:].sum(), 0.0)))


def _lag(reference: FloatArray, position: FloatArray, step: float) -> float:
    """Return by how many rows the position follows its reference."""
    rows = np.arange(reference.size)
    lags = np.linspace(0.0, LONGEST_LAG / step, 61)
    moved = position - position[0]
    errors = [
        float(np.square(np.interp(rows - lag, rows, reference - reference[0]) - moved).sum())
        for lag in lags
    ]
    return float(lags[int(np.argmin(errors))])
