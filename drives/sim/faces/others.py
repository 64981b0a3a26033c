"""Drives of other makers: Elmo and Pilz by their own files; those without a file from documents.

The dictionaries of Novanta, Copley, Nanotec and of any CiA 402 drive are **made up for the
simulation**: the standard objects of the reference drive, and the maker's objects that are
documented.  They are no maker's EDS and ship nowhere.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from math import pi

from durand.datatypes import DatatypeEnum as Type

from drives.sim.dictionary import Key, Value
from drives.sim.entries import OBJECTS, Entry, ObjectEntry
from drives.sim.faces.face import Face, FixedLoops, Lock, Motor, Read, start_settings
from drives.sim.faces.merge import completed, dressed, shipped, with_modes
from drives.sim.servo_kernel import Parameter

PASSWORD = b"owner"
"""Of the simulated Pilz drive."""
_PRBT_GAINS = ((0x2010, 0x2014), (0x2020, 0x2025), (0x2030, 0x2035))


def _standard_motor(motor: Motor) -> dict[Key, Value]:
    return {(0x6076, 0): round(1000 * motor.rated_torque), (0x608F, 1): motor.counts_per_rev}


def _torque_alone(motor: Motor) -> dict[Key, Value]:
    """Nobody entered the encoder: 0x608F and 0x6092 stay 1/1, positions are counts."""
    return {(0x6076, 0): round(1000 * motor.rated_torque)}


def _elmo_gold() -> Face:
    objects, hidden = dressed(shipped("elmo-gold.dcf"))
    return Face("elmo-gold", FixedLoops, with_modes(objects), hidden, values=_torque_alone)


def _elmo_simpliq() -> Face:
    objects, hidden = dressed(shipped("elmo-simpliq.dcf"))
    return Face("elmo-simpliq", FixedLoops, with_modes(objects), hidden, values=_standard_motor)


def _prbt() -> Face:
    objects, hidden = dressed(shipped("prbt.dcf"))
    keys = frozenset((index, 0) for first, end in _PRBT_GAINS for index in range(first, end))
    lock = Lock((0x2008, 0), (0x2009, 0), PASSWORD, keys)
    return Face("prbt", FixedLoops, with_modes(objects), hidden, values=_standard_motor, lock=lock)


# --- made up from documents ------------------------------------------------------------------------


def variable(index: int, name: str, kind: Type, default: float = 0) -> ObjectEntry:
    """Return an object of one entry that can be written."""
    entry = Entry(index, 0, name, kind, "rw", default=default)
    return ObjectEntry(index, name, (entry,), is_variable=True)


def record(index: int, name: str, kinds: dict[int, tuple[str, Type]]) -> ObjectEntry:
    """Return an object of several, by sub-index."""
    count = Entry(index, 0, "Highest sub-index", Type.UNSIGNED8, "const", default=max(kinds))
    subs = (Entry(index, k, text, kind, "rw") for k, (text, kind) in kinds.items())
    return ObjectEntry(index, name, (count, *subs))


def _made_up(own: Iterable[ObjectEntry]) -> tuple[tuple[ObjectEntry, ...], frozenset[Key]]:
    """Return the standard objects with a maker's documented ones among them."""
    shown = {o.index: o for o in OBJECTS if not 0x2000 <= o.index < 0x6000 and o.index != 0x1021}
    shown |= {o.index: o for o in own}
    return completed(shown)


class _NovantaLoops:
    """float32 in the maker's units: N m/(rev/s), Hz, (rev/s)/count, N m/(rev/s2).

    That a corner of f Hz means velocity_i = velocity_p 2 pi f is assumed; the maker's documents
    that were seen do not say it.
    """

    keys: tuple[Key, ...] = ((0x250A, 0), (0x250B, 0), (0x2511, 0), (0x2590, 0))
    locked: tuple[Key, ...] = ()

    def __init__(self, motor: Motor) -> None:
        self._motor, self._start = motor, start_settings(motor.gains)

    def factory(self) -> dict[Key, Value]:
        start = self._start
        inner = start.get(Parameter.VELOCITY_P, 0.0)
        reset = start.get(Parameter.VELOCITY_I, 0.0)
        return {
            (0x250A, 0): inner * 2 * pi,
            (0x250B, 0): reset / inner / (2 * pi) if inner else 0.0,
            (0x2511, 0): start.get(Parameter.POSITION_P, 0.0) / self._motor.counts_per_rev,
            (0x2590, 0): start.get(Parameter.INERTIA_FF, 0.0) * 2 * pi,
        }

    def settings(self, read: Read) -> dict[Parameter, float]:
        inner = float(read(0x250A, 0)) / (2 * pi)
        return {
            **self._start,
            Parameter.VELOCITY_P: inner,
            Parameter.VELOCITY_I: inner * 2 * pi * float(read(0x250B, 0)),
            Parameter.POSITION_P: float(read(0x2511, 0)) * self._motor.counts_per_rev,
            Parameter.INERTIA_FF: float(read(0x2590, 0)) / (2 * pi),
        }


