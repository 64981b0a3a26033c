"""Which experiment tells two rivals apart."""

EXPERIMENTS: dict[frozenset[str], str] = {
    frozenset({"measurement_delay", "torque_lag"}): (
        "excite up to a frequency at which the phase is 45 degrees or more: a lag lowers the gain "
        "there, a delay does not"
    ),
    frozenset({"cogging", "encoder_error"}): (
        "move at constant speeds that differ by a factor of three: cogging keeps its size, an "
        "error of the encoder grows with the square of the speed"
    ),
    frozenset({"gravity", "cogging"}): "move slowly through a whole turn",
    frozenset({"hardening_spring", "backlash"}): (
        "repeat the excitation at a fifth of its size: a gap softens the spring at small "
        "amplitudes, a cubic spring does not"
    ),
    frozenset({"softening_spring", "backlash"}): (
        "repeat the excitation at a fifth of its size: a gap softens the spring at small "
        "amplitudes, a cubic spring does not"
    ),
    frozenset({"coulomb_friction", "asymmetric_friction"}): (
        "read the torque with the power stage off: if that is not zero, the zero of its measurement is "
        "off, else friction differs between the directions"
    ),
    frozenset({"coulomb_friction", "stribeck_friction"}): (
        "move at constant speeds from very slow to fast: only Stribeck friction falls with the speed"
    ),
    frozenset({"coulomb_friction", "backlash"}): (
        "move at constant speed: friction stays, a gap does nothing"
    ),
    frozenset({"structural_damping", "viscous_friction"}): (
        "hold the axis by its brake or another loop and excite two modes far apart in frequency"
    ),
    frozenset({"coupling_spring", "coupling_inertia"}): (
        "excite one axis at low and at high frequencies while the other is held: a spring fades "
        "with the square of the frequency against an inertia"
    ),
    frozenset({"torque_scale", "coupling_inertia"}): "give the motor's inertia from its data sheet",
}


def experiment_for(one: str, other: str) -> str:
    """Return in words what would tell two effects apart."""
    known = EXPERIMENTS.get(frozenset({one, other}))
    if known is not None:
        return known
    if one == other:
        return "excite the axis more strongly, so that both places of the machine move differently"
    return (
        "repeat the excitation at half and at twice its size, and over another band of frequencies"
    )
