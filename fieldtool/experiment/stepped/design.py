"""The paper's plan: stepped sines on one axis, the others floating or holding their position.

Three kinds of sweep (paper, sections 3.1 and 3.2): direct with the others free for resonances,
antiresonances and the high-frequency gain; direct with the others locked for the low-frequency
gain (condition 4); cross-coupled with the remaining axes locked (condition 9).
"""

from collections.abc import Iterable
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.linalg import eigh

from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.stepped.plan import Sweep, SweepPlan, Tone, tone_near
from fieldtool.records.model import FloatArray, MachineModel

CYCLE_TIMES = (0.01, 0.008, 0.005, 0.004, 0.002, 0.001)
"""Cycle times to choose from, seconds."""
CYCLES_A_PERIOD = 10
"""At the highest frequency of the plan, at least."""
SHARE_OF_LIMITS = 0.4
"""Of every limit that a tone may use at steady state, by the prior model."""
REFERENCE_SHARE = 0.9
"""Of the room to the travel's end that the reference may use; soft loops follow a part of it."""
NEIGHBOURHOOD = 0.15
"""A tone's amplitude fits all frequencies so near, because the prior model is not exact."""
GRID_RATIO = 1.06
"""From one frequency of the first pass to the next."""
LOW, HIGH = 0.35, 2.5
"""First pass: from LOW times the lowest to HIGH times the highest mode."""
HIGH_TONES, LOW_TONES = 7, 8
HELD_BAND = (0.18, 0.42)
"""Of the lowest mode: where the low-frequency gains are measured; above, elasticity counts more
than a short series in the frequency's square can follow."""
CROSS_BLOCKS = 6
AROUND_A_MODE = (-1.0, 0.0, 1.0)
"""Second pass: in half-widths (damping ratio times frequency) from each mode."""
SMALLEST_HALF_WIDTH = 0.004
"""Relative; below that the frequencies of a block can not be told apart."""


def chosen_cycle_time(model: MachineModel, shortest: float) -> float:
    """Return the longest cycle time that is short enough for the machine's modes.

    Parameters
    ----------
    model
        Prior model.
    shortest
        That fits the bus, seconds.

    Raises
    ------
    PlanRefusedError
        If the modes are too fast for the bus.
    """
    top = HIGH * _mode_band(model)[1]
    needed = 1 / (CYCLES_A_PERIOD * top)
    for cycle_time in CYCLE_TIMES:
        if cycle_time <= needed:
            if cycle_time < shortest - 1e-9:
                break
            return cycle_time
    raise PlanRefusedError(
        f"the fastest mode needs a cycle of {needed * 1000:.2g} ms or less, the bus allows "
        f"{shortest * 1000:g} ms or more. Use a higher bit rate, fewer axes on the bus, or a "
        "smaller `shortest_cycle` in the machine profile."
    )


def classic_plan(setting: Setting, may_float: Iterable[str], cycle_time: float) -> SweepPlan:
    """Return the first pass: an even grid over the band of the prior model's modes.

    Raises
    ------
    PlanRefusedError
        If an axis may not float.
    """
    _check_floating(setting, may_float)
    low, high = _mode_band(setting.model)
    count = int(np.ceil(np.log(1.12 * high / (LOW * low)) / np.log(GRID_RATIO)))
    grid = np.geomspace(LOW * low, 1.12 * high, count)
    above = np.geomspace(1.25 * high, HIGH * high, HIGH_TONES)
    names = setting.model.names
    sweeps = [
        _free_sweep(setting, axis, np.concatenate([grid, above]), cycle_time) for axis in names
    ]
    if len(names) > 1:
        sweeps += _low_frequency_sweeps(setting, low, cycle_time)
    return SweepPlan(cycle_time, tuple(sweeps), _notes(sweeps))


def refined_plan(setting: Setting, damping_ratios: FloatArray, cycle_time: float) -> SweepPlan:
    """Return the second pass: tones at and beside each mode that the first pass found.

    Parameters
    ----------
    setting
        With the model that the first pass gave.
    damping_ratios
        Of the resonances, rising frequency; antiresonances take the nearest one's.
    """
    resonances, antiresonances = undamped_modes(setting.model)
    sweeps = []
    for k, axis in enumerate(setting.model.names):
        wanted: list[float] = []
        for mode in np.concatenate([resonances, antiresonances[k]]):
            near = int(np.argmin(np.abs(resonances - mode)))
            width = max(float(damping_ratios[near]), SMALLEST_HALF_WIDTH)
            wanted += [float(mode) * (1 + share * width) for share in AROUND_A_MODE]
        frequencies = np.array(sorted(wanted)) / (2 * np.pi)
        apart = np.diff(frequencies, prepend=0.0) > 0.5 * SMALLEST_HALF_WIDTH * frequencies
        if frequencies.size:
            found = _free_sweep(setting, axis, frequencies[apart], cycle_time)
            sweeps.append(replace(found, label="at the modes"))
    return SweepPlan(cycle_time, tuple(sweeps))


