"""What a report holds, section after section, and its first sentence.

A later stage adds to it with one function from the material to a section, or None where it has
nothing to say, and one line in :data:`SECTIONS`.
"""

from collections.abc import Callable

from fieldtool.report.material import Material
from fieldtool.report.page import Page
from fieldtool.report.part_causes import causes, gain, rejected, unexplained
from fieldtool.report.part_done import done, facts, log, missing, warnings
from fieldtool.report.part_machine import changed, numbers, responses
from fieldtool.report.part_parameters import parameters
from fieldtool.report.part_verification import verification
from fieldtool.report.part_wrong import wrong
from fieldtool.report.section import Section
from fieldtool.report.verdict import verdict

SECTIONS: tuple[Callable[[Material], Section | None], ...] = (
    missing,
    numbers,
    responses,
    changed,
    wrong,
    causes,
    gain,
    unexplained,
    rejected,
    parameters,
    verification,
    done,
    warnings,
    log,
)


def page_of(material: Material) -> Page:
    """Return the report of a session, as far as it has come."""
    begun = material.begun
    when = begun.strftime("%d %B %Y, %H:%M") if begun else "date not known"
    name = material.machine.name if material.machine else material.name
    description = material.machine.description if material.machine else ""
    if not description and material.recording is not None:
        description = material.recording.description
    sentence, tone = verdict(material)
    return Page(
        title=f"Commissioning report: {name}",
        subtitle=f"{description} {when}, session {material.name}".strip(),
        verdict=sentence,
        tone=tone,
        facts=facts(material),
        simulated=material.simulated,
        sections=tuple(s for make in SECTIONS if (s := make(material)) is not None),
    )
