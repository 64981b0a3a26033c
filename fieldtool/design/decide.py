"""From what a search found to what is written: rounded, checked again, compared, explained."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite

import numpy as np

from fieldtool.design.design import Advance, Softer, Task, find
from fieldtool.design.drive_side import DriveSide
from fieldtool.design.given_up import STIFFEST, given_up, no_sooner
from fieldtool.design.held import held
from fieldtool.design.loops import Loops, system_matrix
from fieldtool.design.machine import Machine, machine_of, respond
from fieldtool.design.margins import margins_of
from fieldtool.design.moves import TestMove, typical_move
from fieldtool.design.no_worse import is_slower, no_worse, predicted
from fieldtool.design.nonlinear import notes_of
from fieldtool.design.notes import drive_notes
from fieldtool.design.predict import Prediction, frequencies
from fieldtool.design.robust import SLACK
from fieldtool.design.rule import DesignError, check_masses, lowest_antiresonance
from fieldtool.design.search import slots_of
from fieldtool.design.servo import Servo
from fieldtool.design.shaping import Shaping, best_shaper
from fieldtool.design.start import slower
from fieldtool.design.tuning import (
    BOUND,
    MOST_BOUND,
    RESPONSES,
    SOFTEST,
    AxisTuning,
    Choice,
    TradePoint,
    Tuning,
    as_parameters,
)
from fieldtool.records.model import FloatArray, MachineModel

TRADE = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
SEED = 20
NARROWER = 0.99
"""Times the bandwidth of a softer response that one has at least."""
KEPT = "nothing better than the present parameters was found: they are kept."
SWINGS = 0.25
"""Damping ratio below which a vibration is left to shape."""


def design(
    model: MachineModel,
    sides: Sequence[DriveSide] | None = None,
    moves: Sequence[TestMove] | None = None,
    *,
    response: str = "normal",
    bound: float = BOUND,
    top: float | None = None,
    seed: int = SEED,
    advance: Advance = lambda *_: None,
    compare: bool = False,
) -> Tuning:
    """Return parameters for every axis of an identified machine, and what they will do.

    Parameters
    ----------
    model
        The machine, with standard errors where they are known.
    sides
        One an axis, in the model's order: what its drive can hold; None: drives that can hold
        everything, with cautious timing.
    moves
        One an axis: what is to be fast; None: moves that suit the model.
    response
        ``soft``, ``normal`` or ``stiff``.
    bound
        Peak of sensitivity that no axis may exceed, above 1; ``soft`` and ``normal`` stay below.
    top
        Highest frequency at which the model was measured, Hz; None: three times its highest mode.
    seed
        Of the machines that are drawn from the uncertainty.
    advance
        Told what is done, and a number from 0 to 1.
    compare
        Whether responses that are stiffer than the chosen one are computed, too; softer ones are
        anyhow.  The parameters are the same.

    Raises
    ------
    DesignError
        If the model is no machine; a drive has no gains to write; the margin can not be kept within
        the model's uncertainty or the drives' ranges; or the result would be worse than what the
        drives have.  Nothing is written then.
    """
    check_masses(model)
    if response not in RESPONSES:
        raise DesignError(f"no response {response!r}; there are {', '.join(RESPONSES)}.")
    allowed = 1 + (bound - 1) * RESPONSES[response]
    if not allowed > 1.05:
        raise DesignError(
            f"a peak of sensitivity of {allowed:.3g} is below what any loop has; choose --bound above "
            "1.1."
        )
    if not bound <= MOST_BOUND:
        raise DesignError(
            f"a bound of {bound:.3g} leaves no margin; choose --bound up to {MOST_BOUND:g}."
        )
    sides = [DriveSide(axis.name) for axis in model.axes] if sides is None else list(sides)
    moves = default_moves(model, sides) if moves is None else tuple(moves)
    limit = None if top is None else 2 * np.pi * top
    softer: Softer | None = None
    rooms = {name: 1 + (bound - 1) * share for name, share in RESPONSES.items()}
    names = [name for name in RESPONSES if compare or RESPONSES[name] <= RESPONSES[response]]
    choices = {name: Choice(name, room) for name, room in rooms.items()}
    results: dict[str, _Result] = {}
    for k, name in enumerate(names):

        def part(text: str, share: float, k: int = k, name: str = name) -> None:
            advance(f"{name}: {text}", (k + share) / len(names))

        room = rooms[name]
        try:
            task = find(model, sides, moves, room, limit, seed, part, softer)
            task.most = room if name == SOFTEST else bound
            task.softens = name == SOFTEST
            result = _at(task)
        except DesignError as error:
            if name == response:
                raise
            choices[name] = replace(choices[name], refused=str(error))
            continue  # what is softer may ask for too much
        softer = Softer(result.servos, result.prediction, result.instead or name)
        kept = tuple(sides[axis].axis for axis in sorted(result.kept))
        choices[name] = Choice(name, room, result.prediction, kept, result.instead)
        results[name] = result
    return replace(_tuning(results[response], response), responses=tuple(choices.values()))


def default_moves(model: MachineModel, sides: Sequence[DriveSide]) -> tuple[TestMove, ...]:
    """Return moves for a model alone: a radian in some periods of its lowest mode."""
    modes = machine_of(model).modes
    w = float(modes[0]) if modes.size else 20.0
    moves = []
    for axis, side in zip(model.axes, sides, strict=True):
        torque = side.torque_limit if isfinite(side.torque_limit) else inf
        fast = typical_move(axis.name, (0.0, 1.0), 2.0 * w, 0.2 * w * w, torque, axis.total_mass)
        moves.append(fast)
    return tuple(moves)


@dataclass(frozen=True, eq=False)
class _Result:
    """What one response came to."""

    task: Task
    servos: tuple[Servo, ...]
    """As the drives hold them."""
    prediction: Prediction
    kept: frozenset[int]
    """Axes whose present parameters are kept."""
    instead: str = ""
    """Softer response whose parameters these are, for nothing better keeps the margin; empty: none."""


def _at(task: Task) -> _Result:
    """Return what is written of a task's controllers: rounded, no worse than present and softer ones.

    Raises
    ------
    DesignError
        As :func:`design`.
    """
    task.advance("round, check and predict", 0.95)
    softer = task.softer
    try:
        chosen, kept = no_worse(task, *held(task))
    except DesignError:
        if softer is None or is_slower(task, softer.servos):
            raise
        return _as_soft(task, softer)
    prediction = predicted(task, chosen)
    if (
        softer is not None
        and any(
            axis.margins.bandwidth < NARROWER * width
            for axis, width in zip(prediction.axes, softer.bandwidths, strict=True)
        )
        and not is_slower(task, softer.servos)
    ):
        return _as_soft(task, softer)
    return _Result(task, chosen, prediction, kept)


def _as_soft(task: Task, softer: Softer) -> _Result:
    """Return what a softer response came to, with the axes that keep their present parameters."""
    present = task.present or ()
    pairs = enumerate(zip(softer.servos, present, strict=False))
    same = frozenset(k for k, (one, now) in pairs if one == now)
    return _Result(task, softer.servos, predicted(task, softer.servos), same, softer.name)


def _tuning(result: _Result, response: str) -> Tuning:
    task, servos, prediction, kept = result.task, result.servos, result.prediction, result.kept
    softer = task.softer
    axes = []
    now = task.present
    present = predicted(task, now, spread=False) if now else None
    notes = list(notes_of(task.model, servos, task.moves))
    if result.instead:
        notes.append(
            f"A {response} response that is nowhere slower was not found within its margin on all "
            f"machines that the model allows: these are the {result.instead} one's parameters."
        )
    for k, (side, servo, axis) in enumerate(zip(task.sides, servos, prediction.axes, strict=True)):
        parameters = side.held(as_parameters(servo, side))
        if k in kept and side.present:
            parameters = {n: v for n, v in side.present.items() if n in parameters}
        reason = KEPT if k in kept else _reason(task, k, servo)
        peak = axis.margins.sensitivity_peak
        axes.append(AxisTuning(side.axis, parameters, peak, reason, task.model.axes[k].kind))
        notes += drive_notes(side, axis, {} if k in kept else parameters)
        if now and present and present.stable and k not in kept:
            notes += given_up(side, axis, present.axes[k], (servo, now[k]), response)
        if response == STIFFEST and softer is not None and servo != softer.servos[k]:
            notes += no_sooner(side, axis, softer.prediction.axes[k], (response, softer.name))
    if kept:
        names = ", ".join(task.sides[k].axis for k in sorted(kept))
        notes.append(f"{names}: {KEPT}")
    if task.bound > BOUND:
        notes.append(
            f"The peak of sensitivity may be up to {task.bound:.3g} here, above {BOUND:g}: these "
            "parameters may be tried on the machine, and are never stored."
        )
    peaks = [prediction.axes[k].margins.sensitivity_peak for k in kept]
    return Tuning(
        tuple(axes),
        response,
        task.most if max(peaks, default=0.0) > SLACK * task.bound else task.bound,
        task.moves,
        prediction,
        present,
        _trade(task, servos),
        tuple(_shaping(task, servos, prediction)),
        tuple(dict.fromkeys(notes)),
        by_hand=tuple(side.axis for side in task.sides if side.missing),
    )


def _reason(task: Task, k: int, servo: Servo) -> str:
    axis = task.model.axes[k]
    lowest = lowest_antiresonance(axis) / (2 * np.pi)
    at = f"lowest antiresonance {lowest:.3g} Hz" if np.isfinite(lowest) else "a rigid axis"
    kinds = slots_of(servo)
    at_hz = [np.sqrt(f.denominator[1]) / (2 * np.pi) for f in servo.loop.filters]
    filters = ", ".join(f"{kind} at {f:.3g} Hz" for kind, f in zip(kinds, at_hz, strict=True))
    heavy = f"total inertia {axis.total_mass:.4g} kg m2"
    if axis.kind == "linear":
        heavy = f"total mass {axis.total_mass:.4g} kg"
    return (
        f"{heavy}, {at}: optimised for a peak of sensitivity of at most "
        f"{task.bound:.3g} on {len(task.machines)} machines within the model's uncertainty; "
        f"{filters or 'no filter'}."
    )


def _trade(task: Task, servos: tuple[Servo, ...]) -> tuple[TradePoint, ...]:
    """Return what scaling all gains does to bandwidth and margin."""
    machine, out = task.machines[0], []
    for factor in TRADE:
        scaled = tuple(slower(servo, factor) for servo in servos)
        values = np.linalg.eigvals(system_matrix(machine, scaled)).astype(np.complex128)
        if values.real.max() >= 1e-9 * np.abs(values).max():
            nothing = (0.0,) * len(servos)
            out.append(TradePoint(factor, nothing, (inf,) * len(servos)))
            continue
        loops = Loops(respond(machine, frequencies(machine, values)), scaled)
        found = [
            margins_of(loops.response.omega, loops.sensitivity[:, k]) for k in range(len(servos))
        ]
        out.append(
            TradePoint(
                factor,
                tuple(m.bandwidth for m in found),
                tuple(m.sensitivity_peak for m in found),
            )
        )
    return tuple(out)


def _shaping(task: Task, servos: tuple[Servo, ...], prediction: Prediction) -> list[Shaping]:
    """Return advice for the axes whose last mass is left swinging outside of its band."""
    out = []
    for k, (axis, move) in enumerate(zip(prediction.axes, task.moves, strict=True)):
        if axis.load is None or axis.load.residual_peak < 0.5 * move.settling_band:
            continue
        found = [swing(machine, servos, k) for machine in task.machines]
        likely = [one for one in found if one is not None]
        if found[0] is not None:
            frequencies_ = np.array([f for f, _ in likely])
            unit = "m" if task.model.axes[k].kind == "linear" else "rad"
            out.append(best_shaper(axis.axis, frequencies_, found[0][1], move.acceleration, unit))
    return out


def swing(machine: Machine, servos: tuple[Servo, ...], axis: int) -> tuple[float, float] | None:
    """Return frequency (Hz) and damping of the vibration that an axis' reference excites most.

    None where all of them are well damped.  It is the largest residue of the last mass per
    reference among the closed loops' eigenvalues.
    """
    values = np.linalg.eigvals(system_matrix(machine, servos)).astype(np.complex128)
    light = values[(values.imag > 0) & (-values.real < SWINGS * np.abs(values))]
    if light.size == 0:
        return None
    omega: FloatArray = np.abs(light.imag)
    loops = Loops(respond(machine, omega), servos)
    load = np.abs(loops.motion(axis, servos[axis].reference_gain(1j * omega))[1])
    # height of the peak times its width, over what a move excites there
    size = load * np.abs(light.real) / omega**2
    k = int(np.argmax(size))
    return float(np.abs(light[k]) / (2 * np.pi)), float(-light[k].real / np.abs(light[k]))
