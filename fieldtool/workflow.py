"""One function a session: the stages in order, each from the session folder to the session folder.

This is the only place that knows all stages, and, with criticism, the only one that knows that
a simulation may stand behind the bus.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import yaml

from drives.bus import not_imitated, open_bus
from drives.canopen_drive import CanopenGroup, connect
from drives.parameters import Change, HeldObject, Written, load_backup, read_parameters
from drives.profile import BusProfile, MachineProfile, load_machine
from fieldtool.design.tuning import AxisTuning, Tuning, design
from fieldtool.errors import FileFormatError, IdentificationError, PlanRefusedError
from fieldtool.experiment.classic import chosen_cycle_time, classic_plan, refined_plan
from fieldtool.experiment.forecast import AxisForecast, Setting, forecast
from fieldtool.experiment.plan import SweepPlan
from fieldtool.experiment.runner import Axes, Progress, check_directions, run_plan
from fieldtool.frf.held_targets import LINEAR_TARGETS
from fieldtool.frf.response import save_responses
from fieldtool.identify.classic import without_friction
from fieldtool.identify.prediction import LoadPrediction, predict_load
from fieldtool.identify.recorded import Identified, identify_recording
from fieldtool.records.closed_loop import loop_from_parameters
from fieldtool.records.csv_folder import read_folder, write_folder
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from fieldtool.records.model_file import read_model, write_model
from fieldtool.records.recording import (
    AxisInfo,
    Controller,
    Experiment,
    Recording,
    RecordingWriter,
    load,
    save,
)
from fieldtool.records.session_folder import SessionFolder
from fieldtool.records.yaml_file import write_yaml
from fieldtool.report.pictures import draw_responses
from fieldtool.writeback.transaction import WriteBack, apply, changes_for, take_backup, undo

PlanName = Literal["classic"]
Confirm = Callable[[Sequence[Change]], bool]
SETTLE_GUESS = 8.0
"""Seconds that a tone takes to settle, for the first estimate of a plan's duration."""


class Screen(Protocol):
    """What a session tells while it runs; the command line shows it, scripts may ignore it."""

    def stage(self, title: str) -> None:
        """A new stage begins."""

    def say(self, sentence: str) -> None:
        """Something that a person should know."""

    def plan(self, plan: SweepPlan, expected: Sequence[AxisForecast], duration: float) -> None:
        """A plan was made and checked; nothing of it has moved yet."""

    def progress(self, progress: Progress) -> None:
        """A block of a sweep ended."""


class Quiet:
    """A screen that shows nothing."""

    def stage(self, title: str) -> None:
        """Show nothing."""

    def say(self, sentence: str) -> None:
        """Show nothing."""

    def plan(self, plan: SweepPlan, expected: Sequence[AxisForecast], duration: float) -> None:
        """Show nothing."""

    def progress(self, progress: Progress) -> None:
        """Show nothing."""


@dataclass(frozen=True)
class Options:
    """How a session is run."""

    plan: PlanName = "classic"
    write: bool = False
    store: bool = False
    motor_inertia: Literal["measured", "data sheet"] = "measured"


