"""Where a machine's bus is."""

from typing import Annotated, Any, Literal

from pydantic import Field, StrictBool, StrictFloat, StrictInt, StrictStr

from drives.profile.values import Part, Seconds

SIMULATED = "fieldsim"
"""python-can interface of the simulated machine in virtual time; its channel may be a file."""


class BusProfile(Part):
    """Where the machine's CAN bus is, in python-can's words."""

    interface: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]
    channel: str | int | None = None
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000, strict=True)] = 1_000_000
    options: dict[str, StrictBool | StrictInt | StrictFloat | StrictStr] = Field(
        default_factory=dict
    )
    """What else the adapter's python-can interface takes, by name; others are refused."""
    shortest_cycle: Annotated[Seconds, Field(ge=0.001, le=0.01)] = 0.001
    """The tool uses no cycle shorter than this, however short one would fit the bit rate: for a
    computer or an adapter that can not keep up."""
    host_lost_after: Annotated[Seconds, Field(ge=0.1, le=1.0)] = 0.2
    """Without the host's heartbeat for so long, drives stop by themselves (0x1016).  For a computer
    that stands still now and then: an axis in motion goes on for so much longer when it dies."""
    sync: Literal["host", "kernel"] = "host"
    """Who times the SYNC: the tool, or the kernel's broadcast manager (SocketCAN only)."""

    def elsewhere(
        self,
        interface: str | None = None,
        channel: str | int | None = None,
        bitrate: int | None = None,
    ) -> "BusProfile":
        """Return it with what is given changed.

        Another interface drops channel and options, which belong to the one before.
        """
        kept = self.as_dict()
        if interface is not None and interface != self.interface:
            kept = {"interface": interface, "bitrate": self.bitrate}
            kept |= {"shortest_cycle": f"{self.shortest_cycle * 1000:g} ms"}
            kept |= {"host_lost_after": f"{self.host_lost_after * 1000:g} ms"}
        if channel is not None:
            kept["channel"] = channel
        if bitrate is not None:
            kept["bitrate"] = bitrate
        return BusProfile.model_validate(kept)

    def as_dict(self) -> dict[str, Any]:
        """Return it as it stands in a file; what is usual is left out."""
        data = self.model_dump(exclude_defaults=True)
        data |= {"interface": self.interface, "bitrate": self.bitrate}
        for key in ("shortest_cycle", "host_lost_after"):
            if key in data:
                data[key] = f"{data[key] * 1000:g} ms"
        return data
