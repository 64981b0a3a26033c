"""The library of physical effects: all that a name can be given to."""

from fieldtool.criticise.effects.base import Context, Effect
from fieldtool.criticise.effects.coupling import (
    CouplingInertia,
    CouplingSpring,
    coupling_candidates,
)
from fieldtool.criticise.effects.disturbance import PeriodicDisturbance, disturbance_candidates
from fieldtool.criticise.effects.friction import (
    AsymmetricFriction,
    CoulombFriction,
    StribeckFriction,
    ViscousFriction,
    friction_candidates,
)
from fieldtool.criticise.effects.position import (
    Cogging,
    EncoderError,
    Gravity,
    position_candidates,
)
from fieldtool.criticise.effects.springs import (
    Backlash,
    ExtraMode,
    HardeningSpring,
    SofteningSpring,
    StiffnessChange,
    StructuralDamping,
    mode_candidates,
    spring_candidates,
)
from fieldtool.criticise.effects.torque import (
    MeasurementDelay,
    TorqueLag,
    TorqueSaturation,
    TorqueScale,
    torque_candidates,
)

LIBRARY: dict[str, type[Effect]] = {
    kind.name: kind
    for kind in (
        ViscousFriction, CoulombFriction, StribeckFriction, AsymmetricFriction, Backlash,
        HardeningSpring, SofteningSpring, StructuralDamping, Gravity, Cogging, TorqueScale, TorqueLag,
        MeasurementDelay, EncoderError, ExtraMode, CouplingSpring, CouplingInertia,
        PeriodicDisturbance, StiffnessChange, TorqueSaturation,
    )
}  # fmt: skip
"""By the name that files use."""


def candidates(context: Context, without: frozenset[str] = frozenset()) -> list[Effect]:
    """Return every effect at every place, with start values from the data.

    Parameters
    ----------
    context : Context
    without : frozenset of str
        Names that are not tried.
    """
    found = [
        *torque_candidates(context),
        *friction_candidates(context),
        *position_candidates(context),
        *spring_candidates(context),
        *coupling_candidates(context),
        *mode_candidates(context),
        *disturbance_candidates(context),
    ]
    return [effect for effect in found if effect.name not in without]
