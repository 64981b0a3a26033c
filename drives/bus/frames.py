"""Which frames of a bus are CANopen's."""

import can


def is_data(message: can.Message) -> bool:
    """Whether it is a data frame with an 11-bit identifier, as all of CANopen's are.

    Only such a frame's identifier says what it is: an error frame's class may equal any of them.
    """
    return not (message.is_error_frame or message.is_remote_frame or message.is_extended_id)
