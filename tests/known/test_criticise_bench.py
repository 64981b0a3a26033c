"""A real two-mass bench in open loop, torque in A: a delay is named, nothing is invented."""

from pathlib import Path

import pytest

from fieldtool.criticise.criticise import criticise
from fieldtool.identify.recorded import identify_recording
from fieldtool.records.csv_folder import read_folder

DATA = Path(__file__).parents[3] / "shared" / "data" / "two-mass-bench"

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the bench's measurements are not here")


@pytest.fixture(scope="module")
def criticism():
    recording = read_folder(DATA)
    model = identify_recording(recording, {}).model
    return criticise(recording, model).criticism


def test_nothing_but_the_known_delay_is_named(criticism):
    assert [cause.effect for cause in criticism.causes] == ["measurement_delay"]
    delay = criticism.causes[0].parameters["delay"]
    assert delay.value == pytest.approx(0.11e-3, abs=0.02e-3)


def test_what_is_left_is_described_and_not_named(criticism):
    assert criticism.verdict == "partly explained"
    assert criticism.unexplained
    assert all("not explained" in sentence for sentence in criticism.unexplained)


def test_the_other_excitation_was_kept_unseen(criticism):
    assert criticism.held_out.experiments == ("type-b",)
    assert (
        criticism.held_out.error_after["motor"].torque
        < criticism.held_out.error_before["motor"].torque
    )
