"""Parts that can be added to the plain chains of masses and springs, named as in ``model.yaml``.

There are four ways for a part to act, and each meets the plant or the drive at a place of its own:

- A *linear* part changes the matrices of M q'' + C q' + K q = f before anything moves
  (:class:`LinearEffect`: viscous friction, an extra mode, springs between axes); it costs nothing
  while the plant is stepped.
- A *holding* part takes a mass out of the motion while it sticks and is a constant force on it while
  it slides (:class:`HoldingEffect`: dry friction, the brake of an axis with gravity); a plant with one
  is stepped piece by piece, each piece exact (:mod:`drives.sim.stick_slip`).
- A part with a bend or a memory (:class:`BentEffect`: a gap, a spring that hardens, bristles) is made
  of :class:`Element` values: forces between two masses, or a mass and ground, evaluated once an inner
  step and held over it (:mod:`drives.sim.element_kernel`).
- A part of the *drive* (:class:`ServoEffect`) stands between the torque that the drive reports and the
  one that the motor gives, or between the shaft and what is measured of it.

A part of a chain says where it sits: by ``location`` (first or last mass), or by ``joint`` (its number
from the motor, from 1).  The plant numbers the masses.

These are the plant's own formulas.  Whatever explains measured data has to find the effects by others.
"""

from drives.sim.effects.couplings import CouplingInertia, CouplingSpring
from drives.sim.effects.friction import (
    AsymmetricFriction,
    CoulombFriction,
    StribeckFriction,
    ViscousFriction,
)
from drives.sim.effects.grounds import Cogging, ExtraMode, Gravity, PeriodicDisturbance
from drives.sim.effects.joints import (
    Backlash,
    HardeningSpring,
    SofteningSpring,
    StiffnessChange,
    StructuralDamping,
)
from drives.sim.effects.servo import (
    EncoderError,
    MeasurementDelay,
    TorqueLag,
    TorqueSaturation,
    TorqueScale,
)
from drives.sim.effects.shapes import (
    BentEffect,
    Element,
    ElementKind,
    FloatArray,
    HoldingEffect,
    LinearEffect,
    Location,
    ServoEffect,
    Site,
)

ChainEffect = (
    CoulombFriction
    | StribeckFriction
    | AsymmetricFriction
    | Backlash
    | HardeningSpring
    | SofteningSpring
    | StructuralDamping
    | StiffnessChange
    | Gravity
    | Cogging
    | PeriodicDisturbance
    | ExtraMode
    | TorqueScale
    | TorqueLag
    | TorqueSaturation
    | MeasurementDelay
    | EncoderError
)
"""Every part that a chain, its motor and its drive can be given."""

MachineEffect = CouplingSpring | CouplingInertia
"""Every part that joins two chains."""

__all__ = [
    "AsymmetricFriction",
    "Backlash",
    "BentEffect",
    "ChainEffect",
    "Cogging",
    "CoulombFriction",
    "CouplingInertia",
    "CouplingSpring",
    "Element",
    "ElementKind",
    "EncoderError",
    "ExtraMode",
    "FloatArray",
    "Gravity",
    "HardeningSpring",
    "HoldingEffect",
    "LinearEffect",
    "Location",
    "MachineEffect",
    "MeasurementDelay",
    "PeriodicDisturbance",
    "ServoEffect",
    "Site",
    "SofteningSpring",
    "StiffnessChange",
    "StribeckFriction",
    "StructuralDamping",
    "TorqueLag",
    "TorqueSaturation",
    "TorqueScale",
    "ViscousFriction",
]
