"""What a simulated machine is: drives, chains, couplings, as frozen values."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite, pi
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

from drives.errors import ProfileError
from drives.sim.dictionary import Key, Value
from drives.sim.effects import (
    AsymmetricFriction,
    Backlash,
    ChainEffect,
    Cogging,
    CoulombFriction,
    CouplingInertia,
    CouplingSpring,
    EncoderError,
    ExtraMode,
    Gravity,
    HardeningSpring,
    MachineEffect,
    MeasurementDelay,
    PeriodicDisturbance,
    SofteningSpring,
    StiffnessChange,
    StribeckFriction,
    StructuralDamping,
    TorqueLag,
    TorqueSaturation,
    TorqueScale,
)
from drives.sim.entries import ENTRIES
from drives.sim.faces import REFERENCE, Face, Motor, face_names, face_of
from drives.sim.faces.face import Loops
from drives.sim.firmware import DriveHardware
from drives.sim.plant import ChainParameters, PlantParameters
from drives.sim.scales import Scales

if TYPE_CHECKING:
    from drives.profile import (
        AxisProfile,
        EffectProfile,
        FaceProfile,
        MachineEffectProfile,
        MachineProfile,
    )

Kind = Literal["rotary", "linear"]

_STANDARD_RESOLUTION = 2**20
_LARGEST_TORQUE = 32.0
"""Peak over rated torque that 0x6077 (16 bits, per mille) can still show."""
_POSITION_KEYS: tuple[Key, ...] = ((0x6065, 0), (0x6067, 0))
_VELOCITY_KEYS: tuple[Key, ...] = ((0x607F, 0), (0x6080, 0), (0x6081, 0))
_ACCELERATION_KEYS: tuple[Key, ...] = ((0x6083, 0), (0x6084, 0), (0x6085, 0))
"""Objects whose defaults go with the encoder's resolution and the drive's units."""


@dataclass(frozen=True)
class SimulatedDrive:
    """One axis: a drive, its motor and the chain that it moves.

    Raises
    ------
    ValueError
        If a value is not physical, or does not fit the drive's objects.
    """

    name: str
    node_id: int
    """1 to 127."""
    chain: ChainParameters
    rated_torque: float
    """N m (or N): 1000 in the torque objects."""
    peak_torque: float
    """N m (or N)."""
    kind: Kind = "rotary"
    torque_noise: float = 0.0
    """Standard deviation of the torque measurement, N m (or N)."""
    encoder_counts_per_rev: int = _STANDARD_RESOLUTION
    """Object 0x608F:01."""
    counts_per_metre: float | None = None
    """Linear axes only: encoder counts per metre of travel."""
    serial: int = 0
    """Object 0x1018:04."""
    gains: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """Start values by name (``position_p`` ...), SI; factory values of the objects."""
    objects: Mapping[Key, Value] = field(default_factory=lambda: MappingProxyType({}))
    """Factory values of further objects by (index, sub-index), raw; they win over everything."""
    torque_constant: float = 0.1
    """N m/A (or N/A) of the motor, for drives that know currents."""
    face: Face = REFERENCE
    """What kind of drive it is."""
    store_time: float = 0.2
    """How long 0x1010 and 0x1011 take, s."""

    def __post_init__(self) -> None:
        where = f"simulated drive {self.name}"
        if not 1 <= self.node_id <= 127:
            raise ValueError(f"{where}: node id {self.node_id} is not within 1 to 127")
        if self.kind not in ("rotary", "linear"):
            raise ValueError(f"{where}: kind must be rotary or linear, got {self.kind!r}")
        if (self.kind == "linear") != (self.counts_per_metre is not None):
            raise ValueError(
                f"{where}: counts_per_metre belongs to linear axes, and to all of them"
            )
        if self.encoder_counts_per_rev < 1:
            raise ValueError(f"{where}: {self.encoder_counts_per_rev} encoder counts a revolution")
        if not (isfinite(self.peak_torque) and self.peak_torque > 0):
            raise ValueError(f"{where}: peak torque {self.peak_torque} must be finite and above 0")
        if not self.peak_torque <= _LARGEST_TORQUE * self.rated_torque:
            raise ValueError(
                f"{where}: peak torque {self.peak_torque} is more than {_LARGEST_TORQUE:g} times "
                f"the rated torque {self.rated_torque}; 0x6077 can not show it"
            )
        if not (isfinite(self.store_time) and self.store_time >= 0):
            raise ValueError(f"{where}: store time {self.store_time} s must be at least 0")
        _ = self.factory_objects, self.hardware  # both check what they are made from

    @property
    def counts_per_unit(self) -> float:
        """Encoder counts per rad (or m)."""
        if self.counts_per_metre is not None:
            return self.counts_per_metre
        return self.encoder_counts_per_rev / (2 * pi)

    @property
    def scales(self) -> Scales:
        """What the drive's units are in SI."""
        return Scales(self.counts_per_unit, self.rated_torque, *self.face.units(self.motor))

    @property
    def motor(self) -> Motor:
        """The motor as the drive's face knows it."""
        return Motor(
            self.rated_torque,
            self.peak_torque,
            self.torque_constant,
            self.encoder_counts_per_rev,
            self.counts_per_unit,
            self.gains,
        )

    @property
    def loops(self) -> Loops:
        """How the drive's objects are its firmware's parameters."""
        return self.face.loops(self.motor)

    @property
    def hardware(self) -> DriveHardware:
        """The drive as the firmware knows it."""
        return DriveHardware(
            rated_torque=self.rated_torque,
            torque_noise=self.torque_noise,
            counts_per_unit=self.counts_per_unit,
            peak_torque=self.peak_torque,
        )

    @property
    def factory_objects(self) -> dict[Key, Value]:
        """Factory values where this drive differs from the EDS file's defaults."""
        counts = self.encoder_counts_per_rev / _STANDARD_RESOLUTION
        velocity, acceleration = (
            counts / self.counts_per_unit / unit for unit in self.face.units(self.motor)
        )
        objects: dict[Key, Value] = {
            key: min(max(1, round(int(ENTRIES[key].default) * scale)), 2**32 - 1)
            for keys, scale in (
                (_POSITION_KEYS, counts),
                (_VELOCITY_KEYS, velocity),
                (_ACCELERATION_KEYS, acceleration),
            )
            for key in keys
        }
        objects |= {
            (0x1018, 4): self.serial,
            (0x6072, 0): round(1000 * self.peak_torque / self.rated_torque),
        }
        try:
            objects |= self.face.values(self.motor) | self.loops.factory()
        except ValueError as error:
            raise ValueError(f"simulated drive {self.name}: {error}") from None
        return objects | dict(self.objects)