def undamped_modes(model: MachineModel) -> tuple[FloatArray, list[FloatArray]]:
    """Return resonances, shape (R,), and each axis' antiresonances (R,), rad/s, without those at 0.

    Antiresonances of an axis are the resonances of the machine with that motor locked.
    """
    mass, stiffness = model.mass_matrix, model.stiffness_matrix
    rigid = len(model.axes)

    def frequencies(keep: FloatArray, zeros: int) -> FloatArray:
        index = np.flatnonzero(keep)
        values = eigh(
            stiffness[np.ix_(index, index)], mass[np.ix_(index, index)], eigvals_only=True
        )
        result: FloatArray = np.sqrt(np.maximum(values[zeros:], 0.0))
        return result

    every = np.ones(mass.shape[0])
    locked = []
    for motor in model.first_masses:
        keep = every.copy()
        keep[motor] = 0
        locked.append(frequencies(keep, rigid - 1))
    return frequencies(every, rigid), locked


def lowest_mode(model: MachineModel) -> float:
    """Return the lowest resonance or antiresonance, Hz."""
    return _mode_band(model)[0]


def _mode_band(model: MachineModel) -> tuple[float, float]:
    """Return the lowest and the highest mode, Hz."""
    resonances, antiresonances = undamped_modes(model)
    if resonances.size == 0:
        return 1.0, 2.0  # rigid axes only: any frequency does
    every = np.concatenate([resonances, *antiresonances]) / (2 * np.pi)
    return float(every.min()), float(every.max())


def _check_floating(setting: Setting, may_float: Iterable[str]) -> None:
    names = setting.model.names
    held = [name for name in names if name not in set(may_float)]
    if held and len(names) > 1:
        raise PlanRefusedError(
            f"the classic plan lets axes float without torque, and {', '.join(held)} may not "
            "(`may_float` in the machine profile is not true). Set it only if the axis stays where it "
            "is without torque and its brake is open."
        )


def _free_sweep(setting: Setting, axis: str, frequencies: FloatArray, cycle_time: float) -> Sweep:
    free = tuple(name for name in setting.model.names if name != axis)
    tones = _tones(setting, axis, free, frequencies, cycle_time)
    return Sweep("direct, others free", axis, free, tones)


def _low_frequency_sweeps(setting: Setting, lowest: float, cycle_time: float) -> list[Sweep]:
    names = setting.model.names
    sweeps = []
    for axis in names:
        frequencies = np.geomspace(HELD_BAND[0] * lowest, HELD_BAND[1] * lowest, LOW_TONES)
        tones = _tones(setting, axis, (), frequencies, cycle_time)
        sweeps.append(Sweep("direct, others locked", axis, (), tones))
    for first, second in combinations(names, 2):
        frequencies = np.geomspace(HELD_BAND[0] * lowest, HELD_BAND[1] * lowest, LOW_TONES)
        tones = _tones(setting, second, (first,), frequencies, cycle_time)
        sweeps.append(Sweep("cross-coupled", second, (first,), tones, blocks=CROSS_BLOCKS))
    return sweeps


def _tones(
    setting: Setting,
    axis: str,
    free: tuple[str, ...],
    frequencies: FloatArray,
    cycle_time: float,
) -> tuple[Tone, ...]:
    tones = [tone_near(float(f), 0.0, cycle_time) for f in frequencies]
    # at the frequencies that they really have: beside a lightly damped mode 0.1 % matters
    amplitudes = _amplitudes(setting, axis, free, np.array([tone.frequency for tone in tones]))
    return tuple(
        replace(tone, amplitude=float(a)) for tone, a in zip(tones, amplitudes, strict=True)
    )


def _amplitudes(
    setting: Setting, axis: str, free: tuple[str, ...], frequencies: FloatArray
) -> FloatArray:
    """Return the largest reference amplitudes that keep SHARE_OF_LIMITS everywhere near by."""
    near = np.linspace(1 - NEIGHBOURHOOD, 1 + NEIGHBOURHOOD, 31)
    omega = 2 * np.pi * (frequencies[:, None] * near[None, :]).ravel()
    driven = setting.model.names.index(axis)
    position, torque = setting.closed_loop(free).response(omega, driven)
    reference = np.zeros(position.shape[1])
    reference[driven] = 1.0
    room = _room(setting, driven)
    use = np.full(omega.size, SHARE_OF_LIMITS / (REFERENCE_SHARE * room))
    for k, (name, limits) in enumerate(zip(setting.model.names, setting.limits, strict=True)):
        x = np.abs(position[:, k])
        room = _room(setting, k)
        use = np.maximum.reduce(
            [
                use,
                x / room,
                omega * x / limits.velocity,
                omega**2 * x / limits.acceleration,
                np.abs(torque[:, k]) / limits.torque,
            ]
        )
        if name not in free:
            use = np.maximum(use, np.abs(reference[k] - position[:, k]) / limits.following_error)
    worst: FloatArray = use.reshape(frequencies.size, near.size).max(axis=1)
    return SHARE_OF_LIMITS / worst


def _room(setting: Setting, k: int) -> float:
    """Return how far an axis may move from its centre, rad or m."""
    low, high = setting.limits[k].travel
    return float(min(setting.centre[k] - low, high - setting.centre[k]))


def _notes(sweeps: list[Sweep]) -> tuple[str, ...]:
    slow = [s for s in sweeps if s.kind != "direct, others free"]
    if not slow:
        return ()
    lowest = min(tone.frequency for s in slow for tone in s.tones)
    return (
        f"Friction: the low-frequency gains are measured down to {lowest:.2g} Hz at the largest "
        "amplitude that the limits allow, and taken from the part of the torque that is in phase with "
        "the acceleration; friction acts in phase with the velocity and stays out of it. A bias "
        "velocity is not used: it would need more travel than one period of these sweeps leaves.",
    )
