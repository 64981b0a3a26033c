"""One bus, one process of the tool: what counts as the same bus."""

import pytest

from drives.profile.bus import BusProfile
from fieldtool.errors import UnfinishedWriteError
from fieldtool.writeback.alone import alone_on


@pytest.fixture(autouse=True)
def notes(tmp_path, monkeypatch):
    monkeypatch.setenv("FIELDTOOL_STATE_DIR", str(tmp_path))


def bus(interface, channel, **options):
    return BusProfile(interface=interface, channel=channel, bitrate=500_000, options=options)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (bus("socketcan", "can0"), bus("socketcan", "can0")),
        (bus("socketcan", "can0", fd=True), bus("socketcan", "can0")),
        (
            bus("udp_multicast", "239.74.163.2", port=1),
            bus("udp_multicast", "239.74.163.2", port=1),
        ),
    ],
)
def test_the_same_bus_is_held_once(first, second):
    with (
        alone_on(first),
        pytest.raises(UnfinishedWriteError, match="another fieldtool is at work on it"),
        alone_on(second),
    ):
        pass
    with alone_on(second):
        pass


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (bus("socketcan", "can0"), bus("socketcan", "can1")),
        (
            bus("udp_multicast", "239.74.163.2", port=1),
            bus("udp_multicast", "239.74.163.2", port=2),
        ),
    ],
)
def test_another_bus_is_free(first, second):
    with alone_on(first), alone_on(second):
        pass