@dataclass(frozen=True)
class SimulatedMachine:
    """Drives on one bus, and how their chains are coupled.

    Raises
    ------
    ValueError
        If there is no drive, or two have the same name or node id, or the chains do not fit.
    """

    drives: tuple[SimulatedDrive, ...]
    couplings: tuple[tuple[int, int, float], ...] = ()
    """(a, b, value): inertia coupling between the last masses of drives a and b, from 0."""
    seed: int = 0
    """Of the measurement noise."""
    effects: tuple[MachineEffect, ...] = ()
    """What else joins the drives' chains."""

    def __post_init__(self) -> None:
        for what in ("name", "node_id"):
            values = [getattr(drive, what) for drive in self.drives]
            if len(set(values)) != len(values):
                raise ValueError(f"each simulated drive needs a {what} of its own, got {values}")
        _ = self.plant

    @property
    def plant(self) -> PlantParameters:
        """The mechanics of all drives."""
        chains = tuple(drive.chain for drive in self.drives)
        return PlantParameters(chains, self.couplings, self.effects)


def simulated_machine(profile: "MachineProfile") -> SimulatedMachine:
    """Return the simulated machine that a machine profile describes.

    Raises
    ------
    ProfileError
        If the profile has no ``simulation`` section, not one entry in it for each axis, a linear
        axis without ``feed``, or describes nothing that can be.
    """
    try:
        return _described(profile)
    except (ValueError, ArithmeticError) as error:
        raise ProfileError(profile.path, f"simulation: {error}.") from error


