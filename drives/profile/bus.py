"""Where a machine's CAN bus is."""

from typing import Annotated

from pydantic import Field

from drives.profile.values import Part


class BusProfile(Part):
    """Where the machine's CAN bus is, in python-can's words."""

    interface: str
    channel: str | int | None = None
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
