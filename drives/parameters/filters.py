"""Torque filters that a drive holds: off, notches or low-passes, and whether all of them are known."""

from collections.abc import Mapping

from drives.profile import UNKNOWN, DriveProfile

NUMBERS_OF_FILTERS = {
    0: (),
    1: ("frequency", "zero_damping", "pole_damping"),
    2: ("frequency", "pole_damping"),
}
"""That a filter of each type needs: off, notch, low-pass."""


def filter_not_known(values: Mapping[str, float], profile: DriveProfile) -> str:
    """Return why nobody knows what a drive's filters do, a sentence; empty where all are known.

    Parameters
    ----------
    values
        What could be read of the drive, by parameter, physical.
    profile
        Of the drive; filters that it does not name count as off.
    """
    for k in (1, 2):
        told = profile.parameters.get(f"filter{k}_type")
        if told is None or told.factor == UNKNOWN:
            continue
        where = f"filter{k}_type, object {told.object}, drive profile {profile.name}"
        kind = values.get(f"filter{k}_type")
        if kind is None:
            return (
                f"whether filter {k} is on can not be read ({where}). If the drive has no such filter, "
                "leave it away in a drive profile of your own."
            )
        if kind not in NUMBERS_OF_FILTERS:
            return (
                f"filter {k} is of type {kind:g} ({where}), and only 0 (off), 1 (notch) and 2 "
                "(low-pass) are known. Set one of them in the drive, or correct the drive profile."
            )
        names = [f"filter{k}_{number}" for number in NUMBERS_OF_FILTERS[int(kind)]]
        if lacking := [name for name in names if name not in values]:
            return (
                f"filter {k} is on, and {', '.join(lacking)} can not be read in SI units (drive "
                f"profile {profile.name}). Switch it off in the drive, or enter them in a drive profile "
                "of your own."
            )
    return ""
