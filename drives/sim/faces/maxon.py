"""maxon EPOS4, after the maker's units (uA/rad and so on), with one encoder and with two.

Not imitated: the velocity observer and its filters, the main loop's filter, gain scheduling (the
mean of both position gains acts), the PID's feed-forward of the velocity (0x30A1:04), other velocity
units than revolutions a minute, and gains of the PID that no cascade has.
"""

from drives.sim.dictionary import Key, Value
from drives.sim.faces.face import (
    Face,
    Motor,
    Read,
    cascade_of,
    pid_of,
    rpm_units,
    start_settings,
)
from drives.sim.faces.merge import dressed, shipped
from drives.sim.servo_kernel import Parameter

_MOST = 2**32 - 1
_MICRO = 1_000_000
_NOMINAL_CURRENT, _CURRENT_LIMIT, _TORQUE_CONSTANT = (0x3001, 1), (0x3001, 2), (0x3001, 5)
_P, _I, _D, _ACCELERATION = (0x30A1, 1), (0x30A1, 2), (0x30A1, 3), (0x30A1, 5)
_LOW, _HIGH = (0x30AE, 1), (0x30AE, 2)
_AUXILIARY_P, _AUXILIARY_I = (0x30AE, 0x20), (0x30AE, 0x21)
_AUXILIARY_VELOCITY, _AUXILIARY_ACCELERATION = (0x30AE, 0x22), (0x30AE, 0x23)


def _newton_metres(read: Read, key: Key) -> float:
    """N m of a gain in uA: the drive's current times its motor's torque constant (uN m/A)."""
    microamperes, constant = float(read(*key)), float(read(*_TORQUE_CONSTANT))
    return microamperes * constant / _MICRO / _MICRO


class _EposLoops:
    locked: tuple[Key, ...] = ()
    keys: tuple[Key, ...] = ()

    def __init__(self, motor: Motor) -> None:
        self._motor = motor
        self._start = start_settings(motor.gains)

    def _microamperes(self, torque: float) -> int:
        raw = round(torque / self._motor.torque_constant * _MICRO)
        if not 0 <= raw <= _MOST:
            raise ValueError(f"a gain of {torque:g} N m does not fit the EPOS4's 32 bits")
        return raw

    def _gain(self, parameter: Parameter) -> float:
        return self._start.get(parameter, 0.0)


class PositionPid(_EposLoops):
    """0x30A1: current = P error + I integral + D its derivative, uA per rad."""

    keys = (_P, _I, _D, _ACCELERATION, _TORQUE_CONSTANT)

    def factory(self) -> dict[Key, Value]:
        """PID of the start gains' cascade."""
        outer, inner, reset = (
            self._gain(p)
            for p in (Parameter.POSITION_P, Parameter.VELOCITY_P, Parameter.VELOCITY_I)
        )
        pid = pid_of(outer, inner, reset)
        return {
            **{key: self._microamperes(gain) for key, gain in zip((_P, _I, _D), pid, strict=True)},
            _ACCELERATION: self._microamperes(self._gain(Parameter.INERTIA_FF)),
        }

    def settings(self, read: Read) -> dict[Parameter, float]:
        """Return the cascade with the whole reference velocity fed forward that is this PID."""
        stiffness, windup, damping = (_newton_metres(read, key) for key in (_P, _I, _D))
        inertia = _newton_metres(read, _ACCELERATION)
        cascade = cascade_of(stiffness, windup, damping)
        return {**self._start, **cascade, Parameter.INERTIA_FF: inertia}


class DualLoop(_EposLoops):
    """0x30AE: position P in 0.001/s on the load, velocity PI in uA on the motor."""

    keys = (
        _LOW,
        _HIGH,
        _AUXILIARY_P,
        _AUXILIARY_I,
        _AUXILIARY_VELOCITY,
        _AUXILIARY_ACCELERATION,
        _TORQUE_CONSTANT,
    )

    def factory(self) -> dict[Key, Value]:
        """Values for the start gains; both position gains alike."""
        outer = round(1000 * self._gain(Parameter.POSITION_P))
        return {
            _LOW: outer,
            _HIGH: outer,
            _AUXILIARY_P: self._microamperes(self._gain(Parameter.VELOCITY_P)),
            _AUXILIARY_I: self._microamperes(self._gain(Parameter.VELOCITY_I)),
            _AUXILIARY_VELOCITY: self._microamperes(self._gain(Parameter.VISCOUS_FF)),
            _AUXILIARY_ACCELERATION: self._microamperes(self._gain(Parameter.INERTIA_FF)),
        }

    def settings(self, read: Read) -> dict[Parameter, float]:
        """Firmware parameters, SI; the reference's velocity is fed forward as torque alone."""
        return {
            **self._start,
            Parameter.VELOCITY_FF: 0.0,
            Parameter.POSITION_P: (float(read(*_LOW)) + float(read(*_HIGH))) / 2000,
            Parameter.VELOCITY_P: _newton_metres(read, _AUXILIARY_P),
            Parameter.VELOCITY_I: _newton_metres(read, _AUXILIARY_I),
            Parameter.VISCOUS_FF: _newton_metres(read, _AUXILIARY_VELOCITY),
            Parameter.INERTIA_FF: _newton_metres(read, _AUXILIARY_ACCELERATION),
        }


def _values(motor: Motor) -> dict[Key, Value]:
    nominal = round(1000 * motor.rated_torque / motor.torque_constant)
    constant = round(_MICRO * motor.torque_constant)
    return {
        _NOMINAL_CURRENT: nominal,
        _CURRENT_LIMIT: round(1000 * motor.peak_torque / motor.torque_constant),
        _TORQUE_CONSTANT: constant,
        (0x6076, 0): round(nominal * constant / 1000),  # computed by the drive: mA times uN m/A
        (0x3000, 5): motor.counts_per_rev,
        (0x607D, 1): -(2**31),
        (0x607D, 2): 2**31 - 1,
    }


_OBJECTS, _HIDDEN = dressed(shipped("epos4.eds"))
_NOT_IMITATED = (
    "EPOS4: the velocity observer, filters, gain scheduling, and the PID's feed-forward of the velocity",
)
EPOS4 = Face(
    "epos4",
    PositionPid,
    _OBJECTS,
    _HIDDEN,
    units=rpm_units,
    values=_values,
    read_only=frozenset({(0x6076, 0), (0x60A9, 0)}),
    fault_after_lost_heartbeat=True,
    not_imitated=_NOT_IMITATED,
)
EPOS4_DUAL_LOOP = Face(
    "epos4-dual-loop",
    DualLoop,
    _OBJECTS,
    _HIDDEN,
    units=rpm_units,
    values=_values,
    latches={(0x30AE, 0x40): 0x1},
    read_only=frozenset({(0x6076, 0), (0x60A9, 0)}),
    fault_after_lost_heartbeat=True,
    not_imitated=_NOT_IMITATED,
)
