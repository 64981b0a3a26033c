"""What a method found, and how poles and residues become masses and springs by our own reduction."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from peers_data import Case, ComplexArray

from fieldtool.errors import IdentificationError
from fieldtool.identify.chains.block_reduction import reduce_blocks
from fieldtool.identify.modes.fit import rank_one
from fieldtool.identify.modes.model import ModalModel, ModalParts
from fieldtool.records.model import MachineModel

EXACT = 1e-6
"""Relative standard error given to peers' modes, which come without any: small enough to count as
exact, and it changes no value."""


@dataclass(frozen=True, eq=False)
class Found:
    """Result of one method."""

    poles: ComplexArray
    """In the upper half plane, rad/s, rising."""
    model: MachineModel | None = None
    why: str = ""
    """Why there is no model, or what else is to be said."""
    antiresonance: float = float("nan")
    """Hz, of a single axis."""


Method = Callable[[Case], Found]


@dataclass(frozen=True, eq=False)
class Modes:
    """Poles and residues of the receptance: G = R0 / s**2 + sum of residue / (s - pole) and conj."""

    poles: ComplexArray
    """Shape (n,), upper half plane."""
    residues: ComplexArray
    """Shape (n, M, M)."""
    rigid: NDArray[np.float64]
    """R0, shape (M, M)."""


def visible(modes: Modes, count: int) -> Modes:
    """Keep the `count` stable modes whose peaks in the accelerance are highest, by frequency."""
    size = np.linalg.norm(modes.residues, axis=(1, 2)) * np.abs(modes.poles) ** 2
    height = np.where(modes.poles.real < 0.0, size / np.maximum(-modes.poles.real, 1e-300), 0.0)
    kept = np.argsort(-height)[:count]
    kept = kept[height[kept] > 0.0]
    kept = kept[np.argsort(np.abs(modes.poles[kept]))]
    return Modes(modes.poles[kept], modes.residues[kept], modes.rigid)


def with_machine(case: Case, modes: Modes) -> Found:
    """Masses, springs and couplings by our block order reduction of a peer's poles and residues."""
    if modes.poles.size != case.modes:
        return Found(modes.poles, None, f"{modes.poles.size} of {case.modes} modes")
    try:
        model = reduce_blocks(_modal(case, modes), case.masses).model
    except IdentificationError as error:
        return Found(modes.poles, None, f"no machine of chains: {str(error).split(';')[0]}")
    return Found(modes.poles, model)


def _modal(case: Case, modes: Modes) -> ModalModel:
    axes, n = len(case.masses), modes.poles.size
    pairs = np.ones((axes, axes), dtype=np.bool_)
    parts = ModalParts(n, pairs, general=False, friction=False, delay=False)
    in_phase = -2.0 * modes.poles.imag[:, None, None] * modes.residues.imag
    phi = np.array([rank_one((p + p.T) / 2.0, pairs) for p in in_phase]).T.reshape(axes, n)
    omega, rigid = np.abs(modes.poles), (modes.rigid + modes.rigid.T) / 2.0
    numbers = np.concatenate([omega, omega, phi.ravel(), rigid[parts.upper]])
    return ModalModel(
        names=case.data.names,
        parts=parts,
        omega=omega,
        zeta=-modes.poles.real / omega,
        phi=phi,
        chi=np.zeros_like(phi),
        rigid=rigid,
        friction=np.zeros(axes),
        delays=np.zeros(axes),
        covariance=np.diag((EXACT * np.abs(numbers)) ** 2),
        chi2=1.0,
        degrees_of_freedom=1,
    )


def least_squares_residues(case: Case, poles: ComplexArray) -> Modes:
    """Residues and rigid body for given poles by plain linear least squares on the accelerance."""
    s = 1j * case.data.omega[:, None]
    plus, minus = 1.0 / (s - poles), 1.0 / (s - poles.conj())
    basis = np.hstack([s**2 * (plus + minus), 1j * s**2 * (plus - minus), np.ones_like(s)])
    axes, n = len(case.masses), poles.size
    side = case.accelerance.reshape(s.size, -1)
    solved = np.linalg.lstsq(
        np.vstack([basis.real, basis.imag]), np.vstack([side.real, side.imag]), rcond=None
    )[0].reshape(2 * n + 1, axes, axes)
    return Modes(poles, solved[:n] + 1j * solved[n : 2 * n], solved[-1])


def first_antiresonance(response: Callable[[ComplexArray], ComplexArray], case: Case) -> float:
    """Hz where a model of a single axis' accelerance is smallest below its resonance, nan for more."""
    if len(case.masses) > 1:
        return float("nan")
    hertz = np.linspace(case.hertz[0], 100.0, 20001)
    size = np.abs(response(2j * np.pi * hertz))
    peak = hertz[int(np.argmax(size))]
    below = (hertz > 0.5 * peak) & (hertz <= peak)
    return float(hertz[below][int(np.argmin(size[below]))])


def modes_accelerance(modes: Modes) -> Callable[[ComplexArray], ComplexArray]:
    """Accelerance of the first axis as a function of s."""

    def value(s: ComplexArray) -> ComplexArray:
        total: ComplexArray = modes.rigid[0, 0] + np.zeros_like(s)
        for pole, residue in zip(modes.poles, modes.residues[:, 0, 0], strict=True):
            total = total + s**2 * (residue / (s - pole) + residue.conj() / (s - pole.conj()))
        return total

    return value
