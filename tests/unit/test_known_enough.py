"""No controller is designed from numbers that are not known."""

from dataclasses import replace

import pytest

from fieldtool.errors import IdentificationError
from fieldtool.records.model import AxisModel, Estimate, MachineModel
from fieldtool.workflow.designing import check_known

KNOWN = AxisModel(
    "table", "rotary", (Estimate(0.02, 1e-4), Estimate(0.03, 2e-4)), (Estimate(190, 1.0),), ()
)


def test_a_known_machine_passes() -> None:
    check_known(MachineModel((KNOWN,), ()))
    exact = replace(KNOWN, masses=(Estimate(0.02), Estimate(0.03)), springs=(Estimate(190),))
    check_known(MachineModel((exact,), ()))  # without errors: an accepted model


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"masses": (Estimate(0.02, 1e-4), Estimate(0.03, 0.02))}, "table mass 2 is 0.03 "),
        ({"springs": (Estimate(1e-6, 3.0),)}, "table spring 1 is 1e-06 "),
    ],
)
def test_what_is_not_known_is_named(change: dict[str, tuple[Estimate, ...]], words: str) -> None:
    with pytest.raises(IdentificationError, match="no controller is designed") as refusal:
        check_known(MachineModel((replace(KNOWN, **change),), ()))
    assert words in str(refusal.value)
