"""All drives of a machine: connected, checked, and put back as they were."""

import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cached_property
from pathlib import Path

import can

from drives.api import MotionWatch, Onlooker
from drives.bus import CyclicLoad, check_cycle, close_bus, open_bus, shortest_cycle
from drives.bus.opening import SOCKETCAN
from drives.canopen_drive import fail_safe, setup
from drives.canopen_drive.drive import CanopenDrive
from drives.canopen_drive.interrupts import uninterrupted
from drives.canopen_drive.line import Line
from drives.canopen_drive.motion import CanopenMotion
from drives.canopen_drive.pace import Punctuality, undisturbed
from drives.canopen_drive.recovery import recover
from drives.canopen_drive.strangers import Strangers, commands
from drives.canopen_drive.sync import HostSync, KernelSync
from drives.canopen_drive.torque_offset import why_not
from drives.cia402 import Mode
from drives.errors import (
    BusError,
    LimitsError,
    NothingMovedError,
    NotSupportedError,
    SafetyStopError,
    SdoError,
)
from drives.objects import ObjectInfo
from drives.profile import AxisProfile, DriveProfile, MachineProfile, load_drive
from drives.trace import traced

START_NODE = 0x01
LISTENING_TIME = 0.3
"""Seconds for which the bus is listened to before anything is changed."""


def _never() -> bool:
    return False