def _described(profile: "MachineProfile") -> SimulatedMachine:
    simulation = profile.simulation
    if simulation is None:
        raise ValueError(
            f"machine {profile.name} has no `simulation` section, so it can not be simulated"
        )
    if len(simulation.axes) != len(profile.axes):
        raise ValueError(
            f"machine {profile.name} has {len(profile.axes)} axes, but {len(simulation.axes)} "
            "under `simulation`; give one for each, in the same order"
        )
    names = [axis.name for axis in profile.axes]
    drives = []
    for axis, truth in zip(profile.axes, simulation.axes, strict=True):
        counts_per_metre = None
        if axis.kind == "linear":
            if axis.feed is None:
                raise ValueError(
                    f"axis {axis.name} is linear: to be simulated it needs `feed` under `axes`, the "
                    "metres that it goes in a revolution, as a number"
                )
            counts_per_metre = truth.encoder_counts_per_rev / axis.feed
        serial = axis.serial_number
        drives.append(
            SimulatedDrive(
                name=axis.name,
                node_id=axis.node_id,
                kind=axis.kind,
                chain=ChainParameters(
                    masses=truth.masses,
                    springs=truth.springs,
                    dampers=truth.dampers or (0.0,) * len(truth.springs),
                    viscous_friction=truth.viscous_friction,
                    effects=tuple(chain_effect(part, axis.kind) for part in truth.effects),
                ),
                rated_torque=truth.rated_torque,
                peak_torque=truth.peak_torque,
                torque_noise=truth.torque_noise,
                encoder_counts_per_rev=truth.encoder_counts_per_rev,
                counts_per_metre=counts_per_metre,
                serial=1000 + axis.node_id if serial is None else serial,
                gains=truth.gains,
                torque_constant=truth.torque_constant,
                face=_face(truth.face, axis, profile.path),
            )
        )
    couplings = tuple(
        (names.index(c.axes[0]), names.index(c.axes[1]), c.value) for c in simulation.couplings
    )
    effects = tuple(_machine_effect(part, names) for part in simulation.effects)
    return SimulatedMachine(tuple(drives), couplings, simulation.seed, effects)


def _face(told: "FaceProfile | str | None", axis: "AxisProfile", beside: Path) -> Face:
    if isinstance(told, str):
        return face_of(told)
    if told is None:
        return _face_of_drive(axis.drive, beside)
    from drives.profile import load_drive
    from drives.sim.faces.own import own_face

    kind = load_drive(told.profile, beside)
    eds = kind.eds_path if told.eds is None else beside.parent / told.eds
    where = f"axis {axis.name}, `face`"
    if eds is None:
        raise ValueError(
            f"{where}: drive profile {kind.name} has no EDS file of its own. Give the drive's as `eds`, "
            f"beside `profile: {told.profile}`"
        )
    if not eds.is_file():
        raise ValueError(
            f"{where}: there is no EDS file {eds}. Give its path from the machine profile's folder as "
            "`eds`"
        )
    try:
        return own_face(kind, eds)
    except (ValueError, ProfileError) as error:
        raise ValueError(f"{where}: {error}") from None


def _face_of_drive(name: str, beside: Path) -> Face:
    """Return the face of a drive profile's name; that of the reference drive for others' names."""
    from drives.profile import load_drive

    kind = load_drive(name, beside).name
    return face_of(kind) if kind in face_names() else REFERENCE


_PARTS: dict[str, type[ChainEffect]] = {
    "coulomb_friction": CoulombFriction,
    "stribeck_friction": StribeckFriction,
    "asymmetric_friction": AsymmetricFriction,
    "backlash": Backlash,
    "hardening_spring": HardeningSpring,
    "softening_spring": SofteningSpring,
    "structural_damping": StructuralDamping,
    "stiffness_change": StiffnessChange,
    "gravity": Gravity,
    "cogging": Cogging,
    "periodic_disturbance": PeriodicDisturbance,
    "extra_mode": ExtraMode,
    "torque_scale": TorqueScale,
    "torque_saturation": TorqueSaturation,
    "torque_lag": TorqueLag,
    "measurement_delay": MeasurementDelay,
    "encoder_error": EncoderError,
}
"""Parts of a chain by the names of ``model.yaml``; their fields are those of the profile."""


def chain_effect(part: "EffectProfile", kind: Kind) -> ChainEffect:
    """Return the part that a profile describes, for an axis of this kind."""
    values = part.model_dump(exclude={"effect"})
    if kind == "linear" and part.effect == "gravity":
        values["angle"] = None
    if kind == "linear" and part.effect in ("cogging", "encoder_error"):
        values["linear"] = True
    return _PARTS[part.effect](**values)


def _machine_effect(part: "MachineEffectProfile", names: list[str]) -> MachineEffect:
    chains = (names.index(part.axes[0]), names.index(part.axes[1]))
    if part.effect == "coupling_spring":
        return CouplingSpring(chains, part.spring, part.damper, part.location)
    return CouplingInertia(chains, part.inertia, part.location)
