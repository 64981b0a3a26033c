"""What a drive's interpolation of cyclic targets adds to the torque where it is sampled.

A drive that goes straight from target to target bends its reference at every SYNC.  At the SYNCs
the reference r lies on the wanted sine, between them it lies (w^2 r / 2) t (T - t) below it, on
average (w T)^2 r / 12.  The axis follows the average, but the loop's torque shows the bends, and is
sampled always at the same place: just after a bend, by the lag d of the torque.  So

    velocity_p position_p r (w T)^2 / 12 (1 - 6 (d / T) (1 - d / T))

has to be taken off the sampled phasor.  At T = 4 ms and 8 Hz it is 0.2 % of the product of gains
and reference; masses and springs come out 0.13 % too large without it.

Valid for: T short against the velocity loop's response (velocity_p T well below the motor's mass),
feed-forward off, no low-pass near the SYNC rate, d below T.
"""

import numpy as np

from fieldtool.records.recorded import Experiment, Recording, Segment

LINEAR_TARGETS = "linear_targets"
"""Key of a recording's source: ``AXIS=LAG`` of the axes whose drives interpolate linearly, LAG the
torque's lag in s, with blanks between."""


def folded_torque(
    recording: Recording, experiment: Experiment, segment: Segment, axis: int
) -> complex:
    """Return the part of an axis' sampled torque phasor that is folded images, N m or N.

    0 where the recording does not say that the drive interpolates linearly, or lacks the controller
    or the reference.
    """
    information = recording.axes[axis]
    lag = _lags(recording).get(information.name)
    controller, reference = information.controller, experiment.position_reference
    if lag is None or controller is None or reference is None:
        return 0j
    rows = slice(segment.start, segment.stop)
    period = recording.sample_period
    omega = 2 * np.pi * segment.frequency
    time = experiment.time[rows] - experiment.time[segment.start]
    target = reference[rows, axis] - reference[rows, axis].mean()
    phasor = 2 / target.size * complex(np.exp(-1j * omega * time) @ target)
    # A target sent with one SYNC is reached at the next one.
    reached = phasor * np.exp(-1j * omega * period)
    place = min(lag / period, 1.0)
    lost = (omega * period) ** 2 / 12 * (1 - 6 * place * (1 - place))
    return complex(controller.velocity_p * controller.position_p * reached * lost)


def _lags(recording: Recording) -> dict[str, float]:
    lags = {}
    for item in str(recording.source.get(LINEAR_TARGETS, "")).split():
        name, _, lag = item.rpartition("=")
        lags[name] = float(lag)
    return lags
