"""The peers, each with the settings that suit it best.

All get the accelerance -w**2 G, which has no double pole at 0, with its axes made alike in size, and
are told the number of modes.  None of them uses the measured noise.
"""

import contextlib
import io
import pkgutil
import warnings
from functools import wraps

import numpy as np
from peers_data import Case, ComplexArray, FloatArray, vibration_poles
from peers_found import (
    Found,
    Method,
    Modes,
    first_antiresonance,
    least_squares_residues,
    modes_accelerance,
    visible,
    with_machine,
)
from scipy.interpolate import CubicSpline
from scipy.signal import find_peaks

MAX_DAMPING = 0.2
"""Damping ratio above which a pole of a peer is no vibration."""
SPREAD = 100.0
"""Factor on all frequencies for sdypy-EMA, whose choice of stable poles looks 2 Hz around."""


def quiet(method: Method) -> Method:
    """Silence a peer's warnings and progress bars while it works."""

    @wraps(method)
    def silenced(case: Case) -> Found:
        with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
            warnings.simplefilter("ignore")
            with np.errstate(all="ignore"):
                return method(case)

    return silenced


def vector_fitting(more: int = 0, real: int = 0) -> Method:
    """scikit-rf: `more` pairs of poles than there are modes, then those that rise highest."""

    @quiet
    def method(case: Case) -> Found:
        import skrf
        from skrf.vectorFitting import VectorFitting

        frequency = skrf.Frequency.from_f(case.hertz, unit="hz")
        fit = VectorFitting(skrf.Network(frequency=frequency, s=case.balanced, z0=1.0))
        fit.vector_fit(
            n_poles_real=real,
            n_poles_cmplx=case.modes + more,
            fit_constant=True,
            fit_proportional=False,
            enforce_dc=False,
        )
        axes, poles = len(case.masses), np.asarray(fit.poles)
        scale = np.outer(case.size, case.size)
        residues = np.asarray(fit.residues).T.reshape(-1, axes, axes) * scale
        constant = np.asarray(fit.constant_coeff).reshape(axes, axes) * scale
        pairs = poles.imag > 0.0
        ratio = residues / poles[:, None, None]
        at_zero = constant - (np.where(pairs, 2.0, 1.0)[:, None, None] * ratio.real).sum(axis=0)
        receptance = residues[pairs] / poles[pairs, None, None] ** 2
        modes = visible(Modes(poles[pairs], receptance, at_zero), case.modes)
        found = with_machine(case, modes)

        def accelerance(s: ComplexArray) -> ComplexArray:
            total: ComplexArray = constant[0, 0] + np.zeros_like(s)
            for pole, residue in zip(poles, residues[:, 0, 0], strict=True):
                total = total + residue / (s - pole)
                if pole.imag > 0.0:
                    total = total + residue.conj() / (s - pole.conj())
            return total

        return Found(found.poles, found.model, found.why, first_antiresonance(accelerance, case))

    return method


def aaa(more: int = 1) -> Method:
    """Scipy's AAA on the sum of the drive points at both signs of frequency.

    `more` pairs of poles than there are modes, then those that rise highest; residue matrices by
    plain linear least squares.
    """

    @quiet
    def method(case: Case) -> Found:
        from scipy.interpolate import AAA

        s = 1j * case.data.omega
        trace = np.einsum("fii->f", case.balanced)
        rational = AAA(
            np.concatenate([s, s.conj()]),
            np.concatenate([trace, trace.conj()]),
            rtol=0.0,
            max_terms=2 * (case.modes + more) + 1,
        )
        poles = _vibrations(rational.poles(), case)
        modes = visible(least_squares_residues(case, poles), case.modes)
        modes = least_squares_residues(case, modes.poles)
        found = with_machine(case, modes)
        dip = first_antiresonance(rational, case)
        return Found(found.poles, found.model, found.why, dip)

    return method


def _vibrations(poles: ComplexArray, case: Case) -> ComplexArray:
    size = np.abs(poles)
    good = (poles.imag > 0.0) & (poles.real < 0.0) & (-poles.real < MAX_DAMPING * size)
    good &= (size > case.data.omega[0]) & (size < case.data.omega[-1])
    kept: ComplexArray = poles[good]
    return kept[np.argsort(np.abs(kept))]


