"""Check a model by a signal it never saw: the load side of an axis, measured by a second encoder.

From the motor side alone the identification finds masses, spring and damper.  They predict how the
load moves per motor angle and per motor torque; a recording with a load-side encoder shows how it
really moves.  Both ratios are compared at the excited lines.

Valid for: periodic experiments with one driven axis and no coupling that matters, the same delay
in both encoders (it cancels in load per motor, and counts in load per torque).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.multisine.periods import average_periods
from fieldtool.frf.multisine.single_axis import analyse_multisine
from fieldtool.records.model import MachineModel
from fieldtool.records.recorded import Experiment, Recording

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class PredictedRatio:
    """A predicted ratio beside the measured one, at L lines."""

    what: str
    """``load position / motor position`` or ``load position / torque``."""
    predicted: ComplexArray
    """(L,)."""
    measured: ComplexArray
    """(L,)."""

    @property
    def error_db(self) -> FloatArray:
        """Predicted over measured modulus, dB, (L,)."""
        return 20 * np.log10(np.abs(self.predicted / self.measured))

    @property
    def error_degrees(self) -> FloatArray:
        """Predicted minus measured phase, degrees from -180 to 180, (L,)."""
        return np.degrees(np.angle(self.predicted / self.measured))

    @property
    def median_db(self) -> float:
        """Median of the modulus of :attr:`error_db`."""
        return float(np.median(np.abs(self.error_db)))

    @property
    def median_degrees(self) -> float:
        """Median of the modulus of :attr:`error_degrees`."""
        return float(np.median(np.abs(self.error_degrees)))


@dataclass(frozen=True, eq=False)
class LoadPrediction:
    """How well a model predicts the load side in one experiment."""

    experiment: str
    axis: str
    frequencies: FloatArray
    """(L,), Hz: the excited lines in the band."""
    per_position: PredictedRatio
    per_torque: PredictedRatio

    @property
    def median_db(self) -> float:
        """The larger of both medians, dB."""
        return max(self.per_position.median_db, self.per_torque.median_db)

    @property
    def median_degrees(self) -> float:
        """The larger of both medians, degrees."""
        return max(self.per_position.median_degrees, self.per_torque.median_degrees)


def predict_load(
    model: MachineModel,
    delay: float,
    recording: Recording,
    axis: str | None = None,
    extra: str = "load_position",
    band: tuple[float, float] = (11.0, 200.0),
    load_friction: float = 0.0,
    ground_spring: float = 0.0,
) -> tuple[LoadPrediction, ...]:
    """Compare the load side that ``model`` predicts with the one that was measured.

    Parameters
    ----------
    model
        With at least two masses on the axis; its last mass is the load.
    delay
        From torque to position, s.
    recording
        With periodic experiments that drive the axis and have the extra signal ``AXIS.extra``.
    axis
        Which axis; None takes the only one of the model.
    extra
        Name of the column with the load's position, rad or m.
    band
        Hz; lines outside are not compared.
    load_friction
        Viscous friction between the axis's last mass and ground, N m s/rad or N s/m; the friction
        at the motor is in the model.
    ground_spring
        Between the axis' motor and ground, N m/rad or N/m (see ``surroundings``).

    Returns
    -------
    tuple
        One comparison per experiment that has the signal.

    Raises
    ------
    NotEnoughDataError
        If no experiment has the signal, or no excited line lies in the band.
    ValueError
        If the axis is not in model and recording, or has one mass only.
    """
    name = _axis_name(model, recording, axis)
    signal = f"{name}.{extra}"
    fitting = [
        experiment
        for experiment in recording.experiments
        if signal in experiment.extra and experiment.driven == (name,) and experiment.period
    ]
    if not fitting:
        raise NotEnoughDataError(
            f"no periodic experiment drives axis {name} alone and has the signal '{signal}': there "
            "is nothing to check the prediction against."
        )
    return tuple(
        _compare(model, delay, recording, e, name, signal, band, (load_friction, ground_spring))
        for e in fitting
    )


def load_responses(
    model: MachineModel,
    axis: str,
    delay: float,
    frequencies: Sequence[float] | FloatArray,
    load_friction: float = 0.0,
    ground_spring: float = 0.0,
) -> tuple[ComplexArray, ComplexArray]:
    """Return load position per motor position and load position per torque, (L,) each.

    From the equation of motion (-w^2 M + j w C + K) q = tau with torque on this axis's motor only,
    all other axes free.  ``frequencies`` in Hz, ``delay`` in s,
    ``load_friction`` between the last mass and ground in N m s/rad or N s/m, ``ground_spring``
    between the motor and ground in N m/rad or N/m.
    """
    place = model.names.index(axis)
    first, last = int(model.first_masses[place]), int(model.last_masses[place])
    w = 2 * np.pi * np.asarray(frequencies, dtype=np.float64)
    M, C, K = model.mass_matrix, model.damping_matrix, model.stiffness_matrix
    C[last, last] += load_friction
    K[first, first] += ground_spring
    dynamic = -(w**2)[:, None, None] * M + 1j * w[:, None, None] * C + K
    push = np.zeros((M.shape[0], 1))
    push[first] = 1.0
    q = np.linalg.solve(dynamic, np.broadcast_to(push, (w.size, *push.shape)))[:, :, 0]
    return q[:, last] / q[:, first], q[:, last] * np.exp(-1j * w * delay)


def _compare(
    model: MachineModel,
    delay: float,
    recording: Recording,
    experiment: Experiment,
    name: str,
    signal: str,
    band: tuple[float, float],
    ground: tuple[float, float],
) -> LoadPrediction:
    result = analyse_multisine(recording, experiment)
    axis = recording.names.index(name)
    average = average_periods(
        experiment.extra[signal][:, None],
        experiment.period or 0.0,
        recording.sample_period,
        result.skipped,
    )
    frequencies = result.phasors.frequencies
    inside = (frequencies >= band[0]) & (frequencies <= band[1])
    if not np.any(inside):
        raise NotEnoughDataError(
            f"experiment {experiment.name} has no excited line between {band[0]:g} and "
            f"{band[1]:g} Hz: choose another band."
        )
    frequencies = frequencies[inside]
    lines = np.rint(frequencies * average.period).astype(np.intp) - 1
    load = average.mean[lines, 0]
    per_position, per_torque = load_responses(model, name, delay, frequencies, *ground)
    return LoadPrediction(
        experiment=experiment.name,
        axis=name,
        frequencies=frequencies,
        per_position=PredictedRatio(
            "load position / motor position",
            per_position,
            load / result.phasors.position[inside, axis],
        ),
        per_torque=PredictedRatio(
            "load position / torque", per_torque, load / result.phasors.torque[inside, axis]
        ),
    )


def _axis_name(model: MachineModel, recording: Recording, axis: str | None) -> str:
    if axis is None and len(model.names) != 1:
        raise ValueError(f"say which axis: the model has {', '.join(model.names)}")
    name = model.names[0] if axis is None else axis
    for what, names in (("model", model.names), ("recording", recording.names)):
        if name not in names:
            raise ValueError(f"the {what} has no axis '{name}', it has {', '.join(names)}")
    if len(model.axes[model.names.index(name)].masses) < 2:
        raise ValueError(f"axis {name} has one mass in the model: its load is its motor")
    return name
