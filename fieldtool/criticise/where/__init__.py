"""Where a simulation is wrong: by frequency, amplitude, lines, speed, position, time, axis and pair."""
