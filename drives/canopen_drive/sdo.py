"""SDO transfers that believe only the answers that belong to them.

python ``canopen`` takes the next answer for the one it waits for: a write is confirmed by an answer
about another object, and one that came too late for its own request answers the next.  Here an answer
has to fit its request (CiA 301, clause 7.2.4.3): command specifier, index and sub-index, toggle bit,
eight bytes.  What does not fit is passed over and remembered, for the error if nothing else comes.
"""

import struct

from canopen.sdo import SdoAbortedError, SdoClient, SdoCommunicationError

SDO_TIMEOUT = 0.5
"""Seconds a drive may take for an ordinary SDO answer."""
SDO_BYTES = 8
LONGEST = 1_000_000
"""Most bytes of one object that are read: no drive has more, and a defective one never ends."""
MOST_STRANGE = 1000
"""Most answers that are passed over while one is waited for."""
MOST_OWED = 100
"""Most answers that are remembered to be missing: a node that is off owes ever more."""
CHANGING = {0x1001, 0x1003, 0x603F, 0x6041, 0x606C, 0x60F4, 0x60FD}
CHANGING |= {*range(0x6061, 0x6065), *range(0x6077, 0x607A)}
"""Objects that change by themselves: two answers about one may differ."""

_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = 0, 1, 2, 3, 4
_ANSWER_TO = {_DOWNLOAD_SEGMENT: 1, _DOWNLOAD: 3, _UPLOAD: 2, _UPLOAD_SEGMENT: 0}
"""Server's command specifier by the client's."""
_TOGGLE, _EXPEDITED, _SIZE_GIVEN = 0x10, 0x02, 0x01


