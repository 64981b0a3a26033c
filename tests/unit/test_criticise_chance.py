"""The test on unseen data: fair under chance, also where errors are correlated."""

import numpy as np
from scipy.signal import lfilter

from fieldtool.criticise.search.significance import chance


def test_chance_alone_is_seldom_called_more(fresh_rng):
    rng = fresh_rng
    called = sum(chance(rng.normal(size=60))[1] < 0.01 for _ in range(600))
    assert called <= 18  # 6 expected


def test_correlated_blocks_do_not_make_it_sure(fresh_rng):
    rng = fresh_rng
    called = 0
    for _ in range(600):
        gains = lfilter([1.0], [1.0, -0.5], rng.normal(size=120))
        called += chance(gains)[1] < 0.01
    assert called <= 24  # 8 expected at the 1 % level, 5.7 standard errors


def test_few_correlated_blocks_do_not_make_it_sure_either(fresh_rng):
    rng = fresh_rng
    called = 0
    for _ in range(600):
        gains = lfilter([1.0], [1.0, -0.5], rng.normal(size=80))[50:]
        called += chance(gains)[1] < 0.01
    assert called <= 26  # 8 expected for 30 blocks: 6 standard errors


def test_a_steady_gain_is_seen(fresh_rng):
    rng = fresh_rng
    t, p = chance(1.0 + rng.normal(size=60))
    assert t > 4.0
    assert p < 1e-3


def test_no_difference_is_no_gain():
    assert chance(np.zeros(30)) == (0.0, 1.0)
