"""Open the machine's bus, and say in clear words why it can not be opened."""

from typing import Any

import can

from drives.bus.adapters import (
    BITRATE_ELSEWHERE,
    bus_class,
    check_options,
    missing_package,
)
from drives.bus.kernel_link import KernelLink, kernel_links
from drives.errors import BusError, ProfileError, UserStopError
from drives.profile import BusProfile

SOCKETCAN = "socketcan"


def open_bus(profile: BusProfile) -> can.BusABC:
    """Open the machine's bus.

    What python-can would read from its own configuration files and environment is not used: the
    machine profile alone says what is opened.

    Raises
    ------
    BusError
        If python-can knows no such interface or option, a driver or package is missing, the
        interface is missing, down or has another bit rate, or it can not be opened.
    ProfileError
        If the machine that it would simulate can not be.
    """
    if profile.interface == SOCKETCAN:
        check_link(profile)
    elif profile.sync == "kernel":
        raise BusError(
            f"the kernel can give the SYNC on SocketCAN only, not on {profile.interface}. Set "
            "`sync: host` in the machine profile's bus."
        )
    kind: Any = bus_class(profile.interface)
    check_options(profile.interface, profile.options)
    if profile.interface == SOCKETCAN:
        from drives.bus.kernel_bus import KernelBus  # only where there is a kernel that has it

        kind = KernelBus
    where = () if profile.channel is None else (profile.channel,)
    try:
        opened: can.BusABC = kind(*where, bitrate=profile.bitrate, **profile.options)
    except (BusError, UserStopError):
        raise
    except Exception as error:  # adapters' libraries raise whatever they like
        cause = error.__cause__
        if isinstance(cause, ProfileError) and cause.path.is_file():
            raise cause from None
        raise BusError(_why_not(profile, error)) from error
    return opened


def close_bus(bus: can.BusABC) -> None:
    """Close a bus, also one that can not be closed in order any more.

    What an adapter that was pulled out says of that must not take the place of what there is to say of
    the drives.
    """
    try:
        bus.shutdown()
    except UserStopError:
        raise
    except Exception:  # adapters' libraries raise whatever they like
        return


def _why_not(profile: BusProfile, error: Exception) -> str:
    said = " ".join(str(error).split()) or type(error).__name__
    name = (
        f"bus {profile.interface} {profile.channel if profile.channel is not None else ''}".strip()
    )
    install = missing_package(profile.interface, error)
    if install:
        return f"{name}: can not be opened ({said}). {install}"
    if profile.interface in BITRATE_ELSEWHERE:
        return f"{name}: can not be opened ({said}). Is it the right channel, and is the far end there?"
    return (
        f"{name}: can not be opened ({said}). Is the adapter plugged in, the channel the right one, and "
        f"does it know a bit rate of {profile.bitrate} bit/s? Does another program use it?"
    )


def check_link(profile: BusProfile) -> None:
    """Compare a SocketCAN interface with the profile; nothing where the kernel can not be asked.

    Raises
    ------
    BusError
        If there is no such interface, it is down, only listens, is off the bus, or has another bit
        rate than the profile says.
    """
    name = str(profile.channel if profile.channel is not None else "")
    every = kernel_links()
    if every is None:
        return
    link = next((one for one in every if one.name == name), None)
    if link is None:
        there = ", ".join(one.name for one in every) or "none"
        raise BusError(
            f"SocketCAN interface {name or '(no channel given)'} does not exist; CAN interfaces of this "
            f"computer: {there}. Is the adapter plugged in and its kernel driver loaded? Check "
            "`channel` in the machine profile or --channel."
        )
    if link.bitrate is not None and link.bitrate != profile.bitrate:
        raise BusError(
            f"SocketCAN interface {name} is set to {link.bitrate} bit/s, the machine profile says "
            f"{profile.bitrate} bit/s. Correct the profile (or --bitrate), or set the interface: "
            f"{_bring_up(link, profile)}"
        )
    if not link.up:
        raise BusError(
            f"SocketCAN interface {name} is down. Bring it up: {_bring_up(link, profile)}"
        )
    if link.listen_only:
        raise BusError(
            f"SocketCAN interface {name} only listens (listen-only mode), so no drive can be spoken to. "
            f"Set it: `ip link set {name} down; ip link set {name} type can listen-only off; "
            f"ip link set {name} up`"
        )
    if link.state == "bus off":
        raise BusError(
            f"SocketCAN interface {name} is off the bus (bus off) after too many errors. Check cable, "
            f"terminators and bit rate ({profile.bitrate} bit/s), then restart it: "
            f"`ip link set {name} type can restart`"
        )


def _bring_up(link: KernelLink, profile: BusProfile) -> str:
    if link.kind == "vcan":
        return f"`ip link set {link.name} up`"
    up = f"ip link set {link.name} up type can bitrate {profile.bitrate}"
    return f"`ip link set {link.name} down; {up}`"
