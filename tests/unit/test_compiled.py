"""Kernels are compiled also for a user who may write nowhere, as in a read-only installation."""

from typing import Any

import numba.core.caching
import pytest

from drives.compiled import compiled


def inverse(x: float) -> float:
    return 1.0 / x


def test_a_kernel_without_a_folder_to_keep_it_in_is_compiled_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Nowhere(numba.core.caching.CompileResultCacheImpl):
        _locator_classes: tuple[Any, ...] = ()

    monkeypatch.setattr(numba.core.caching.FunctionCache, "_impl_class", Nowhere)
    with pytest.raises(RuntimeError, match="no locator"):
        numba.njit(cache=True)(inverse)
    kernel = compiled(error_model="numpy")(inverse)
    assert kernel(4.0) == 0.25
    assert kernel(0.0) == float("inf")
    assert kernel.signatures, "it was compiled"


def test_what_divides_by_nothing_raises_unless_the_kernel_wants_otherwise() -> None:
    def reciprocal(x: float) -> float:
        return 1.0 / x

    with pytest.raises(ZeroDivisionError):
        compiled()(reciprocal)(0.0)
