"""One axis in motion as the host sees it: what it sent last, what it may do, and what is wrong.

One PDO each way and axis: controlword, target position, and target torque or torque offset;
statusword, actual position, actual torque.
"""

import struct
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from math import ceil, floor, sqrt

import can

from drives.canopen_drive.drive import CanopenDrive
from drives.canopen_drive.energy import Balance
from drives.canopen_drive.line import NMT_OPERATIONAL
from drives.canopen_drive.setup import DRIVE_HEARTBEAT
from drives.canopen_drive.unseen import FLOOR, Unseen
from drives.cia402 import ENABLED_MASK, ENABLED_VALUE, PowerState, emergency_text
from drives.profile import CouplingProfile

OUTPUT = struct.Struct("<Hih")
INPUT = struct.Struct("<Hih")

MISSING_ALLOWED = 1
"""Cycles in a row in which a PDO may be missing."""
HEARTBEATS_MISSED = 3.5
"""Heartbeat times after which a silent drive counts as lost."""
SPAN_UNITS = 20
"""The velocity is judged over so many cycles too that its limit is at least so many units: with a
coarse encoder one unit a cycle is already much."""
STRAY_ALLOWED = 2
"""Cycles in a row in which a PDO may come that no SYNC of the host's asked for."""
JUMP_TORQUES, JUMP_UNITS, JUMP_CYCLES = 4.0, 4, 10
"""From one cycle to the next a position can not change more than it did before by what so many times
the torque limit does to the motor alone, nor by its way at the velocity limit (an impact may take all
of that), and so many units: then its encoder has jumped.  It is said of a stop so many cycles later."""
STUCK_SHARE, STUCK_UNITS, STUCK_TIME = 8, 20, 0.02
"""A target that moves by a part of the following error window, and by so many units at least,
while the position does not change at all for so many seconds: the encoder is stuck, or the axis is
blocked."""
STUCK_SHARE_KNOWN = 2
"""That part, where the axis' friction is known: then its torque tells sooner (``unseen``), and friction
may need that much."""
STUCK_SLOWEST = 10.0
"""Natural frequency of the slowest position loop, rad/s: it is given the time to drive an axis that
reverses on across one unit of its encoder."""
SHAKEN_CYCLES, SHAKEN_UNITS, SHAKEN_STAYS = 6, 2, 0.9
"""Cycles over which the change of an axis' speed is taken that others may feel, and position units of it
that may be rounding; and the share of it that counts a cycle later."""
COUPLED = 1.5
"""Times a coupling of the machine profile that there may be."""
_MOST_UNITS = 2**33
"""More position units than any change or error of a 32-bit position can have."""


