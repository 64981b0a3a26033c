"""python-can's interfaces: which there are, and which options each takes.

python-can hands every option on, and most interfaces pass over what they do not know; a misspelled
one would be without effect and without a word.  So names and types are compared with what the
interface's class declares.
"""

import importlib
import inspect
import logging
import re
from collections.abc import Mapping
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import can
from can.interfaces import BACKENDS

from drives.errors import BusError, UserStopError
from drives.profile import SIMULATED

for _logger in ("can", "seeedbus"):  # what goes wrong is raised, not logged
    logging.getLogger(_logger).setLevel(logging.CRITICAL)

Scalar = bool | int | float | str

OURS = frozenset(
    {
        "bitrate",
        "can_filters",
        "channel",
        "fd",
        "ignore_rx_error_frames",
        "interface",
        "listen_only",
        "local_loopback",
        "machine",
        "monitor",
        "receive_own_messages",
        "self",
    }
)
"""Options that the tool sets or needs as they are; they can not be given."""
_PLAIN = (bool, int, float, str)
_UNDECLARED: Mapping[str, Mapping[str, type]] = {
    "kvaser": {
        "accept_virtual": bool,
        "driver_mode": bool,
        "exclusive": bool,
        "no_samp": int,
        "override_exclusive": bool,
        "single_handle": bool,
        "sjw": int,
        "tseg1": int,
        "tseg2": int,
    },
    "neovi": {"override_library_name": str, "serial": str, "use_system_timestamp": bool},
    "systec": {"device_number": int, "rx_buffer_entries": int, "tx_buffer_entries": int},
}
"""Options of interfaces that read them without declaring them."""
_GONE = re.compile(r"\b(modules?|packages?|librar\w*|drivers?|dlls?|not installed)\b")
EXTRAS = {
    "serial": "serial",
    "slcan": "serial",
    "robotell": "serial",
    "seeedstudio": "seeedstudio",
    "gs_usb": "gs-usb",
    "canalystii": "canalystii",
    "cantact": "cantact",
    "neovi": "neovi",
    "nixnet": "nixnet",
    "udp_multicast": "multicast",
    "usb2can": "pywin32",
    "pcan": "pcan",
}
"""Extras of python-can that an interface needs, or is better with."""
BITRATE_ELSEWHERE = frozenset(
    {"socketcan", "serial", "socketcand", "udp_multicast", "virtual", SIMULATED, "fieldreplay"}
)
"""Interfaces whose bit rate is set by somebody else, or that have none."""

BACKENDS.setdefault("fieldreplay", ("drives.replay.replay_bus", "ReplayBus"))
"""Known from its entry point too; an installation in place may be older than that."""


def bus_class(interface: str) -> type[can.BusABC]:
    """Return python-can's class for an interface.

    Raises
    ------
    BusError
        If python-can knows no such interface, or it can not be used on this computer.
    """
    if interface not in BACKENDS:
        raise BusError(
            f"python-can knows no interface {interface!r}; it knows {', '.join(sorted(BACKENDS))}. "
            "Check `interface` in the machine profile or --interface."
        )
    module, name = BACKENDS[interface]
    try:
        found: type[can.BusABC] = getattr(importlib.import_module(module), name)
    except UserStopError:
        raise
    except Exception as error:  # an interface's module raises whatever its libraries do
        raise BusError(
            f"interface {interface} can not be used on this computer: {_plain(error)}. "
            f"{_to_install(interface)}"
        ) from error
    return found


def _to_install(interface: str) -> str:
    extra = EXTRAS.get(interface)
    package = f"`pip install python-can[{extra}]` and " if extra else ""
    return f"Install what it needs: {package}the adapter's driver for this system."


def missing_package(interface: str, error: Exception) -> str:
    """Return what to install, where an error says that something is not there; else nothing."""
    gone = isinstance(error, ImportError | NotImplementedError | NameError)
    if not gone and not _GONE.search(str(error).lower()):
        return ""
    return _to_install(interface)


def _plain(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def known_options(interface: str) -> dict[str, tuple[type, ...]]:
    """Return the options that an interface takes, by name, with the types of their values.

    Raises
    ------
    BusError
        As :func:`bus_class`.
    """
    found: dict[str, tuple[type, ...]] = {
        name: (kind,) for name, kind in _UNDECLARED.get(interface, {}).items()
    }
    for cls in bus_class(interface).__mro__:
        if cls is can.BusABC:
            break
        if "__init__" not in vars(cls):
            continue
        hints = _hints(cls)
        for name, parameter in inspect.signature(vars(cls)["__init__"]).parameters.items():
            if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL) or name in OURS:
                continue
            types = _plain_types(hints.get(name), parameter.default)
            if types:
                found[name] = types
    return found


def _hints(cls: type) -> dict[str, Any]:
    try:
        return get_type_hints(vars(cls)["__init__"])
    except UserStopError:
        raise
    except Exception:  # a name of a library that is not there
        return {}


def _plain_types(hint: Any, default: object) -> tuple[type, ...]:
    """Return the plain types that an option may have; none where it has another kind of value."""
    if hint is None:
        kinds = (type(default),) if type(default) in _PLAIN else _PLAIN
    elif get_origin(hint) is Union or isinstance(hint, UnionType):
        kinds = tuple(kind for kind in get_args(hint) if kind is not NoneType)
    else:
        kinds = (hint,)
    if any(kind not in _PLAIN for kind in kinds):
        return ()
    return (*kinds, int) if float in kinds else kinds


def check_options(interface: str, options: Mapping[str, Scalar]) -> None:
    """Refuse options that the interface does not know, that are ours, or of the wrong type.

    Raises
    ------
    BusError
        Naming the option, and those that there are.
    """
    if not options:
        return
    known = known_options(interface)
    for name, value in options.items():
        if name in OURS:
            raise BusError(
                f"bus option {name}: can not be given, the tool sets it itself. Take it out of "
                "`options`."
            )
        if name not in known:
            there = ", ".join(sorted(known)) or "none"
            raise BusError(
                f"bus option {name}: python-can's interface {interface} has no such option; it has "
                f"{there}. Check its spelling or take it out."
            )
        if type(value) not in known[name]:
            wanted = " or ".join(dict.fromkeys(kind.__name__ for kind in known[name]))
            raise BusError(
                f"bus option {name}: needs a value of type {wanted}, got {value!r}. Correct it in "
                "`options`."
            )
