"""What one motor shows of a machine: resonances, antiresonances and gains.

The drive point of axis i, acceleration over torque with nothing else pushing, is one rational
function of lam = w**2 (rad2/s2)::

    theta''_i / tau_i  =  A_H * prod(lam - lam0_j) / prod(lam - lam_j)

with resonances lam (the rigid body at zero among them, once) and antiresonances lam0.  Both
alternate.  Its partial fractions, divided by A_H, are the squares of the first eigenvector's
components (paper, equation 13).
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotAChainError

FloatArray = NDArray[np.float64]


def as_hertz(squared: FloatArray) -> FloatArray:
    """Frequencies in Hz of squared angular frequencies in rad2/s2, for messages."""
    hertz: FloatArray = np.sqrt(np.abs(squared)) / (2.0 * np.pi)
    return hertz


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Resonances and antiresonances that motor and encoder of one axis see.

    Raises
    ------
    NotAChainError
        If the two lists do not alternate: then no machine of chains can have them.
    ValueError
        If shapes do not fit or a value is not finite.
    """

    axis: str
    """Name of the axis, for messages."""
    resonances: FloatArray
    """lam, shape (n,), rad2/s2, rising; the first is 0, the rigid body."""
    antiresonances: FloatArray
    """lam0, shape (n - 1,), rad2/s2, rising, none at 0."""
    covariance: FloatArray | None = None
    """Of (resonances[1:], antiresonances), shape (2n - 2, 2n - 2), rad4/s4; None if not known."""
    left_out: tuple[tuple[float, float], ...] = ()
    """Pairs (resonance, antiresonance), rad2/s2, left out because they nearly cancel."""

    def __post_init__(self) -> None:
        lam, lam0 = (np.asarray(x, dtype=float) for x in (self.resonances, self.antiresonances))
        object.__setattr__(self, "resonances", lam)
        object.__setattr__(self, "antiresonances", lam0)
        if lam.ndim != 1 or lam.size == 0 or lam0.shape != (lam.size - 1,):
            raise ValueError(
                f"axis {self.axis}: {lam.size} resonances (the one at 0 included) need one "
                f"antiresonance fewer, got {lam0.size}"
            )
        if not (np.all(np.isfinite(lam)) and np.all(np.isfinite(lam0))):
            raise ValueError(f"axis {self.axis}: resonances and antiresonances must be finite")
        if lam[0] != 0.0:
            raise ValueError(
                f"axis {self.axis}: the first resonance is the rigid body at 0, "
                f"got {as_hertz(lam[:1])[0]:.6g} Hz"
            )
        if self.covariance is not None and self.covariance.shape != (2 * lam0.size,) * 2:
            raise ValueError(
                f"axis {self.axis}: covariance must have shape {(2 * lam0.size,) * 2}, "
                f"got {self.covariance.shape}"
            )
        self._check_alternation()

    @classmethod
    def from_angular(cls, axis: str, resonances: FloatArray, antiresonances: FloatArray) -> Self:
        """From angular frequencies, rad/s, as sweeps give them, in any order.

        Parameters
        ----------
        axis : str
            Name of the axis.
        resonances, antiresonances : array
            rad/s.  Zeros are dropped, and the rigid body is put in once: the extra rigid bodies
            belong to the other axes (paper, section 3.1).
        """
        flexible, anti = (
            np.sort(np.asarray(w, dtype=float)[np.asarray(w) != 0.0]) ** 2
            for w in (resonances, antiresonances)
        )
        return cls(axis, np.append(0.0, flexible), anti)

    @property
    def weights(self) -> FloatArray:
        """Squares of the first eigenvector's components, shape (n,), sum 1 (equation 13).

        Every factor is a ratio of neighbouring differences between 0 and 1, so each weight is
        as accurate as the differences of its frequencies are.
        """
        weights: FloatArray = np.prod(weight_factors(self), axis=1)
        return weights

    def _check_alternation(self) -> None:
        lam, lam0 = self.resonances, self.antiresonances
        if np.all(np.diff(lam) > 0) and np.all(lam[:-1] <= lam0) and np.all(lam0 <= lam[1:]):
            if lam0.size and lam0[0] == 0.0:
                raise NotAChainError(f"axis {self.axis}: an antiresonance at 0 Hz is no machine")
            return
        raise NotAChainError(
            f"axis {self.axis}: resonances {_listed(lam[1:])} Hz and antiresonances "
            f"{_listed(lam0)} Hz must alternate, antiresonance first; {self._first_offence()}. "
            "A mode was missed or invented, or motor and encoder are not on the same body: "
            "measure finer there, or leave out a pair that nearly cancels."
        )

    def _first_offence(self) -> str:
        lam, lam0 = self.resonances, self.antiresonances
        for j in range(lam0.size):
            inside = np.count_nonzero((lam0 >= lam[j]) & (lam0 <= lam[j + 1]))
            if inside != 1 or lam[j + 1] <= lam[j]:
                a, b = as_hertz(lam[j : j + 2])
                return f"between {a:.4g} and {b:.4g} Hz there are {inside} antiresonances, not 1"
        return "they are not in rising order"


def _listed(squared: FloatArray) -> str:
    return "[" + ", ".join(f"{f:.4g}" for f in as_hertz(squared)) + "]"


def weight_factors(spectrum: Spectrum) -> FloatArray:
    """Factors of equation (13), shape (n, n): row i, multiplied up, is the weight of mode i.

    Column j holds (lam0 - lam_i) / (lam_j - lam_i) with the antiresonance next to lam_j on the
    side of lam_i; column i holds 1.
    """
    lam, lam0 = spectrum.resonances, spectrum.antiresonances
    factors = np.ones((lam.size, lam.size))
    for i in range(lam.size):
        other = np.arange(lam.size) != i
        factors[i, other] = (lam0 - lam[i]) / (lam[other] - lam[i])
    return factors


def without_cancelling_pairs(spectrum: Spectrum, relative: float) -> Spectrum:
    """Leave out resonances that have an antiresonance closer than `relative`.

    Such a mode is all but invisible from this motor: in measured data the pair can neither be
    found nor does it matter much (paper's branch 2: 0.03 % apart, weight 0.0014, B11 moves by
    0.2 %).  The result lists what was left out.

    Parameters
    ----------
    spectrum : Spectrum
        What was found.
    relative : float
        Distance of the two frequencies divided by the resonance; 0.001 is 0.1 %.
    """
    lam, lam0 = spectrum.resonances, spectrum.antiresonances
    keep, keep0 = np.ones(lam.size, bool), np.ones(lam0.size, bool)
    for j in range(1, lam.size):
        for k in (j - 1, j):  # the antiresonances below and above resonance j
            if keep[j] and k < lam0.size and keep0[k]:
                distance = abs(np.sqrt(lam0[k] / lam[j]) - 1.0)
                keep[j] = keep0[k] = distance >= relative
    pairs = zip(lam[~keep], lam0[~keep0], strict=True)
    covariance = spectrum.covariance
    if covariance is not None:
        kept = np.concatenate([keep[1:], keep0])
        covariance = covariance[np.ix_(kept, kept)]
    return Spectrum(
        spectrum.axis,
        lam[keep],
        lam0[keep0],
        covariance,
        spectrum.left_out + tuple((float(p), float(z)) for p, z in pairs),
    )
