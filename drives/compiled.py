"""Numeric kernels, compiled by numba, and kept on disk where there is a place for it."""

from collections.abc import Callable
from typing import Any

from numba import njit


def compiled(*, error_model: str = "python") -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that has a function compiled when it is first called.

    What is compiled is kept for the next process, beside the file or in the user's cache folder.
    Where neither can be written it is compiled once a process.

    Parameters
    ----------
    error_model
        ``numpy``: a division by 0 is infinite or no number; ``python``: it raises ZeroDivisionError.
    """

    def decorated(kernel: Callable[..., Any]) -> Any:
        try:
            return njit(cache=True, error_model=error_model)(kernel)
        except RuntimeError:  # numba finds no folder
            return njit(error_model=error_model)(kernel)

    return decorated
