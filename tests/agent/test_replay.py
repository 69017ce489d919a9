"""What the replay buffer counts, and how it draws sequences in which something happens."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite import registry
from suite.agent.replay import Replay
from suite.policy.ppo import Trajectory
from suite.runtime.errors import UserError
from tests.tiny import WideCorridor

ENVS, ROOM, STEPS, LENGTH, SKIPPED = 2, 30, 44, 5, 1
SPEC = WideCorridor.spec


@pytest.fixture(scope="module", params=[22, STEPS], ids=["with room left", "wrapped around"])
def buffer(request):
    """A buffer, and what was written to it, [E, T]: rewards, ends and first frames."""
    rng = np.random.default_rng(0)
    shape = (STEPS, ENVS)
    reward, ended = (rng.random(shape) < 0.15).astype(np.float32), rng.random(shape) < 0.1
    reward[rng.random(shape) < 0.5] += 0.3  # belongs to the level it is near
    first = np.concatenate([np.ones((1, ENVS), bool), ended[:-1]])
    replay = Replay(num_envs=ENVS, length=ROOM)
    state = replay.init(SPEC)
    steps = request.param
    for start in range(0, steps, 11):
        part = slice(start, start + 11)
        none = jnp.zeros((11, ENVS))
        fields = {field.name: none for field in dataclasses.fields(Trajectory)} | {
            "observation_TB": jnp.zeros((11, ENVS, *SPEC.observation.shape), jnp.uint8),
            "action_TB": jnp.arange(start, start + 11, dtype=jnp.int32)[:, None] + jnp.array([[0, 100]], jnp.int32),
            "reward_TB": jnp.asarray(reward[part]),
            "terminated_TB": jnp.asarray(ended[part]),
            "first_TB": jnp.asarray(first[part]),
            "turn_TB": None,
            "state_TB": None,
        }
        state = replay.add(state, Trajectory(**fields))
    kept = slice(max(0, steps - ROOM), steps)
    return replay, state, *(x[kept].T for x in (reward >= 0.5, ended, first))


def test_rewards_that_the_episode_has_paid(buffer):
    replay, state, pays_ET, _, first_ET = buffer
    expected = np.zeros(pays_ET.shape, int)
    for env in range(ENVS):
        count = 0
        for time in range(pays_ET.shape[1]):
            count = 0 if first_ET[env, time] else count
            expected[env, time] = count
            count += pays_ET[env, time]
    assert expected.max() > 1
    counting = replay.counting(state, SPEC.pays)
    sampled = replay.sample(counting, jax.random.key(0), 300, LENGTH)
    env, time = np.divmod(np.asarray(sampled.action), 100)
    oldest = time.min()
    np.testing.assert_array_equal(sampled.paid, expected[env, time - oldest])


def test_sequences_with_an_event(buffer):
    """A share of them is drawn; every other is drawn as rarely as its weight says, so that weighed means are right."""
    replay, state, pays_ET, ended_ET, _ = buffer
    event_ET = pays_ET | ended_ET
    firsts = event_ET.shape[1] - LENGTH + 1
    holds = np.array([[row[t + SKIPPED : t + LENGTH - 1].any() for t in range(firsts)] for row in event_ET])
    eventful = replay.eventful(state, SPEC.pays, LENGTH, SKIPPED)
    np.testing.assert_array_equal(eventful.holds_EL[:, :firsts], holds)
    assert not eventful.holds_EL[:, firsts:].any() and 0 < holds.sum() < holds.size
    number = 40_000
    sampled, weight_B = jax.jit(lambda key: replay.sample_eventful(state, key, number, LENGTH, eventful, 0.4))(
        jax.random.key(1)
    )
    action_BT = np.asarray(sampled.action)
    env, time = np.divmod(action_BT[:, 0], 100)
    np.testing.assert_array_equal(action_BT, action_BT[:, :1] + np.arange(LENGTH))
    oldest = action_BT.min()
    frequency = np.zeros(holds.shape)
    np.add.at(frequency, (env, time - oldest), 1 / number)
    odds = 0.6 / holds.size + 0.4 * holds / holds.sum()
    assert (np.abs(frequency - odds) < 5 * np.sqrt(odds / number)).all()
    np.testing.assert_allclose(weight_B, 1 / (holds.size * odds[env, time - oldest]), rtol=1e-5)


def test_without_events_all_are_drawn_alike(buffer):
    replay, state, *_ = buffer
    none = replay.eventful(state, lambda reward: reward > 2, 2, skipped=1)  # of one step, which is skipped
    assert not none.holds_EL.any()
    _, weight_B = replay.sample_eventful(state, jax.random.key(0), 50, 2, none, 0.4)
    np.testing.assert_array_equal(weight_B, 1)


def test_more_rewards_than_there_are_measure_no_trust():
    overrides = ["world_model.event_share=0.3", "imagination.trust=0.5"]
    with pytest.raises(UserError, match=r"event_share=0\.3 replays more rewards than there are"):
        registry.resolve("craftax_classic", "m5", "small", overrides)
