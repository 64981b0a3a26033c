"""How well further data would tell a cause from its rivals: tried in simulation, before anything moves.

The rivals are fitted to the data at hand.  For a motion that is planned, the torque is that which the
cause asks for, with noise as it was measured; then the cause and each rival are fitted to
all of it together, as a criticism will do.  What the rival's sum of squares is larger by is the
evidence to expect (discrimination by the largest expected difference: Atkinson and Fedorov, The
design of experiments for discriminating between two rival models, Biometrika 62, 1975).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.criticism import Cause, Criticism, Rival
from fieldtool.criticise.effects import candidates
from fieldtool.criticise.search.fit import Fitted, fit
from fieldtool.criticise.search.hypothesis import Hypothesis, Simulator
from fieldtool.criticise.search.prepare import Prepared, prepare
from fieldtool.criticise.search.screen import screened, tangent
from fieldtool.criticise.search.search import settled
from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.velocity_band import white_noise
from fieldtool.records.model import MachineModel
from fieldtool.records.recording import Experiment, Recording

FloatArray = NDArray[np.float64]
Key = tuple[str, int, str, int | None]
DECISIVE = 30.0
"""Difference of the sums of squares from which two rivals are told apart: odds of e to the 15th."""
SEED = 3
"""Of the noise of data that are expected: the same question has the same answer."""


@dataclass(frozen=True, eq=False)
class Separation:
    """A cause and its rivals, fitted to the data at hand."""

    recording: Recording
    model: MachineModel
    cause: Fitted
    rivals: tuple[Fitted, ...]
    rows: int
    """Numbers that are compared."""
    misfit: float
    """Sum of squares a number that the cause leaves at hand, at least 1: more than noise counts less."""

    def expected(self, experiments: Sequence[Experiment]) -> float:
        """Return the least evidence against a rival that new experiments would bring.

        Parameters
        ----------
        experiments : sequence of Experiment
            With the positions to expect, and the torques by the machine without effects.

        Returns
        -------
        float
            To be compared with :data:`DECISIVE`.
        """
        rng = np.random.default_rng(SEED)
        noises = [
            np.median([white_noise(getattr(e, what)) for e in self.recording.experiments], axis=0)
            for what in ("position", "torque")
        ]
        blurred = [
            replace(e, position=e.position + noises[0] * rng.normal(size=e.position.shape))
            for e in experiments
        ]
        prepared = self._prepared(blurred)
        truth = _moved(prepared, self.cause.hypothesis)
        asked = []
        for e in blurred:
            torque = prepared.simulator.torque(truth, prepared.motions[e.name])
            asked.append(replace(e, torque=torque + noises[1] * rng.normal(size=torque.shape)))
        prepared = self._prepared(asked)
        costs = [
            fit(prepared.simulator, _moved(prepared, one.hypothesis)).cost
            for one in (self.cause, *self.rivals)
        ]
        gained = [
            (cost - costs[0]) / self.misfit - max(0.0, (rival.cost - self.cause.cost) / self.misfit)
            for cost, rival in zip(costs[1:], self.rivals, strict=True)
        ]
        return float(min(gained))

    def measured(self) -> tuple[int, float]:
        """Return which explains the data at hand best (0: the cause, then the rivals), and the evidence.

        The evidence is what the next best's sum of squares is larger by, over what the best leaves; see
        :data:`DECISIVE`.
        """
        costs = np.array([one.cost for one in (self.cause, *self.rivals)])
        best = int(np.argmin(costs))
        misfit = max(1.0, float(costs[best]) / max(self.rows, 1))
        return best, float(np.delete(costs, best).min() - costs[best]) / misfit

    def _prepared(self, experiments: Sequence[Experiment]) -> Prepared:
        both = replace(self.recording, experiments=(*self.recording.experiments, *experiments))
        return _seen(prepare(both, self.model))


def separation(
    recording: Recording,
    model: MachineModel,
    criticism: Criticism,
    cause: Cause,
    advance: Callable[[str, float], None] = lambda *_: None,
) -> Separation:
    """Fit a cause, beside all others, and each of its rivals to the data at hand.

    Parameters
    ----------
    recording : Recording
        The one that was criticised.
    model : MachineModel
        Its chains and couplings, without effects.
    criticism, cause
        With a tie.
    advance : callable
        Told what is done, and a number from 0 to 1.

    Raises
    ------
    NotEnoughDataError
        If one of them can not be tried on this recording.
    """
    advance("fit the machine", 0.0)
    prepared, current = settled(*_started(_seen(prepare(recording, model))))
    names = recording.names
    others = [c for c in criticism.causes if c is not cause]
    for k, one in enumerate(others):
        advance(f"fit {one.effect}", 0.1 + 0.3 * k / len(others))
        current = _with(prepared, current, _key(names, one))
    tried = []
    wanted: list[Cause | Rival] = [cause, *cause.ties]
    for k, rival in enumerate(wanted):
        advance(f"fit {rival.effect}", 0.4 + 0.6 * k / len(wanted))
        tried.append(_with(prepared, current, _key(names, rival)))
    rows = prepared.simulator.degrees("fit")
    misfit = max(1.0, tried[0].cost / max(rows, 1))
    return Separation(recording, model, tried[0], tuple(tried[1:]), rows, misfit)


def _started(prepared: Prepared) -> tuple[Prepared, Hypothesis]:
    return prepared, prepared.start


def _seen(prepared: Prepared) -> Prepared:
    """Return the same with nothing kept unseen."""
    spans = replace(
        prepared.spans, spans=tuple(replace(s, role="fit") for s in prepared.spans.spans)
    )
    lines = tuple(
        replace(one, span=replace(one.span, role="fit")) for one in prepared.simulator.lines
    )
    return replace(prepared, spans=spans, simulator=Simulator(prepared.motions, lines))


def _moved(prepared: Prepared, hypothesis: Hypothesis) -> Hypothesis:
    """Return a hypothesis about the same machine, for other data."""
    return replace(hypothesis, machine=prepared.start.machine)


def _key(names: Sequence[str], one: Cause | Rival) -> Key:
    axes = (one.axis,) if isinstance(one.axis, str) else one.axis
    missing = [a for a in axes if a not in names]
    if missing:
        raise NotEnoughDataError(
            f"the criticism speaks of axis {missing[0]}, the recording has {', '.join(names)}."
        )
    places = [names.index(a) for a in axes]
    return one.effect, places[0], one.location, places[1] if len(places) > 1 else None


def _with(prepared: Prepared, current: Fitted, key: Key) -> Fitted:
    """Fit one more effect, from its best start."""
    hypothesis = current.hypothesis
    pool = [e for e in candidates(prepared.context(hypothesis)) if e.key[:4] == key]
    if not pool:
        raise NotEnoughDataError(
            f"{key[0]} of {prepared.recording.names[key[1]]} can not be tried on this recording, "
            "so nobody can say what would tell it apart. Criticise it again first."
        )
    at = tangent(prepared.simulator, hypothesis)
    ranked = screened(prepared.simulator, at, pool, lambda _: None)
    if not ranked:
        return fit(prepared.simulator, hypothesis.with_effect(pool[0]))
    grown = hypothesis.with_effect(ranked[0].effect)
    grown = replace(grown, values=(*grown.values[:-1], ranked[0].start))
    return fit(prepared.simulator, grown, shared=at.of_machine)
