"""Criticise a model with a recording: where it is wrong, why, and what is gained by knowing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.changes import change_sentences
from fieldtool.criticise.criticism import (
    Cause,
    Criticism,
    HeldOut,
    Judged,
    Rejected,
    Rival,
    SignalError,
    Verdict,
)
from fieldtool.criticise.effects import LIBRARY
from fieldtool.criticise.effects.base import Context, Effect
from fieldtool.criticise.evidence.position import position_error
from fieldtool.criticise.extension import extended_model
from fieldtool.criticise.notes import notes_of
from fieldtool.criticise.numbers import numbers_of
from fieldtool.criticise.search.afterwards import FALSE_ZERO, Accepted
from fieldtool.criticise.search.fit import Fitted
from fieldtool.criticise.search.judge import Parts
from fieldtool.criticise.search.machine import Machine
from fieldtool.criticise.search.marks import Unmarked
from fieldtool.criticise.search.prepare import Prepared, prepare
from fieldtool.criticise.search.rules import LEFT, NO_MORE
from fieldtool.criticise.search.search import Advance, Found, search
from fieldtool.criticise.simulate.inverse import needed_torque
from fieldtool.criticise.simulate.structure import Structure
from fieldtool.criticise.tell_apart import experiment_for
from fieldtool.criticise.where.sentences import AxisError, axis_errors
from fieldtool.errors import NotEnoughDataError
from fieldtool.records.model import Estimate, MachineModel
from fieldtool.records.recording import Recording

FloatArray = NDArray[np.float64]
SMALL_UNSURE = 0.01
"""Error of the torque that does not matter, where its noise is not known."""
NEAR_NOISE = 1.5
"""Error over noise (RMS) up to which it is all noise."""
ENOUGH, ENOUGH_KNOWN, ENOUGH_SURE = 0.9, 0.97, 0.98
"""Share of the explainable error that has to be explained for "explained": where the noise is not known,
where it is, and where it is and the causes' forms are no approximations."""
STRONG = 0.01
"""Of the power of the strongest line of a motion: lines that units are judged by."""
OTHER_UNIT = 5.0
"""Factor between measured and needed torque from which it is no fault of the machine."""
MORE = 2.0
"""Error of all data over that of the unseen ones from which both are told."""
NOTHING_UNSEEN = "there are no unseen data of it, so no cause of it can be shown"
"""Of an axis of whose torque the unseen data tell nothing."""


@dataclass(frozen=True, eq=False)
class Criticised:
    """A criticism, and what pictures are drawn from."""

    criticism: Criticism
    found: Found
    before: tuple[AxisError, ...]
    after: tuple[AxisError, ...]


def criticise(
    recording: Recording,
    model: MachineModel,
    prior: MachineModel | None = None,
    without: frozenset[str] = frozenset(),
    advance: Advance = lambda *_: None,
    contiguous: bool = False,
) -> Criticised:
    """Say what a model gets wrong of a recording, and why.

    Parameters
    ----------
    recording : Recording
        Own or imported; in open or closed loop.
    model : MachineModel
        The identified machine: its masses, springs, dampers and couplings are where the fit starts.
        Effects in it are tried anew, so that each name has its evidence.
    prior : MachineModel, optional
        The machine as last accepted.  What it has of friction and couplings belongs to the
        machine; what the model has beyond has to be found as a cause.
    without : frozenset of str
        Effects that are not tried.
    advance : callable
        Told what is done, and how much of all: a number from 0 to 1.
    contiguous : bool
        Where the recording has to be cut in time, keep its last third unseen in one piece.

    Raises
    ------
    NotEnoughDataError
        If nothing can be compared, or the model is of other axes.
    """
    prepared = prepare(recording, starting_model(model, prior), contiguous)
    check_units(prepared)
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            found = search(prepared, without, advance, _accepted_base(prepared, model, prior))
    except np.linalg.LinAlgError as error:
        raise NotEnoughDataError(
            "the simulated machine runs away, so nothing can be compared: its model is no "
            "machine that can stand still. Identify it with other numbers of masses (`fieldtool "
            "identify FOLDER --masses AXIS=N`), then criticise again."
        ) from error
    prepared = found.prepared
    before = _axis_errors(found, found.before)
    if all(e.data == "nothing" for e in before):
        raise NotEnoughDataError(
            f"{before[0].sentence}. So it is with all axes: nothing is criticised."
        )
    after = _axis_errors(found, found.after)
    causes = tuple(_cause(found, a, recording) for a in found.accepted)
    held = _held_out(found, before, after)
    zeros = _false_zeros(found)
    verdict, decide = _verdict(causes, held, zeros, after)
    untold = frozenset(e.axis for e in after if e.data != "unseen")
    return Criticised(
        Criticism(
            verdict=verdict,
            where=tuple(e.sentence for e in before),
            causes=causes,
            unexplained=(
                *(
                    f"{e.sentence}; {NOTHING_UNSEEN}" if e.axis in untold else e.sentence
                    for e in after
                    if _matters(e.error, e.noise)
                    or (e.axis in decide and _beyond_noise(e.error, e.noise))
                ),
                *(_unmarked(found, u) for u in found.unmarked if verdict != "adequate"),
                *(zeros.values() if causes else ()),
            ),
            held_out=held,
            rejected=tuple(
                _rejected(e, _axis(recording.names, e), why, untold)
                for e, why in found.rejected
                if why
            ),
            changes=() if prior is None else change_sentences(prior, model),
            model=extended_model(found, recording.names),
            band=(0.0, prepared.spans.top),
            judged={
                b.axis: _judged(b, a, a.axis in decide) for b, a in zip(before, after, strict=True)
            },
            notes=(
                *notes_of(recording, found.prepared, _of_unknown_noise(after)),
                *(_untold(e) for e in after if e.data == "all"),
                *(_more_in_all(e) for e in after if _shows_less(e)),
            ),
        ),
        found,
        before,
        after,
    )


