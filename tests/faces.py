"""Machines whose drives have makers' faces, and the drive profiles that a person would complete.

Kinds of drives by name: ``copley`` is the packaged profile, ``copley*`` the same with the facts filled
in that measuring needs, ``copley+`` with all that writing needs as well (its simulated drive has the
face of these two files), ``own`` a drive that is in no list, from its EDS file alone.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml
from durand.datatypes import DatatypeEnum as Type

from drives.profile import MachineProfile, load_machine
from drives.sim.eds import eds_text
from drives.sim.entries import OBJECTS, ObjectEntry
from drives.sim.faces import face_of
from drives.sim.faces.merge import shipped
from drives.sim.faces.others import record, variable
from drives.sim.lockstep_bus import register, unregister
from drives.sim.machine import simulated_machine
from drives.sim.running import RunningMachine
from fieldtool.workflow.profiling import new_profile

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
_ALWAYS, _DISABLED = {"write": "always"}, {"write": "disabled"}
COMPLETE: dict[str, dict[str, Any]] = {
    "copley": {
        "velocity": "position units/s",
        "parameters.velocity_p": {"scale": 2e-4, **_ALWAYS},
        "parameters.velocity_i": {"scale": 1e-2, **_ALWAYS},
        "parameters.position_p": {"scale": 5e-3, **_DISABLED},
        "parameters.velocity_ff": {"scale": 1e-4, **_DISABLED},
        "store": {"object": "0x1010:01", "timeout": "5 s", "states": "disabled"},
    },
    "nanotec": {
        "structure": "cascade",
        "parameters": {
            "position_p": {"object": "0x320E:01", "type": "unknown", "unit": "1/s", "scale": 5e-3,
                           **_ALWAYS},
            "velocity_p": {"object": "0x320E:03", "type": "unknown", "unit": "N m s/rad",
                           "scale": 1e-4, **_ALWAYS},
            "velocity_i": {"object": "0x320E:04", "type": "unknown", "unit": "N m/rad", "scale": 1e6,
                           "power": -1, "times": {"velocity_p": 1}, **_ALWAYS},
        },
        "store": {"object": "0x1010:06", "what": "drive", "timeout": "5 s", "states": "any"},
    },
}  # fmt: skip
"""What besides: made up, as no document that was seen has these units, Copley's store, Nanotec's
velocity loop and sub-index of its store.  How well written gains arrive does not depend on it."""

OWN_EDS = (
    record(0x1010, "Store", {1: ("All parameters", Type.UNSIGNED32)}),
    record(0x2100, "Motor", {1: ("Rated current, 10 mA", Type.UNSIGNED16),
                             2: ("Torque constant, uN m/A", Type.UNSIGNED32)}),
    variable(0x2101, "Increments a revolution", Type.UNSIGNED32),
    record(0x2200, "Speed controller", {1: ("Gain Kp, 2 mA s/rad", Type.UNSIGNED16),
                                        2: ("Reset time Tn, us", Type.UNSIGNED32),
                                        3: ("Take over", Type.UNSIGNED8)}),
    variable(0x2201, "Position controller gain Kp, (rev/s)/increment", Type.REAL32),
    variable(0x2202, "Acceleration feed-forward gain, 1e-6 kg m2", Type.INTEGER32),
    variable(0x2300, "Keep", Type.UNSIGNED32),
    variable(0x2301, "Kept", Type.UNSIGNED8),
    variable(0x60A9, "Velocity unit", Type.UNSIGNED32, 0xFFB44700),  # 0.1 rpm
)  # fmt: skip
"""What a drive that is in no list has besides the standard's objects, and in place of them."""
OWN_FACTS: dict[str, Any] = {
    "modes": [1, 8, 9, 10],
    "position": {"counts": "0x2101", "revolutions": None},
    "torque": {"per_mille_of": "0x2100:01", "unit": "A", "scale": 0.01, "constant": "0x2100:02",
               "constant_scale": 1e-6},
    "quantities": {"torque_constant": {"object": "0x2100:02", "type": "UNSIGNED32", "scale": 1e-6,
                                       "unit": "N m/A"}},
    "interpolation": "linear",
    "torque_lag": "0.22 ms",
    "loop_period": "0.125 ms",
    "torque_offset": True,
    "heartbeat_reaction": 3,
    "error_behaviour": 1,
    "recovery": "fault reset",
    "structure": "cascade",
    "gains_via": "objects",
    "feed_forward": ["inertia_ff"],
    "parameters": {
        "velocity_p": {"object": "0x2200:01", "type": "UNSIGNED16", "unit": "N m s/rad", "scale": 2e-3,
                       "times": {"torque_constant": 1}, **_ALWAYS},
        "velocity_i": {"object": "0x2200:02", "type": "UNSIGNED32", "unit": "N m/rad", "scale": 1e6,
                       "power": -1, "times": {"velocity_p": 1}, **_ALWAYS},
        "position_p": {"object": "0x2201", "type": "REAL32", "unit": "1/s",
                       "times": {"counts_per_rev": 1}, **_DISABLED},
        "inertia_ff": {"object": "0x2202", "type": "INTEGER32", "unit": "kg m2", "scale": 1e-6,
                       **_DISABLED},
    },
    "latches": [{"object": "0x2200:03", "type": "UNSIGNED8", "set_bits": 1,
                 "after": ["velocity_p", "velocity_i"]}],
    "store": {"object": "0x2300", "signature": 0x4B454550, "timeout": "5 s", "verify": "status",
              "status": "0x2301", "status_done": 1, "states": "disabled"},
}  # fmt: skip
"""What its owner finds out."""
NANOTEC = {
    0x1010: {6: ("Store drive parameters", Type.UNSIGNED32)},
    0x320E: {3: ("Velocity Kp", Type.UNSIGNED16), 4: ("Velocity Tn, us", Type.UNSIGNED32)},
}
"""Sub-indices that ``nanotec+`` has besides; made up as its units are."""
TORQUE_CONSTANT = 0.1


