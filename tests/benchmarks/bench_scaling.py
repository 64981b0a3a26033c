"""Time from a response matrix to the refined model with covariance, against axes and masses.

Random machines, all numbers of masses known: modes, block order reduction, maximum likelihood fit, as
fieldtool.identify does it.  The responses have odd lines over the band of the modes and
errors e = G dT with their covariance, 3e-4 N m of noise on torques of 1 N m.

Targets of the project: 3 axes of 3 masses in under 1 s, 6 axes of 4 masses (24 masses, 18 springs, 15
couplings) in under 30 s.

Run: python tests/benchmarks/bench_scaling.py [--seed S] [--machines N] [--lines L] [--case 3x3 ...]
"""

import argparse
import os
import resource
import sys
import time
from dataclasses import replace
from pathlib import Path

if "OMP_NUM_THREADS" not in os.environ:
    os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "2"  # of a laptop

import numpy as np
from scipy.linalg import eigh

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from fieldtool.errors import IdentificationError
from fieldtool.identify.chains.block_reduction import reduce_blocks
from fieldtool.identify.likelihood.parameters import machine_parameters, parameter_values
from fieldtool.identify.likelihood.refine import machine_response, refine
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes.fit import fit_modes
from fieldtool.identify.modes.search import find_modes
from fieldtool.records.model import Estimate
from tests.conftest import _random_model

CASES = {"1x2": (1, 2), "2x3": (2, 3), "3x3": (3, 3), "4x3": (4, 3), "4x4": (4, 4), "6x4": (6, 4)}
"""Axes, masses."""
LIMITS = {"3x3": 1.0, "6x4": 30.0}
"""s."""
NOISE = 3e-4
KINDS = ("mass", "spring", "coupling", "damper")


def measured(rng, model, lines):
    """Return responses over the band of the modes, with errors and their covariance."""
    axes = len(model.axes)
    lam = eigh(model.stiffness_matrix, model.mass_matrix, eigvals_only=True)[axes:]
    low, high = 0.3 * np.sqrt(lam[0]), 1.5 * np.sqrt(lam[-1])
    spacing = high / (2 * lines)
    odd = spacing * (2 * np.arange(lines) + 1)
    omega = odd[odd >= low]
    exact = machine_response(model, omega)
    torque = NOISE * (
        (rng.standard_normal(exact.shape) + 1j * rng.standard_normal(exact.shape)) / np.sqrt(2.0)
    )
    outer = NOISE**2 * exact @ exact.conj().transpose(0, 2, 1)
    covariance = np.array([np.kron(each, np.eye(axes)) for each in outer])
    std = np.sqrt(np.einsum("fkk->fk", covariance).real).reshape(exact.shape)
    return ResponseMatrix(model.names, omega, exact + exact @ torque, std, covariance)


def machine(rng, axes, masses, loads):
    """Return a random machine, without friction at its last masses if that is not wanted."""
    model = _random_model(rng, (masses,) * axes, friction=True)
    if loads:
        return model
    still = tuple(replace(axis, load_friction=Estimate(0.0)) for axis in model.axes)
    return replace(model, axes=still)


def timed(model, data, loads, search):
    """Identify; return the fitted machine, and seconds of modes, reduction, fit, and of processor."""
    fitted = {"fit_friction": True, "fit_delay": True, "fit_load_friction": loads}
    used = time.process_time()
    masses = {axis.name: len(axis.masses) for axis in model.axes}
    kinds = {axis.name: axis.kind for axis in model.axes}
    marks = [time.perf_counter()]
    modes = sum(masses.values()) - len(masses)
    modal = find_modes(data, modes).modal if search else None
    if modal is None or modal.omega.size != modes:
        modal = fit_modes(data, modes, **fitted)
    marks.append(time.perf_counter())
    reduced = reduce_blocks(modal, masses, kinds)
    marks.append(time.perf_counter())
    found = refine(reduced.model, data, **fitted)
    marks.append(time.perf_counter())
    return found, np.append(np.diff(marks), time.process_time() - used)


