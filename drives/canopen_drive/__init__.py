"""The one implementation of drives over CANopen, for real and for simulated ones alike.

``line`` sends and receives, ``drive`` speaks with one drive, ``group`` with all of a machine,
``motion`` streams targets and watches limits.
"""

from drives.canopen_drive.drive import CanopenDrive
from drives.canopen_drive.group import CanopenGroup, connect
from drives.canopen_drive.motion import CanopenMotion

__all__ = ["CanopenDrive", "CanopenGroup", "CanopenMotion", "connect"]
