"""The face of any drive, from its EDS file and its drive profile.

Objects, types, access, ranges and defaults are the file's.  Units, states and ways are the profile's,
converted by formulas written down here by hands of their own.  What a profile says is taken for what
such a drive does: whether that is so, only the real drive tells.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from math import pi, prod
from pathlib import Path

from durand.datatypes import is_float, is_numeric, range_dict

from drives.objects import ObjectAddress
from drives.profile import UNKNOWN, DriveProfile, ParameterInfo, PositionScale, Store, TorqueScale
from drives.profile.drive import BUILT_IN_QUANTITIES
from drives.profile.eds import read_eds
from drives.sim.dictionary import Key, Value
from drives.sim.entries import Entry, ObjectEntry
from drives.sim.faces.eds_entries import EdsFile
from drives.sim.faces.face import (
    Face,
    Lock,
    Motor,
    Read,
    Storing,
    cascade_of,
    counts_units,
    pid_of,
    rpm_units,
    start_settings,
)
from drives.sim.faces.merge import MODES, merged, with_modes
from drives.sim.faces.others import PASSWORD
from drives.sim.running import INNER_RATE
from drives.sim.scales import GAIN_NAMES
from drives.sim.servo_kernel import Parameter
from drives.sim.servo_settings import ranges

COARSEST = 1e-4
"""Relative rounding of a rated torque above which the drive's torques would not be what they should."""
_PID, _CASCADE = ("pid_p", "pid_i", "pid_d"), ("position_p", "velocity_p", "velocity_i")
_RPM = 0x00B44700
"""Of 0x60A9, where the file tells none."""
_WHOLE_RANGE = {(0x607D, 1): -(2**31), (0x607D, 2): 2**31 - 1}


@dataclass(frozen=True)
class _Told:
    """What files tell of one kind of drive."""

    profile: DriveProfile
    eds: str
    """Name of the file."""
    entries: Mapping[Key, Entry]
    """What the drive shows."""

    @property
    def understood(self) -> dict[str, ParameterInfo]:
        """Parameters whose unit is known, by name, in order."""
        quantities = self.profile.quantities
        known = {*BUILT_IN_QUANTITIES, *(n for n, q in quantities.items() if q.scale != UNKNOWN)}
        understood: dict[str, ParameterInfo] = {}
        for name, one in self.profile.parameters.items():
            if one.factor != UNKNOWN and known.issuperset(one.times):
                understood[name] = one
                known.add(name)
        return understood

    def default(self, address: ObjectAddress) -> float:
        """Return the number that the file gives an object."""
        value = self.entries[_key(address)].default
        return 0.0 if isinstance(value, bytes) else float(value)

    def fitting(self, place: str, address: ObjectAddress, exact: float) -> int | float:
        """Return a value as the object holds it; raise ValueError if it holds no such value."""
        entry = self.entries[_key(address)]
        value = exact if is_float(entry.type) else round(exact)
        low, high = range_dict[entry.type]
        low = low if entry.low is None else max(low, entry.low)
        high = high if entry.high is None else min(high, entry.high)
        if not low <= value <= high:
            raise ValueError(
                f"{place} is {exact:.6g} in object {address} ({entry.type.name}), which holds {low:g} "
                f"to {high:g}. Correct `scale` or `object` in drive profile {self.profile.name}, or the "
                "simulated value"
            )
        return value


def own_face(profile: DriveProfile, eds: Path) -> Face:
    """Return the face of a drive that is told by its files.

    Raises
    ------
    ProfileError
        If the EDS can not be read.
    ValueError
        If the profile names objects that the EDS does not have, or has with another type.
    """
    read_eds(eds)  # says in the tool's words what is no EDS
    file = EdsFile(eds)
    objects, hidden = merged(file)
    shown = {e.key: e for o in objects for e in o.entries if e.key not in hidden}
    told = _Told(profile, eds.name, shown)
    _check_objects(told)
    parameters = frozenset(_key(one.object) for one in profile.parameters.values())
    read_only = parameters if profile.gains_via == "read-only" else frozenset()
    torque = profile.torque
    if isinstance(torque, TorqueScale) and torque.computed is True:
        read_only |= {_key(torque.per_mille_of)}
    lock = None
    if profile.unlock is not None:
        level = profile.unlock.level
        level_key = None if level is None else _key(level)
        lock = Lock(_key(profile.unlock.object), level_key, PASSWORD, parameters)
    return Face(
        profile.name,
        partial(ProfileLoops, told),
        with_modes(_as_told(objects, profile, file), _modes(profile, file)),
        hidden,
        eds=eds.read_bytes(),
        units=_units(told),
        values=partial(_values, told),
        read_only=read_only,
        latches={_key(latch.object): latch.set_bits for latch in profile.latches},
        waiting={
            _key(profile.parameters[name].object): _key(latch.object)
            for latch in profile.latches
            for name in latch.after
        },
        storing=_storing(profile),
        fault_after_lost_heartbeat=profile.recovery == "communication reset",
        lock=lock,
        not_imitated=(
            f"{profile.name}: objects that its profile gives no meaning hold values and do nothing",
        ),
    )


