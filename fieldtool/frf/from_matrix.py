"""What the classic sweeps would have measured, from the response matrix: others locked, others free.

Let G be the M x M response with all torques free to choose.  Holding the axes h still asks for the
torques that keep their positions at 0, and leaves for the moving axes a the Schur complement

    G_aa - G_ah G_hh^-1 G_ha

With every other axis held it is 1 / (G^-1)_ii, the curve A_L of the paper; with a pair moving it is
the cross-coupled one; with none held it is G itself.

The error of the result follows to first order from the covariance of all elements of G: for
S = [I, -G_ah G_hh^-1] and R = [I; -G_hh^-1 G_ha] on (a, h),  d(result) = S dG R.

Valid for: a matrix whose held part is not singular (a held axis moves when its torque does).
Sensitivity: near frequencies where the held axes alone resonate G_hh is large and its inverse small,
no harm; near their antiresonances the errors grow, which the standard error shows.
"""

from collections.abc import Sequence

import numpy as np

from fieldtool.frf.matrix import OTHERS_FREE, OTHERS_LOCKED
from fieldtool.frf.phasors import ComplexArray
from fieldtool.frf.response import FrequencyResponse


def locked_response(
    response: FrequencyResponse, moving: str | int | Sequence[str | int]
) -> FrequencyResponse:
    """Return the response of one or several axes with all others locked.

    Parameters
    ----------
    response
        The whole matrix; with its covariance, errors are propagated in full, without it as
        independent.
    moving
        The axis, or the axes, that are not locked.

    Returns
    -------
    FrequencyResponse
        Of all M axes, NaN for the locked ones, at the frequencies where the whole matrix was
        measured; condition ``others locked``, ``a + b free, others locked``, or ``others free``.

    Raises
    ------
    KeyError
        If there is no axis of that name.
    ValueError
        If no axis moves, or one is named twice.
    """
    names = [moving] if isinstance(moving, str | int) else list(moving)
    free = sorted(response.index(name) for name in names)
    if not free or len(set(free)) != len(free):
        raise ValueError(f"axes that move must be named once each, got {names}")
    M = len(response.axes)
    held = [axis for axis in range(M) if axis not in free]
    whole = np.all(response.measured.reshape(-1, M * M), axis=1)
    G = response.response[whole]
    left, right = _sides(G, free, held)
    values = left @ G @ right
    small = len(free)
    # d(result)[p, q] = sum over i, j of left[p, i] right[j, q] dG[i, j]
    sensitivity = np.einsum("fpi,fjq->fpqij", left, right).reshape(-1, small * small, M * M)
    covariance = (
        sensitivity @ _covariance(response)[whole] @ np.conj(np.swapaxes(sensitivity, 1, 2))
    )
    return _embedded(response, whole, free, values, covariance)


def locked_responses(response: FrequencyResponse) -> dict[str, FrequencyResponse]:
    """Return the locked, pairwise free and free responses, by condition.

    As the classic sweeps give them: ``others locked`` with each axis' own curve on the diagonal,
    ``a + b free, others locked`` for every pair if there are more than two axes, ``others free``.
    """
    M = len(response.axes)
    found = {}
    if M > 1:
        found[OTHERS_LOCKED] = _diagonal([locked_response(response, axis) for axis in range(M)])
    if M > 2:
        for a in range(M):
            for b in range(a + 1, M):
                pair = locked_response(response, (a, b))
                found[pair.condition] = pair
    free = locked_response(response, range(M))
    found[free.condition] = free
    return found


def _sides(G: ComplexArray, free: list[int], held: list[int]) -> tuple[ComplexArray, ComplexArray]:
    """Return S (F, a, M) and R (F, M, a) with result = S G R."""
    F, M, small = G.shape[0], G.shape[1], len(free)
    left = np.zeros((F, small, M), dtype=np.complex128)
    right = np.zeros((F, M, small), dtype=np.complex128)
    left[:, range(small), free] = 1.0
    right[:, free, range(small)] = 1.0
    if held:
        inner = G[:, held][:, :, held]
        across, back = G[:, free][:, :, held], G[:, held][:, :, free]
        left[:, :, held] = -np.swapaxes(
            np.linalg.solve(np.swapaxes(inner, 1, 2), np.swapaxes(across, 1, 2)), 1, 2
        )
        right[:, held] = -np.linalg.solve(inner, back)
    return left, right


def _covariance(response: FrequencyResponse) -> ComplexArray:
    if response.covariance is not None:
        return response.covariance
    M = len(response.axes)
    variance = (response.complex_std**2).reshape(-1, M * M)
    diagonal: ComplexArray = (variance[:, :, None] * np.eye(M * M)).astype(np.complex128)
    return diagonal


def _embedded(
    response: FrequencyResponse,
    whole: np.typing.NDArray[np.bool_],
    free: list[int],
    values: ComplexArray,
    covariance: ComplexArray,
) -> FrequencyResponse:
    """Place the small matrices among all axes, NaN elsewhere."""
    F, M = values.shape[0], len(response.axes)
    full = np.full((F, M, M), np.nan + 1j * np.nan)
    full[np.ix_(range(F), free, free)] = values
    spread = np.full((F, M * M, M * M), np.nan + 1j * np.nan)
    places = [i * M + j for i in free for j in free]
    spread[np.ix_(range(F), places, places)] = covariance
    std = np.sqrt(np.einsum("fkk->fk", spread).real / 2).reshape(F, M, M)
    return FrequencyResponse(
        response.axes, response.frequencies[whole], full, std, _condition(response, free), spread
    )


def _condition(response: FrequencyResponse, free: list[int]) -> str:
    if len(free) == len(response.axes):
        return OTHERS_FREE
    if len(free) == 1:
        return OTHERS_LOCKED
    return f"{' + '.join(response.axes[axis] for axis in free)} free, {OTHERS_LOCKED}"


def _diagonal(single: list[FrequencyResponse]) -> FrequencyResponse:
    """Join the locked curves of the axes in one response; their errors are not told together."""
    values = np.array(single[0].response)
    std = np.array(single[0].std)
    for axis, one in enumerate(single):
        values[:, axis, axis] = one.response[:, axis, axis]
        std[:, axis, axis] = one.std[:, axis, axis]
    return FrequencyResponse(single[0].axes, single[0].frequencies, values, std, OTHERS_LOCKED)
