"""Whose answers an SDO client believes: late ones, those of somebody else, and those of two drives."""

from collections import deque

import pytest
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo import SdoCommunicationError

from drives.canopen_drive.sdo import StrictSdoClient, expedited


def place(index: int, subindex: int) -> bytes:
    return index.to_bytes(2, "little") + bytes([subindex])


def read(index: int, subindex: int, value: int) -> bytes:
    return b"\x43" + place(index, subindex) + value.to_bytes(4, "little")


def written(index: int, subindex: int) -> bytes:
    return b"\x60" + place(index, subindex) + bytes(4)


class Clock:
    def __init__(self) -> None:
        self.time = 0.0

    def now(self) -> float:
        return self.time


class Net:
    """Gives the answers that are listed for each request, in order; the last ones come too late."""

    def __init__(self, client: StrictSdoClient, *answers: tuple[bytes, ...]) -> None:
        self.client, self.clock, self.answers = client, Clock(), deque(answers)
        self.asked: list[bytes] = []
        self.stops = False
        client.network = self

    def send_message(self, _cob_id: int, data: bytes) -> None:
        if data[0] >> 5 == 4:  # the transfer is over
            return
        self.asked.append(bytes(data))
        for answer in self.answers.popleft():
            self.client.responses.put(answer)

    def wait(self, seconds: float, until) -> bool:
        if self.stops:
            raise KeyboardInterrupt
        if not until():
            self.clock.time += seconds + 1e-9
        return bool(until())


def client_of(*answers: tuple[bytes, ...]) -> tuple[StrictSdoClient, Net]:
    client = StrictSdoClient(0x60B, 0x58B, ObjectDictionary())
    return client, Net(client, *answers)


A, B, STATE = (0x2010, 1), (0x2010, 2), (0x6041, 0)


def test_an_answer_of_somebody_else_is_noticed_while_the_next_one_is_waited_for():
    client, net = client_of((read(*A, 5),), (read(*A, 6), read(*B, 1)), ())
    assert client.upload(*A) == (5).to_bytes(4, "little")
    assert client.upload(*B) == (1).to_bytes(4, "little")
    with pytest.raises(SdoCommunicationError, match="0x2010:01 that differ: two drives"):
        client.upload(*B)
    assert len(net.asked) == 2


def test_an_answer_about_another_object_that_is_late_hides_nothing():
    client, _ = client_of((), (read(*A, 5),), (read(*A, 6), read(*B, 1)))
    with pytest.raises(SdoCommunicationError, match="No SDO response"):
        client.upload(*B)
    client.upload(*A)
    client.upload(*B)
    assert client.contradicted == "0x2010:01"


def test_an_answer_that_comes_late_contradicts_nobody():
    """The value was written in between."""
    client, _ = client_of((read(*A, 5),), (), (read(*A, 5),), (read(*A, 7), read(*B, 1)))
    client.upload(*A)
    with pytest.raises(SdoCommunicationError):
        client.upload(*A)
    client.upload(*A)
    client.upload(*B)
    assert client.contradicted == ""


def test_an_answer_that_was_not_waited_for_contradicts_nobody():
    client, net = client_of((read(*A, 5),), (written(*A),), (read(*A, 7),), (read(*B, 1),))
    client.upload(*A)
    client.download(*A, (7).to_bytes(4, "little"))
    net.stops = True  # the user presses Ctrl-C while the answer is on its way
    with pytest.raises(KeyboardInterrupt):
        client.upload(*A)
    net.stops = False
    assert client.upload(*B) == (1).to_bytes(4, "little")
    assert client.contradicted == ""


def test_somebody_who_reads_what_changes_by_itself_contradicts_nobody():
    client, _ = client_of(
        (read(*STATE, 0x237),), (read(*STATE, 0x637), read(*A, 5)), (read(*A, 5),)
    )
    client.upload(*STATE)
    client.upload(*A)
    client.upload(*A)
    assert client.contradicted == ""


def test_a_contradicted_node_is_told_what_it_was_but_not_asked():
    client, net = client_of((read(*A, 5), read(*A, 6)), (written(*A), written(*A)))
    client.upload(*A)
    client.forget_old()
    assert client.contradicted == "0x2010:01"
    client.told_all_the_same = True
    client.download(*A, (5).to_bytes(4, "little"))
    with pytest.raises(SdoCommunicationError, match="two drives"):
        client.upload(*A)
    client.told_all_the_same = False
    with pytest.raises(SdoCommunicationError, match="two drives"):
        client.download(*A, (5).to_bytes(4, "little"))
    assert len(net.asked) == 2


def test_what_is_asked_without_waiting_is_owed_once():
    client, net = client_of((), (read(0x6061, 0, 8),), (read(0x6061, 0, 10),))
    client.ask(0x6061, 0)
    assert net.asked == [b"\x40" + place(0x6061, 0) + bytes(4)]
    assert client.forget_old() == [], "nobody waits for it"
    late = read(0x6061, 0, 8)
    client.responses.put(late)
    client.responses.put(late)
    assert client.forget_old() == [late, late]
    assert client.unasked == 1
    client.ask(0x6061, 0)
    assert client.upload(0x6061, 0) == (10).to_bytes(4, "little"), "not what was asked for before"
    assert client.unasked == 1


def test_what_an_answer_holds():
    assert expedited(b"\x4f" + place(0x6061, 0) + b"\x0a\0\0\0", 0x6061, 0) == b"\x0a"
    assert expedited(b"\x42" + place(0x6061, 0) + b"\x0a\0\0\0", 0x6061, 0) == b"\x0a\0\0\0"
    for other in (
        b"\x4f" + place(0x6061, 0) + b"\x0a\0\0",
        b"\x4f" + place(0x6061, 1) + b"\x0a\0\0\0",
        b"\x41" + place(0x6061, 0) + b"\x01\0\0\0",
        b"\x60" + place(0x6061, 0) + b"\0\0\0\0",
        b"\x80" + place(0x6061, 0) + b"\0\0\2\6",
        b"",
    ):
        assert expedited(other, 0x6061, 0) is None
