"""Where a drive is not as a profile and its EDS file say: objects that lack, or have another size."""

from collections.abc import Callable
from dataclasses import dataclass

from drives.errors import ProfileError
from drives.objects import ObjectAddress, ObjectInfo, type_bits
from drives.profile import DriveProfile
from drives.profile.eds import info_at, read_eds
from drives.profile.match import Match
from drives.scan.asking import Reading

VENDOR_AGREES = 10
"""Score of a match (``drives.profile.match``) from which the vendor is the profile's."""


@dataclass(frozen=True)
class NamedObject:
    """An object that a profile names, and how its EDS says it is coded."""

    info: ObjectInfo
    bytes: int | None
    """Size by the EDS; None for texts, and where no EDS tells."""

    def __str__(self) -> str:
        return f"{self.info.address} ({self.info.name})"


@dataclass(frozen=True)
class Fit:
    """How well a profile fits a drive: by its identity, and by its objects."""

    match: Match
    differences: tuple[str, ...] = ()
    """In words."""
    asked: int = 0
    """Objects that the profile names and that the drive was asked for."""

    @property
    def profile(self) -> str:
        """Name of the profile."""
        return self.match.profile.name

    @property
    def fits(self) -> bool:
        """Whether nothing of its identity speaks against it."""
        return self.match.fits

    @property
    def sure(self) -> bool:
        """Whether the vendor is the profile's, and every object is as its EDS says."""
        return self.fits and self.match.score >= VENDOR_AGREES and not self.differences

    @property
    def verdict(self) -> str:
        """In words: fits, may fit, does not fit."""
        if not self.fits:
            return "does not fit"
        return "fits" if self.sure else "may fit"

    @property
    def rank(self) -> tuple[bool, bool, float, int]:
        """The larger the better."""
        score = self.match.score
        as_expected = 1 - len(self.differences) / self.asked if self.asked else 0.0
        return self.fits, score >= VENDOR_AGREES, as_expected, score

    @property
    def why(self) -> str:
        """In words."""
        parts = list(self.match.because)
        if self.asked:
            right = self.asked - len(self.differences)
            parts.append(f"{right} of {self.asked} objects that it names are as its EDS says")
        return "; ".join(parts)


def named_objects(profile: DriveProfile) -> tuple[NamedObject, ...]:
    """Return the objects that a profile names: scales, parameters, latches, password, store.

    Those that it says are absent are left out.  An EDS that can not be read tells no sizes.
    """
    named: dict[ObjectAddress, str] = {}
    if not isinstance(profile.position, str):
        for address in (profile.position.counts, profile.position.revolutions):
            if isinstance(address, ObjectAddress):
                named[address] = "position scale"
    if not isinstance(profile.torque, str):
        named[profile.torque.per_mille_of] = "torque scale"
        if isinstance(profile.torque.constant, ObjectAddress):
            named[profile.torque.constant] = "torque constant"
    named |= {one.object: name for name, one in profile.quantities.items()}
    named |= {one.object: name for name, one in profile.parameters.items()}
    named |= {one.object: "latch" for one in profile.latches}
    if profile.store is not None and not isinstance(profile.store, str):
        named[profile.store.object] = "store"
    return tuple(
        _named(profile, address, name)
        for address, name in named.items()
        if address not in profile.absent
    )


def _named(profile: DriveProfile, address: ObjectAddress, name: str) -> NamedObject:
    unknown = NamedObject(ObjectInfo(address, "UNSIGNED32", name), None)
    if profile.eds_path is None:
        return unknown
    try:
        info = info_at(read_eds(profile.eds_path), address)
    except ProfileError:
        return unknown
    if info is None or info.type == "VISIBLE_STRING":
        return unknown
    return NamedObject(ObjectInfo(address, info.type, name), type_bits(info.type) // 8)


def with_objects(match: Match, read: Callable[[ObjectInfo], Reading]) -> Fit:
    """Return how a profile fits, with every object that it names read from the drive."""
    named = named_objects(match.profile)
    differences = [d for one in named if (d := _difference(one, read(one.info)))]
    return Fit(match, tuple(differences), len(named))


def _difference(one: NamedObject, reading: Reading) -> str:
    if reading.absent:
        return f"{one} is not there"
    if reading.data is None:
        return f"{one} can not be read: {reading.why}"
    if one.bytes is not None and len(reading.data) != one.bytes:
        return f"{one} has {len(reading.data)} bytes, its EDS says {one.bytes}"
    return ""
