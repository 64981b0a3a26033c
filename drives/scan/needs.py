"""What this tool needs of a drive, and what it would miss; judged from what the drive answered."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from drives import objects
from drives.cia402 import Mode
from drives.objects import ObjectAddress, ObjectInfo
from drives.profile import DriveProfile
from drives.scan.asking import Reading

CIA402_DEVICE = 402
Found = Literal["there", "missing", "not known"]


@dataclass(frozen=True)
class Need:
    """One thing that the tool needs of a drive."""

    what: str
    found: Found
    shown: str
    """What the drive answered, in words."""
    consequence: str = ""
    """What can not be done without it; empty where it is there."""
    blocks: bool = False
    """Whether the drive may not be moved by this tool without it."""


Answers = Mapping[ObjectAddress, Reading]
"""What a node answered, by object."""


def _pdo(index: int, subindex: int, name: str) -> ObjectInfo:
    kind = "UNSIGNED32" if subindex else "UNSIGNED8"
    return ObjectInfo(ObjectAddress(index, subindex), kind, name)  # type: ignore[arg-type]


TORQUE_OFFSET = ObjectInfo(ObjectAddress(0x60B2), "INTEGER16", "torque offset")
_PDOS = (
    _pdo(0x1400, 1, "RPDO 1"),
    _pdo(0x1600, 0, "mapping of RPDO 1"),
    _pdo(0x1800, 1, "TPDO 1"),
    _pdo(0x1A00, 0, "mapping of TPDO 1"),
)
_STAYS_STILL = "it may not be moved by this tool"
_PRESENT: tuple[tuple[tuple[ObjectInfo, ...], str, str, bool], ...] = (
    (
        (objects.CONSUMER_HEARTBEAT,),
        "stops when the host dies",
        f"nothing would stop it when the host dies: {_STAYS_STILL}",
        True,
    ),
    (
        (objects.ABORT_CONNECTION,),
        "reaction to a lost host",
        f"what it does when the host dies is not known: {_STAYS_STILL}",
        True,
    ),
    (
        (objects.PRODUCER_HEARTBEAT,),
        "heartbeat",
        f"that it is lost would not be noticed: {_STAYS_STILL}",
        True,
    ),
    (_PDOS, "one PDO each way", f"targets can not be sent in every cycle: {_STAYS_STILL}", True),
    (
        (
            objects.CONTROLWORD,
            objects.STATUSWORD,
            objects.POSITION_ACTUAL,
            objects.TARGET_POSITION,
            objects.TORQUE_ACTUAL,
        ),
        "state, position and torque",
        f"it can be neither commanded nor watched: {_STAYS_STILL}",
        True,
    ),
    (
        (objects.INTERPOLATION_VALUE,),
        "cycle time 0x60C2",
        "the time between targets can not be set",
        False,
    ),
    (
        (objects.STORE_ALL,),
        "store 0x1010",
        "new parameters can not be kept over a power cycle by this tool",
        False,
    ),
    (
        (TORQUE_OFFSET,),
        "torque offset 0x60B2",
        "the fast plan measures with position references alone, which takes longer",
        False,
    ),
)

ASKED: tuple[ObjectInfo, ...] = (
    objects.SUPPORTED_MODES,
    *(info for infos, *_ in _PRESENT for info in infos if info is not objects.CONTROLWORD),
    objects.CONTROLWORD,
    objects.RATED_TORQUE,
    objects.ENCODER_COUNTS,
    objects.ENCODER_REVOLUTIONS,
    objects.GEAR_MOTOR,
    objects.GEAR_SHAFT,
    objects.ERROR_REGISTER,
)
"""Objects whose answers :func:`needs_of` judges."""


def needs_of(answers: Answers, profile: DriveProfile | None = None) -> tuple[Need, ...]:
    """Judge what a drive answered for ``ASKED``, the device type, and what its profile names.

    Parameters
    ----------
    answers
        By object.
    profile
        Drive profile that fits, if there is one: it may name other objects for the scales.
    """
    first = _device(answers)
    if first.found == "missing":
        return (first,)
    return (
        first,
        _cyclic_position(answers),
        _torque_scale(answers, profile),
        _resolution(answers, profile),
        *(_present(answers, *row) for row in _PRESENT),
        *_gear(answers),
        _cyclic_torque(answers),
    )


def _number(answers: Answers, info: ObjectInfo) -> int | None:
    reading = answers.get(info.address)
    return None if reading is None else reading.number


def _why(answers: Answers, info: ObjectInfo) -> str:
    reading = answers.get(info.address)
    return "not asked" if reading is None else reading.why


def _absent(answers: Answers, info: ObjectInfo) -> bool:
    reading = answers.get(info.address)
    return reading is not None and reading.absent


def _device(answers: Answers) -> Need:
    device = _number(answers, objects.DEVICE_TYPE)
    what = "CiA 402 drive"
    if device is None:
        return Need(what, "not known", _why(answers, objects.DEVICE_TYPE))
    if device & 0xFFFF != CIA402_DEVICE:
        return Need(
            what,
            "missing",
            f"device type 0x{device:08X}, profile {device & 0xFFFF}",
            "it is no drive of the kind that this tool can use",
            blocks=True,
        )
    return Need(what, "there", f"device type 0x{device:08X}")


def _mode(answers: Answers, mode: Mode, consequence: str, blocks: bool) -> Need:
    modes = _number(answers, objects.SUPPORTED_MODES)
    what = f"mode {mode.words}"
    if modes is None:
        return Need(
            what,
            "not known",
            f"0x6502: {_why(answers, objects.SUPPORTED_MODES)}",
            "whether it has the mode shows when it is set, or its drive profile has to say so",
        )
    if modes & mode.supported_bit:
        return Need(what, "there", f"0x6502 is 0x{modes:X}")
    return Need(what, "missing", f"0x6502 is 0x{modes:X}", consequence, blocks)


def _cyclic_position(answers: Answers) -> Need:
    return _mode(
        answers, Mode.CYCLIC_POSITION, f"it can not follow targets at SYNC: {_STAYS_STILL}", True
    )


def _cyclic_torque(answers: Answers) -> Need:
    return _mode(
        answers, Mode.CYCLIC_TORQUE, "the axis can not float: no classic plan with others", False
    )


def _torque_scale(answers: Answers, profile: DriveProfile | None) -> Need:
    address = objects.RATED_TORQUE.address
    if profile is not None and not isinstance(profile.torque, str):
        address = profile.torque.per_mille_of
    return _scale(
        answers,
        address,
        f"torque scale {address}",
        f"torques have no scale, unless its drive profile names another object: {_STAYS_STILL}",
    )


def _resolution(answers: Answers, profile: DriveProfile | None) -> Need:
    address = objects.ENCODER_COUNTS.address
    if profile is not None and not isinstance(profile.position, str):
        if not isinstance(profile.position.counts, ObjectAddress):
            return Need(
                "encoder resolution",
                "not known",
                "the drive does not tell; `encoder_counts_per_rev` of the machine profile does",
            )
        address = profile.position.counts
    return _scale(
        answers,
        address,
        f"encoder resolution {address}",
        f"positions have no scale, unless the machine profile gives it: {_STAYS_STILL}",
    )


def _scale(answers: Answers, address: ObjectAddress, what: str, consequence: str) -> Need:
    info = ObjectInfo(address, "UNSIGNED32", what)
    value = _number(answers, info)
    if value:
        return Need(what, "there", str(value))
    if value == 0:
        return Need(what, "missing", "it is 0", consequence, blocks=True)
    found: Found = "missing" if _absent(answers, info) else "not known"
    return Need(what, found, _why(answers, info), consequence, blocks=found == "missing")


def _gear(answers: Answers) -> tuple[Need, ...]:
    motor, shaft = _number(answers, objects.GEAR_MOTOR), _number(answers, objects.GEAR_SHAFT)
    if motor is None or shaft is None or motor == shaft:
        return ()
    need = Need(
        "gear ratio 0x6091 of 1",
        "missing",
        f"it is {motor}/{shaft}",
        "positions are those behind the gear, torques those of the motor: set it to 1/1",
        blocks=True,
    )
    return (need,)


def _present(
    answers: Answers, infos: tuple[ObjectInfo, ...], what: str, consequence: str, blocks: bool
) -> Need:
    absent = [str(info.address) for info in infos if _absent(answers, info)]
    if absent:
        return Need(what, "missing", f"no {', '.join(absent)}", consequence, blocks)
    unsure = [info for info in infos if info.address not in answers or answers[info.address].why]
    if unsure:
        shown = f"{unsure[0].address}: {_why(answers, unsure[0])}"
        return Need(what, "not known", shown, consequence)
    return Need(what, "there", ", ".join(str(info.address) for info in infos))
