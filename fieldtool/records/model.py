"""The elastic model of a machine: chains of masses and springs, coupled at their last masses.

Axis i is a chain that its motor drives at the first mass; inertia couplings m_ab join last masses::

    tau_i -> [ m1 ]--k1--[ m2 ]--k2-- ... --[ mN ]~~ m_ab ~~[ last mass of another chain ]

The equation of motion is M q'' + C q' + K q = tau (paper, equations 1 and 10).  Degrees of freedom
run chain after chain, motor side first.  SI units: kg, N/m, N s/m on linear axes; kg m2, N m/rad,
N m s/rad on rotary ones.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite, isnan, nan
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Kind = Literal["rotary", "linear"]
FORMAT = "fieldtool-model/1"


@dataclass(frozen=True)
class Estimate:
    """A number and what is known of its error."""

    value: float
    std: float = nan
    """Standard error, same unit; infinite where the data tell nothing, NaN where nobody told it."""


@dataclass(frozen=True)
class AxisModel:
    """One chain, motor side first."""

    name: str
    kind: Kind
    masses: tuple[Estimate, ...]
    """N masses, kg or kg m2."""
    springs: tuple[Estimate, ...]
    """N - 1 springs, N/m or N m/rad; spring k joins masses k and k + 1."""
    dampers: tuple[Estimate, ...] = ()
    """N - 1 dampers beside the springs, N s/m or N m s/rad; empty where they are not known."""
    viscous_friction: Estimate = Estimate(0.0)
    """Between the first mass and ground, N s/m or N m s/rad."""
    load_friction: Estimate = Estimate(0.0)
    """Viscous, between the last mass and ground, N s/m or N m s/rad."""

    def __post_init__(self) -> None:
        if not self.masses:
            raise ValueError(f"axis {self.name}: a chain has at least one mass")
        if len(self.springs) != len(self.masses) - 1:
            raise ValueError(
                f"axis {self.name}: {len(self.masses)} masses need {len(self.masses) - 1} springs, "
                f"got {len(self.springs)}"
            )
        if self.dampers and len(self.dampers) != len(self.springs):
            raise ValueError(
                f"axis {self.name}: {len(self.springs)} springs need as many dampers, "
                f"got {len(self.dampers)}"
            )

    @property
    def total_mass(self) -> float:
        """Sum of the chain's masses, kg or kg m2."""
        return sum(m.value for m in self.masses)

    @property
    def total_friction(self) -> float:
        """Viscous friction of its first and its last mass, N m s/rad or N s/m; less than 0 is none."""
        return max(self.viscous_friction.value + self.load_friction.value, 0.0)


@dataclass(frozen=True)
class Coupling:
    """Off-diagonal entry of the mass matrix between the last masses of two chains."""

    axes: tuple[str, str]
    value: float
    std: float = nan


@dataclass(frozen=True)
class Correlation:
    """How the errors of a model's numbers hang together."""

    names: tuple[str, ...]
    """``x.mass[1]``, ``x.spring[1]``, ``x.damper[1]`` (motor side first), ``x.viscous_friction``,
    ``x.load_friction``, ``coupling[x,y]``."""
    rows: tuple[tuple[float, ...], ...]
    """Lower triangle: row k has k + 1 numbers, its last one is 1."""

    def __post_init__(self) -> None:
        if [len(row) for row in self.rows] != list(range(1, len(self.names) + 1)):
            raise ValueError("correlation needs one row a name, of 1, 2, 3 ... numbers")
        if any(abs(number) > 1 for row in self.rows for number in row):
            raise ValueError("correlation has a number outside of -1 to 1")
        if any(row[-1] != 1 for row in self.rows):
            raise ValueError("each row of correlation has to end with 1")

    @property
    def matrix(self) -> FloatArray:
        """Symmetric, shape (P, P)."""
        out = np.zeros((len(self.names),) * 2)
        for k, row in enumerate(self.rows):
            out[k, : k + 1] = out[: k + 1, k] = row
        return out


