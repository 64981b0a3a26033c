"""Tables of elements and imperfect shafts for the compiled loop, made from the parts of a plant."""

from collections.abc import Sequence
from math import cos, exp, inf, sin

import numpy as np

from drives.sim.effects import (
    ChainEffect,
    Element,
    EncoderError,
    MeasurementDelay,
    TorqueLag,
    TorqueSaturation,
    TorqueScale,
)
from drives.sim.effects.shapes import ELEMENT_MEMORY, ELEMENT_VALUES
from drives.sim.element_kernel import Elements, Shafts

SERVO_EFFECTS = (TorqueScale, TorqueSaturation, TorqueLag, MeasurementDelay, EncoderError)


def has_servo_effect(effects: Sequence[ChainEffect]) -> bool:
    """Whether any of these sits in the drive."""
    return any(isinstance(part, SERVO_EFFECTS) for part in effects)


def pushed_masses(elements: Sequence[Element]) -> tuple[int, ...]:
    """Numbers of all masses that elements act on, rising."""
    return tuple(sorted({end for e in elements for end in (e.first, e.second) if end >= 0}))


def element_tables(elements: Sequence[Element]) -> Elements:
    """Tables of these elements; places count in :func:`pushed_masses`."""
    place = {mass: k for k, mass in enumerate(pushed_masses(elements))}
    count = len(elements)
    ends = np.array([(e.first, e.second) for e in elements], dtype=np.int64).reshape(count, 2)
    values = np.zeros((count, ELEMENT_VALUES))
    for row, element in zip(values, elements, strict=True):
        row[: len(element.values)] = element.values
    return Elements(
        kinds=np.array([int(e.kind) for e in elements], dtype=np.int64),
        ends=ends,
        slots=np.array(
            [[place.get(int(m), 0) for m in pair] for pair in ends], dtype=np.int64
        ).reshape(count, 2),
        values=values,
        memory=np.zeros((count, ELEMENT_MEMORY)),
    )


def shaft_tables(effects: Sequence[Sequence[ChainEffect]], step: float) -> Shafts:
    """Tables for M axes, from the effects of each; ideal where there is none of a kind.

    Raises
    ------
    ValueError
        If an axis has two of a kind.
    """
    axes = len(effects)
    scale, saturation = np.ones(axes), np.full(axes, inf)
    lag, encoder = np.zeros((axes, 2)), np.zeros((axes, 3))
    delays = np.zeros(axes, dtype=np.int64)
    for axis, parts in enumerate(effects):
        kinds = [type(part) for part in parts if isinstance(part, SERVO_EFFECTS)]
        if len(set(kinds)) != len(kinds):
            raise ValueError(f"axis {axis}: two effects of one kind in one drive")
        for part in parts:
            match part:
                case TorqueScale():
                    scale[axis] = part.factor
                case TorqueSaturation():
                    saturation[axis] = part.torque
                case TorqueLag():
                    ratio = step / part.time
                    lag[axis] = exp(-ratio), -np.expm1(-ratio) / ratio
                case MeasurementDelay():
                    delays[axis] = round(part.time / step)
                case EncoderError():
                    offset = part.amplitude * part.rate
                    encoder[axis] = part.rate, offset * cos(part.phase), offset * sin(part.phase)
                case _:
                    pass
    return Shafts(
        scale=scale,
        saturation=saturation,
        lag=lag,
        lagged=np.zeros(axes),
        encoder=encoder,
        delays=delays,
        queue=np.zeros((axes, int(delays.max(initial=0)) + 1)),
        places=np.zeros(1, dtype=np.int64),
    )