@dataclass(frozen=True)
class SessionResult:
    """What a session found and did."""

    folder: Path
    model: MachineModel
    identified: Identified
    tuning: Tuning
    write_back: WriteBack | None
    truth: MachineModel | None
    """What the simulated machine really is; None for a real one."""
    machine_time: float
    """Seconds of excitation."""
    wall_time: float
    """Seconds."""
    warnings: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``--json`` prints them."""
        return {
            "model": self.model.as_dict(),
            "truth": self.truth.as_dict() if self.truth else None,
            "time": {"machine_s": self.machine_time, "wall_s": self.wall_time},
            "parameters": parameter_table(self.write_back),
            "warnings": list(self.warnings),
            "folder": str(self.folder),
        }


@dataclass
class _Session:
    """What the stages of one session share."""

    folder: SessionFolder
    machine: MachineProfile
    screen: Screen
    warnings: list[str] = field(default_factory=list)

    def warn(self, sentence: str) -> None:
        if sentence not in self.warnings:
            self.warnings.append(sentence)
            self.screen.say(sentence)
            self.folder.note("warning", text=sentence)


def _never() -> bool:
    return False


# --- whole sessions ----------------------------------------------------------------------------


def run(
    machine: str | Path | MachineProfile,
    out: Path,
    options: Options | None = None,
    *,
    screen: Screen | None = None,
    confirm: Confirm = lambda _: False,
    stop_requested: Callable[[], bool] = _never,
) -> SessionResult:
    """Measure, identify, design and, if wanted, write back.

    Parameters
    ----------
    machine
        Name or file of a machine profile, or the profile.
    out
        Session folder; made if missing.
    options
        Plan, and whether to write.
    screen
        Is told what happens.
    confirm
        Sees old and new parameters before the first write, and says whether to go on.
    stop_requested
        Asked in every cycle of a motion.

    Raises
    ------
    DrivesError, FieldtoolError
        With one sentence for a person.  Whatever was measured is in the session folder.
    """
    options = options or Options()
    begin = time.perf_counter()
    with _session(machine, out, screen, stop_requested) as (session, group):
        machine_time = _measure(session, group)
        identified = _identify(session, options)
        session.screen.stage("Design new controller parameters")
        tuning = _design(session.folder, identified.model)
        write_back = _write(session, group, tuning, options, confirm)
        session.warnings += group.warnings
    return SessionResult(
        session.folder.path,
        identified.model,
        identified,
        tuning,
        write_back,
        truth_model(session.machine),
        machine_time,
        time.perf_counter() - begin,
        tuple(session.warnings),
    )


def measure(
    machine: str | Path | MachineProfile,
    out: Path,
    *,
    screen: Screen | None = None,
    stop_requested: Callable[[], bool] = _never,
) -> float:
    """Run both passes of the classic plan; return the seconds of excitation.

    Raises
    ------
    DrivesError, FieldtoolError
        As :func:`run`.
    """
    with _session(machine, out, screen, stop_requested) as (session, group):
        return _measure(session, group)


def identify(
    source: Path, options: Options | None = None, masses: Mapping[str, int] | None = None
) -> Identified:
    """Identify from a session folder or a recording; in a session folder the model is kept.

    Raises
    ------
    FileFormatError
        If there is no recording.
    IdentificationError
        If the data do not allow it.
    """
    options = options or Options()
    folder = SessionFolder(source) if source.is_dir() else None
    recording = load(folder.recording if folder else source)
    prior = None
    motors: dict[str, Estimate] = {}
    if folder and folder.machine.is_file():
        machine = load_machine(folder.machine)
        prior, motors = prior_model(machine), data_sheet_masses(machine, options)
    identified = identify_recording(recording, masses or {}, prior, motors)
    if folder:
        _keep(folder, identified, prior)
    return identified


def redesign(folder_path: Path) -> Tuning:
    """Design parameters from a session folder's model and keep them there.

    Raises
    ------
    FileFormatError
        If there is no model.
    """
    folder = SessionFolder(folder_path)
    return _design(folder, read_model(folder.model))


def write(
    folder_path: Path,
    options: Options,
    confirm: Confirm,
    *,
    screen: Screen | None = None,
) -> WriteBack:
    """Write a session folder's tuning into the machine's drives.

    Raises
    ------
    DrivesError, FieldtoolError
        As :func:`run`.
    """
    folder = SessionFolder(folder_path)
    tuning = read_tuning(folder.tuning)
    with _session(folder.machine, folder_path, screen, _never, keep_profile=True) as (s, group):
        result = _write(s, group, tuning, options, confirm)
        if result is None:
            raise FileFormatError(folder.tuning, "writing was not asked for")
        return result


def restore(machine: str | Path, backup: Path, store: bool = False) -> tuple[HeldObject, ...]:
    """Bring a backup back into a machine's drives; return what had to be written.

    Raises
    ------
    ProfileError, WrongDeviceError, WriteBackMixedError
        If the backup is none, was made on other drives, or does not come back whole.
    """
    path = backup / "parameters-before.yaml" if backup.is_dir() else backup
    load_backup(path)
    with connect(load_machine(machine)) as group:
        return undo(group.drives, path, store)


# --- models ------------------------------------------------------------------------------------


def prior_model(machine: MachineProfile) -> MachineModel:
    """Return the machine as last accepted."""
    return _model([axis.prior for axis in machine.axes], machine.couplings, machine)


def truth_model(machine: MachineProfile) -> MachineModel | None:
    """Return what a simulated machine really is; None where the machine is real."""
    if machine.simulation is None or machine.bus.interface != "fieldsim":
        return None
    return _model(machine.simulation.axes, machine.simulation.couplings, machine)


def data_sheet_masses(machine: MachineProfile, options: Options) -> dict[str, Estimate]:
    """Return the motors' masses from their data sheets, where they are to be used."""
    if options.motor_inertia == "measured":
        return {}
    missing = [axis.name for axis in machine.axes if axis.motor_inertia is None]
    if missing:
        raise PlanRefusedError(
            f"{', '.join(missing)}: the machine profile has no motor_inertia, which "
            "--motor-inertia data-sheet needs. Add it from the motor's data sheet."
        )
    return {
        axis.name: Estimate(m.value, m.value * m.tolerance / np.sqrt(3))
        for axis in machine.axes
        if (m := axis.motor_inertia) is not None
    }