@dataclass
class Channel:
    """Run-time state of one axis."""

    drive: CanopenDrive
    free: bool
    output: can.Message
    low: int
    high: int
    step: int
    """Largest change of position units from SYNC to SYNC."""
    torque: int
    window: int
    """Following error window, position units."""
    balance: Balance
    """The energy that its motor has brought in."""
    last: bytes = b""
    statusword: int = 0
    position: int = 0
    previous: int = 0
    """Position one sample before."""
    allowed: int = 0
    """Largest change of position units since then."""
    missing: int = 0
    paused: float = 0.0
    """Cycles by which SYNC was late since the last sample: the axis had more time to move."""
    stray: int = 0
    """Cycles in a row with a PDO that no SYNC of the host's asked for."""
    strayed: bool = False
    """Whether a PDO came since the last SYNC that answers none of the host's, or a second one."""
    contradicts: bool = False
    """Whether PDOs showed a drive under power that said of itself that it is off."""
    jump: int = _MOST_UNITS
    """Position units by which a position can not change more than it did the cycle before."""
    jumped: int = 0
    """By how much it did all the same; 0 if it did not lately."""
    jumped_ago: int = 0
    step_before: int | None = None
    heard: float = 0.0
    emergencies: list[int] = field(default_factory=list)
    nmt_state: int = NMT_OPERATIONAL
    rebooted: bool = False
    hold: int | None = None
    """Where it was first seen enabled, position units: its target until others are streamed."""
    anchor: int | None = None
    """Target when the position, or the target itself, stood last."""
    still: int = 0
    """Samples in a row with the same position."""
    still_allowed: int = 20
    span: int = 1
    """Cycles over which the velocity is judged too: as many as the resolution needs."""
    span_units: int = 0
    """Largest change of position units over that span."""
    span_begin: int | None = None
    span_count: float = 0.0
    too_fast: bool = False
    takes_offset: bool = False
    """Whether the torque in its PDO is the torque offset 0x60B2."""
    offset: int = 0
    """Torque offset sent last, per mille of the rated torque."""
    unseen: Unseen | None = None
    """Looks for motion that the encoder does not show; None for a floating axis."""
    others: list[tuple["Channel", float]] = field(default_factory=list)
    """Axes that are coupled with it, and the torque units by which they may hold it for each position
    unit per cycle and cycle that they accelerate."""
    shaken: float = 0.0
    """Acceleration of late, position units per cycle and cycle."""
    places: deque[int] = field(default_factory=lambda: deque(maxlen=2 * SHAKEN_CYCLES + 1))
    """Positions of the last cycles, without a gap."""

    @property
    def state(self) -> PowerState | None:
        """Power state that the drive shows; None where the statusword shows none."""
        try:
            return PowerState.of(self.statusword)
        except ValueError:
            return None

    @property
    def state_words(self) -> str:
        """The power state in words."""
        return self.state.words if self.state else f"no CiA 402 state (0x{self.statusword:04X})"

    def take(self, data: bytes) -> None:
        """Take the drive's PDO of this SYNC."""
        self.previous = self.position
        first = not self.last
        self.last = data
        self.statusword, self.position, torque = INPUT.unpack(data)
        if first:
            self.previous = self.position
        self.still += 1
        if self.position != self.previous:
            self.anchor, self.still = None, 0
        self._judge_jump()
        cycles = 1 + self.missing + self.paused
        self._note_shaking(cycles)
        enabled = self.statusword & ENABLED_MASK == ENABLED_VALUE
        target = OUTPUT.unpack(self.output.data)[1]
        self.balance.take(self.position, torque, target, cycles, enabled=enabled)
        self._judge_unseen(torque, cycles, enabled)
        self.allowed = ceil(self.step * cycles)
        self._judge_span(cycles)
        self.missing, self.paused = 0, 0.0

    def _judge_jump(self) -> None:
        step = self.position - self.previous
        if self.jumped_ago:
            self.jumped_ago -= 1
        even = not self.missing and not self.paused
        if even and self.step_before is not None and not self.jumped_ago:
            change = step - self.step_before
            if abs(change) > self.jump:
                self.jumped, self.jumped_ago = change, JUMP_CYCLES
        self.step_before = step if even else None

    def _note_shaking(self, cycles: float) -> None:
        if cycles != 1:
            self.places.clear()
        self.places.append(self.position)
        self.shaken *= SHAKEN_STAYS
        if len(self.places) == self.places.maxlen:
            change = self.places[-1] - 2 * self.places[SHAKEN_CYCLES] + self.places[0]
            sure = max(0, abs(change) - SHAKEN_UNITS) / SHAKEN_CYCLES**2
            self.shaken = max(self.shaken, sure)

    def _judge_unseen(self, torque: int, cycles: float, enabled: bool) -> None:
        if self.unseen is None:
            return
        if not enabled:
            self.unseen.restart()
            return
        disturbed = sum(other.shaken * torques for other, torques in self.others)
        self.unseen.take(self.position, torque, cycles, disturbed)

    def _judge_span(self, cycles: float) -> None:
        if self.span_begin is None:
            self.span_begin = self.position
        self.span_count += cycles
        if self.span_count >= self.span:
            share = self.span_count / self.span
            self.too_fast = abs(self.position - self.span_begin) > self.span_units * share
            self.span_begin, self.span_count = self.position, 0.0

    @property
    def alarm(self) -> str:
        """What makes it sure that the axis moves unseen, or was caught; else empty."""
        return self.unseen.alarm if self.unseen is not None else ""

    def is_stuck(self, target: int) -> bool:
        """Whether the position stands while the target moves."""
        if self.anchor is None or target == self.anchor:
            self.anchor, self.still = target, 0  # counted from where the target begins to move
        if self.free or self.still < self.still_allowed:
            return False
        share = STUCK_SHARE
        if self.unseen is not None and self.unseen.knows:
            share = STUCK_SHARE_KNOWN
        return abs(target - self.anchor) > max(self.window // share, STUCK_UNITS)

    def is_fine(self, target: int, now: float) -> bool:
        """Whether the drive is enabled, heard, and inside all limits; target in position units."""
        statusword, position, torque = INPUT.unpack(self.last)
        return (
            statusword & ENABLED_MASK == ENABLED_VALUE
            and self.low <= position <= self.high
            and -self.torque <= torque <= self.torque
            and -self.allowed <= position - self.previous <= self.allowed
            and not self.too_fast
            and (self.free or -self.window <= target - position <= self.window)
            and not self.is_stuck(target)
            and not self.alarm
            and not self.emergencies
            and self.missing <= MISSING_ALLOWED
            and self.stray <= STRAY_ALLOWED
            and self.nmt_state == NMT_OPERATIONAL
            and not self.rebooted
            and now - self.heard <= HEARTBEATS_MISSED * DRIVE_HEARTBEAT
        )

    def violation(self, target: int, cycle_time: float) -> str:
        """Return what is not fine, in a sentence."""
        drive, scale, limits = self.drive, self.drive.scaling, self.drive.limits
        unit, torque_unit = drive.position_unit, drive.torque_unit
        statusword, position, torque = INPUT.unpack(self.last)
        if self.stray > STRAY_ALLOWED:
            return (
                f"{drive.axis}: PDOs of node {drive.node_id} come that no SYNC of this host asked for; "
                "all axes were stopped. Two drives may have this node id, another master may send "
                "SYNC, or the drive answers too late for the cycle."
            )
        if self.missing > MISSING_ALLOWED:
            return (
                f"{drive.axis}: node {drive.node_id} sent no PDO for {self.missing} cycles; all "
                "axes were stopped. Check its supply and its cable."
            )
        if self.rebooted or self.nmt_state != NMT_OPERATIONAL:
            return (
                f"{drive.axis}: node {drive.node_id} left NMT operational"
                f"{' (it rebooted)' if self.rebooted else ''}; all axes were stopped. Check its "
                "supply, and whether another master is on the bus."
            )
        if self.jumped_ago:
            return (
                f"{drive.axis}: its position jumped by {self.jumped * scale.position:.4g} {unit} from "
                f"one cycle to the next, which is above the limit {self.jump * scale.position:.3g} "
                f"{unit} of what its torque and velocity allow; all axes were stopped. Either its "
                "encoder lost count (cable, shield, index), and the position is not known any more "
                "until it is referenced, or something hit the axis."
            )
        if self.emergencies or statusword & ENABLED_MASK != ENABLED_VALUE:
            return self.trouble()
        if not self.low <= position <= self.high:
            return (
                f"{drive.axis}: position {position * scale.position:.4g} {unit} is outside the "
                f"travel {limits.travel[0]:g} to {limits.travel[1]:g} {unit}; all axes were stopped. "
                "Move it back inside before the next start."
            )
        if abs(torque) > self.torque:
            return (
                f"{drive.axis}: torque {torque * scale.torque:.4g} {torque_unit} is above the limit "
                f"{limits.torque:g} {torque_unit}; all axes were stopped. Is the axis blocked, does "
                "it move the wrong way, or does the prior model have too little inertia?"
            )
        if not self.free and abs(target - position) > self.window:
            error = (target - position) * scale.position
            return (
                f"{drive.axis}: following error {error:.4g} {unit} is above the limit "
                f"{limits.following_error:g} {unit}; all axes were stopped. Does the axis move the "
                "wrong way, or is it blocked?"
            )
        if self.unseen is not None and self.alarm:
            return self._unseen_words(self.unseen)
        if self.is_stuck(target):
            return (
                f"{drive.axis}: does not move at all while its target moves; its power was cut and "
                "all axes were stopped. Does the encoder count, is the axis blocked or its brake "
                "closed? If only friction holds it, allow it a larger following error."
            )
        if abs(position - self.previous) > self.allowed:
            cycles = max(1, self.allowed // self.step)
            speed = (position - self.previous) * scale.position / (cycle_time * cycles)
            return (
                f"{drive.axis}: velocity {speed:.4g} {unit}/s is above the limit "
                f"{limits.velocity:g} {unit}/s; all axes were stopped. Does the axis move the wrong "
                "way?"
            )
        if self.too_fast:
            return (
                f"{drive.axis}: velocity over {self.span} cycles is above the limit "
                f"{limits.velocity:g} {unit}/s; all axes were stopped. Does the axis move the wrong way?"
            )
        return (
            f"{drive.axis}: node {drive.node_id} sent no heartbeat for "
            f"{HEARTBEATS_MISSED * DRIVE_HEARTBEAT:.2g} s; all axes were stopped. Check its supply "
            "and its cable."
        )

    def _unseen_words(self, unseen: Unseen) -> str:
        drive, scale = self.drive, self.drive.scaling
        way = f"{abs(unseen.way) * scale.position:.2g} {drive.position_unit}"
        torque = f"{INPUT.unpack(self.last)[2] * scale.torque:.3g} {drive.torque_unit}"
        seen = (
            "stands dead from one cycle to the next, though it moved and nothing has ever stopped it so "
            "suddenly"
            if unseen.alarm == "dead"
            else f"stands under a torque of {torque}, which is more than it has ever stood under"
        )
        return (
            f"{drive.axis}: {seen}; its power was cut and all axes were stopped. Either its encoder "
            f"does not count (cable, supply), and it has moved by about {way} unseen, or its brake, a "
            "stop or friction holds it. Both look the same from here: turn it by hand with the power "
            "off, and see whether its position changes."
        )

    def reversed_words(self) -> str:
        """Return that its motor is reversed, in a sentence."""
        drive, torque = self.drive, INPUT.unpack(self.last)[2] * self.drive.scaling.torque
        return (
            f"{drive.axis}: moves the wrong way: the axes give back more energy than they were given, "
            f"so its motor turns against its torque (now {torque:.3g} {drive.torque_unit}), or "
            "something moves it; all axes were stopped. If nothing touched it, "
            "check the motor's phases and the encoder's direction."
        )

    def trouble(self) -> str:
        """Return what the drive itself reports, in a sentence."""
        axis, node_id = self.drive.axis, self.drive.node_id
        if self.emergencies:
            said = ", ".join(emergency_text(code) for code in self.emergencies[:3])
            return (
                f"{axis}: node {node_id} reports emergency {said}; all axes were stopped. Find the "
                "cause in the drive's manual before the next start."
            )
        return (
            f"{axis}: the drive left operation enabled: statusword 0x{self.statusword:04X} "
            f"({self.state_words}); all axes were stopped. Look for its cause at the drive."
        )


def channel_of(
    drive: CanopenDrive, cycle_time: float, free: bool, takes_offset: bool = False
) -> Channel:
    """Return the run-time state of an axis about to be moved, its limits in drive units."""
    scale, limits = drive.scaling, drive.limits
    units = min(limits.velocity * cycle_time / scale.position, _MOST_UNITS)
    span = ceil(SPAN_UNITS / units)
    lightest = drive.axis_profile.prior.masses[0]
    kick = max(
        JUMP_TORQUES * limits.torque / lightest * cycle_time**2, limits.velocity * cycle_time
    )
    window = floor(min(limits.following_error / scale.position * (1 + 1e-12), _MOST_UNITS))
    wind_up = sum(limits.torque / k for k in drive.axis_profile.prior.springs) / scale.position
    push = scale.torque / sum(drive.axis_profile.prior.masses) * cycle_time**2 / scale.position
    floor_torque = 2 + FLOOR * limits.torque / scale.torque
    return Channel(
        drive,
        free,
        can.Message(arbitration_id=0x200 + drive.node_id, data=bytes(8), is_extended_id=False),
        low=scale.position_units(limits.travel[0]),
        high=scale.position_units(limits.travel[1]),
        step=max(2, 1 + floor(units)),
        jump=JUMP_UNITS + ceil(min(kick / scale.position, _MOST_UNITS)),
        span=span,
        span_units=1 + floor(units * span),
        torque=floor(min(limits.torque / scale.torque * (1 + 1e-12), _MOST_UNITS)),
        takes_offset=takes_offset,
        still_allowed=max(3, round(_stuck_time(window) / cycle_time)),
        window=window,
        unseen=None
        if free
        else Unseen(drive.learned, push, window, floor_torque, cycle_time, wind_up),
        balance=Balance(
            scale.position,
            scale.torque,
            limits.torque,
            sum(drive.axis_profile.prior.masses),
            cycle_time,
            None if drive.axis_profile.may_float else drive.learned.pull * scale.torque,
        ),
    )


def couple(
    channels: Sequence[Channel], couplings: Iterable[CouplingProfile], cycle_time: float
) -> None:
    """Let coupled axes know of each other: what accelerates one may hold the other."""
    by_axis = {channel.drive.axis: channel for channel in channels}
    for coupling in couplings:
        a, b = (by_axis[axis] for axis in coupling.axes)
        for one, other in ((a, b), (b, a)):
            inertia = COUPLED * abs(coupling.value) / cycle_time**2
            scale = other.drive.scaling.position / one.drive.scaling.torque
            one.others.append((other, inertia * scale))


def _stuck_time(window: int) -> float:
    """Return how long a position may stand while its target moves away, s.

    A loop of natural frequency w accelerates the axis by w^2 times the target's mean distance, half
    of what is asked for in ``is_stuck``; from rest one unit then takes sqrt(2 units / acceleration).
    """
    distance = max(window // STUCK_SHARE, STUCK_UNITS) / 2
    return STUCK_TIME + sqrt(2 / distance) / STUCK_SLOWEST
