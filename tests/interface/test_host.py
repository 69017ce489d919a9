from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.interface.batching import Batched
from suite.interface.host import ENGINES_PER_ENVIRONMENT, MIN_ENGINES, HostEnvironment, HostStep
from suite.interface.random_play import reward_classes
from tests.contract import check_environment
from tests.tiny import PENNIES_SPEC, Pennies
from tests.walks import Walks


class HostPennies:
    """`tests.tiny.Pennies` on the host."""

    def reset(self, seed):
        self.player, self.coin, self.guess = 0, 0, 0
        return self._show(np.zeros(2), False)

    def step(self, action):
        if self.player == 0:
            self.coin = action // 2
        elif self.player == 1:
            self.guess = action
        over = self.player == 2
        reward = np.array([1, -1]) * (1 if self.coin == self.guess else -1) * over
        self.player = (self.player + 1) % 3
        return self._show(reward, over)

    def _show(self, reward, over):
        observation = [[self.player, 1 + self.coin if self.player == 1 else 0], [self.player, 0]]
        legal = [self.player > 0, self.player == 1]
        chance = [0.5, 0, 0.5] if self.player == 0 else [0, 0, 0]
        return HostStep(observation, reward, over, False, self.player, legal, chance)


def play(environment, key, steps, num_envs, start=None):
    """The start, and the states, time steps and actions of random play from it, [T, B]."""
    batched = Batched(environment, num_envs)

    def event(carry, key):
        action_key, step_key = jax.random.split(key)
        action_B = jax.random.randint(action_key, (num_envs,), 0, 2)
        carry = batched.step(step_key, carry[0], action_B)
        return carry, (*carry, action_B)

    start = batched.reset(key) if start is None else start
    return start, jax.lax.scan(event, start, jax.random.split(key, steps))[1]


def equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_contract():
    played = check_environment(Walks(), jax.random.key(0), steps=60)
    assert played.stepped.terminated.any() and played.stepped.truncated.any()


def test_game_equals_the_same_in_jax():
    host = HostEnvironment(PENNIES_SPEC, HostPennies, limit=9)
    ours = check_environment(host, jax.random.key(0), steps=40)
    theirs = check_environment(Pennies(), jax.random.key(0), steps=40)
    equal(ours.shown, theirs.shown)
    for name in ("observation", "reward", "terminated", "truncated"):
        equal(getattr(ours.stepped, name), getattr(theirs.stepped, name))


def test_a_step_advances_a_live_engine():
    environment, key = Walks(), jax.random.key(1)
    # No state depends on what the host answers, so that one program may call it for the first frames after the first
    # step, which then needs resets of its own. Two programs, one after the other, call in order.
    start = jax.block_until_ready(jax.jit(Batched(environment, 4).reset)(key))
    _, (_, shown, _) = jax.jit(lambda start: play(environment, key, 50, 4, start))(start)
    episodes_begun = 4 + int(shown.first.sum())  # waits for the program, whose calls are counted then
    assert environment.resets == episodes_begun
    assert len(environment.engines) <= max(MIN_ENGINES, 4 * ENGINES_PER_ENVIRONMENT)


def test_any_state_can_be_stepped_at_any_time():
    """In another order, one by one, by engines that never saw it, and two at a time: the same."""
    limit = 6
    start, (states, shown, actions) = jax.jit(lambda key: play(Walks(limit), key, 30, 4))(jax.random.key(2))
    before = jax.tree.map(lambda first, rest: np.concatenate([first[None], rest])[:-1], start[0], states)
    fresh = Walks(limit)
    step = jax.jit(fresh.step)
    order = np.random.default_rng(0).permutation(30 * 4)
    for t, b in zip(*np.unravel_index(order, (30, 4)), strict=True):
        _, stepped = step(jax.random.key(0), jax.tree.map(lambda a, t=t, b=b: a[t, b], before), actions[t, b])
        for name in ("reward", "terminated", "truncated", "final_observation"):
            equal(getattr(stepped, name), getattr(shown, name)[t, b])
    again = jax.jit(jax.vmap(jax.vmap(fresh.step, (None, 0, 0)), (None, 0, 0)))
    _, stepped = again(jax.random.key(0), before, actions)
    equal(stepped.final_observation, shown.final_observation)
    twice = jax.jit(jax.vmap(fresh.step, (None, None, 0)))
    one = jax.tree.map(lambda a: a[3, 0], before)
    _, both = twice(jax.random.key(0), one, jnp.array([0, 0], jnp.int32))
    equal(both.observation[0], both.observation[1])


def test_the_limit_truncates_what_has_not_ended():
    environment = Walks(limit=5)
    _, (states, shown, _) = jax.jit(lambda key: play(environment, key, 100, 8))(jax.random.key(3))
    at_limit = np.concatenate([np.zeros((1, 8), int), np.asarray(states.length)])[:-1] == 4
    np.testing.assert_array_equal(shown.truncated, at_limit & ~np.asarray(shown.terminated))
    assert (at_limit & np.asarray(shown.terminated)).any()


def test_no_step_after_the_end():
    environment = Walks(limit=1)
    state, _ = environment.reset(jax.random.key(0))
    state, shown = environment.step(jax.random.key(0), state, jnp.int32(0))
    assert shown.truncated
    with pytest.raises(Exception, match="after the end of an episode"):
        environment.step(jax.random.key(0), state, jnp.int32(0))


@pytest.mark.parametrize(
    ("rewards", "classes"),
    [
        ([], (0, 1)),
        ([0, 1], (0, 1)),
        ([-1, 20, -10], (-10, -1, 0, 20)),
        ([0.25, 1], (0, 0.25, 1)),
        ([0.1, 0.3, 0.7, 0.9], (0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1)),
        ([-1, 0.1, 0.3, 0.7], (-1, -0.8, -0.6, -0.4, -0.2, 0, 0.2, 0.4, 0.6, 0.8, 1)),
        ([1e-7, 3e-7], (0, 1e-7, 3e-7)),
        ([0.01, 0.03, 0.07, 0.0925], (0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08, 0.09, 0.1)),
        (range(-10, 10), tuple(round(1.9 * n, 6) for n in range(-6, 6))),
    ],
)
def test_reward_classes(rewards, classes):
    assert reward_classes(map(float, rewards)) == pytest.approx(classes, rel=1e-12)