@dataclass(frozen=True)
class MachineModel:
    """Chains and their couplings: what ``model.yaml`` holds."""

    axes: tuple[AxisModel, ...]
    couplings: tuple[Coupling, ...] = ()
    effects: tuple[Mapping[str, Any], ...] = field(default=())
    """Named additions, as ``model.yaml`` has them: effect, axis, parameters."""
    correlation: Correlation | None = None
    """Of the errors; None: not known."""

    def __post_init__(self) -> None:
        names = [axis.name for axis in self.axes]
        if len(set(names)) != len(names):
            raise ValueError(f"axis names must differ, got {names}")
        for coupling in self.couplings:
            a, b = coupling.axes
            if a == b or a not in names or b not in names:
                raise ValueError(f"coupling {a} - {b} does not join two axes of {names}")

    @property
    def numbers(self) -> dict[str, Estimate]:
        """Masses, springs, dampers, viscous frictions and couplings by their names in a correlation."""
        out: dict[str, Estimate] = {}
        for axis in self.axes:
            for what, chain in (
                ("mass", axis.masses),
                ("spring", axis.springs),
                ("damper", axis.dampers),
            ):
                out |= {f"{axis.name}.{what}[{k + 1}]": one for k, one in enumerate(chain)}
            out[f"{axis.name}.viscous_friction"] = axis.viscous_friction
            out[f"{axis.name}.load_friction"] = axis.load_friction
        for one in self.couplings:
            out[f"coupling[{one.axes[0]},{one.axes[1]}]"] = Estimate(one.value, one.std)
        return out

    def with_numbers(self, new: Mapping[str, Estimate]) -> "MachineModel":
        """Return the model with other numbers; those that are not named stay."""
        known = self.numbers | dict(new)

        def chain(axis: AxisModel, what: str, count: int) -> tuple[Estimate, ...]:
            return tuple(known[f"{axis.name}.{what}[{k + 1}]"] for k in range(count))

        axes = tuple(
            replace(
                axis,
                masses=chain(axis, "mass", len(axis.masses)),
                springs=chain(axis, "spring", len(axis.springs)),
                dampers=chain(axis, "damper", len(axis.dampers)),
                viscous_friction=known[f"{axis.name}.viscous_friction"],
                load_friction=known[f"{axis.name}.load_friction"],
            )
            for axis in self.axes
        )
        coupled = [known[f"coupling[{c.axes[0]},{c.axes[1]}]"] for c in self.couplings]
        couplings = tuple(
            replace(c, value=one.value, std=one.std)
            for c, one in zip(self.couplings, coupled, strict=True)
        )
        return replace(self, axes=axes, couplings=couplings)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the axes in order."""
        return tuple(axis.name for axis in self.axes)

    @property
    def first_masses(self) -> NDArray[np.intp]:
        """Degree of freedom of each motor, shape (M,)."""
        counts = [0, *(len(axis.masses) for axis in self.axes[:-1])]
        return np.cumsum(counts).astype(np.intp)

    @property
    def last_masses(self) -> NDArray[np.intp]:
        """Degree of freedom of each chain's last mass, shape (M,)."""
        return np.cumsum([len(axis.masses) for axis in self.axes]).astype(np.intp) - 1

    @property
    def mass_matrix(self) -> FloatArray:
        """M, shape (n, n), n the number of all masses."""
        matrix = np.diag([m.value for axis in self.axes for m in axis.masses]).astype(np.float64)
        last = dict(zip(self.names, self.last_masses, strict=True))
        for coupling in self.couplings:
            a, b = (last[name] for name in coupling.axes)
            matrix[a, b] += coupling.value
            matrix[b, a] += coupling.value
        return matrix

    @property
    def stiffness_matrix(self) -> FloatArray:
        """K, shape (n, n)."""
        return self._between_neighbours([axis.springs for axis in self.axes])

    @property
    def damping_matrix(self) -> FloatArray:
        """C, shape (n, n): dampers beside the springs, viscous friction at motors and loads."""
        matrix = self._between_neighbours([axis.dampers for axis in self.axes])
        for first, last, axis in zip(self.first_masses, self.last_masses, self.axes, strict=True):
            matrix[first, first] += axis.viscous_friction.value
            matrix[last, last] += axis.load_friction.value
        return matrix

    def _between_neighbours(self, elements: Sequence[tuple[Estimate, ...]]) -> FloatArray:
        n = sum(len(axis.masses) for axis in self.axes)
        matrix = np.zeros((n, n))
        for first, chain in zip(self.first_masses, elements, strict=True):
            for k, element in enumerate(chain):
                a = first + k
                matrix[np.ix_([a, a + 1], [a, a + 1])] += element.value * np.array(
                    [[1.0, -1.0], [-1.0, 1.0]]
                )
        return matrix

    def as_dict(self) -> dict[str, Any]:
        """Plain values in the form of ``model.yaml``; an infinite error is null, NaN is left out."""
        return {
            "format": FORMAT,
            "axes": [
                {
                    "name": axis.name,
                    "kind": axis.kind,
                    "masses": [_plain(e) for e in axis.masses],
                    "springs": [_plain(e) for e in axis.springs],
                    "dampers": [_plain(e) for e in axis.dampers],
                }
                for axis in self.axes
            ],
            "couplings": [
                {"axes": list(c.axes), **_plain(Estimate(c.value, c.std))} for c in self.couplings
            ],
            "effects": [
                *(_friction(axis) for axis in self.axes if _has_friction(axis)),
                *(dict(effect) for effect in self.effects),
            ],
            **({} if self.correlation is None else {"correlation": _triangle(self.correlation)}),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "MachineModel":
        """Inverse of :meth:`as_dict`.

        Raises
        ------
        ValueError
            If a key is missing or unknown, a value is no finite number, or friction is on no axis.
        """
        try:
            return cls._from_dict(data)
        except KeyError as error:
            raise ValueError(f"{error} is missing") from None

    @classmethod
    def _from_dict(cls, data: Mapping[str, Any]) -> "MachineModel":
        _only_keys(data, {"format", "axes", "couplings", "effects", "correlation"}, "model")
        if data.get("format") != FORMAT:
            raise ValueError(f"format must be {FORMAT}, got {data.get('format')!r}")
        names = [str(axis["name"]) for axis in data["axes"]]
        friction: dict[str, Mapping[str, Any]] = {}
        effects: list[Mapping[str, Any]] = []
        for effect in data.get("effects") or ():
            if effect.get("effect") == "viscous_friction":
                if effect["axis"] not in names:
                    raise ValueError(
                        f"viscous friction is on axis {effect['axis']!r}, the axes are {names}"
                    )
                friction[effect["axis"]] = effect["parameters"]
            else:
                effects.append(effect)
        axes = []
        none: Mapping[str, Any] = {}
        for axis in data["axes"]:
            held = friction.get(str(axis["name"]), none)
            _only_keys(axis, {"name", "kind", "masses", "springs", "dampers"}, "axis")
            if axis["kind"] not in ("rotary", "linear"):
                raise ValueError(f"kind must be rotary or linear, got {axis['kind']!r}")
            axes.append(
                AxisModel(
                    name=str(axis["name"]),
                    kind=axis["kind"],
                    masses=tuple(_estimate(e) for e in axis["masses"]),
                    springs=tuple(_estimate(e) for e in axis.get("springs") or ()),
                    dampers=tuple(_estimate(e) for e in axis.get("dampers") or ()),
                    viscous_friction=_estimate(held.get("coefficient", 0.0)),
                    load_friction=_estimate(held.get("load_coefficient", 0.0)),
                )
            )
        couplings = []
        for coupling in data.get("couplings") or ():
            a, b = coupling["axes"]
            e = _estimate({k: v for k, v in coupling.items() if k != "axes"})
            couplings.append(Coupling((str(a), str(b)), e.value, e.std))
        model = cls(tuple(axes), tuple(couplings), tuple(effects))
        return replace(model, correlation=_correlation(data.get("correlation"), model))


def _triangle(correlation: Correlation) -> dict[str, Any]:
    return {"names": list(correlation.names), "rows": [list(row) for row in correlation.rows]}


def _correlation(data: Any, model: MachineModel) -> Correlation | None:
    if data is None:
        return None
    _only_keys(data, {"names", "rows"}, "correlation")
    names = tuple(str(name) for name in data["names"])
    unknown = set(names) - set(model.numbers)
    if unknown or len(set(names)) != len(names):
        raise ValueError(
            f"correlation names {sorted(unknown) or 'a number twice'}; known are {sorted(model.numbers)}"
        )
    return Correlation(names, tuple(tuple(_number(n) for n in row) for row in data["rows"]))


def _has_friction(axis: AxisModel) -> bool:
    return axis.viscous_friction.value != 0.0 or axis.load_friction.value != 0.0


def _friction(axis: AxisModel) -> dict[str, Any]:
    unit = {"unit": "N m s/rad" if axis.kind == "rotary" else "N s/m"}
    parameters = {"coefficient": _plain(axis.viscous_friction) | unit}
    if axis.load_friction.value != 0.0:
        parameters["load_coefficient"] = _plain(axis.load_friction) | unit
    return {"effect": "viscous_friction", "axis": axis.name, "parameters": parameters}


def _plain(estimate: Estimate) -> dict[str, float | None]:
    value, std = float(estimate.value), float(estimate.std)
    if isnan(std):
        return {"value": value}
    return {"value": value, "std": std if isfinite(std) else None}


def _estimate(data: Any) -> Estimate:
    if isinstance(data, Mapping):
        _only_keys(data, {"value", "std", "unit"}, "number")
        value = _number(data["value"])
        if "std" not in data:
            return Estimate(value)
        return Estimate(value, inf if data["std"] is None else _number(data["std"]))
    return Estimate(_number(data))


def _number(data: Any) -> float:
    if isinstance(data, bool) or not isinstance(data, int | float):
        raise ValueError(f"expected a number, got {data!r}")  # noqa: TRY004
    value = float(data)
    if not isfinite(value):
        raise ValueError(f"expected a finite number, got {data!r}")
    return value


def _only_keys(data: Mapping[str, Any], known: set[str], what: str) -> None:
    unknown = set(data) - known
    if unknown:
        raise ValueError(f"{what} has unknown keys {sorted(unknown)}; known are {sorted(known)}")
