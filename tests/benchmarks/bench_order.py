"""How often the number of masses of every axis is found, and what is said where it is not.

Random machines with couplings, light dampers and some friction; responses on an odd grid with the
noise of a measured torque.  A machine counts as seen when every mode's largest component stands
ten standard errors out of the noise, by the information that its true modes have in the data.
A machine of two axes, coupled at their ends and without friction at its loads, has twins: machines of
other lengths with the same responses.  Whether a machine has any is found out here, not asked of the
tool: a spring is carried over the coupling by a change of coordinates, and the twin counts only if its
responses, solved from its own matrices, agree to 1e-9 with those of the machine.  No data of the motors
tell which of them was measured, so such machines have columns of their own: a twin found with a word
of doubt is all that can be had, one without a word is wrong.

A second table has machines with a faint mode: the noise is such that it stands 1 to 20 standard errors
out of it.  Counted is what was found, whether a sentence names a frequency near that mode (5 %), and
whether lengths that are wrong come without any word of doubt.  Below about 6 standard errors noise alone
looks like such a mode somewhere in the band (once in a hundred machines), and between 6 and 10 the other
modes can still take over what it does: there the machine without it may explain all that was measured,
and nothing is said.

Run: python tests/benchmarks/bench_order.py [machines] [seed]
"""

import os
import re
import sys
import time
from collections import Counter
from itertools import pairwise
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


def carried_over(axes, coupling, giver):
    """Carry the last spring of an axis over the coupling; None where it has none to give.

    With x the other's last mass a, y the giver's b on its spring K, p the mass before it, and coupling
    c, the coordinate z = x + (b / c) (y - p) makes of them: a - c^2 / b at x, K (c / b)^2 from x to z,
    c^2 / b at z, and p + b; c couples z and p.
    """
    (masses, springs, dampers), (taken, theirs, also) = axes[giver], axes[1 - giver]
    if not springs or not coupling:
        return None
    b, ratio = masses[-1], coupling / masses[-1]
    given = ([*masses[:-2], masses[-2] + b], springs[:-1], dampers[:-1])
    grown = (
        [*taken[:-1], taken[-1] - coupling * ratio, coupling * ratio],
        [*theirs, springs[-1] * ratio**2],
        [*also, dampers[-1] * ratio**2],
    )
    return (given, grown) if giver == 0 else (grown, given)


def response(axes, coupling, frictions, omega):
    """Responses of two coupled chains from their own matrices, shape (F, 2, 2)."""
    n = [len(chain[0]) for chain in axes]
    mass = np.diag(np.concatenate([chain[0] for chain in axes]))
    mass[n[0] - 1, -1] = mass[-1, n[0] - 1] = coupling
    dynamic = -(omega[:, None, None] ** 2) * mass + 0j
    for first, (_, springs, dampers), friction in zip((0, n[0]), axes, frictions, strict=True):
        dynamic[:, first, first] += 1j * omega * friction
        for k, (spring, damper) in enumerate(zip(springs, dampers, strict=True), start=first):
            both = (spring + 1j * omega * damper)[:, None, None] * np.array([[1, -1], [-1, 1]])
            dynamic[:, k : k + 2, k : k + 2] += both
    motors = [0, n[0]]
    return np.linalg.inv(dynamic)[:, motors][:, :, motors]


def twins(model, omega, longest=5):
    """Return the lengths of all other machines that have this one's responses to 1e-9."""
    loads = any(a.load_friction.value for a in model.axes)
    if len(model.axes) != 2 or not model.couplings or loads:
        return []
    axes = tuple(
        tuple([e.value for e in part] for part in (axis.masses, axis.springs, axis.dampers))
        for axis in model.axes
    )
    coupling = model.couplings[0].value
    frictions = [axis.viscous_friction.value for axis in model.axes]
    own, found = machine_response(model, omega), []
    for giver in (0, 1):
        other = carried_over(axes, coupling, giver)
        while other is not None and max(len(chain[0]) for chain in other) <= longest:
            same = response(other, coupling, frictions, omega)
            positive = all(value > 0 for chain in other for part in chain for value in part)
            if positive and np.allclose(same, own, rtol=1e-9, atol=1e-9 * np.abs(own).max(0)):
                found.append(tuple(len(chain[0]) for chain in other))
            other = carried_over(other, coupling, giver)
    return found


