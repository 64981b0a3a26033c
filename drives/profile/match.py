"""Which drive profile fits a drive, and why: by who it says it is, and by what it can do."""

from collections.abc import Iterable
from dataclasses import dataclass

from canopen.objectdictionary import ObjectDictionary

from drives.cia402 import Mode, in_words, modes_in
from drives.errors import ProfileError
from drives.objects import (
    ABORT_CONNECTION,
    CONSUMER_HEARTBEAT,
    DEVICE_TYPE,
    PRODUCT_CODE,
    SUPPORTED_MODES,
    TARGET_POSITION,
    TARGET_TORQUE,
    VENDOR_ID,
)
from drives.profile.drive import DriveProfile, Identity
from drives.profile.eds import default_at, info_at, read_eds, variable_at
from drives.profile.loading import load_drive, packaged
from drives.profile.values import UNKNOWN

CIA_402 = 402


@dataclass(frozen=True)
class Presented:
    """What a drive, or its EDS file, says of itself; None where it says nothing."""

    device_type: int | None = None
    """Object 0x1000."""
    vendor_id: int | None = None
    """Object 0x1018:01."""
    product_code: int | None = None
    """Object 0x1018:02."""
    supported_modes: int | None = None
    """Object 0x6502."""

    @classmethod
    def of_eds(cls, dictionary: ObjectDictionary) -> "Presented":
        """Return what an EDS file says: the objects' defaults, else its section [DeviceInfo]."""
        device = dictionary.device_information

        def value(address: object, otherwise: object = None) -> int | None:
            found = default_at(dictionary, address)  # type: ignore[arg-type]
            if found is not None:
                return found
            return otherwise if isinstance(otherwise, int) and otherwise else None

        return cls(
            value(DEVICE_TYPE.address),
            value(VENDOR_ID.address, device.vendor_number),
            value(PRODUCT_CODE.address, device.product_number),
            value(SUPPORTED_MODES.address),
        )


@dataclass(frozen=True)
class Match:
    """How well one profile fits."""

    profile: DriveProfile
    fits: bool
    score: int
    """More is better; 0 for one that speaks only of CiA 402."""
    because: tuple[str, ...]
    """What agrees and what does not, and what can not be done with the drive: a phrase each."""

    @property
    def sentence(self) -> str:
        """The reasons in one line."""
        verb = "fits" if self.fits else "does not fit"
        return f"{self.profile.name} {verb}: {'; '.join(self.because)}"


def match(profile: DriveProfile, presented: Presented) -> Match:
    """Compare a drive with one profile.

    A number that the profile or the drive does not have is not compared.
    """
    wanted = profile.identity
    because: list[str] = []
    fits, score = True, 0
    mask = 0xFFFF if wanted.low_word_only else 0xFFFFFFFF
    for what, expected, found, bits, worth in (
        ("device type 0x1000", wanted.device_type, presented.device_type, mask, 1),
        ("vendor-ID 0x1018:01", wanted.vendor_id, presented.vendor_id, 0xFFFFFFFF, 10),
        ("product code 0x1018:02", wanted.product_code, presented.product_code, 0xFFFFFFFF, 20),
        ("0x6502", wanted.supported_modes, presented.supported_modes, 0xFFFFFFFF, 5),
    ):
        if expected is None or found is None:
            continue
        if expected & bits == found & bits:
            score += worth
            because.append(f"{what} is 0x{found:X}")
        else:
            fits = False
            because.append(f"{what} is 0x{found:X}, not 0x{expected:X}")
    if (
        presented.device_type is not None
        and presented.device_type & 0xFFFF != CIA_402
        and wanted.device_type is None
    ):
        fits = False
        because.append(f"device type 0x{presented.device_type:X} is no CiA 402 drive")
    if not any(value is not None for value in _numbers(wanted)):
        fits = False
        because.append("it has no number by which such a drive could be told; choose it by hand")
    elif not because:
        because.append("the drive gives no number to compare")
    because += obstacles(profile, presented.supported_modes)
    return Match(profile, fits, score, tuple(because))


