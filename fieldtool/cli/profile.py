"""``fieldtool profile``: drive and machine profiles as files."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from drives.profile.schema import ProfileKind, json_schema
from fieldtool.cli.output import Json, console_of, indented, print_json
from fieldtool.workflow.profiling import CheckedProfile, check_profile, new_profile

profile_app = typer.Typer(
    no_args_is_help=True,
    help="Profiles: begin one from an EDS file, check one, help an editor with their keys.",
)


@profile_app.command()
def new(
    eds: Annotated[Path, typer.Option("--eds", help="EDS or DCF file of the drive.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="New file; beside the EDS otherwise.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Begin a drive profile from an EDS file; what it does not tell is marked unknown."""
    made = new_profile(eds, out)
    console = console_of(as_json)
    console.print(Text(f"{made.path} written: what the EDS tells, and unknown for all the rest."))
    _show(console, made)
    if as_json:
        print_json(made.as_dict())


@profile_app.command("check")
def check_file(
    file: Annotated[
        Path, typer.Argument(help="Drive or machine profile: a file, or a packaged one's name.")
    ],
    as_json: Json = False,
) -> None:
    """Check a profile, and the drive profiles and EDS files that it names, without a drive."""
    found = check_profile(file)
    console = console_of(as_json)
    console.print(Text(f"{found.path}: a {found.kind} profile, {found.name}; it can be read."))
    _show(console, found)
    for drive, axes in found.drives:
        console.print(Text(f"{', '.join(axes)}: {drive.path}, a drive profile, {drive.name}."))
        _show(console, drive)
    if as_json:
        print_json(found.as_dict())


@profile_app.command()
def schema(
    kind: Annotated[str, typer.Argument(help="drive or machine.")] = "drive",
) -> None:
    """Print the JSON schema of drive or machine profiles, for editors."""
    kinds: dict[str, ProfileKind] = {"drive": "drive", "machine": "machine"}
    if kind not in kinds:
        raise typer.BadParameter(f"{kind!r} is neither drive nor machine")
    print_json(json_schema(kinds[kind]))


def _show(console: Console, found: CheckedProfile) -> None:
    if found.unknown:
        console.print(Text("Still to be found out (each has a line in the file):"))
        keys = dict.fromkeys(".".join(key.split(".")[:2]) for key in found.unknown)
        gains = [key for key in keys if key.startswith("parameters.")]
        for key in keys:
            if key not in gains:
                console.print(indented(f"{key}"))
        if gains:
            console.print(
                indented(
                    f"unit, scale or write of {len(gains)} parameters; keep those of the loops"
                )
            )
    if found.obstacles:
        console.print(Text("Until then, or with such a drive at all:"))
        for phrase in found.obstacles:
            console.print(indented(f"{phrase}"))
