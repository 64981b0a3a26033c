"""What parameters will do, before they are written: margins, moves, steps, noise, with their spread."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import hypot, inf, isfinite, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldtool.design.figures import MoveFigures, StepFigures, sensitivity_peak
from fieldtool.design.loops import Loops, system_matrix
from fieldtool.design.machine import Machine, machine_of, respond, standing
from fieldtool.design.margins import Margins, margins_of
from fieldtool.design.motion import Curves, moved
from fieldtool.design.moves import TestMove
from fieldtool.design.servo import Servo
from fieldtool.records.model import FloatArray, MachineModel

ComplexArray = NDArray[np.complexfloating[Any, Any]]
GRID = 400
BESIDE = np.linspace(-2.5, 2.5, 13)
LIGHT = 0.3
"""Damping ratio below which an eigenvalue gets frequencies of its own."""
SPREAD = (2.5, 97.5)
"""Percentiles of what is told of uncertain models."""


@dataclass(frozen=True, eq=False)
class AxisPrediction:
    """What one axis will do; SI."""

    axis: str
    margins: Margins
    """Of the axis' loop with all others closed."""
    move: MoveFigures | None
    """The motor on the axis' move; None where the machine is not stable."""
    load: MoveFigures | None
    """The last mass on the same move."""
    step: StepFigures | None
    """The motor after a step of the reference, without feed-forward."""
    compliance: float
    """Largest motor position per torque at the motor over all frequencies, rad/(N m) or m/N."""
    noise: float
    """RMS of the torque that the steps of encoder and moving targets make; NaN where they are not
    known."""
    peak_torque: float
    """Largest torque of the move, N m or N; NaN where the machine is not stable."""
    spread: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """95 % ranges over the model's uncertainty: sensitivity_peak, settling_time, positioning_time,
    overshoot (of the motor); empty where no samples were given."""
    curves: Curves | None = None
    sensitivity: tuple[FloatArray, FloatArray] | None = None
    """Hz and abs(1 / (1 + L)) of the axis' loop with all others closed, for pictures."""
    beside: FloatArray | None = None
    """Largest torque, distance and speed of every axis' motor on this axis' move, (3, M); this one's own
    say nothing."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values without the histories; what is infinite or not known is null."""
        data = {
            "axis": self.axis,
            "margins": self.margins.as_dict(),
            "move": self.move.as_dict() if self.move else None,
            "load": self.load.as_dict() if self.load else None,
            "step": self.step.as_dict() if self.step else None,
            "compliance": self.compliance,
            "noise": self.noise,
            "peak_torque": self.peak_torque,
            "spread": {k: list(v) for k, v in self.spread.items()},
        }
        plain: dict[str, Any] = finite(data)
        return plain


@dataclass(frozen=True, eq=False)
class Prediction:
    """What all axes will do under one set of parameters."""

    axes: tuple[AxisPrediction, ...]
    stable: bool
    sensitivity_peak: float
    """Largest singular value of the sensitivity of all loops together, at the motors' torques, each over
    the root of its axis' inertia, so that no unit matters: for loops that change at the same time."""

    def of(self, axis: str) -> AxisPrediction:
        """Return one axis by name; KeyError where there is none."""
        for one in self.axes:
            if one.axis == axis:
                return one
        raise KeyError(axis)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "Prediction":
        """Inverse of :meth:`as_dict`; what is null is infinite (times, peaks) or no number."""
        return cls(
            tuple(_axis_from(axis) for axis in data["axes"]),
            bool(data["stable"]),
            _number(data["sensitivity_peak"], inf),
        )

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "stable": self.stable,
            "sensitivity_peak": finite(self.sensitivity_peak),
            "axes": [axis.as_dict() for axis in self.axes],
        }