class Row:
    """Counts of one group of machines."""

    def __init__(self, name):
        self.name, self.seconds, self.shapes = name, [], set()
        self.counts = dict.fromkeys(
            (
                "seen",
                "right",
                "doubted",
                "faint",
                "warned",
                "twinned",
                "itself",
                "twin",
                "said",
                "wrong",
            ),
            0,
        )

    def add(self, chosen, seen, right, twin, has_twins, warned, seconds):
        """Count one machine: its lengths, whether all modes are seen, what was found and said."""
        self.shapes.add(chosen)
        self.seconds.append(seconds)
        if has_twins and seen:
            self.counts["twinned"] += 1
            self.counts["itself"] += right
            self.counts["twin"] += twin
            self.counts["said"] += (right or twin) and warned
            self.counts["wrong"] += not warned
            return
        self.counts["seen" if seen else "faint"] += 1
        self.counts["right"] += seen and right
        self.counts["doubted"] += seen and right and warned
        self.counts["warned"] += not seen and warned
        self.counts["wrong"] += not right and not warned

    def show(self):
        """Print the row."""
        c = self.counts
        share = 100.0 * c["right"] / max(c["seen"], 1)
        times = np.array(self.seconds) if self.seconds else np.zeros(1)
        print(
            f"{self.name:29s} {c['seen']:5d} {c['right']:6d} {share:6.1f} % {c['doubted']:8d} "
            f"{c['faint']:6d} {c['warned']:7d} {c['twinned']:8d} {c['itself']:7d} {c['twin']:6d} "
            f"{c['said']:5d} {c['wrong']:6d} {np.median(times):8.2f} {times.max():6.2f} "
            f"{len(self.shapes):7d}",
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
            answer = tuple(found.masses.values())
            right, warned = answer == chosen, bool(found.doubts)
        except IdentificationError as error:
            answer, right, warned = (), False, True
            print(f"  refused {chosen}, faintest {heights.min(initial=np.inf):.3g}: {error}")
        seconds = time.perf_counter() - start
        seen = bool(np.all(heights > SEEN))
        others = twins(model, data.omega)
        row.add(chosen, seen, right, answer in others, bool(others), warned, seconds)
        if not right and answer:
            kind = "a twin" if answer in others else "no twin"
            print(
                f"  {chosen} found as {answer}, {kind}, faintest {heights.min(initial=np.inf):.3g}, "
                f"warned: {warned}"
            )


BANDS = (1.0, 3.0, 6.0, 10.0, 20.0)
"""Standard errors that the faintest mode stands out of the noise."""
NEAR = 0.05
"""Relative difference of a frequency that is named from the faintest mode's."""


def named_near(doubts, hertz):
    """Whether a sentence names a frequency near this one."""
    found = [float(n) for each in doubts for n in re.findall(r"([0-9.e+]+) Hz", each)]
    return any(abs(n - hertz) < NEAR * hertz for n in found)


def faint_study(rng, machines):
    """Print a row for each band of how far the faintest mode stands out of the noise."""
    print(
        "\nfaintest mode at, std errors  machines  right  doubted  named  fewer  said  other  said"
        "  refused  wrong without a word"
    )
    for low, high in pairwise(BANDS):
        counts = Counter()
        while counts["machines"] < machines:
            chosen = tuple(int(n) for n in rng.integers(1, 5, int(rng.integers(1, 5))))
            if max(chosen) == 1:
                continue
            model = _random_model(rng, chosen, friction=True, spread=0.3)
            state, lines = rng.bit_generator.state, int(rng.integers(60, 151))
            frequencies, heights = visibility(model, measured(rng, model, 1e-4, lines))
            noise = 1e-4 * heights.min() / np.exp(rng.uniform(np.log(low), np.log(high)))
            rng.bit_generator.state = state
            data = measured(rng, model, noise, lines)
            if np.count_nonzero(visibility(model, data)[1] < 2 * SEEN) > 1 or twins(
                model, data.omega
            ):
                continue  # one faint mode, and nothing else that is in doubt
            counts["machines"] += 1
            try:
                found = select_order(data)
            except IdentificationError:
                counts["refused"] += 1
                continue
            answer, doubts = tuple(found.masses.values()), found.doubts
            right, fewer = answer == chosen, sum(answer) < sum(chosen)
            kind = "right" if right else "fewer" if fewer else "other"
            counts[kind] += 1
            counts[f"{kind} said"] += bool(doubts)
            counts["named"] += named_near(doubts, frequencies[np.argmin(heights)])
            counts["silent"] += not right and not doubts
        c = counts
        print(
            f"{low:4.0f} to {high:<21.0f} {c['machines']:8d} {c['right']:6d} {c['right said']:8d} "
            f"{c['named']:6d} {c['fewer']:6d} {c['fewer said']:5d} {c['other']:6d} {c['other said']:5d} "
            f"{c['refused']:8d} {c['silent']:6d}",
            flush=True,
        )


def main(machines=100, seed=None):
    """Print the table."""
    seed = np.random.SeedSequence().entropy if seed is None else seed
    rng = np.random.default_rng(seed)
    print(f"{machines} machines a row, seed {seed}")
    print(
        "machines                       seen  right   share  doubted  faint  warned  twinned  itself"
        "   twin  said  wrong median s    max  shapes"
    )
    print(
        "(seen: every mode over 10 standard errors and no twin; twinned: seen, but other lengths give "
        "the same responses; said: with a word of doubt; wrong: not right, or a twin, and no such word)"
    )
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
    faint_study(rng, max(machines // 4, 1))


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:]))
