"""Design new parameters from a session folder: model and drives in, ``tuning.yaml`` out."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from drives.profile import MachineProfile, load_machine
from fieldtool.design.decide import design
from fieldtool.design.tuning import BOUND, Tuning
from fieldtool.design.tuning_file import tuning_as_dict
from fieldtool.errors import FieldtoolError, IdentificationError
from fieldtool.frf.response import load_responses
from fieldtool.records.model import MachineModel
from fieldtool.records.session_folder import SessionFolder
from fieldtool.records.yaml_file import write_yaml
from fieldtool.report.design_picture import draw_design
from fieldtool.workflow.design_inputs import drive_sides, moves_of
from fieldtool.workflow.models import model_of
from fieldtool.workflow.reporting import renewing_report
from fieldtool.writeback.earlier import written_since

NOT_KNOWN = 0.3
"""Relative standard error of a mass or spring from which no controller is designed."""
SINCE = (
    "Before, and present parameters, are those of parameters-before.yaml: what the drives held before "
    "the first write of this session. They were written since, and what they hold now is not compared."
)
Advance = Callable[[str, float], None]


def redesign(
    folder_path: Path,
    response: str = "normal",
    bound: float = BOUND,
    picture: Path | None = None,
    advance: Advance = lambda *_: None,
    *,
    compare: bool = False,
    say: Callable[[str], None] = lambda _: None,
) -> Tuning:
    """Design parameters from a session folder's model and keep them there.

    Parameters
    ----------
    folder_path
        Session folder.
    response
        ``soft``, ``normal`` or ``stiff``.
    bound
        Peak of sensitivity that no axis may exceed.
    picture
        PNG file to draw; none where it is None.
    advance
        Told what is done, and a number from 0 to 1.
    compare
        Whether responses that are stiffer than the chosen one are computed, too; softer ones are
        anyhow.
    say
        Told what a person should know besides.

    Raises
    ------
    FileFormatError
        If there is no model, or one of another machine.
    DesignError, IdentificationError
        If nothing can be designed; what was kept before is unchanged.
    """
    folder = SessionFolder.existing(folder_path)
    folder.needed(folder.model, "`fieldtool identify` on this folder")
    machine = load_machine(folder.machine)
    model = model_of(machine, folder.model)
    check_known(model)
    with renewing_report(folder_path, say):
        tuning = designed(folder, machine, model, response, bound, advance, compare=compare)
        if picture is not None:
            draw_design(tuning, machine_kinds(model), picture)
    return tuning


def designed(
    folder: SessionFolder,
    machine: MachineProfile,
    model: MachineModel,
    response: str = "normal",
    bound: float = BOUND,
    advance: Advance = lambda *_: None,
    *,
    compare: bool = False,
) -> Tuning:
    """Design for a machine, and write ``tuning.yaml``."""
    tuning = design(
        model,
        drive_sides(folder, machine, machine.controller_cycle),
        moves_of(machine, model, folder.recording),
        response=response,
        bound=bound,
        top=_top(folder),
        advance=advance,
        compare=compare,
    )
    if tuning.present is not None and written_since(folder.journal):
        tuning = replace(tuning, notes=(SINCE, *tuning.notes))
    write_yaml(folder.tuning, tuning_as_dict(tuning))
    return tuning


def machine_kinds(model: MachineModel) -> dict[str, str]:
    """Return the unit of position of each axis."""
    return {axis.name: "rad" if axis.kind == "rotary" else "m" for axis in model.axes}


def _top(folder: SessionFolder) -> float | None:
    """Return the highest frequency that was measured, Hz; None where nobody knows."""
    try:
        responses = load_responses(folder.frequency_response)
    except FieldtoolError:
        return None
    tops = [float(r.frequencies.max()) for r in responses.values() if r.frequencies.size]
    return max(tops, default=None)


def check_known(model: MachineModel) -> None:
    """Refuse a model with a mass or spring that is not known well enough to design from.

    Raises
    ------
    IdentificationError
        Naming it, its value and its error.
    """
    for axis in model.axes:
        for what, values in (("mass", axis.masses), ("spring", axis.springs)):
            for k, value in enumerate(values):
                if value.std > NOT_KNOWN * abs(value.value):
                    raise IdentificationError(
                        f"{axis.name} {what} {k + 1} is {value.value:.4g} +- {1.96 * value.std:.2g}: "
                        "that is not known, so no controller is designed. Give the number of masses "
                        "with `fieldtool identify FOLDER --masses AXIS=N`, or measure longer (--time). "
                        "The recording is kept."
                    )