class CanopenGroup:
    """The identified drives of one machine; made by :func:`connect`."""

    def __init__(
        self,
        line: Line,
        machine: MachineProfile,
        drives: Sequence[CanopenDrive],
        stop_requested: Callable[[], bool],
    ) -> None:
        self.line, self.machine = line, machine
        self._drives, self.stop_requested = tuple(drives), stop_requested
        self.warnings: list[str] = []
        """What could not be put back, in words."""
        self.recovered: tuple[str, ...] = ()
        """Faults of drives that a lost host had left behind, and that were reset, a sentence each."""
        self.onlooker: Onlooker | None = None
        """Sees every block of all motions; none where it is None."""
        self._unsure: dict[str, str] = {}
        """Axes that may still be enabled, and why, in words."""
        self._moved = False
        """Whether axes were enabled, in any motion."""
        bus = machine.bus
        self.punctuality = Punctuality(
            kernel_could=bus.interface == SOCKETCAN and bus.sync == "host"
        )
        """How well the host has kept the cycles of all motions so far."""

    @property
    def drives(self) -> tuple[CanopenDrive, ...]:
        """One drive an axis, in the machine profile's order."""
        return self._drives

    @property
    def late_cycles(self) -> int:
        """Cycles of all motions so far that the host began late."""
        return self.punctuality.late

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes, in the machine profile's order."""
        return tuple(d.axis for d in self._drives)

    @property
    def shortest_cycle(self) -> float:
        """Shortest cycle time that fits the bus and that the machine profile allows, seconds."""
        bus = self.machine.bus
        return max(shortest_cycle(len(self._drives), bus.bitrate), bus.shortest_cycle)

    @cached_property
    def _offset_obstacles(self) -> tuple[str, ...]:
        return tuple(why_not(d) for d in self._drives)

    @property
    def torque_offsets(self) -> tuple[bool, ...]:
        """Of which axes the drive takes torque offsets (0x60B2) together with target positions.

        Its profile says so, its EDS has the object as INTEGER16 that an RPDO may carry, and the
        drive itself has it; asked once.

        Raises
        ------
        SdoError
            If a drive does not answer.
        """
        return tuple(not obstacle for obstacle in self._offset_obstacles)

    def check_can_measure(self) -> None:
        """Refuse drives that frequency responses can not be measured with, before anything moves.

        Raises
        ------
        NotSupportedError
            If a drive lacks a mode that measuring needs, or is not known to stop by itself.
        """
        for drive in self._drives:
            drive.check_mode(Mode.CYCLIC_POSITION)
            fail_safe.require_fail_safe(drive)
            if drive.axis_profile.may_float and len(self._drives) > 1:
                drive.check_mode(Mode.CYCLIC_TORQUE)

    @contextmanager
    def without_feed_forward(self) -> Iterator[None]:
        """Switch the drives' feed-forward off while frequency responses are measured.

        That is what the drives themselves derive from the targets; torque offsets that the host
        streams act all the same.

        On leaving, whatever happened, it is what it was.

        Raises
        ------
        NotSupportedError
            If a drive lacks a mode that measuring needs: better known before anything moves.
        SdoError, NotSupportedError
            If a drive does not take it; then those before have their old values again.
        SafetyStopError
            In place of all these where axes have moved before.
        """
        with self._stopped_if_moved(), ExitStack() as stack:
            self.check_can_measure()
            for drive in self._drives:
                changes = self._changes(stack, drive)
                for name in drive.profile.feed_forward:
                    parameter = drive.profile.parameters[name]
                    changes.change(ObjectInfo(parameter.object, parameter.type, name), 0)
            yield

    @contextmanager
    def motion(
        self,
        cycle_time: float,
        free: Collection[str] = (),
        torque_offset: bool = False,
        watch: MotionWatch | None = None,
    ) -> Iterator[CanopenMotion]:
        """Enable all axes: those in ``free`` float without torque, the others hold position.

        Whatever happens inside, on leaving the axes are stopped and disabled, and the drives'
        PDOs and fail-safe objects are what they were.

        Parameters
        ----------
        cycle_time
            Seconds from SYNC to SYNC.
        free
            Names of axes in cyclic torque mode with zero torque.
        torque_offset
            Whether torque offsets are streamed with the positions (``drives.api.Targets``), to the
            axes that :attr:`torque_offsets` shows; those of the others must be 0.
        watch
            Looks at every cycle from the first axis' enabling on, besides the limits.

        Raises
        ------
        LimitsError
            If the cycle does not fit the bus, or an axis may not float, or is to float while torque
            offsets are streamed.
        NotSupportedError
            If torque offsets are asked for and no drive takes them.
        NothingMovedError
            If a drive can not be enabled.
        SafetyStopError
            In place of all these where axes have moved before.
        """
        with self._stopped_if_moved(), ExitStack() as stack:
            self._check(cycle_time, free)
            bus = self.machine.bus
            offsets = self._offset_axes(free) if torque_offset else frozenset()
            for drive in self._drives:
                changes = self._changes(stack, drive)
                mode = Mode.CYCLIC_TORQUE if drive.axis in free else Mode.CYCLIC_POSITION
                setup.cycle(drive, cycle_time, changes)
                setup.mode(drive, mode, changes)
                streamed = drive.axis in offsets
                setup.clear_torque_offset(drive, changes, streamed=streamed)
                setup.process_data(drive, changes, torque_offset=streamed)
            stack.callback(self.line.end_heartbeat)
            for drive in self._drives:  # last, and so first to be put back
                fail_safe.arm(drive, self._changes(stack, drive), bus.host_lost_after)
            for drive in self._drives:
                stack.callback(self._leave_operational, drive)
            for drive in self._drives:
                drive.node.nmt.send_command(START_NODE)
            for drive in self._drives:
                fail_safe.see_armed(drive, bus.host_lost_after)
            sync = self._sync(cycle_time)
            stack.callback(sync.close)
            floating = frozenset(free)
            motion = CanopenMotion(
                self.line,
                self._drives,
                cycle_time,
                floating,
                self.stop_requested,
                offsets,
                sync,
                watch,
                self.machine.couplings,
                bus.host_lost_after,
            )
            motion.perhaps_enabled = self._unsure
            motion.onlooker = self.onlooker
            if self.onlooker is not None:
                self.onlooker.begin(cycle_time)
            motion.real_time = stack.enter_context(undisturbed(self.line.clock))
            stack.enter_context(self.line.only(_identifiers(self._drives)))
            self.line.begin_heartbeat(setup.HOST_NODE_ID, setup.HOST_HEARTBEAT)
            stack.callback(self._note_punctuality, motion)
            stack.callback(motion.end)
            try:
                motion.begin()
                self._moved = True
                yield motion
            except BaseException as error:
                motion.stop(error)
                raise

    @contextmanager
    def _stopped_if_moved(self) -> Iterator[None]:
        """Where axes have moved, make a stop of an error that would say that nothing had."""
        try:
            yield
        except (BusError, NothingMovedError, SdoError) as error:
            if not self._moved:
                raise
            now = " ".join(self._unsure.values()) or "All are disabled now."
            stopped = SafetyStopError(f"{error} Axes had moved before. {now}")
            for note in getattr(error, "__notes__", ()):
                if note not in now:
                    stopped.add_note(note)
            raise stopped from error

    def _sync(self, cycle_time: float) -> HostSync:
        if self.machine.bus.sync == "host":
            return HostSync(self.line, cycle_time)
        try:
            return KernelSync(self.line, cycle_time)
        except can.CanError as error:
            raise NotSupportedError(
                f"the kernel can not give the SYNC ({error}). Set `sync: host` in the machine "
                "profile's bus."
            ) from error

    def _offset_axes(self, free: Collection[str]) -> frozenset[str]:
        """Return the axes that torque offsets are streamed to."""
        if free:
            raise LimitsError(
                f"{', '.join(free)}: can not float while torque offsets are streamed: both use the one "
                "torque of the axis' PDO. Take either `free` or `torque_offset` in one motion."
            )
        if not any(self.torque_offsets):
            raise NotSupportedError(
                "no drive takes a torque offset together with target positions: "
                f"{'; '.join(self._offset_obstacles)}. Measure with position references alone."
            )
        return frozenset(a for a, can in zip(self.axes, self.torque_offsets, strict=True) if can)

    def _check(self, cycle_time: float, free: Collection[str]) -> None:
        check_cycle(CyclicLoad(len(self._drives), cycle_time, self.machine.bus.bitrate))
        for axis in free:
            if axis not in self.axes:
                raise LimitsError(f"{axis} is no axis of machine {self.machine.name}")
        for drive in self._drives:
            low, high = drive.limits.travel
            if drive.axis in free and not drive.axis_profile.may_float:
                raise LimitsError(
                    f"{drive.axis}: may not float (`may_float` in the machine profile is not true), "
                    "so it can not be left without torque."
                )
            drive.check_idle()
            drive.check_mode(Mode.CYCLIC_TORQUE if drive.axis in free else Mode.CYCLIC_POSITION)
            fail_safe.require_fail_safe(drive)
            position = drive.read_position()
            if not low <= position <= high:
                unit = drive.position_unit
                raise LimitsError(
                    f"{drive.axis}: stands at {position:.4g} {unit}, outside its travel {low:g} to "
                    f"{high:g} {unit}. Move it back by hand or with the machine's own controller."
                )

    def _changes(self, stack: ExitStack, drive: CanopenDrive) -> setup.TemporaryObjects:
        changes = setup.TemporaryObjects(drive)
        stack.callback(self._put_back, changes, drive)
        return changes

    def _put_back(self, changes: setup.TemporaryObjects, drive: CanopenDrive) -> None:
        """Put a drive's objects back; what fails joins the warnings and the error on its way.

        Nothing is written to a drive that may be enabled: an old mode has its own old targets, and
        the fail-safe objects may be all that stops it.
        """
        if drive.axis in self._unsure:
            drive.left_changed = True
            self._warn(
                f"could not be put back: {drive.axis}: its fail-safe objects (0x1016, 0x6007, 0x1029) "
                "were left armed, and its mode and PDOs as they were for the motion, because the drive "
                "may still be enabled. Switch the drive off and on."
            )
            return
        with uninterrupted():
            failures = changes.put_back()
        error = sys.exc_info()[1]
        for text in failures:
            self._warn(f"could not be put back: {text}")
            if error is not None:
                error.add_note(f"could not be put back: {text}")

    def _note_punctuality(self, motion: CanopenMotion) -> None:
        self.punctuality = self.punctuality.plus(motion.punctuality)

    def _warn(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)

    def _leave_operational(self, drive: CanopenDrive) -> None:
        try:
            with uninterrupted():
                drive.to_pre_operational()
        except BusError as error:
            self._warn(f"{drive.axis}: {error}")


