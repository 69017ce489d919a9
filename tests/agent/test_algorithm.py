"""What Algorithm 1's iterations share, and what they do not."""

from __future__ import annotations

import jax
import numpy as np

from suite.agent.algorithm import evaluation_key, iteration_key, start_key


def test_no_two_parts_of_any_two_runs_have_the_same_randomness():
    keys = []
    for seed in (0, 1, 7):
        keys += [start_key(seed), *(iteration_key(seed, i) for i in range(5))]
        keys += [evaluation_key(seed, step) for step in (0, 1_024, 2_048)]
    assert len({tuple(np.asarray(jax.random.key_data(key)).tolist()) for key in keys}) == len(keys)
    assert (jax.random.key_data(iteration_key(7, 3)) == jax.random.key_data(iteration_key(7, 3))).all()
