"""Criticism: what the simulation of a machine gets wrong, why, and what is gained by knowing."""
