"""Dreams in the true game: they start from real states and follow the game's own rules."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite import registry
from suite.agent.phases import Agent
from suite.agent.replay import Replay
from suite.interface.batching import Batched
from tests.tiny import WIDE_CORRIDOR, WideCorridor


@pytest.fixture(scope="module")
def agent():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "TASKS", (*registry.TASKS, WIDE_CORRIDOR))
        config = registry.resolve("wide_corridor", "oracle", "smoke", ["imagination.num_envs=64"])
    return Agent(config, WideCorridor())


@pytest.fixture(scope="module")
def played(agent):
    """The agent's state, with 8 real steps of each environment in the replay buffer, and those steps."""
    state = agent.init(jax.random.key(0))
    rollout_state, trajectory, _ = agent.collect(state.policy.acting, state.rollout, jax.random.key(1))
    return dataclasses.replace(
        state, rollout=rollout_state, replay=agent.remember(state.replay, trajectory)
    ), trajectory


def test_replay_keeps_each_frames_own_state(agent, played):
    state, trajectory = played
    stored = state.replay.experience
    frame = jax.vmap(jax.vmap(lambda s: WideCorridor()._show(s, *[jnp.float32(0)] * 4).observation))(stored.state)
    steps = len(trajectory.first_TB)
    np.testing.assert_array_equal(frame[:, :steps], stored.observation[:, :steps])
    assert len(np.unique(stored.state.position[:, :steps])) > 1


def test_a_dream_is_the_game_from_replayed_states(agent, played):
    """Every imagined frame, reward and end follows from the state in which the dream began and from its actions."""
    state, _ = played
    dream = jax.jit(lambda *x: agent.dream(x[0], None, None, *x[1:]))(state.policy, state.replay, jax.random.key(2))
    cell_TB = np.asarray(dream.observation_TB)[:, :, ::5, ::5, 0].reshape(*dream.action_TB.shape, 4).argmax(-1)
    action_TB, reward_TB, end_TB = (np.asarray(x) for x in (dream.action_TB, dream.reward_TB, dream.terminated_TB))
    arrived_TB = np.clip(cell_TB + 2 * action_TB - 1, 0, 3)
    np.testing.assert_array_equal(reward_TB, arrived_TB == 3)
    np.testing.assert_array_equal(end_TB, arrived_TB == 3)
    on_TB = ~(end_TB | np.asarray(dream.truncated_TB))[:-1]
    np.testing.assert_array_equal(cell_TB[1:][on_TB], arrived_TB[:-1][on_TB])
    assert len(np.unique(cell_TB[0])) > 1 and end_TB.any()


def test_a_dream_in_the_game_ends_when_the_game_does(agent, played):
    """The step count of the state goes on: a dream from an episode's last step but one is cut off by the time limit."""
    state, _ = played
    replay = state.replay
    stored = dataclasses.replace(replay.experience.state, time=jnp.full_like(replay.experience.state.time, 5))
    late = replay.replace(experience=dataclasses.replace(replay.experience, state=stored))
    dream = jax.jit(lambda *x: agent.dream(x[0], None, None, *x[1:]))(state.policy, late, jax.random.key(2))
    assert (dream.terminated_TB[0] | dream.truncated_TB[0]).all()


def test_an_annealed_rate_falls_in_dreams_too(agent, played):
    """After half of the budget a dream moves the policy half as far as at the beginning; at the end, not at all."""
    config = dataclasses.replace(agent.config, ppo=dataclasses.replace(agent.config.ppo, anneal_learning_rate=True))
    annealed, (state, _) = Agent(config, WideCorridor()), played

    def moved(steps):
        before = jax.tree.map(jnp.copy, state.policy)
        one, taken = jnp.asarray(1, jnp.int32), jnp.asarray(steps, jnp.float32)
        after, _ = annealed.imagine(before, None, None, state.replay, jax.random.key(3), one, taken)
        changes = jax.tree.map(lambda new, old: new - old, after.params, state.policy.params)
        return np.concatenate([np.ravel(change) for change in jax.tree.leaves(changes)])

    whole, half, none = (moved(share * config.total_steps) for share in (0, 0.5, 1))
    assert np.abs(whole).max() > 1e-5 and not none.any()
    np.testing.assert_allclose(half, whole / 2, atol=1e-6)


def test_recent_steps_only(agent, played):
    """Sequences end in the latest steps of each environment, and are the buffer's, also after it has wrapped around."""
    replay = Replay(num_envs=2, length=7)
    state = replay.init(WideCorridor.spec)
    _, trajectory = played
    few = jax.tree.map(
        lambda x: x[:5, :2], dataclasses.replace(trajectory, state_TB=None, hidden_BH=None, last_value_B=None)
    )
    for start in range(0, 15, 5):
        numbered = dataclasses.replace(few, action_TB=jnp.arange(start, start + 5)[:, None] + jnp.array([[0, 100]]))
        state = replay.add(state, numbered)
    sampled = replay.sample(state, jax.random.key(0), 200, 3, recent=2).action
    assert set(map(tuple, sampled.tolist())) == {
        tuple(range(row + end - 2, row + end + 1)) for row in (0, 100) for end in (13, 14)
    }


def test_resumed_environments_step_as_the_batch_does():
    batched = Batched(WideCorridor(), 3)
    state, shown = batched.reset(jax.random.key(0))
    resumed = batched.resumed(state, shown.observation, shown.first, None)
    again, same = resumed.reset(jax.random.key(9))
    jax.tree.map(np.testing.assert_array_equal, (again, same), (state, shown))
    action = jnp.array([1, 0, 1])
    expected = batched.step(jax.random.key(1), state, action)
    jax.tree.map(np.testing.assert_array_equal, resumed.step(jax.random.key(1), again, action), expected)


def test_a_game_on_the_host_cannot_be_dreamt_in(suite, tmp_path):
    code, _, error = suite("run", "openspiel/connect_four", "--agent", "oracle", "--preset", "smoke", "--out", tmp_path)
    *_, last = error.strip().splitlines()  # behind what the progress bar has printed
    assert code == 2 and last.startswith("error: ") and "connect_four steps on the host" in last


def test_describe_says_what_keeping_states_takes(suite):
    code, out, _ = suite("describe", "minatar/breakout", "--agent", "oracle", "--preset", "small")
    assert code == 0 and "replay memory (MiB)" in out and "the environments' own states" in out
    code, out, _ = suite("describe", "minatar/breakout", "--agent", "m5", "--preset", "small")
    assert code == 0 and "replay memory (MiB)" in out and "own states" not in out
