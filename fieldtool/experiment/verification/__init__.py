"""Test new loops on the machine: watch first, then hold, then the smallest move, then the rest."""
