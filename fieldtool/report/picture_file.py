"""Put a drawn figure on the disk, whole or not at all."""

from io import BytesIO
from pathlib import Path

from matplotlib.figure import Figure

from fieldtool.records.files import write_atomic


def save_picture(figure: Figure, path: Path, dpi: int) -> None:
    """Write a figure as PNG; what was there before stays where that fails.

    Raises
    ------
    OutputError
        If the file can not be written.
    """
    drawn = BytesIO()
    figure.savefig(drawn, dpi=dpi, format="png")
    write_atomic(path, drawn.getbuffer())
