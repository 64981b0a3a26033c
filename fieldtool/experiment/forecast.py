"""What a plan will do to the machine, by simulation with the prior model, before anything moves."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drives.api import AxisLimits
from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.stepped.plan import Sweep, SweepPlan, tone_blocks, transition
from fieldtool.records.closed_loop import AxisLoop, ClosedLoop
from fieldtool.records.model import FloatArray, Kind, MachineModel

BoolArray = NDArray[np.bool_]
SIMULATED_BLOCKS = 3
"""Blocks of each tone in the simulation; transients have their largest values before that."""


@dataclass(frozen=True)
class Setting:
    """What planning needs to know: the prior model, the drives' loops, and the axes' limits."""

    model: MachineModel
    loops: tuple[AxisLoop, ...]
    limits: tuple[AxisLimits, ...]
    centre: FloatArray
    """Position about which each axis moves, shape (M,), rad or m."""

    def closed_loop(self, free: Sequence[str]) -> ClosedLoop:
        """Return the model under its loops, with some axes floating."""
        return ClosedLoop(
            self.model,
            tuple(
                None if name in free else loop
                for name, loop in zip(self.model.names, self.loops, strict=True)
            ),
        )


@dataclass(frozen=True)
class AxisForecast:
    """Largest values of one axis in a plan, SI, and the limits they stay below."""

    axis: str
    kind: Kind
    excursion: float
    """From the centre."""
    velocity: float
    acceleration: float
    torque: float
    following_error: float


def forecast(plan: SweepPlan, setting: Setting) -> tuple[AxisForecast, ...]:
    """Simulate every sweep and return each axis' largest values.

    Raises
    ------
    PlanRefusedError
        If a limit would be left, or the loops are not stable with the prior model: naming sweep,
        axis, value and limit.
    """
    peaks = np.zeros((5, len(setting.loops)))
    for sweep in plan.sweeps:
        found = _sweep_peaks(sweep, plan.cycle_time, setting)
        check_peaks(f"sweep {sweep.name}", found, setting)
        peaks = np.maximum(peaks, found)
    return tuple(
        AxisForecast(axis.name, axis.kind, *(float(v) for v in peaks[:, k]))
        for k, axis in enumerate(setting.model.axes)
    )


def _sweep_peaks(sweep: Sweep, step: float, setting: Setting) -> FloatArray:
    loop = setting.closed_loop(sweep.free)
    if not loop.stable:
        raise PlanRefusedError(
            f"sweep {sweep.name}: with the prior model and the gains in the drives the loops are not "
            "stable. Check the prior model in the machine profile and the drives' gains."
        )
    axis = setting.model.names.index(sweep.driven)
    pieces: list[FloatArray] = []
    before = None
    for tone in sweep.tones:
        blocks = tone_blocks(tone, before)
        pieces += [next(blocks) for _ in range(1 + SIMULATED_BLOCKS)]
        before = tone
    pieces.append(transition(None, before))
    references = np.zeros((sum(p.size for p in pieces), len(setting.loops)))
    references[:, axis] = np.concatenate(pieces)
    position, torque = loop.simulate(references, step)
    held = np.array([one is not None for one in loop.loops])
    return largest_values(references, position, torque, step, held)


def largest_values(
    references: FloatArray, position: FloatArray, torque: FloatArray, step: float, held: BoolArray
) -> FloatArray:
    """Return the largest excursions, velocities, accelerations, torques and following errors.

    Parameters
    ----------
    references, position, torque
        Simulated, shape (n, M), relative to the centre, at the ``step`` in seconds.
    step
        Seconds.
    held
        Which axes follow their reference, shape (M,); the others have no following error.

    Returns
    -------
    ndarray
        Shape (5, M), SI.
    """
    velocity = np.gradient(position, step, axis=0)
    error = np.where(held, np.abs(references - position).max(axis=0), 0.0)
    return np.stack(
        [
            np.abs(position).max(axis=0),
            np.abs(velocity).max(axis=0),
            np.abs(np.gradient(velocity, step, axis=0)).max(axis=0),
            np.abs(torque).max(axis=0),
            error,
        ]
    )


def check_peaks(what_moves: str, peaks: FloatArray, setting: Setting) -> None:
    """See that no limit is left.

    Parameters
    ----------
    what_moves
        Sweep or experiment with its name, for the message.
    peaks
        Largest excursions, velocities, accelerations, torques and following errors, shape (5, M).
    setting
        Axes, limits and centres.

    Raises
    ------
    PlanRefusedError
        Naming axis, value and limit.
    """
    for k, (name, limits) in enumerate(zip(setting.model.names, setting.limits, strict=True)):
        room = min(setting.centre[k] - limits.travel[0], limits.travel[1] - setting.centre[k])
        unit = "rad" if setting.model.axes[k].kind == "rotary" else "m"
        force = "N m" if unit == "rad" else "N"
        for what, value, limit, in_unit in (
            ("leave its centre by", peaks[0, k], room, unit),
            ("move at", peaks[1, k], limits.velocity, f"{unit}/s"),
            ("accelerate at", peaks[2, k], limits.acceleration, f"{unit}/s2"),
            ("need a torque of", peaks[3, k], limits.torque, force),
            ("have a following error of", peaks[4, k], limits.following_error, unit),
        ):
            if value > limit:
                raise PlanRefusedError(
                    f"{what_moves}: {name} would {what} {value:.4g} {in_unit}, its limit is "
                    f"{limit:.4g} {in_unit}. Nothing of it was moved. Widen the limit if the machine "
                    "allows it, or correct the prior model."
                )
