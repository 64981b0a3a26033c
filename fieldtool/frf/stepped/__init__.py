"""Responses and their quality from stepped sines."""
