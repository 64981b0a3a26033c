"""How often the number of masses of every axis is found, and what is said where it is not.

Random machines with couplings, light dampers and some friction; responses on an odd grid with the
noise of a measured torque.  A machine counts as seen when every mode's largest component stands
ten standard errors out of the noise, by the information that its true modes have in the data.
Two axes alone, coupled at their ends, are the same to both motors however the springs are split
(:mod:`fieldtool.identify.chains.order`): they have a row of their own.

Run: python tests/benchmarks/bench_order.py [machines] [seed]
"""

import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # small matrices: threads only wait for each other

import numpy as np
from scipy.linalg import eigh

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from fieldtool.errors import IdentificationError
from fieldtool.identify.chains.modal_chain import SEEN
from fieldtool.identify.chains.order import select_order
from fieldtool.identify.likelihood.refine import machine_response
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes.model import ModalParts, modal_derivatives
from tests.conftest import _random_model


def measured(rng, model, noise, lines):
    """Responses around all modes, with errors e = G dT and their covariance."""
    lam = eigh(model.stiffness_matrix, model.mass_matrix, eigvals_only=True)
    axes = len(model.axes)
    w = np.sqrt(np.abs(lam[axes:])) if lam.size > axes else np.array([30.0, 120.0])
    low, high = 0.3 * w.min(), 1.5 * w.max()
    spacing = (high - low) / lines
    omega = spacing * (np.round(low / spacing) + 0.5 + np.arange(lines))
    exact = machine_response(model, omega)
    shape = (lines, axes, axes)
    torque = noise * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2.0)
    outer = noise**2 * exact @ exact.conj().transpose(0, 2, 1)
    covariance = np.array([np.kron(each, np.eye(axes)) for each in outer])
    std = np.sqrt(np.einsum("fkk->fk", covariance).real).reshape(shape)
    return ResponseMatrix(model.names, omega, exact + exact @ torque, std, covariance)


def visibility(model, data):
    """Frequencies in Hz and largest component of each true mode in standard errors."""
    lam, shapes = eigh(model.stiffness_matrix, model.mass_matrix)
    axes, n = len(model.axes), lam.size - len(model.axes)
    omega = np.sqrt(lam[axes:])
    parts = ModalParts(n, np.ones((axes, axes), bool), True, True, False, True)
    at, x = parts.slices, np.zeros(parts.count)
    at_motors = shapes[model.first_masses]
    flexible = shapes[:, axes:]
    x[at["omega"]] = omega
    x[at["zeta"]] = np.diag(flexible.T @ model.damping_matrix @ flexible) / (2.0 * omega)
    x[at["phi"]] = at_motors[:, axes:].ravel()
    x[at["rigid"]] = (at_motors[:, :axes] @ at_motors[:, :axes].T)[parts.upper]
    x[at["friction"]] = [a.viscous_friction.value + a.load_friction.value for a in model.axes]
    rows = data.jacobian(modal_derivatives(parts, x, data.omega))
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    covariance = np.linalg.pinv((rows / size).T @ (rows / size)) / np.outer(size, size)
    std = np.sqrt(np.diag(covariance))[at["phi"]].reshape(axes, n)
    return omega / (2 * np.pi), np.max(np.abs(at_motors[:, axes:]) / std, axis=0, initial=0.0)


class Row:
    """Counts of one group of machines."""

    def __init__(self, name):
        self.name, self.seconds = name, []
        self.counts = dict.fromkeys(("seen", "right", "doubted", "faint", "warned", "wrong"), 0)

    def add(self, seen, right, warned, seconds):
        self.seconds.append(seconds)
        self.counts["seen" if seen else "faint"] += 1
        self.counts["right"] += seen and right
        self.counts["doubted"] += seen and right and warned
        self.counts["warned"] += not seen and warned
        self.counts["wrong"] += not right and not warned

    def show(self):
        c = self.counts
        share = 100.0 * c["right"] / max(c["seen"], 1)
        times = np.array(self.seconds) if self.seconds else np.zeros(1)
        print(
            f"{self.name:26s} {c['seen']:5d} {c['right']:6d} {share:6.1f} % {c['doubted']:8d} "
            f"{c['faint']:6d} {c['warned']:7d} {c['wrong']:6d} {np.median(times):8.2f} "
            f"{times.max():6.2f}",
            flush=True,
        )


def study(rng, row, machines, spread, friction, lengths=None):
    for _ in range(machines):
        axes = int(rng.integers(1, 5))
        chosen = tuple(int(n) for n in rng.integers(1, 5, axes)) if lengths is None else lengths
        model = _random_model(rng, chosen, friction=friction, spread=spread)
        data = measured(rng, model, 10.0 ** rng.uniform(-3.5, -3.0), int(rng.integers(60, 151)))
        _, heights = visibility(model, data)
        start = time.perf_counter()
        try:
            found = select_order(data)
            right = tuple(found.masses.values()) == chosen
            warned = bool(found.doubts)
        except IdentificationError as error:
            right, warned = False, True
            print(f"  refused {chosen}, faintest {heights.min(initial=np.inf):.3g}: {error}")
        seconds = time.perf_counter() - start
        seen = bool(np.all(heights > SEEN))
        row.add(seen, right, warned, seconds)
        if not right:
            print(f"  {chosen} faintest {heights.min(initial=np.inf):.3g}, warned: {warned}")


def main(machines=100, seed=None):
    """Print the table."""
    seed = np.random.SeedSequence().entropy if seed is None else seed
    rng = np.random.default_rng(seed)
    print(f"{machines} machines a row, seed {seed}")
    print(
        "machines                    seen  right   share  doubted  faint  warned  wrong   median s"
        "    max"
    )
    print("(seen: every mode over 10 standard errors; wrong: not right and no word of doubt)")
    groups = (
        ("1-4 axes x 1-4, friction", 0.3, True, None, machines),
        ("the same, values x 1/2.5-2.5", 0.9, True, None, machines),
        ("no friction", 0.9, False, None, machines),
        ("2 axes x 3, no friction", 0.3, False, (3, 3), machines // 5),
        ("3 axes x 3", 0.3, True, (3, 3, 3), machines // 10),
        ("4 axes x 4", 0.3, True, (4, 4, 4, 4), machines // 10),
    )
    for name, spread, friction, lengths, count in groups:
        row = Row(name)
        study(rng, row, max(count, 1), spread, friction, lengths)
        row.show()


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:]))
