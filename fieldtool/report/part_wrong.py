"""Where the simulation is wrong: the same error looked at in many ways."""

from fieldtool.criticise.pictures_file import Picture
from fieldtool.report.figures import picture_figure
from fieldtool.report.material import Material
from fieldtool.report.section import Block, Plot, Plots, Section, Words

TITLES = {
    "follows": "What it follows",
    "frequency": "By frequency",
    "lines": "By kind of line",
    "amplitude": "By amplitude",
    "velocity": "By velocity and its sign",
    "position": "By position",
    "time": "In time",
    "session": "Over the measurement",
    "axes": "By axis",
}


def wrong(material: Material) -> Section | None:
    """Show the errors of every axis, before and after, with one sentence each."""
    criticism = material.criticism
    if criticism is None:
        return None
    blocks: list[Block] = [
        Words(
            (
                "The torque that the simulated machine needs for the measured motion is taken off the "
                "measured torque: what is left is the error. Before: the machine of masses, springs, "
                "dampers and couplings alone. After: with the causes named below.",
            )
        )
    ]
    for axis in dict.fromkeys(p.axis for p in material.pictures):
        plots = tuple(_plot(p) for p in material.pictures if p.axis == axis)
        blocks.append(Plots(plots, 2))
    if not material.pictures:
        blocks.append(
            Words(
                ("There are no pictures of it: `fieldtool criticise` on this folder makes them.",),
                "warning",
            )
        )
    where = Words(tuple(f"{s}." for s in criticism.where), "list")
    return Section("Where the simulation is wrong", "", (where, *blocks))


def _plot(picture: Picture) -> Plot:
    return Plot(
        picture_figure(picture),
        f"{picture.axis}. {TITLES[picture.kind]}: {picture.sentence}.",
        290,
    )
