"""Resonances and antiresonances of coupled chains to 35 digits, and random machines to try.

Eigenvalues in double precision are off by rounding of the largest, too much to judge an inverse
problem by.  Here each one is enclosed by counting the negative pivots of K - s M in decimal
arithmetic and halving the interval; the result is rounded once, to double.
"""

from decimal import Decimal, getcontext

import numpy as np

from fieldtool.identify.chains.forward import spectra
from fieldtool.identify.chains.spectrum import Spectrum
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel

DIGITS = 60
HALVINGS = 140


def random_machine(rng, axes, lengths):
    """Masses and springs log-uniform within a factor of 10; couplings of both signs."""
    chains = []
    for i in range(axes):
        masses = 0.7 * 10.0 ** rng.uniform(0.0, 1.0, lengths[i])
        springs = 1000.0 * 10.0 ** rng.uniform(0.0, 1.0, lengths[i] - 1)
        chains.append(
            AxisModel(
                f"axis{i + 1}",
                "rotary",
                tuple(Estimate(float(m)) for m in masses),
                tuple(Estimate(float(k)) for k in springs),
            )
        )
    couplings = []
    for i in range(axes):
        for j in range(i + 1, axes):
            share = rng.uniform(0.2, 0.9) / (axes - 1) * rng.choice([-1.0, 1.0])
            ends = chains[i].masses[-1].value * chains[j].masses[-1].value
            couplings.append(
                Coupling((chains[i].name, chains[j].name), float(share * np.sqrt(ends)))
            )
    return MachineModel(tuple(chains), tuple(couplings))


def exact_spectra(model):
    """Spectrum of each axis with every frequency correct to the last bit of a double.

    Valid where all axes are coupled and no two resonances are equal.
    """
    getcontext().prec = DIGITS
    lam = _enclose_all(model, None, spectra(model)[0].resonances[1:])
    result = []
    for i, start in enumerate(spectra(model)):
        lam0 = _enclose_all(model, i, start.antiresonances)
        result.append(Spectrum(model.axes[i].name, np.append(0.0, lam), lam0))
    return tuple(result)


def _enclose_all(model, locked, starts):
    rigid = len(model.axes) - (locked is not None)
    return np.array([_enclose(model, locked, rigid + k, s) for k, s in enumerate(starts)])


def _enclose(model, locked, index, start):
    """The eigenvalue that has `index` others below it."""
    below, above = Decimal(start), Decimal(start)
    step = Decimal(start) * Decimal(10) ** -13
    while _count_below(model, locked, below) > index:
        below, step = below - step, step * 8
    while _count_below(model, locked, above) <= index:
        above, step = above + step, step * 8
    for _ in range(HALVINGS):
        middle = (below + above) / 2
        if _count_below(model, locked, middle) > index:
            above = middle
        else:
            below = middle
    return float((below + above) / 2)


def _count_below(model, locked, s):
    """Eigenvalues of K x = lam M x below s: negative pivots of K - s M, chain by chain."""
    count, ends = 0, []
    for i, axis in enumerate(model.axes):
        masses = [Decimal(m.value) for m in axis.masses]
        springs = [Decimal(k.value) for k in axis.springs]
        pivot = None if i == locked else -s * masses[0]
        if len(masses) > 1 and pivot is not None:
            pivot += springs[0]
        for k in range(1, len(masses)):
            entry = springs[k - 1] - s * masses[k] + (springs[k] if k < len(springs) else 0)
            if pivot is not None:
                count += pivot < 0
                entry -= springs[k - 1] ** 2 / pivot
            pivot = entry
        ends.append(pivot)
    return count + _negative_pivots(_end_matrix(model, ends, s))


def _end_matrix(model, ends, s):
    """Last masses after all others are eliminated; an end that is itself locked is left out."""
    free = [i for i, end in enumerate(ends) if end is not None]
    matrix = [[ends[i] if i == j else Decimal(0) for j in free] for i in free]
    for coupling in model.couplings:
        i, j = (model.names.index(name) for name in coupling.axes)
        if i in free and j in free:
            a, b = free.index(i), free.index(j)
            matrix[a][b] = matrix[b][a] = -s * Decimal(coupling.value)
    return matrix


def _negative_pivots(matrix):
    count = 0
    for k in range(len(matrix)):
        pivot = matrix[k][k]
        count += pivot < 0
        for i in range(k + 1, len(matrix)):
            factor = matrix[i][k] / pivot
            for j in range(k + 1, len(matrix)):
                matrix[i][j] -= factor * matrix[k][j]
    return count
