"""Criticise what was measured: from a session folder or a recording to a criticism."""

from collections.abc import Callable, Mapping, Set
from dataclasses import replace
from pathlib import Path
from typing import Any

from drives.errors import UserStopError
from drives.profile import load_machine
from fieldtool.criticise.criticise import Criticised, criticise
from fieldtool.criticise.criticism import Criticism
from fieldtool.criticise.pictured import pictures_of
from fieldtool.criticise.pictures_file import save_pictures
from fieldtool.design.machine import DRY, is_machine
from fieldtool.errors import IdentificationError, NotEnoughDataError
from fieldtool.identify.recorded import identify_recording
from fieldtool.records.model import MachineModel
from fieldtool.records.model_file import read_model, write_model
from fieldtool.records.recording import Recording, load
from fieldtool.records.same_axes import axes_differ
from fieldtool.records.session_folder import SessionFolder
from fieldtool.records.yaml_file import write_yaml
from fieldtool.report.criticism_picture import draw_criticism
from fieldtool.workflow.models import prior_model
from fieldtool.workflow.reporting import report as write_report
from fieldtool.workflow.reporting import report_of_recording
from fieldtool.workflow.rescued import rescue
from fieldtool.workflow.session import Session

Advance = Callable[[str, float], None]
Place = tuple[str, frozenset[str], str]
LIGHTER = 0.5
"""Of the motor's inertia: all masses of an axis together can not be less."""
SAME = (
    frozenset(DRY),
    frozenset({"measurement_delay", "torque_lag"}),
)
"""Effects of which an axis has one: forms of its dry friction, and of what comes late."""
KNOWN = 0.3
"""Relative standard error up to which a mass or spring of the extended model replaces the old one."""


def criticise_source(
    source: Path,
    model_file: Path | None = None,
    picture: Path | None = None,
    advance: Advance = lambda *_: None,
    report: Path | None = None,
) -> Criticised:
    """Criticise the model of a session folder, or of a recording.

    Parameters
    ----------
    source : Path
        Session folder, or recording (FILE.h5).
    model_file : Path, optional
        model.yaml to criticise; the session's otherwise; identified first where there is none.
    picture : Path, optional
        PNG file to draw; a session folder always gets one.
    advance : callable
        Told what is done, and a number from 0 to 1.
    report : Path, optional
        HTML file to write; a session folder always gets its ``report.html``.

    Raises
    ------
    FileFormatError
        If there is no recording, or the model is none.
    NotEnoughDataError, IdentificationError
        If the data do not allow it.
    """
    folder = SessionFolder.of_source(source)
    if folder:
        rescue(folder)
    recording = load(folder.recording if folder else source)
    prior = None
    if folder and folder.machine.is_file():
        prior = prior_model(load_machine(folder.machine))
    if model_file is not None:
        model = read_model(model_file)
    elif folder and folder.model.is_file():
        model = read_model(folder.model)
    else:
        advance("identify", 0.0)
        model = _identified(recording, prior)
    found = criticise(recording, model, alike(prior, model), advance=advance)
    if folder:
        keep(folder, found, model)
        write_report(source)
    if picture is not None:
        draw_criticism(found.criticism, pictures_of(found.found), picture)
    if report is not None and folder:
        write_report(source, report)
    elif report is not None:
        report_of_recording(source, found, recording, report)
    return found


def _identified(recording: Recording, prior: MachineModel | None) -> MachineModel:
    """Identify first; where that fails, say that a model can be given.

    Raises
    ------
    IdentificationError
        If the data do not allow it, or contradict the motors' data sheets.
    """
    try:
        model = identify_recording(recording, {}, prior).model
    except IdentificationError as error:
        error.add_note(
            "There is no model yet, so the recording was to be identified first. If you have a "
            "model of this machine, give it: --model model.yaml."
        )
        raise
    for info, axis in zip(recording.axes, model.axes, strict=True):
        if info.torque_unit == "A" or not info.motor_inertia:
            continue
        if axis.total_mass < LIGHTER * info.motor_inertia:
            unit = "kg m2" if info.kind == "rotary" else "kg"
            raise IdentificationError(
                f"{info.name}: by its torque and motion all its masses come to "
                f"{axis.total_mass:.3g} {unit}, its motor alone has {info.motor_inertia:.3g} "
                f"{unit} by the data sheet. A unit of torque or position is wrong, or the motor's "
                "inertia: correct it, and import again."
            )
    return model


