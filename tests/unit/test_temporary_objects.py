"""What is changed for a while: a wrong reading must not be written back as a parameter."""

from contextlib import nullcontext
from math import nan

import pytest

from drives.canopen_drive.setup import TemporaryObjects
from drives.errors import NotSupportedError
from drives.objects import ObjectAddress, ObjectInfo

INFO = ObjectInfo(ObjectAddress(0x2010, 5), "UNSIGNED32", "inertia_ff")


class Drive:
    """Holds a number, and answers the readings that are listed wrongly."""

    axis = "x"
    left_changed = False
    told_all_the_same = nullcontext

    def __init__(self, value, wrong, deaf=()):
        self.value, self.wrong, self.readings = value, wrong, 0
        self.deaf, self.writings = deaf, 0

    def read_number(self, info):
        self.readings += 1
        return self.wrong.get(self.readings, self.value)

    def write(self, info, value):
        self.writings += 1
        self.value = self.value if self.writings in self.deaf else value


@pytest.mark.parametrize("wrong", [{1: 3916780366}, {2: 3916780366}, {1: nan, 2: nan}])
def test_two_readings_that_differ_are_not_acted_on(wrong):
    drive = Drive(7, wrong)
    changes = TemporaryObjects(drive)
    with pytest.raises(NotSupportedError, match=r"x, object 0x2010:05 .*was not changed"):
        changes.change(INFO, 0)
    assert changes.put_back() == []
    assert drive.value == 7


def test_a_value_is_changed_and_put_back():
    drive = Drive(7, {})
    changes = TemporaryObjects(drive)
    changes.change(INFO, 0)
    assert drive.value == 0
    assert changes.put_back() == []
    assert drive.value == 7
    assert not drive.left_changed


@pytest.mark.parametrize(("deaf", "held"), [({2}, 7), ({2, 3}, 0)])
def test_what_was_put_back_is_read_back(deaf, held):
    """A write that the drive confirms and does not take is repeated once, and then said."""
    drive = Drive(7, {}, deaf)
    changes = TemporaryObjects(drive)
    changes.change(INFO, 0)
    said = changes.put_back()
    assert drive.value == held
    assert drive.left_changed == bool(said) == (held == 0)
    assert all(
        "x, object 0x2010:05 (inertia_ff): wrote 7 as it was before" in text for text in said
    )
