"""Network management of the simulated drive: CiA 301 states and commands.

durand's slave does the same for both kinds of reset and swallows what its callbacks raise; this one
keeps them apart and lets errors out.  It has what durand's SDO and LSS servers ask of theirs.
"""

from collections.abc import Callable

from durand.callback_handler import CallbackHandler, FailMode
from durand.services.nmt import StateEnum

START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 0x01, 0x02, 0x80, 0x81, 0x82


class NetworkManagement:
    """State, commands, and who has to know of a change.

    Parameters
    ----------
    node_id
        Of this node; NMT commands to it and to all (0) are followed.
    on_reset
        Called with True for a reset of the node and False for one of its communication; it has to
        end with :meth:`boot`.
    """

    def __init__(self, node_id: int, on_reset: Callable[[bool], None]) -> None:
        self.node_id = node_id
        self.pending_node_id = node_id
        """What LSS configured; valid from the next reset on."""
        self.state: StateEnum = StateEnum.INITIALISATION
        self.state_callbacks = CallbackHandler(FailMode.FIRST_FAIL)
        self._on_reset = on_reset

    @property
    def operational(self) -> bool:
        """Whether PDOs are exchanged."""
        return bool(self.state == StateEnum.OPERATIONAL)

    def handle(self, _cob_id: int, data: bytes | bytearray) -> None:
        """Follow an NMT command frame; one of wrong length or for others is passed over."""
        if len(data) != 2 or data[1] not in (0, self.node_id):
            return
        command = data[0]
        if command == START:
            self.set_state(StateEnum.OPERATIONAL)
        elif command == STOP:
            self.set_state(StateEnum.STOPPED)
        elif command == PRE_OPERATIONAL:
            self.set_state(StateEnum.PRE_OPERATIONAL)
        elif command in (RESET_NODE, RESET_COMMUNICATION):
            self._on_reset(command == RESET_NODE)

    def reset(self) -> None:
        """Reset the communication (what LSS asks for when a node id was configured)."""
        self._on_reset(False)

    def set_state(self, state: StateEnum) -> None:
        """Change the state and tell everybody; nothing happens if it is the present one."""
        if state != self.state:
            self.state = state
            self.state_callbacks.call(state)
