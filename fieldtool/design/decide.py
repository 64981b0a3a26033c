"""From what a search found to what is written: rounded, checked again, compared, explained."""

from collections.abc import Mapping, Sequence
from math import inf

import numpy as np

from fieldtool.design.design import Advance, Task, default_moves, find, slower
from fieldtool.design.drive_side import DriveSide
from fieldtool.design.loops import Loops, system_matrix
from fieldtool.design.machine import Machine, machine_of, respond
from fieldtool.design.margins import margins_of
from fieldtool.design.moves import TestMove
from fieldtool.design.nonlinear import notes_of
from fieldtool.design.predict import AxisPrediction, Prediction, frequencies, predict
from fieldtool.design.robust import SLACK, check
from fieldtool.design.rule import DesignError, check_masses, lowest_antiresonance
from fieldtool.design.servo import Servo
from fieldtool.design.shaping import Shaping, best_shaper
from fieldtool.design.tuning import (
    BOUND,
    MOST_BOUND,
    RESPONSES,
    AxisTuning,
    TradePoint,
    Tuning,
    as_parameters,
)
from fieldtool.design.uncertainty import samples_of
from fieldtool.records.model import FloatArray, MachineModel

LONGER = 1.05
"""Of the present settling time of the motor, or of the time until motor and last mass have arrived: what
makes new parameters worse."""
TICK = 0.002
"""s of settling that nobody notices."""
TRADE = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
SPREAD_OF = 8
"""Machines that the prediction's spread is over."""
SEED = 20
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
    task = find(model, sides, moves, allowed, limit, seed, advance)
    advance("round, check and predict", 0.95)
    chosen = _rounded(task)
    present = _present(task)
    kept: dict[int, str] = {}
    prediction = _predicted(task, chosen)
    if present is not None:
        chosen, prediction, kept = _not_worse(task, chosen, prediction, present)
    return _tuning(task, response, chosen, prediction, present, kept)


def _rounded(task: Task) -> tuple[Servo, ...]:
    """Return the controllers as the drives will hold them, within the margin on every machine.

    Raises
    ------
    DesignError
        If rounding or ranges do not leave it.
    """
    servos = task.servos
    for _ in range(6):
        parameters = [
            as_parameters(servo, side) for servo, side in zip(servos, task.sides, strict=True)
        ]
        held = tuple(
            side.servo(side.held(one)) for side, one in zip(task.sides, parameters, strict=True)
        )
        peaks = check(task.machines, held).peaks.max(axis=0)
        if np.all(peaks <= SLACK * task.bound):
            return held
        servos = tuple(
            slower(servo) if peak > SLACK * task.bound else servo
            for servo, peak in zip(servos, peaks, strict=True)
        )
    k = int(np.argmax(peaks))
    outside = task.sides[k].out_of_range(parameters[k])
    why = (
        f"its ranges are too small: {', '.join(outside)}" if outside else "its steps are too coarse"
    )
    raise DesignError(
        f"{task.sides[k].axis}: with the numbers that the drive can hold, the peak of sensitivity is "
        f"{peaks[k]:.3g}, above {task.bound:.3g}; {why}. Nothing is written. Choose other units or "
        "ranges in the drive, allow more with --bound, or enter gains by hand."
    )


def _present(task: Task) -> tuple[Servo, ...] | None:
    servos = [side.present_servo for side in task.sides]
    known = tuple(servo for servo in servos if servo is not None)
    return known if len(known) == len(servos) else None


def _predicted(task: Task, servos: tuple[Servo, ...], spread: bool = True) -> Prediction:
    rng = np.random.default_rng(SEED)
    return predict(
        task.machines[0],
        servos,
        task.moves,
        resolutions=[side.resolution for side in task.sides],
        samples=[machine_of(m) for m in samples_of(task.model, SPREAD_OF, rng)] if spread else (),
    )


def arrival(axis: AxisPrediction) -> float:
    """Return when motor and last mass have both arrived, s from the beginning of the move."""
    if axis.move is None or axis.load is None:
        return inf
    return max(axis.move.positioning_time, axis.load.positioning_time)


