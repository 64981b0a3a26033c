"""Machines from multisines of all axes under closed loops, and what a pilot tells."""
