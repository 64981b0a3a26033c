"""Recordings from and to other tools, the check on a hidden signal, and simulated machines on a bus."""

from collections.abc import Callable
from pathlib import Path

from drives.bus import close_bus, open_bus
from drives.errors import BusError, ProfileError
from drives.profile import SIMULATED, MachineProfile, load_machine
from fieldtool.errors import NotEnoughDataError
from fieldtool.identify.prediction import LoadPrediction, predict_load
from fieldtool.identify.recorded import identify_recording
from fieldtool.records.csv_folder import read_folder, write_folder
from fieldtool.records.model import MachineModel
from fieldtool.records.model_file import read_model
from fieldtool.records.recording import (
    Recording,
    load,
    save,
)
from fieldtool.records.session_folder import SessionFolder


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
    folder = SessionFolder.of_source(recording)
    data = load(folder.recording if folder else recording)
    if len(data.axes) != 1:
        raise NotEnoughDataError(
            f"{recording}: the load side is predicted for recordings of a single axis; this one has "
            f"{', '.join(data.names)}."
        )
    machine = read_model(model) if model else identify_recording(data, {}).model
    return predict_load(
        machine,
        _known(machine, "measurement_delay", "delay"),
        data,
        band=band,
        ground_spring=_known(machine, "coulomb_friction", "stiffness"),
    )


def _known(model: MachineModel, effect: str, parameter: str) -> float:
    """Return a parameter of an effect of the model's only axis; 0 if it is not there."""
    for one in model.effects:
        if one.get("effect") == effect and parameter in one["parameters"]:
            return float(one["parameters"][parameter]["value"])
    return 0.0


def simulate(
    machine: str | Path | MachineProfile,
    stop_requested: Callable[[], bool],
    say: Callable[[str], None] = lambda _: None,
) -> str:
    """Serve a simulated machine's nodes in real time on its profile's bus until told to stop.

    Parameters
    ----------
    machine
        Name or file of a machine profile, or the profile.
    stop_requested
        Asked many times a second.
    say
        Is told when the nodes can be spoken to.

    Returns
    -------
    str
        How well this computer kept up, in a sentence.

    Raises
    ------
    ProfileError
        If the machine has no `simulation` section.
    BusError
        If the bus can not be opened, or ends.
    """
    from drives.sim.machine import simulated_machine
    from drives.sim.running import RunningMachine
    from drives.sim.serve import serve

    profile = machine if isinstance(machine, MachineProfile) else load_machine(machine)
    if profile.simulation is None:
        raise ProfileError(
            profile.path, "has no `simulation` section, so it can not be simulated. Add one."
        )
    if profile.bus.interface == SIMULATED:
        raise BusError(
            f"{SIMULATED} brings its own simulated machine, in virtual time. Serve nodes on a bus "
            "that another program can reach: --interface socketcan --channel vcan0."
        )
    running = RunningMachine(simulated_machine(profile))
    bus = open_bus(profile.bus)
    try:
        report = serve(
            running,
            bus,
            stop_requested,
            begun=lambda: say(
                f"Serving {profile.name} on {profile.bus.interface} {profile.bus.channel}; Ctrl-C "
                "ends it."
            ),
        )
    finally:
        close_bus(bus)
    return report.sentence
