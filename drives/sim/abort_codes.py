"""SDO abort codes of CiA 301 (clause 7.2.4.3.17) that the simulated drive answers with."""

from enum import IntEnum

from durand.services.sdo.server import SDODomainAbort


class Abort(IntEnum):
    """Why an SDO transfer was refused."""

    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    UNSUPPORTED_ACCESS = 0x06010000
    NO_SUCH_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE = 0x06040043
    HARDWARE = 0x06060000
    TYPE_MISMATCH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUCH_SUBINDEX = 0x06090011
    INVALID_VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    GENERAL = 0x08000000
    CAN_NOT_STORE = 0x08000020
    LOCAL_CONTROL = 0x08000021
    WRONG_STATE = 0x08000022


def refuse(code: int, index: int, subindex: int) -> SDODomainAbort:
    """Return the exception with which durand's SDO server answers this abort code."""
    return SDODomainAbort(int(code), (index, subindex))
