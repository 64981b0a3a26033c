"""Profiles: what a drive's objects mean, and what a machine's axes may do.

A profile is a YAML file.  Unknown keys, wrong types, wrong units and missing limits are refused with
file and line, because a misspelled limit must stop the program.  Profiles hold data only.  A fact
that is not known is written ``unknown``; the tool never guesses it.

Files are looked for as given, else among the packaged ones (``profiles/drives``,
``profiles/machines``) by their name without ``.yaml``.
"""

from drives.profile.bus import SIMULATED, BusProfile
from drives.profile.chain import ChainProfile, CouplingProfile
from drives.profile.drive import DriveProfile, Identity
from drives.profile.effects import EffectProfile, MachineEffectProfile
from drives.profile.loading import load_drive, load_machine, packaged
from drives.profile.machine import (
    AxisProfile,
    Limits,
    LoopProfile,
    MachineProfile,
    MotorInertia,
)
from drives.profile.parameter import Condition, FilterInfo, Latch, ParameterInfo, Store, Unlock
from drives.profile.scales import PositionScale, Quantity, SyncRules, TorqueScale
from drives.profile.simulation import FaceProfile, SimulatedAxisProfile, SimulationProfile
from drives.profile.values import DIMENSIONS, UNKNOWN, known
from drives.profile.yaml_reader import MAX_PROFILE_BYTES, read_yaml

__all__ = [
    "DIMENSIONS",
    "MAX_PROFILE_BYTES",
    "SIMULATED",
    "UNKNOWN",
    "AxisProfile",
    "BusProfile",
    "ChainProfile",
    "Condition",
    "CouplingProfile",
    "DriveProfile",
    "EffectProfile",
    "FaceProfile",
    "FilterInfo",
    "Identity",
    "Latch",
    "Limits",
    "LoopProfile",
    "MachineEffectProfile",
    "MachineProfile",
    "MotorInertia",
    "ParameterInfo",
    "PositionScale",
    "Quantity",
    "SimulatedAxisProfile",
    "SimulationProfile",
    "Store",
    "SyncRules",
    "TorqueScale",
    "Unlock",
    "known",
    "load_drive",
    "load_machine",
    "packaged",
    "read_yaml",
]