def starting_model(model: MachineModel, prior: MachineModel | None) -> MachineModel:
    """Return what a search starts from: the model without effects, and able to stand still.

    Parameters
    ----------
    model : MachineModel
    prior : MachineModel, optional
        What it has of friction and couplings belongs to the machine.
    """
    return _settling(_bare(model, prior))


def _bare(model: MachineModel, prior: MachineModel | None) -> MachineModel:
    """Return the model without what has to be found as a cause."""
    if prior is None or prior.names != model.names:
        return replace(model, effects=())
    axes = []
    for axis, accepted in zip(model.axes, prior.axes, strict=True):
        known = {
            name: accepted_one
            if accepted_one.value == 0.0 or getattr(axis, name).value == 0.0
            else getattr(axis, name)
            for name in ("viscous_friction", "load_friction")
            for accepted_one in [getattr(accepted, name)]
        }
        axes.append(replace(axis, **known))
    found = {frozenset(c.axes): c for c in model.couplings}
    couplings = tuple(found.get(frozenset(c.axes), c) for c in prior.couplings if c.value != 0.0)
    return replace(model, axes=tuple(axes), couplings=couplings, effects=())


def _settling(model: MachineModel) -> MachineModel:
    """Return the model without dampers and frictions below zero, from which hidden masses run away.

    An identification gives such where a delay or a lag, which it does not know of, undoes damping.
    """
    axes = tuple(
        replace(
            axis,
            dampers=tuple(_not_negative(d) for d in axis.dampers),
            viscous_friction=_not_negative(axis.viscous_friction),
            load_friction=_not_negative(axis.load_friction),
        )
        for axis in model.axes
    )
    return replace(model, axes=axes)


def _not_negative(estimate: Estimate) -> Estimate:
    return replace(estimate, value=max(estimate.value, 0.0))


def _accepted_base(
    prepared: Prepared, model: MachineModel, prior: MachineModel | None
) -> FloatArray | None:
    """Return the accepted machine's numbers in the order of those that are fitted, if they are alike."""
    if prior is None or prior.names != model.names:
        return None
    machine = prepared.start.machine
    accepted = Machine.of(_bare(prior, prior), np.ones(len(prior.axes)))
    values = {v.name: v.value for v in accepted.variables}
    if set(values) != set(machine.names):
        return None
    return np.array([values[name] for name in machine.names])


