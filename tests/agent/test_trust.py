"""What the world model learns from; and dreams teach only where it foresees rewards."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite import registry
from suite.agent.phases import Agent
from suite.interface.tokens import TokenSpec
from suite.runtime.errors import UserError
from suite.world_model.training import known_share, reward_frequency
from tests.tiny import WIDE_CORRIDOR, WideCorridor

SPEC = TokenSpec(tokens_per_frame=1, num_codes=2, num_actions=2, reward_classes=(-1.0, 0.0, 1.0))
REWARDS = jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
ENTROPY = 4 / 6 * jnp.log(6 / 4) + 2 * (1 / 6 * jnp.log(6.0))


@pytest.mark.parametrize(("loss", "known"), [(0.0, 1.0), (ENTROPY, 0.0), (ENTROPY / 4, 0.75), (2 * ENTROPY, -1.0)])
def test_what_is_known_of_rewards(loss, known):
    assert known_share(jnp.asarray(loss), reward_frequency(SPEC, REWARDS)) == pytest.approx(known, abs=1e-6)


def test_of_rewards_that_are_all_alike_nothing_is_known():
    assert known_share(jnp.asarray(0.3), reward_frequency(SPEC, 0 * REWARDS)) == 0


def test_no_dreams_below_the_threshold():
    config = registry.resolve("minatar/breakout", "m6", "small")
    after = config.imagination.start_step
    updates = [config.imagined_updates(after, known) for known in (0.49, 0.5, 1.0, None)]
    assert updates == [0, *[config.imagination.updates] * 3]
    assert config.imagined_updates(after - 1, 1.0) == 0


def test_the_true_game_needs_no_trust():
    with pytest.raises(UserError, match="its rewards are the true ones"):
        registry.resolve("minatar/breakout", "oracle", "small", ["imagination.trust=0.5"])


def test_the_window_needs_trust():
    with pytest.raises(UserError, match=r"trust_window=10 measures what imagination\.trust=0 does not ask for"):
        registry.resolve("minatar/breakout", "m5", "small", ["imagination.trust_window=10"])


@pytest.fixture(scope="module")
def agent():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "TASKS", (*registry.TASKS, WIDE_CORRIDOR))
        changes = ["imagination.trust=0.7", "imagination.trust_window=2", "world_model.patch_contents=true"]
        return Agent(registry.resolve("wide_corridor", "m5", "smoke", changes), WideCorridor())


def played(agent):
    """The state of a fresh agent, and the two trajectories that its buffer has room for."""
    state, rollout_state, trajectories = agent.init(jax.random.key(0)), None, []
    for key in jax.random.split(jax.random.key(1), 2):
        rollout_state, trajectory, _ = agent.collect(state.policy.acting, rollout_state or state.rollout, key)
        trajectories.append(trajectory)
    return state, trajectories


def test_it_learns_what_each_action_led_to(agent):
    """In the corridor frame and action say which frame, reward and end come next."""
    state, trajectories = played(agent)
    replay = state.replay
    for trajectory in trajectories:
        replay = agent.remember(replay, trajectory)
    tokenizer, _ = agent.update_tokenizer(state.tokenizer, replay, jax.random.key(3))
    replay = agent.code(replay, tokenizer, jnp.int32(0))
    bright_K = agent.tokenizer.contents(tokenizer).mean(-1) > 0.5
    keys = jax.random.split(jax.random.key(2), 32)
    shown = jax.jit(jax.vmap(lambda key: agent.replayed_sequences(tokenizer, replay, key)))(keys)
    position_BT = np.argmax(bright_K[shown.tokens_BTL], axis=-1)  # B: 32 minibatches of sequences
    before_BT, after_BT = position_BT[..., :-1], position_BT[..., 1:]
    arrives_BT = (before_BT == 2) & (shown.action_BT == 1)
    assert arrives_BT.any()
    np.testing.assert_array_equal(shown.reward_BT, arrives_BT)
    np.testing.assert_array_equal(shown.terminated_BT, arrives_BT)
    moved_BT = np.clip(before_BT + 2 * shown.action_BT - 1, 0, 3)
    np.testing.assert_array_equal(after_BT[~shown.ended_BT], moved_BT[~shown.ended_BT])
    assert shown.ended_BT[arrives_BT].all()


def test_the_newest_steps_measure_a_model_that_has_not_learned_from_them(agent):
    """The buffer holds two iterations: no step of the first one pays, every step of the second one does."""
    state, trajectories = played(agent)
    replay = state.replay
    for reward, trajectory in enumerate(trajectories):
        paid = dataclasses.replace(trajectory, reward_TB=jnp.full_like(trajectory.reward_TB, reward))
        replay = agent.remember(replay, paid)
    tokenizer, _ = agent.update_tokenizer(state.tokenizer, replay, jax.random.key(3))
    replay = agent.code(replay, tokenizer, jnp.int32(0))
    contents_KP = agent.tokenizer.contents(tokenizer)
    assert np.asarray(contents_KP).any()
    model_state, expected = state.world_model, jnp.zeros(3)
    measure = jax.jit(agent.measure_rewards)
    for key in jax.random.split(jax.random.key(2), 2):
        now = measure(model_state.with_contents(contents_KP).dreaming, tokenizer, replay, jax.random.fold_in(key, 0))
        np.testing.assert_array_equal(now[1:], [0, 1])
        expected = expected + (now - expected) / 2
        model_state, metrics = agent.update_world_model(model_state, tokenizer, replay, key)
        np.testing.assert_allclose(model_state.measured, expected, rtol=1e-5)
        np.testing.assert_array_equal(model_state.dreaming["contents"][...], contents_KP)
        assert metrics["reward_known"] == 0  # for all rewards that were measured are alike
    assert metrics["reward_loss"] < now[0]  # half of the steps that it learned from pay, and it had begun to say so
