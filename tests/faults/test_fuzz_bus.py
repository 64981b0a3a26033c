"""Random frames on the bus: no traceback, no hang, drives off, no wrong write."""

from random import Random

import numpy as np
import pytest

from tests.faults.bench import Moment
from tests.faults.fuzz_bus import Noise, disturbed

SEED = int(np.random.SeedSequence().generate_state(1)[0])


def test_frames_that_are_nobodys_do_not_matter():
    print("seed", SEED)
    outcome = disturbed(Noise("bystanders", 3.0, SEED))
    assert outcome.code == 0, outcome.said[:600]
    assert outcome.frames > 10_000
    assert outcome.problems == ()


@pytest.mark.parametrize("moment", [Moment.SWEEP, Moment.WRITE])
@pytest.mark.parametrize("kind", ["look-alikes", "answers"])
def test_frames_that_look_like_the_nodes_own(kind, moment):
    print("seed", SEED)
    random = Random(SEED)
    for k in range(8):
        rate = random.choice((0.05, 0.3, 1.0))
        noise = Noise(kind, rate, random.getrandbits(32), random.choice((0, 100, 300)))
        outcome = disturbed(noise, moment)
        assert outcome.problems == (), f"{k}: {noise}: {outcome.said[:600]}"


def test_drives_that_contradict_each_other_in_a_write_are_given_up_and_named():
    outcome = disturbed(Noise("answers", 0.3, 2343595180, quiet=100), Moment.WRITE)
    assert outcome.code == 7, outcome.said[:600]
    assert "two answers came about 0x2010:01 that differ" in outcome.said
    assert "two drives have this node id" in outcome.said
    assert "(table, object 0x1000:00: the drive's answer was wrong: two answers" in outcome.said
    assert outcome.problems == ()
