"""``fieldtool import`` and ``export``: recordings from folders of CSV files, and back."""

from pathlib import Path
from typing import Annotated

import typer

from fieldtool import workflow
from fieldtool.cli.output import console_of


def import_(
    folder: Annotated[Path, typer.Argument(help="Folder with recording.yaml and CSV files.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Recording to write (FILE.h5).")],
) -> None:
    """Turn a folder with recording.yaml and CSV files into a recording."""
    recording = workflow.import_folder(folder, out)
    rows = sum(e.samples for e in recording.experiments)
    console_of(False).print(f"{out}: {len(recording.experiments)} experiments, {rows} rows.")


def export(
    recording: Annotated[Path, typer.Argument(help="Recording (FILE.h5).")],
    folder: Annotated[Path, typer.Argument(help="Folder to write.")],
) -> None:
    """Turn a recording into a folder with recording.yaml and CSV files."""
    workflow.export_folder(recording, folder)
    console_of(False).print(f"{folder} written.")
