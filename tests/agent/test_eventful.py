"""What the replay buffer knows of rewards that were paid, and how it draws sequences in which something happens."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.agent.replay import Replay
from suite.interface.environment import EnvironmentSpec, ObservationSpec
from suite.policy.ppo import Trajectory

ENVS, ROOM, PART, STEPS, LENGTH, SKIPPED, ACTIONS = 2, 30, 11, 44, 5, 1, 3
SPEC = EnvironmentSpec("test", ObservationSpec((1,), 255, "symbols"), num_actions=ACTIONS, reward_classes=(0.0, 1.0))


def pays(reward):
    return reward >= 0.5


@pytest.fixture(scope="module", params=[22, STEPS], ids=["with room left", "wrapped around"])
def buffer(request):
    """A buffer, and what was written to it, [E, T]: actions, what pays, ends, first frames; frames show the time."""
    rng, steps = np.random.default_rng(0), request.param
    shape = (steps, ENVS)
    reward, ended = (rng.random(shape) < 0.3).astype(np.float32), rng.random(shape) < 0.05
    reward[rng.random(shape) < 0.5] += 0.3  # belongs to the level it is near
    first = np.concatenate([np.ones((1, ENVS), bool), ended[:-1]])
    action = rng.integers(0, ACTIONS, shape).astype(np.int32)
    frame = (np.arange(steps)[:, None] + [0, 100]).astype(np.uint8)[..., None]
    replay = Replay(num_envs=ENVS, length=ROOM)
    state = replay.init(SPEC, paid=True)
    for start in range(0, steps, PART):
        part = slice(start, start + PART)
        none = jnp.zeros((PART, ENVS))
        fields = {field.name: none for field in dataclasses.fields(Trajectory)} | {
            "observation_TB": jnp.asarray(frame[part]),
            "action_TB": jnp.asarray(action[part]),
            "reward_TB": jnp.asarray(reward[part]),
            "terminated_TB": jnp.asarray(ended[part]),
            "first_TB": jnp.asarray(first[part]),
            "turn_TB": None,
            "state_TB": None,
        }
        state = replay.add(state, Trajectory(**fields), pays)
    return replay, state, *(x.T for x in (action, pays(reward), ended, first))


def test_rewards_that_the_episode_has_paid(buffer):
    """Also those of steps that have been overwritten."""
    replay, state, action_ET, pays_ET, _, first_ET = buffer
    expected = np.zeros((*pays_ET.shape, ACTIONS), int)
    for env in range(ENVS):
        count = np.zeros(ACTIONS, int)
        for time in range(pays_ET.shape[1]):
            count = 0 * count if first_ET[env, time] else count
            expected[env, time] = count
            count[action_ET[env, time]] += pays_ET[env, time]
    assert expected.max() > 1
    sampled = replay.sample(state, jax.random.key(0), 300, LENGTH)
    env, time = np.divmod(np.asarray(sampled.observation[..., 0]), 100)
    np.testing.assert_array_equal(sampled.paid, expected[env, time])


def test_sequences_with_an_event(buffer):
    """A share of them is drawn; every other is drawn as rarely as its weight says, so that weighed means are right."""
    replay, state, _, pays_ET, ended_ET, _ = buffer
    oldest = max(0, pays_ET.shape[1] - ROOM)
    event_ET = (pays_ET | ended_ET)[:, oldest:]
    firsts = event_ET.shape[1] - LENGTH + 1
    holds = np.array([[row[t + SKIPPED : t + LENGTH - 1].any() for t in range(firsts)] for row in event_ET])
    eventful = replay.eventful(state, pays, LENGTH, SKIPPED)
    np.testing.assert_array_equal(eventful.holds_EL[:, :firsts], holds)
    assert not eventful.holds_EL[:, firsts:].any() and 0 < holds.sum() < holds.size
    number = 40_000
    sampled, weight_B = jax.jit(lambda key: replay.sample_eventful(state, key, number, LENGTH, eventful, 0.4))(
        jax.random.key(1)
    )
    env, time_BT = np.divmod(np.asarray(sampled.observation[..., 0]).astype(int), 100)
    np.testing.assert_array_equal(time_BT, time_BT[:, :1] + np.arange(LENGTH))
    place = (env[:, 0], time_BT[:, 0] - oldest)
    frequency = np.zeros(holds.shape)
    np.add.at(frequency, place, 1 / number)
    odds = 0.6 / holds.size + 0.4 * holds / holds.sum()
    assert (np.abs(frequency - odds) < 5 * np.sqrt(odds / number)).all()
    np.testing.assert_allclose(weight_B, 1 / (holds.size * odds[place]), rtol=1e-5)


def test_without_events_all_are_drawn_alike(buffer):
    replay, state, *_ = buffer
    none = replay.eventful(state, lambda reward: reward > 2, 2, skipped=1)  # of one step, which is skipped
    assert not none.holds_EL.any()
    _, weight_B = replay.sample_eventful(state, jax.random.key(0), 50, 2, none, 0.4)
    np.testing.assert_array_equal(weight_B, 1)
