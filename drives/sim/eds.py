"""The electronic data sheet (CiA 306) of the simulated drive, made from its entries.

``profiles/drives/reference.eds`` is this text; the drive itself serves that file as object 0x1021.
durand's own EDS writer is not used: it swaps the codes of arrays and records, and calls every
object above 0x2000 mappable.
"""

from collections.abc import Sequence
from importlib.resources import files

from durand.datatypes import DatatypeEnum as Type
from durand.datatypes import is_float, is_numeric

from drives.sim.entries import (
    OBJECTS,
    PDO_COUNT,
    PRODUCT_CODE,
    REVISION,
    VENDOR_ID,
    Entry,
    ObjectEntry,
)

EDS_FILE = "reference.eds"
_VARIABLE, _ARRAY, _RECORD, _DOMAIN = 0x7, 0x8, 0x9, 0x2
_MANDATORY = (0x1000, 0x1001, 0x1018)
_BIT_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)


def packaged_eds() -> bytes:
    """Return the EDS file that ships with the drive profiles."""
    return files("profiles").joinpath("drives", EDS_FILE).read_bytes()


def eds_text(
    described: Sequence[ObjectEntry] = OBJECTS,
    comment: str = "Positions in encoder counts, torques in per mille.",
) -> str:
    """Return the data sheet of a simulated drive, the reference drive's unless others are given."""
    mandatory = [o for o in described if o.index in _MANDATORY]
    maker = [o for o in described if 0x2000 <= o.index < 0x6000]
    optional = [o for o in described if o not in mandatory and o not in maker]
    parts = [
        _section(
            "FileInfo",
            FileName=EDS_FILE,
            FileVersion=1,
            FileRevision=0,
            EDSVersion="4.0",
            Description="Simulated CiA 402 servo drive",
            CreationTime="12:00PM",
            CreationDate="01-01-2026",
            CreatedBy="fieldtool",
        ),
        _section(
            "DeviceInfo",
            VendorName="none (simulated)",
            VendorNumber=VENDOR_ID,
            ProductName="simulated CiA 402 servo drive",
            ProductNumber=f"0x{PRODUCT_CODE:08X}",
            RevisionNumber=f"0x{REVISION:08X}",
            OrderCode="none",
            **{f"BaudRate_{rate}": 1 for rate in _BIT_RATES},
            SimpleBootUpMaster=0,
            SimpleBootUpSlave=1,
            Granularity=8,
            DynamicChannelsSupported=0,
            GroupMessaging=0,
            NrOfRXPDO=PDO_COUNT,
            NrOfTXPDO=PDO_COUNT,
            LSS_Supported=1,
        ),
        _section("DummyUsage", **{f"Dummy{k:04d}": int(k >= 2) for k in range(1, 8)}),
        _section("Comments", Lines=1, Line1=comment),
    ]
    for name, objects in (
        ("MandatoryObjects", mandatory),
        ("OptionalObjects", optional),
        ("ManufacturerObjects", maker),
    ):
        listed = {str(k): f"0x{o.index:04X}" for k, o in enumerate(objects, start=1)}
        parts.append(_section(name, SupportedObjects=len(objects), **listed))
        parts += [_object(o) for o in objects]
    return "\n".join(parts)


def _section(title: str, **values: object) -> str:
    return f"[{title}]\n" + "".join(f"{key}={value}\n" for key, value in values.items())


def _object(described: ObjectEntry) -> str:
    if described.is_variable:
        return _entry(f"{described.index:04X}", described.entries[0])
    head = _section(
        f"{described.index:04X}",
        ParameterName=described.name,
        ObjectType=f"0x{_ARRAY if described.is_array else _RECORD:X}",
        SubNumber=len(described.entries),
    )
    subs = (_entry(f"{e.index:04X}sub{e.subindex:X}", e) for e in described.entries)
    return "\n".join((head, *subs))


def _entry(title: str, entry: Entry) -> str:
    values: dict[str, object] = {
        "ParameterName": entry.name,
        "ObjectType": f"0x{_DOMAIN if entry.type == Type.DOMAIN else _VARIABLE:X}",
        "DataType": f"0x{int(entry.type):04X}",
        "AccessType": entry.access,
    }
    if entry.type != Type.DOMAIN:
        values["DefaultValue"] = _default(entry)
    if entry.low is not None:
        values["LowLimit"] = _number(entry, entry.low)
    if entry.high is not None:
        values["HighLimit"] = _number(entry, entry.high)
    values["PDOMapping"] = int(entry.mappable)
    return _section(title, **values)


def _default(entry: Entry) -> str:
    if entry.plus_node_id:
        return f"$NODEID+0x{int(entry.default):X}"
    if isinstance(entry.default, bytes):
        return entry.default.decode("ascii")
    return _number(entry, entry.default)


def _number(entry: Entry, value: float) -> str:
    if is_numeric(entry.type) and is_float(entry.type):
        return repr(float(value))
    return str(int(value))
