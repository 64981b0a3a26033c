"""One combination of chain lengths, tried on measured responses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, log, nan, sqrt

import numpy as np

from fieldtool.errors import FieldtoolError, NotAChainError
from fieldtool.identify.chains.block_reduction import BlockReduced, reduce_blocks
from fieldtool.identify.likelihood.refine import UNKNOWN_ABOVE, RefinedModel, refine
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes.model import ModalModel
from fieldtool.records.model import Kind, MachineModel

DECISIVE = 30.0
"""Difference of the criterion above which one of two models is out of the question."""
SPREAD = 6.0
"""Standard deviations of chi2 by which an accepted machine may explain less than free modes."""
UNEXPLAINED = 100.0
"""Misfit over noise above which no model is accepted: errors ten times the noise."""
FAR = 4.0
"""Misfit over noise above which the model is called doubtful though nothing is better."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One combination of lengths, as far as it was tried."""

    lengths: tuple[int, ...]
    modal: ModalModel
    reduced: BlockReduced | None
    refined: RefinedModel | None
    criterion: float
    accepted: bool
    why: str

    @property
    def excess(self) -> float:
        """Chi2 over its degrees of freedom; NaN if not refined."""
        return self.refined.chi2 / max(self.refined.degrees_of_freedom, 1) if self.refined else nan

    def motors_off(self, prior: MachineModel) -> float:
        """Largest relative difference of a motor mass from the prior's."""
        if self.refined is None:
            return inf
        pairs = zip(self.refined.model.axes, prior.axes, strict=True)
        return max(abs(a.masses[0].value / b.masses[0].value - 1.0) for a, b in pairs)

    @property
    def structure(self) -> float:
        """Misfit of the structure, like chi2; what orders the trials before refinement."""
        return inf if self.reduced is None else self.reduced.misfit

    @property
    def unevenness(self) -> float:
        """Sum over all chains of squared logarithms of masses and springs over their mean."""
        machine = self.refined or self.reduced
        if machine is None:
            return inf
        total = 0.0
        for axis in machine.model.axes:
            for chain in (axis.masses, axis.springs):
                logs = np.log([e.value for e in chain]) if chain else np.zeros(1)
                total += float(np.sum((logs - logs.mean()) ** 2))
        return total


def reduced_trial(modal: ModalModel, kinds: Mapping[str, Kind], lengths: tuple[int, ...]) -> Trial:
    """Return the chains of these lengths that the modes say, not refined yet."""
    masses = dict(zip(modal.names, lengths, strict=True))
    try:
        reduced = reduce_blocks(modal, masses, kinds)
    except NotAChainError as error:
        return Trial(lengths, modal, None, None, inf, False, str(error))
    why = (
        f"not refined: modes differ from those of such chains by {sqrt(reduced.misfit):.3g} "
        f"standard errors"
    )
    return Trial(lengths, modal, reduced, None, inf, False, why)


def refined_trial(
    data: ResponseMatrix, trial: Trial, start: MachineModel, free: ModalModel | None = None
) -> Trial:
    """The trial refined; accepted if as good as free modes, its own where no others are given."""
    modal = free or trial.modal
    try:
        with np.errstate(all="ignore"):  # a start from afar may go astray, which chi2 tells
            found = refine(
                start,
                data,
                fit_delay=modal.parts.delay,
                fit_friction=True,
                fit_load_friction=True,
                delays=[float(d) for d in modal.delays],
            )
    except (FieldtoolError, np.linalg.LinAlgError) as error:
        return replace(trial, why=f"can not be refined: {error}")
    price = len(found.names) * log(max(data.count, 2))
    limit = min(_acceptable(modal, found), UNEXPLAINED * found.degrees_of_freedom)
    excess = found.chi2 / max(found.degrees_of_freedom, 1)
    why = f"misfit {sqrt(excess):.3g} times the noise, free modes {sqrt(modal.excess):.3g}"
    unknown = not_known(found.model)
    explains = found.chi2 <= limit
    if not explains:
        why = f"it does not explain the responses ({why})"
    elif unknown:
        why += f", but the responses do not tell {', '.join(unknown)}"
    accepted = explains and not unknown
    return replace(trial, refined=found, criterion=found.chi2 + price, accepted=accepted, why=why)


def not_known(model: MachineModel) -> list[str]:
    """Masses and springs whose standard error is half of them or more."""
    named = [
        (f"{axis.name} {what} {k}", each)
        for axis in model.axes
        for what, chain in (("mass", axis.masses), ("spring", axis.springs))
        for k, each in enumerate(chain, start=1)
    ]
    return [name for name, e in named if not e.std < UNKNOWN_ABOVE * e.value]


def _acceptable(modal: ModalModel, found: RefinedModel) -> float:
    """Largest chi2 of a machine that explains the responses as free modes do.

    A machine has fewer parameters than free modes, each of which may cost one unit; a tenth on
    top, as free modes may follow what is not linear.
    """
    unit = max(modal.excess, 1.0)
    dof = found.degrees_of_freedom
    fewer = max(dof - modal.degrees_of_freedom, 0)
    return max(
        modal.chi2 + unit * (fewer + SPREAD * sqrt(2.0 * max(fewer, 1))) + 0.1 * unit * dof,
        unit * (dof + SPREAD * sqrt(2.0 * dof)),
    )


def at_errors_of_the_method(trial: Trial) -> Trial:
    """Accept a simple machine whose misfit is small, though free modes follow what it leaves."""
    if trial.refined is None or not trial.excess < FAR or not_known(trial.refined.model):
        return trial
    why = f"misfit {sqrt(trial.excess):.3g} times the noise, more than that of free modes"
    return trial if trial.accepted else replace(trial, accepted=True, why=why)


def alike(trials: Sequence[Trial]) -> list[Trial]:
    """Accepted machines that the criterion can not tell from the best, each lengths once."""
    best_of: dict[tuple[int, ...], Trial] = {}
    for trial in sorted(trials, key=lambda t: t.criterion):
        if trial.accepted:
            best_of.setdefault(trial.lengths, trial)
    accepted = list(best_of.values())
    limit = accepted[0].criterion + DECISIVE * max(accepted[0].excess, 1.0)
    return [t for t in accepted if t.criterion < limit]


def lengths_of(model: MachineModel) -> tuple[int, ...]:
    """Return the number of masses of each axis."""
    return tuple(len(axis.masses) for axis in model.axes)