class StrictSdoClient(SdoClient):  # type: ignore[misc]
    """``canopen``'s SDO client, which receives by itself while it waits, and checks what it gets."""

    RESPONSE_TIMEOUT = SDO_TIMEOUT
    _place = bytes(3)
    """Index and sub-index of the transfer, as they are sent."""
    _segments = 0
    _owed: tuple[bytes, ...] = ()
    """Of which objects answers did not come in time or were not waited for, and may still come."""
    unasked = 0
    """Answers to nothing: more than were asked for."""
    contradicted = ""
    """About which object two answers came that differ; then nothing that the node says is known."""
    told_all_the_same = False
    """Whether a node that is contradicted is written to: what it said before is put back."""
    _last = b""
    """What was read last, as it came; nothing once it was written."""

    def request_response(self, sdo_request: bytes) -> bytes:
        """Send a request, and return the answer that fits it.

        Raises
        ------
        SdoAbortedError
            If the drive aborts the transfer.
        SdoCommunicationError
            If no answer fits in time, or a transfer does not end.
        """
        self.forget_old()
        specifier = sdo_request[0] >> 5
        told = self.told_all_the_same and specifier in (_DOWNLOAD, _DOWNLOAD_SEGMENT)
        if self.contradicted and not told:
            raise SdoCommunicationError(
                f"two answers came about {self.contradicted} that differ: two drives have this node id, "
                "or somebody else answers for it"
            )
        if specifier in (_DOWNLOAD, _UPLOAD):
            self._place, self._segments = bytes(sdo_request[1:4]), 0
        else:
            self._segments += 1
        if self._segments * 7 > LONGEST:
            self.abort(0x05040005)
            raise SdoCommunicationError(f"it has more than {LONGEST} bytes, and does not end")
        self._owed = (*self._owed, self._place)[-MOST_OWED:]
        self.send_request(sdo_request)
        return self._answer(bytes(sdo_request))

    def ask(self, index: int, subindex: int) -> None:
        """Ask for an object and do not wait: its answer is among those that are forgotten later."""
        place = struct.pack("<HB", index, subindex)
        self._owed = (*self._owed, place)[-MOST_OWED:]
        self.send_request(struct.pack("<B3s4x", _UPLOAD << 5, place))

    def forget_old(self) -> list[bytes]:
        """Take note of answers that nobody waited for, and drop them; return them."""
        old: list[bytes] = []
        while not self.responses.empty():
            old.append(bytes(self.responses.get_nowait()))
            self.unasked += not self._was_owed(old[-1])
        return old

    def _was_owed(self, answer: bytes) -> bool:
        """Whether an answer that is passed over came late; else see whether it contradicts the last."""
        place = answer[1:4]
        if place in self._owed:
            self._settle(place)
            return True
        if int.from_bytes(place[:2], "little") in CHANGING:
            return False
        read = len(answer) == SDO_BYTES and answer[0] >> 5 == _ANSWER_TO[_UPLOAD]
        if read and place == self._last[1:4] and answer != self._last:
            self.contradicted = _place(answer)
        return False

    def _settle(self, place: bytes) -> None:
        """No longer wait for one answer about an object."""
        at = self._owed.index(place)
        self._owed = self._owed[:at] + self._owed[at + 1 :]

    def _answer(self, request: bytes) -> bytes:
        strange: list[bytes] = []
        clock = self.network.clock
        deadline = clock.now() + self.RESPONSE_TIMEOUT
        while len(strange) < MOST_STRANGE:
            left = deadline - clock.now()
            if not self.network.wait(max(0.0, left), lambda: not self.responses.empty()):
                break
            answer = bytes(self.responses.get_nowait())
            if self._fits(request, answer):
                if self._place in self._owed:
                    self._settle(self._place)
                if answer[0] >> 5 == _ABORT:
                    raise SdoAbortedError(struct.unpack_from("<L", answer, 4)[0])
                if request[0] >> 5 == _UPLOAD:
                    self._last = answer
                elif self._place == self._last[1:4]:
                    self._last = b""
                return answer
            self._was_owed(answer)
            strange.append(answer)
        self.abort(0x05040000)
        if not strange:
            raise SdoCommunicationError("No SDO response received")
        raise SdoCommunicationError(f"{_in_words(strange[0], request)}; no right one came")

    def _fits(self, request: bytes, answer: bytes) -> bool:
        if len(answer) != SDO_BYTES:
            return False
        asked, given = request[0] >> 5, answer[0] >> 5
        if given == _ABORT:
            return answer[1:4] in (self._place, bytes(3))
        if given != _ANSWER_TO.get(asked):
            return False
        if asked in (_DOWNLOAD, _UPLOAD):
            return answer[1:4] == self._place
        return not (request[0] ^ answer[0]) & _TOGGLE

    def abort(self, abort_code: int = 0x08000000) -> None:
        """Tell the drive that the transfer is over."""
        self.send_request(struct.pack("<B3sL", 0x80, self._place, abort_code))


def expedited(answer: bytes, index: int, subindex: int) -> bytes | None:
    """Return what an answer says that an object holds; None if it is no such answer, or in segments."""
    if (
        len(answer) != SDO_BYTES
        or answer[0] >> 5 != _ANSWER_TO[_UPLOAD]
        or not answer[0] & _EXPEDITED
    ):
        return None
    if answer[1:4] != struct.pack("<HB", index, subindex):
        return None
    unused = answer[0] >> 2 & 0x03 if answer[0] & _SIZE_GIVEN else 0
    return answer[4 : SDO_BYTES - unused]


def _in_words(answer: bytes, request: bytes) -> str:
    """Return what is wrong with an answer."""
    if len(answer) != SDO_BYTES:
        return f"it has {len(answer)} bytes in place of {SDO_BYTES}"
    given = answer[0] >> 5
    if given != _ANSWER_TO.get(request[0] >> 5) and given != _ABORT:
        return f"its command specifier is {given} (0x{answer[0]:02X})"
    if request[0] >> 5 in (_DOWNLOAD, _UPLOAD) or given == _ABORT:
        return f"it is about {_place(answer)}"
    return "its toggle bit does not alternate"


def _place(answer: bytes) -> str:
    """Return the object that an answer is about."""
    return f"0x{int.from_bytes(answer[1:3], 'little'):04X}:{answer[3]:02X}"
