"""Enabled axes: targets out and positions in at every SYNC, limits watched in every cycle.

When a limit is passed or a drive fails, *all* axes get a quick stop in the next cycle and are
disabled once they stand; the power of one that runs away is cut at once, because a quick stop by a
loop of the wrong sign would only make it faster.
"""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress

import can
import numpy as np

from drives import objects
from drives.api import Capture, FloatArray, MotionWatch, Onlooker, Source, Targets, joined
from drives.bus import is_data
from drives.canopen_drive.asked import Asked, mode_words, wanted_mode
from drives.canopen_drive.channel import (
    INPUT,
    MISSING_ALLOWED,
    OUTPUT,
    Channel,
    channel_of,
    couple,
)
from drives.canopen_drive.drive import CanopenDrive
from drives.canopen_drive.energy import reversed_axis
from drives.canopen_drive.interrupts import uninterrupted
from drives.canopen_drive.line import Line
from drives.canopen_drive.outputs import Outputs, outputs_of
from drives.canopen_drive.pace import LATE_SHARE, Punctuality
from drives.canopen_drive.setup import HOST_HEARTBEAT, HOST_LOST_AFTER, HOST_NODE_ID
from drives.canopen_drive.strangers import Strangers
from drives.canopen_drive.sync import HostSync, Sync
from drives.canopen_drive.unseen import Learned
from drives.cia402 import ENABLED_VALUE, STEP_TOWARDS_ENABLED, Controlword, PowerState
from drives.errors import (
    MAY_BE_ENABLED,
    DriveFaultError,
    DrivesError,
    OscillationError,
    SafetyStopError,
    SdoError,
    StoppedError,
    UserStopError,
)
from drives.profile import CouplingProfile

NMT_STOPPED = 4
INPUT_ROW = np.dtype([("statusword", "<u2"), ("position", "<i4"), ("torque", "<i2")])

STATE_TIMEOUT = 3.0
"""Seconds a drive may take from one power state to the next (a brake may have to open)."""
STOP_TIMEOUT = 5.0
"""Seconds after which axes that still move are disabled."""
RUNAWAY_SHARE, RUNAWAY_GROWTH, RUNAWAY_CYCLES = 0.25, 1.25, 3
"""An axis runs away that, for so many cycles of a quick stop, is faster than this share of its
velocity limit and than it was at the start of the stop times the growth."""
PAUSE_CYCLES, REPLY_TRIES = 3, 3
"""Cycles without SYNC before the drives' replies are timed, and tries to find them in time."""
REPLY_SHARE = 0.9
"""Share of the cycle within which the drives' PDOs have to come."""


