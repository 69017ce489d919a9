"""Codes are drawn as often as they are likely, on a CPU by runs of codes, and never one that is not filled."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.nn.sampling import _draw_by_noise, draw

DRAWS = 20_000


def frequencies(odds_K, sample):
    drawn_N = sample(jax.random.key(0), jnp.broadcast_to(odds_K, (1, DRAWS, len(odds_K))))[0]
    return np.bincount(drawn_N, minlength=len(odds_K)) / DRAWS


@pytest.mark.parametrize("codes", [3, 32, 70, 1000])
@pytest.mark.parametrize("sample", [draw, _draw_by_noise], ids=["draw", "noise"])
def test_codes_come_as_often_as_they_are_likely(codes, sample):
    rng = np.random.default_rng(codes)
    odds_K = rng.dirichlet(np.full(codes, 0.3)) * (rng.random(codes) < 0.7)
    odds_K[0] = odds_K[-1] = 0  # as codes that are not filled
    odds_K[32:64] = 0  # a whole run
    odds_K[codes // 2] += 1e-3
    odds_K = (odds_K / odds_K.sum()).astype(np.float32)
    found_K = frequencies(odds_K, sample)
    assert not found_K[odds_K == 0].any()
    assert (np.abs(found_K - odds_K) < 5 * np.sqrt(odds_K / DRAWS) + 4 / DRAWS).all()


def test_codes_next_to_a_likely_one():
    """What is left of the random number within a run is worth as much as a number of its own."""
    odds_K = np.full(64, 1e-3, np.float32)
    odds_K[[5, 40]] = 0.5 - 31e-3
    found_K = frequencies(odds_K, draw)
    assert (np.abs(found_K - odds_K) < 5 * np.sqrt(odds_K / DRAWS)).all()


def test_codes_less_likely_than_a_share_of_the_likeliest_are_left_out():
    found_K = frequencies(np.array([0.5, 0.3, 0.09, 0.11], np.float32), lambda *odds: draw(*odds, 0.2))
    np.testing.assert_allclose(found_K, np.array([0.5, 0.3, 0, 0.11]) / 0.91, atol=0.02)
