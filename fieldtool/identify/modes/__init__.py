"""Common modes of a response matrix: how many there are, where, and their shapes."""