def check_units(prepared: Prepared) -> None:
    """Refuse a recording whose torques can not belong to its motions, by the model.

    A wrong scale of a torque or a new tool is a factor of two or so, a unit is one of 57 or 1000.

    Raises
    ------
    NotEnoughDataError
        Naming the axis, the factor, and the units that differ by it.
    """
    start = prepared.start
    structure = Structure.of(start.machine.with_values(start.base))
    torques = {name: needed_torque(structure, m) for name, m in prepared.motions.items()}
    for k, axis in enumerate(prepared.recording.axes):
        if axis.torque_unit == "A":
            continue  # how many N m an A is, nobody has said
        measured = needed = common = 0.0
        for name, motion in prepared.motions.items():
            moved, torque, wanted = (
                np.fft.rfft(course[:, k])[1:]
                for course in (motion.position, motion.torque, torques[name])
            )
            # where it hardly moves, its motion is an encoder's steps, differentiated twice
            power, strong = np.abs(torque) ** 2, np.abs(moved) ** 2
            strong = strong > STRONG * strong.max(initial=0.0)
            measured += float(power[strong].sum())
            needed += float((np.abs(wanted[strong]) ** 2).sum())
            common += float((torque[strong] * wanted[strong].conj()).sum().real)
        if needed <= 0.0 or measured <= 0.0 or common <= 0.0 or not np.isfinite(needed):
            continue
        # noise of either alone leaves one of them right
        factors = np.array([common / needed, measured / common])
        if np.all(factors > OTHER_UNIT) or np.all(factors < 1 / OTHER_UNIT):
            factor = float(factors[np.argmin(np.abs(np.log(factors)))])
            raise NotEnoughDataError(
                f"{axis.name}: its torque is {factor:.2g} times the one that its motion needs by "
                "the model. No machine changes by that much: the recording and the model are of "
                f"different machines, or a unit is wrong ({axis.position_unit} and "
                f"{axis.torque_unit} are stated; degrees would make a factor of 57, revolutions "
                "one of 6.3, thousandths one of 1000). Correct the units, then import and "
                "criticise again."
            )


def _all_parts(found: Found, fitted: Fitted) -> Parts:
    simulator = found.prepared.simulator
    return [
        *simulator.parts(fitted.hypothesis, "fit"),
        *simulator.parts(fitted.hypothesis, "unseen"),
    ]


def _axis_errors(found: Found, fitted: Fitted) -> tuple[AxisError, ...]:
    context = found.prepared.context(fitted.hypothesis)
    return axis_errors(context, _all_parts(found, fitted))


def _matters(error: float, noise: float | None) -> bool:
    """Whether an error is beyond noise, and large enough to be worth a word."""
    if noise is None:
        return error > SMALL_UNSURE
    return _beyond_noise(error, noise) and error**2 - noise**2 > LEFT**2


def _beyond_noise(error: float, noise: float | None) -> bool:
    return noise is not None and error > NEAR_NOISE * noise


def _axis(names: Sequence[str], effect: Effect) -> str | tuple[str, str]:
    if effect.other is None:
        return names[effect.axis]
    return names[effect.axis], names[effect.other]


def _cause(found: Found, accepted: Accepted, recording: Recording) -> Cause:
    tried = accepted.tried
    effect = tried.effect
    names = recording.names
    return Cause(
        effect.name,
        _axis(names, effect),
        effect.location,
        numbers_of(found.final, effect),
        _evidence(tried.torque, tried.gain.p, tried.gain.blocks, effect),
        tried.torque,
        tried.gain.p,
        tuple(
            Rival(
                t.effect.name,
                _axis(names, t.effect),
                t.effect.location,
                experiment_for(effect.name, t.effect.name),
            )
            for t in accepted.ties
        ),
    )


def _evidence(torque: float, p: float, blocks: int, effect: Effect) -> str:
    chance = "below 1e-12" if p < 1e-12 else f"{p:.1g}"
    return (
        f"on unseen data it explains {100 * torque:.2g} % of the torque (RMS) beside all other causes; "
        f"probability by chance {chance} over {blocks} stretches; signature: {effect.signature}"
    )


def _rejected(
    effect: Effect, axis: str | tuple[str, str], why: str, untold: frozenset[str]
) -> Rejected:
    if why == NO_MORE and untold.issuperset(np.atleast_1d(axis).tolist()):
        why = NOTHING_UNSEEN
    return Rejected(effect.name, axis, effect.location, why)


def _unmarked(found: Found, one: Unmarked) -> str:
    """Say what would fit, by its numbers and its signature, and why it has no name."""
    effect, mark = one.effect, one.mark
    numbers = ", ".join(
        f"{name} {n.value:.3g} {n.unit}" for name, n in numbers_of(one.fitted, effect).items()
    )
    others = f"{mark.relative} or {mark.or_else}" if mark.or_else else mark.relative
    axis = " - ".join(np.atleast_1d(_axis(found.prepared.recording.names, effect)))
    return (
        f"{axis}: {effect.signature}; {effect.name} would fit ({numbers}), but so might {others}, and "
        f"what tells them apart is not shown: {mark.words}"
    )