def _model(chains: Any, couplings: Any, machine: MachineProfile) -> MachineModel:
    def exact(values: Sequence[float]) -> tuple[Estimate, ...]:
        return tuple(Estimate(v) for v in values)

    return MachineModel(
        tuple(
            AxisModel(
                axis.name,
                axis.kind,
                exact(chain.masses),
                exact(chain.springs),
                exact(chain.dampers),
                Estimate(chain.viscous_friction),
            )
            for axis, chain in zip(machine.axes, chains, strict=True)
        ),
        tuple(Coupling(c.axes, c.value) for c in couplings),
    )


# --- stages ------------------------------------------------------------------------------------


@contextmanager
def _session(
    machine: str | Path | MachineProfile,
    out: Path,
    screen: Screen | None,
    stop_requested: Callable[[], bool],
    keep_profile: bool = False,
) -> Iterator[tuple[_Session, CanopenGroup]]:
    profile = machine if isinstance(machine, MachineProfile) else load_machine(machine)
    folder = SessionFolder.create(out)
    if not keep_profile:
        write_yaml(folder.machine, yaml.safe_load(profile.path.read_text(encoding="utf-8")))
    session = _Session(folder, profile, screen or Quiet())
    folder.note("session", machine=profile.name, version=version("fieldtool"))
    session.screen.stage(f"Connect to {profile.name}")
    try:
        with connect(profile, stop_requested=stop_requested) as group:
            for drive in group.drives:
                identity = drive.identity
                folder.note("drive", axis=drive.axis, node=drive.node_id, name=identity.device_name)
            left_out = not_imitated(group.line.can_bus)
            if left_out:
                session.warn(
                    "This machine is simulated. Not imitated: " + "; ".join(left_out) + "."
                )
            yield session, group
    except BaseException as error:
        folder.note("ended", error=type(error).__name__, text=str(error))
        raise
    folder.note("ended")


def _measure(session: _Session, group: CanopenGroup) -> float:
    machine, folder = session.machine, session.folder
    take_backup(machine.name, group.drives, folder.parameters_before)
    with group.without_feed_forward():
        return _measure_both_passes(session, group)


