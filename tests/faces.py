"""Machines whose drives have makers' faces, and the drive profiles that a person would complete."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml

from drives.profile import MachineProfile, load_machine
from drives.sim.eds import eds_text
from drives.sim.faces import face_of
from drives.sim.lockstep_bus import register, unregister
from drives.sim.machine import simulated_machine
from drives.sim.running import RunningMachine

OWN: dict[str, dict[str, Any]] = {
    "novanta": {
        "torque": {"per_mille_of": "0x6076", "unit": "N m", "scale": 0.001},
        "heartbeat_reaction": 3,
        "parameters.velocity_i.scale": 6.283185307179586,
    },
    "copley": {
        "torque": {"per_mille_of": "0x6076", "unit": "N m", "scale": 0.001},
        "heartbeat_reaction": 3,
    },
    "nanotec": {
        "torque": {
            "per_mille_of": "0x203B:01",
            "unit": "A",
            "scale": 0.001,
            "constant": "machine",
        },
        "heartbeat_reaction": 3,
    },
    "cia402": {},
    "epos4": {"interpolation": "linear", "torque_lag": "0.22 ms"},
}
"""What a person enters where a packaged profile says unknown; the simulated drives are made so."""
TORQUE_CONSTANT = 0.1


def own_profile(name: str, folder: Path) -> Path:
    """Write a packaged drive profile with its unknown facts filled in."""
    text = files("profiles").joinpath("drives", f"{name}.yaml").read_text(encoding="utf-8")
    data = yaml.safe_load(text)
    for key, value in OWN[name].items():
        *parts, last = key.split(".")
        inner = data
        for part in parts:
            inner = inner[part]
        inner[last] = value
    if data["eds"] != "own":
        data["eds"] = str(files("profiles").joinpath("drives", data["eds"]))
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return path


def machine_of(
    drives: tuple[str, str], folder: Path, **changes: Mapping[str, Any]
) -> MachineProfile:
    """Return the packaged turntable with an arm, its two drives of these kinds.

    ``changes`` by axis name go into the axis.
    """
    text = files("profiles").joinpath("machines", "turntable-arm.yaml").read_text(encoding="utf-8")
    data = yaml.safe_load(text)
    data["bus"]["channel"] = str(folder)
    for name, axis, truth in zip(drives, data["axes"], data["simulation"]["axes"], strict=True):
        kind = name.removesuffix("*")
        axis["drive"] = str(own_profile(kind, folder)) if name.endswith("*") else name
        truth["torque_constant"] = TORQUE_CONSTANT
        truth["gains"]["velocity_ff"] = 1 if kind in ("reference", "epos4") else 0
        if kind in ("novanta", "copley", "nanotec", "cia402"):
            eds = folder / f"{kind}.eds"
            eds.write_text(eds_text(face_of(kind).shown, "Made up for the simulation."))
            axis["eds"] = eds.name
        if kind == "elmo-gold":
            axis["encoder_counts_per_rev"] = 2**20
        if kind == "nanotec":
            axis["torque_constant"] = TORQUE_CONSTANT
        if kind in ("elmo-gold", "copley", "nanotec", "cia402"):
            axis["loop"] = {
                key: truth["gains"][key] for key in ("position_p", "velocity_p", "velocity_i")
            }
        axis.update(changes.get(axis["name"], {}))
    path = folder / "machine.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return load_machine(path)


@contextmanager
def simulated(machine: MachineProfile) -> Iterator[RunningMachine]:
    """Have the machine simulated behind its bus."""
    channel = str(machine.bus.channel)
    running = register(channel, simulated_machine(machine))
    try:
        yield running
    finally:
        unregister(channel)