def _not_worse(
    task: Task, chosen: tuple[Servo, ...], prediction: Prediction, present: tuple[Servo, ...]
) -> tuple[tuple[Servo, ...], Prediction, dict[int, str]]:
    """Keep the present parameters where the new ones are slower and the old ones good enough.

    Raises
    ------
    DesignError
        If the new ones are worse all the same.
    """
    old = _predicted(task, present, spread=False)
    if not old.stable:
        return chosen, prediction, {}
    kept: dict[int, str] = {}
    for k, (new, was) in enumerate(zip(prediction.axes, old.axes, strict=True)):
        if was.margins.sensitivity_peak > task.bound or not _slower(new, was):
            continue
        mixed = tuple(present[i] if i in (*kept, k) else s for i, s in enumerate(chosen))
        if np.all(check(task.machines, mixed).peaks <= SLACK * task.bound):
            kept[k] = "nothing better than the present parameters was found: they are kept."
    if kept:
        chosen = tuple(present[i] if i in kept else s for i, s in enumerate(chosen))
        prediction = _predicted(task, chosen)
    for k, (new, was) in enumerate(zip(prediction.axes, old.axes, strict=True)):
        if k not in kept and was.margins.sensitivity_peak <= task.bound and _slower(new, was):
            raise DesignError(
                f"{new.axis}: the new parameters would need {arrival(new):.3g} s for its typical move, "
                f"the present ones need {arrival(was):.3g} s with a peak of sensitivity of "
                f"{was.margins.sensitivity_peak:.3g}; nothing is written. Keep the present ones, or try "
                "--response stiff."
            )
    return chosen, prediction, kept


def _slower(new: AxisPrediction, was: AxisPrediction) -> bool:
    if new.move is None or was.move is None:
        return was.move is not None
    return (
        arrival(new) > LONGER * arrival(was)
        or new.move.settling_time > LONGER * was.move.settling_time + TICK
    )


def _tuning(
    task: Task,
    response: str,
    servos: tuple[Servo, ...],
    prediction: Prediction,
    present: tuple[Servo, ...] | None,
    kept: Mapping[int, str],
) -> Tuning:
    axes = []
    notes = list(notes_of(task.model, servos))
    for k, (side, servo, axis) in enumerate(zip(task.sides, servos, prediction.axes, strict=True)):
        parameters = side.held(as_parameters(servo, side))
        if k in kept and side.present:
            parameters = {n: v for n, v in side.present.items() if n in parameters}
        reason = kept.get(k) or _reason(task, k, servo)
        axes.append(AxisTuning(side.axis, parameters, axis.margins.sensitivity_peak, reason))
        if side.missing:
            notes.append(
                f"{side.axis}: its drive profile has no {', '.join(side.missing)} that can be written; "
                "enter the numbers with the maker's software, or complete `parameters` in a drive "
                "profile of your own."
            )
        if side.unreadable:
            notes.append(
                f"{side.axis}: its present parameters can not be compared: {side.unreadable}"
            )
    if task.bound > BOUND:
        notes.append(
            f"The peak of sensitivity may be up to {task.bound:.3g} here, above {BOUND:g}: these "
            "parameters may be tried on the machine, and are never stored."
        )
    return Tuning(
        tuple(axes),
        response,
        task.bound,
        task.moves,
        prediction,
        _predicted(task, present, spread=False) if present else None,
        _trade(task, servos),
        tuple(_shaping(task, servos, prediction)),
        tuple(dict.fromkeys(notes)),
    )


def _reason(task: Task, k: int, servo: Servo) -> str:
    axis = task.model.axes[k]
    lowest = lowest_antiresonance(axis) / (2 * np.pi)
    at = f"lowest antiresonance {lowest:.3g} Hz" if np.isfinite(lowest) else "a rigid axis"
    kinds = ["notch" if f.numerator[0] else "low-pass" for f in servo.loop.filters]
    at_hz = [np.sqrt(f.denominator[1]) / (2 * np.pi) for f in servo.loop.filters]
    filters = ", ".join(f"{kind} at {f:.3g} Hz" for kind, f in zip(kinds, at_hz, strict=True))
    return (
        f"total inertia {axis.total_mass:.4g}, {at}: optimised for a peak of sensitivity of at most "
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
            out.append(best_shaper(axis.axis, frequencies_, found[0][1], move.acceleration))
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