def errors(model, found):
    """Return largest relative errors by kind, and the largest error in standard errors."""
    truth_of = machine_parameters(model, np.array([1.0, 100.0]))
    values = parameter_values(model, truth_of, [0.0] * len(model.axes))
    truth = dict(zip((p.name for p in truth_of), values, strict=True))
    kinds = {p.name: p.kind for p in truth_of}
    worst, sigmas = dict.fromkeys(KINDS, 0.0), 0.0
    std = np.sqrt(np.diag(found.covariance))
    for name, value, s in zip(found.names, found.values, std, strict=True):
        error = abs(value - truth[name])
        sigmas = max(sigmas, error / s)
        if kinds[name] in worst:
            worst[kinds[name]] = max(worst[kinds[name]], error / abs(truth[name]))
    return worst, sigmas


def main():
    """Print the table and the exponents."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--machines", type=int, default=3, help="of each size")
    parser.add_argument("--lines", type=int, default=150, help="from 0 to the end of the band")
    parser.add_argument("--loads", action="store_true", help="friction at the last masses too")
    parser.add_argument("--search", action="store_true", help="modes as without known numbers")
    parser.add_argument("--case", nargs="*", choices=list(CASES), default=list(CASES))
    arguments = parser.parse_args()
    seed = arguments.seed
    if seed is None:
        seed = int(np.random.SeedSequence().generate_state(1)[0])
    rng = np.random.default_rng(seed)
    print(f"seed {seed}, {arguments.machines} machines of each size, seconds: median (largest)")
    print(f"{'axes x masses':<14}{'modes':>6}{'lines':>6}{'parameters':>11}{'modes s':>9}"
          f"{'reduce s':>9}{'fit s':>8}{'CPU s':>8}{'all s':>15}{'mass %':>9}{'spring %':>9}"
          f"{'coupl. %':>9}{'damper %':>9}{'sigmas':>8}{'misfit':>8}{'peak MB':>9}")  # fmt: skip
    sizes, medians = [], []
    for case in arguments.case:
        axes, n = CASES[case]
        parts, worst, sigmas = [], dict.fromkeys(KINDS, 0.0), 0.0
        misfit = 0.0
        for _ in range(arguments.machines):
            model = machine(rng, axes, n, arguments.loads)
            data = measured(rng, model, arguments.lines)
            try:
                found, seconds = timed(model, data, arguments.loads, arguments.search)
            except IdentificationError as error:
                print(f"{case}: failed: {error}")
                continue
            parts.append(seconds)
            each, largest = errors(model, found)
            worst = {k: max(worst[k], each[k]) for k in KINDS}
            sigmas = max(sigmas, largest)
            misfit = max(misfit, found.chi2 / found.degrees_of_freedom)
        if not parts:
            continue
        times = np.array(parts)
        total = times[:, :3].sum(axis=1)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        limit = LIMITS.get(case)
        verdict = (
            "" if limit is None else f"  {'met' if total.max() < limit else 'MISSED'}: {limit:g} s"
        )
        print(
            f"{case:<14}{axes * (n - 1):6d}{data.omega.size:6d}{len(found.names):11d}"
            + "".join(
                f"{t:{w}.2f}" for t, w in zip(np.median(times, axis=0), (9, 9, 8, 8), strict=True)
            )
            + f"{np.median(total):7.2f} ({total.max():.2f})"
            + "".join(f"{100 * worst[k]:9.3f}" for k in KINDS)
            + f"{sigmas:8.1f}{misfit:8.2f}{peak:9.0f}{verdict}",
            flush=True,
        )
        sizes.append((axes, n))
        medians.append(float(np.median(times[:, 3])))
    if len(medians) >= 3:
        rows = np.column_stack([np.ones(len(sizes)), np.log(sizes)])
        exponents = np.linalg.lstsq(rows, np.log(medians), rcond=None)[0]
        print(
            f"processor's time grows as axes^{exponents[1]:.1f} masses^{exponents[2]:.1f} (fitted)"
        )


if __name__ == "__main__":
    main()
