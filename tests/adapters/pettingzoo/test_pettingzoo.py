from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pettingzoo
import pytest

from adapters.pettingzoo import export
from adapters.pettingzoo import task as import_
from suite import registry
from suite.interface.batching import Batched
from suite.interface.turns import choose_event
from suite.runtime.errors import UserError
from tests.adapters.foreign import Game
from tests.adapters.pettingzoo.standard import check
from tests.contract import check_environment
from tests.tiny import Corridor, Pennies

PENNIES = Pennies()
EXPORTED = sorted(id for id, task in registry.tasks().items() if task.family == "openspiel")


# Out.


def test_standard_tests_of_a_tiny_game():
    check(PENNIES)


@pytest.mark.parametrize("id", EXPORTED)
def test_standard_tests(id):
    check(id)


def test_a_game_is_played_from_both_seats():
    env = export.raw_env(PENNIES)
    coins, firsts = [], []
    for game in range(200):
        env.reset(seed=0 if game == 0 else None)
        assert env.agent_selection == "player_1"  # chance has played
        observation, reward, terminated, truncated, _ = env.last()
        coin = int(observation["observation"][1]) - 1
        coins.append(coin)
        assert observation["action_mask"].tolist() == [1, 1]
        assert env.observe("player_2")["observation"].tolist() == [1, 0]
        assert env.observe("player_2")["action_mask"].tolist() == [0, 0]
        assert (reward, terminated, truncated) == (0, False, False)
        env.step(game % 2)
        assert env.agent_selection == "player_2"
        assert env.last()[0]["action_mask"].tolist() == [1, 0]
        env.step(0)
        won = 1.0 if coin == game % 2 else -1.0
        assert env.rewards == {"player_1": won, "player_2": -won}
        assert env.terminations == {"player_1": True, "player_2": True}
        assert not any(env.truncations.values())
        firsts.append(env.agent_selection)
        env.step(None)
        env.step(None)
        assert env.agents == []
    assert set(coins) == {0, 1} and 60 < sum(coins) < 140
    assert set(firsts) == {"player_1"}


def test_imported_is_exported_again():
    """Connect four there and back is the original, move by move."""
    original = pettingzoo.make("aec", "classic/connect_four_v3")
    ours = export.env(import_.make("connect_four_v3"))
    names = {"player_1": "player_0", "player_2": "player_1"}
    random = np.random.default_rng(0)
    for seed in range(5):
        original.reset(seed=seed)
        ours.reset(seed=seed)
        while ours.agents:
            assert names[ours.agent_selection] == original.agent_selection
            seen, reward, terminated, truncated, _ = ours.last()
            expected, *rest, _ = original.last()
            np.testing.assert_array_equal(seen["observation"], expected["observation"].ravel())
            assert (reward, terminated, truncated) == tuple(rest)
            if terminated:
                action = None
            else:
                np.testing.assert_array_equal(seen["action_mask"], expected["action_mask"])
                action = int(random.choice(np.flatnonzero(seen["action_mask"])))
            original.step(action)
            ours.step(action)
        assert original.agents == []


def test_render_says_what_is_seen():
    env = export.raw_env(PENNIES, render_mode="ansi")
    env.reset(seed=0)
    env.step(1)
    assert env.render() == "player_2 to act; player_1 sees [2, 0]; player_2 sees [2, 0]"
    env.step(0)
    assert env.render().startswith("over; ")
    assert export.raw_env(PENNIES).render() is None


def test_misuse_is_one_error():
    env = export.env(PENNIES)
    env.reset(seed=0)
    env.step(0)
    with pytest.raises(UserError, match=r"^illegal action 1 of player_2; legal: 0$"):
        env.step(1)
    for ask in (env.observe, env.action_space, env.observation_space):
        with pytest.raises(UserError, match=r"^no seat 'player_3'; valid: player_1, player_2$"):
            ask("player_3")
    env.step(0)
    with pytest.raises(UserError, match="one player"):
        export.env(Corridor())
    with pytest.raises(UserError, match="cannot be rendered as 'human'"):
        export.env(PENNIES, render_mode="human")
    with pytest.raises(UserError, match="unknown task"):
        export.env("nothing")


