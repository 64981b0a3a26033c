"""Rows saved while axes move, and what of them a recording lacks afterwards."""

import os
import signal
import struct
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drives.api import Capture, joined
from fieldtool.errors import FileFormatError
from fieldtool.records.raw_rows import RawRows, cut_off_rows
from fieldtool.records.recording import AxisInfo, Experiment, Recording
from tests.fuzzed import in_words, noisy

STEP = 0.002
AXES = (AxisInfo("a", "rotary"), AxisInfo("b", "rotary"))
EMPTY = Recording(STEP, AXES)


def capture(rng: np.random.Generator, first: int, rows: int) -> Capture:
    reference, position, torque = rng.normal(size=(3, rows, 2))
    words = rng.integers(0, 2**16, (rows, 2)).astype(np.uint16)
    return Capture(first, reference, position, torque, words)


def experiment(name: str, of: Capture, rows: slice = slice(None)) -> Experiment:
    position = of.position[rows]
    time = STEP * np.arange(position.shape[0])
    return Experiment(name, "moves", ("a",), (), None, time, position, of.torque[rows])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "rows"


def test_a_motion_that_nothing_was_kept_of_is_there_number_by_number(path, fresh_rng):
    rows = RawRows(path, ("a", "b"))
    rows.begin(STEP)
    rows.take(capture(fresh_rng, 0, 30))
    rows.begin(STEP)  # what was before is in the recording
    blocks = [capture(fresh_rng, first, 10) for first in range(7, 57, 10)]
    for block in blocks:
        rows.take(block)
    rows.take(capture(fresh_rng, 90, 4))  # another stream: SYNCs lie between
    rows.close(all_kept=False)
    one, other = cut_off_rows(path, EMPTY)
    whole = joined(blocks)
    assert (one.name, other.name) == ("cut off", "cut off 2")
    assert (one.samples, other.samples) == (50, 4)
    assert not one.complete
    for name in ("position", "position_reference", "torque", "statusword"):
        assert np.array_equal(getattr(one, name), getattr(whole, name)), name
    Recording(STEP, AXES, (one, other))  # it belongs to the recording


def test_what_the_recording_has_already_is_not_added_twice(path, fresh_rng):
    rows = RawRows(path, ("a", "b"))
    rows.begin(STEP)
    block = capture(fresh_rng, 0, 100)
    rows.take(block)
    rows.kept()
    rows.close(all_kept=False)
    first = experiment("first", block, slice(20, 60))
    (left,) = cut_off_rows(path, Recording(STEP, AXES, (first,)))
    assert np.array_equal(left.position, block.position[60:])
    both = Recording(STEP, AXES, (first, experiment("last", block, slice(60, 100))))
    assert cut_off_rows(path, both) == ()


def test_rows_that_are_not_found_in_the_recording_are_kept(path, fresh_rng):
    """Twice is better than never: the file is removed once they are in the recording."""
    rows = RawRows(path, ("a", "b"))
    rows.begin(STEP)
    known, other = capture(fresh_rng, 0, 40), capture(fresh_rng, 100, 30)
    rows.take(known)
    rows.kept()
    rows.take(other)  # a stretch of its own, of which nothing was kept
    rows.close(all_kept=False)
    (left,) = cut_off_rows(path, Recording(STEP, AXES, (experiment("first", known),)))
    assert np.array_equal(left.position, other.position)
    altered = np.nextafter(known.position, np.inf)
    first = replace(experiment("first", known), position=altered)
    both = cut_off_rows(path, Recording(STEP, AXES, (first,)))
    assert [one.samples for one in both] == [40, 30]
    assert np.array_equal(both[0].position, known.position)


@pytest.mark.parametrize("period", ["1" + 400 * "0", "null", "[]", "NaN", '"x"', "1" + 5000 * "0"])
def test_a_head_without_a_period_is_refused_in_words(path, period):
    head = f'{{"axes": ["a", "b"], "sample_period": {period}}}'.encode()
    path.write_bytes(struct.pack("<4sI", b"HEAD", len(head)) + head)
    with pytest.raises(FileFormatError, match=r"has no head|every nan s") as error:
        cut_off_rows(path, EMPTY)
    assert len(str(error.value)) < 1000


def test_where_all_was_kept_no_file_is_left(path, fresh_rng):
    rows = RawRows(path, ("a", "b"))
    rows.begin(STEP)
    rows.take(capture(fresh_rng, 0, 10))
    rows.close(all_kept=True)
    assert not path.exists()


def test_a_full_pipe_is_not_waited_for_and_nothing_is_lost(path, fresh_rng):
    rows = RawRows(path, ("a", "b"))
    assert rows._process is not None
    os.kill(rows._process.pid, signal.SIGSTOP)
    rows.begin(STEP)
    blocks = [capture(fresh_rng, 500 * k, 500) for k in range(40)]  # 1.4 MB: more than a pipe holds
    began = time.monotonic()
    for block in blocks:
        rows.take(block)
    assert time.monotonic() - began < 2.0
    assert rows._waiting
    os.kill(rows._process.pid, signal.SIGCONT)
    rows.close(all_kept=False)
    (found,) = cut_off_rows(path, EMPTY)
    assert np.array_equal(found.position, joined(blocks).position)


def test_a_disk_that_is_full_or_a_process_that_is_gone_does_no_harm(path, fresh_rng):
    rows = RawRows(path, ("a", "b"))
    assert rows._process is not None
    rows._process.kill()
    rows._process.wait()
    rows.begin(STEP)
    for k in range(100):
        rows.take(capture(fresh_rng, 10 * k, 10))
    rows.close(all_kept=False)
    nowhere = RawRows(path / "no" / "folder", ("a", "b"))
    nowhere.begin(STEP)
    nowhere.take(capture(fresh_rng, 0, 10))
    nowhere.close(all_kept=False)


def test_rows_of_another_machine_are_refused(path, fresh_rng):
    rows = RawRows(path, ("a", "c"))
    rows.begin(STEP)
    rows.take(capture(fresh_rng, 0, 10))
    rows.close(all_kept=False)
    with pytest.raises(
        FileFormatError, match=r"is of axes a, c every 0.002 s; the recording .* a, b"
    ):
        cut_off_rows(path, EMPTY)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("rows") / "rows"
    rows = RawRows(path, ("a", "b"))
    rows.begin(STEP)
    for k in range(5):
        rows.take(capture(np.random.default_rng(k), 3 * k, 3))
    rows.kept()
    rows.close(all_kept=False)
    return path


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_damaged_rows_are_refused_in_words_or_read(whole, data):
    path = whole.with_name("damaged")
    path.write_bytes(noisy(data.draw, whole.read_bytes()))
    for one in in_words(lambda: cut_off_rows(path, EMPTY), FileFormatError) or ():
        assert one.samples >= 2
