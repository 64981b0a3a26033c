"""SDO server of the simulated drive: durand's, corrected where it is wrong, and able to wait.

durand 0.5 says in the last frame of a block upload that seven of its bytes are empty when none is
(data whose length is a multiple of 7); that frame is made here.  While the drive stores parameters
it answers no one: requests wait until it has finished, as they do in a drive whose flash is busy.
"""

from binascii import crc_hqx
from collections import deque
from collections.abc import Callable
from typing import Any

from durand.services.sdo.server import SDO_STRUCT, SDOServer, TransferState
from durand.services.sdo.upload import UploadManager

from drives.sim.dictionary import Key
from drives.sim.scheduler import Timer, VirtualScheduler

_DOWNLOAD, _UPLOAD, _BLOCK_UPLOAD, _BLOCK_DOWNLOAD = 1, 2, 5, 6
_ABORT = 0x80


class _BlockUploads(UploadManager):  # type: ignore[misc]  # durand is not typed
    """Uploads; the end of a block upload made after CiA 301, clause 7.2.4.3.15."""

    _state: Any
    _stream: Any
    _crc: int | None

    def upload_sub_block(self, msg: bytes) -> None:
        confirmed = self._state == TransferState.BLOCK and msg[0] & 0x03 == 2
        if not confirmed or self._stream.peek(msg[1] * 7 + 1)[msg[1] * 7 :]:
            super().upload_sub_block(msg)
            return
        data = self._stream.read(msg[1] * 7)
        if self._crc is not None:
            self._crc = crc_hqx(data, self._crc)
        empty = -len(data) % 7
        end = bytes((0xC1 | empty << 2,)) + (self._crc or 0).to_bytes(2, "little") + bytes(5)
        self._server.node.network.send(self._server.cob_tx, end)
        self._state = TransferState.BLOCK_END


class _HoldingNetwork:
    """The node's network, but answers can be held back."""

    def __init__(self, network: Any) -> None:
        self._network = network
        self.add_subscription = network.add_subscription
        self.remove_subscription = network.remove_subscription
        self.held: list[tuple[int, bytes]] | None = None

    def send(self, cob_id: int, msg: bytes) -> None:
        """Send an answer, or hold it back."""
        if self.held is None:
            self._network.send(cob_id, msg)
        else:
            self.held.append((cob_id, bytes(msg)))

    def release(self) -> None:
        """Send what was held back, in order."""
        held, self.held = self.held or [], None
        for cob_id, msg in held:
            self._network.send(cob_id, msg)


class _SdoHost:
    """What durand's server asks of its node."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self.network = _HoldingNetwork(node.network)
        self.object_dictionary = node.dictionary
        self.nmt = node.nmt

    @property
    def node_id(self) -> int:
        return int(self._node.node_id)


class DriveSdoServer(SDOServer):  # type: ignore[misc]  # durand is not typed
    """The default SDO server (0x1200) of one node.

    Parameters
    ----------
    node
        Whose server it is: has ``node_id``, ``dictionary``, ``network`` and ``nmt``.
    scheduler
        For answers that take their time.
    """

    def __init__(self, node: Any, scheduler: VirtualScheduler) -> None:
        super().__init__(_SdoHost(node))
        self.upload_manager = uploads = _BlockUploads(self)
        self._handle_cs_dict |= {
            2: uploads.init_upload,
            3: uploads.upload_segment,
            5: uploads.init_upload,
        }
        self._scheduler = scheduler
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._busy: Timer | None = None
        self.aborting: dict[Key, int] = {}
        """Fault injection: entries whose transfers are refused, with the abort code."""
        self.silent: set[Key] = set()
        """Fault injection: entries whose requests are not answered."""

    def handle_msg(self, cob_id: int, msg: bytes) -> None:
        """Handle a request of the client's; one of wrong length is passed over."""
        if len(msg) != 8:
            return
        if self._busy is not None:
            self._waiting.append((cob_id, bytes(msg)))
        elif not self._faulty(bytes(msg)):
            super().handle_msg(cob_id, bytes(msg))

    @property
    def busy(self) -> bool:
        """Whether an answer is held back."""
        return self._busy is not None

    def wait_with_answer(self, seconds: float, finish: Callable[[], int | None]) -> None:
        """Hold the answer to the present request back for a time, and requests after it.

        At its end ``finish`` is called; the abort code that it returns, if any, is sent in place
        of the answer.
        """
        self._node.network.held = []
        self._busy = self._scheduler.add(seconds, self._answer, (finish,))

    def forget(self) -> None:
        """Drop what is under way: the power went, or the node was reset."""
        if self._busy is not None:
            self._scheduler.cancel(self._busy)
        self._busy = None
        self._waiting.clear()
        self._node.network.held = None

    def _answer(self, finish: Callable[[], int | None]) -> None:
        code = finish()
        network, self._busy = self._node.network, None
        if code is not None and network.held:
            cob_id, answer = network.held[0]
            refusal = bytes((_ABORT,)) + answer[1:4] + code.to_bytes(4, "little")
            network.held[:] = [(cob_id, refusal)]
        network.release()
        while self._waiting and self._busy is None:
            self.handle_msg(*self._waiting.popleft())

    def _faulty(self, msg: bytes) -> bool:
        if not self.aborting and not self.silent:
            return False
        under_way = (
            self.download_manager.block_transfer_active or self.upload_manager.block_transfer_active
        )
        specifier = msg[0] >> 5
        begins = specifier in (_DOWNLOAD, _UPLOAD) or (
            specifier in (_BLOCK_UPLOAD, _BLOCK_DOWNLOAD) and not msg[0] & 0x01
        )
        if under_way or not begins:
            return False
        _, index, subindex = SDO_STRUCT.unpack(msg[:4])
        if (index, subindex) in self.silent:
            return True
        code = self.aborting.get((index, subindex))
        if code is None:
            return False
        answer = bytes((_ABORT,)) + msg[1:4] + code.to_bytes(4, "little")
        self._node.network.send(self._cob_tx, answer)
        return True
