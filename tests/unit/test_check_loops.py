"""What the pilot shows is believed of loops only where a machine could do so."""

from types import SimpleNamespace

import numpy as np
import pytest

from fieldtool.errors import LoopUnstableError, NotEnoughDataError
from fieldtool.workflow.stopped import check_loops


def setting(rate):
    """One axis, whose loop grows at this rate, 1/s."""
    matrix = np.array([[rate, 0.0], [0.0, -1.0]])
    loop = SimpleNamespace(stable=rate <= 0, system_matrix=lambda: matrix)
    model = SimpleNamespace(names=("arm",), first_masses=[0])
    return SimpleNamespace(closed_loop=lambda _: loop, model=model)


def test_a_loop_that_grows_is_unstable():
    check_loops(setting(-5.0))
    with pytest.raises(LoopUnstableError, match=r"arm: its loop is unstable: .* in 0\.2 s"):
        check_loops(setting(5.0))


def test_a_growth_that_no_machine_has_is_no_word_on_loops():
    with pytest.raises(NotEnoughDataError, match=r"arm: the pilot did not show .*--plan classic"):
        check_loops(setting(2.6e31))
