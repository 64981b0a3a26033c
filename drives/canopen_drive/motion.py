"""Enabled axes: targets out and positions in at every SYNC, limits watched in every cycle.

One PDO each way and axis: controlword, target position, target torque; statusword, actual
position, actual torque.  When a limit is passed or a drive fails, *all* axes get a quick stop in
the next cycle and are disabled once they stand; a runaway is disabled at once.
"""

import signal
import struct
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import can
import numpy as np

from drives.api import Capture, FloatArray, Source, joined
from drives.canopen_drive.drive import CanopenDrive
from drives.canopen_drive.line import Line
from drives.canopen_drive.setup import DRIVE_HEARTBEAT, HOST_HEARTBEAT, HOST_NODE_ID
from drives.cia402 import (
    ENABLED_MASK,
    ENABLED_VALUE,
    STEP_TOWARDS_ENABLED,
    Controlword,
    PowerState,
    emergency_text,
)
from drives.errors import (
    BusError,
    DriveFaultError,
    DrivesError,
    SafetyStopError,
    StoppedError,
    UserStopError,
)

OUTPUT = struct.Struct("<Hih")
INPUT = struct.Struct("<Hih")
INPUT_ROW = np.dtype([("statusword", "<u2"), ("position", "<i4"), ("torque", "<i2")])
OUTPUT_ROW = np.dtype([("controlword", "<u2"), ("position", "<i4"), ("torque", "<i2")])
NMT_OPERATIONAL = 5

STATE_TIMEOUT = 3.0
"""Seconds a drive may take from one power state to the next (a brake may have to open)."""
STOP_TIMEOUT = 5.0
"""Seconds after which axes that still move are disabled."""
MISSING_ALLOWED = 1
"""Cycles in a row in which a PDO may be missing."""
HEARTBEATS_MISSED = 3.5
"""Heartbeat times after which a silent drive counts as lost."""
REPLY_SHARE = 0.9
"""Share of the cycle within which the drives' PDOs have to come."""


@dataclass
class _Channel:
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
    last: bytes = b""
    statusword: int = 0
    position: int = 0
    previous: int = 0
    """Position one sample before."""
    allowed: int = 0
    """Largest change of position units since then."""
    missing: int = 0
    heard: float = 0.0
    emergencies: list[int] = field(default_factory=list)
    nmt_state: int = NMT_OPERATIONAL
    rebooted: bool = False

    @property
    def state(self) -> PowerState:
        return PowerState.of(self.statusword)