def _novanta() -> Face:
    real = Type.REAL32
    biquads = (0x2530, 0x2540, 0x2550, 0x2560, 0x2570, 0x2580)
    parts = {
        k + 1: (f"{name} {k // 4 + 1}", real)
        for k, name in enumerate(("TYPE", "FREQ", "Q", "GAIN") * 2)
    }
    objects, hidden = _made_up(
        (
            variable(0x209A, "Rated torque, N m", real),
            variable(0x2100, "Rated current, A", real),
            variable(0x2500, "Current loop Kp, V/A", real),
            variable(0x2501, "Current loop Ki, Hz", real),
            variable(0x250A, "Velocity loop Kp, N m/(rev/s)", real),
            variable(0x250B, "Velocity loop Ki, Hz", real),
            variable(0x250C, "Velocity loop Kd, s", real),
            variable(0x2511, "Position loop Kp, (rev/s)/count", real),
            variable(0x2590, "Acceleration feed-forward, N m/(rev/s2)", real),
            *(record(index, "Biquads", parts) for index in biquads),
        )
    )

    def values(motor: Motor) -> dict[Key, Value]:
        return {
            **_standard_motor(motor),
            (0x209A, 0): motor.rated_torque,
            (0x2100, 0): motor.rated_torque / motor.torque_constant,
        }

    return Face("novanta", _NovantaLoops, objects, hidden, values=values)


def _copley() -> Face:
    short = Type.INTEGER16
    velocity = {1: ("Kp", short), 2: ("Ki", short), 3: ("Kaff", short), 4: ("Shift", short)}
    position = {1: ("Kp", short), 2: ("Kvff", short), 3: ("Kaff", short), 4: ("Scale", short)}
    objects, hidden = _made_up(
        (
            record(0x60F9, "Velocity loop", velocity),
            record(0x60FB, "Position loop", position),
            variable(0x2106, "Velocity output filter", Type.UNSIGNED32),
            variable(0x2108, "Velocity command filter", Type.UNSIGNED32),
        )
    )
    return Face("copley", FixedLoops, objects, hidden, values=_standard_motor)


def _nanotec() -> Face:
    """Torque per mille of the rated current 0x203B:01, here in mA; no 0x6076."""
    closed = {1: ("Position Kp, per mille", Type.UNSIGNED16), 2: ("Tn, us", Type.UNSIGNED32)}
    objects, hidden = _made_up(
        (
            record(0x203B, "Motor currents", {1: ("Rated current, mA", Type.UNSIGNED32)}),
            record(0x320E, "Closed loop parameters", closed),
        )
    )

    def values(motor: Motor) -> dict[Key, Value]:
        current = round(1000 * motor.rated_torque / motor.torque_constant)
        return {**_standard_motor(motor), (0x203B, 1): current}

    return Face("nanotec", FixedLoops, objects, hidden | {(0x6076, 0)}, values=values)


def _cia402() -> Face:
    objects, hidden = _made_up(())
    return Face("cia402", FixedLoops, objects, hidden, values=_standard_motor)


_MAKERS = {
    "elmo-gold": _elmo_gold,
    "elmo-simpliq": _elmo_simpliq,
    "prbt": _prbt,
    "novanta": _novanta,
    "copley": _copley,
    "nanotec": _nanotec,
    "cia402": _cia402,
}
NAMES = tuple(_MAKERS)


@cache
def other_face(name: str) -> Face:
    """Return one of these faces by the name of its drive profile; raise KeyError if there is none."""
    face = _MAKERS[name]()
    return replace(
        face, not_imitated=(f"{name}: the maker's own objects hold values and do nothing",)
    )