class ProfileLoops:
    """Gains as the profile has them: physical = scale * value ** power * product of ``times``.

    A gain that was not given at the start is what the EDS file has; one without an object, or of
    unknown unit, stays what it was given as.
    """

    def __init__(self, told: _Told, motor: Motor) -> None:
        self._told, self._motor = told, motor
        self._start = start_settings(motor.gains)
        self._parameters = told.understood
        quantities = told.profile.quantities
        self._quantities = {
            name: (_key(quantities[name].object), float(quantities[name].scale))
            for name in {other for one in self._parameters.values() for other in one.times}
            if name in quantities
        }
        objects = [_key(one.object) for one in self._parameters.values()]
        self.keys = tuple(dict.fromkeys((*objects, *(key for key, _ in self._quantities.values()))))
        self.locked: tuple[Key, ...] = tuple(
            _key(one.object) for one in told.profile.parameters.values() if one.write != "always"
        )

    def factory(self) -> dict[Key, Value]:
        """Objects for the start gains."""
        told, objects = self._told, _values(self._told, self._motor)
        held = self._held()
        gains: dict[Key, Value] = {}

        def read(index: int, subindex: int) -> Value:
            key = (index, subindex)
            return {**objects, **gains}.get(key, told.entries[key].default)

        physical: dict[str, float] = {}
        for name, one in self._parameters.items():
            factor = self._factor(one, physical, read)
            wanted = held.get(one.follows or name)
            if wanted is not None:
                exact = wanted / factor if factor else 0.0
                if one.power < 0 and exact:
                    exact = 1 / exact
                place = f"parameters.{name}: {wanted:g} {one.unit}"
                gains[_key(one.object)] = told.fitting(place, one.object, exact)
            physical[name] = _physical(one, factor, read(*_key(one.object)))
        self._check(self.settings(read))
        return gains

    def settings(self, read: Read) -> dict[Parameter, float]:
        """Firmware parameters, SI; the reference's velocity is fed forward as it was given."""
        physical: dict[str, float] = {}
        for name, one in self._parameters.items():
            factor = self._factor(one, physical, read)
            physical[name] = _physical(one, factor, read(*_key(one.object)))
        settings = {Parameter.VELOCITY_FF: 0.0, **self._start}
        if self._told.profile.structure == "pid" and physical.keys() >= set(_PID):
            settings |= cascade_of(*(physical[name] for name in _PID))
        acting = {n: value for n, value in physical.items() if n in (*GAIN_NAMES, "viscous_ff")}
        return settings | {Parameter[name.upper()]: value for name, value in acting.items()}

    def _held(self) -> dict[str, float]:
        """Return the start gains by the profile's names."""
        held = {parameter.name.lower(): value for parameter, value in self._start.items()}
        if self._told.profile.structure == "pid" and held.keys() >= set(_CASCADE):
            held |= zip(_PID, pid_of(*(held[name] for name in _CASCADE)), strict=True)
        return held

    def _factor(self, one: ParameterInfo, physical: Mapping[str, float], read: Read) -> float:
        known = {
            "counts_per_rev": float(self._motor.counts_per_rev),
            "rated_torque": self._motor.rated_torque,
            **physical,
        }
        for name, (key, scale) in self._quantities.items():
            known[name] = float(read(*key)) * scale
        return float(one.factor) * prod(known[name] ** power for name, power in one.times.items())

    def _check(self, settings: Mapping[Parameter, float]) -> None:
        allowed = ranges(float(INNER_RATE))
        for parameter, value in settings.items():
            one = allowed[parameter]
            if not one.low <= value <= one.high:
                raise ValueError(
                    f"{parameter.name.lower()} would begin with {value:g} {one.unit}, by the start "
                    f"gains and {self._told.eds}; a simulated drive works with {one.low:g} to "
                    f"{one.high:g}. Give it in `gains`"
                )


def _physical(one: ParameterInfo, factor: float, raw: Value) -> float:
    value = float(raw)
    if one.power < 0:
        return factor / value if value else 0.0
    return factor * value


# --- what the profile names -------------------------------------------------------------------------


