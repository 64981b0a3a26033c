"""Random frames on the bus: no traceback, no hang, drives off, no wrong write."""

from random import Random

import pytest

from tests.faults.bench import Moment
from tests.faults.fuzz_bus import HARMLESS, Noise, disturbed
from tests.seeds import fresh_seed

SEED = fresh_seed()


@pytest.mark.parametrize("kind", HARMLESS)
def test_frames_that_are_nobodys_do_not_matter(kind):
    print("seed", SEED)
    outcome = disturbed(Noise(kind, 3.0, SEED))
    assert outcome.code == 0, outcome.said[:600]
    assert outcome.frames > 10_000
    assert outcome.problems == ()


def test_frames_that_are_not_canopens_do_not_matter_to_a_write():
    outcome = disturbed(Noise("likenesses", 3.0, SEED), Moment.WRITE)
    assert outcome.code == 0, outcome.said[:600]
    assert outcome.frames > 300
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


@pytest.mark.parametrize(
    ("noise", "moment"),
    [
        (Noise("answers", 0.3, 2343595180, quiet=100), Moment.WRITE),
        (Noise("answers", 0.05, 589927323, quiet=300), Moment.SWEEP),
        (Noise("answers", 0.3, 1184570331, quiet=100), Moment.SWEEP),
        (Noise("answers", 0.3, 1630593117, quiet=100), Moment.WRITE),
    ],
    ids=[
        "called a node without a pause",
        "did not say what was not put back",
        "put back what a wrong answer had said",
        "took back what a wrong answer had said",
    ],
)
def test_what_went_wrong_once(noise, moment):
    outcome = disturbed(noise, moment)
    assert outcome.problems == (), outcome.said[:600]
