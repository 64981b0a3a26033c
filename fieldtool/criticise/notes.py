"""What a reader of a criticism has to know of the recording."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.evidence.spans import Spans
from fieldtool.criticise.search.prepare import Prepared
from fieldtool.frf.multisine.period import quantum
from fieldtool.records.recording import Recording

FloatArray = NDArray[np.float64]
FLAT = 0.02
"""Share of rows at one largest torque from which it is said that the drive was at its limit."""
SAME = 0.999
"""Of the largest torque: what is more is the same."""
NEAR = 0.95
"""Of the limit that the recording states: a largest torque that may be it."""
QUANTA, CREST = 20, 1.5
"""Largest torque over its smallest step, and over its RMS, from which it may be an unstated limit.

A torque that is the same all the time (dry friction at constant speed), or a sine, has no more."""


def notes_of(recording: Recording, prepared: Prepared, unknown: Sequence[str]) -> tuple[str, ...]:
    """Say how the data are cut, whether the noise is known, and what of each axis is not as it might be.

    Parameters
    ----------
    recording : Recording
    prepared : Prepared
    unknown : sequence of str
        Axes whose noise the data that they are judged by do not tell.
    """
    spans = prepared.spans
    notes = []
    if spans.split == "time":
        seconds = sum(s.stop - s.start for s in spans.spans if s.role == "unseen")
        notes.append(
            "There are no experiments of a kind twice, so the data are cut in time: "
            f"{seconds * recording.sample_period:.3g} s are kept unseen, in {_stretches(spans)}."
        )
    if unknown and any(s.periods < 2 for s in spans.spans):
        why = (
            f"{'Not every' if any(s.periods > 1 for s in spans.spans) else 'No'} stretch that is "
            "compared holds a period twice"
            if any(e.period for e in recording.experiments if e.kind == "multisine")
            else "The excitation does not repeat"
        )
        of = "" if len(unknown) == len(recording.axes) else f" of {', '.join(unknown)}"
        notes.append(
            f"{why}, so the noise{of} is not known: what is not explained may in part be noise."
        )
    for k, axis in enumerate(recording.axes):
        if axis.controller is None:
            notes.append(
                f"{axis.name}: the recording states no controller; the error of its position is that in "
                "open loop, at excited frequencies."
            )
        torques = [motion.torque[:, k] for motion in prepared.motions.values()]
        limit = axis.controller.torque_limit if axis.controller is not None else 0.0
        share = share_at_limit(torques, limit)
        if share > FLAT:
            notes.append(
                f"{axis.name}: its torque is at the same largest value in {100 * share:.0f} % of the "
                "rows: the drive was at its limit there."
            )
    return tuple(notes)


def _stretches(spans: Spans) -> str:
    count = sum(s.role == "unseen" for s in spans.spans)
    return "one stretch" if count == 1 else f"{count} stretches"


def share_at_limit(torques: Sequence[FloatArray], limit: float = 0.0) -> float:
    """Return the share of rows at the very largest torque of an axis, one after another.

    Parameters
    ----------
    torques : sequence of ndarray
        Of one axis, one an experiment.
    limit : float
        As the recording states it; 0 where it does not.

    Returns
    -------
    float
        0 where the largest torque is none that a drive is likely to end at.
    """
    whole = np.concatenate(torques)
    size = np.abs(whole)
    largest = float(size.max())
    stated = limit > 0.0 and largest >= NEAR * limit
    tops = largest > CREST * np.sqrt(np.mean(whole**2)) and largest >= QUANTA * quantum(whole)
    if largest == 0.0 or not (stated or tops):
        return 0.0
    flat = 0
    for torque in torques:
        at = np.abs(torque) >= SAME * largest
        flat += int(np.sum(at[1:] & at[:-1]))
    return flat / whole.size
