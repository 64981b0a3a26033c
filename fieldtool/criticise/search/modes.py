"""Where a further mass on a spring would explain most, sought line by line instead of by simulation.

With its other end held, a mass m on a spring of the frequency w0 and damping ratio z asks for the
force D q of what it hangs on, D = -m w^2 (w0^2 + 2 j z w0 w) / (w0^2 - w^2 + 2 j z w0 w).  At a hidden
mass whose receptance with the motors held is g, D / (1 + g D) reaches the motors instead, and each of
them by as much as it moves that mass (reciprocity).  A peak of a lightly damped mode is narrow, so
hundreds of frequencies have to be tried; a product of matrices for each mass does.
Source: Ewins, Modal Testing, 2nd ed., 2000, section 6.3 (modification of a structure at one point).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal.windows import tukey

from fieldtool.criticise.effects.base import Effect
from fieldtool.criticise.evidence.lines import TAPER, Lines, unflat
from fieldtool.criticise.search.hypothesis import Hypothesis, Simulator
from fieldtool.criticise.simulate.structure import Structure

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
APART = 1.02
"""Ratio of neighbouring frequencies that are tried."""
DAMPINGS = (0.01, 0.05)
MASSES = (1e-4, 1e-3, 1e-2, 1e-1)
"""Of the axis' whole inertia."""
FINER, DAMPINGS_FINER = 9, (0.003, 0.006, 0.012, 0.025, 0.05, 0.1, 0.2)
"""Frequencies between the neighbours of the best, and damping ratios tried there."""
MOST_LINES = 6000
"""In a span, the strongest."""
HELD = 3.0
"""A mass becomes no more than this many times the one that was tried, and no less than its inverse."""


@dataclass(frozen=True, eq=False)
class _Sought:
    """What the lines of all spans say, (L,) end to end, and K directions that explain already."""

    omega: FloatArray
    moved: ComplexArray
    """What the mass hangs on, rad or m."""
    receptance: ComplexArray
    """g."""
    against: ComplexArray
    """Error that a force there would take away, all motors together."""
    power: FloatArray
    """Of such a force in all motors."""
    known: ComplexArray
    """(L, K)."""


def best_mode(
    simulator: Simulator, hypothesis: Hypothesis, side: FloatArray, basis: FloatArray, mode: Effect
) -> Effect:
    """Return a further mass with the start values that explain most of the rows that may be seen.

    Parameters
    ----------
    simulator, hypothesis
    side : ndarray
        Weighted errors of role ``fit``, what other numbers can do taken out; (R,), R the rows at least.
    basis : ndarray
        Orthonormal, what the other numbers can do, (R, K).
    mode : Effect
        An ``extra_mode``: its bounds are kept.
    """
    mass, frequency, _ = mode.parameters
    sought = _lines(simulator, hypothesis, side, basis, mode)
    count = max(2, int(np.log(frequency.high / frequency.low) / np.log(APART)))
    frequencies = np.geomspace(2.0 * frequency.low, frequency.high / 1.1, count)
    at_motor = mode.location == "motor"
    masses = mass.high * np.array(MASSES[:1] if at_motor else MASSES)
    best = _tried(sought, masses, frequencies, np.array(DAMPINGS))
    near = best[1] * np.geomspace(1.0 / APART, APART, FINER)
    masses = best[0] * np.array([1.0] if at_motor else [0.3, 0.6, 1.0, 1.8])
    m, f, z = _tried(sought, masses, near, np.array(DAMPINGS_FINER))
    return started(mode, m, f, z)


def started(mode: Effect, m: float, f: float, z: float) -> Effect:
    """Return a further mass with start values within its bounds: mass, frequency, Hz, damping ratio."""
    mass, frequency, damping = mode.parameters
    m, f, z = mass.clipped(m), frequency.clipped(f), damping.clipped(z)
    return replace(
        mode,
        parameters=(
            replace(mass, start=0.0, scale=m),
            replace(frequency, start=f, scale=max(z, DAMPINGS[0]) * f),
            replace(damping, start=z, scale=0.5 * z),
        ),
    )