def criticised(
    session: Session, model: MachineModel, stop_requested: Callable[[], bool]
) -> tuple[MachineModel, Criticism | None]:
    """Criticise within a session; return the model that later stages use, and the criticism.

    A criticism that can not be made stops no session: what was identified stands.

    Raises
    ------
    UserStopError
        If the user asked for a stop; no axis moves at this stage.
    """

    def advance(what: str, share: float) -> None:
        session.screen.doing(what, share)
        if stop_requested():
            raise UserStopError(
                "stopped by the user while the simulation was criticised; no axis was moving, "
                "nothing was written"
            )

    session.screen.stage("Criticise the simulation: what it gets wrong, and why")
    prior = alike(prior_model(session.machine), model)
    try:
        found = criticise(load(session.folder.recording), model, prior, advance=advance)
    except NotEnoughDataError as error:
        session.warn(f"The simulation was not criticised: {error}")
        return model, None
    criticism = found.criticism
    keep(session.folder, found, model)
    session.screen.say(f"Verdict: {criticism.verdict}.")
    for sentence in (*criticism.changes, *criticism.where, *cause_sentences(criticism)):
        session.screen.say(sentence)
    return final_model(found, model), criticism


def cause_sentences(criticism: Criticism) -> tuple[str, ...]:
    """Return one sentence a cause, with its numbers, and one for what is left."""
    out = []
    for c in criticism.causes:
        numbers = ", ".join(f"{n} {v.value:.4g} {v.unit}" for n, v in c.parameters.items())
        tie = f"; as well: {', '.join(t.effect for t in c.ties)}" if c.ties else ""
        out.append(
            f"Cause: {c.effect} of {c.axis_words} ({c.location}): {numbers}; explains "
            f"{100 * c.gain:.2g} % of the torque on unseen data{tie}."
        )
    return (*out, *(f"Unexplained: {sentence}." for sentence in criticism.unexplained))


def keep(folder: SessionFolder, found: Criticised, model: MachineModel) -> None:
    """Write the criticism and its picture; where a cause is new, the extended model as well."""
    write_yaml(folder.criticism, found.criticism.as_dict())
    pictures = pictures_of(found.found)
    save_pictures(pictures, folder.views)
    draw_criticism(found.criticism, pictures, folder.criticism_picture)
    extended = final_model(found, model)
    if extended is not model:
        write_model(extended, folder.model)
    folder.note(
        "criticised",
        verdict=found.criticism.verdict,
        causes=[f"{c.effect} of {c.axis_words}" for c in found.criticism.causes],
    )


def final_model(found: Criticised, model: MachineModel) -> MachineModel:
    """Return the model that later stages use: extended where criticism found what it has not.

    Where the identification had the same effects, its numbers stand: it uses all data at once.  Where
    masses and springs beside the causes are hardly known, the causes join the model as it is.
    """
    had = {_place(str(e.get("effect")), e.get("axis"), e.get("location")) for e in model.effects}
    had |= {
        _place("viscous_friction", axis.name)
        for axis in model.axes
        if axis.viscous_friction.value != 0.0 or axis.load_friction.value != 0.0
    }
    had |= {_place("coupling_inertia", c.axes, "load") for c in model.couplings}
    new = {
        p for c in found.criticism.causes if (p := _place(c.effect, c.axis, c.location)) not in had
    }
    extended = found.criticism.model
    if not new:
        return model
    known = all(
        e.std < KNOWN * e.value for axis in extended.axes for e in (*axis.masses, *axis.springs)
    )
    return extended if known else _with_causes(model, extended, new)


def _with_causes(model: MachineModel, extended: MachineModel, new: Set[Place]) -> MachineModel:
    """Put causes into a model whose masses and springs stay; what they do not replace stays as well."""
    axes = []
    for mine, theirs in zip(model.axes, extended.axes, strict=True):
        axis = mine
        if _place("viscous_friction", axis.name) in new:
            axis = replace(axis, load_friction=theirs.load_friction)
        if any(_place(e, axis.name) in new for e in ("viscous_friction", "asymmetric_friction")):
            axis = replace(axis, viscous_friction=theirs.viscous_friction)
        axes.append(axis)
    kept = [e for e in model.effects if not any(_instead(one, e) for one in extended.effects)]
    couplings = [c for c in extended.couplings if _place("coupling_inertia", c.axes, "load") in new]
    joined = replace(
        model,
        axes=tuple(axes),
        couplings=(*model.couplings, *couplings),
        effects=(*kept, *extended.effects),
    )
    # Masses and couplings of two fits may not go together.
    return joined if is_machine(joined) else extended


def _instead(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether an effect is another one, or stands for the same of the same axis."""
    here, there = (
        _place(str(e.get("effect")), e.get("axis"), e.get("location")) for e in (one, other)
    )
    same = any({here[0], there[0]} <= alike_ones for alike_ones in SAME)
    return here == there or (same and here[1] == there[1])


def _place(effect: str, axis: Any, location: str | None = None) -> Place:
    """Return what tells an effect from others: a coupling of motors is none of last masses."""
    axes = frozenset([axis] if isinstance(axis, str) else axis or ())
    return effect, axes, "motor" if (effect, location) == ("coupling_inertia", "motor") else ""


def alike(prior: MachineModel | None, model: MachineModel) -> MachineModel | None:
    """Return the prior model if it is of the same axes, without effects."""
    if prior is None or axes_differ(prior.axes, "the model", model.axes):
        return None
    return replace(prior, effects=())
