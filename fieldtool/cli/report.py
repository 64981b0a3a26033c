"""``fieldtool report``: everything about a session on one page, in one file."""

from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from fieldtool import workflow
from fieldtool.cli.options import check_output
from fieldtool.cli.output import Json, console_of, print_json


def report(
    folder: Annotated[Path, typer.Argument(help="Session folder; also one that was stopped.")],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="HTML file; report.html in the folder otherwise."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Put everything about a session on one page: an HTML file that needs no network."""
    check_output("--out", out)
    path = workflow.report(folder, out)
    size = path.stat().st_size
    console_of(as_json).print(
        Text(f"{path}: {size / 1e6:.1f} MB; it opens in any browser, without a network."),
        soft_wrap=True,
    )
    if as_json:
        print_json({"report": str(path), "bytes": size})
