"""The case study of the paper's section 4: three chains of three masses, coupled at their ends."""

from itertools import combinations

import numpy as np
import pytest

from fieldtool.identify.chains.forward import gains, spectra
from fieldtool.identify.chains.order_reduction import AxisModes, CrossGain, reduce_machine
from fieldtool.identify.chains.spectrum import Spectrum, without_cancelling_pairs
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel

MASSES = ((0.7, 2, 3), (4, 5, 6), (7, 8, 9))
SPRINGS = ((1000, 2000), (3000, 4000), (5000, 6000))
COUPLINGS = {("branch 1", "branch 2"): 1.0, ("branch 1", "branch 3"): 2.0}
COUPLINGS[("branch 2", "branch 3")] = 3.0

RESONANCES = [0, 24.63, 29.59, 34.16, 44.92, 48.60, 51.28]
ANTIRESONANCES = [
    [13.11, 25.29, 29.75, 43.62, 46.88, 49.33],
    [14.93, 27.05, 34.15, 43.13, 47.94, 51.27],
    [15.63, 27.55, 33.55, 43.38, 48.12, 51.17],
]
PRINTED = [
    {
        "u1": [0.3569, 0.1808, 0.1292, 0.7077, 0.2070, 0.2104, 0.4850],
        "b11": 1428.6,
        "d2": [509.89, 148.67, 71.43, 185.14, -122.06, -196.46, -582.52],
        "b12": 845.15,
        "u2": [0.6033, 0.1759, 0.0845, 0.2191, -0.1444, -0.2325, -0.6892],
        "b22": 1500,
    },
    {
        "u1": [0.5248, 0.5016, 0.5723, 0.0368, 0.3019, 0.2289, 0.0218],
        "b11": 750.0,
        "d2": [393.60, 71.97, -71.83, -15.36, -382.91, -369.07, -40.90],
        "b12": 670.82,
        "u2": [0.5867, 0.1073, -0.1071, -0.0229, -0.5708, -0.5502, -0.0610],
        "b22": 1400,
    },
    {
        "u1": [0.5538, 0.5238, 0.4761, 0.2561, 0.2881, 0.1890, 0.0894],
        "b11": 714.29,
        "d2": [395.56, 56.45, -76.76, -115.94, -375.61, -311.47, -171.31],
        "b12": 668.15,
        "u2": [0.5920, 0.0845, -0.1149, -0.1735, -0.5622, -0.4662, -0.2564],
        "b22": 1375,
    },
]
HALF_DIGIT = {"u1": 5e-5, "b11": 0.05, "d2": 5e-3, "b12": 5e-3, "u2": 5e-5, "b22": 0.5}


def paper_machine():
    axes = tuple(
        AxisModel(
            f"branch {i + 1}",
            "rotary",
            tuple(Estimate(float(m)) for m in MASSES[i]),
            tuple(Estimate(float(k)) for k in SPRINGS[i]),
        )
        for i in range(3)
    )
    return MachineModel(axes, tuple(Coupling(pair, m) for pair, m in COUPLINGS.items()))


def reduced(given, *, motor_mass_known=False):
    known = gains(paper_machine())
    axes = [
        AxisModes(
            spectrum,
            3,
            Estimate(known.low[i]),
            None if motor_mass_known else Estimate(known.high[i]),
            Estimate(float(MASSES[i][0])) if motor_mass_known else None,
        )
        for i, spectrum in enumerate(given)
    ]
    cross = [
        CrossGain((f"branch {i + 1}", f"branch {j + 1}"), known.cross[i, j])
        for i, j in combinations(range(3), 2)
    ]
    return reduce_machine(axes, cross)


def test_frequencies_and_gains_are_those_of_the_case_study():
    for spectrum, antiresonances in zip(spectra(paper_machine()), ANTIRESONANCES, strict=True):
        np.testing.assert_allclose(np.sqrt(spectrum.resonances), RESONANCES, atol=5.001e-3)
        np.testing.assert_allclose(np.sqrt(spectrum.antiresonances), antiresonances, atol=5.001e-3)
    known = gains(paper_machine())
    np.testing.assert_allclose(known.low, [0.175439, 0.066667, 0.041667], atol=5e-7)
    np.testing.assert_allclose(known.high, [1.428571, 0.25, 0.142857], atol=5e-7)
    np.testing.assert_allclose(
        known.cross[[0, 0, 1], [1, 2, 2]], [-0.0118343, -0.0150602, -0.0085470], atol=5e-8
    )


@pytest.mark.parametrize("branch", range(3))
@pytest.mark.parametrize("quantity", HALF_DIGIT)
def test_every_intermediate_that_the_paper_prints(branch, quantity):
    (step,) = reduced(spectra(paper_machine())).chains[branch].steps
    np.testing.assert_allclose(
        getattr(step, quantity), PRINTED[branch][quantity], rtol=0, atol=1.02 * HALF_DIGIT[quantity]
    )


@pytest.mark.parametrize("motor_mass_known", [False, True])
def test_exact_frequencies_give_every_mass_spring_and_coupling(motor_mass_known):
    result = reduced(spectra(paper_machine()), motor_mass_known=motor_mass_known)
    for i, chain in enumerate(result.chains):
        np.testing.assert_allclose(chain.masses, MASSES[i], rtol=1e-11)
        np.testing.assert_allclose(chain.springs, SPRINGS[i], rtol=1e-11)
        assert len(chain.steps) == 1
        assert np.all(chain.relative_bounds < 1e-11)
    for coupling in result.model.couplings:
        assert coupling.value == pytest.approx(COUPLINGS[coupling.axes], rel=1e-12)
    assert result.notes == ()


def test_frequencies_as_printed_give_springs_within_half_a_percent():
    given = [
        Spectrum.from_angular(f"branch {i + 1}", np.array(RESONANCES), np.array(anti))
        for i, anti in enumerate(ANTIRESONANCES)
    ]
    for i, chain in enumerate(reduced(given).chains):
        np.testing.assert_allclose(chain.springs, SPRINGS[i], rtol=5e-3)
        np.testing.assert_allclose(chain.masses[-1], MASSES[i][-1], rtol=25e-3)
        assert np.abs(chain.springs / SPRINGS[i] - 1).max() > 1e-5  # the rounding is felt


def test_branch_2_may_leave_out_the_pair_that_nearly_cancels():
    whole = spectra(paper_machine())[1]
    shorter = Spectrum(
        whole.axis, np.delete(whole.resonances, 3), np.delete(whole.antiresonances, 2)
    )
    b11 = shorter.weights @ shorter.resonances
    assert b11 / 750.0 - 1 == pytest.approx(-0.002, abs=0.001)


def test_pairs_that_nearly_cancel_are_found_and_noted():
    given = list(spectra(paper_machine()))
    given[1] = without_cancelling_pairs(given[1], 0.001)
    pairs = np.sqrt(given[1].left_out)
    np.testing.assert_allclose(pairs, [[34.16101, 34.14905], [51.28013, 51.27408]], atol=1e-5)
    result = reduced(given)
    assert sum("branch 2" in note and "left out" in note for note in result.notes) == 2
    np.testing.assert_allclose(result.chains[1].springs, SPRINGS[1], rtol=0.03)
