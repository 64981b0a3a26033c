"""How accurately order reduction takes random machines apart, from exact frequencies and gains.

Run: python tests/benchmarks/bench_order_reduction.py [machines] [seed]
"""

import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from exact_modes import exact_spectra, random_machine

from fieldtool.errors import NotAChainError
from fieldtool.identify.chains.forward import gains
from fieldtool.identify.chains.order_reduction import (
    AxisModes,
    CrossGain,
    reduce_machine,
)
from fieldtool.records.model import Estimate


def machine_inputs(model, spectra, motor_mass_known=False):
    """Exact inputs of order reduction."""
    known = gains(model)
    axes = []
    for i, (axis, spectrum) in enumerate(zip(model.axes, spectra, strict=True)):
        low, high = Estimate(float(known.low[i]), 0.0), Estimate(float(known.high[i]), 0.0)
        mass = axis.masses[0] if motor_mass_known else None
        axes.append(AxisModes(spectrum, len(axis.masses), low, high, mass))
    names = model.names
    cross = [
        CrossGain((names[i], names[j]), float(known.cross[i, j]), 0.0)
        for i in range(len(names))
        for j in range(i + 1, len(names))
    ]
    return axes, cross


def errors_and_bounds(model, motor_mass_known=False):
    """Relative errors of masses and springs, their bounds, and the couplings' errors and bounds."""
    reduced = reduce_machine(*machine_inputs(model, exact_spectra(model), motor_mass_known))
    truth = np.array([e.value for a in model.axes for e in (*a.masses, *a.springs)])
    found = np.concatenate([chain.values for chain in reduced.chains])
    bounds = np.concatenate([chain.relative_bounds for chain in reduced.chains])
    couplings = np.array([c.value for c in model.couplings])
    off = np.array([c.value for c in reduced.model.couplings]) - couplings
    return np.abs(found / truth - 1.0), bounds, np.abs(off / couplings), reduced.coupling_bounds


def main(machines=50, seed=None):
    """Print the table."""
    seed = np.random.SeedSequence().entropy if seed is None else seed
    print(f"{machines} machines a row, seed {seed}")
    print(
        "worst relative error of a machine; error over bound of the worst value; refused machines"
    )
    print(" M   N    median      95 %       max   > 1e-6   err/bound max  median  refused       s")
    rng = np.random.default_rng(seed)
    for axes in range(1, 5):
        for masses in (1, 2, 3, 4, 5, 6, "1-6"):
            start, worst, ratios, refused = time.perf_counter(), [], [], 0
            for _ in range(machines):
                lengths = [masses] * axes if masses != "1-6" else list(rng.integers(1, 7, axes))
                model = random_machine(rng, axes, lengths)
                try:
                    errors, bounds, off, off_bounds = errors_and_bounds(model)
                except NotAChainError:
                    refused += 1
                    continue
                errors, bounds = np.append(errors, off), np.append(bounds, off_bounds)
                worst.append(errors.max())
                ratios.append(float(np.max(errors / np.maximum(bounds, 1e-300))))
            print(
                f"{axes:2d} {masses!s:>3s}   {np.median(worst):7.1e} {np.quantile(worst, 0.95):9.1e} "
                f"{np.max(worst):9.1e} {np.sum(np.array(worst) > 1e-6):8d} {np.max(ratios):15.3f} "
                f"{np.median(ratios):7.4f} {refused:8d} {time.perf_counter() - start:7.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:]))
