"""``fieldtool simulate``: a simulated machine on a bus, or rebuilt from a session."""

from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from fieldtool import workflow
from fieldtool.cli.bus_options import Bitrate, Channel, on_bus
from fieldtool.cli.output import console_of, indented
from fieldtool.cli.stop_key import stop_key


def simulate(
    machine: Annotated[
        str,
        typer.Argument(
            help="Machine profile (name or file), or a session folder to rebuild it from."
        ),
    ],
    interface: Annotated[
        str | None,
        typer.Option(help="python-can interface to serve the nodes on (socketcan ...)."),
    ] = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    profile_file: Annotated[
        Path | None,
        typer.Option(
            "--profile",
            help="Where the rebuilt machine's profile goes; twin.yaml in the folder otherwise.",
        ),
    ] = None,
) -> None:
    """Serve a simulated machine's nodes in real time on a bus, or rebuild one from a session folder.

    Rebuilt from a session folder, the simulated machine has the chains, couplings and effects of the
    folder's model.yaml; without --interface its profile is written, for virtual time.
    """
    console = console_of(False)
    name: str | Path = machine
    if Path(machine).is_dir():
        twin = workflow.twin(Path(machine), profile_file)
        name = twin.profile.path
        console.print(Text(f"The machine of {machine} as a simulated one: {name}."), soft_wrap=True)
        for sentence in twin.left_out:
            console.print(indented(f"Otherwise than there: {sentence}"))
        if interface is None:
            console.print(Text(f"Run it in virtual time: fieldtool run {name}"), soft_wrap=True)
            return
    elif profile_file is not None:
        raise typer.BadParameter("--profile is for session folders; this is none")
    if interface is None:
        raise typer.BadParameter(
            "--interface says which bus the nodes are served on, such as --interface socketcan "
            "--channel vcan0. In virtual time no serving is needed: fieldtool run MACHINE"
        )
    with stop_key("Ending ...") as key:
        profile = on_bus(name, interface, channel, bitrate)
        served = workflow.simulate(profile, key, console.print)
    console.print(served)
