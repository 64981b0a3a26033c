"""How fast the simulated machine runs on the lock-step bus: ``python tests/benchmarks/bench_bus.py``.

Three axes in cyclic position mode, one RPDO (controlword, target position, target torque) and one
TPDO (statusword, position, torque) each, a SYNC every millisecond.  The host is nothing but frames:
it sends prepared messages and receives the answers.  Shares come from the same cycles with parts
taken out: the plant and firmware alone, the nodes without a bus, the whole.
"""

import argparse
import struct
import time
from collections.abc import Callable

import can

from drives.sim.lockstep_bus import LockstepBus
from drives.sim.machine import SimulatedDrive, SimulatedMachine
from drives.sim.plant import ChainParameters
from drives.sim.running import RunningMachine

PERIOD = 1_000_000
AXES = 3


def three_axes() -> SimulatedMachine:
    chain = ChainParameters((0.7, 2.0, 3.0), (1000.0, 2000.0), (0.5, 1.0))
    gains = {"position_p": 6.0, "velocity_p": 30.0, "velocity_i": 60.0}
    drives = tuple(
        SimulatedDrive(f"axis{k}", k, chain, 50.0, 100.0, torque_noise=0.05, gains=gains)
        for k in range(1, AXES + 1)
    )
    return SimulatedMachine(drives, ((0, 1, 1.0), (0, 2, 1.0)), seed=1)


def write(machine: RunningMachine, node: int, index: int, sub: int, value: int, size: int) -> None:
    command = 0x23 | (4 - size) << 2
    data = struct.pack("<BHBI", command, index, sub, value)
    answers: list[bytes] = []

    def listener(_time: int, cob_id: int, answer: bytes) -> None:
        if cob_id == 0x580 + node:
            answers.append(bytes(answer))

    machine.listen(listener)
    machine.receive(0x600 + node, data)
    machine.unlisten(listener)
    if not answers or answers[0][0] != 0x60:
        raise RuntimeError(f"node {node} refused 0x{index:04X}:{sub:02X}: {answers}")


def configure(machine: RunningMachine) -> None:
    for node in range(1, AXES + 1):
        for communication, mapping, base, words in (
            (0x1400, 0x1600, 0x200, (0x60400010, 0x607A0020, 0x60710010)),
            (0x1800, 0x1A00, 0x180, (0x60410010, 0x60640020, 0x60770010)),
        ):
            write(machine, node, communication, 1, (base + node) | 1 << 31, 4)
            write(machine, node, communication, 2, 1, 1)
            write(machine, node, mapping, 0, 0, 1)
            for k, word in enumerate(words, start=1):
                write(machine, node, mapping, k, word, 4)
            write(machine, node, mapping, 0, len(words), 1)
            write(machine, node, communication, 1, base + node, 4)
        write(machine, node, 0x6060, 0, 8, 1)
        for word in (6, 7, 15):
            write(machine, node, 0x6040, 0, word, 2)
    machine.receive(0, b"\x01\x00")


def seconds_a_cycle(cycle: Callable[[], None], cycles: int) -> float:
    for _ in range(200):
        cycle()
    began = time.perf_counter()
    for _ in range(cycles):
        cycle()
    return (time.perf_counter() - began) / cycles


def plant_cycle() -> Callable[[], None]:
    axes = RunningMachine(three_axes()).axes

    def cycle() -> None:
        axes.latch()
        axes.advance(8)

    for axis in range(AXES):
        axes.follow_position(axis, 0.0, 8)
    return cycle


def node_cycle() -> Callable[[], None]:
    machine = RunningMachine(three_axes())
    configure(machine)
    data = struct.pack("<Hih", 15, 0, 0)

    def cycle() -> None:
        for node in range(1, AXES + 1):
            machine.receive(0x200 + node, data)
        machine.receive(0x80, b"")
        machine.advance_to(machine.time + PERIOD)

    return cycle


def bus_cycle(bus: LockstepBus) -> Callable[[], None]:
    configure(bus.machine)
    while bus.recv(0) is not None:
        pass
    data = struct.pack("<Hih", 15, 0, 0)
    outputs = [
        can.Message(arbitration_id=0x200 + node, is_extended_id=False, data=data)
        for node in range(1, AXES + 1)
    ]
    sync = can.Message(arbitration_id=0x80, is_extended_id=False, data=b"")

    def cycle() -> None:
        for message in outputs:
            bus.send(message)
        bus.send(sync)
        for _ in range(AXES):
            if bus.recv(0.01) is None:
                raise RuntimeError("a TPDO is missing")

    return cycle


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cycles", type=int, default=20_000)
    cycles = parser.parse_args().cycles
    plant = seconds_a_cycle(plant_cycle(), cycles)
    nodes = seconds_a_cycle(node_cycle(), cycles)
    bus = LockstepBus(machine=three_axes())
    try:
        whole = seconds_a_cycle(bus_cycle(bus), cycles)
    finally:
        bus.shutdown()
    frames = 2 * AXES + 1
    print(f"{'cycles/s':>12} {1 / whole:12.0f}")
    print(f"{'frames/s':>12} {frames / whole:12.0f}")
    print(f"{'times real':>12} {PERIOD / 1e9 / whole:12.1f}")
    for name, part in (("plant", plant), ("nodes", nodes - plant), ("bus", whole - nodes)):
        print(f"{name:>12} {part * 1e6:9.1f} us {part / whole:6.0%}")
    print(f"{'whole cycle':>12} {whole * 1e6:9.1f} us")


if __name__ == "__main__":
    main()
