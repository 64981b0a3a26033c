"""Recordings simulated with a model: torque from the measured motion, motion from references."""
