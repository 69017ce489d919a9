"""Craftax-classic as a pure environment: worlds, endings, rewards. Its frames: test_craftax_classic_renderer.py."""

from __future__ import annotations

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

from adapters.craftax.task import CLASSIC_SPEC, classic_built_in_auto_reset, make_classic


def test_achievements_are_those_of_the_game_in_its_order():
    from craftax.craftax_classic.constants import Achievement, Action

    assert CLASSIC_SPEC.achievements == tuple(a.name.lower() for a in sorted(Achievement, key=lambda a: a.value))
    assert len(CLASSIC_SPEC.achievements) == CLASSIC_SPEC.max_return == 22
    assert set(CLASSIC_SPEC.achievement_rewards) == {1.0}
    assert CLASSIC_SPEC.num_actions == len(Action) == 17
    assert CLASSIC_SPEC.action_names == tuple(a.name.lower() for a in Action)


def test_death_terminates_and_the_limit_truncates(play):
    assert play.stepped.terminated[0].tolist()[:4] == [True, False, True, False]
    assert play.stepped.truncated[0].tolist()[:4] == [False, True, False, False]
    assert play.stepped.truncated[9, 4] and play.stepped.truncated[19, 5] and play.stepped.truncated[29, 6]


def test_death_costs_health(play):
    np.testing.assert_allclose(play.stepped.reward[0, [0, 2]], -0.9, atol=1e-6)
    np.testing.assert_allclose(play.stepped.statistics["health_return"][0, [0, 2]], -0.9, atol=1e-6)


def test_random_play_achieves_and_is_counted(play):
    statistics = play.stepped.statistics
    assert statistics["achievement_return"].max() >= 2
    assert (play.stepped.reward > 0.5).sum() >= 5


def test_a_new_episode_counts_from_zero(play):
    begun = play.ended[:-1]
    np.testing.assert_array_equal(play.states.timestep[1:-1][begun], 0)
    assert not play.fresh.statistics["achievements"].any()
    assert (play.states.timestep[2:][begun] <= 1).all()


def test_batched_worlds_are_the_single_ones(environment):
    """jaxlib 0.10.2 gets this wrong on a CPU for every index from 8 on."""
    keys = jax.random.split(jax.random.key(11), 16)
    batched = jax.jit(jax.vmap(environment.reset))(keys)
    reset = jax.jit(environment.reset)
    for index, key in enumerate(keys):
        state, shown = reset(key)
        np.testing.assert_array_equal(batched[0].map[index], state.map, err_msg=f"world {index}")
        np.testing.assert_array_equal(batched[1].observation[index], shown.observation)
    maps = np.asarray(batched[0].map).reshape(16, -1)
    assert len(np.unique(maps, axis=0)) == 16


def test_built_in_auto_reset():
    """What `suite bench` compares with plays the same game: the types and the first frames' ranges agree."""
    built_in = classic_built_in_auto_reset(2)
    key, action_B = jax.random.key(0), jnp.zeros(2, jnp.int32)
    first = jax.eval_shape(built_in.reset, key)
    then = jax.eval_shape(built_in.step, key, first[0], action_B)
    assert [(a.shape, a.dtype, a.weak_type) for a in jax.tree.leaves(first)] == [
        (a.shape, a.dtype, a.weak_type) for a in jax.tree.leaves(then)
    ]
    assert first[1].observation.shape == (2, 63, 63, 3)


def test_making_reports_progress():
    seen = []
    assert make_classic(lambda message, fraction: seen.append(fraction)).spec is CLASSIC_SPEC
    assert seen[0] == 0.0 and seen[-1] == 1.0


def test_the_specification_loads_no_game():
    code = "import sys, adapters.craftax.task; sys.exit('craftax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