def ema(method_name: str, order: int, near: float = 0.01, alike: float = 0.1) -> Method:
    """sdypy-EMA: LSCF or RFP, then LSFD with the rigid body as its lower residual.

    LSCF works on all lines of the base grid, those not excited by cubic splines; RFP on the lines
    themselves.  Poles that repeat at the next order (to the shares `near` and `alike` of frequency
    and damping) are stable; those nearest to the true ones are taken, as by an operator's clicks.
    """

    @quiet
    def method(case: Case) -> Found:
        from sdypy import EMA

        hertz, values = case.hertz, case.balanced.reshape(case.hertz.size, -1).T
        if method_name == "lscf":
            step = case.base * np.gcd.reduce(np.round(hertz / case.base).astype(int))
            grid = np.arange(round(hertz[0] / step), round(hertz[-1] / step) + 1) * step
            values = CubicSpline(hertz, values, axis=1)(grid)
            # the package would fill up to the first line itself, at times by one line too many
            below = np.arange(round(hertz[0] / step)) * step
            values = np.hstack([np.zeros((values.shape[0], below.size)), values])
            grid = np.append(below, grid)
        else:
            grid = hertz
        # the package leaves the last line out
        last = 2 * grid[-1] - grid[-2]
        model = EMA.Model(
            np.column_stack([values, values[:, -1]]),
            SPREAD * np.append(grid, last),
            lower=SPREAD * hertz[0],
            upper=SPREAD * last,
            pol_order_high=order,
            frf_form="accelerance",
        )
        model.get_poles(method=method_name, show_progress=False)
        wanted = SPREAD * np.abs(operator_poles(case)) / (2 * np.pi)
        model.select_closest_poles(list(wanted), f_window=0.1 * SPREAD, fn_temp=near, xi_temp=alike)
        chosen = [model.all_poles[a][b] / SPREAD for a, b in model.pole_ind]
        poles = np.unique(np.array(chosen))
        poles = _vibrations(np.where(poles.imag < 0.0, poles.conj(), poles), case)
        modes = _lsfd(case, poles)
        found = with_machine(case, modes)
        return Found(
            found.poles,
            found.model,
            found.why,
            first_antiresonance(modes_accelerance(modes), case),
        )

    return method


def _lsfd(case: Case, poles: ComplexArray) -> Modes:
    """The package's own least squares in the frequency domain, on the measured lines."""
    from sdypy.EMA.EMA import LSFD

    axes, scale = len(case.masses), np.outer(case.size, case.size)
    frf = case.balanced.reshape(case.hertz.size, -1).T
    constants, _, lower, _ = LSFD(
        poles, frf, case.hertz, True, False, 0, case.hertz.size, frf_form="accelerance"
    )
    residues = constants.T.reshape(-1, axes, axes) * scale
    return Modes(poles, residues, lower.real.reshape(axes, axes) * scale)


OPERATOR: dict[str, ComplexArray] = {}
"""Poles that stand for the truth where it is not known, by name of the case."""


def operator_poles(case: Case) -> ComplexArray:
    """Poles that an operator would click at."""
    return vibration_poles(case.truth) if case.truth is not None else OPERATOR[case.name]


@quiet
def peak_picking(case: Case) -> Found:
    """Peaks of the largest singular value of the accelerance and their half-power widths."""
    values = np.linalg.svd(case.balanced, compute_uv=False)
    size = np.asarray(values[:, 0], dtype=np.float64)
    peaks, _ = find_peaks(size)
    poles = [p for k in peaks if (p := _half_power(case.data.omega, size, int(k))) is not None]
    heights = np.array([np.interp(abs(p), case.data.omega, size) for p in poles])
    kept = np.argsort(-heights)[: case.modes]
    chosen = np.array([poles[k] for k in kept], dtype=complex)
    modes = least_squares_residues(case, chosen[np.argsort(np.abs(chosen))])
    found = with_machine(case, modes)
    dip = np.nan
    if len(case.masses) == 1:
        one = np.abs(case.accelerance[:, 0, 0])
        top = int(np.argmax(np.where(case.hertz < 100.0, one, 0.0)))
        low = int(np.argmin(one[: top + 1]))
        dip = _vertex(case.hertz, -np.log(one), low)[0]
    return Found(found.poles, found.model, found.why, dip)


def _vertex(x: FloatArray, y: FloatArray, k: int) -> tuple[float, float]:
    """Top of the parabola through three neighbours."""
    if not 0 < k < x.size - 1:
        return float(x[k]), float(y[k])
    a, b, c = np.polyfit(x[k - 1 : k + 2] - x[k], y[k - 1 : k + 2], 2)
    at = -b / (2 * a)
    return float(x[k] + at), float(c + b * at + a * at**2)


def _half_power(omega: FloatArray, size: FloatArray, k: int) -> complex | None:
    """Pole from one peak, None where the curve does not fall to 1/sqrt(2) of it on either side."""
    at, top = _vertex(omega, np.log(size), k)
    level, sides = np.exp(top) / np.sqrt(2.0), []
    for step in (-1, 1):
        i = k
        while 0 <= i + step < size.size and size[i + step] > level:
            i += step
            if size[i] > size[k]:
                break
        j = i + step
        if 0 <= j < size.size and size[j] <= level:
            share = (size[i] - level) / (size[i] - size[j])
            sides.append(abs(omega[i] + share * (omega[j] - omega[i]) - at))
    if not sides:
        return None
    damping = min(float(np.mean(sides)) / at, MAX_DAMPING)
    return complex(at * (-damping + 1j * np.sqrt(1 - damping**2)))


def missing(package: str) -> bool:
    """Whether a package, or a name in it, is not there."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pkgutil.resolve_name(package)
    except (ImportError, AttributeError):
        return True
    return False
