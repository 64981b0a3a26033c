"""Doubts from the responses, looked at once more with what the whole records say.

Responses are freed of transients without a model, and what that leaves can look like a faint mode at
the edge of the band.  The fit to whole records holds the machine's free motion: a mode that is not in
its model has to show in what it leaves, and a mode that is in it rests on masses and springs whose
errors are known.
"""

from collections.abc import Sequence

from scipy.stats import chi2

from fieldtool.identify.chains.doubts import ModeDoubt
from fieldtool.identify.chains.modal_chain import SEEN
from fieldtool.identify.chains.structure import FALSE_ALARM, StructureTest, structure_notes
from fieldtool.identify.likelihood.parameters import Parameter, machine_parameters
from fieldtool.identify.likelihood.record_data import RecordData
from fieldtool.identify.likelihood.refine import RefinedModel
from fieldtool.identify.modes.scan import SCAN_DAMPINGS, noise_limit
from fieldtool.identify.modes.search import DOUBTFUL
from fieldtool.records.model import MachineModel


def still_in_doubt(doubt: ModeDoubt, fitted: RefinedModel, data: RecordData, lines: int) -> bool:
    """Whether a mode that the responses left in doubt is so by the whole records as well.

    Parameters
    ----------
    doubt
        By the responses.
    fitted
        The fit to `data`.
    data
        Whole records.
    lines
        Number of frequencies at which the responses were searched for modes.
    """
    if doubt.in_model:
        return not _all_known(fitted)
    return _gain(doubt.omega, fitted, data) > noise_limit(lines, len(data.names), DOUBTFUL)


def structure_still_in_doubt(
    tests: Sequence[StructureTest], fitted: RefinedModel, data: RecordData
) -> tuple[str, ...]:
    """What the modes tell of couplings in unexpected places, without those that the records deny.

    An inertia or a spring there would have to lower the fit's chi2; of an end that is held, or goes on,
    the word of the modes is kept.
    """
    limit = float(chi2.isf(FALSE_ALARM / max(len(tests), 1), 1))
    excess = max(1.0, fitted.chi2 / fitted.degrees_of_freedom)
    parameters = _fitted(fitted, data)

    def shows(test: StructureTest) -> bool:
        added = _between(test, fitted.model)
        if added is None:
            return True
        gain = data.gain_of_parameter(fitted.model, fitted.delay_values, parameters, added)
        return gain > limit * excess

    return structure_notes([test for test in tests if test.significant and shows(test)])


def _between(test: StructureTest, model: MachineModel) -> Parameter | None:
    """The coupling or spring that a test asks for; None for a chain's end."""
    if test.kind == "end":
        return None
    first = dict(zip(model.names, model.first_masses, strict=True))
    one, other = (int(first[name]) + k - 1 for name, k in test.places)
    return Parameter(
        "", "coupling" if test.kind == "inertia" else "spring", (one, other), 0, 0, 1.0
    )


def _fitted(fitted: RefinedModel, data: RecordData) -> list[Parameter]:
    listed = machine_parameters(fitted.model, data.omega)
    return [p for p in listed if p.name in fitted.names]


def _all_known(fitted: RefinedModel) -> bool:
    """Whether every mass and spring stands out of its error as a mode must."""
    chains = [chain for axis in fitted.model.axes for chain in (axis.masses, axis.springs)]
    return all(SEEN * each.std < each.value for chain in chains for each in chain)


def _gain(omega: float, fitted: RefinedModel, data: RecordData) -> float:
    """By how much a small mode there would lower chi2, in units of the misfit."""
    parameters = _fitted(fitted, data)
    excess = max(1.0, fitted.chi2 / fitted.degrees_of_freedom)
    gains = [
        data.gain_of_mode(fitted.model, fitted.delay_values, parameters, omega, zeta)
        for zeta in SCAN_DAMPINGS
    ]
    return max(gains) / excess
