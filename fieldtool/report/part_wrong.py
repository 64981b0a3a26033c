"""Where the simulation is wrong: the same error looked at in many ways."""

from fieldtool.criticise.pictures_file import NOISE_ONLY, Picture
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
    """Show the errors of every axis, before and after, with one sentence each.

    Where nothing is wrong, the pictures of what is left are folded away.
    """
    criticism = material.criticism
    if criticism is None:
        return None
    where = Words(tuple(f"{s}." for s in criticism.where), "list")
    said = (
        "The torque that the simulated machine needs for the measured motion is taken off the measured "
        "torque: what is left is the error. The sentences above give its size on the data that the "
        "verdict rests on; the pictures show all data."
    )
    if criticism.causes:
        said += (
            " Before: the machine of masses, springs, dampers and couplings alone. After: with the "
            "causes named below."
        )
    blocks: list[Block] = [where, Words((said,))]
    for axis in dict.fromkeys(p.axis for p in material.pictures):
        shown = tuple(p for p in material.pictures if p.axis == axis)
        if criticism.verdict != "adequate" and all(map(_noise_only, shown)):
            blocks.append(Words((f"{axis}: {NOISE_ONLY}, however it is looked at.",)))
        else:
            blocks.append(Plots(tuple(_plot(p) for p in shown), 2))
    if not material.pictures:
        blocks.append(
            Words(
                ("There are no pictures of it: `fieldtool criticise` on this folder makes them.",),
                "warning",
            )
        )
    if criticism.verdict == "adequate":
        lead = "Nothing that matters: noise, or below 1 % of the torque."
        return Section("What the simulation leaves", lead, tuple(blocks), folded=True)
    return Section("Where the simulation is wrong", "", tuple(blocks))


def _noise_only(picture: Picture) -> bool:
    """Whether a picture shows nothing but noise; the course in time shows whatever there is."""
    return picture.kind in ("time", "lines") or picture.sentence == NOISE_ONLY


def _plot(picture: Picture) -> Plot:
    return Plot(
        picture_figure(picture),
        f"{picture.axis}. {TITLES[picture.kind]}: {picture.sentence}.",
        290,
    )