def predict(
    model: MachineModel | Machine,
    servos: Sequence[Servo],
    moves: Sequence[TestMove],
    *,
    resolutions: Sequence[float] | None = None,
    samples: Sequence[MachineModel | Machine] = (),
) -> Prediction:
    """Return what a machine does under its drives' loops.

    Each axis makes its own move while the references of the others stand still, their loops closed.

    Parameters
    ----------
    model
        The machine, effects included where they are linear, dry friction, and gravity and cogging where
        it is known from where a move starts.
    servos, moves
        One an axis, in the model's order.
    resolutions
        One step of each axis' encoder, rad or m; NaN or None where it is not known.
    samples
        Models that are as likely as ``model``; the spread is that over them.
    """
    machine = model if isinstance(model, Machine) else machine_of(model)
    machine = standing(machine, [move.start for move in moves])
    servos = tuple(servos)
    steps = [nan] * len(servos) if resolutions is None else list(resolutions)
    values: ComplexArray = np.linalg.eigvals(system_matrix(machine, servos)).astype(np.complex128)
    steady = bool(values.real.max() < 1e-9 * np.abs(values).max())
    loops = Loops(respond(machine, frequencies(machine, values)), servos)
    axes = []
    spreads = _spreads(samples, servos, moves) if steady and samples else [{} for _ in servos]
    for k, (servo, move) in enumerate(zip(servos, moves, strict=True)):
        motion = moved(machine, servos, k, move, values) if steady else None
        axes.append(
            AxisPrediction(
                machine.names[k],
                margins_of(loops.response.omega, loops.sensitivity[:, k]),
                motion.motor if motion else None,
                motion.load if motion else None,
                motion.step if motion else None,
                float(np.abs(loops.compliance[:, k, k]).max()),
                _noise(servo, steps[k]),
                motion.peak_torque if motion else nan,
                spreads[k],
                motion.curves if motion else None,
                (loops.response.omega / (2 * np.pi), np.abs(loops.sensitivity[:, k])),
                motion.beside if motion else None,
            )
        )
    root = np.sqrt(machine.inertias)
    together = loops.input_sensitivity * (root[None, :] / root[:, None])
    peak = sensitivity_peak(together) if steady else inf
    return Prediction(tuple(axes), steady, peak)


def _noise(servo: Servo, step: float) -> float:
    return hypot(servo.torque_noise(step), servo.target_noise(step)) if isfinite(step) else nan


def frequencies(machine: Machine, eigenvalues: ComplexArray) -> FloatArray:
    """Return frequencies at which a closed machine shows all its peaks, rad/s, rising.

    Parameters
    ----------
    machine
        The machine.
    eigenvalues
        Of the closed loops, rad/s.
    """
    swinging = eigenvalues[eigenvalues.imag > 0]
    size = np.abs(swinging) if swinging.size else np.abs(eigenvalues)
    modes = np.concatenate([size, machine.modes, machine.held_modes])
    slow = np.abs(eigenvalues.real)
    low = 0.1 * min(modes.min(), slow[slow > 1e-6 * modes.max()].min())
    high = 5.0 * min(modes.max(), 20 * max([*machine.modes, np.median(modes)]))
    light = swinging[-swinging.real < LIGHT * np.abs(swinging)]
    width = np.maximum(np.abs(light.real), 1e-3 * light.imag)
    near = (light.imag[:, None] + width[:, None] * BESIDE).ravel()
    open_modes = np.concatenate([machine.modes, machine.held_modes])
    beside = (open_modes[:, None] * (1 + 0.004 * BESIDE)).ravel()
    every = np.concatenate([np.geomspace(low, high, GRID), near, beside])
    return np.unique(every[every > 0])


def _spreads(
    samples: Sequence[MachineModel | Machine], servos: tuple[Servo, ...], moves: Sequence[TestMove]
) -> list[dict[str, tuple[float, float]]]:
    found = [predict(sample, servos, moves) for sample in samples]
    out = []
    for k in range(len(servos)):
        axes = [one.axes[k] for one in found]
        figures = {
            "sensitivity_peak": [a.margins.sensitivity_peak for a in axes],
            "settling_time": [a.move.settling_time if a.move else inf for a in axes],
            "positioning_time": [a.move.positioning_time if a.move else inf for a in axes],
            "overshoot": [a.move.overshoot if a.move else inf for a in axes],
        }
        out.append({name: _range(values) for name, values in figures.items()})
    return out


def _range(values: Sequence[float]) -> tuple[float, float]:
    low, high = np.percentile(values, SPREAD, method="nearest")
    return float(low), float(high)


def _number(value: Any, otherwise: float) -> float:
    return otherwise if value is None else float(value)


def _axis_from(data: Mapping[str, Any]) -> AxisPrediction:
    def figures(kind: Any, name: str) -> Any:
        given = data[name]
        return None if given is None else kind(**{k: _number(v, inf) for k, v in given.items()})

    return AxisPrediction(
        str(data["axis"]),
        figures(Margins, "margins"),
        figures(MoveFigures, "move"),
        figures(MoveFigures, "load"),
        figures(StepFigures, "step"),
        _number(data["compliance"], nan),
        _number(data["noise"], nan),
        _number(data["peak_torque"], nan),
        {k: (_number(a, inf), _number(b, inf)) for k, (a, b) in data["spread"].items()},
    )


def finite(data: Any) -> Any:
    """Return plain values with None in place of what is infinite or no number."""
    if isinstance(data, dict):
        return {k: finite(v) for k, v in data.items()}
    if isinstance(data, list | tuple):
        return [finite(v) for v in data]
    if isinstance(data, float):
        return data if isfinite(data) else None
    return data
