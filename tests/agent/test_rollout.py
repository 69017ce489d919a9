"""The one rollout: alignment, memory, truncation values, burn-in, other players' events."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from suite.agent import rollout as play
from suite.configuration.schema import PolicyConfig
from suite.interface.batching import Batched
from suite.policy.actor_critic import make_policy
from suite.policy.ppo import TargetStatistics
from tests.tiny import Corridor, Pennies

POLICY = PolicyConfig(
    cnn_channels=(4,), blocks_per_stack=1, convs_per_block=1, rnn_size=8, hidden_size=16, dense_blocks=1
)
TARGETS = TargetStatistics.create(0.1)
B, T, M = 3, 20, 4


def setup(environment, seed=0):
    policy = make_policy(POLICY, environment.spec.observation, environment.spec.num_actions, nnx.Rngs(seed))
    batched = Batched(environment, B)
    return policy, batched, play.start(policy, batched, jax.random.key(seed), M)


def roll(environment, length=T, seed=0, rollout_state=None):
    policy, batched, fresh = setup(environment, seed)
    run = jax.jit(lambda p: play.rollout(jax.random.key(seed + 1), policy, TARGETS, batched, p, length))
    return policy, *run(fresh if rollout_state is None else rollout_state)


@pytest.fixture(scope="module")
def corridor():
    return roll(Corridor())


def test_rewards_and_ends_stand_beside_the_action_that_caused_them(corridor):
    _, _, trajectory, _ = corridor
    cell_TB = trajectory.observation_TB[:, :, ::2, ::2, 0].reshape(T, B, 4).argmax(-1)
    arrives_TB = (cell_TB == 2) & (trajectory.action_TB == 1)
    chex.assert_trees_all_equal(arrives_TB, trajectory.terminated_TB)
    chex.assert_trees_all_equal(arrives_TB.astype(jnp.float32), trajectory.reward_TB)
    ended_TB = trajectory.terminated_TB | trajectory.truncated_TB
    assert bool(trajectory.first_TB[0].all())
    chex.assert_trees_all_equal(ended_TB[:-1], trajectory.first_TB[1:])
    assert trajectory.truncated_TB.sum() > 0
    assert trajectory.terminated_TB.sum() > 0


def test_recorded_probabilities_and_values_are_those_of_the_sequence(corridor):
    policy, _, trajectory, _ = corridor
    output, _ = policy(trajectory.observation_TB, trajectory.first_TB, trajectory.hidden_BH)
    log_TBA = jax.nn.log_softmax(output.logits_TBA)
    expected_TB = jnp.take_along_axis(log_TBA, trajectory.action_TB[..., None], -1)[..., 0]
    chex.assert_trees_all_close(trajectory.log_probability_TB, expected_TB, atol=1e-5)
    chex.assert_trees_all_close(trajectory.value_TB, output.value_TB, atol=1e-5)


def test_a_truncated_step_has_the_value_of_the_frame_it_led_to(corridor):
    policy, _, trajectory, _ = corridor
    assert (jnp.where(trajectory.truncated_TB, 0, trajectory.truncation_value_TB) == 0).all()
    t, b = (int(i) for i in np.argwhere(trajectory.truncated_TB)[0])
    # The frame the step led to is not in the trajectory; play the corridor by hand to see it.
    cell = int(trajectory.observation_TB[t, b, ::2, ::2, 0].reshape(4).argmax())
    cell = min(max(cell + 2 * int(trajectory.action_TB[t, b]) - 1, 0), 3)
    frame = np.zeros((2, 2), np.uint8)
    frame.reshape(4)[cell] = 255
    frame = frame.repeat(2, 0).repeat(2, 1)[..., None]
    observation_T = jnp.concatenate([trajectory.observation_TB[: t + 1, b], jnp.asarray(frame)[None]])
    first_T = jnp.append(trajectory.first_TB[: t + 1, b], False)
    output, _ = policy(observation_T[:, None], first_T[:, None], trajectory.hidden_BH[b][None])
    chex.assert_trees_all_close(trajectory.truncation_value_TB[t, b], output.value_TB[-1, 0], atol=1e-5)


def test_the_log_adds_up_whole_episodes(corridor):
    _, _, trajectory, log = corridor
    for b in range(B):
        total, length = 0.0, 0
        for t in range(T):
            total, length = total + float(trajectory.reward_TB[t, b]), length + 1
            assert float(log.return_TB[t, b]) == total
            assert int(log.length_TB[t, b]) == length
            if log.ended_TB[t, b]:
                total, length = 0.0, 0


def test_a_second_rollout_goes_on_where_the_first_stopped():
    policy, rollout_state, first, _ = roll(Corridor(), length=8)
    _, rollout_state, second, _ = roll(Corridor(), length=8, rollout_state=rollout_state)
    observation_TB = jnp.concatenate([first.observation_TB, second.observation_TB])
    first_TB = jnp.concatenate([first.first_TB, second.first_TB])
    output, hidden_BH = policy(observation_TB, first_TB, first.hidden_BH)
    chex.assert_trees_all_close(second.value_TB, output.value_TB[8:], atol=1e-5)
    chex.assert_trees_all_close(rollout_state.hidden_BH, hidden_BH, atol=1e-5)


def test_burn_in_with_unchanged_parameters_changes_nothing_and_follows_new_ones():
    policy, rollout_state, _, _ = roll(Corridor())
    same = play.refresh(policy, rollout_state, carried=True)
    chex.assert_trees_all_close(same.hidden_BH, rollout_state.hidden_BH, atol=1e-5)
    other = setup(Corridor(), seed=9)[0]
    fresh = play.refresh(other, rollout_state, carried=True)
    assert not np.allclose(fresh.hidden_BH, rollout_state.hidden_BH, atol=1e-3)


def test_burn_in_from_zero_sees_only_the_recent_frames():
    policy, rollout_state, trajectory, _ = roll(Corridor(limit=100))
    forgotten = play.refresh(policy, rollout_state, carried=False)
    expected = policy.advance(
        trajectory.observation_TB[-M:], trajectory.first_TB[-M:], jnp.zeros_like(rollout_state.hidden_BH)
    )
    chex.assert_trees_all_close(forgotten.hidden_BH, expected, atol=1e-5)
    no_end_B = ~trajectory.first_TB[-M:].any(0)
    assert bool(no_end_B.any())
    difference_B = jnp.abs(forgotten.hidden_BH - rollout_state.hidden_BH).max(-1)
    assert (difference_B[no_end_B] > 1e-5).all()


def test_events_of_chance_and_the_opponent_are_theirs():
    policy, rollout_state, trajectory, _ = roll(Pennies())
    player_TB = jnp.arange(T)[:, None] % 3 + jnp.zeros((T, B), jnp.int32)
    chex.assert_trees_all_equal(trajectory.acting_TB, player_TB == 1 + jnp.arange(B)[None] % 2)
    chance = trajectory.action_TB[player_TB == 0]
    assert set(chance.tolist()) == {0, 2}  # outcome 1 has probability zero
    assert (trajectory.action_TB[player_TB == 2] == 0).all()  # the only legal action
    # Our memory moves on our turns only: the whole sequence with the acting mask gives the same values.
    output, hidden_BH = policy(
        trajectory.observation_TB, trajectory.first_TB, trajectory.hidden_BH, trajectory.acting_TB
    )
    chex.assert_trees_all_close(trajectory.value_TB, output.value_TB, atol=1e-5)
    chex.assert_trees_all_close(rollout_state.hidden_BH, hidden_BH, atol=1e-5)


def test_seeds_are_a_batch_axis():
    policy, batched, _ = setup(Corridor(limit=3))

    def whole(key):
        rollout_state = play.start(policy, batched, key, M)
        return play.rollout(key, policy, TARGETS, batched, rollout_state, 8)[1:]

    keys = jax.random.split(jax.random.key(3), 2)
    together = jax.jit(jax.vmap(whole))(keys)
    alone_of = jax.jit(whole)
    for i in range(2):
        alone = alone_of(keys[i])
        chex.assert_trees_all_close(jax.tree.map(lambda x, i=i: x[i], together), alone, atol=1e-5)
