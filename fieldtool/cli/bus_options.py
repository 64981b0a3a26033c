"""Which bus a command uses, where it is another one than the machine profile says."""

from pathlib import Path
from typing import Annotated

import typer

from drives.profile import MachineProfile, load_machine

Interface = Annotated[
    str | None,
    typer.Option(
        "--interface",
        help="python-can interface (socketcan, pcan, kvaser, slcan ...); the profile's otherwise.",
    ),
]
Channel = Annotated[
    str | None,
    typer.Option(
        "--channel", help="Its channel (can0, PCAN_USBBUS1 ...); the profile's otherwise."
    ),
]
Bitrate = Annotated[
    int | None,
    typer.Option(
        "--bitrate",
        help="Of the bus, bit/s; the profile's otherwise.",
        min=10_000,
        max=1_000_000,
    ),
]


def on_bus(
    machine: str | Path, interface: str | None, channel: str | None, bitrate: int | None
) -> MachineProfile:
    """Return a machine's profile, with the bus that was asked for.

    Another interface has no channel and no options but those that are given with it.

    Raises
    ------
    ProfileError
        If there is no such profile, or it is wrong.
    BadParameter
        If an interface's name has other characters than such names have.
    """
    profile = load_machine(machine)
    try:
        bus = profile.bus.elsewhere(interface, channel_of(channel), bitrate)
    except ValueError:
        raise typer.BadParameter(f"--interface {interface!r} is no name of an interface") from None
    return profile.model_copy(update={"bus": bus})


def channel_of(text: str | None) -> str | int | None:
    """Return a channel as python-can's interfaces want it: numbers as such."""
    return int(text) if text is not None and text.isdecimal() and text.isascii() else text
