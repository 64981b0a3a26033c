"""Measured responses that all methods get alike, and what is true of them."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from bench_demo import run
from numpy.typing import NDArray

from drives.profile import load_machine
from fieldtool.frf.matrix import column_responses
from fieldtool.frf.multisine.matrix import joint_response
from fieldtool.frf.multisine.single_axis import analyse_multisine
from fieldtool.identify.likelihood.response_data import ResponseMatrix, matrix_of
from fieldtool.records.csv_folder import read_folder
from fieldtool.records.model import MachineModel
from fieldtool.records.recording import Recording, load
from fieldtool.workflow import Options
from fieldtool.workflow.models import truth_model
from tests.conftest import _random_model

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
RIGID = 1e-3
"""Share of the largest pole below which a pole's imaginary part is that of no vibration."""


@dataclass(frozen=True, eq=False)
class Case:
    """One measured response matrix."""

    name: str
    data: ResponseMatrix
    masses: dict[str, int]
    """Chain lengths; every method is told them, and so the number of modes."""
    base: float
    """Hz: every line is a multiple of it."""
    truth: MachineModel | None = None
    recording: Recording | None = None

    @property
    def modes(self) -> int:
        """n."""
        return sum(self.masses.values()) - len(self.masses)

    @property
    def hertz(self) -> FloatArray:
        """Lines, shape (F,)."""
        result: FloatArray = self.data.omega / (2 * np.pi)
        return result

    @cached_property
    def accelerance(self) -> ComplexArray:
        """-w**2 G, shape (F, M, M): without the double pole of the rigid body at 0."""
        result: ComplexArray = -(self.data.omega[:, None, None] ** 2) * self.data.response
        return result

    @cached_property
    def size(self) -> FloatArray:
        """Of the accelerance of each axis, square root, shape (M,)."""
        diagonal = np.abs(np.einsum("fii->fi", self.accelerance))
        result: FloatArray = np.sqrt(np.median(diagonal, axis=0))
        return result

    @cached_property
    def balanced(self) -> ComplexArray:
        """Accelerance with all axes made alike in size, shape (F, M, M)."""
        result: ComplexArray = self.accelerance / np.outer(self.size, self.size)
        return result


def vibration_poles(model: MachineModel) -> ComplexArray:
    """Poles of a machine in the upper half plane without those of the rigid body, rad/s, rising."""
    poles = np.linalg.eigvals(_state_matrix(model))
    upper = poles[poles.imag > RIGID * np.abs(poles).max()]
    sorted_poles: ComplexArray = upper[np.argsort(np.abs(upper))]
    return sorted_poles


def _state_matrix(model: MachineModel) -> FloatArray:
    n = model.mass_matrix.shape[0]
    inverse = np.linalg.inv(model.mass_matrix)
    below = -inverse @ np.hstack([model.stiffness_matrix, model.damping_matrix])
    matrix: FloatArray = np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), below])
    return matrix


def exact_response(model: MachineModel, omega: FloatArray) -> ComplexArray:
    """G from the state equations, shape (F, M, M)."""
    n, first = model.mass_matrix.shape[0], model.first_masses
    inputs = np.vstack([np.zeros((n, len(model.axes))), np.linalg.inv(model.mass_matrix)[:, first]])
    resolvents = 1j * omega[:, None, None] * np.eye(2 * n) - _state_matrix(model)
    states = np.linalg.solve(resolvents, np.broadcast_to(inputs, (omega.size, *inputs.shape)))
    return np.asarray(states[:, first, :], dtype=np.complex128)


def random_cases(
    seed: int, noises: Sequence[float], draws: int, lines: int = 100
) -> list[list[Case]]:
    """Three machines of three axes with each noise: errors e = G dT of torques of size 1.

    The same machines, and the same `draws` noises but for their size, in all lists.  Odd lines of
    one period.
    """
    rng = np.random.default_rng(seed)
    machines = [
        _random_model(rng, tuple(int(n) for n in rng.integers(2, 5, 3)), damped=True)
        for _ in range(3)
    ]
    drawn = rng.standard_normal((2, draws, 3, lines, 3, 3)) / np.sqrt(2.0)
    noise_of = drawn[0] + 1j * drawn[1]
    return [
        [_with_noise(m, each[k], noise) for each in noise_of for k, m in enumerate(machines)]
        for noise in noises
    ]


def _with_noise(model: MachineModel, drawn: ComplexArray, noise: float) -> Case:
    lines, axes = drawn.shape[0], drawn.shape[1]
    size = np.abs(vibration_poles(model))
    low, high = 0.3 * size.min(), 1.5 * size.max()
    base = (high - low) / (2 * lines)
    odd = 2 * np.round(low / (2 * base)) + 1 + 2 * np.arange(lines)
    omega = base * odd
    exact = exact_response(model, omega)
    measured = exact + noise * exact @ drawn
    outer = noise**2 * measured @ measured.conj().transpose(0, 2, 1)
    covariance = np.array([np.kron(each, np.eye(axes)) for each in outer])
    std = np.sqrt(np.einsum("fkk->fk", covariance).real).reshape(measured.shape)
    masses = {axis.name: len(axis.masses) for axis in model.axes}
    name = "machine with chains of " + ", ".join(str(n) for n in masses.values())
    data = ResponseMatrix(model.names, omega, measured, std, covariance)
    return Case(name, data, masses, base / (2 * np.pi), model)


def paper_case(seed: int) -> Case:
    """Return the paper's machine as the fast plan measures it over the virtual CAN."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "session"
        run("paper-3x3", seed, folder, Options(plan="fast", write=False))
        recording = load(folder / "recording.h5")
    truth = truth_model(load_machine("paper-3x3"))
    if truth is None:
        raise SystemExit("the truth of this machine is not known")
    return case_of_recording(recording, truth)


def case_of_recording(recording: Recording, truth: MachineModel) -> Case:
    """Response matrix of all multisines of a recording, those of the pilot included."""
    periods = [e.period for e in recording.experiments if e.kind == "multisine" and e.period]
    data = matrix_of(joint_response(recording).response)
    masses = {axis.name: len(axis.masses) for axis in truth.axes}
    name = f"paper's machine, {len(periods)} experiments of the fast plan"
    return Case(name, data, masses, 1 / max(periods), truth, recording)


def bench_case(folder: Path) -> Case:
    """Return the real two-mass bench: one axis, motor side."""
    recording = read_folder(folder)
    phasors = [analyse_multisine(recording, e).phasors for e in recording.experiments]
    response = next(iter(column_responses(phasors).values()))
    data = ResponseMatrix(
        response.axes,
        2 * np.pi * response.frequencies,
        response.response,
        response.complex_std,
    )
    period = recording.experiments[0].period or 1.0
    return Case("real two-mass bench", data, {response.axes[0]: 2}, 1 / period, None, recording)
