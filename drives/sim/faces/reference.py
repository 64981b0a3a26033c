"""The reference drive: every loop, filter and feed-forward of the firmware as an object."""

from drives.sim.dictionary import Key, Value
from drives.sim.eds import packaged_eds
from drives.sim.faces.face import Face, Motor, Read
from drives.sim.scales import FILTER_KEYS, GAINS, gain_objects
from drives.sim.servo_kernel import Parameter


class ReferenceLoops:
    """One object a parameter, in thousandths."""

    keys: tuple[Key, ...] = tuple(GAINS)
    locked: tuple[Key, ...] = FILTER_KEYS

    def __init__(self, motor: Motor) -> None:
        self._gains = dict(motor.gains)

    def factory(self) -> dict[Key, Value]:
        """Values for the start gains."""
        return gain_objects(self._gains)

    def settings(self, read: Read) -> dict[Parameter, float]:
        """Firmware parameters, SI."""
        return {parameter: float(read(*key)) * scale for key, (parameter, scale) in GAINS.items()}


def _values(motor: Motor) -> dict[Key, Value]:
    return {
        (0x6076, 0): round(1000 * motor.rated_torque),
        (0x608F, 1): motor.counts_per_rev,
    }


REFERENCE = Face("reference", ReferenceLoops, eds=packaged_eds(), values=_values)
