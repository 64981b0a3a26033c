"""Time from a response matrix to the refined model with covariance, against axes and masses.

Random machines, all numbers of masses known: modes, block order reduction, fit to the responses, and
the fit to the whole records that ends every identification.  The recordings behind the responses have as
many experiments as axes, two periods of odd lines over the band of the modes at steady state, and white
noise of 3e-4 N m in a line of torques of 1 N m.  Before the clock runs, the phasors and the response
matrix are made from them; "whole s" has the noise between the lines in it, and both weightings.
One thread, as fieldtool has it; judged is the processor's time, for the computer may be busy.

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

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as fieldtool itself

import numpy as np
from scipy.linalg import eigh

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from fieldtool.errors import IdentificationError
from fieldtool.experiment.multisine.phases import orthogonal_phases
from fieldtool.frf.multisine.matrix import joint_response
from fieldtool.identify.chains.block_reduction import reduce_blocks
from fieldtool.identify.likelihood.parameters import machine_parameters, parameter_values
from fieldtool.identify.likelihood.refine import machine_response, refine
from fieldtool.identify.likelihood.response_data import matrix_of
from fieldtool.identify.modes.fit import fit_modes
from fieldtool.identify.modes.search import find_modes
from fieldtool.identify.multisine.fit import WEIGHTINGS
from fieldtool.identify.multisine.whole_records import WholeRecords
from fieldtool.records.model import Estimate
from fieldtool.records.recording import AxisInfo, Experiment, Recording
from tests.conftest import _random_model

CASES = {"1x2": (1, 2), "2x3": (2, 3), "3x3": (3, 3), "4x3": (4, 3), "4x4": (4, 4), "6x4": (6, 4)}
"""Axes, masses."""
LIMITS = {"3x3": 1.0, "6x4": 30.0}
"""s."""
NOISE = 3e-4
OVERSAMPLED = 40
"""Samples in a period of the highest frequency that lines are counted to."""
KINDS = ("mass", "spring", "coupling", "damper")


def measured(rng, model, lines):
    """Return a recording with noise: multisines over the band of the modes at steady state."""
    axes = len(model.axes)
    lam = eigh(model.stiffness_matrix, model.mass_matrix, eigvals_only=True)[axes:]
    low, high = 0.3 * np.sqrt(lam[0]), 1.5 * np.sqrt(lam[-1])
    odd = 2 * np.arange(lines) + 1
    odd = odd[odd * high / (2 * lines) >= low]
    samples, period = OVERSAMPLED * 2 * lines, 2 * np.pi * 2 * lines / high
    response = machine_response(model, 2 * np.pi * odd / period)
    phases = np.exp(2j * np.pi * rng.random((odd.size, axes)))
    mixing = orthogonal_phases(axes, axes)
    experiments = []
    for e in range(axes):
        torque = phases * mixing[:, e]
        position = np.einsum("fij,fj->fi", response, torque)
        signals = np.tile(
            np.hstack([periodic(p, odd, samples) for p in (position, torque)]), (2, 1)
        )
        reference = 1e-3 * signals[:, axes:]  # as strong at all lines
        signals[:, axes:] += NOISE * np.sqrt(samples / 2) * rng.standard_normal((2 * samples, axes))
        experiments.append(
            Experiment(
                f"fast {e + 1}", "multisine", model.names, (), period,
                np.arange(2 * samples) * (period / samples), signals[:, :axes], signals[:, axes:],
                reference,
            )
        )  # fmt: skip
    infos = tuple(AxisInfo(axis.name, "rotary", len(axis.masses)) for axis in model.axes)
    return Recording(period / samples, infos, tuple(experiments))


def periodic(phasors, lines, samples):
    """A period of the signals with these amplitudes at these lines, shape (samples, M)."""
    spectrum = np.zeros((samples // 2 + 1, phasors.shape[1]), complex)
    spectrum[lines] = phasors * (samples / 2)
    return np.fft.irfft(spectrum, samples, axis=0)


def machine(rng, axes, masses, loads):
    """Return a random machine, without friction at its last masses if that is not wanted."""
    model = _random_model(rng, (masses,) * axes, friction=True)
    if loads:
        return model
    still = tuple(replace(axis, load_friction=Estimate(0.0)) for axis in model.axes)
    return replace(model, axes=still)


def timed(model, recording, loads, search):
    """Identify; return the machine, seconds of modes, reduction, fits and processor, and lines."""
    solved = joint_response(recording)
    data = matrix_of(solved.response)
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
    records = WholeRecords(recording, solved.lines, np.zeros(len(masses)))
    if records.too_long:
        raise SystemExit("too many numbers for a fit of whole records: fewer --lines")
    for _ in range(WEIGHTINGS):
        whole = records.data(found, run_in=True)
        found = refine(found.model, whole, delays=found.delay_values.tolist(), **fitted)
    marks.append(time.perf_counter())
    return found, np.append(np.diff(marks), time.process_time() - used), data.omega.size


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
          f"{'reduce s':>9}{'fit s':>8}{'whole s':>9}{'CPU s':>8}{'all s':>15}{'mass %':>9}"
          f"{'spring %':>9}{'coupl. %':>9}{'damper %':>9}{'sigmas':>8}{'misfit':>8}"
          f"{'peak MB':>9}")  # fmt: skip
    sizes, medians = [], []
    for case in arguments.case:
        axes, n = CASES[case]
        parts, worst, sigmas = [], dict.fromkeys(KINDS, 0.0), 0.0
        misfit = 0.0
        for _ in range(arguments.machines):
            model = machine(rng, axes, n, arguments.loads)
            data = measured(rng, model, arguments.lines)
            try:
                found, seconds, lines = timed(model, data, arguments.loads, arguments.search)
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
        total = times[:, :4].sum(axis=1)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        limit = LIMITS.get(case)
        verdict = (
            ""
            if limit is None
            else f"  {'met' if times[:, 4].max() < limit else 'MISSED'}: {limit:g} s"
        )
        print(
            f"{case:<14}{axes * (n - 1):6d}{lines:6d}{len(found.names):11d}"
            + "".join(
                f"{t:{w}.2f}"
                for t, w in zip(np.median(times, axis=0), (9, 9, 8, 9, 8), strict=True)
            )
            + f"{np.median(total):7.2f} ({total.max():.2f})"
            + "".join(f"{100 * worst[k]:9.3f}" for k in KINDS)
            + f"{sigmas:8.1f}{misfit:8.2f}{peak:9.0f}{verdict}",
            flush=True,
        )
        sizes.append((axes, n))
        medians.append(float(np.median(times[:, 4])))
    if len(medians) >= 3:
        rows = np.column_stack([np.ones(len(sizes)), np.log(sizes)])
        exponents = np.linalg.lstsq(rows, np.log(medians), rcond=None)[0]
        print(
            f"processor's time grows as axes^{exponents[1]:.1f} masses^{exponents[2]:.1f} (fitted)"
        )


if __name__ == "__main__":
    main()
