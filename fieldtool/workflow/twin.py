"""The simulated machine rebuilt from a session: chains, effects, drives as they were measured."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drives.errors import ProfileError
from drives.parameters import load_backup
from drives.profile import SIMULATED, AxisProfile, MachineProfile, load_drive, load_machine
from drives.sim.faces import face_names
from fieldtool.errors import FileFormatError, PlanRefusedError
from fieldtool.frf.velocity_band import white_noise
from fieldtool.records.model import AxisModel, MachineModel
from fieldtool.records.recording import Recording, load
from fieldtool.records.session_folder import SessionFolder
from fieldtool.records.yaml_file import write_yaml
from fieldtool.workflow.models import model_of
from fieldtool.workflow.twin_effects import Rebuilt, rebuilt

OVERLOAD = 3.0
"""Peak over rated torque of a drive that nobody has described."""
LARGEST_OVERLOAD = 30.0
LONG_ENOUGH = 100
"""Rows of an experiment from which noise is taken."""
REFERENCE = "reference"
"""Drive that stands in for kinds that are not simulated."""


@dataclass(frozen=True, eq=False)
class Twin:
    """A simulated machine as a profile, and what it does not imitate."""

    profile: MachineProfile
    left_out: tuple[str, ...]


def twin(folder_path: Path, out: Path | None = None) -> Twin:
    """Rebuild the machine of a session folder as a simulated one.

    Its chains, couplings and effects are those of ``model.yaml``, its gains those that the drives held
    before the session, the noise of its torque the one that was measured.

    Parameters
    ----------
    folder_path : Path
    out : Path, optional
        Machine profile to write; ``twin.yaml`` in the folder otherwise.

    Raises
    ------
    FileFormatError, ProfileError
        If the folder holds no machine profile, no model, or no recording.
    PlanRefusedError
        If the model can not be simulated: torques in A, or a linear axis without feed.
    """
    folder = SessionFolder.existing(folder_path)
    machine = _machine(folder)
    folder.needed(folder.model, "`fieldtool identify` on this folder")
    model, recording = model_of(machine, folder.model), load(folder.recording)
    path = out or folder.path / "twin.yaml"
    data, left_out = _data(folder, machine, model, recording, path)
    write_yaml(path, data)
    return Twin(load_machine(path), left_out)


def _machine(folder: SessionFolder) -> MachineProfile:
    if not folder.machine.is_file():
        raise FileFormatError(
            folder.path, "holds no machine.yaml: a simulated machine needs its axes and limits."
        )
    return load_machine(folder.machine)


def _data(
    folder: SessionFolder,
    machine: MachineProfile,
    model: MachineModel,
    recording: Recording,
    path: Path,
) -> tuple[dict[str, Any], tuple[str, ...]]:
    for info in recording.axes:
        if info.torque_unit == "A":
            raise PlanRefusedError(
                f"{info.name}: its torque was recorded in A, so its masses are not known in SI and the "
                "machine can not be simulated. Give the motor's torque constant and measure again."
            )
    parts = rebuilt(
        model.effects,
        {a.name: (a.kind, tuple(s.value for s in a.springs)) for a in model.axes},
    )
    left_out = list(parts.left_out)
    gains, noise = _gains(folder, machine, recording), _noise(recording)
    axes: list[dict[str, Any]] = []
    drives: list[str] = []
    for k, (profile, chain) in enumerate(zip(machine.axes, model.axes, strict=True)):
        base = machine.simulation.axes[k] if machine.simulation else None
        held: dict[str, Any] = {}
        if base is not None:
            held = base.model_dump(mode="json", exclude_unset=True)
            held = {k: v for k, v in held.items() if k in KEPT}
        fed = {"velocity_ff": 1.0} if base is None else {}  # what it has in use, no file tells
        drive = _drive(profile, machine.path, left_out, known=base is not None)
        drives.append(drive)
        axes.append(
            {
                **_of_drive(profile, recording, k),
                **held,
                **_chain(chain, parts, left_out),
                "torque_noise": float(noise[k]),
                "gains": {**fed, **held.get("gains", {}), **gains[profile.name]},
            }
        )
    data: dict[str, Any] = yaml.safe_load(folder.machine.read_text(encoding="utf-8"))
    data["name"] = f"{machine.name}-twin"[:60]
    data["description"] = f"Simulated from the session {folder.path.resolve().name}."
    data["bus"] = {
        "interface": SIMULATED,
        "channel": str(path.resolve()),
        "bitrate": machine.bus.bitrate,
    }
    for axis, drive in zip(data["axes"], drives, strict=True):
        axis["drive"] = drive
        if drive == REFERENCE:
            for key in ("eds", "encoder_counts_per_rev", "torque_constant", "loop"):
                axis.pop(key, None)
    data["simulation"] = {
        "seed": machine.simulation.seed if machine.simulation else 0,
        "axes": axes,
        "couplings": [{"axes": list(c.axes), "value": c.value} for c in model.couplings],
        "effects": parts.between,
    }
    return data, tuple(left_out)


KEPT = (
    "rated_torque", "peak_torque", "torque_constant", "face", "encoder_counts_per_rev", "gains",
)  # fmt: skip
"""What a simulated machine's drive stays as it was."""


