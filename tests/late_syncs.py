"""SYNCs that this computer gives late on the lock-step bus, without taking them for late cycles."""

from collections.abc import Callable

from drives.canopen_drive.sync import Early, HostSync


def giving_late(seconds: Callable[[float], float]) -> Callable[[HostSync, Early], float]:
    """Return what takes the place of ``HostSync.give``: each SYNC comes so many seconds late.

    ``seconds`` is asked for each, and given the cycle time, s.
    """
    give = HostSync.give

    def given(sync: HostSync, early: Early) -> float:
        late = seconds(sync._cycle_time)
        if late:
            clock = sync._line.clock
            clock.wait_until(clock.now() + late)
            sync._start += late  # virtual time goes on by whole cycles from there
        return give(sync, early)

    return given
