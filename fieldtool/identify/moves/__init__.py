"""Machines from recordings without a period."""
