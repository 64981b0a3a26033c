"""Rigid body and vibration modes as the motors see them.

    G(s) = inv(s**2 inv(R0) + s F)  +  sum_r N_r(s) / (s**2 + 2 zeta_r w_r s + w_r**2)
    N_r(s) = P_r + Q_r (s + zeta_r w_r) / (w_r sqrt(1 - zeta_r**2))
    P_r = phi_r phi_r' - chi_r chi_r',    Q_r = phi_r chi_r' + chi_r phi_r'

with s = jw, times exp(-jw d_j) for each torque.  chi is 0 where dampers are proportional to
springs (all masses pass their rest position together); otherwise it is small, and phi and w are
those of the undamped machine up to its square.

Motor friction couples vibration to the rigid body: to first order it takes X / s from G, with
X = R0 F Y + Y F R0 and Y = sum_r phi_r phi_r' / w_r**2, and makes sum_r Q_r / w_r = X.  Where
friction acts at loads too, X is not known from F; then that sum itself is X.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fieldtool.identify.likelihood.least_squares import standard_errors

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class ModalParts:
    """Which numbers there are: the layout of the parameter vector.

    Order: w, zeta, phi (axis by axis), chi (if any), R0 (upper triangle of measured pairs),
    friction (if any), delays (if any).
    """

    modes: int
    pairs: NDArray[np.bool_]
    """Pairs of axes with data, shape (M, M), symmetric."""
    general: bool
    """Whether modes may be out of phase (chi)."""
    friction: bool
    delay: bool
    load_friction: bool = False
    """Whether friction may also act at other masses than the motors'; only with `friction`."""

    @property
    def axes(self) -> int:
        """M."""
        return int(self.pairs.shape[0])

    @cached_property
    def upper(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns of R0 that are parameters."""
        i, j = np.nonzero(np.triu(self.pairs))
        return i, j

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Where each part stands."""
        shape = self.axes * self.modes
        sizes = {
            "omega": self.modes,
            "zeta": self.modes,
            "phi": shape,
            "chi": shape if self.general else 0,
            "rigid": self.upper[0].size,
            "friction": self.axes if self.friction else 0,
            "delay": self.axes if self.delay else 0,
        }
        ends = np.cumsum(list(sizes.values()))
        return {
            name: slice(int(end) - size, int(end))
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }

    @property
    def count(self) -> int:
        """P, the number of parameters."""
        return int(self.slices["delay"].stop)


@dataclass(frozen=True, eq=False)
class ModalModel:
    """Modes of a machine, with the covariance of everything."""

    names: tuple[str, ...]
    """Axes."""
    parts: ModalParts
    omega: FloatArray
    """w_r, shape (n,), rad/s, rising."""
    zeta: FloatArray
    """Damping ratios, shape (n,)."""
    phi: FloatArray
    """Shape (M, n), 1/sqrt(kg) or 1/sqrt(kg m2), normalised to the mass matrix."""
    chi: FloatArray
    """Out-of-phase part, shape (M, n), unit of phi."""
    rigid: FloatArray
    """R0, shape (M, M), 1/kg or 1/(kg m2): inverse of chain masses and couplings; NaN where not
    measured."""
    friction: FloatArray
    """F, viscous friction of each axis, shape (M,), N s/m or N m s/rad."""
    delays: FloatArray
    """Shape (M,), s."""
    covariance: FloatArray
    """Of the parameters in the order of `parts`, shape (P, P)."""
    chi2: float
    degrees_of_freedom: int

    @property
    def excess(self) -> float:
        """Misfit over what noise explains: near 1 where model and noise are right."""
        return self.chi2 / self.degrees_of_freedom

    @property
    def parameters(self) -> FloatArray:
        """Parameter vector, shape (P,)."""
        pieces = [self.omega, self.zeta, self.phi.ravel()]
        if self.parts.general:
            pieces.append(self.chi.ravel())
        pieces.append(self.rigid[self.parts.upper])
        if self.parts.friction:
            pieces.append(self.friction)
        if self.parts.delay:
            pieces.append(self.delays)
        return np.concatenate(pieces)

    @property
    def significance(self) -> FloatArray:
        """Largest component of each mode in standard errors, shape (n,).

        Below about 5 a mode may be nothing but noise: the fit always finds as many as it is told.
        """
        std = self.std("phi").reshape(self.phi.shape)
        ratios = np.divide(np.abs(self.phi), std, out=np.full(std.shape, np.inf), where=std > 0.0)
        return np.asarray(ratios.max(axis=0, initial=0.0), dtype=np.float64)

    def std(self, part: str) -> FloatArray:
        """Standard errors of one part: omega, zeta, phi, chi, rigid, friction or delay.

        Shapes are those of the part; for ``rigid`` that of the measured upper triangle.
        """
        values = standard_errors(self.covariance)[self.parts.slices[part]]
        return values.reshape(self.phi.shape) if part in ("phi", "chi") and values.size else values

    def response(self, omega: FloatArray) -> ComplexArray:
        """G at frequencies in rad/s, shape (F, M, M); NaN where R0 is not known."""
        return modal_response(self.parts, self.parameters, omega)


@dataclass(frozen=True, eq=False)
class ModalValues:
    """The parameter vector taken apart."""

    omega: FloatArray
    zeta: FloatArray
    phi: FloatArray
    chi: FloatArray
    rigid: FloatArray
    friction: FloatArray
    delays: FloatArray


def take_apart(parts: ModalParts, x: FloatArray) -> ModalValues:
    """Parameter vector to named arrays; R0 is NaN at pairs that are not measured."""
    at = parts.slices
    shape = (parts.axes, parts.modes)
    rigid = np.full((parts.axes, parts.axes), np.nan)
    rigid[parts.upper] = x[at["rigid"]]
    rigid.T[parts.upper] = x[at["rigid"]]
    return ModalValues(
        omega=x[at["omega"]],
        zeta=x[at["zeta"]],
        phi=x[at["phi"]].reshape(shape),
        chi=x[at["chi"]].reshape(shape) if parts.general else np.zeros(shape),
        rigid=rigid,
        friction=x[at["friction"]] if parts.friction else np.zeros(parts.axes),
        delays=x[at["delay"]] if parts.delay else np.zeros(parts.axes),
    )


def modal_response(parts: ModalParts, x: FloatArray, omega: FloatArray) -> ComplexArray:
    """G of a parameter vector, shape (F, M, M)."""
    v = take_apart(parts, x)
    s = (1j * omega[:, None]).astype(np.complex128)
    shape = _ModeShapes(v, s)
    flexible = np.einsum("fr,ijr->fij", shape.inverse, shape.in_phase) + np.einsum(
        "fr,ijr->fij", shape.inverse * shape.swing, shape.out_of_phase
    )
    response: ComplexArray = _rigid(v, omega) + flexible
    if parts.general and parts.friction:
        share = shape.start_velocity if parts.load_friction else friction_share(v)
        response = response - share / s[:, :, None]
    return response * np.exp(-s * v.delays)[:, None, :]


def _root(zeta: FloatArray) -> FloatArray:
    """Damped over undamped frequency; held away from 0 while a fit strays there."""
    return np.sqrt(np.maximum(1.0 - zeta**2, 0.1))


def friction_share(v: ModalValues) -> FloatArray:
    """X = R0 F Y + Y F R0, what friction at the motors passes between rigid body and modes, (M, M)."""
    half = (v.rigid * v.friction) @ ((v.phi / v.omega**2) @ v.phi.T)
    return np.asarray(half + half.T, dtype=np.float64)


def friction_share_derivatives(parts: ModalParts, v: ModalValues) -> FloatArray:
    """Derivatives of :func:`friction_share` by every parameter, shape (M, M, P)."""
    at, axes = parts.slices, parts.axes
    left = v.rigid * v.friction  # R0 F
    compliance = (v.phi / v.omega**2) @ v.phi.T
    half = np.zeros((axes, axes, parts.count))
    for r in range(parts.modes):
        shape = v.phi[:, r]
        half[:, :, at["omega"].start + r] = -2.0 / v.omega[r] ** 3 * np.outer(left @ shape, shape)
        for a in range(axes):
            column = at["phi"].start + a * parts.modes + r
            half[:, :, column] += np.outer(left[:, a], shape) / v.omega[r] ** 2
            half[:, a, column] += left @ shape / v.omega[r] ** 2
    for k, (i, j) in enumerate(zip(*parts.upper, strict=True)):
        half[i, :, at["rigid"].start + k] += v.friction[j] * compliance[j]
        if i != j:
            half[j, :, at["rigid"].start + k] += v.friction[i] * compliance[i]
    for a in range(axes):
        half[:, :, at["friction"].start + a] = np.outer(v.rigid[:, a], compliance[a])
    return np.asarray(half + half.transpose(1, 0, 2), dtype=np.float64)


def start_velocity_derivatives(parts: ModalParts, v: ModalValues) -> FloatArray:
    """Derivatives of sum_r Q_r / (w_r sqrt(1 - zeta_r**2)) by every parameter, shape (M, M, P)."""
    at, damped = parts.slices, v.omega * _root(v.zeta)
    products = (v.phi[:, None] * v.chi[None] + v.chi[:, None] * v.phi[None]) / damped
    result = np.zeros((parts.axes, parts.axes, parts.count))
    result[..., at["omega"]] = -products / v.omega
    result[..., at["zeta"]] = products * v.zeta / _root(v.zeta) ** 2
    for a in range(parts.axes):
        for name, other in (("phi", v.chi), ("chi", v.phi)):
            columns = slice(
                at[name].start + a * parts.modes, at[name].start + (a + 1) * parts.modes
            )
            result[a, :, columns] += other / damped
            result[:, a, columns] += other / damped
    return result


class _ModeShapes:
    """Factors of the modes at s, shape (F, 1)."""

    def __init__(self, v: ModalValues, s: ComplexArray) -> None:
        self.inverse = 1.0 / (s**2 + 2.0 * v.zeta * v.omega * s + v.omega**2)
        self.damped = v.omega * _root(v.zeta)
        self.swing = (s + v.zeta * v.omega) / self.damped
        phi, chi = v.phi, v.chi
        self.in_phase = phi[:, None] * phi[None] - chi[:, None] * chi[None]
        self.out_of_phase = phi[:, None] * chi[None] + chi[:, None] * phi[None]

    @property
    def start_velocity(self) -> FloatArray:
        """sum_r Q_r / (w_r sqrt(1 - zeta_r**2)), shape (M, M)."""
        return np.asarray((self.out_of_phase / self.damped).sum(axis=2), dtype=np.float64)


def _rigid(v: ModalValues, omega: FloatArray) -> ComplexArray:
    """inv(s**2 inv(R0) + s F), shape (F, M, M)."""
    w = omega[:, None, None]
    if not np.any(v.friction):
        return (v.rigid / (-(w**2))).astype(np.complex128)
    mass = np.linalg.inv(v.rigid)
    result: ComplexArray = np.linalg.inv(-(w**2) * mass + 1j * w * np.diag(v.friction))
    return result


def modal_derivatives(parts: ModalParts, x: FloatArray, omega: FloatArray) -> ComplexArray:
    """Derivatives of G by every parameter, shape (F, M, M, P)."""
    v = take_apart(parts, x)
    s = (1j * omega[:, None]).astype(np.complex128)
    shape = _ModeShapes(v, s)
    derivatives = np.zeros((omega.size, parts.axes, parts.axes, parts.count), complex)
    _by_poles(derivatives, parts, v, s, shape)
    _by_shapes(derivatives, parts, v, shape)
    _by_rigid(derivatives, parts, v, omega)
    if parts.general and parts.friction:
        share = (start_velocity_derivatives if parts.load_friction else friction_share_derivatives)(
            parts, v
        )
        derivatives -= share / s[:, :, None, None]
    derivatives *= np.exp(-s * v.delays)[:, None, :, None]
    if parts.delay:
        response = modal_response(parts, x, omega)
        for j in range(parts.axes):
            column = parts.slices["delay"].start + j
            derivatives[:, :, j, column] = -s * response[:, :, j]
    return derivatives


def _by_poles(
    out: ComplexArray, parts: ModalParts, v: ModalValues, s: ComplexArray, shape: _ModeShapes
) -> None:
    """By w and zeta: of the denominator, and of the factor of Q."""
    root = _root(v.zeta)
    slope = {
        "omega": (2.0 * v.zeta * s + 2.0 * v.omega, -s / (v.omega**2 * root)),
        "zeta": (2.0 * v.omega * s, 1.0 / root + shape.swing * v.zeta / root**2),
    }
    for name, (of_denominator, of_swing) in slope.items():
        both = -(shape.inverse**2) * of_denominator
        out[..., parts.slices[name]] = np.einsum("fr,ijr->fijr", both, shape.in_phase)
        if parts.general:
            factor = both * shape.swing + shape.inverse * of_swing
            out[..., parts.slices[name]] += np.einsum("fr,ijr->fijr", factor, shape.out_of_phase)


def _by_shapes(out: ComplexArray, parts: ModalParts, v: ModalValues, shape: _ModeShapes) -> None:
    """By phi and chi: row a and column a of each mode's matrices move."""
    swinging = shape.inverse * shape.swing
    for a in range(parts.axes):
        columns = slice(
            parts.slices["phi"].start + a * parts.modes,
            parts.slices["phi"].start + (a + 1) * parts.modes,
        )
        row = np.einsum("fr,jr->fjr", shape.inverse, v.phi)
        if parts.general:
            row = row + np.einsum("fr,jr->fjr", swinging, v.chi)
        out[:, a, :, columns] += row
        out[:, :, a, columns] += row
        if parts.general:
            offset = parts.slices["chi"].start - parts.slices["phi"].start
            columns = slice(columns.start + offset, columns.stop + offset)
            row = np.einsum("fr,jr->fjr", swinging, v.phi) - np.einsum(
                "fr,jr->fjr", shape.inverse, v.chi
            )
            out[:, a, :, columns] += row
            out[:, :, a, columns] += row


def _by_rigid(out: ComplexArray, parts: ModalParts, v: ModalValues, omega: FloatArray) -> None:
    """By R0 and friction."""
    square = -(omega**2)
    rigid = _rigid(v, omega)
    left: ComplexArray
    right: ComplexArray
    if parts.friction:
        mass = np.linalg.inv(v.rigid)
        left, right = rigid @ mass, mass @ rigid
    else:
        left = (np.eye(parts.axes) / square[:, None, None]).astype(np.complex128)
        right = left
    start = parts.slices["rigid"].start
    for k, (i, j) in enumerate(zip(*parts.upper, strict=True)):
        change = left[:, :, i, None] * right[:, None, j, :]
        if i != j:
            change = change + left[:, :, j, None] * right[:, None, i, :]
        out[..., start + k] = square[:, None, None] * change
    if parts.friction:
        for a in range(parts.axes):
            out[..., parts.slices["friction"].start + a] = (
                -1j * omega[:, None, None] * rigid[:, :, a, None] * rigid[:, None, a, :]
            )
