"""One simulated drive on the bus: a CANopen slave (CiA 301) with a CiA 402 servo drive in it.

The SDO server, LSS and the dictionary's ground are durand's; PDO, NMT, heartbeat, emergencies,
non-volatile memory and the drive are this package's (the reasons stand in their modules).
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from durand.services.lss import LSSSlave
from durand.services.nmt import StateEnum
from durand.services.sdo.server import SDODomainAbort

from drives.sim.abort_codes import Abort
from drives.sim.dictionary import DriveDictionary, Guard, Key, Value
from drives.sim.emergency import (
    HEARTBEAT_LOST,
    PDO_TOO_SHORT,
    EmergencyProducer,
    ErrorRegister,
    refuse_cob_id,
)
from drives.sim.faces import REFERENCE, Face
from drives.sim.faces.face import Loops
from drives.sim.firmware import SimulatedAxes
from drives.sim.heartbeat import HeartbeatConsumers, HeartbeatProducer
from drives.sim.memory import LOAD, Bank, NonVolatileMemory
from drives.sim.motion import MotionControl
from drives.sim.nmt import NetworkManagement
from drives.sim.pdo import Getter, PdoService, Setter
from drives.sim.port import BusPort
from drives.sim.scales import LIMIT_KEYS, Scales
from drives.sim.scheduler import VirtualScheduler
from drives.sim.sdo import DriveSdoServer

CONNECTION_ERROR, PARAMETERS_LOST = 0x8100, 0x6310
_PRODUCES_SYNC = 1 << 30
_FAULT, _DISABLE_VOLTAGE, _QUICK_STOP = 1, 2, 3
_TO_PRE_OPERATIONAL, _TO_STOPPED = 0, 2


class DriveNode:
    """A node: services around one dictionary and one axis of the firmware.

    Parameters
    ----------
    name
        Of the axis.
    node_id
        1 to 127.
    port
        Its connection to the bus.
    axes, axis
        The machine's firmware and the number of this drive's axis.
    scales
        Of this drive.
    overrides
        Factory values that differ from the dictionary's defaults.
    scheduler
        The machine's.
    store_time
        Time that storing to non-volatile memory takes, s; the SDO answer comes after it.
    on_communication_change
        Called when the SYNC identifier, the cycle time or the NMT state changed.
    loops
        How its objects are the firmware's parameters.
    face
        What kind of drive it is.
    """

    def __init__(
        self,
        name: str,
        node_id: int,
        port: BusPort,
        axes: SimulatedAxes,
        axis: int,
        scales: Scales,
        overrides: dict[Key, Value],
        scheduler: VirtualScheduler,
        store_time: float,
        on_communication_change: Callable[[], None],
        loops: Loops,
        face: Face = REFERENCE,
    ) -> None:
        self.face, self._loops = face, loops
        self.name, self.axis, self.store_time = name, axis, store_time
        self._first_node_id = node_id
        self.network, self._axes, self._scales = port, axes, scales
        self._scheduler, self._changed = scheduler, on_communication_change
        self.store_fails: int | None = None
        self.store_forgets = False
        """Fault injection: abort code with which storing ends."""
        self.on_store: Callable[[], None] | None = None
        """Fault injection: called when storing begins."""
        self._saving = False
        self.nmt = NetworkManagement(node_id, self._reset)
        self.dictionary = dictionary = DriveDictionary(
            node_id, overrides, face.objects, face.hidden
        )
        self.memory = NonVolatileMemory()
        self.emergency = EmergencyProducer(dictionary, self._send_emergency)
        self.motion = MotionControl(dictionary, self.emergency, axes, axis, scales, scheduler)
        self.pdo = PdoService(
            dictionary, self, port, self.motion.apply_targets, self.emergency.report
        )
        self.heartbeat = HeartbeatProducer(dictionary, scheduler, self._send_state)
        self.consumers = HeartbeatConsumers(
            dictionary, scheduler, self._heartbeat_lost, self._heartbeat_back
        )
        self._watched: tuple[int, ...] = ()
        self._taken_over: dict[Key, Value] = {}
        """What acts of the objects that wait for a latch."""
        self._latched_getters, self._live_getters = self._make_getters()
        self._setters = self._make_setters()
        self._connect_objects()
        described = dictionary[0x1200]
        self.sdo = DriveSdoServer(self, scheduler)
        dictionary[0x1200] = described  # durand puts its own description there
        self.lss = LSSSlave(self)
        self.lss.set_store_configuration_callback(self._store_node_id)
        self._connect_memory()
        self.nmt.state_callbacks.add(self._nmt_changed)
        port.add_subscription(0, self.nmt.handle)
        self._take_over(face.waiting)
        self._boot()

    # -- what others ask of a node ----------------------------------------------------------------

    @property
    def node_id(self) -> int:
        """Node id in use."""
        return self.nmt.node_id

    @property
    def object_dictionary(self) -> DriveDictionary:
        """What durand calls the dictionary."""
        return self.dictionary

    @property
    def period(self) -> int:
        """Time between two SYNCs that the drive is set to, ns: 0x1006, or 0x60C2 where that is 0."""
        cycle = int(self.dictionary.read(0x1006, 0)) * 1000
        return cycle or self._interpolation_period()

    @property
    def sync_identifier(self) -> int:
        """CAN identifier of the SYNC that the node listens to."""
        return int(self.dictionary.read(0x1005, 0)) & 0x7FF

    def setter(self, key: Key) -> Setter:
        """Return what puts a value received in a PDO into the drive."""
        return self._setters.get(key) or (lambda value: self._write_from_pdo(key, value))

    def getter(self, key: Key, *, latched: bool) -> Getter:
        """Return what gives a value for a PDO: as it was at the last SYNC, or as it is."""
        if latched and key in self._latched_getters:
            return self._latched_getters[key]
        return self._live_getters.get(key) or (lambda: self.dictionary.read(*key))

    # -- time -------------------------------------------------------------------------------------

    def at_sync(self, counts: int, per_mille: int, velocity: float) -> None:
        """Handle a SYNC: what the firmware sampled goes out, what was received acts."""
        self.motion.latch(counts, per_mille, velocity)
        self.pdo.at_sync()

    def at_task(self, now: int) -> None:
        """Do what is done every millisecond; ``now`` in ns."""
        self.motion.at_task()
        if self.pdo.event_driven:
            self.pdo.at_task(now)

    def power_cycle(self, bank: Bank = "old") -> None:
        """Switch the drive's supply off and on: what was not stored is forgotten.

        ``bank`` is what its memory then holds, if it was storing at that moment.
        """
        if self._saving and self.sdo.busy:
            self.memory.cut_off(bank, self.dictionary)
        self.nmt.pending_node_id = self.memory.node_id or self._first_node_id
        self._reset(whole=True)

    def limit_torque(self, per_mille: float) -> None:
        """Fault injection: let the firmware give so much torque at most, whatever 0x6072 says."""
        parameter, limit = self._scales.limit((0x6072, 0), per_mille)
        self._axes.set(self.axis, parameter, limit)

    # -- starting and resetting -------------------------------------------------------------------

    def _reset(self, whole: bool) -> None:
        self.nmt.set_state(StateEnum.INITIALISATION)
        self.sdo.forget()
        if self.nmt.pending_node_id != self.nmt.node_id:
            self.nmt.node_id = self.nmt.pending_node_id
            self.dictionary.set_node_id(self.nmt.node_id)
        self.motion.reset_blocked = False
        if not whole:
            self._connection_aborted()
            self.emergency.clear(PDO_TOO_SHORT)
        self.memory.recall(self.dictionary, all_of_it=whole)
        self.heartbeat.start(0)
        if whole:
            self.emergency.power_up()
            self.motion.power_up()
            self._take_over(self.face.waiting)
        self._boot()
        if whole and self.memory.corrupted:
            self.emergency.report(PARAMETERS_LOST, ErrorRegister.DEVICE_PROFILE)

    def _boot(self) -> None:
        self._apply_parameters()
        self.network.send(0x700 + self.node_id, b"\x00")
        self.nmt.set_state(StateEnum.PRE_OPERATIONAL)

    def _apply_parameters(self) -> None:
        self._loops_changed()
        for key in LIMIT_KEYS:
            self._write_limit(key, self.dictionary.read(*key))
        self._interpolation_changed()
        self.heartbeat.start(int(self.dictionary.read(0x1017, 0)))
        self._configure_consumers()

    def _nmt_changed(self, state: StateEnum) -> None:
        if state == StateEnum.OPERATIONAL:
            self.pdo.start()
        else:
            self.pdo.stop()
        if state == StateEnum.STOPPED:
            self._connection_aborted()
        self._changed()

    # -- objects ----------------------------------------------------------------------------------

    def _connect_objects(self) -> None:
        dictionary = self.dictionary
        eds = self.face.eds
        dictionary.set_read_callback(0x1021, 0, lambda: eds)
        for key, getter in self._live_getters.items():
            dictionary.set_read_callback(*key, getter)
        for key, setter in self._setters.items():
            dictionary.effects[key] = partial(self._written, setter)
        for key in self._loops.keys:
            dictionary.effects[key] = lambda _: self._loops_changed()
        for key in LIMIT_KEYS:
            dictionary.effects[key] = partial(self._write_limit, key)
        for key, bits in self.face.latches.items():
            dictionary.effects[key] = partial(self._latched, key, bits)
        for key in self.face.read_only:
            self._guard(key, lambda _: Abort.READ_ONLY)
        self._connect_lock()
        dictionary.effects[0x6060, 0] = self.motion.set_mode
        for key in self._loops.locked:
            self._guard(key, lambda _: Abort.WRONG_STATE if self.motion.powered else None)
        for key in self._loops.keys:
            self._guard(key, partial(self._refuse_gain, key))
        dictionary.guards[0x1005, 0] = self._refuse_sync
        for key in ((0x1005, 0), (0x1006, 0)):
            dictionary.effects[key] = lambda _: self._changed()
        for subindex in (1, 2):
            dictionary.effects[0x60C2, subindex] = lambda _: self._interpolation_changed()
            dictionary.effects[0x1016, subindex] = lambda _: self._configure_consumers()

    def _connect_memory(self) -> None:
        dictionary = self.dictionary
        how = self.face.storing
        dictionary.guards[how.key] = self._refuse_store
        dictionary.guards[0x1011, 1] = lambda v: None if v == LOAD else Abort.CAN_NOT_STORE
        dictionary.effects[how.key] = lambda _: self._begin_store(self._save)
        dictionary.effects[0x1011, 1] = lambda _: self._begin_store(self._erase)
        for key in (how.key, (0x1011, 1)):
            dictionary.set_read_callback(*key, lambda: 1)

    def _make_getters(self) -> tuple[dict[Key, Getter], dict[Key, Getter]]:
        motion, axes, axis = self.motion, self._axes, self.axis
        both: dict[Key, Getter] = {
            (0x6040, 0): lambda: motion.controlword,
            (0x6041, 0): lambda: motion.statusword,
            (0x6061, 0): lambda: motion.mode,
            (0x6071, 0): lambda: motion.target_torque,
            (0x6074, 0): lambda: motion.torque_demand,
            (0x607A, 0): lambda: motion.target_position,
            (0x60B0, 0): lambda: motion.position_offset,
            (0x60B1, 0): lambda: motion.velocity_offset,
            (0x60B2, 0): lambda: motion.torque_offset,
            (0x60F4, 0): lambda: motion.following_error,
            (0x60FF, 0): lambda: motion.target_velocity,
        }
        latched: dict[Key, Getter] = {
            (0x6064, 0): lambda: motion.position_actual,
            (0x606C, 0): lambda: motion.velocity_actual,
            (0x6077, 0): lambda: motion.torque_actual,
        }

        def sampled() -> MotionControl:
            per_mille = axes.measured_torque_per_mille(axis)
            motion.latch(axes.position_counts(axis), per_mille, axes.velocity(axis))
            return motion

        live: dict[Key, Getter] = {
            (0x6064, 0): lambda: sampled().position_actual,
            (0x606C, 0): lambda: sampled().velocity_actual,
            (0x6077, 0): lambda: sampled().torque_actual,
        }
        return both | latched, both | live

    def _make_setters(self) -> dict[Key, Setter]:
        motion = self.motion
        return {
            (0x6040, 0): motion.write_controlword,
            (0x6071, 0): motion.set_target_torque,
            (0x607A, 0): motion.set_target_position,
            (0x60B0, 0): motion.set_position_offset,
            (0x60B1, 0): motion.set_velocity_offset,
            (0x60B2, 0): motion.set_torque_offset,
            (0x60FF, 0): motion.set_target_velocity,
        }

    def _written(self, setter: Setter, value: Value) -> None:
        setter(value)
        self.motion.apply_targets()

    def _write_from_pdo(self, key: Key, value: Value) -> None:
        """Write what a PDO brought; a value that the object refuses is passed over."""
        try:
            if self.dictionary.read(*key) != value:
                self.dictionary.write(*key, value)
        except SDODomainAbort:
            return

    def _connect_lock(self) -> None:
        lock = self.face.lock
        if lock is None:
            return
        dictionary = self.dictionary

        def right(password: Value) -> bool:
            return isinstance(password, bytes) and password.rstrip(b"\0") == lock.password

        def give(password: Value) -> None:
            if lock.level_key is not None:
                dictionary.force(*lock.level_key, int(right(password)))

        def closed(_value: Value) -> int | None:
            if lock.level_key is not None:
                opened = bool(dictionary.read(*lock.level_key))
            else:
                opened = right(dictionary.read(*lock.password_key))
            return None if opened else Abort.UNSUPPORTED_ACCESS

        dictionary.effects[lock.password_key] = give
        for key in lock.keys:
            self._guard(key, closed)

    def _guard(self, key: Key, guard: Guard) -> None:
        """Let a guard stand beside those that an object has already."""
        guards = self.dictionary.guards
        before = guards.get(key, lambda _: None)
        guards[key] = lambda value: before(value) or guard(value)

    def _latched(self, key: Key, bits: int, value: int) -> None:
        self.dictionary.force(*key, value & ~bits)
        if value & bits:
            self._take_over(one for one, latch in self.face.waiting.items() if latch == key)
            self._loops_changed()

    def _take_over(self, keys: Iterable[Key]) -> None:
        for key in keys:
            self._taken_over[key] = self.dictionary.read(*key)

    def _acting(self, index: int, subindex: int) -> Value:
        """Return the value of an object that the loops work with."""
        key = (index, subindex)
        return self._taken_over[key] if key in self._taken_over else self.dictionary.read(*key)

    def _refuse_gain(self, key: Key, value: Value) -> int | None:
        """Refuse a value with which the loops could not work."""
        written = self._loops.settings(lambda *one: value if one == key else self._acting(*one))
        for parameter, wanted in written.items():
            allowed = self._axes.range_of(parameter)
            if not allowed.low <= wanted <= allowed.high:
                return Abort.INVALID_VALUE
        return None

    def _loops_changed(self) -> None:
        for parameter, value in self._loops.settings(self._acting).items():
            if self._axes.get(self.axis, parameter) != value:
                self._axes.set(self.axis, parameter, value)

    def _write_limit(self, key: Key, value: Any) -> None:
        if key in ((0x607F, 0), (0x6080, 0)):
            value = min(self.dictionary.read(0x607F, 0), self.dictionary.read(0x6080, 0))
        parameter, limit = self._scales.limit(key, value)
        self._axes.set(self.axis, parameter, limit)
        self.motion.update_limits()

    def _interpolation_period(self) -> int:
        value = int(self.dictionary.read(0x60C2, 1))
        exponent = int(self.dictionary.read(0x60C2, 2))
        return value * int(10 ** (9 + exponent))

    def _interpolation_changed(self) -> None:
        self.motion.set_interpolation(self._interpolation_period())
        self._changed()

    def _refuse_sync(self, value: int) -> int | None:
        if value & _PRODUCES_SYNC:
            return Abort.INVALID_VALUE
        return refuse_cob_id(value & 0x7FFFFFFF, 1 << 31)

    # -- errors of the communication --------------------------------------------------------------

    def _heartbeat_lost(self, node_id: int) -> None:
        data = bytes((node_id,))
        option = int(self.dictionary.read(0x6007, 0))
        if self.face.fault_after_lost_heartbeat and option:
            self.motion.fault(HEARTBEAT_LOST, ErrorRegister.COMMUNICATION, data)
            self.motion.reset_blocked = True
        elif option == _FAULT:
            self.motion.fault(HEARTBEAT_LOST, ErrorRegister.COMMUNICATION, data)
        else:
            self.emergency.report(HEARTBEAT_LOST, ErrorRegister.COMMUNICATION, data)
            self._react(option)
        behaviour = int(self.dictionary.read(0x1029, 1))
        if behaviour == _TO_PRE_OPERATIONAL and self.nmt.operational:
            self.nmt.set_state(StateEnum.PRE_OPERATIONAL)
        elif behaviour == _TO_STOPPED:
            self.nmt.set_state(StateEnum.STOPPED)

    def _heartbeat_back(self, _node_id: int) -> None:
        if not self.motion.in_fault:
            self.emergency.clear(HEARTBEAT_LOST)

    def _connection_aborted(self) -> None:
        """React to NMT stop and reset of the communication, as 0x6007 says."""
        option = int(self.dictionary.read(0x6007, 0))
        if option == _FAULT and self.motion.powered:
            self.motion.fault(CONNECTION_ERROR, ErrorRegister.COMMUNICATION)
        else:
            self._react(option)

    def _react(self, option: int) -> None:
        if option == _DISABLE_VOLTAGE:
            self.motion.disable_voltage()
        elif option == _QUICK_STOP:
            self.motion.quick_stop()

    def _configure_consumers(self) -> None:
        self.consumers.configure()
        for node_id in self._watched:
            self.network.remove_subscription(0x700 + node_id)
        self._watched = self.consumers.watched
        for node_id in self._watched:
            self.network.add_subscription(0x700 + node_id, self._heard)

    def _heard(self, cob_id: int, _data: bytes | bytearray) -> None:
        self.consumers.heard(cob_id - 0x700)

    # -- frames and memory ------------------------------------------------------------------------

    def _send_state(self) -> None:
        self.network.send(0x700 + self.node_id, bytes((self.nmt.state,)))

    def _send_emergency(self, cob_id: int, data: bytes) -> None:
        if self.nmt.state in (StateEnum.PRE_OPERATIONAL, StateEnum.OPERATIONAL):
            self.network.send(cob_id, data)

    def _refuse_store(self, value: Value) -> int | None:
        how = self.face.storing
        if value != how.signature:
            return Abort.CAN_NOT_STORE
        return Abort.WRONG_STATE if how.disabled_only and self.motion.powered else None

    def _begin_store(self, finish: Callable[[], int | None]) -> None:
        if self.on_store is not None:
            self.on_store()
        self._saving = finish == self._save
        self.sdo.wait_with_answer(self.store_time, finish)

    def _save(self) -> int | None:
        if self.store_fails is None and not self.store_forgets:
            self.memory.save(self.dictionary)
        status = self.face.storing.status
        if status is not None and self.store_fails is None:
            self.dictionary.force(*status[0], status[1])
        return self.store_fails

    def _erase(self) -> int | None:
        if self.store_fails is None:
            self.memory.erase()
        return self.store_fails

    def _store_node_id(self, _bit_rate: int | None, node_id: int) -> None:
        self.memory.node_id = node_id
