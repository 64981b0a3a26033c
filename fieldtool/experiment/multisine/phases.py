"""Phases of multisines: orthogonal over the experiments, and with small peaks in each of them.

In experiment e the input of axis i at line k is A_ki exp(j phi_ki) W_ie: the same random phases in
all experiments, turned by a matrix W with W W^H = E I.  So the axes' inputs over the experiments are
orthogonal at every line, whatever the phases, and the phases are free to keep peaks small.

Sources: Dobrowiecki, Schoukens and Guillaume, Optimized excitation signals for MIMO frequency
response function measurements, IEEE Trans. Instrum. Meas. 55 (2006) 2072; Guillaume, Schoukens,
Pintelon and Kollar, Crest-factor minimization using nonlinear Chebyshev approximation methods, IEEE
Trans. Instrum. Meas. 40 (1991) 982 (the norm of order p, p rising, takes the place of the peak).
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.linalg import hadamard

from fieldtool.experiment.multisine.excitation import IntArray
from fieldtool.records.closed_loop import ComplexArray
from fieldtool.records.model import FloatArray

DRAWS = 40
"""Random phases that are tried; the best is improved."""
SQUARINGS = (2, 4, 5)
"""The norms of order p = 2 ** n lead from the root mean square to the peak."""
OVERSAMPLING = 6
"""Samples at least for a wave of the highest line."""
WORK = 2e7
"""Samples computed for each order at most."""
FEWEST_STEPS, MOST_STEPS = 10, 100
REMEMBERED = 10
"""Steps from which the descent takes the curvature."""


def orthogonal_phases(axes: int, experiments: int) -> ComplexArray:
    """Return W of modulus one, shape (axes, experiments), with W W^H = experiments * I.

    A Hadamard matrix (only signs) for 1, 2, 4, 8, ... and 12 experiments, else a Fourier matrix;
    where there are more experiments than axes, its first rows.

    Raises
    ------
    ValueError
        If there are fewer experiments than axes: their inputs can not be told apart.
    """
    if not 1 <= axes <= experiments:
        raise ValueError(
            f"{experiments} experiments can not tell the inputs of {axes} axes apart; make as many "
            "experiments as axes"
        )
    if experiments & (experiments - 1) == 0:
        square = hadamard(experiments).astype(np.complex128)
    elif experiments == 12:
        square = _paley_12()
    else:
        turns = np.outer(np.arange(experiments), np.arange(experiments)) / experiments
        square = np.exp(-2j * np.pi * turns)
    mixing: ComplexArray = square[:axes]
    return mixing


def _paley_12() -> ComplexArray:
    """Return the Hadamard matrix of order 12, from the squares modulo 11 (Paley)."""
    squares = {n * n % 11 for n in range(1, 11)}
    chi = np.array([0, *(1 if n in squares else -1 for n in range(1, 11))])
    size = np.arange(11)
    skew = np.zeros((12, 12))
    skew[0, 1:], skew[1:, 0] = 1, -1
    skew[1:, 1:] = chi[(size[:, None] - size) % 11]
    result: ComplexArray = (skew + np.eye(12)).astype(np.complex128)
    return result


def low_crest(
    lines: IntArray,
    amplitude: FloatArray,
    seed: int,
    weights: ComplexArray | None = None,
    mixing: ComplexArray | None = None,
) -> FloatArray:
    """Return phases, shape (L, M), rad, with which the largest peak of all outputs is small.

    Parameters
    ----------
    lines
        Excited lines, shape (L,).
    amplitude
        Of the M inputs, shape (L, M).
    seed
        Of the random phases that are tried.
    weights
        Outputs that matter, for a unit input: shape (L, M, Q), each as a share of what it may reach
        (a torque over its limit, say).  Without them the outputs are the inputs, each as a share of
        its root mean square, so that all crest factors become small.
    mixing
        W, shape (M, E): peaks count in all E experiments.  Without it in one with all phases as
        they are.

    Notes
    -----
    The peak is that of E Q signals at once; 40 lines of one amplitude come to crest factors of some
    1.6 with one axis, 1.7 with two, 2 with five (3 without the optimisation).
    """
    L, M = amplitude.shape
    W = np.ones((M, 1), dtype=np.complex128) if mixing is None else mixing
    inputs = amplitude[:, :, None] * W  # (L, M, E)
    if weights is None:
        level = np.sqrt(np.sum(amplitude**2, axis=0) / 2)
        per_axis = np.where(level > 0, 1 / np.where(level > 0, level, 1.0), 0.0)
        weights = np.broadcast_to(np.diag(per_axis).astype(np.complex128), (L, M, M))
    peaks = _Peaks(lines, inputs, weights)
    rng = np.random.default_rng(seed)
    draws = rng.uniform(0, 2 * np.pi, (min(DRAWS, peaks.affordable), L, M))
    best = min(draws, key=lambda phases: float(np.abs(peaks.signals(phases)).max()))
    for squarings in SQUARINGS:
        steps = min(max(peaks.affordable, FEWEST_STEPS), MOST_STEPS)
        best = _descended(partial(peaks.norm, squarings=squarings), best.ravel(), steps)
        best = best.reshape(L, M)
    result: FloatArray = np.mod(best, 2 * np.pi)
    return result


def _descended(
    function: Callable[[FloatArray], tuple[float, FloatArray]], x: FloatArray, steps: int
) -> FloatArray:
    """Return a point lower down, by so many steps of the limited-memory BFGS method.

    Nocedal and Wright, Numerical Optimization, algorithm 7.4, without bounds.  On problems as small as
    these the library's spends most of its time on waking threads.
    """
    value, slope = function(x)
    pairs: list[tuple[FloatArray, FloatArray, float]] = []
    for _ in range(steps):
        way = _two_loops(slope, pairs)
        down = float(np.sum(way * slope))
        size = 1.0 if pairs else 1 / float(np.sqrt(np.sum(slope**2)) + 1e-300)
        while size > 1e-8:
            there, slope_there = function(x + size * way)
            if there <= value + 1e-4 * size * down:
                break
            size /= 2
        else:
            break
        bend = float(np.sum((slope_there - slope) * way)) * size
        if bend > 0:
            pairs = [*pairs[1 - REMEMBERED :], (size * way, slope_there - slope, 1 / bend)]
        done = value - there < 1e-5
        x, value, slope = x + size * way, there, slope_there
        if done:
            break
    return x


def _two_loops(slope: FloatArray, pairs: list[tuple[FloatArray, FloatArray, float]]) -> FloatArray:
    """Return the quasi-Newton direction from the last steps and changes of slope."""
    way, shares = -slope, []
    for step, change, inverse in reversed(pairs):
        shares.append(inverse * np.sum(step * way))
        way = way - shares[-1] * change
    if pairs:
        _, change, inverse = pairs[-1]
        way = way / (inverse * np.sum(change**2))
    for step, change, inverse in pairs:
        way = way + (shares.pop() - inverse * np.sum(change * way)) * step
    return way


class _Peaks:
    """Signals y_eq(t) = Re sum_k sum_i R_kiq A_ki W_ie exp(j phi_ki) exp(j w_k t), and their norms."""

    def __init__(
        self,
        lines: IntArray,
        inputs: ComplexArray,
        weights: ComplexArray,
        oversampling: int = OVERSAMPLING,
    ) -> None:
        self._lines, self._inputs, self._weights = lines, inputs, weights
        self._samples = int(next_fast_len(oversampling * int(lines[-1]), real=True))
        self._outputs = inputs.shape[2] * weights.shape[2]
        self.affordable = max(1, int(WORK / (self._samples * self._outputs)))
        """Evaluations that may be spent on one order."""

    def signals(self, phases: FloatArray) -> FloatArray:
        """Return y over one period, shape (E Q, N)."""
        return self._signals(self._inputs * np.exp(1j * phases)[:, :, None])

    def _signals(self, turned: ComplexArray) -> FloatArray:
        spectrum = np.zeros((self._outputs, self._samples // 2 + 1), dtype=np.complex128)
        outputs = np.einsum("kie,kiq->keq", turned, self._weights)
        spectrum[:, self._lines] = outputs.reshape(-1, self._outputs).T * (self._samples / 2)
        values: FloatArray = irfft(spectrum, self._samples, axis=1, overwrite_x=True)
        return values

    def norm(self, flat: FloatArray, squarings: int) -> tuple[float, FloatArray]:
        """Return the logarithm of the norm of order p = 2 ** squarings, and its gradient."""
        L, M, E = self._inputs.shape
        turned = self._inputs * np.exp(1j * flat.reshape(L, M))[:, :, None]
        y = self._signals(turned)
        peak = float(np.abs(y).max())
        y /= peak
        power, square = y.copy(), y * y  # power becomes y ** (p - 1)
        for _ in range(squarings - 1):
            power *= square
            square *= square
        total = float(np.sum(power * y))
        value = np.log(peak) + np.log(total / y.size) / 2**squarings
        power /= total * peak  # the value's slope by y
        back = np.conj(rfft(power, axis=1)[:, self._lines].T)  # sum over t of slope exp(+j w t)
        by_input = np.einsum("kiq,keq->kie", self._weights, back.reshape(L, E, -1))
        gradient: FloatArray = -np.sum(np.imag(turned * by_input), axis=2)
        return float(value), gradient.ravel()


def crest_factors(phasors: ComplexArray, lines: IntArray) -> FloatArray:
    """Return peak over root mean square of signals with these phasors, (L, Q), shape (Q,)."""
    weights = np.eye(phasors.shape[1], dtype=np.complex128)[None] * phasors[:, None, :]
    ones = np.ones((lines.size, phasors.shape[1], 1), dtype=np.complex128)
    y = _Peaks(lines, ones, weights, 4 * OVERSAMPLING).signals(np.zeros(phasors.shape))
    result: FloatArray = np.abs(y).max(axis=1) / np.sqrt(np.mean(y**2, axis=1))
    return result
