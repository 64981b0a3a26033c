"""Backup files: what is left out, what is kept exactly, what is refused."""

import math
import struct
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drives.errors import DriveFaultError, NotSupportedError, ProfileError, SdoAbortError
from drives.objects import ObjectAddress, ObjectInfo, type_range
from drives.parameters import Backup, DriveBackup, HeldObject, back_up, load_backup, save_backup

INTEGERS = [f"{s}{b}" for s in ("INTEGER", "UNSIGNED") for b in (8, 16, 32, 64)]


@dataclass
class FakeDrive:
    """Just enough of a drive for a backup."""

    values: dict[ObjectInfo, object]
    axis: str = "x"
    node_id: int = 5
    boots: int = 0

    @property
    def identity(self):
        return SimpleNamespace(vendor_id=1, product_code=2, serial_number=3, revision=4)

    def writable_parameters(self):
        return iter(self.values)

    def read_optional(self, info):
        return None

    def read(self, info):
        value = self.values[info]
        if isinstance(value, list):
            value = value.pop(0)
        if value == "restarts":
            self.boots += 1
        if isinstance(value, Exception):
            raise value
        return value


def info(data_type, index=0x2000, subindex=0):
    return ObjectInfo(ObjectAddress(index, subindex), data_type, f"object {index:X}")


def backup_of(*held):
    return Backup("machine", "2025-01-01T00:00:00+00:00", (DriveBackup("x", 5, 1, 2, 3, 4, held),))


def test_what_could_not_be_written_again_is_left_out():
    drive = FakeDrive(
        {
            info("REAL32", 0x2001): math.nan,
            info("REAL64", 0x2002): math.inf,
            info("VISIBLE_STRING", 0x2003): "\ufffd",
            info("UNSIGNED8", 0x2004): SdoAbortError("x", 0x2004, 0, 0x06010001, "read"),
            info("UNSIGNED8", 0x2005): 7,
        }
    )
    (part,) = back_up("machine", [drive]).drives
    assert [h.info.address.index for h in part.held] == [0x2005]


@pytest.mark.parametrize(
    ("answers", "said"),
    [
        ([1200, 176], "read as 1200, then as 176"),
        ([176, 1200], "read as 176, then as 1200"),
        ([math.nan, 5.0], "read as nothing that can be kept, then as 5.0"),
        (
            [SdoAbortError("x", 0x2000, 0, 0x06020000, "read"), 7],
            "nothing that can be kept, then as 7",
        ),
    ],
)
def test_what_is_read_as_one_value_and_then_as_another_is_not_backed_up(answers, said):
    """It would be written back."""
    drive = FakeDrive({info("REAL32"): answers})
    with pytest.raises(NotSupportedError, match=said) as refused:
        back_up("machine", [drive])
    assert "x, object 0x2000:00" in str(refused.value)
    assert "volatile_commands" in str(refused.value)


def test_what_a_motion_sets_up_is_read_two_times_as_well():
    drive = FakeDrive({})
    answers = {0x60B2: [100, 356]}
    drive.read_optional = lambda info: answers.get(info.address.index, [0]).pop(0)
    with pytest.raises(
        NotSupportedError, match=r"x, object 0x60B2:00 .*: read as 100, then as 356"
    ):
        back_up("machine", [drive])


def test_a_drive_that_restarts_while_it_is_read_is_not_backed_up():
    """One half would be what it held, the other what was stored."""
    drive = FakeDrive({info("VISIBLE_STRING"): "restarts"})
    with pytest.raises(
        DriveFaultError, match="node 5 has restarted while its parameters were read"
    ):
        back_up("machine", [drive])


def test_an_object_that_can_not_be_read_for_another_reason_stops_the_backup():
    drive = FakeDrive({info("UNSIGNED8"): SdoAbortError("x", 0x2000, 0, 0x08000022, "read")})
    with pytest.raises(SdoAbortError):
        back_up("machine", [drive])


@given(
    st.one_of(
        st.sampled_from(INTEGERS).flatmap(
            lambda t: st.tuples(st.just(t), st.integers(*type_range(t)))
        ),
        st.tuples(st.just("REAL32"), st.floats(width=32, allow_nan=False, allow_infinity=False)),
        st.tuples(st.just("REAL64"), st.floats(allow_nan=False, allow_infinity=False)),
        st.tuples(st.just("BOOLEAN"), st.booleans()),
        st.tuples(
            st.just("VISIBLE_STRING"),
            st.text(st.characters(codec="ascii"), max_size=40).map(lambda t: t.rstrip("\0")),
        ),
    )
)
def test_every_value_comes_back_bit_by_bit(tmp_path_factory, case):
    data_type, value = case
    path = tmp_path_factory.mktemp("backup") / "b.yaml"
    backup = backup_of(HeldObject(info(data_type), value))
    try:
        save_backup(backup, path)
    except ProfileError:
        # Refused before anything is written to a drive: YAML can not hold this control character.
        assert data_type == "VISIBLE_STRING"
        assert not value.isprintable()
        assert not path.exists()
        return
    (held,) = load_backup(path).drives[0].held
    assert held.info.encode(held.value) == info(data_type).encode(value)
    assert isinstance(held.value, type(value))


def test_an_object_twice_is_refused(tmp_path):
    path = tmp_path / "b.yaml"
    twice = (HeldObject(info("UNSIGNED8"), 1), HeldObject(info("UNSIGNED8"), 2))
    with pytest.raises(ProfileError, match="a second time"):
        save_backup(backup_of(*twice), path)
    assert list(tmp_path.iterdir()) == []


def test_a_large_machine_can_be_loaded_again(tmp_path):
    """What can be saved can be restored: 12 drives of a thousand objects are above a megabyte."""
    held = tuple(HeldObject(info("REAL32", 0x2000 + k), _single(0.1 * k)) for k in range(1000))
    drives = tuple(DriveBackup(f"x{k}", 1 + k, 1, 2, 3, 4, held) for k in range(12))
    backup = Backup("machine", "2025-01-01T00:00:00+00:00", drives)
    path = tmp_path / "b.yaml"
    save_backup(backup, path)
    assert path.stat().st_size > 1_000_000
    assert load_backup(path) == backup


def _single(value):
    return struct.unpack("<f", struct.pack("<f", value))[0]


def test_a_disk_that_is_full_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "b.yaml"
    save_backup(backup_of(HeldObject(info("UNSIGNED8"), 1)), path)
    before = path.read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("drives.parameters.durable.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_backup(backup_of(HeldObject(info("UNSIGNED8"), 2)), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