def own_drive(folder: Path) -> Path:
    """Write EDS and profile of a drive that is in no list, the profile as ``profile new`` begins it."""
    replaced = {o.index for o in OWN_EDS} | {0x1021, 0x6076, 0x608F}
    standard = (o for o in OBJECTS if not 0x2000 <= o.index < 0x6000 and o.index not in replaced)
    objects = sorted((*standard, *OWN_EDS), key=lambda o: o.index)
    eds = folder / "own.eds"
    eds.write_text(eds_text(objects, "Made up for a test."))
    made = new_profile(eds)
    data = filled_in(yaml.safe_load(made.path.read_text(encoding="utf-8")), OWN_FACTS)
    made.path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return made.path


def _with_more(shown: Iterable[ObjectEntry]) -> tuple[ObjectEntry, ...]:
    """Return the simulated Nanotec's objects with what its person's EDS has besides."""
    out = []
    for one in shown:
        more = record(one.index, one.name, NANOTEC[one.index]) if one.index in NANOTEC else None
        out.append(replace(one, entries=(*one.entries, *more.entries[1:])) if more else one)
    return tuple(out)


def filled_in(data: dict[str, Any], facts: Mapping[str, Any]) -> dict[str, Any]:
    """Put facts into a profile's plain values, by dotted keys; a mapping adds to what is there."""
    for key, value in facts.items():
        *parts, last = key.split(".")
        inner = data
        for part in parts:
            inner = inner[part]
        adds = isinstance(value, dict) and parts
        inner[last] = {**inner[last], **value} if adds else value
    return data


def own_profile(name: str, folder: Path, *, complete: bool = False) -> Path:
    """Write a packaged drive profile with its unknown facts filled in."""
    text = files("profiles").joinpath("drives", f"{name}.yaml").read_text(encoding="utf-8")
    facts = OWN[name] | (COMPLETE[name] if complete else {})
    data = filled_in(yaml.safe_load(text), facts)
    if data["eds"] != "own":
        data["eds"] = str(files("profiles").joinpath("drives", data["eds"]))
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return path


def machine_of(
    drives: tuple[str, str],
    folder: Path,
    gains: Mapping[str, Mapping[str, float]] | None = None,
    **changes: Mapping[str, Any],
) -> MachineProfile:
    """Return the packaged turntable with an arm, its two drives of these kinds.

    ``changes`` by axis name go into the axis; ``gains`` by axis name replace the drives' first gains.
    """
    text = files("profiles").joinpath("machines", "turntable-arm.yaml").read_text(encoding="utf-8")
    data = yaml.safe_load(text)
    data["bus"]["channel"] = str(folder)
    for name, axis, truth in zip(drives, data["axes"], data["simulation"]["axes"], strict=True):
        kind = name.rstrip("*+")
        axis["drive"] = str(own_profile(kind, folder)) if name.endswith("*") else name
        truth["torque_constant"] = TORQUE_CONSTANT
        if name == "schunk":
            axis |= {"drive": "prbt", "eds": str(shipped("schunk.dcf"))}
            truth["face"] = {"profile": "prbt", "eds": axis["eds"]}
        if name.endswith("+") or name == "own":
            path = own_drive(folder) if name == "own" else own_profile(kind, folder, complete=True)
            axis["drive"] = path.name
            truth["face"] = {"profile": path.name, "eds": f"{kind}.eds"}
        truth["gains"]["velocity_ff"] = 1 if kind in ("reference", "epos4") else 0
        if kind in ("novanta", "copley", "nanotec", "cia402"):
            eds = folder / f"{kind}.eds"
            shown = face_of(kind).shown
            objects = _with_more(shown) if name == "nanotec+" else shown
            eds.write_text(eds_text(objects, "Made up for the simulation."))
            axis["eds"] = eds.name
        if kind == "elmo-gold":
            axis["encoder_counts_per_rev"] = 2**20
        if kind == "nanotec":
            axis["torque_constant"] = TORQUE_CONSTANT
        if kind in ("elmo-gold", "copley", "nanotec", "cia402") and not name.endswith("+"):
            axis["loop"] = {
                key: truth["gains"][key] for key in ("position_p", "velocity_p", "velocity_i")
            }
        axis.update(changes.get(axis["name"], {}))
        truth["gains"].update((gains or {}).get(axis["name"], {}))
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
