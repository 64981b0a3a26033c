"""Tool set-ups of one machine: keep their parameters by name, compare them, switch between them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from drives.canopen_drive.group import profile_of
from drives.objects import ObjectAddress
from drives.parameters import Change, Raw, can_store
from drives.profile import MachineProfile, load_machine
from fieldtool.errors import PlanRefusedError
from fieldtool.workflow.session import Options, Screen, never, open_session, parameter_table
from fieldtool.writeback.alone import connected
from fieldtool.writeback.tool_sets import (
    ToolSet,
    ToolSets,
    changes_to,
    keep_drives,
    keep_session,
    tool_set,
    tool_sets,
    tools_folder,
)
from fieldtool.writeback.transaction import WriteBack, apply
from fieldtool.writeback.unfinished import refuse_unfinished


@dataclass(frozen=True)
class Difference:
    """One parameter that two tool sets have different, in the drive's own units."""

    axis: str
    name: str
    address: ObjectAddress
    one: Raw | None
    other: Raw | None


def tools_of(machine: str | Path | MachineProfile) -> ToolSets:
    """Return the tool sets of a machine, by name, and those that can not be used."""
    return tool_sets(_profile(machine).name)


def keep_tool(
    machine: str | Path | MachineProfile, name: str, session: Path | None = None
) -> ToolSet:
    """Keep a session's written parameters as a tool set, or those that are in the drives now.

    Raises
    ------
    DrivesError, FieldtoolError
        If nothing was written from the session; the drives can not be read, or may hold what a write
        or a measurement that was cut off has left in them.
    """
    profile = _profile(machine)
    controller = _controller(profile)
    if session is not None:
        return keep_session(profile.name, name, session, controller)
    with connected(profile, to_move=False) as group:
        refuse_unfinished(profile.name, group.drives, tools_folder(profile.name) / name)
        return keep_drives(profile.name, name, group.drives, controller)


def compare_tools(
    machine: str | Path | MachineProfile, one: str, other: str
) -> tuple[ToolSet, ToolSet, tuple[Difference, ...]]:
    """Return two tool sets, and the parameters in which they differ."""
    profile = _profile(machine)
    a, b = (tool_set(profile.name, name, profile.path) for name in (one, other))
    names = {
        axis.name: {p.object: n for n, p in profile_of(axis, profile).parameters.items()}
        for axis in profile.axes
    }
    found = []
    held = [
        {(part.axis, h.info.address): h for part in tool.parameters.drives for h in part.held}
        for tool in (a, b)
    ]
    for key in held[0] | held[1]:
        values = [each[key].value if key in each else None for each in held]
        if values[0] != values[1]:
            axis, address = key
            name = names.get(axis, {}).get(address, str(address))
            found.append(Difference(axis, name, address, values[0], values[1]))
    return a, b, tuple(found)


def switch_tool(
    machine: str | Path | MachineProfile,
    name: str,
    out: Path,
    confirm: Callable[[Sequence[Change]], bool],
    *,
    store: bool = False,
    same_drives: bool = False,
    screen: Screen | None = None,
    stop_requested: Callable[[], bool] = never,
) -> WriteBack:
    """Bring a tool set into the drives by a write-back: backup, journal, read back, all or none.

    Nothing moves.  What was not tried on the machine is said to be so, and not stored.

    Raises
    ------
    PlanRefusedError
        If a set that was not tried is to be stored.
    WrongDeviceError
        If it was kept from other drives.
    WriteBackError, WriteBackMixedError
        As :func:`fieldtool.writeback.transaction.apply`.
    """
    profile = _profile(machine)
    tool = tool_set(profile.name, name, profile.path)
    if store and not tool.verified:
        raise PlanRefusedError(
            f"tool set {name} was not tried on the machine, so it is not stored: leave --store away, or "
            "keep it from a session whose parameters stood their trial. Nothing was written."
        )
    options = Options(write=True, store=store)
    with open_session(profile, out, screen, stop_requested, command="tools", options=options) as (
        session,
        group,
    ):
        if not tool.verified:
            session.warn(
                f"Tool set {name} was not tried on the machine by this tool: move the axes with care."
            )
        changes = changes_to(group.drives, tool, same_drives=same_drives)
        session.screen.stage(f"Write the parameters of tool set {name}, and read them back")
        result = apply(
            profile.name,
            group.drives,
            changes,
            session.folder.parameters_before,
            confirm,
            store,
            session.screen.say,
            stop_requested=stop_requested,
        )
        if tool.verified and all(can_store(drive) for drive in group.drives):
            back = f"`fieldtool restore {result.backup}`, then " if result.differs else ""
            result = replace(result, to_store=f"{back}the same command with --store")
        session.write_back = result
        session.folder.note("parameters", rows=parameter_table(result))
        session.folder.note("tool", name=name, written=result.in_memory, stored=result.stored)
        return result


def _profile(machine: str | Path | MachineProfile) -> MachineProfile:
    return machine if isinstance(machine, MachineProfile) else load_machine(machine)


def _controller(machine: MachineProfile) -> Mapping[str, tuple[ObjectAddress, ...]]:
    """Return the objects that hold controller parameters, by axis, in the order of writing."""
    return {
        axis.name: tuple(p.object for p in profile_of(axis, machine).parameters.values())
        for axis in machine.axes
    }
