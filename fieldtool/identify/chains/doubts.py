"""What may be wrong with a chosen number of masses, and why there may be none, in words."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

from fieldtool.errors import IdentificationError
from fieldtool.identify.chains.modal_chain import SEEN
from fieldtool.identify.chains.trial import DECISIVE, FAR, Trial, alike, not_known
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes.search import ModeSearch, standing_out

SUNK = 3.0
"""Standard errors below which a mode that is left out is noise, and not mentioned."""


@dataclass(frozen=True)
class ModeDoubt:
    """A mode that may be missing in the model, or may be none."""

    omega: float
    """rad/s."""
    in_model: bool
    sentence: str


def mode_doubts(search: ModeSearch, best: Trial) -> list[ModeDoubt]:
    """Modes that hardly rise out of the noise, are left out, or may be missing."""
    if max(best.lengths) == 1 and best.excess < FAR:
        return []  # what is left is noise and errors of the method, which free modes follow
    doubts = []
    larger = max((search.modal, best.modal), key=lambda modal: modal.omega.size)
    for w, seen in zip(larger.omega, standing_out(larger), strict=True):
        left_out = not np.any(np.abs(best.modal.omega - w) < 0.02 * w)
        if left_out and seen < SUNK:
            continue
        if seen < SEEN or left_out:
            sentence = (
                f"the mode at {w / (2 * pi):.4g} Hz is in doubt: it stands "
                f"{seen:.2g} standard errors out of the noise, {SEEN:.0f} are needed"
                + ("; the model does without it" if left_out else "")
                + "; excite more strongly or longer there"
            )
            doubts.append(ModeDoubt(float(w), not left_out, sentence))
    if search.hint is not None and not np.any(
        np.abs(best.modal.omega - search.hint) < 0.05 * search.hint
    ):
        sentence = (
            f"the responses hint at a further mode near {search.hint / (2 * pi):.4g} Hz "
            f"({sqrt(search.hint_chi2):.2g} standard errors), which is not in the model; excite "
            "more strongly there, or look for what is not linear"
        )
        doubts.append(ModeDoubt(search.hint, False, sentence))
    return doubts


def other_doubts(
    data: ResponseMatrix, best: Trial, trials: Sequence[Trial], decided: str
) -> list[str]:
    """Other lengths that explain the responses nearly as well, and a large misfit."""
    doubts = []
    rivals = [t for t in alike(trials) if t.lengths != best.lengths]
    if rivals:
        listed = "; or ".join(_listed(data.names, t.lengths) for t in rivals)
        nearest = min(t.criterion for t in rivals) - best.criterion
        doubts.append(
            f"the responses can hardly tell the masses {_listed(data.names, best.lengths)} from "
            f"{listed} (criterion {nearest:+.2g}, {DECISIVE:.0f} are decisive): {decided}; give the "
            "number of masses of an axis where it is known"
        )
    if best.excess > FAR:
        doubts.append(
            f"the misfit is {sqrt(best.excess):.3g} times the noise: something is not linear or changes "
            "with time, or the noise is larger than stated; standard errors are enlarged by it"
        )
    return doubts


def _listed(names: Sequence[str], lengths: Sequence[int]) -> str:
    return ", ".join(f"{name} {n}" for name, n in zip(names, lengths, strict=True))


def nothing_fits(
    names: Sequence[str], search: ModeSearch, trials: Sequence[Trial], most: int
) -> IdentificationError:
    """Return the error of responses that no machine explains: how many modes, and what is closest."""
    modes = search.modal.omega.size
    where = ", ".join(f"{w / (2 * pi):.4g}" for w in sorted(np.abs(search.modal.omega)))
    found = f"the responses hold {modes} modes" + (f" (at {where} Hz)" if modes else "")
    if not trials or modes > most:
        return IdentificationError(
            f"{found}, more than the {most} that the given numbers of masses allow; allow longer "
            "chains or more masses"
            if modes > most
            else f"{found}, which the given numbers of masses do not allow; leave them open, or "
            "excite the modes that are missing more strongly"
        )
    nearest = min(trials, key=lambda t: (t.criterion, t.structure))
    notes = nearest.reduced.notes if nearest.reduced is not None else ()
    detail = f"; {notes[0]}" if notes else ""
    unknown = nearest.refined is not None and not_known(nearest.refined.model)
    return IdentificationError(
        f"{found}, but no machine of chains that are coupled at their last masses explains them"
        f"{' with all masses and springs known' if unknown else ''}; "
        f"closest are the masses {_listed(names, nearest.lengths)}: {nearest.why}{detail}"
    )
