"""A first drive profile from an EDS file: what the file tells, and ``unknown`` for all the rest.

Nothing is guessed.  Each ``unknown`` is followed by what a person has to find out, and until then
the tool refuses what depends on it.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from canopen.objectdictionary import ObjectDictionary, ODVariable

from drives import objects
from drives.cia402 import in_words, modes_in
from drives.objects import ObjectAddress, ObjectInfo
from drives.profile.eds import (
    default_at,
    info_at,
    variable_at,
    variables,
    writable,
)
from drives.profile.match import Presented

MOST_PARAMETERS = 60
"""Gains that are listed at most; a maker with more has other ideas of what a gain is."""
_GAIN = re.compile(
    r"\b(gain|k[pivdrac]{1,3}|kr|tn|td|kc|feed.?forward|ff|notch|filter|observer|bandwidth"
    r"|proportional|integral|reset time|damping|cut.?off|p.?factor|(position|velocity|speed) [pid])\b",
    re.IGNORECASE,
)
_NOT_A_GAIN = re.compile(
    r"temperature|voltage|input|output|sub-?index|encoder|touch|home|homing|number of",
    re.IGNORECASE,
)
_MAKERS = ((0x2000, 0x6000), (0x60F6, 0x60FC))
_TORQUE_OFFSET = ObjectInfo(ObjectAddress(0x60B2), "INTEGER16", "torque offset")
_EXPECTED = (
    objects.STORE_ALL,
    objects.CONSUMER_HEARTBEAT,
    objects.ERROR_BEHAVIOUR,
    objects.SYNC_PERIOD,
    objects.ABORT_CONNECTION,
    objects.QUICK_STOP_OPTION,
    objects.TARGET_TORQUE,
    objects.RATED_TORQUE,
    objects.ENCODER_COUNTS,
    objects.ENCODER_REVOLUTIONS,
    objects.GEAR_MOTOR,
    objects.GEAR_SHAFT,
    objects.FEED_CONSTANT,
    objects.FEED_REVOLUTIONS,
    objects.VELOCITY_UNIT,
    _TORQUE_OFFSET,
)
"""Standard objects of which a profile says where the drive has none."""


def draft(dictionary: ObjectDictionary, name: str, eds: str) -> str:
    """Return a drive profile as YAML, with all that an EDS file tells.

    Parameters
    ----------
    dictionary
        What the file describes.
    name
        Of the new profile.
    eds
        The file's name, from the profile's folder.
    """
    device = dictionary.device_information
    said = " ".join(str(t) for t in (device.vendor_name, device.product_name) if t)
    lines = [
        f"# First profile of a drive, from {_plain(eds)}.",
        "# Every `unknown` is for a person to find out, in the drive's manual or from its maker; until",
        "# then the tool refuses what depends on it, and says so.",
        "# Take nothing from a similar drive: a wrong unit moves the machine wrongly.",
        "format: fieldtool-drive/1",
        f"name: {name}",
        f"description: {json.dumps(_plain(said) or name)}",
        f"eds: {json.dumps(eds)}",
        *_identity(dictionary),
        *_modes(dictionary),
        *_absent(dictionary),
        *_units(dictionary),
        *_behaviour(dictionary),
        *_gains(dictionary),
        *_store(dictionary),
        "sources:",
        f"  - {json.dumps(_plain(eds))}",
    ]
    return "\n".join(lines) + "\n"


def profile_name(eds: Path) -> str:
    """Return a name for the profile of an EDS file: its own, as far as names allow."""
    name = re.sub(r"[^A-Za-z0-9_-]+", "-", eds.stem).strip("-")[:32]
    return name if name[:1].isalpha() else f"drive-{name}"[:32].rstrip("-")


def _plain(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)[:120].strip()


def _identity(dictionary: ObjectDictionary) -> Iterator[str]:
    presented = Presented.of_eds(dictionary)
    known = {
        key: value
        for key, value in (
            ("device_type", presented.device_type),
            ("vendor_id", presented.vendor_id),
            ("product_code", presented.product_code),
        )
        if value is not None and 0 <= value <= 0xFFFFFFFF
    }
    parts = [f"{key}: 0x{value:08X}" for key, value in known.items()]
    if known.get("device_type", 0x10000) <= 0xFFFF:
        parts.append("low_word_only: true")
    lacking = [k for k in ("device_type", "vendor_id", "product_code") if k not in known]
    yield (
        f"identity: {{{', '.join(parts)}}}"
        + (f"   # the file does not tell {', '.join(lacking)}" if lacking else "")
    )


def _modes(dictionary: ObjectDictionary) -> Iterator[str]:
    supported = default_at(dictionary, objects.SUPPORTED_MODES.address)
    if supported:
        modes = sorted(modes_in(supported))
        yield f"# 0x6502 = 0x{supported:X}: {in_words(modes)}."
        yield f"modes: {modes}"
        if 8 not in modes:
            yield "# It has no cyclic position mode: this tool can not measure with it."
    else:
        yield "modes: unknown   # 0x6502 has no default in the file; the drive itself is asked"


def _absent(dictionary: ObjectDictionary) -> Iterator[str]:
    missing = [i for i in _EXPECTED if variable_at(dictionary, i.address) is None]
    if missing:
        yield "absent:   # standard objects that the file does not have"
        for info in missing:
            yield f'  - "{info.address.short}"   # {info.name}'
    for info in _EXPECTED:
        own = info_at(dictionary, info.address)
        if own is not None and own.type != info.type:
            yield f"# {info.address.short} ({info.name}) is {own.type}; the standard has {info.type}."


def _units(dictionary: ObjectDictionary) -> Iterator[str]:
    if variable_at(dictionary, objects.ENCODER_COUNTS.address) is None:
        yield "# Increments a motor revolution: an object that holds them, or `machine`, for"
        yield "# `encoder_counts_per_rev` of the axis."
        yield "position: unknown"
    else:
        yield 'position: {counts: "0x608F:01", revolutions: "0x608F:02"}'
    if variable_at(dictionary, objects.VELOCITY_UNIT.address) is None:
        yield "velocity: unknown   # position units/s, rpm, 0.001 rpm, or counts * 512 / 1875"
    else:
        yield 'velocity: "0x60A9"'
    if variable_at(dictionary, objects.RATED_TORQUE.address) is None:
        yield "# What 1000 in 0x6071 and 0x6077 is: `per_mille_of` an object with the rated torque, or"
        yield "# with a rated current and the motor's torque `constant`."
        yield "torque: unknown"
    else:
        yield "# What one unit of 0x6076 is in N m: CiA 402 has 0.001, some makers have not."
        yield 'torque: {per_mille_of: "0x6076", unit: N m, scale: unknown}'


def _behaviour(dictionary: ObjectDictionary) -> Iterator[str]:
    yield "# What the drive asks of SYNC (cycle times as `1 ms`), and what it does when one is missing."
    yield "sync: {shortest: unknown, longest: unknown, multiple: unknown, missing: unknown}"
    yield "interpolation: unknown   # linear: straight from one cyclic target to the next"
    yield "# From torque reference to torque (current loop and half its step), such as 0.22 ms"
    yield "torque_lag: unknown"
    yield "loop_period: unknown     # of position and velocity loop, such as 0.25 ms"
    offset = info_at(dictionary, _TORQUE_OFFSET.address)
    if offset is not None and offset.type == _TORQUE_OFFSET.type:
        yield "# Whether 0x60B2 is added to the torque at every SYNC in cyclic position mode"
        yield "torque_offset: unknown"
    else:
        yield "torque_offset: false"
    if variable_at(dictionary, objects.ABORT_CONNECTION.address) is None:
        yield "# No 0x6007, so nothing that this tool knows stops the drive when the host dies: it is"
        yield "# never moved, whatever stands here."
        yield "heartbeat_reaction: unknown"
    else:
        default = default_at(dictionary, objects.ABORT_CONNECTION.address)
        yield "# Value of 0x6007 while the machine moves: 1 fault, 2 disable voltage, 3 quick stop; the"
        yield f"# file's default is {default}."
        yield "heartbeat_reaction: unknown"
    if variable_at(dictionary, objects.ERROR_BEHAVIOUR.address) is not None:
        yield "# 0x1029:1 while it moves: 0 pre-operational, 1 no change, 2 stopped; null: as is"
        yield "error_behaviour: null"
    yield "recovery: unknown   # after a lost heartbeat: fault reset, or communication reset"


def _gains(dictionary: ObjectDictionary) -> Iterator[str]:
    yield "# Of the loops in cyclic position mode: cascade (position P, velocity PI), or pid."
    yield "structure: unknown"
    found = _candidates(dictionary)
    yield "# How gains are reached: objects, password, read-only, interpreter (the maker's own language)"
    yield "# or none."
    yield "gains_via: unknown"
    if not found:
        yield "# No object's name looks like a gain's: add the gains that the drive has as `parameters`."
        return
    yield "# Objects that look like gains, with the names that the maker gives them. Keep those of the"
    yield "# loops in use, call them position_p, velocity_p, velocity_i (or pid_p, pid_i, pid_d),"
    yield "# velocity_ff, viscous_ff, inertia_ff, in the order in which they are to be written; give"
    yield "# `unit`, `scale` (SI value of one unit) and `write` (always, or disabled). Take the others"
    yield "# out, and add those that are missing: these were found by their names alone."
    yield "parameters:"
    names: set[str] = set()
    short = Counter(_slug(variable.name) for variable in found)
    for variable in found:
        address = ObjectAddress(variable.index, variable.subindex)
        info = info_at(dictionary, address)
        if info is None:
            continue
        called = _full_name(dictionary, variable)
        yield f"  # {_plain(called)}"
        alone = short[_slug(variable.name)] == 1
        name = _unused(variable.name if alone else called, address, names)
        yield (
            f'  {name}: {{object: "{address.short}", type: {info.type}, unit: unknown, '
            "scale: unknown, write: unknown}"
        )


def _candidates(dictionary: ObjectDictionary) -> list[ODVariable]:
    found = []
    for variable in variables(dictionary):
        if not any(low <= variable.index < high for low, high in _MAKERS) or not writable(variable):
            continue
        info = info_at(dictionary, ObjectAddress(variable.index, variable.subindex))
        if info is None or info.type in ("BOOLEAN", "VISIBLE_STRING"):
            continue
        text = _full_name(dictionary, variable).replace("_", " ")
        if _GAIN.search(text) and not _NOT_A_GAIN.search(text):
            found.append(variable)
    return found[:MOST_PARAMETERS]


def _full_name(dictionary: ObjectDictionary, variable: ODVariable) -> str:
    parent = dictionary[variable.index]
    if parent is variable or str(parent.name).lower() in str(variable.name).lower():
        return str(variable.name)
    return f"{parent.name}: {variable.name}"


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")[:48].rstrip("_")


def _unused(text: str, address: ObjectAddress, names: set[str]) -> str:
    name = _slug(text)
    if not name or not name[0].isalpha() or name in names:
        name = f"x{address.index:04x}_{address.subindex:02x}"
    names.add(name)
    return name


def _store(dictionary: ObjectDictionary) -> Iterator[str]:
    has = variable_at(dictionary, objects.STORE_ALL.address) is not None
    where = "0x1010:01 exists" if has else "no 0x1010"
    yield f"# {where}. To be found out: object, `signature` (usually save), `timeout`, whether a"
    yield "# `restart` is needed, and in which `states` the drive stores; then"
    yield '#   store: {object: "0x1010:01", timeout: 10 s, restart: false, states: disabled,'
    yield "#           duration: unknown}"
    yield "store: unknown"
