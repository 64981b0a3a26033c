"""The CiA 402 part of the simulated drive: power states, modes, halt, stops and faults.

It stands between the objects (controlword, targets, option codes) and the firmware's loops
(:class:`drives.sim.firmware.SimulatedAxes`), which know nothing of CANopen.  Positions here are
encoder counts, velocities counts/s, torques per mille of the rated torque; the firmware has SI.

Where CiA 402 leaves a choice: stopping ramps that a command started (shutdown, disable operation
with option code 1) run in OPERATION ENABLED and the state changes at standstill; every stop ends
after a limited time even if the axis does not come to rest; QUICK STOP ACTIVE is left for OPERATION
ENABLED only by a controlword that changes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf

from drives.sim.dictionary import DriveDictionary
from drives.sim.emergency import FOLLOWING_ERROR, EmergencyProducer, ErrorRegister
from drives.sim.firmware import Parameter, SimulatedAxes
from drives.sim.scales import Scales
from drives.sim.scheduler import VirtualScheduler, nanoseconds
from drives.sim.set_points import SetPoints
from drives.sim.state_machine import TRANSITIONS, Command, Control, State, Status, command_of

NO_MODE, PROFILE_POSITION, CYCLIC_POSITION, CYCLIC_VELOCITY, CYCLIC_TORQUE = 0, 1, 8, 9, 10

_LIVE = frozenset(
    (
        State.READY_TO_SWITCH_ON,
        State.SWITCHED_ON,
        State.OPERATION_ENABLED,
        State.QUICK_STOP_ACTIVE,
        State.FAULT_REACTION_ACTIVE,
    )
)
_POWERED = frozenset(
    (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)
)
_COAST = 0
_QUICK_STOP_RAMP = (2, 6)
_STAY_STOPPED = (5, 6)
_STOP_MARGIN, _STOP_EXTRA = 2.0, 0.5
"""A stop may take so many times its ramp, and so many seconds more."""
_INT16, _INT32 = 2**15, 2**31
_LIMITED, _REACHED = int(Status.INTERNAL_LIMIT), int(Status.TARGET_REACHED)
_MODE_12, _ERROR = int(Status.MODE_12), int(Status.FOLLOWING_ERROR)
_HALT = int(Control.HALT)


@dataclass(frozen=True)
class _Stop:
    """A stop under way: until when at the latest (ns), and what comes after it."""

    deadline: int
    done: Callable[[], None]


class MotionControl:
    """Power states and modes of one drive.

    Parameters
    ----------
    dictionary
        Option codes, ramps and windows are read from it.
    emergency
        Hears of faults.
    axes, axis
        The firmware and the number of this drive's axis in it.
    scales
        Of this drive.
    scheduler
        Whose time it is.
    """

    def __init__(
        self,
        dictionary: DriveDictionary,
        emergency: EmergencyProducer,
        axes: SimulatedAxes,
        axis: int,
        scales: Scales,
        scheduler: VirtualScheduler,
    ) -> None:
        self._dictionary, self._emergency, self._scheduler = dictionary, emergency, scheduler
        self._axes, self._axis, self._scales = axes, axis, scales
        self._velocity_units = scales.velocity_units
        self.reset_blocked = False
        """Whether a fault reset is ignored, as some drives do until the communication was reset."""
        self._set_points = SetPoints(self._begin_profile)
        self._stop: _Stop | None = None
        self._leaving = False
        self._apply: Callable[[], None] | None = None
        self._steps = 1
        self._fault_code = 0
        self._last_velocity: float | None = None
        self.position_actual = self.torque_actual = self.velocity_actual = 0
        """Latched at the last SYNC or communication task: counts, per mille, counts/s."""
        self.forced_bits = 0
        """Fault injection: bits of the statusword that are set whatever the drive does."""
        self.enabling = True
        """Fault injection: False while the drive can not be enabled."""
        self.update_limits()
        self.power_up()

    # -- power-up and communication ---------------------------------------------------------------

    def power_up(self) -> None:
        """Start as a drive that was just switched on: power stage off, no targets."""
        self._axes.off(self._axis)
        self._stop, self._apply = None, None
        self.controlword = 0
        self.target_position = self.target_velocity = self.target_torque = 0
        self.position_offset = self.velocity_offset = self.torque_offset = 0
        self._offsets_changed = True
        self._last_velocity = None
        self._clamped = False
        self.mode = int(self._dictionary.read(0x6060, 0))
        self._halted = self._leaving = False
        self._fault_code = 0
        self._set_points.reset(0)
        self._enter(State.SWITCH_ON_DISABLED)

    def set_interpolation(self, period: int) -> None:
        """Take the time between two cyclic targets, ns."""
        self._steps = max(1, round(period * self._axes.rate / 1e9))

    # -- what is read -----------------------------------------------------------------------------

    @property
    def in_fault(self) -> bool:
        """Whether the drive waits for a fault reset, or is on its way there."""
        return self.state in (State.FAULT, State.FAULT_REACTION_ACTIVE)

    @property
    def statusword(self) -> int:
        """Object 0x6041; the torque limit in it is that of the last communication task."""
        word = self._state_bits
        state = self.state
        if state is State.OPERATION_ENABLED:
            if self._clamped or self._limited:
                word |= _LIMITED
            if self._halted or self._stop is not None:
                if self._axes.standstill(self._axis):
                    word |= _REACHED
            elif self.mode == PROFILE_POSITION:
                word |= self._profile_bits()
            elif self.mode != NO_MODE:
                word |= _MODE_12
        elif state is State.QUICK_STOP_ACTIVE and self._axes.standstill(self._axis):
            word |= _REACHED
        elif self._fault_code == FOLLOWING_ERROR:
            word |= _ERROR
        return word | self.forced_bits

    def latch(self, counts: int, per_mille: int, velocity: float) -> None:
        """Take what the firmware sampled: counts, per mille, rad/s.

        Counts wrap at 32 bits as an encoder's do; speed and torque stay at the ends of their types.
        """
        if not -_INT32 <= counts < _INT32:
            counts = (counts + _INT32) % (2 * _INT32) - _INT32
        speed = int(velocity * self._velocity_units)
        if not -_INT32 <= speed < _INT32:
            speed = _int32(speed)
        self.position_actual = counts
        self.torque_actual = per_mille if -_INT16 <= per_mille < _INT16 else _int16(per_mille)
        self.velocity_actual = speed

    @property
    def following_error(self) -> int:
        """Object 0x60F4, counts."""
        counts = self._axes.following_error(self._axis) * self._scales.counts_per_unit
        return _int32(counts)

    @property
    def torque_demand(self) -> int:
        """Object 0x6074, per mille."""
        demand = self._axes.reference_torque(self._axis) * 1000.0 / self._scales.rated_torque
        return _int16(demand)

    # -- targets ----------------------------------------------------------------------------------

    def set_target_position(self, value: int) -> None:
        """Object 0x607A."""
        self.target_position = value

    def set_target_velocity(self, value: int) -> None:
        """Object 0x60FF."""
        self.target_velocity = value

    def set_target_torque(self, value: int) -> None:
        """Object 0x6071."""
        self.target_torque = value

    def set_position_offset(self, value: int) -> None:
        """Object 0x60B0."""
        self.position_offset = value

    def set_velocity_offset(self, value: int) -> None:
        """Object 0x60B1."""
        if value != self.velocity_offset:
            self.velocity_offset = value
            self._offsets_changed = True

    def set_torque_offset(self, value: int) -> None:
        """Object 0x60B2."""
        if value != self.torque_offset:
            self.torque_offset = value
            self._offsets_changed = True

    def apply_targets(self) -> None:
        """Let the targets act, if the drive follows any: at a SYNC, or after a write."""
        if self._apply is not None:
            if self._offsets_changed:
                self._write_offsets()
            self._apply()

    def _write_offsets(self) -> None:
        cyclic = self.mode in (CYCLIC_POSITION, CYCLIC_VELOCITY, CYCLIC_TORQUE)
        velocity = self._scales.velocity(self.velocity_offset) if cyclic else 0.0
        torque = self._scales.torque(self.torque_offset) if cyclic else 0.0
        self._axes.set(self._axis, Parameter.VELOCITY_OFFSET, velocity)
        self._axes.set(self._axis, Parameter.TORQUE_OFFSET, torque)
        self._offsets_changed = False

    def _apply_position(self) -> None:
        target = self.target_position + self.position_offset
        self._clamped = not self._low <= target <= self._high
        scaled = target / self._scales.counts_per_unit
        self._axes.follow_position(self._axis, scaled, self._steps)

    def _apply_velocity(self) -> None:
        target = self._scales.velocity(self.target_velocity)
        if target == self._last_velocity:
            return
        before = self._last_velocity
        if before is None:
            before = self._axes.velocity(self._axis)
        ramp = abs(target - before) * self._axes.rate / self._steps or inf
        self._last_velocity = target
        self._axes.follow_velocity(self._axis, target, ramp, ramp)

    def _apply_torque(self) -> None:
        self._axes.follow_torque(self._axis, self._scales.torque(self.target_torque))

    # -- modes ------------------------------------------------------------------------------------

    def set_mode(self, mode: int) -> None:
        """Object 0x6060; a drive that is enabled goes on in the new mode at once."""
        if mode == self.mode:
            return
        self.mode = mode
        self._offsets_changed = True
        if self.state is State.OPERATION_ENABLED and self._stop is None and not self._halted:
            self._follow()

    def update_limits(self) -> None:
        """Take the software position limits 0x607D as they stand."""
        self._low = int(self._dictionary.read(0x607D, 1))
        self._high = int(self._dictionary.read(0x607D, 2))

    def _follow(self) -> None:
        """Begin to do what the mode says."""
        self._clamped = False
        self._last_velocity = None
        self._apply = {
            CYCLIC_POSITION: self._apply_position,
            CYCLIC_VELOCITY: self._apply_velocity,
            CYCLIC_TORQUE: self._apply_torque,
        }.get(self.mode)
        if self._apply is None:
            self._set_points.reset(self._axes.position_counts(self._axis))
            self._write_offsets()
            self._hold()
        else:
            self.apply_targets()

    def _hold(self) -> None:
        self._axes.follow_position(self._axis, self._axes.position(self._axis), 1)

    def _begin_profile(self, target: int) -> None:
        read, scales = self._dictionary.read, self._scales
        self._clamped = not self._low <= target <= self._high
        self._axes.follow_profile(
            self._axis,
            scales.position(target),
            scales.velocity(read(0x6081, 0)),
            scales.acceleration(read(0x6083, 0)),
            scales.acceleration(read(0x6084, 0)),
        )

    def _profile_bits(self) -> int:
        word = _MODE_12 if self._set_points.acknowledged else 0
        return word | _REACHED if self._target_reached() else word

    def _target_reached(self) -> bool:
        window = int(self._dictionary.read(0x6067, 0))
        return self._axes.reference_reached(self._axis) and abs(self.following_error) <= window

    # -- controlword ------------------------------------------------------------------------------

    def write_controlword(self, word: int) -> None:
        """Object 0x6040; a word that does not change asks for nothing."""
        before = self.controlword
        if word == before:
            return
        self.controlword = word
        self._obey(word, before)
        if self.state is not State.OPERATION_ENABLED or self._leaving:
            return
        self._set_halt(bool(word & _HALT))
        if self.mode == PROFILE_POSITION and not self._halted:
            self._set_points.on_controlword(word, before, self.target_position)

    def _obey(self, word: int, before: int) -> None:
        command = command_of(word, before)
        if self._leaving and command not in (Command.DISABLE_VOLTAGE, Command.QUICK_STOP):
            return  # the state follows at standstill
        target = TRANSITIONS.get((self.state, command))
        if target is None:
            return
        match (self.state, target):
            case (State.FAULT, _) if self.reset_blocked:
                return
            case (State.FAULT, _):
                self._emergency.clear()
                self._fault_code = 0
                self._enter(target)
            case (_, State.OPERATION_ENABLED):
                if self.enabling:
                    self._enable(word)
            case (_, State.QUICK_STOP_ACTIVE):
                self._quick_stop()
            case (State.OPERATION_ENABLED, State.READY_TO_SWITCH_ON):
                self._leave(target, int(self._dictionary.read(0x605B, 0)))
            case (State.OPERATION_ENABLED, State.SWITCHED_ON):
                self._leave(target, int(self._dictionary.read(0x605C, 0)))
            case _:
                self._switch_off(target)

    def _enable(self, word: int) -> None:
        self._stop, self._halted = None, False
        self._offsets_changed = True
        self._enter(State.OPERATION_ENABLED)
        if word & _HALT:
            self._set_halt(halted=True)
        else:
            self._follow()

    def _leave(self, target: State, option: int) -> None:
        if option == _COAST:
            self._switch_off(target)
        else:
            self._leaving = True
            self._begin_stop(quick=False, done=lambda: self._switch_off(target, obey=True))

    def _set_halt(self, halted: bool) -> None:
        if halted == self._halted:
            return
        self._halted = halted
        if halted:
            self._begin_stop(quick=int(self._dictionary.read(0x605D, 0)) == 2, done=self._hold)
            return
        self._stop = None
        if self.mode != PROFILE_POSITION:
            self._follow()
        elif not self._set_points.resume():
            self._hold()

    # -- stops and faults -------------------------------------------------------------------------

    def quick_stop(self) -> None:
        """Stop as the quick stop command does; a drive that is not enabled is switched off."""
        if self.state is State.OPERATION_ENABLED:
            self._quick_stop()
        elif self.state in (State.READY_TO_SWITCH_ON, State.SWITCHED_ON):
            self._switch_off(State.SWITCH_ON_DISABLED)

    def disable_voltage(self) -> None:
        """Switch the power stage off at once; a fault stays a fault."""
        if not self.in_fault:
            self._switch_off(State.SWITCH_ON_DISABLED)

    def fault(self, code: int, bits: int, data: bytes = b"") -> None:
        """Report an emergency and react as 0x605E says; ends in FAULT."""
        self._emergency.report(code, bits, data)
        if self.in_fault:
            return
        self._fault_code = code
        reaction = int(self._dictionary.read(0x605E, 0))
        if reaction == _COAST or not self.powered:
            self._switch_off(State.FAULT)
            return
        self._leaving = False
        self._enter(State.FAULT_REACTION_ACTIVE)
        self._begin_stop(
            quick=reaction in _QUICK_STOP_RAMP, done=lambda: self._switch_off(State.FAULT)
        )

    def at_task(self) -> None:
        """Do what the drive's communication task does every millisecond: watch."""
        if not self.powered:
            return
        axes, axis = self._axes, self._axis
        self._limited = axes.torque_limited(axis)
        if axes.following_error_exceeded(axis) and self.state is not State.FAULT_REACTION_ACTIVE:
            self.fault(FOLLOWING_ERROR, ErrorRegister.DEVICE_PROFILE)
            return
        stop = self._stop
        if stop is not None:
            rests = axes.reference_reached(axis) and axes.standstill(axis)
            if rests or self._scheduler.now >= stop.deadline:
                self._stop = None
                stop.done()
        elif self.mode == PROFILE_POSITION and not self._halted and self._target_reached():
            self._set_points.on_reached()

    def _quick_stop(self) -> None:
        option = int(self._dictionary.read(0x605A, 0))
        if option == _COAST:
            self._switch_off(State.SWITCH_ON_DISABLED)
            return
        self._leaving = False
        self._enter(State.QUICK_STOP_ACTIVE)
        stays = option in _STAY_STOPPED
        self._begin_stop(
            quick=option in _QUICK_STOP_RAMP,
            done=self._hold if stays else lambda: self._switch_off(State.SWITCH_ON_DISABLED),
        )

    def _begin_stop(self, *, quick: bool, done: Callable[[], None]) -> None:
        ramp = self._scales.acceleration(int(self._dictionary.read(0x6085 if quick else 0x6084, 0)))
        speed = abs(self._axes.velocity(self._axis))
        longest = _STOP_MARGIN * speed / ramp + _STOP_EXTRA
        self._apply = None
        self._stop = _Stop(self._scheduler.now + nanoseconds(longest), done)
        self._axes.follow_velocity(self._axis, 0.0, ramp, ramp)

    def _switch_off(self, state: State, *, obey: bool = False) -> None:
        self._stop, self._apply = None, None
        self._halted = self._clamped = self._leaving = False
        self._axes.off(self._axis)
        self._enter(state)
        if obey:
            self._obey(self.controlword, self.controlword)

    def _enter(self, state: State) -> None:
        self.state = state
        self.powered = state in _POWERED
        """Whether the power stage is on."""
        self._limited = False
        voltage = Status.VOLTAGE_ENABLED if state in _LIVE else 0
        self._state_bits = int(state.value | voltage | Status.REMOTE)


def _int32(value: float) -> int:
    return max(-_INT32, min(_INT32 - 1, round(value)))


def _int16(value: float) -> int:
    return max(-_INT16, min(_INT16 - 1, round(value)))