def _identifiers(drives: Sequence[CanopenDrive]) -> list[int]:
    """What matters while axes move: what drives send, and what only this host may send."""
    services = (0x080, 0x180, 0x580, 0x700)
    own = [service + d.node_id for d in drives for service in services]
    return sorted({*own, *Strangers(drives, setup.HOST_NODE_ID).identifiers})


@contextmanager
def connect(
    machine: MachineProfile,
    bus: can.BusABC | None = None,
    stop_requested: Callable[[], bool] = _never,
    trace: Path | None = None,
    *,
    to_move: bool = True,
) -> Iterator[CanopenGroup]:
    """Open the machine's bus, and identify every drive on it; nothing moves and nothing is written.

    But for one thing: a drive that is to move, and that is in the fault which a lost host leaves
    behind, is led out of it as its profile says (``recovery``).

    Parameters
    ----------
    machine
        The machine profile.
    bus
        A bus that is open already, and stays open; else the profile's is opened and closed.
    stop_requested
        Asked in every cycle of a motion: whether the user wants to stop.
    trace
        File that every frame is noted in (``drives.trace``); none where it is None.
    to_move
        Refuse drives that could not be moved: in fault, without scales, or whose scales do not fit
        the limits.  A drive that has lost its parameters is such a one, until they are restored.

    Raises
    ------
    BusError
        If the bus can not be opened, or the trace can not be written.
    NothingMovedError
        If a node is absent, another device, in fault, has no scales, or a limit does not fit them.
    """
    profiles: dict[str, DriveProfile] = {}
    for axis in machine.axes:
        if axis.node_id == setup.HOST_NODE_ID:
            raise NothingMovedError(
                f"{axis.name}: node id {axis.node_id} is the host's own (its heartbeat); give the "
                "drive another one."
            )
        profiles[axis.name] = profile_of(axis, machine)
    with ExitStack() as stack:
        if bus is None:
            bus = open_bus(machine.bus)
            stack.callback(close_bus, bus)
        line = Line(stack.enter_context(traced(bus, trace)))
        stack.callback(_forget_nodes, line)
        drives = [CanopenDrive(line, axis, profiles[axis.name]) for axis in machine.axes]
        for drive in drives:
            _identify(drive)
        _check_alone(line, drives)
        recovered: list[str] = []
        try:
            for drive in drives if to_move else ():
                drive.check_mode(Mode.CYCLIC_POSITION)
                if said := recover(drive):
                    recovered.append(said)
                drive.check_idle()
                drive.read_scaling()
                drive.check_limits()
        except BaseException as error:
            for said in recovered:
                error.add_note(said)
            raise
        group = CanopenGroup(line, machine, drives, stop_requested)
        group.recovered = tuple(recovered)
        yield group


