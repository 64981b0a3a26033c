"""What is on a bus: heard first, then asked, never changed.

``traffic`` sorts frames that were heard, ``asking`` reads objects with short time-outs, ``needs`` judges
what the tool would miss in a drive, ``scanning`` puts them together.
"""

from drives.scan.needs import Need
from drives.scan.scanning import Scan, ScannedNode, listened, scan
from drives.scan.traffic import Traffic

__all__ = ["Need", "Scan", "ScannedNode", "Traffic", "listened", "scan"]
