"""One drive: its objects by SDO, its identity, its units."""

import logging
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace

from canopen.objectdictionary import ObjectDictionary
from canopen.sdo import SdoAbortedError, SdoCommunicationError

from drives import objects
from drives.api import AxisLimits, DriveIdentity
from drives.bus import drives_begin_anew
from drives.canopen_drive.conversion import Conversion, quantity_objects, unmet_conditions
from drives.canopen_drive.line import Line, Node
from drives.canopen_drive.scaling import Scaled, read_scaling
from drives.canopen_drive.unseen import Learned
from drives.cia402 import Mode, PowerState, emergency_text, in_words
from drives.errors import (
    BusError,
    DriveFaultError,
    DrivesError,
    LimitsError,
    NodeAbsentError,
    NothingMovedError,
    NotSupportedError,
    ProfileError,
    SdoAbortError,
    SdoError,
    SdoTimeoutError,
    WrongDeviceError,
)
from drives.objects import ObjectAddress, ObjectInfo
from drives.profile import AxisProfile, DriveProfile, Identity
from drives.profile.eds import info_at, read_eds, variables, writable
from drives.profile.match import offered_modes
from drives.units import AxisScaling

logging.getLogger("canopen").setLevel(logging.CRITICAL)  # what goes wrong is raised, not logged

CIA402_DEVICE = 402
STOP_NODE, ENTER_PRE_OPERATIONAL, RESET_NODE = 0x02, 0x80, 0x81
QUICK_STOP = 0x0002
"""Controlword."""
MOST_ERRORS = 8
"""Entries of the error history that are read at most."""
WAKING = 0.1
"""Seconds at least from one call to a node that does not answer to the next."""