def _forget_nodes(line: Line) -> None:
    for node_id in list(line.nodes):
        del line[node_id]


def profile_of(axis: AxisProfile, machine: MachineProfile) -> DriveProfile:
    """Return the drive profile of an axis, with the axis' own EDS file where it has one.

    Raises
    ------
    ProfileError
        If the profile is wrong or not there.
    """
    profile = load_drive(axis.drive, machine.path)
    return profile if axis.eds is None else profile.with_eds(machine.path.parent / axis.eds)


def _check_alone(line: Line, drives: Sequence[CanopenDrive]) -> None:
    """Listen for a while, and refuse a bus on which somebody else commands.

    Raises
    ------
    NothingMovedError
        Naming the frame: a SYNC, the host's own heartbeat, or targets for one of our drives; or the
        node that two drives answer for.
    """
    heard = line.listen(LISTENING_TIME)
    cyclic = commands(drives, setup.HOST_NODE_ID)
    foreign = [text for cob_id, text in cyclic.items() if cob_id in heard]
    if foreign:
        raise NothingMovedError(
            f"somebody else sends {' and '.join(foreign)} on this bus; two masters must not command "
            "one machine. Stop the other controller first."
        )
    for drive in drives:
        _check_only_one(drive)


def _identify(drive: CanopenDrive) -> None:
    """Ask a drive what it is; an error that a second one with its node id makes is said as such."""
    try:
        drive.identify()
    except SdoError:
        _check_only_one(drive)
        raise


def _check_only_one(drive: CanopenDrive) -> None:
    """Refuse a node that answers more often than it is asked."""
    if drive.unasked_answers or drive.node.sdo.contradicted:
        raise NothingMovedError(
            f"{drive.axis}: node {drive.node_id} answers more often than it is asked: two drives "
            "have this node id, or another program talks to it. Give every drive an id of its own, "
            "and close other programs."
        )