class CanopenMotion:
    """Axes that are enabled and watched; made by ``CanopenGroup.motion``."""

    def __init__(
        self,
        line: Line,
        drives: Sequence[CanopenDrive],
        cycle_time: float,
        free: frozenset[str],
        stop_requested: Callable[[], bool],
        offsets: frozenset[str] = frozenset(),
        sync: Sync | None = None,
        watch: MotionWatch | None = None,
        couplings: Iterable[CouplingProfile] = (),
        lost_after: float = HOST_LOST_AFTER,
    ) -> None:
        self._lost_after = lost_after
        """Seconds without the host's heartbeat after which drives stop by themselves."""
        self._most_late = lost_after - HOST_HEARTBEAT
        """Seconds by which a cycle may begin late: after a longer pause the targets would go on from
        where the axes have long been at rest."""
        self._line, self._cycle_time, self._stop_requested = line, cycle_time, stop_requested
        self._watch = watch
        self._channels = [
            channel_of(d, cycle_time, d.axis in free, d.axis in offsets) for d in drives
        ]
        couple(self._channels, couplings, cycle_time)
        self._by_cob = {0x180 + c.drive.node_id: k for k, c in enumerate(self._channels)}
        self._by_node = {c.drive.node_id: c for c in self._channels}
        self._sync: Sync = sync or HostSync(line, cycle_time)
        self._disturbed, self._complete = False, True
        self._moment = line.clock.now()
        self._lost = line.overruns
        self._lost_before = self._lost
        self._targets: Sequence[int] = ()
        """Of the cycle before, position units."""
        self._count = 0
        self._asked = Asked(self._channels, cycle_time)
        self._strangers = Strangers(drives, HOST_NODE_ID)
        self._stranger = ""
        """What somebody else has commanded, in words."""
        self._stopped = False
        self.perhaps_enabled: dict[str, str] = {}
        """Axes whose drive could not be seen to be off after a stop: a sentence each."""
        self.onlooker: Onlooker | None = None
        self.real_time = ""
        """Why the host has no real-time priority; empty where it has."""

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
    def punctuality(self) -> Punctuality:
        """How well the host has kept its cycles so far."""
        sync = self._sync
        return Punctuality(
            sync.cycles,
            sync.late,
            sync.worst,
            self._cycle_time,
            self._line.overruns - self._lost_before,
            self.real_time,
        )

    @property
    def free(self) -> tuple[bool, ...]:
        """Which axes float."""
        return tuple(c.free for c in self._channels)

    @property
    def torque_offsets(self) -> tuple[bool, ...]:
        """Which axes take torque offsets in this motion."""
        return tuple(c.takes_offset for c in self._channels)

    def stream(self, source: Source) -> Capture:
        """Follow targets SYNC by SYNC; see ``drives.api.Motion``."""
        captures: list[Capture] = []
        try:
            previous: Capture | None = None
            while (block := source(previous)) is not None:
                previous = self._follow(block, captures)
                if self.onlooker is not None:
                    self.onlooker.take(previous)
            self._release_offsets()
        except BaseException as error:
            self.stop(error)
            stopped = _as_stopped(error)
            if stopped is None:
                raise
            stopped.capture = joined(captures) if captures else None
            if stopped is error:
                raise
            raise stopped from error
        return joined(captures)

    # --- enabling and disabling ----------------------------------------------------------------

    def begin(self) -> None:
        """Start the SYNC, and enable every axis with its target at its actual position.

        Raises
        ------
        DriveFaultError
            If a drive does not reach ``operation enabled``.
        SafetyStopError
            If an axis leaves a limit as soon as it is enabled; all are disabled.
        """
        now = self._line.clock.now()
        self._count = 0
        self._sync.restart()
        for channel in self._channels:
            node_id = channel.drive.node_id
            channel.heard = now
            self._line.subscribe(0x80 + node_id, self._on_emergency)
            self._line.subscribe(0x700 + node_id, self._on_heartbeat)
        self._await_inputs()
        self._check_replies(" No axis was enabled.")
        self._towards_enabled()
        slow = [c for c in self._channels if c.state is not PowerState.OPERATION_ENABLED]
        if slow:
            raise DriveFaultError(
                f"{slow[0].drive.axis}: the drive stays in {slow[0].state_words} and can not be "
                f"enabled; its last error is {slow[0].drive.last_error()}. Check its enable input, "
                "its supply and its brake."
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

    def _check_replies(self, so_far: str = "") -> None:
        """See that every drive answers a SYNC within its own cycle, not within the next one.

        After a pause without SYNC nothing old is on its way; a PDO that comes too late would be
        taken for the next cycle's ever after.
        """
        words = [self._word(c, Controlword.DISABLE_VOLTAGE) for c in self._channels]
        for _ in range(REPLY_TRIES):
            self._line.wait(PAUSE_CYCLES * self._cycle_time)
            self._sync.restart()
            if self._cycle(words):
                return
        late = next((c for c in self._channels if c.missing), self._channels[0])
        raise DriveFaultError(
            f"{late.drive.axis}: node {late.drive.node_id} answers a SYNC later than "
            f"{REPLY_SHARE:g} of the cycle of {self._cycle_time * 1000:g} ms, or the bus is too slow "
            f"or disturbed.{so_far} Check the bus load, or use a longer cycle."
        )

    def _towards_enabled(self) -> None:
        """Lead every drive, state by state, to operation enabled; return when time is up."""
        for _ in range(round(len(STEP_TOWARDS_ENABLED) * STATE_TIMEOUT / self._cycle_time)):
            self._cycle([self._word(c, _next_word(c.state)) for c in self._channels])
            self._check_user()
            self._check_strangers()
            self._check_flood()
            if any(c.state is PowerState.OPERATION_ENABLED for c in self._channels):
                self._look(self._held_targets(), [0] * len(self._channels))
            for channel in self._channels:
                self._check_enabling(channel)
            self._check_energy()
            if all(c.state is PowerState.OPERATION_ENABLED for c in self._channels):
                return

    def _check_enabling(self, channel: Channel) -> None:
        if channel.emergencies or channel.state in (
            None,
            PowerState.FAULT,
            PowerState.FAULT_REACTION_ACTIVE,
        ):
            raise DriveFaultError(channel.trouble())
        if channel.state is PowerState.OPERATION_ENABLED:
            if channel.hold is None:
                channel.hold = channel.position
            if not channel.is_fine(channel.hold, self._line.clock.now()):
                raise SafetyStopError(
                    channel.violation(channel.hold, self._cycle_time),
                    axis=channel.drive.axis,
                    cycle=self._count - 1,
                    runaway=True,
                )

    def end(self) -> None:
        """Disable every axis and stop listening; the normal end, with all axes at rest."""
        try:
            if not self._stopped:
                with uninterrupted():
                    self._stopped = True
                    self._or_last_resort(lambda: self._disable(Controlword.SHUTDOWN))
                    self._make_sure_off()
                if self.perhaps_enabled:
                    raise SafetyStopError(" ".join(self.perhaps_enabled.values()))
                self._check_trust()
        finally:
            for channel in self._channels:
                node_id = channel.drive.node_id
                self._line.unsubscribe(0x80 + node_id, self._on_emergency)
                self._line.unsubscribe(0x700 + node_id, self._on_heartbeat)

    def _check_trust(self) -> None:
        """See that what was measured can be believed: with all axes off, at the end of a motion.

        Raises
        ------
        SafetyStopError
            If a drive's PDOs come too late, show another state than the drive has, or it is in
            another mode than it was set to; or if that can not be asked any more.
        """
        try:
            self._look_for_doubt()
        except StoppedError:
            raise
        except DrivesError as error:
            raise SafetyStopError(
                f"{error} It was so at the end of a motion, with all axes disabled: what was measured "
                "in it is kept, but do not rely on it."
            ) from error

    def _look_for_doubt(self) -> None:
        for channel in self._channels:
            drive = channel.drive
            if channel.contradicts:
                raise SafetyStopError(
                    f"{drive.axis}: the PDOs of node {drive.node_id} show statusword "
                    f"0x{channel.statusword:04X}, the drive itself (object 0x6041:00) shows that it is "
                    "off: a fault would not have been seen. All axes are disabled; what was measured "
                    "is kept, but do not rely on it. Switch the drive off and on.",
                    axis=drive.axis,
                )
            self._check_mode(channel)
        self._check_replies()

    def _check_mode(self, channel: Channel) -> None:
        wrong = self._wrong_mode(channel)
        if wrong:
            raise SafetyStopError(wrong, axis=channel.drive.axis)

    @staticmethod
    def _wrong_mode(channel: Channel) -> str:
        """Return a sentence if a drive is in another mode than it was set to; else nothing."""
        drive = channel.drive
        try:
            shown = drive.read_int(objects.MODE_DISPLAY)
        except SdoError:  # one answer that is lost must not spoil what was measured
            shown = drive.read_int(objects.MODE_DISPLAY)
        return "" if shown == wanted_mode(channel).value else mode_words(channel, shown)

    def _explain(self, cause: BaseException) -> None:
        """Add what the stopped axis' drive says of itself to the error, if that explains it."""
        if not isinstance(cause, SafetyStopError) or cause.axis is None or self.perhaps_enabled:
            return
        channel = next((c for c in self._channels if c.drive.axis == cause.axis), None)
        if channel is not None and not channel.missing:
            with suppress(DrivesError):
                wrong = self._wrong_mode(channel)
                if wrong and wrong not in str(cause):
                    cause.add_note(wrong)

    def stop(self, cause: BaseException | None = None) -> None:
        """Quick stop all axes at once, then disable them; never raises for what a drive does.

        Axes that a ``SafetyStopError`` names in ``power_off`` are not ramped down: their power is cut.
        """
        with uninterrupted():
            if not self._stopped:
                self._stop(cause)
            if cause is not None:
                # Also to an error that followed the one that stopped the axes.
                for sentence in self.perhaps_enabled.values():
                    if sentence not in getattr(cause, "__notes__", ()):
                        cause.add_note(sentence)

    def _stop(self, cause: BaseException | None) -> None:
        self._stopped = True
        for channel in self._channels:
            channel.hold = None  # from now on the target is where the axis is
        cut = self._without_quick_stop(cause)
        self._or_last_resort(lambda: self._quick_stop(cut))
        self._make_sure_off()
        if isinstance(cause, SafetyStopError) and cause.held_up:
            for channel in self._channels:
                channel.drive.learned = Learned()  # the mean of half a move is no weight
        if cause is not None:
            self._explain(cause)

    def _without_quick_stop(self, cause: BaseException | None) -> frozenset[str]:
        """Return the axes whose power is cut at once: a quick stop needs loops that can be trusted."""
        if cause is not None and self._watch is not None and not self._watch.trusts_loops:
            # nor does a person's stop prove that they can be trusted
            return frozenset(c.drive.axis for c in self._channels)
        return cause.power_off if isinstance(cause, SafetyStopError) else frozenset()

    def _make_sure_off(self) -> None:
        """Believe only a fresh statusword; else switch off by SDO, and say what stays unknown.

        The host's heartbeat ends for good where a drive may still be enabled: its own consumer is
        then what stops it, so its fail-safe objects must stay as they are.
        """
        for channel in self._channels:
            if not channel.missing and _is_off(channel.statusword):
                continue
            drive = channel.drive
            stopped = channel.nmt_state == NMT_STOPPED or bool(self._stranger)
            state = drive.switch_off(stopped)
            channel.contradicts = not channel.missing and state is not None and _is_off(state)
            if state is None or not _is_off(state):
                shown = "does not answer" if state is None else f"shows statusword 0x{state:04X}"
                self.perhaps_enabled[drive.axis] = (
                    f"{drive.axis}: node {drive.node_id} {shown} after it was told to switch off: it "
                    f"{MAY_BE_ENABLED}. It has to stop by itself within "
                    f"{self._lost_after:g} s, as it misses the host's heartbeat. Use the emergency "
                    "stop before you go near it."
                )
        if self.perhaps_enabled:
            self._line.end_heartbeat()
            for channel in self._channels:
                if channel.drive.axis in self.perhaps_enabled:
                    channel.drive.stop_node()

    def _or_last_resort(self, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception:  # whatever it was, the axes must not stay enabled
            self._last_resort()

    def _quick_stop(self, cut: frozenset[str]) -> None:
        """Command a quick stop until every axis stands or is off; cut the power of some at once."""
        channels = self._channels
        for channel in channels:
            if channel.missing:  # perhaps it does not take part in SYNC or PDO any more
                channel.drive.order_quick_stop()
        words = [
            Controlword.DISABLE_VOLTAGE if c.drive.axis in cut else Controlword.QUICK_STOP
            for c in channels
        ]
        fast = [
            max(RUNAWAY_GROWTH * abs(c.position - c.previous), RUNAWAY_SHARE * c.step)
            for c in channels
        ]
        too_fast = [0] * len(channels)
        before = [c.position for c in channels]
        still = 0
        for _ in range(round(STOP_TIMEOUT / self._cycle_time)):
            self._cycle([self._word(c, w) for c, w in zip(channels, words, strict=True)])
            moving = False
            for k, c in enumerate(channels):
                moved = abs(c.position - before[k])
                before[k] = c.position
                too_fast[k] = too_fast[k] + 1 if moved > fast[k] else 0
                if too_fast[k] >= RUNAWAY_CYCLES:
                    words[k] = Controlword.DISABLE_VOLTAGE
                moving = moving or _still_moves(c, moved)
            still = 0 if moving else still + 1
            if still >= 3:
                break
        self._disable(Controlword.DISABLE_VOLTAGE)

    def _disable(self, first: Controlword) -> None:
        for word in dict.fromkeys((first, Controlword.DISABLE_VOLTAGE)):
            for _ in range(round(STATE_TIMEOUT / self._cycle_time)):
                self._cycle([self._word(c, word) for c in self._channels])
                if all(c.missing or _is_off(c.statusword) for c in self._channels):
                    break

    def _last_resort(self) -> None:
        """The cyclic way failed: no statusword is fresh, and every drive is asked one by one."""
        for channel in self._channels:
            channel.missing = max(channel.missing, 1)

    # --- the cycle -----------------------------------------------------------------------------

    def _follow(self, block: FloatArray | Targets, captures: list[Capture]) -> Capture:
        """Send a block of targets; what came back joins ``captures`` whatever happens."""
        outputs = outputs_of(block, self._channels, self._count)
        units, frames = outputs.units, outputs.frames
        first, n = self._count, units.shape[0]
        received = [bytearray() for _ in self._channels]
        missing: list[int] = []
        row = 0
        try:
            for row in range(n):
                a, b = 8 * row, 8 * row + 8
                complete = self._cycle([frame[a:b] for frame in frames])
                for channel, raw in zip(self._channels, received, strict=True):
                    raw.extend(channel.last)
                if not complete:
                    missing.append(row)
                self._check(units[row].tolist(), outputs.offset_units[row].tolist())
        finally:
            for k, channel in enumerate(self._channels):
                channel.hold = int(units[row, k])  # what was sent last stays the target
                channel.offset = int(outputs.offset_units[row, k])
            captures.append(self._capture(first, outputs, received, missing))
        return captures[-1]

    def _release_offsets(self) -> None:
        """Take torque offsets away when a stream ends: nobody may think of them until the next."""
        channels = self._channels
        if any(c.offset for c in channels):
            self._cycle([self._word(c, Controlword.ENABLE_OPERATION) for c in channels])
            for channel in channels:
                channel.offset = 0
            self._check(self._held_targets(), [0] * len(channels))

    def _held_targets(self) -> list[int]:
        """Return where every axis is told to stand, position units."""
        return [c.position if c.hold is None else c.hold for c in self._channels]

    def _capture(
        self, first: int, outputs: Outputs, received: list[bytearray], missing: list[int]
    ) -> Capture:
        rows = min(len(raw) for raw in received) // INPUT.size
        tables = [np.frombuffer(bytes(raw[: rows * 8]), dtype=INPUT_ROW) for raw in received]
        scales = [c.drive.scaling for c in self._channels]
        return Capture(
            first,
            np.array(outputs.position[:rows], dtype=np.float64),
            np.stack(
                [t["position"] * s.position for t, s in zip(tables, scales, strict=True)], axis=1
            ),
            np.stack([t["torque"] * s.torque for t, s in zip(tables, scales, strict=True)], axis=1),
            np.stack([t["statusword"] for t in tables], axis=1),
            tuple(missing),
            outputs.torque_offset[:rows] if any(self.torque_offsets) else None,
        )

    def _cycle(self, outputs: Sequence[bytes]) -> bool:
        """Send outputs, then SYNC, then take every drive's input; return whether all came."""
        line = self._line
        for channel, output in zip(self._channels, outputs, strict=True):
            channel.output.data = bytearray(output)
            line.send(channel.output)
        line.beat()
        self._disturbed = False
        moment = self._sync.give(self._early)
        self._count += 1
        self._note_pause(moment)
        for channel in self._channels:
            channel.stray = channel.stray + 1 if channel.strayed else 0
            channel.strayed = False
        complete = self._collect(moment + REPLY_SHARE * self._cycle_time)
        spoiled = self._disturbed or self._sync.lateness > 0 or self._lost_frames()
        self._complete = complete and not spoiled
        return self._complete

    def _note_pause(self, moment: float) -> None:
        """Have velocities judged over the time that has passed, where a SYNC was late."""
        paused = (moment - self._moment) / self._cycle_time - 1
        self._moment = moment
        if paused > LATE_SHARE:
            for channel in self._channels:
                channel.paused += paused

    def _lost_frames(self) -> bool:
        """Whether received frames were lost since this was asked last."""
        before, self._lost = self._lost, self._line.overruns
        return self._lost != before

    def _early(self, message: can.Message) -> None:
        """Hand on a frame that came before the SYNC.

        A drive's PDO among them came too late for its SYNC, or answers a SYNC that is not ours.
        """
        k = self._by_cob.get(message.arbitration_id)
        if k is not None and is_data(message):
            self._channels[k].strayed = self._disturbed = True
        else:
            self._hand_on(message)

    def _collect(self, deadline: float) -> bool:
        """Take every drive's PDO; return whether all came.

        A host that was held up takes what waits for it after the deadline too, but not other frames
        without end.  None is taken that may be older than the SYNC.
        """
        by_cob, channels, clock = self._by_cob, self._channels, self._line.clock
        awaited = set(by_cob.values())
        end = clock.now() + self._cycle_time
        while awaited and not self._sync.behind:
            message = self._line.receive(max(0.0, deadline - clock.now()))
            if message is None:
                break
            k = by_cob.get(message.arbitration_id)
            if k is None or not is_data(message) or len(message.data) != INPUT.size:
                self._hand_on(message)
            elif k in awaited:
                channels[k].take(bytes(message.data))
                awaited.discard(k)
                continue
            else:
                channels[k].strayed = True
            if clock.now() >= end:
                break
        for k in awaited:
            channels[k].missing += 1
        return not awaited and not any(c.strayed for c in channels)

    def _hand_on(self, message: can.Message) -> None:
        self._stranger = self._stranger or self._strangers.command(message)
        if is_data(message):
            self._line.notify(message.arbitration_id, message.data, message.timestamp)

    def _word(self, channel: Channel, word: Controlword) -> bytes:
        """Return a PDO that holds the position; target torque and torque offset are always 0."""
        position = channel.position if channel.hold is None else channel.hold
        return OUTPUT.pack(word, position, 0)

    # --- watching ------------------------------------------------------------------------------

    def _on_emergency(self, can_id: int, data: bytearray, _timestamp: float) -> None:
        code = int.from_bytes(data[0:2], "little")
        if code >> 8:  # 0x00xx: error reset
            self._by_node[can_id - 0x80].emergencies.append(code)

    def _on_heartbeat(self, can_id: int, data: bytearray, _timestamp: float) -> None:
        channel = self._by_node[can_id - 0x700]
        channel.heard = self._line.clock.now()
        channel.nmt_state = data[0] & 0x7F if data else 0
        if channel.nmt_state == 0:
            channel.rebooted = True

    def _check_lateness(self, targets: Sequence[int]) -> None:
        """Raise SafetyStopError where a cycle began too late: sooner where targets are under way."""
        most, late = self._most_late, self._sync.lateness
        if self._watch is not None and targets != self._targets:
            most = min(most, self._watch.most_late)
        self._targets = targets
        if late > most:
            raise SafetyStopError(
                f"this computer stood still for {1000 * late:.0f} ms; a cycle may begin "
                f"{1000 * most:.0f} ms late at most. All axes were stopped. Close other "
                "programs, switch power saving off, and start again.",
                cycle=self._count - 1,
                held_up=0.0 if late > self._most_late else late,
            )

    def _check_user(self) -> None:
        if self._stop_requested():
            raise UserStopError(
                "stopped by the user: all axes were stopped and disabled. What was recorded until "
                "then is kept."
            )

    def _check_strangers(self) -> None:
        if self._stranger:
            raise SafetyStopError(
                f"somebody else sends {self._stranger} on this bus; all axes were stopped. Two masters "
                "must not command one machine: stop the other controller first.",
                cycle=self._count - 1,
            )

    def _check_flood(self) -> None:
        behind = self._sync.behind
        if len(behind) > MISSING_ALLOWED:
            raise SafetyStopError(
                f"frames come faster than this computer takes them, the last one 0x{behind[-1]:X}: for "
                f"{len(behind)} cycles nothing was known of the drives; all axes were stopped. Look for "
                "a device that sends without end, close other programs, and start again.",
                cycle=self._count - 1,
            )

    def _check(self, targets: Sequence[int], offsets: Sequence[int]) -> None:
        """Raise SafetyStopError for the first thing that is not as it has to be."""
        self._check_user()
        self._check_lateness(targets)
        self._check_strangers()
        self._check_flood()
        self._look(targets, offsets)
        now = self._line.clock.now()
        for channel, target in zip(self._channels, targets, strict=True):
            if not channel.is_fine(target, now):
                raise SafetyStopError(
                    channel.violation(target, self._cycle_time),
                    axis=channel.drive.axis,
                    cycle=self._count - 1,
                    runaway=channel.is_stuck(target) or bool(channel.alarm),
                )
        self._check_energy()
        self._check_asked()

    def _check_asked(self) -> None:
        """Raise SafetyStopError where a drive that is asked is not as its PDOs say."""
        found = self._asked.wrong()
        if found is not None:
            channel, said = found
            raise SafetyStopError(said, axis=channel.drive.axis, cycle=self._count - 1)

    def _check_energy(self) -> None:
        """Raise SafetyStopError where the axes give back more energy than they were given."""
        worst = reversed_axis([c.balance for c in self._channels])
        if worst is not None:
            drive = self._channels[worst].drive
            raise SafetyStopError(
                self._channels[worst].reversed_words(),
                axis=drive.axis,
                cycle=self._count - 1,
                # an axis that may sink is held, if it can be: one that runs away loses its power then
                runaway=drive.axis_profile.may_float,
            )

    def _look(self, targets: Sequence[int], offsets: Sequence[int]) -> None:
        """Have the watch look at this cycle; raise OscillationError if it says that this has to end.

        Targets and torque offsets are those that were sent, in the drives' units.
        """
        if self._watch is None:
            return
        scales = [c.drive.scaling for c in self._channels]
        inputs = [INPUT.unpack(c.last) for c in self._channels]
        alarm = self._watch.take(
            [one[1] * scale.position for one, scale in zip(inputs, scales, strict=True)],
            [one[2] * scale.torque for one, scale in zip(inputs, scales, strict=True)],
            [one * scale.position for one, scale in zip(targets, scales, strict=True)],
            [one * scale.torque for one, scale in zip(offsets, scales, strict=True)],
            fresh=self._complete,
            late=self._sync.stretch,
        )
        if alarm is not None:
            raise OscillationError(
                alarm.sentence,
                axis=alarm.axis,
                cycle=self._count - 1,
                power_off=alarm.power_off,
                held_up=alarm.held_up,
            )


def _is_off(statusword: int) -> bool:
    """Whether this statusword shows a power stage that is off."""
    return statusword & 0x4F in (0x40, 0x08) or statusword & 0x6F in (0x21, 0x23)


def _next_word(state: PowerState | None) -> Controlword:
    """Return the controlword that leads from this state towards operation enabled."""
    if state is PowerState.OPERATION_ENABLED:
        return Controlword.ENABLE_OPERATION
    step = STEP_TOWARDS_ENABLED.get(state) if state else None
    return step[0] if step else Controlword.DISABLE_VOLTAGE


def _still_moves(channel: Channel, moved: int) -> bool:
    """Whether a quick stop of this axis is still at work; one that is off or mute is done."""
    state = channel.statusword & 0x6F
    if channel.missing or state not in (ENABLED_VALUE, PowerState.QUICK_STOP_ACTIVE.value[1]):
        return False
    return state == ENABLED_VALUE or moved > max(2, channel.step // 100)


def _as_stopped(error: BaseException) -> StoppedError | None:
    """Return the error that says the machine was stopped, for causes that stop it; else None."""
    if isinstance(error, StoppedError):
        return error
    if isinstance(error, KeyboardInterrupt):
        return UserStopError("stopped by the user: all axes were stopped and disabled.")
    if isinstance(error, DrivesError):
        return SafetyStopError(
            f"{error} The axes were told to stop; a drive that did not hear it stops by itself when "
            "it misses the host's heartbeat. See that the machine stands before you go near it."
        )
    return None