def _held_out(found: Found, before: Sequence[AxisError], after: Sequence[AxisError]) -> HeldOut:
    prepared = found.prepared
    errors = []
    for fitted, torques in ((found.before, before), (found.after, after)):
        parts = prepared.simulator.parts(fitted.hypothesis, "unseen")
        structure = Structure.of(fitted.hypothesis.machine.with_values(fitted.hypothesis.base))
        positions = position_error(structure, prepared.recording.axes, parts)
        errors.append(
            {
                t.axis: SignalError(t.error if t.data == "unseen" else None, p)
                for t, p in zip(torques, positions, strict=True)
            }
        )
    return HeldOut(
        prepared.spans.unseen(),
        prepared.spans.split,
        errors[0],
        errors[1],
        {e.axis: e.noise if e.data == "unseen" else None for e in after},
        {b.axis: _explained(b, a) for b, a in zip(before, after, strict=True)},
    )


def _explained(before: AxisError, after: AxisError) -> float:
    """Return the share of the power beyond noise; where no unseen data tell, nothing is explained."""
    floor = (after.noise or 0.0) ** 2
    could = before.error**2 - floor
    if before.data != "unseen" or could <= 0.0:
        return 0.0
    return float(np.clip((before.error**2 - max(after.error**2, floor)) / could, 0.0, 1.0))


def _judged(before: AxisError, after: AxisError, decides: bool) -> Judged:
    if after.data == "nothing":
        return Judged("nothing", None, None, None, decides)
    return Judged(after.data, before.error, after.error, after.noise, decides)


def _false_zeros(found: Found) -> dict[str, str]:
    """Say by axis of constant torques that are more than the zero of a measurement may be off."""
    hypothesis, said = found.after.hypothesis, {}
    machine = hypothesis.machine
    zeros = machine.offsets(hypothesis.base)
    for axis, variable, off in zip(
        found.prepared.recording.axes, machine.variables[-len(zeros) :], zeros, strict=True
    ):
        if abs(off) > FALSE_ZERO * variable.known * variable.scale:
            said[axis.name] = (
                f"{axis.name}: a constant torque of {off:.3g} {axis.torque_unit} is not explained; the "
                f"zero of its measurement should be right within {100 * variable.known:.2g} % of the "
                "largest torque"
            )
    return said


def _of_unknown_noise(errors: Sequence[AxisError]) -> list[str]:
    return [e.axis for e in errors if e.data != "nothing" and e.noise is None]


def _untold(error: AxisError) -> str:
    return (
        f"{error.axis}: the unseen data tell nothing of its torque; it is judged by data that fits have "
        "seen, and no cause of it can be shown. Another experiment of the same motion would test it."
    )


def _more_in_all(error: AxisError) -> str:
    overall, _ = error.overall
    return (
        f"{error.axis}: {100 * overall:.2g} % of the torque of all data is not explained, but "
        f"{100 * error.error:.2g} % of that of unseen data, by which it is judged: what is wrong of the "
        "seen ones shows less there. Another experiment of the same motion would test it."
    )


def _shows_less(error: AxisError) -> bool:
    """Whether all data have an error that the data which an axis is judged by hardly have."""
    return _matters(*error.overall) and error.overall[0] > MORE * error.error


def _verdict(
    causes: Sequence[Cause], held: HeldOut, zeros: Mapping[str, str], after: Sequence[AxisError]
) -> tuple[Verdict, frozenset[str]]:
    """Judge what is left of every axis on the data that it is judged by.

    Returns
    -------
    verdict, axes
        The axes but for which the verdict would be better.
    """
    left = frozenset(e.axis for e in after if _matters(e.error, e.noise))
    if not causes:
        return ("unexplained" if left else "adequate"), left
    short = set()
    for e in after:
        mine = [c for c in causes if e.axis in c.axes]
        # Beside a cause that has a name even little counts: it may be of another cause than of that one.
        if e.axis in left or (mine and _beyond_noise(e.error, e.noise)):
            sure = all(LIBRARY[c.effect].exact for c in mine)
            enough = ENOUGH if e.noise is None else ENOUGH_SURE if sure else ENOUGH_KNOWN
            if held.explained[e.axis] < enough:
                short.add(e.axis)
        if mine and e.axis in zeros:
            short.add(e.axis)
    return ("partly explained" if short else "explained"), frozenset(short)


def context_of(criticised: Criticised) -> Context:
    """Return what pictures of the error before are drawn from."""
    return criticised.found.prepared.context(criticised.found.before.hypothesis)
