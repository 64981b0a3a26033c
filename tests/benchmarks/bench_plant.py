"""How fast the simulated machine runs: ``python tests/benchmarks/bench_plant.py``."""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi, sin
from time import perf_counter

from drives.sim.firmware import DriveHardware, Parameter, SimulatedAxes
from drives.sim.plant import ChainParameters, PlantParameters

SYNC_STEPS = 8  # 1 kHz SYNC at 8 kHz
REPEATS = 5


def paper_machine() -> PlantParameters:
    """Three chains of three masses, coupled, lightly damped."""
    springs = ((1000.0, 2000.0), (3000.0, 4000.0), (5000.0, 6000.0))
    masses = ((0.7, 2.0, 3.0), (4.0, 5.0, 6.0), (7.0, 8.0, 9.0))
    chains = tuple(
        ChainParameters(m, k, (5e-4 * k[0], 5e-4 * k[1]))
        for m, k in zip(masses, springs, strict=True)
    )
    return PlantParameters(chains, ((0, 1, 1.0), (0, 2, 2.0), (1, 2, 3.0)))


def long_chains(axes: int, masses: int) -> PlantParameters:
    """Equal chains without couplings."""
    links = masses - 1
    chain = ChainParameters((1.0,) * masses, (1000.0,) * links, (0.5,) * links)
    return PlantParameters((chain,) * axes)


def running(parameters: PlantParameters) -> SimulatedAxes:
    """All axes in position control with both filters on."""
    drive = DriveHardware(
        rated_torque=100.0, torque_noise=0.1, counts_per_unit=2**20 / (2 * pi), peak_torque=300.0
    )
    axes = SimulatedAxes(parameters, [drive] * len(parameters.chains), seed=1)
    for axis, chain in enumerate(parameters.chains):
        total = sum(chain.masses)
        for parameter, value in (
            (Parameter.POSITION_P, 2.0),
            (Parameter.VELOCITY_P, 8.0 * total),
            (Parameter.VELOCITY_I, 8.0 * total),
            (Parameter.VELOCITY_FILTER, 500.0),
            (Parameter.FILTER1_TYPE, 1),
            (Parameter.FILTER1_FREQUENCY, 60.0),
            (Parameter.FILTER2_TYPE, 2),
            (Parameter.FILTER2_FREQUENCY, 600.0),
        ):
            axes.set(axis, parameter, value)
        axes.follow_position(axis, 0.0, SYNC_STEPS)
    axes.advance(SYNC_STEPS)
    return axes


@dataclass(frozen=True)
class Case:
    """One line of the table: what is called, how often, and what one is."""

    machine: str
    what: str
    count: int
    call: Callable[[], object]


def cases(name: str, parameters: PlantParameters) -> list[Case]:
    """What costs time while a machine is measured."""
    axes = running(parameters)
    cycle = [0]

    def sync() -> None:
        cycle[0] += 1
        target = 0.1 * sin(2 * pi * 3.0 * cycle[0] * 1e-3)
        for axis in range(axes.axes):
            axes.follow_position(axis, target, SYNC_STEPS)
        axes.advance(SYNC_STEPS)
        axes.latch()

    def repeated(call: Callable[[], object], count: int) -> Callable[[], None]:
        def run() -> None:
            for _ in range(count):
                call()

        return run

    calls: list[tuple[str, Callable[[], object]]] = [
        ("advance(0): the call alone", lambda: axes.advance(0)),
        ("advance(8)", lambda: axes.advance(SYNC_STEPS)),
        ("latch()", axes.latch),
        ("follow_position()", lambda: axes.follow_position(0, 0.0, SYNC_STEPS)),
        ("position_counts()", lambda: axes.position_counts(0)),
        ("one 1 kHz SYNC, all axes", sync),
    ]
    return [
        Case(name, "inner step, 8000 in one call", 8000, lambda: axes.advance(8000)),
        *(Case(name, what, 2000, repeated(call, 2000)) for what, call in calls),
    ]


def main() -> None:
    """Print the table; each figure is the best of several runs."""
    print(f"{'machine':<28}{'what':<32}{'us':>8}")
    for name, parameters in (
        ("paper, 3 axes x 3 masses", paper_machine()),
        ("1 axis x 2 masses", long_chains(1, 2)),
        ("6 axes x 4 masses", long_chains(6, 4)),
    ):
        for case in cases(name, parameters):
            case.call()
            best = float("inf")
            for _ in range(REPEATS):
                begin = perf_counter()
                case.call()
                best = min(best, perf_counter() - begin)
            print(f"{case.machine:<28}{case.what:<32}{best / case.count * 1e6:>8.3f}")


if __name__ == "__main__":
    main()
