"""Values of dictionary objects on the wire: round trips, ranges, and what is refused."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drives import objects
from drives.objects import (
    DATA_TYPES,
    DataType,
    ObjectAddress,
    ObjectInfo,
    decode,
    encode,
    type_bits,
    type_range,
)

WHOLE: dict[DataType, tuple[int, int, int]] = {  # bytes, lowest, highest; CiA 301, clause 7.1.4
    "BOOLEAN": (1, 0, 1),
    "INTEGER8": (1, -128, 127),
    "INTEGER16": (2, -32768, 32767),
    "INTEGER32": (4, -2147483648, 2147483647),
    "INTEGER64": (8, -9223372036854775808, 9223372036854775807),
    "UNSIGNED8": (1, 0, 255),
    "UNSIGNED16": (2, 0, 65535),
    "UNSIGNED32": (4, 0, 4294967295),
    "UNSIGNED64": (8, 0, 18446744073709551615),
}
whole_types = st.sampled_from(sorted(WHOLE))


@pytest.mark.parametrize("name", WHOLE)
def test_ranges(name: DataType) -> None:
    size, low, high = WHOLE[name]
    assert type_range(name) == (low, high)
    assert type_bits(name) == 8 * size
    for value in (low, high):
        assert decode(name, encode(name, value)) == value
    for value in (low - 1, high + 1):
        with pytest.raises(ValueError, match=f"outside {name}'s range {low} to {high}"):
            encode(name, value)


@given(whole_types, st.data())
def test_whole_numbers_survive(name: DataType, data: st.DataObject) -> None:
    size, low, high = WHOLE[name]
    value = data.draw(st.integers(low, high))
    wire = encode(name, value)
    # little endian two's complement, worked out without struct
    assert wire == (value % 256**size).to_bytes(size, "little")
    assert decode(name, wire) == value
    info = ObjectInfo(ObjectAddress(0x2000, 1), name, "x")
    assert info.decode(info.encode(value)) == value


@given(whole_types, st.one_of(st.integers(), st.floats()))
def test_nothing_but_the_value_is_ever_encoded(name: DataType, value: float) -> None:
    _, low, high = WHOLE[name]
    fits = math.isfinite(value) if isinstance(value, float) else True
    if fits and value == int(value) and low <= value <= high:
        assert decode(name, encode(name, value)) == value
    else:
        with pytest.raises(ValueError, match=r"range|whole|finite"):
            encode(name, value)


@pytest.mark.parametrize("name", [*WHOLE, "REAL32", "REAL64"])
def test_numbers_beyond_any_float_are_refused(name: DataType) -> None:
    with pytest.raises(ValueError, match=name):
        encode(name, 10**400)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_singles_survive_exactly(value: float) -> None:
    again = decode("REAL32", encode("REAL32", value))
    assert struct.pack("<d", again) == struct.pack("<d", value)  # the sign of zero too


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_doubles_survive_exactly_and_singles_to_their_precision(value: float) -> None:
    again = decode("REAL64", encode("REAL64", value))
    assert struct.pack("<d", again) == struct.pack("<d", value)
    largest = (2 - 2**-23) * 2.0**127
    if abs(value) <= largest:
        rounded = decode("REAL32", encode("REAL32", value))
        assert isinstance(rounded, float)
        assert abs(rounded - value) <= max(2.0**-24 * abs(value), 2.0**-150)
    elif abs(value) > largest * (1 + 2**-23):
        with pytest.raises(ValueError, match="does not fit REAL32"):
            encode("REAL32", value)


@pytest.mark.parametrize("name", ["REAL32", "REAL64", *WHOLE])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf"), "12"])
def test_what_is_no_number_is_refused(name: DataType, value: float | str) -> None:
    with pytest.raises(ValueError, match=f"{name} needs a"):
        encode(name, value)


@given(st.sampled_from([t for t in DATA_TYPES if t != "VISIBLE_STRING"]), st.binary(max_size=9))
def test_bytes_of_the_wrong_number_are_refused(name: DataType, data: bytes) -> None:
    if len(data) == type_bits(name) // 8:
        value = decode(name, data)
        if isinstance(value, float) and math.isnan(value):
            return
        if name in WHOLE and name != "BOOLEAN":  # any byte but 0 is true
            assert encode(name, value) == data
    else:
        with pytest.raises(ValueError, match=f"{name} has .* the drive sent {len(data)}"):
            decode(name, data)


@given(st.text(st.characters(min_codepoint=1, max_codepoint=126)))
def test_texts_survive(text: str) -> None:
    assert decode("VISIBLE_STRING", encode("VISIBLE_STRING", text)) == text
    assert decode("VISIBLE_STRING", encode("VISIBLE_STRING", text) + b"\0\0") == text


def test_a_text_that_is_not_ascii() -> None:
    with pytest.raises(ValueError, match="VISIBLE_STRING"):
        encode("VISIBLE_STRING", "Ω")
    assert decode("VISIBLE_STRING", b"dr\xffve") == "dr\N{REPLACEMENT CHARACTER}ve"


def test_a_text_has_no_range_and_no_fixed_number_of_bits() -> None:
    for name in ("VISIBLE_STRING", "REAL32", "REAL64"):
        with pytest.raises(ValueError, match=f"{name} is no whole-number type"):
            type_range(name)
    with pytest.raises(ValueError, match="VISIBLE_STRING has no fixed length"):
        type_bits("VISIBLE_STRING")


@given(st.integers(1, 0xFFFF), st.integers(0, 0xFF))
def test_addresses_survive(index: int, sub: int) -> None:
    address = ObjectAddress(index, sub)
    assert ObjectAddress.parse(str(address)) == address
    assert ObjectAddress.parse(f"{index:x}:{sub:x}") == address


@pytest.mark.parametrize(
    "text",
    ["", "x", "0x2010:", "0x2010:01:02", "0x10000", "0x0", "0x2010:100", "-0x10", "0x2010.1"],
)
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"no object address|outside 0x0001:00"):
        ObjectAddress.parse(text)


def test_addresses_sort_by_index_then_subindex() -> None:
    texts = ["0x2010:02", "0x1000", "0x2010:01", "0x6040"]
    rising = sorted(ObjectAddress.parse(text) for text in texts)
    assert [str(a) for a in rising] == ["0x1000:00", "0x2010:01", "0x2010:02", "0x6040:00"]


def test_the_standard_objects_are_where_the_standards_have_them() -> None:
    """Each address once, and the mapping entries of the tool's PDOs by hand."""
    found = [value for value in vars(objects).values() if isinstance(value, ObjectInfo)]
    assert len({info.address for info in found}) == len(found) > 25
    sizes = [type_bits(getattr(objects, n).type) for n in
             ("CONTROLWORD", "TARGET_POSITION", "TARGET_TORQUE")]  # fmt: skip
    assert sizes == [16, 32, 16]
    sizes = [type_bits(getattr(objects, n).type) for n in
             ("STATUSWORD", "POSITION_ACTUAL", "TORQUE_ACTUAL")]  # fmt: skip
    assert sizes == [16, 32, 16]