def _numbers(identity: Identity) -> tuple[int | None, ...]:
    return (
        identity.device_type,
        identity.vendor_id,
        identity.product_code,
        identity.supported_modes,
    )


def best_matches(
    presented: Presented, profiles: Iterable[DriveProfile] | None = None
) -> tuple[Match, ...]:
    """Return how all profiles fit, the best first; those packaged unless others are given."""
    if profiles is None:
        profiles = [load_drive(name) for name in packaged("drives")]
    found = [match(profile, presented) for profile in profiles]
    return tuple(sorted(found, key=lambda m: (not m.fits, -m.score, m.profile.name)))


def offered_modes(profile: DriveProfile, supported_modes: int | None) -> frozenset[int] | None:
    """Return the modes a drive has: by its 0x6502, else by the profile; None if neither tells."""
    if supported_modes is not None:
        return modes_in(supported_modes)
    if isinstance(profile.modes, str):
        return None
    return frozenset(profile.modes)


def obstacles(profile: DriveProfile, supported_modes: int | None = None) -> tuple[str, ...]:
    """Return what this tool can not do with such a drive, a phrase each; empty if nothing.

    Parameters
    ----------
    profile
        Of the drive.
    supported_modes
        Its 0x6502; None for what profile and EDS file say.
    """
    found: list[str] = []
    dictionary = _dictionary(profile)
    if supported_modes is None and dictionary is not None:
        supported_modes = default_at(dictionary, SUPPORTED_MODES.address)
    modes = offered_modes(profile, supported_modes)
    if modes is None:
        found.append("whether it has cyclic modes is not known before it is asked (0x6502)")
    else:
        if Mode.CYCLIC_POSITION.value not in modes:
            found.append(
                f"it has no cyclic position mode (it has {in_words(modes)}), so it can not be measured"
            )
        if Mode.CYCLIC_TORQUE.value not in modes:
            found.append("it has no cyclic torque mode, so the axis can not float")
    if isinstance(profile.torque, str) or isinstance(profile.torque.scale, str):
        found.append("what its torque units are worth is not known, so it can not be measured")
    lacking = _fail_safe_lacking(dictionary)
    if lacking:
        found.append(
            f"its EDS has no {' and no '.join(lacking)}: nothing that this tool knows stops such a "
            "drive when the host dies, so it never moves one, whatever else is found out; it can be "
            "scanned, and checked without motion"
        )
    elif profile.heartbeat_reaction == UNKNOWN:
        found.append("what it does when the host dies is not known, so it may not be moved")
    found += _gains(profile)
    if profile.store is None:
        found.append("it stores parameters in no way that this tool knows")
    elif isinstance(profile.store, str):
        found.append("how it stores parameters is not known, so nothing is stored")
    if dictionary is not None:
        for info in (TARGET_POSITION, TARGET_TORQUE):
            if info_at(dictionary, info.address) is None:
                found.append(f"it has no {info.name} {info.address}")
    return tuple(found)


def _fail_safe_lacking(dictionary: ObjectDictionary | None) -> list[str]:
    if dictionary is None:
        return []
    return [
        f"{info.name} {info.address.short}"
        for info in (CONSUMER_HEARTBEAT, ABORT_CONNECTION)
        if variable_at(dictionary, info.address) is None
    ]


def _gains(profile: DriveProfile) -> list[str]:
    words = {
        "interpreter": "its gains are reached only through its own language, so they are not written",
        "none": "it has no gains that this tool knows, so none are written",
        "read-only": "its gains can be read but not written",
        "unknown": "how its gains are reached is not known, so they are not written",
        "password": "its gains are written only with the owner's password (`password` of the axis)",
    }
    found = [words[profile.gains_via]] if profile.gains_via in words else []
    lacking = [name for name, one in profile.parameters.items() if one.factor == UNKNOWN]
    if lacking:
        more = f" and {len(lacking) - 4} more" if len(lacking) > 4 else ""
        found.append(f"units of {', '.join(lacking[:4])}{more} are not known: they are not written")
    return found


def _dictionary(profile: DriveProfile) -> ObjectDictionary | None:
    if profile.eds_path is None:
        return None
    try:
        return read_eds(profile.eds_path)
    except ProfileError:
        return None