# In.


def test_imported_spec():
    spec = import_.spec("connect_four_v3")
    assert spec == import_.make("connect_four_v3").spec
    assert (spec.observation.shape, spec.observation.high, spec.observation.kind) == ((84,), 1, "symbols")
    assert (spec.num_actions, spec.reward_classes, spec.chance_outcomes) == (7, (-1.0, 0.0, 1.0), 0)
    assert spec.two_player and spec.package == "pettingzoo"
    for spelling in ("classic.connect_four_v3", "classic/connect_four_v3", "classic/connect_four-v3"):
        assert import_.spec(spelling).observation == spec.observation


def test_imported_contract():
    environment = import_.make("connect_four_v3")
    assert check_environment(environment, jax.random.key(0), steps=60, num_envs=4).ended.any()


def test_imported_equals_the_engine():
    """Every field, from both seats, over several games; ours batched and compiled, theirs driven directly."""
    T, B = 200, 2
    environment = import_.make("connect_four_v3")
    batched = Batched(environment, B)

    def event(carry, key):
        state, shown = carry
        choose_key, turn_key, step_key = jax.random.split(key, 3)
        ours_B = jax.random.categorical(choose_key, jnp.where(shown.turn.legal_A, 0.0, -jnp.inf)).astype(jnp.int32)
        event_B = choose_event(turn_key, shown.turn, ours_B)
        carry = batched.step(step_key, state, event_B)
        return carry, (shown.turn, event_B, *carry)

    start = jax.jit(batched.reset)(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), T)
    _, played = jax.jit(lambda start, keys: jax.lax.scan(event, start, keys))(start, keys)
    turn, event_TB, state, shown = jax.device_get(played)
    ends = 0
    for b in range(B):
        seat = b + 1
        env = pettingzoo.make("aec", "classic/connect_four_v3")
        ours, theirs = env.possible_agents[seat - 1], env.possible_agents[2 - seat]
        env.reset(seed=int(start[0].seed[b]))
        for t in range(T):
            acting = env.agent_selection
            assert turn.player[t, b] == env.possible_agents.index(acting) + 1
            assert turn.seat[t, b] == seat
            np.testing.assert_array_equal(turn.legal_A[t, b], env.observe(acting)["action_mask"])
            np.testing.assert_array_equal(turn.opponent_observation[t, b], env.observe(theirs)["observation"].ravel())
            env.step(int(event_TB[t, b]))
            np.testing.assert_array_equal(shown.final_observation[t, b], env.observe(ours)["observation"].ravel())
            assert shown.reward[t, b] == env.rewards[ours]
            assert shown.terminated[t, b] == all(env.terminations.values())
            assert not shown.truncated[t, b]
            if shown.terminated[t, b]:
                ends += 1
                env.reset(seed=int(state.seed[t, b]))
            np.testing.assert_array_equal(shown.observation[t, b], env.observe(ours)["observation"].ravel())
    assert ends >= 6


def test_a_game_goes_on_as_long_as_one_agent_lives():
    engine = import_.PettingZooEngine(Game(lives=(2, 4)), [lambda number: np.array([number], np.uint8)] * 2)
    shown = [engine.reset(0), *(engine.step(1) for _ in range(6))]
    assert [step.player for step in shown] == [1, 2, 1, 2, 2, 2, 2]
    assert [step.observation.ravel().tolist() for step in shown] == [
        *([0, 0], [1, 0], [1, 1], [2, 1], [2, 2], [2, 3], [2, 4])  # the dead one sees what it saw last
    ]
    assert [step.reward.tolist() for step in shown] == [[0, 0], [0, 0], [0, 0], [1, 0], [0, 0], [0, 0], [0, 1]]
    assert [step.terminated for step in shown] == 6 * [False] + [True]
    assert shown[5].legal_A.all() and not shown[6].legal_A.any()