def _of_drive(profile: AxisProfile, recording: Recording, k: int) -> dict[str, Any]:
    """Return what is known of a real drive: rated torque, largest torque, encoder."""
    info = recording.axes[k]
    measured = [float(np.abs(e.torque[:, k]).max()) for e in recording.experiments]
    largest = max([profile.limits.torque, *measured])
    rated = info.rated_torque or largest / OVERLOAD
    out: dict[str, Any] = {
        "rated_torque": rated,
        "peak_torque": min(max(OVERLOAD * rated, largest), LARGEST_OVERLOAD * rated),
    }
    if info.encoder_counts_per_rev:
        out["encoder_counts_per_rev"] = max(16, round(info.encoder_counts_per_rev))
    if profile.kind == "linear" and profile.feed is None:
        raise PlanRefusedError(
            f"{profile.name}: a linear axis is simulated with `feed` (metres per encoder "
            "revolution). Add it to the axis in the session's machine.yaml."
        )
    return out


def _drive(profile: AxisProfile, beside: Path, left_out: list[str], *, known: bool) -> str:
    """Return the drive profile that the simulated drive has; the reference drive's for unknown kinds."""
    if known:
        return profile.drive
    try:
        kind = load_drive(profile.drive, beside).name
    except ProfileError:
        kind = ""
    if kind in face_names():
        return profile.drive
    left_out.append(
        f"{profile.name}: drives of the kind {kind or profile.drive} are not simulated; the "
        "reference drive stands in, with the gains of the cascade and without the filters."
    )
    return REFERENCE


def _chain(chain: AxisModel, parts: Rebuilt, left_out: list[str]) -> dict[str, Any]:
    name = chain.name
    springs = [s.value * parts.springs.get((name, k), 1.0) for k, s in enumerate(chain.springs)]
    dampers = [e.value for e in chain.dampers] or [0.0] * len(springs)
    viscous = chain.viscous_friction.value + parts.viscous.get(name, 0.0)
    viscous += chain.load_friction.value
    if len(chain.masses) > 1 and chain.load_friction.value:
        left_out.append(
            f"{name}: viscous friction at the load has no simulated part; it is put at the motor."
        )
    for what, values in (("damper", dampers), ("viscous friction", [viscous])):
        if min(values, default=0.0) < 0:
            left_out.append(
                f"{name}: a {what} of the model is below zero ({min(values):.3g}), which no "
                "machine has; 0 was taken."
            )
    return {
        "masses": [m.value for m in chain.masses],
        "springs": springs,
        "dampers": [max(d, 0.0) for d in dampers],
        "viscous_friction": max(viscous, 0.0),
        "effects": parts.parts.get(name, []),
    }


def _noise(recording: Recording) -> np.ndarray[Any, np.dtype[np.float64]]:
    """White noise of each torque, (M,), less the rounding to per mille that the simulated drive adds."""
    found = [white_noise(e.torque) for e in recording.experiments if e.samples > LONG_ENOUGH]
    if not found:
        return np.zeros(len(recording.axes))
    counts = np.array([(info.rated_torque or 0.0) / 1000.0 for info in recording.axes])
    return np.sqrt(np.maximum(np.median(found, axis=0) ** 2 - counts**2 / 12.0, 0.0))


def _gains(
    folder: SessionFolder, machine: MachineProfile, recording: Recording
) -> dict[str, Mapping[str, float]]:
    """Return the drives' gains before the session, as far as files tell them in SI."""
    out: dict[str, Mapping[str, float]] = {}
    for info in recording.axes:
        c = info.controller
        out[info.name] = (
            {}
            if c is None
            else {
                "position_p": c.position_p,
                "velocity_p": c.velocity_p,
                "velocity_i": c.velocity_i,
            }
        )
    if not folder.parameters_before.is_file():
        return out
    try:
        held = {d.axis: d.held for d in load_backup(folder.parameters_before).drives}
    except ProfileError:
        return out
    for axis in machine.axes:
        try:
            profile = load_drive(axis.drive, machine.path)
        except ProfileError:
            continue
        if profile.name != REFERENCE:  # others have names and units of their own
            continue
        raw = {h.info.address: h.value for h in held.get(axis.name, ())}
        out[axis.name] = {
            name: float(raw[p.object]) * p.scale
            for name, p in profile.parameters.items()
            if p.object in raw
        }
    return out