def _named(profile: DriveProfile) -> Iterator[tuple[str, ObjectAddress, str]]:
    """Yield every object that a profile relies on: its key there, and the type that it is told."""
    for name, one in profile.parameters.items():
        yield f"parameters.{name}", one.object, one.told_type
        if one.only_if is not None and not one.only_if.missing_is_fine:
            yield f"parameters.{name}.only_if", one.only_if.object, one.only_if.type
    for name, quantity in profile.quantities.items():
        yield f"quantities.{name}", quantity.object, quantity.type
    for latch in profile.latches:
        yield "latches", latch.object, latch.type
    if profile.unlock is not None:
        yield "unlock.object", profile.unlock.object, UNKNOWN
        if profile.unlock.level is not None:
            yield "unlock.level", profile.unlock.level, UNKNOWN
    if isinstance(profile.store, Store):
        yield "store.object", profile.store.object, UNKNOWN
        if profile.store.status is not None:
            yield "store.status", profile.store.status, UNKNOWN
    if isinstance(profile.torque, TorqueScale):
        yield "torque.per_mille_of", profile.torque.per_mille_of, UNKNOWN
        if isinstance(profile.torque.constant, ObjectAddress):
            yield "torque.constant", profile.torque.constant, UNKNOWN
    position = profile.position
    if isinstance(position, PositionScale) and position != PositionScale():
        for key, address in (("counts", position.counts), ("revolutions", position.revolutions)):
            if isinstance(address, ObjectAddress):
                yield f"position.{key}", address, UNKNOWN


def _check_objects(told: _Told) -> None:
    profile = told.profile
    for place, address, kind in _named(profile):
        entry = told.entries.get(_key(address))
        if entry is None:
            raise ValueError(
                f"drive profile {profile.name} names object {address} ({place}), which {told.eds} does "
                "not have. Correct the profile, or give the EDS of this drive's firmware"
            )
        if place != "unlock.object" and not is_numeric(entry.type):
            raise ValueError(
                f"object {address} ({place} of drive profile {profile.name}) is no number in "
                f"{told.eds}. Correct the profile"
            )
        if kind not in (UNKNOWN, entry.type.name):
            raise ValueError(
                f"drive profile {profile.name} says that object {address} ({place}) is {kind}, and "
                f"{told.eds} that it is {entry.type.name}. Correct the profile"
            )
    for name in {other for one in told.understood.values() for other in one.times}:
        quantity = profile.quantities.get(name)
        if quantity and name != "torque_constant" and not told.default(quantity.object):
            raise ValueError(
                f"quantities.{name} of drive profile {profile.name}: {told.eds} gives object "
                f"{quantity.object} no value. Write what your drive holds there as its DefaultValue"
            )


# --- what the drive holds ---------------------------------------------------------------------------


def _values(told: _Told, motor: Motor) -> dict[Key, Value]:
    """Objects that tell of motor and encoder, as somebody entered them."""
    profile = told.profile
    wanted: list[tuple[str, ObjectAddress, float]] = [
        ("the gear ratio", ObjectAddress(0x6091, 1), 1),
        ("the gear ratio", ObjectAddress(0x6091, 2), 1),
        ("the feed constant", ObjectAddress(0x6092, 1), motor.counts_per_rev),
        ("the feed constant", ObjectAddress(0x6092, 2), 1),
    ]
    position, torque = profile.position, profile.torque
    if isinstance(position, PositionScale):
        if isinstance(position.counts, ObjectAddress):
            wanted.append(("encoder_counts_per_rev", position.counts, motor.counts_per_rev))
        if position.revolutions is not None:
            wanted.append(("the encoder's revolutions", position.revolutions, 1))
    if isinstance(torque, TorqueScale) and not isinstance(torque.scale, str):
        rated = motor.rated_torque if torque.unit == "N m" else _current(motor)
        _check_rounding(told, torque, rated, motor.rated_torque)
        wanted.append(("rated_torque", torque.per_mille_of, rated / torque.scale))
        if isinstance(torque.constant, ObjectAddress):
            constant = motor.torque_constant / torque.constant_scale
            wanted.append(("torque_constant", torque.constant, constant))
    quantity = profile.quantities.get("torque_constant")
    if quantity is not None and not isinstance(quantity.scale, str):
        constant = motor.torque_constant / quantity.scale
        wanted.append(("torque_constant", quantity.object, constant))
    values: dict[Key, Value] = {
        _key(address): told.fitting(place, address, value)
        for place, address, value in wanted
        if (entry := told.entries.get(_key(address))) is not None and is_numeric(entry.type)
    }
    for one in profile.parameters.values():
        if one.only_if is not None and _key(one.only_if.object) in told.entries:
            values[_key(one.only_if.object)] = one.only_if.equals
    return values


def _current(motor: Motor) -> float:
    return motor.rated_torque / motor.torque_constant