def _measure_both_passes(session: _Session, group: CanopenGroup) -> float:
    machine, screen, folder = session.machine, session.screen, session.folder
    setting = _setting(machine, group, prior_model(machine))
    cycle_time = chosen_cycle_time(setting.model, group.shortest_cycle)
    plan = classic_plan(setting, [axis.name for axis in machine.axes if axis.may_float], cycle_time)
    screen.stage("Plan the first pass")
    expected = forecast(plan, setting)
    screen.plan(plan, expected, plan.expected_duration(SETTLE_GUESS))
    for note in plan.notes:
        screen.say(note)
    axes = Axes(group.axes, setting.limits, setting.centre)
    with RecordingWriter(folder.recording, _header(machine, group, cycle_time)) as recording:

        def keep(experiment: Experiment) -> None:
            recording.append(experiment)
            folder.note("recorded", experiment=experiment.name, complete=experiment.complete)

        screen.stage("Check that every axis moves the right way")
        check_directions(group, axes, cycle_time, keep)
        screen.stage("Measure, first pass: an even grid over the band of the prior model")
        machine_time = run_plan(group, plan, axes, keep, screen.progress)
        screen.stage("Find the modes, and plan the second pass around them")
        try:
            found = identify_recording(recording.recording, {}, setting.model, {})
        except IdentificationError as error:
            session.warn(f"The first pass alone can not be identified ({error})")
            return machine_time
        now_known = replace(setting, model=without_friction(found.model))
        second = refined_plan(now_known, found.damping_ratios, cycle_time)
        if not second.sweeps:
            return machine_time
        screen.plan(second, forecast(second, now_known), second.expected_duration(SETTLE_GUESS))
        screen.stage("Measure, second pass: at and beside every mode")
        machine_time += run_plan(group, second, axes, keep, screen.progress)
    return machine_time


def _setting(machine: MachineProfile, group: CanopenGroup, model: MachineModel) -> Setting:
    return Setting(
        model,
        tuple(loop_from_parameters(read_parameters(drive)) for drive in group.drives),
        tuple(drive.limits for drive in group.drives),
        np.array([sum(axis.limits.travel) / 2 for axis in machine.axes]),
    )


def _header(machine: MachineProfile, group: CanopenGroup, cycle_time: float) -> Recording:
    axes = []
    for axis, drive in zip(machine.axes, group.drives, strict=True):
        values = read_parameters(drive)
        rotary = axis.kind == "rotary"
        axes.append(
            AxisInfo(
                name=axis.name,
                kind=axis.kind,
                masses=len(axis.prior.masses),
                motor_inertia=axis.motor_inertia.value if axis.motor_inertia else None,
                rated_torque=drive.rated_torque,
                encoder_counts_per_rev=(2 * np.pi / drive.scaling.position if rotary else None),
                controller=Controller(
                    values["position_p"],
                    values["velocity_p"],
                    values["velocity_i"],
                    axis.limits.torque,
                ),
                torque_unit="N m" if rotary else "N",
                position_unit="rad" if rotary else "m",
            )
        )
    source = {"machine": machine.name}
    linear = [
        f"{d.axis}={d.profile.torque_lag!r}"
        for d in group.drives
        if d.profile.interpolation == "linear"
    ]
    if linear:
        source[LINEAR_TARGETS] = " ".join(linear)
    return Recording(cycle_time, tuple(axes), (), machine.description, source)


def _identify(session: _Session, options: Options) -> Identified:
    session.screen.stage("Identify masses, springs, couplings and dampers")
    machine = session.machine
    identified = identify_recording(
        load(session.folder.recording),
        {},
        prior_model(machine),
        data_sheet_masses(machine, options),
    )
    for note in identified.notes:
        session.warn(note)
    _keep(session.folder, identified, prior_model(machine))
    return identified


def _keep(folder: SessionFolder, identified: Identified, prior: MachineModel | None) -> None:
    save_responses(identified.responses, folder.frequency_response)
    write_model(identified.model, folder.model)
    draw_responses(identified.responses, identified.model, prior, folder.picture)
    folder.note("identified", notes=list(identified.notes))


def _design(folder: SessionFolder, model: MachineModel) -> Tuning:
    tuning = design(model)
    write_yaml(folder.tuning, tuning_as_dict(tuning))
    return tuning


def _write(
    session: _Session,
    group: CanopenGroup,
    tuning: Tuning,
    options: Options,
    confirm: Confirm,
) -> WriteBack | None:
    folder = session.folder
    if not options.write:
        changes = changes_for(group.drives, tuning)
        return WriteBack((), changes, in_memory=False, stored=False, backup=None)
    session.screen.stage("Write the new parameters, and read them back")
    backup = folder.parameters_before
    result = apply(session.machine.name, group.drives, tuning, backup, confirm, options.store)
    write_yaml(
        folder.journal,
        {
            "format": "fieldtool-write-journal/1",
            "machine": session.machine.name,
            "backup": backup.name,
            "in_memory": result.in_memory,
            "stored": result.stored,
            "parameters": parameter_table(result),
        },
    )
    session.screen.say(result.sentence)
    return result