class CanopenDrive:
    """A CiA 402 drive behind SDO; enabling and motion belong to ``CanopenMotion``."""

    def __init__(self, line: Line, axis: AxisProfile, profile: DriveProfile) -> None:
        self.line, self._axis = line, axis
        self.dictionary = _read_eds(profile)
        self.profile = profile.with_types_of(self.dictionary)
        self.node = Node(axis.node_id, ObjectDictionary())
        line.add_node(self.node)
        self._identity: DriveIdentity | None = None
        self._scaled: Scaled | None = None
        self.left_changed = False
        """Whether something that was set for a time could not be put back."""
        self.boots = 0
        """Boot-up messages of it that nobody had asked for: what was not stored in it is lost then."""
        line.subscribe(0x700 + self.node_id, self._on_heartbeat)
        self.learned = Learned()
        """What its motion has shown so far; learned while it moves."""

    @property
    def axis(self) -> str:
        """Name of the axis."""
        return self._axis.name

    @property
    def axis_profile(self) -> AxisProfile:
        """What the machine profile says of the axis."""
        return self._axis

    @property
    def node_id(self) -> int:
        """CANopen node id."""
        return self._axis.node_id

    @property
    def limits(self) -> AxisLimits:
        """What the axis may do."""
        return self._axis.limits.watched

    @property
    def position_unit(self) -> str:
        """Unit of positions: rad or m."""
        return "rad" if self._axis.kind == "rotary" else "m"

    @property
    def torque_unit(self) -> str:
        """Unit of torques: N m or N."""
        return "N m" if self._axis.kind == "rotary" else "N"

    @property
    def identity(self) -> DriveIdentity:
        """What the drive says of itself; known once :meth:`identify` was called."""
        if self._identity is None:
            raise NothingMovedError(f"{self.axis}: the drive was not identified yet")
        return self._identity

    @property
    def scaled(self) -> Scaled:
        """Worth of the drive's units, and where it comes from; known once they were read."""
        if self._scaled is None:
            raise NothingMovedError(f"{self.axis}: the drive's units were not read yet")
        return self._scaled

    @property
    def scaling(self) -> AxisScaling:
        """Worth of the drive's units; known once :meth:`read_scaling` was called."""
        return self.scaled.axis

    @property
    def rated_torque(self) -> float:
        """N m or N that 1000 per mille of torque are."""
        return self.scaled.rated_torque

    # --- objects -------------------------------------------------------------------------------

    def info(self, address: ObjectAddress) -> ObjectInfo | None:
        """Return what the EDS says of an object, None if it has none."""
        return info_at(self.dictionary, address)

    def writable_parameters(self) -> Iterator[ObjectInfo]:
        """Yield every object that the EDS calls writable and that is a parameter, not a command.

        Objects of the communication profile stay out from 0x1200 to 0x1FFF (SDO and PDO set-up
        belongs to whoever uses the bus), and so do ``objects.COMMANDS`` and the profile's commands.
        """
        for variable in variables(self.dictionary):
            address = ObjectAddress(variable.index, variable.subindex)
            info = self.info(address)
            if (
                info is not None
                and not 0x1200 <= address.index < 0x2000
                and writable(variable)
                and address.index not in objects.COMMANDS
                and not self.profile.is_volatile(address)
            ):
                yield info

    def read(self, info: ObjectInfo, timeout: float | None = None) -> int | float | str:
        """Read an object.

        Raises
        ------
        SdoAbortError, SdoTimeoutError, SdoError
            If the drive refuses, does not answer, or answers something else.
        """
        info = self._typed(info)
        address = info.address
        with self._asking(address, "read", timeout):
            data = self.node.sdo.upload(address.index, address.subindex)
        try:
            return info.decode(data)
        except ValueError as error:
            raise SdoError(self.axis, address.index, address.subindex, f"{error}.") from None

    def read_int(self, info: ObjectInfo) -> int:
        """Read an object that holds a whole number."""
        value = self.read(info)
        if not isinstance(value, int):
            raise SdoError(
                self.axis,
                info.address.index,
                info.address.subindex,
                f"holds {value!r}, a whole number was expected.",
            )
        return value

    def read_number(self, info: ObjectInfo) -> int | float:
        """Read an object that holds a number, whole or not."""
        value = self.read(info)
        if isinstance(value, str):
            raise SdoError(
                self.axis,
                info.address.index,
                info.address.subindex,
                f"holds text {value!r}, a number was expected.",
            )
        return value

    def read_optional(self, info: ObjectInfo) -> int | None:
        """Read an object that some drives lack; None if this one does."""
        try:
            return self.read_int(info)
        except SdoAbortError as error:
            if error.code in (0x06020000, 0x06090011):
                return None
            raise

    def write(self, info: ObjectInfo, value: float | str, timeout: float | None = None) -> None:
        """Write an object.

        Raises
        ------
        SdoAbortError, SdoTimeoutError, SdoError
            If the drive refuses or does not answer, or the value does not fit the type.
        """
        info = self._typed(info)
        address = info.address
        try:
            data = info.encode(value)
        except ValueError as error:
            raise SdoError(self.axis, address.index, address.subindex, f"{error}.") from None
        with self._asking(address, "write", timeout):
            self.node.sdo.download(address.index, address.subindex, data)

    def _typed(self, info: ObjectInfo) -> ObjectInfo:
        """Return the object with the type that this drive's EDS gives it."""
        own = self.info(info.address)
        return info if own is None else replace(info, type=own.type)

    @contextmanager
    def _asking(self, address: ObjectAddress, verb: str, timeout: float | None) -> Iterator[None]:
        place = (self.axis, address.index, address.subindex)
        client = self.node.sdo
        before = client.RESPONSE_TIMEOUT
        try:
            if timeout is not None:
                client.RESPONSE_TIMEOUT = timeout
            yield
        except SdoAbortedError as error:
            raise SdoAbortError(*place, error.code, verb) from None
        except struct.error as error:
            raise SdoError(*place, f"the drive's answer was too short: {error}.") from None
        except SdoCommunicationError as error:
            if "No SDO response" in str(error):
                raise SdoTimeoutError(
                    *place,
                    f"node {self.node_id} did not answer within {client.RESPONSE_TIMEOUT:g} s. "
                    "Check its supply, cable and bit rate.",
                ) from None
            raise SdoError(*place, f"the drive's answer was wrong: {error}.") from None
        finally:
            client.RESPONSE_TIMEOUT = before

    # --- who and what --------------------------------------------------------------------------

    def identify(self) -> DriveIdentity:
        """Read who the drive is and compare it with its profiles.

        Raises
        ------
        NodeAbsentError
            If the node does not answer.
        WrongDeviceError
            If it is no CiA 402 drive, or not the one that the profile describes.
        """
        device_type = self._first_answer()
        if device_type & 0xFFFF != CIA402_DEVICE:
            raise WrongDeviceError(
                f"{self.axis}: node {self.node_id} is no CiA 402 drive: device type 0x1000 is "
                f"0x{device_type:08X} (profile number {device_type & 0xFFFF}). Check the node ids."
            )
        self._identity = DriveIdentity(
            device_type,
            self.read_optional(objects.VENDOR_ID) or 0,
            self.read_optional(objects.PRODUCT_CODE) or 0,
            self.read_optional(objects.REVISION) or 0,
            self.read_optional(objects.SERIAL_NUMBER) or 0,
            self._text(objects.DEVICE_NAME),
            self._text(objects.FIRMWARE_VERSION),
        )
        wanted, found = self.profile.identity, self._identity
        mask = 0xFFFF if wanted.low_word_only else 0xFFFFFFFF
        for what, expected, held, bits in (
            ("device type 0x1000", wanted.device_type, found.device_type, mask),
            ("vendor-ID 0x1018:01", wanted.vendor_id, found.vendor_id, 0xFFFFFFFF),
            ("product code 0x1018:02", wanted.product_code, found.product_code, 0xFFFFFFFF),
            ("serial number 0x1018:04", self._axis.serial_number, found.serial_number, 0xFFFFFFFF),
            ("supported modes 0x6502", wanted.supported_modes, self._modes(wanted), 0xFFFFFFFF),
        ):
            if expected is not None and expected & bits != held & bits:
                raise WrongDeviceError(
                    f"{self.axis}: node {self.node_id} is another device than profile "
                    f"{self.profile.name} says: {what} is 0x{held:08X}, expected "
                    f"0x{expected:08X}. Check the node id and the machine profile."
                )
        return self._identity

    def _modes(self, wanted: Identity) -> int:
        """Return 0x6502 where the profile tells such drives by it."""
        if wanted.supported_modes is None:
            return 0
        return self.read_optional(objects.SUPPORTED_MODES) or 0

    def _first_answer(self) -> int:
        try:
            return self.read_int(objects.DEVICE_TYPE)
        except SdoTimeoutError:
            self.node.nmt.send_command(ENTER_PRE_OPERATIONAL)  # a stopped node answers no SDO
        try:
            return self.read_int(objects.DEVICE_TYPE)
        except SdoTimeoutError:
            raise NodeAbsentError(
                f"{self.axis}: node {self.node_id} does not answer. {self.line.diagnosis()} Check its "
                "supply, its cable, its node id and the bit rate.".replace("  ", " ")
            ) from None

    def wait(self, seconds: float) -> None:
        """Let time pass on the drive's bus, and receive meanwhile."""
        self.line.wait(seconds)

    def answers(self) -> bool:
        """Whether the node answers at all."""
        try:
            self.read(objects.DEVICE_TYPE)
        except SdoAbortError:
            return True
        except (SdoError, BusError):
            return False
        return True

    @property
    def begins_anew(self) -> bool:
        """Whether it was switched on with this bus: nothing of an earlier session is in it."""
        return drives_begin_anew(self.line.can_bus)

    def wakes(self, patience: float) -> bool:
        """Whether the node answers, perhaps after it has booted, or was told to leave NMT stopped.

        Parameters
        ----------
        patience
            Seconds to wait for it at most.  Two drives that contradict each other are not waited
            for: no time makes one of them.
        """
        clock = self.line.clock
        deadline = clock.now() + patience
        while not self.answers():
            now = clock.now()
            if now >= deadline or self.node.sdo.contradicted:
                return False
            with suppress(BusError):
                self.node.nmt.send_command(ENTER_PRE_OPERATIONAL)
                self.line.wait(WAKING)
            clock.wait_until(now + WAKING)  # on a bus that fails too: what fails may do so at once
        return True

    def restart(self, patience: float) -> bool:
        """Restart the node (NMT reset), as a power cycle would; return whether it is back.

        Parameters
        ----------
        patience
            Seconds to wait for its boot-up message, and for its answers, at most.
        """
        before = self.boots
        try:
            self.node.nmt.send_command(RESET_NODE)
            booted = self.line.wait(patience, lambda: self.boots != before)
        finally:
            self.boots = before
        return booted and self.wakes(patience)

    def _on_heartbeat(self, _id: int, data: bytearray, _time: float) -> None:
        self.boots += bytes(data) == b"\0"

    @property
    def unasked_answers(self) -> int:
        """SDO answers that came and that nobody had asked for."""
        client = self.node.sdo
        client.forget_old()
        return int(client.unasked)

    @contextmanager
    def told_all_the_same(self) -> Iterator[None]:
        """Write to the drive although two answers of its node differ; what it says is not believed."""
        self.node.sdo.told_all_the_same = True
        try:
            yield
        finally:
            self.node.sdo.told_all_the_same = False

    def _text(self, info: ObjectInfo) -> str:
        try:
            return str(self.read(info))
        except SdoAbortError:
            return ""

    def read_scaling(self) -> AxisScaling:
        """Read what the drive's position, velocity and torque units are worth.

        Raises
        ------
        NotSupportedError
            If one of them has no scale; see ``scaling.read_scaling``.
        """
        self._scaled = read_scaling(self)
        return self._scaled.axis

    def conversion(self) -> Conversion:
        """Return how parameters become physical, with the quantities read that units depend on.

        Raises
        ------
        SdoError
            If the drive does not let them be read.
        """
        needed = {other for one in self.profile.parameters.values() for other in one.times}
        quantities = {}
        if "counts_per_rev" in needed:
            quantities["counts_per_rev"] = self.scaled.counts_per_rev
        if "rated_torque" in needed:
            quantities["rated_torque"] = self.scaled.rated_torque
        for name, info, scale in quantity_objects(self.profile):
            quantities[name] = float(self.read(info)) * scale
        return Conversion(
            self.axis, self.profile, quantities, unmet_conditions(self.profile, self.read_optional)
        )

    def check_limits(self) -> None:
        """Refuse limits that the drive's units can not express: they could not be watched.

        Raises
        ------
        LimitsError
            With the limit, and what the drive can express.
        """
        scale, limits = self.scaling, self.limits
        low, high = limits.travel
        most = 2**31 * scale.position
        if not (-most <= low and high < most):
            raise LimitsError(
                f"{self.axis}: travel {low:g} to {high:g} {self.position_unit} is more than the "
                f"drive's position can show, {-most:.4g} to {most:.4g} {self.position_unit}. Give the "
                "axis' real travel in the machine profile."
            )
        for what, limit, unit, smallest in (
            ("following error", limits.following_error, self.position_unit, scale.position),
            ("torque", limits.torque, self.torque_unit, scale.torque),
        ):
            if limit < smallest:
                raise LimitsError(
                    f"{self.axis}: the {what} limit {limit:g} {unit} is less than the drive's "
                    f"resolution of {smallest:.4g} {unit}, so it can not be watched. Correct it in "
                    "the machine profile."
                )

    def read_position(self) -> float:
        """Read the actual position 0x6064, rad or m."""
        return self.read_int(objects.POSITION_ACTUAL) * self.scaling.position

    # --- state ---------------------------------------------------------------------------------

    def power_state(self) -> PowerState:
        """Read the statusword and return the state it shows."""
        try:
            return PowerState.of(self.read_int(objects.STATUSWORD))
        except ValueError as error:
            raise DriveFaultError(f"{self.axis}: {error}.") from None

    def check_idle(self) -> None:
        """Refuse a drive that is in fault, or that somebody else has enabled.

        Raises
        ------
        DriveFaultError
            With the drive's last error.
        """
        state = self.power_state()
        if state in (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE):
            raise DriveFaultError(
                f"{self.axis}: the drive is in {state.words}; its last error is {self.last_error()}. "
                "Find the cause and reset the fault before starting again."
            )
        if state in (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE):
            raise DriveFaultError(
                f"{self.axis}: the drive is already enabled ({state.words}): somebody else commands "
                "it. Stop the other controller first."
            )

    def last_error(self) -> str:
        """Return the newest entry of the drive's error history 0x1003 in words, and those before it."""
        try:
            codes = self.error_history()
        except (SdoError, BusError):
            return "not readable"
        return ", before it ".join(map(emergency_text, dict.fromkeys(codes))) or "not recorded"

    def error_history(self) -> tuple[int, ...]:
        """Return the emergency codes in the drive's error history 0x1003, newest first.

        Empty where it has none.

        Raises
        ------
        SdoError
            If an entry that its count promises can not be read.
        """
        count = self.read_optional(objects.ERROR_COUNT)
        codes: list[int] = []
        for k in range(1, 1 + min(MOST_ERRORS if count is None else count, MOST_ERRORS)):
            entry = self.read_optional(
                ObjectInfo(ObjectAddress(0x1003, k), "UNSIGNED32", f"standard error field {k}")
            )
            if entry is None:
                break
            codes.append(entry & 0xFFFF)
        return tuple(code for code in codes if code)

    def switch_off(self, stopped: bool = False) -> int | None:
        """Write controlword 0 and return the statusword then, by SDO; None if there is no answer.

        A node that was ``stopped`` answers no SDO: it is led to pre-operational first.
        """
        try:
            if stopped:
                self.node.nmt.send_command(ENTER_PRE_OPERATIONAL)
            self.write(objects.CONTROLWORD, 0)
            return self.read_int(objects.STATUSWORD)
        except DrivesError:
            return None

    def order_quick_stop(self) -> None:
        """Ask for a quick stop by SDO, without waiting for an answer: for a drive without PDOs."""
        request = struct.pack("<BHBHxx", 0x2B, objects.CONTROLWORD.address.index, 0, QUICK_STOP)
        with suppress(DrivesError):
            self.line.send_message(0x600 + self.node_id, request)

    def to_pre_operational(self) -> None:
        """Lead the node to NMT pre-operational, where its PDOs may be set up."""
        self.node.nmt.send_command(ENTER_PRE_OPERATIONAL)

    def stop_node(self) -> None:
        """Send NMT stop to the node; a bus that does not take it changes nothing."""
        with suppress(DrivesError):
            self.node.nmt.send_command(STOP_NODE)

    def check_mode(self, mode: Mode) -> None:
        """Refuse a mode that the drive does not have: by its 0x6502, else by its profile.

        Raises
        ------
        NotSupportedError
            With the modes that are there.
        """
        supported = self.read_optional(objects.SUPPORTED_MODES)
        offered = offered_modes(self.profile, supported)
        if offered is None or mode.value in offered:
            return
        source = "its profile" if supported is None else f"0x6502 is 0x{supported:08X}"
        raise NotSupportedError(
            f"{self.axis}: the drive has no mode {mode.words} ({mode.value}); {source}: "
            f"{in_words(offered)}. This tool can not measure with it; nothing was moved."
        )

    def set_mode(self, mode: Mode, timeout: float = 1.0) -> None:
        """Set the mode of operation and see it confirmed in 0x6061.

        Raises
        ------
        NotSupportedError
            If the drive does not confirm.
        """
        self.write(objects.MODE, mode.value)
        deadline = self.line.clock.now() + timeout
        while (shown := self.read_int(objects.MODE_DISPLAY)) != mode.value:
            if self.line.clock.now() >= deadline:
                raise NotSupportedError(
                    f"{self.axis}: mode {mode.words} ({mode.value}) was not taken; 0x6061 shows "
                    f"{shown} after {timeout:g} s."
                )
            self.line.wait(0.005)


def _read_eds(profile: DriveProfile) -> ObjectDictionary:
    path = profile.eds_path
    if path is None:
        raise ProfileError(
            profile.path,
            f"profile {profile.name} ships no EDS file. Give the drive's own EDS with `eds:` at the "
            "axis in the machine profile",
        )
    return read_eds(path)
