"""What a person is told of late cycles."""

import pytest

from drives.canopen_drive.group import CanopenGroup
from drives.canopen_drive.line import Line
from drives.canopen_drive.pace import Punctuality
from drives.profile import load_machine
from drives.sim.lockstep_bus import LockstepBus

KERNEL = "let the kernel give the SYNC (`sync: kernel` under `bus` in the machine profile), or give"
MOTION = Punctuality(1000, 20, 0.003, 0.001)


@pytest.mark.parametrize(
    ("interface", "sync", "named"),
    [
        ("socketcan", "host", True),
        ("socketcan", "kernel", False),
        ("pcan", "host", False),
    ],
)
def test_the_kernels_sync_is_advised_only_where_it_could_be_had(interface, sync, named):
    machine = load_machine("turntable-arm")
    bus = machine.bus.model_copy(update={"interface": interface, "sync": sync})
    far = LockstepBus("turntable-arm")
    try:
        group = CanopenGroup(Line(far), machine.model_copy(update={"bus": bus}), (), lambda: False)
    finally:
        far.shutdown()
    assert group.punctuality.advice == ""
    advice = group.punctuality.plus(MOTION).plus(MOTION).advice
    assert (KERNEL in advice) is named
    assert advice.endswith("give the bus a longer `shortest_cycle` in the machine profile.")


def test_it_is_no_help_where_frames_were_lost_and_no_cycle_was_late():
    lost = Punctuality(1000, 0, 0.0, 0.001, overruns=3, kernel_could=True)
    assert "kernel" not in lost.advice
    assert "close other programs" in lost.advice
