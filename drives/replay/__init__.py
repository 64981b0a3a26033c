"""A trace shown again: read, decoded, counted, and played to the tool in place of drives.

``reading`` reads trace files, ``sdo`` and ``decoding`` say what their frames mean, ``statistics`` counts
them, ``process_data`` rebuilds positions and torques, ``replay_bus`` answers the tool from a trace.
"""

from drives.replay.decoding import Decoded, Decoder
from drives.replay.reading import read_trace

__all__ = ["Decoded", "Decoder", "read_trace"]