class CanopenMotion:
    """Axes that are enabled and watched; made by ``CanopenGroup.motion``."""

    def __init__(
        self,
        line: Line,
        drives: Sequence[CanopenDrive],
        cycle_time: float,
        free: frozenset[str],
        stop_requested: Callable[[], bool],
    ) -> None:
        self._line, self._cycle_time, self._stop_requested = line, cycle_time, stop_requested
        self._channels = [_channel(d, cycle_time, d.axis in free) for d in drives]
        self._by_cob = {0x180 + c.drive.node_id: k for k, c in enumerate(self._channels)}
        self._sync = can.Message(arbitration_id=0x80, is_extended_id=False)
        self._heartbeat = can.Message(
            arbitration_id=0x700 + HOST_NODE_ID, data=bytes([NMT_OPERATIONAL]), is_extended_id=False
        )
        self._next_heartbeat = 0.0
        self._start = 0.0
        self._count = 0
        self._stopped = False
        self.late_cycles = 0
        """Cycles that the host began more than half a cycle late."""

    # --- what the outside sees -----------------------------------------------------------------

    @property
    def cycle_time(self) -> float:
        """Seconds from SYNC to SYNC."""
        return self._cycle_time

    @property
    def position(self) -> FloatArray:
        """Latest actual positions, shape (M,), rad or m."""
        return np.array([c.position * c.drive.scaling.position for c in self._channels])

    @property
    def free(self) -> tuple[bool, ...]:
        """Which axes float."""
        return tuple(c.free for c in self._channels)

    def stream(self, source: Source) -> Capture:
        """Follow targets SYNC by SYNC; see ``drives.api.Motion``."""
        captures: list[Capture] = []
        try:
            previous: Capture | None = None
            while (block := source(previous)) is not None:
                previous = self._follow(block, captures)
        except BaseException as error:
            self.stop()
            if isinstance(error, StoppedError):
                error.capture = joined(captures) if captures else None
            raise
        return joined(captures)

    # --- enabling and disabling ----------------------------------------------------------------

    def begin(self) -> None:
        """Start the SYNC, and enable every axis with its target at its actual position.

        Raises
        ------
        DriveFaultError
            If a drive does not reach ``operation enabled``.
        """
        now = self._line.clock.now()
        self._start, self._count, self._next_heartbeat = now + self._cycle_time, 0, now
        for channel in self._channels:
            node_id = channel.drive.node_id
            channel.heard = now
            self._line.subscribe(0x80 + node_id, self._on_emergency)
            self._line.subscribe(0x700 + node_id, self._on_heartbeat)
        self._await_inputs()
        for _ in STEP_TOWARDS_ENABLED:
            self._towards_enabled()
        slow = [c for c in self._channels if c.state is not PowerState.OPERATION_ENABLED]
        if slow:
            raise DriveFaultError(
                f"{slow[0].drive.axis}: the drive stays in {slow[0].state.words} and can not be "
                f"enabled; its last error is {slow[0].drive.last_error()}."
            )

    def _await_inputs(self) -> None:
        for _ in range(max(10, round(0.2 / self._cycle_time))):
            self._cycle([self._word(c, Controlword.DISABLE_VOLTAGE) for c in self._channels])
            if all(c.last for c in self._channels):
                return
        silent = next(c for c in self._channels if not c.last)
        raise DriveFaultError(
            f"{silent.drive.axis}: node {silent.drive.node_id} sends no PDO after SYNC. Check that it "
            "takes part in SYNC (0x1005) and reached NMT operational."
        )

    def _towards_enabled(self) -> None:
        wanted = {}
        for k, channel in enumerate(self._channels):
            if channel.state in STEP_TOWARDS_ENABLED:
                wanted[k] = STEP_TOWARDS_ENABLED[channel.state]
        for _ in range(round(STATE_TIMEOUT / self._cycle_time)):
            words = [
                self._word(c, wanted[k][0] if k in wanted else Controlword.ENABLE_OPERATION)
                for k, c in enumerate(self._channels)
            ]
            self._cycle(words)
            self._check_user()
            for channel in self._channels:
                if channel.emergencies or channel.state in (
                    PowerState.FAULT,
                    PowerState.FAULT_REACTION_ACTIVE,
                ):
                    raise DriveFaultError(self._trouble(channel))
            if all(self._channels[k].state is after for k, (_, after) in wanted.items()):
                return

    def end(self) -> None:
        """Disable every axis and stop listening; the normal end, with all axes at rest."""
        try:
            if not self._stopped:
                with _uninterrupted():
                    self._disable(Controlword.SHUTDOWN)
        finally:
            for channel in self._channels:
                node_id = channel.drive.node_id
                self._line.unsubscribe(0x80 + node_id, self._on_emergency)
                self._line.unsubscribe(0x700 + node_id, self._on_heartbeat)

    def stop(self) -> None:
        """Quick stop all axes at once, then disable them; never raises for what a drive does."""
        if self._stopped:
            return
        self._stopped = True
        with _uninterrupted():
            try:
                self._quick_stop()
                self._disable(Controlword.DISABLE_VOLTAGE)
            except (DrivesError, can.CanError, OSError):
                self._last_resort()

    def _quick_stop(self) -> None:
        """Command a quick stop until every axis stands or is off; cut the power of a runaway."""
        words = [Controlword.QUICK_STOP] * len(self._channels)
        speeds = [abs(c.position - c.previous) for c in self._channels]
        before = [c.position for c in self._channels]
        limit = [max(2 * s, 4 * c.step) for s, c in zip(speeds, self._channels, strict=True)]
        still = 0
        for _ in range(round(STOP_TIMEOUT / self._cycle_time)):
            self._cycle([self._word(c, w) for c, w in zip(self._channels, words, strict=True)])
            moving = False
            for k, c in enumerate(self._channels):
                moved = abs(c.position - before[k])
                before[k] = c.position
                if moved > limit[k]:
                    words[k] = Controlword.DISABLE_VOLTAGE
                powered = c.statusword & 0x6F in (
                    ENABLED_VALUE,
                    PowerState.QUICK_STOP_ACTIVE.value[1],
                )
                if powered and c.missing == 0 and moved > max(2, c.step // 100):
                    moving = True
                if powered and c.statusword & 0x6F == ENABLED_VALUE and c.missing == 0:
                    moving = True
            still = 0 if moving else still + 1
            if still >= 3:
                return

    def _disable(self, first: Controlword) -> None:
        for word in dict.fromkeys((first, Controlword.DISABLE_VOLTAGE)):
            for _ in range(round(STATE_TIMEOUT / self._cycle_time)):
                self._cycle([self._word(c, word) for c in self._channels])
                if all(
                    c.missing or c.statusword & 0x4F in (0x40, 0x08) or c.statusword & 0x6F == 0x21
                    for c in self._channels
                ):
                    break

    def _last_resort(self) -> None:
        """The cyclic way failed: disable by SDO, then stop the nodes; their heartbeat does the rest."""
        for channel in self._channels:
            try:
                channel.drive.node.sdo.download(0x6040, 0, bytes(2))
            except Exception:  # every other drive still has to be tried
                continue
        for channel in self._channels:
            try:
                channel.drive.node.nmt.send_command(0x02)
            except Exception:
                continue

    # --- the cycle -----------------------------------------------------------------------------

    def _follow(self, targets: FloatArray, captures: list[Capture]) -> Capture:
        """Send a block of targets; what came back joins ``captures`` whatever happens."""
        n = targets.shape[0]
        if targets.shape != (n, len(self._channels)) or not np.all(np.isfinite(targets)):
            raise ValueError(
                f"targets must be finite, of shape (n, {len(self._channels)}), got {targets.shape}"
            )
        first = self._count
        frames: list[bytes] = []
        units = np.empty((n, len(self._channels)), dtype=np.int32)
        for k, channel in enumerate(self._channels):
            rows = np.zeros(n, dtype=OUTPUT_ROW)
            rows["controlword"] = Controlword.ENABLE_OPERATION
            if channel.free:
                units[:, k] = channel.position
            else:
                units[:, k] = np.rint(targets[:, k] / channel.drive.scaling.position)
            rows["position"] = units[:, k]
            frames.append(rows.tobytes())
        received = [bytearray() for _ in self._channels]
        missing: list[int] = []
        try:
            for row in range(n):
                a, b = 8 * row, 8 * row + 8
                complete = self._cycle([frame[a:b] for frame in frames])
                for channel, raw in zip(self._channels, received, strict=True):
                    raw.extend(channel.last)
                if not complete:
                    missing.append(row)
                self._check(units[row])
        finally:
            captures.append(self._capture(first, targets, received, missing))
        return captures[-1]

    def _capture(
        self, first: int, targets: FloatArray, received: list[bytearray], missing: list[int]
    ) -> Capture:
        rows = min(len(raw) for raw in received) // INPUT.size
        tables = [np.frombuffer(bytes(raw[: rows * 8]), dtype=INPUT_ROW) for raw in received]
        scales = [c.drive.scaling for c in self._channels]
        return Capture(
            first,
            np.array(targets[:rows], dtype=np.float64),
            np.stack(
                [t["position"] * s.position for t, s in zip(tables, scales, strict=True)], axis=1
            ),
            np.stack([t["torque"] * s.torque for t, s in zip(tables, scales, strict=True)], axis=1),
            np.stack([t["statusword"] for t in tables], axis=1),
            tuple(missing),
        )

    def _cycle(self, outputs: Sequence[bytes]) -> bool:
        """Send outputs, then SYNC, then take every drive's input; return whether all came."""
        line, clock = self._line, self._line.clock
        for channel, output in zip(self._channels, outputs, strict=True):
            channel.output.data = bytearray(output)
            line.send(channel.output)
        moment = self._start + self._count * self._cycle_time
        if clock.now() >= self._next_heartbeat:
            line.send(self._heartbeat)
            self._next_heartbeat = clock.now() + HOST_HEARTBEAT
        clock.wait_until(moment - 1e-7)
        late = clock.now() - moment
        if late > self._cycle_time / 2:
            self.late_cycles += 1
            self._start += late
            moment += late
        line.send(self._sync)
        self._count += 1
        return self._collect(moment + REPLY_SHARE * self._cycle_time)

    def _collect(self, deadline: float) -> bool:
        line, by_cob, channels = self._line, self._by_cob, self._channels
        bus, clock = line.can_bus, line.clock
        awaited = set(by_cob.values())
        while awaited:
            try:
                message = bus.recv(max(0.0, deadline - clock.now()))
            except (can.CanError, OSError) as error:
                raise BusError(f"the bus does not deliver frames any more: {error}") from error
            if message is None:
                break
            k = by_cob.get(message.arbitration_id)
            if k is None or len(message.data) != INPUT.size:
                if not (message.is_error_frame or message.is_remote_frame):
                    line.notify(message.arbitration_id, message.data, message.timestamp)
                continue
            channel = channels[k]
            first = not channel.last
            channel.previous = channel.position
            channel.last = bytes(message.data)
            channel.statusword, channel.position, _ = INPUT.unpack(channel.last)
            if first:
                channel.previous = channel.position
            channel.allowed = channel.step * (1 + channel.missing)
            channel.missing = 0
            awaited.discard(k)
        for k in awaited:
            channels[k].missing += 1
        return not awaited

    def _word(self, channel: _Channel, word: Controlword) -> bytes:
        return OUTPUT.pack(word, channel.position, 0)

    # --- watching ------------------------------------------------------------------------------

    def _on_emergency(self, can_id: int, data: bytearray, _timestamp: float) -> None:
        channel = next(c for c in self._channels if 0x80 + c.drive.node_id == can_id)
        code = int.from_bytes(data[0:2], "little")
        if code >> 8:  # 0x00xx: error reset
            channel.emergencies.append(code)

    def _on_heartbeat(self, can_id: int, data: bytearray, _timestamp: float) -> None:
        channel = next(c for c in self._channels if 0x700 + c.drive.node_id == can_id)
        channel.heard = self._line.clock.now()
        channel.nmt_state = data[0] & 0x7F if data else 0
        if channel.nmt_state == 0:
            channel.rebooted = True

    def _check_user(self) -> None:
        if self._stop_requested():
            raise UserStopError("stopped by the user")

    def _check(self, targets: np.ndarray[tuple[int], np.dtype[np.int32]]) -> None:
        """Raise SafetyStopError for the first thing that is not as it has to be."""
        self._check_user()
        now = self._line.clock.now()
        for channel, target in zip(self._channels, targets.tolist(), strict=True):
            statusword, position, torque = INPUT.unpack(channel.last)
            if (
                statusword & ENABLED_MASK == ENABLED_VALUE
                and channel.low <= position <= channel.high
                and -channel.torque <= torque <= channel.torque
                and -channel.allowed <= position - channel.previous <= channel.allowed
                and (channel.free or -channel.window <= target - position <= channel.window)
                and not channel.emergencies
                and channel.missing <= MISSING_ALLOWED
                and channel.nmt_state == NMT_OPERATIONAL
                and not channel.rebooted
                and now - channel.heard <= HEARTBEATS_MISSED * DRIVE_HEARTBEAT
            ):
                continue
            message = self._violation(channel, target)
            raise SafetyStopError(message, axis=channel.drive.axis, cycle=self._count - 1)

    def _violation(self, channel: _Channel, target: int) -> str:
        drive, scale = channel.drive, channel.drive.scaling
        limits = drive.limits
        unit = "rad" if drive.axis_profile.kind == "rotary" else "m"
        torque_unit = "N m" if unit == "rad" else "N"
        statusword, position, torque = INPUT.unpack(channel.last)
        if channel.missing > MISSING_ALLOWED:
            return (
                f"{drive.axis}: node {drive.node_id} sent no PDO for {channel.missing} cycles; all "
                "axes were stopped. Check its supply and its cable."
            )
        if channel.rebooted or channel.nmt_state != NMT_OPERATIONAL:
            return (
                f"{drive.axis}: node {drive.node_id} left NMT operational"
                f"{' (it rebooted)' if channel.rebooted else ''}; all axes were stopped."
            )
        if channel.emergencies or statusword & ENABLED_MASK != ENABLED_VALUE:
            return self._trouble(channel)
        if not channel.low <= position <= channel.high:
            return (
                f"{drive.axis}: position {position * scale.position:.4g} {unit} is outside the "
                f"travel {limits.travel[0]:g} to {limits.travel[1]:g} {unit}; all axes were stopped."
            )
        if abs(torque) > channel.torque:
            return (
                f"{drive.axis}: torque {torque * scale.torque:.4g} {torque_unit} is above the limit "
                f"{limits.torque:g} {torque_unit}; all axes were stopped."
            )
        if not channel.free and abs(target - position) > channel.window:
            error = (target - position) * scale.position
            return (
                f"{drive.axis}: following error {error:.4g} {unit} is above the limit "
                f"{limits.following_error:g} {unit}; all axes were stopped. Does the axis move the "
                "wrong way, or is it blocked?"
            )
        if abs(position - channel.previous) > channel.allowed:
            cycles = channel.allowed // channel.step
            speed = (position - channel.previous) * scale.position / (self._cycle_time * cycles)
            return (
                f"{drive.axis}: velocity {speed:.4g} {unit}/s is above the limit "
                f"{limits.velocity:g} {unit}/s; all axes were stopped. Does the axis move the wrong "
                "way?"
            )
        return (
            f"{drive.axis}: node {drive.node_id} sent no heartbeat for "
            f"{HEARTBEATS_MISSED * DRIVE_HEARTBEAT:.2g} s; all axes were stopped."
        )

    @staticmethod
    def _trouble(channel: _Channel) -> str:
        axis, node_id = channel.drive.axis, channel.drive.node_id
        if channel.emergencies:
            said = ", ".join(emergency_text(code) for code in channel.emergencies[:3])
            return f"{axis}: node {node_id} reports emergency {said}; all axes were stopped."
        try:
            state = channel.state.words
        except ValueError:
            state = "no CiA 402 state"
        return (
            f"{axis}: the drive left operation enabled: statusword 0x{channel.statusword:04X} "
            f"({state}); all axes were stopped."
        )


def _channel(drive: CanopenDrive, cycle_time: float, free: bool) -> _Channel:
    scale, limits = drive.scaling, drive.limits
    return _Channel(
        drive,
        free,
        can.Message(arbitration_id=0x200 + drive.node_id, data=bytes(8), is_extended_id=False),
        low=scale.position_units(limits.travel[0]),
        high=scale.position_units(limits.travel[1]),
        step=max(2, int(limits.velocity * cycle_time / scale.velocity) + 1),
        torque=scale.torque_units(limits.torque),
        window=scale.position_units(limits.following_error),
    )


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Let nothing from the keyboard cut a stop short."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
