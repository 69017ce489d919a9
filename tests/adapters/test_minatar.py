"""Our games against the original package, step by step, with the same randomness."""

from __future__ import annotations

import importlib
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from adapters.minatar import GAMES, MinAtar
from adapters.numerics import loose_numerics
from suite import registry
from suite.runtime.errors import UserError

EPISODES = {"asterix": 100, "breakout": 100, "freeway": 10, "seaquest": 100, "space_invaders": 100}
# Freeway's are 2,500 steps each.
LIMITS = {"asterix": 1000, "breakout": 1000, "freeway": 2500, "seaquest": 1000, "space_invaders": 1000}
OXYGEN = 7  # of Seaquest's planes
LETTERS = {"none": "n", "left": "l", "up": "u", "right": "r", "down": "d", "fire": "f"}


def original(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the package is older than its dependencies
        return importlib.import_module(f"minatar.environments.{name}").Env()


def play(game: MinAtar, steps: int):
    """The first episodes of `EPISODES` environments under random play: what each was given and what it showed.

    Leading axes [T, B]; `dealt` is what `deals` finds of the random outcomes that gymnax would use in each step.
    """
    start_keys, step_keys = jax.random.split(jax.random.key(7))
    batch = EPISODES[game.spec.id.partition("/")[2]]
    state, shown = jax.jit(jax.vmap(game.reset))(jax.random.split(start_keys, batch))

    # Surfacing without a diver ends Seaquest: without restraint, games last 25 steps and nothing is ever hit.
    rare = {"minatar/seaquest": "up"}.get(game.spec.id)
    likely = jnp.array([-3.0 if action == rare else 0.0 for action in GAMES[game.spec.id.partition("/")[2]].actions])

    def step(state, key):
        action_key, game_key = jax.random.split(key)
        action_B = jax.random.categorical(action_key, likely, shape=(batch,))
        keys_B = jax.random.split(game_key, batch)
        dealt = jax.vmap(lambda key, state: deals(game, key, state))(keys_B, state)
        state, after = jax.vmap(game.step)(keys_B, state, action_B)
        return state, (action_B, after, dealt)

    _, (actions, after, dealt) = jax.jit(lambda s: jax.lax.scan(step, s, jax.random.split(step_keys, steps)))(state)
    return jax.tree.map(np.asarray, (state, shown, actions, after, dealt))


def deals(game: MinAtar, key, state):
    """A step's random outcomes: Asterix's next entity, Freeway's speeds and directions, what Seaquest spawns."""
    with loose_numerics():
        if game.spec.id == "minatar/asterix":
            from gymnax.environments.minatar.asterix import spawn_entity

            return spawn_entity(key, state)
        if game.spec.id == "minatar/freeway":
            speed_key, direction_key = jax.random.split(key)
            speeds = jax.random.randint(speed_key, shape=(8,), minval=1, maxval=6)
            return speeds, jax.random.choice(direction_key, jnp.array([-1, 1]), shape=(8,))
        if game.spec.id == "minatar/seaquest":
            enemy_key, diver_key = jax.random.split(key)
            kind_key, row_key = jax.random.split(enemy_key)
            kind = jax.random.uniform(kind_key, (2,))
            direction_key, diver_row_key = jax.random.split(diver_key)
            rows = [jax.random.randint(key, (), 1, 9) for key in (row_key, diver_row_key)]
            return kind, rows[0], jax.random.bernoulli(direction_key), rows[1]
    return ()


class Dealer:
    """Stands for the original's random generator: says what gymnax drew."""

    def __init__(self, env, name):
        self.env, self.name = env, name

    def next(self, dealt, t, b):
        if self.name == "asterix":
            (_, row, from_left, gold, free), slot = dealt[0][t, b], dealt[1][t, b]
            assert free == 1 or all(entity is not None for entity in self.env.entities)
            self.floats = [0.0 if from_left else 0.9, 0.0 if gold else 0.9]
            empty = [i for i, entity in enumerate(self.env.entities) if entity is None]
            self.choice = empty.index(int(slot)) if empty else 0
            assert row == slot + 1
        elif self.name == "freeway":
            self.speeds, self.directions = dealt[0][t, b], dealt[1][t, b]
        elif self.name == "seaquest":  # which draws for an enemy, then for a diver, if it is time for one
            kind, row, from_left, diver_row = (part[t, b] for part in dealt)
            enemy, diver = self.env.e_spawn_timer == 0, self.env.d_spawn_timer == 0
            self.floats = [*kind] * enemy + [0.0 if from_left else 0.9] * diver
            self.rows = [row] * enemy + [diver_row] * diver

    def rand(self, size=None):
        return self.floats.pop(0) if size is None else np.where(self.directions > 0, 0.9, 0.1)

    def randint(self, *bounds, low=None, high=None):
        if low is not None:
            return int(self.rows.pop(0))
        return self.speeds.copy() if len(bounds) == 3 else self.choice


def begin(name, state, b):
    """An original game at the first state of our environment b."""
    env = original(name)
    if name == "breakout":
        side = int(state.ball_x[b] == 9)
        env.ball_x, env.ball_dir = [(0, 2), (9, 3)][side]
        env.last_x = env.ball_x
    if name == "freeway":
        env.cars = [[int(n) for n in car] for car in state.cars[b]]
    env.random = Dealer(env, name)
    return env


@pytest.mark.parametrize("name", sorted(GAMES))
def test_an_episode_is_the_original_s(name):
    game = MinAtar(name)
    state, shown, actions, after, dealt = play(game, LIMITS[name])
    letters = [LETTERS[action] for action in GAMES[name].actions]
    rewards = 0
    for b in range(EPISODES[name]):
        env = begin(name, state, b)
        np.testing.assert_array_equal(env.state(), shown.observation[b])
        for t in range(LIMITS[name]):
            env.random.next(dealt, t, b)
            reward, terminal = env.act(env.action_map.index(letters[actions[t, b]]))
            assert (after.reward[t, b], after.terminated[t, b]) == (reward, terminal), (b, t)
            same = env.state() == after.observation[t, b]
            if name == "seaquest" and terminal:
                same = np.delete(same, OXYGEN, axis=-1)  # gymnax fills it up in the frame after the end
            assert same.all(), (b, t)
            rewards += reward
            assert after.truncated[t, b] == (t + 1 == LIMITS[name] and not terminal)
            if terminal:
                break
        else:
            assert after.truncated[t, b]
    assert rewards > 0  # of something, at least
    assert [env.action_map[i] for i in env.minimal_action_set()] == letters


def test_an_unknown_game():
    with pytest.raises(UserError, match="unknown task 'minatar/breakot'; did you mean 'minatar/breakout'"):
        registry.resolve("minatar/breakot", "m5", "small")