def _check_rounding(told: _Told, torque: TorqueScale, rated: float, given: float) -> None:
    """Refuse a rated torque that the drive can not hold: all of its torques would be wrong by it.

    ``rated``: what the object holds, N m or A; ``given``: the simulated drive's, N m.
    """
    units = rated / float(torque.scale)
    if is_float(told.entries[_key(torque.per_mille_of)].type):
        return
    if abs(round(units) / units - 1) > COARSEST:
        raise ValueError(
            f"the rated {'torque' if torque.unit == 'N m' else 'current'} {rated:.6g} {torque.unit} is "
            f"{units:.6g} in object {torque.per_mille_of} of drive profile {told.profile.name}, which "
            "holds whole numbers. Give a rated_torque that is one there, such as "
            f"{given * max(1, round(units)) / units:.6g}"
        )


def _as_told(
    objects: tuple[ObjectEntry, ...], profile: DriveProfile, file: EdsFile
) -> tuple[ObjectEntry, ...]:
    """Fill in what the file leaves open, and take commands out of what is stored."""
    identity = profile.identity
    open_values = {
        (0x1000, 0): _default(file, 0x1000) or identity.device_type,
        (0x1018, 1): identity.vendor_id,
        (0x1018, 2): identity.product_code,
        (0x60C2, 1): 1,
        (0x60C2, 2): profile.interpolation_index,
        (0x60A9, 0): _RPM if profile.velocity == "0x60A9" else None,
    }
    ends = {e.key: float(e.default) for o in objects for e in o.entries if e.key in _WHOLE_RANGE}
    free = ends[0x607D, 1] >= ends[0x607D, 2]  # nobody set any

    def filled(entry: Entry) -> Entry:
        told = open_values.get(entry.key)
        if told is not None and (entry.key == (0x1000, 0) or not entry.default):
            entry = replace(entry, default=told)
        if free and entry.key in _WHOLE_RANGE:
            entry = replace(entry, default=_WHOLE_RANGE[entry.key])
        if profile.is_volatile(ObjectAddress(*entry.key)):
            entry = replace(entry, stored=False)
        return entry

    return tuple(replace(o, entries=tuple(filled(e) for e in o.entries)) for o in objects)


def _default(file: EdsFile, index: int) -> int:
    described = file.objects.get(index)
    value = described.entries[0].default if described is not None else 0
    return value if isinstance(value, int) else 0


def _modes(profile: DriveProfile, file: EdsFile) -> int:
    """Return 0x6502."""
    told = _default(file, 0x6502) or profile.identity.supported_modes
    if told:
        return told
    if isinstance(profile.modes, str):
        return MODES
    return sum(1 << (mode - 1) for mode in set(profile.modes) if 1 <= mode <= 32)


def _storing(profile: DriveProfile) -> Storing:
    how = profile.store
    if not isinstance(how, Store):
        return Storing()
    status = None
    if how.status is not None and how.status_done is not None:
        status = (_key(how.status), how.status_done)
    return Storing(_key(how.object), how.signature_value, how.states != "any", status)


def _units(told: _Told) -> Callable[[Motor], tuple[float, float]]:
    """Return what gives rad/s per velocity unit, and rad/s2 per acceleration unit."""
    unit = told.profile.velocity
    if unit == "rpm":
        return rpm_units
    if unit == "0.001 rpm":
        return lambda motor: _alike(motor.turn / 60_000)
    if unit == "counts * 512 / 1875":  # times rpm
        return lambda motor: _alike(motor.turn / 60 / (motor.counts_per_rev * 512 / 1875))
    if unit == "0x60A9" and (0x60A9, 0) in told.entries:
        return _coded_units(int(told.default(ObjectAddress(0x60A9))) or _RPM, told.eds)
    return counts_units


def _coded_units(code: int, eds: str) -> Callable[[Motor], tuple[float, float]]:
    """Return the same for a value of 0x60A9 (CiA 303-2)."""
    prefix = int.from_bytes((code >> 24 & 0xFF,), signed=True)
    seconds = {0x03: 1, 0x47: 60}.get(code >> 8 & 0xFF)
    what = code >> 16 & 0xFF
    if seconds is None or what not in (0xB4, 0xB5, 0x10, 0x41):
        raise ValueError(
            f"{eds} gives 0x60A9 the value 0x{code:08X}, which is no velocity unit that is known here. "
            f"Write what your drive holds there as its DefaultValue, 0x{_RPM:08X} for rpm"
        )

    def units(motor: Motor) -> tuple[float, float]:
        turns = {0xB4: 1.0, 0xB5: 1 / motor.counts_per_rev, 0x10: 0.5 / pi, 0x41: 1 / 360}[what]
        return _alike(motor.turn * turns * 10.0**prefix / seconds)

    return units


def _alike(unit: float) -> tuple[float, float]:
    return unit, unit


def _key(address: ObjectAddress) -> Key:
    return address.index, address.subindex
