"""SDO transfers as a listener puts them together, against an independent client and server."""

import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes
from hypothesis import given, settings
from hypothesis import strategies as st

from drives.objects import ObjectAddress
from drives.replay.sdo import SdoChannel, SdoStep

NODE, INDEX = 9, 0x2345


class Listened:
    """A client and a server of ``canopen``, and every frame between them."""

    def __init__(self) -> None:
        dictionary = canopen.ObjectDictionary()
        variable = ODVariable("anything", INDEX)
        variable.data_type, variable.access_type = datatypes.DOMAIN, "rw"
        dictionary.add_object(variable)
        self.frames: list[tuple[int, bytes]] = []
        self.server_network, self.client_network = canopen.Network(), canopen.Network()
        self.server = canopen.LocalNode(NODE, dictionary)
        self.client = canopen.RemoteNode(NODE, dictionary)
        for network, other in (
            (self.server_network, self.client_network),
            (self.client_network, self.server_network),
        ):
            network.send_message = self._carry(other)  # type: ignore[method-assign]
        self.server_network.add_node(self.server)
        self.client_network.add_node(self.client)

    def _carry(self, other: canopen.Network):
        def carry(identifier: int, data: bytes, remote: bool = False) -> None:
            self.frames.append((identifier, bytes(data).ljust(8, b"\0")))
            other.notify(identifier, bytearray(self.frames[-1][1]), 0.0)

        return carry

    def steps(self) -> list[SdoStep]:
        channel = SdoChannel()
        return [
            channel.request(data) if identifier >= 0x600 else channel.answer(data)
            for identifier, data in self.frames
        ]


@settings(max_examples=60, deadline=None)
@given(st.binary(min_size=1, max_size=60))
def test_what_was_read_and_written_is_heard(value: bytes) -> None:
    line = Listened()
    line.client.sdo.download(INDEX, 0, value, force_segment=len(value) % 2 == 0)
    assert bytes(line.client.sdo.upload(INDEX, 0)) == value
    steps = line.steps()
    (written,) = [s for s in steps if s.what == "written"]
    (read,) = [s for s in steps if s.what == "value"]
    assert (written.address, written.data) == (ObjectAddress(INDEX), value)
    assert (read.address, read.data) == (ObjectAddress(INDEX), value)


def test_an_abort_is_heard() -> None:
    line = Listened()
    with pytest.raises(canopen.SdoAbortedError):
        line.client.sdo.upload(0x5555, 1)
    last = line.steps()[-1]
    assert (last.what, last.address) == ("abort", ObjectAddress(0x5555, 1))
    assert last.abort_text == "the object does not exist (0x06020000)"


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.binary(max_size=8)), max_size=40))
def test_nonsense_is_heard_without_harm(frames: list[tuple[bool, bytes]]) -> None:
    channel = SdoChannel()
    for answer, data in frames:
        step = channel.answer(data) if answer else channel.request(data)
        assert step.data is None or len(step.data) < 400