# --- tables and files --------------------------------------------------------------------------


def parameter_table(write_back: WriteBack | None) -> list[dict[str, Any]]:
    """Return one row a parameter: axis, name, unit, before, after, read_back (null: not written)."""
    if write_back is None:
        return []
    read_back = {(w.change.axis, w.change.name): w for w in write_back.written}

    def row(change: Change) -> dict[str, Any]:
        written: Written | None = read_back.get((change.axis, change.name))
        return {
            "axis": change.axis,
            "name": change.name,
            "unit": change.unit,
            "before": change.before,
            "after": change.after,
            "read_back": written.read_back if written else None,
        }

    return [row(change) for change in write_back.changes]


def tuning_as_dict(tuning: Tuning) -> dict[str, Any]:
    """Return plain values in the form of ``tuning.yaml``."""
    return {
        "format": "fieldtool-tuning/1",
        "axes": [
            {
                "axis": axis.axis,
                "parameters": dict(axis.parameters),
                "sensitivity_peak": axis.sensitivity_peak,
                "reason": axis.reason,
            }
            for axis in tuning.axes
        ],
    }


def read_tuning(path: Path) -> Tuning:
    """Read ``tuning.yaml``.

    Raises
    ------
    FileFormatError
        If it is missing or not a tuning.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
        if data.get("format") != "fieldtool-tuning/1":
            raise FileFormatError(path, "format must be fieldtool-tuning/1", 1)
        return Tuning(
            tuple(
                AxisTuning(
                    str(axis["axis"]),
                    {str(k): float(v) for k, v in axis["parameters"].items()},
                    float(axis["sensitivity_peak"]),
                    str(axis["reason"]),
                )
                for axis in data["axes"]
            )
        )
    except (OSError, yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise FileFormatError(
            path, f"is no tuning ({error}); run `fieldtool design` first"
        ) from None


# --- recordings and simulated machines ---------------------------------------------------------


def import_folder(folder: Path, out: Path) -> Recording:
    """Turn a folder with ``recording.yaml`` and CSV files into a recording file.

    Raises
    ------
    FileFormatError
        If something in the folder is wrong: file, line, column.
    OutputError
        If the recording can not be written.
    """
    recording = read_folder(folder)
    save(recording, out)
    return recording


def export_folder(recording: Path, folder: Path) -> None:
    """Turn a recording file into a folder with ``recording.yaml`` and CSV files."""
    write_folder(load(recording), folder)


def compare(
    recording: Path, model: Path | None, band: tuple[float, float]
) -> tuple[LoadPrediction, ...]:
    """Predict the load side of a single axis, which no fit has seen, and compare.

    Parameters
    ----------
    recording
        With a load-side signal.
    model
        ``model.yaml``; None identifies the motor side of the recording first.
    band
        Hz.
    """
    data = load(recording)
    machine = read_model(model) if model else identify_recording(data, {}).model
    return predict_load(machine, _delay_of(machine), data, band=band)


def _delay_of(model: MachineModel) -> float:
    for effect in model.effects:
        if effect.get("effect") == "measurement_delay":
            return float(effect["parameters"]["delay"]["value"])
    return 0.0


def simulate(
    machine: str, interface: str, channel: str, stop_requested: Callable[[], bool]
) -> None:
    """Serve a simulated machine's nodes in real time on a bus until told to stop.

    Raises
    ------
    ProfileError
        If the machine has no `simulation` section.
    BusError
        If the bus can not be opened.
    """
    from drives.sim.machine import simulated_machine
    from drives.sim.running import RunningMachine
    from drives.sim.serve import serve

    profile = load_machine(machine)
    running = RunningMachine(simulated_machine(profile))
    bus = open_bus(BusProfile(interface=interface, channel=channel, bitrate=profile.bus.bitrate))
    try:
        serve(running, bus, stop_requested)
    finally:
        bus.shutdown()
