"""One bus, one master: two processes of the tool on one computer never command the same drives.

Another computer's master is heard on the bus, where it commands; between its motions nothing is to be
heard.  On this computer a lock says so at any time, before anything is sent.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from filelock import FileLock, Timeout

from drives.bus.adapters import bus_class
from drives.canopen_drive import CanopenGroup, connect
from drives.profile import BusProfile, MachineProfile
from fieldtool.errors import UnfinishedWriteError
from fieldtool.writeback.unfinished import state_folder


@contextmanager
def alone_on(bus: BusProfile) -> Iterator[None]:
    """Hold a bus for this process, until the end of the ``with``; a killed one holds nothing.

    Where no lock can be made (no room, no rights), nothing is held, and nothing refused.

    Raises
    ------
    UnfinishedWriteError
        If another process of this computer's user holds it; nothing was sent.
    """
    if getattr(bus_class(bus.interface), "of_this_process", False):
        yield
        return
    name = " ".join(str(part) for part in (bus.interface, bus.channel) if part is not None)
    what = [name]
    if (
        bus.interface != "socketcan"
    ):  # there the channel is the hardware; elsewhere an option may be
        what += [f"{key} {value}" for key, value in sorted(bus.options.items())]
    folder = state_folder("buses")
    lock = FileLock(folder / f"{re.sub(r'[^A-Za-z0-9_.-]', '_', ' '.join(what))[:100]}.lock")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
    except Timeout:
        raise UnfinishedWriteError(
            f"bus {name}: another fieldtool is at work on it, and two masters must not command one "
            "machine. Wait until it has ended, or stop it there with Ctrl-C. Nothing was moved or "
            "written."
        ) from None
    except OSError:
        pass
    try:
        yield
    finally:
        lock.release()


@contextmanager
def connected(machine: MachineProfile, **options: Any) -> Iterator[CanopenGroup]:
    """Connect to a machine's drives as ``drives.canopen_drive.connect`` does, alone on its bus.

    Raises
    ------
    UnfinishedWriteError
        If another process uses it.
    DrivesError
        As of ``connect``.
    """
    with alone_on(machine.bus), connect(machine, **options) as group:
        yield group