def _tried(
    sought: _Sought, masses: FloatArray, frequencies: FloatArray, dampings: FloatArray
) -> tuple[float, float, float]:
    """Return mass, frequency and damping ratio that explain most."""
    best, most = (float(masses[0]), float(frequencies[0]), float(dampings[0])), 0.0
    w = sought.omega
    for z in dampings:
        own = 2.0 * np.pi * frequencies[:, None]
        stiff = own**2 + 2j * z * own * w
        for m in masses:
            d = -m * w**2 * stiff / (stiff - w**2)
            force = sought.moved * d / (1.0 + sought.receptance * d)
            wanted = np.real(np.conj(force) @ sought.against)
            power = np.abs(force) ** 2 @ sought.power
            known = np.sum(np.real(force @ sought.known) ** 2, axis=1)
            left = np.maximum(power - known, 1e-9 * power) + np.finfo(float).tiny
            gain = np.where(wanted > 0.0, wanted**2 / left, 0.0)
            k = int(np.argmax(gain))
            if gain[k] > most:
                most = float(gain[k])
                share = float(np.clip(wanted[k] / left[k], 1.0 / HELD, HELD))
                at_motor = not np.any(sought.receptance)
                size = float(wanted[k] / left[k]) if at_motor else share
                best = (float(m * size), float(frequencies[k]), float(z))
    return best


def _lines(
    simulator: Simulator, hypothesis: Hypothesis, side: FloatArray, basis: FloatArray, mode: Effect
) -> _Sought:
    structure = hypothesis.structure
    ends = structure.motors if mode.location == "motor" else structure.ends
    dof = int(ends[mode.axis])
    parts, row = [], 0
    for lines in simulator.lines:
        if lines.span.role != "fit":
            continue
        rows = slice(row, row + 2 * lines.weight.size)
        row = rows.stop
        parts.append(_of_span(lines, structure, dof, side[rows], basis[rows]))
    width = max(p.known.shape[1] for p in parts)
    known = [np.pad(p.known, [(0, 0), (0, width - p.known.shape[1])]) for p in parts]
    return _Sought(
        np.concatenate([p.omega for p in parts]),
        np.concatenate([p.moved for p in parts]),
        np.concatenate([p.receptance for p in parts]),
        np.concatenate([p.against for p in parts]),
        np.concatenate([p.power for p in parts]),
        np.concatenate(known),
    )


def _of_span(
    lines: Lines, structure: Structure, dof: int, side: FloatArray, basis: FloatArray
) -> _Sought:
    span, motion, M = lines.span, lines.motion, lines.weight.shape[1]
    n = span.stop - span.start
    taper = np.ones(n) if span.periods else tukey(n, TAPER)
    whole = replace(lines, window=np.broadcast_to(taper[:, None], (n, M)))
    accelerated = whole.raw(motion.acceleration)
    strength = np.sum(np.abs(accelerated * lines.weight) ** 2, axis=1)
    if span.periods:
        strength[np.arange(strength.size) % span.periods != 0] = 0.0
    strength[0] = 0.0
    chosen = np.sort(np.argsort(-strength)[:MOST_LINES])
    chosen = chosen[strength[chosen] > 0.0]
    omega = 2.0 * np.pi * chosen / (n * motion.step)
    moves, receptance = _reached(structure, dof, omega)
    moved = np.sum(moves * -accelerated[chosen] / omega[:, None] ** 2, axis=1)
    lever = lines.weight[chosen] * moves

    def seen(values: FloatArray) -> ComplexArray:
        return np.asarray(unflat(values, M)[chosen])

    columns = [basis[:, k] for k in range(basis.shape[1])]
    columns += [lines.free[:, k] for k in range(lines.free.shape[1])]
    known = np.zeros((chosen.size, len(columns)), dtype=complex)
    for k, column in enumerate(columns):
        known[:, k] = np.sum(lever * np.conj(seen(column)), axis=1)
    return _Sought(
        omega,
        moved,
        receptance,
        np.asarray(np.sum(np.conj(lever) * seen(side), axis=1)),
        np.asarray(np.sum(np.abs(lever) ** 2, axis=1)),
        known,
    )


def _reached(
    structure: Structure, dof: int, omega: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return how far each motor moves a mass, (L, M), and its receptance while they are held, (L,)."""
    motors, hidden = structure.motors, structure.hidden
    if dof in motors:
        own = (motors == dof).astype(complex)
        return np.broadcast_to(own, (omega.size, motors.size)), np.zeros(omega.size, dtype=complex)
    w = omega[:, None, None]
    whole = structure.stiffness + 1j * w * structure.damping - w**2 * structure.mass
    inner = whole[:, hidden[:, None], hidden] + 1e-6j * np.abs(structure.stiffness).max()
    place = int(np.flatnonzero(hidden == dof)[0])
    unit = np.zeros((omega.size, hidden.size, 1), dtype=complex)
    unit[:, place] = 1.0
    answer = np.linalg.solve(inner, unit)[:, :, 0]
    moves = -np.einsum("lh,lhm->lm", answer, whole[:, hidden[:, None], motors])
    return moves, answer[:, place]
