"""The one check that every environment must pass: `check_environment`."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from suite.interface.batching import Batched
from suite.interface.environment import Environment, TimeStep
from suite.interface.turns import choose_event

PATTERNS = {"pixels": 3, "grid": 3, "symbols": 1}  # axes of an observation
REWARDS = 10_000


@dataclasses.dataclass
class Play:
    """T random events in B environments: `states` and `shown` are [T + 1, B], the rest [T, B].

    `stepped` is what stepping alone gives and `fresh_*`, where an episode ended, what resetting alone gives, with the
    keys that `Batched` documents; `shown[t + 1]` and `states[t + 1]` are what `Batched` made of them.
    """

    states: Any
    shown: TimeStep
    stepped_states: Any
    stepped: TimeStep
    fresh_states: Any
    fresh: TimeStep

    @property
    def ended(self) -> np.ndarray:
        return self.stepped.terminated | self.stepped.truncated


def check_environment(
    environment: Environment,
    key: jax.Array,
    steps: int,
    num_envs: int = 8,
    prepare: Callable[[Any], Any] = lambda state: state,
) -> Play:
    """Raises AssertionError where `environment` breaks the contract of `suite.interface.environment`.

    Args:
      environment: what to check.
      key: of the random play.
      steps: T, how many events to play in each of the environments; then play goes on, and only rewards are checked,
        until it is `REWARDS` events.
      num_envs: B.
      prepare: changes the B first states, so that rare events happen; returns them in the same types.

    Returns:
      what was played, for checks of the environment's own.
    """
    check_spec(environment)
    check_types(environment, num_envs)
    play, further = _play(environment, key, steps, num_envs, prepare)
    check_ranges(environment, play)
    # What a prepared state has gained before is not in the statistics that were shown with it.
    for shown in (jax.tree.map(lambda array: array[1:], play.shown), *further):
        check_rewards(environment, shown)
    check_auto_reset(play)
    return play


def check_spec(environment: Environment) -> None:
    spec = environment.spec
    observation = spec.observation
    assert len(observation.shape) == PATTERNS[observation.kind]
    assert 1 <= observation.high <= 255
    assert spec.num_actions >= 2
    assert list(spec.reward_classes) == sorted(set(spec.reward_classes)) and 0.0 in spec.reward_classes
    assert len(spec.achievements) == len(spec.achievement_rewards) and set(spec.achievement_rewards) <= set(
        spec.reward_classes
    )
    assert (observation.patch is None) == (observation.kind == "symbols")
    if observation.patch is not None:
        assert all(side % patch == 0 for side, patch in zip(observation.shape, observation.patch, strict=False))
    statistics = dict(spec.statistics)
    if spec.achievements:
        assert statistics["achievements"] == (len(spec.achievements),)


def check_types(environment: Environment, num_envs: int) -> None:
    """Shapes and dtypes, alone and batched; a step returns the types it was given, or would be compiled again."""
    spec, key = environment.spec, jax.random.key(0)
    alone = environment.reset if not spec.two_player else lambda key: environment.reset(key, jnp.int32(2))
    for lead, reset, step in (
        ((), alone, environment.step),
        ((num_envs,), Batched(environment, num_envs).reset, Batched(environment, num_envs).step),
    ):
        action = jax.ShapeDtypeStruct(lead, jnp.int32)
        first_state, first = jax.eval_shape(reset, key)
        next_state, then = jax.eval_shape(step, key, first_state, action)
        assert _types((first_state, first)) == _types((next_state, then))
        for name, shape, dtype in (
            ("observation", spec.observation.shape, jnp.uint8),
            ("final_observation", spec.observation.shape, jnp.uint8),
            ("reward", (), jnp.float32),
            ("terminated", (), jnp.bool_),
            ("truncated", (), jnp.bool_),
            ("first", (), jnp.bool_),
        ):
            array = getattr(first, name)
            assert (array.shape, array.dtype) == ((*lead, *shape), dtype), name
        assert {name: array.shape for name, array in first.statistics.items()} == {
            name: (*lead, *shape) for name, shape in spec.statistics
        }
        assert spec.two_player == (first.turn is not None)
        if first.turn is not None:
            assert first.turn.legal_A.shape == (*lead, spec.num_actions)
            assert first.turn.chance_C.shape == (*lead, spec.chance_outcomes)
            assert first.turn.opponent_observation.shape == (*lead, *spec.observation.shape)


def check_ranges(environment: Environment, play: Play) -> None:
    high = environment.spec.observation.high
    assert max(play.shown.observation.max(), play.shown.final_observation.max()) <= high
    assert np.isfinite(play.stepped.reward).all()
    assert not (play.stepped.terminated & play.stepped.truncated).any()
    assert not play.stepped.first.any(), "a step alone never begins an episode"
    assert play.fresh.first[play.ended].all() and not play.fresh.reward.any()
    assert not (play.fresh.terminated | play.fresh.truncated).any()
    _equal(play.stepped.observation, play.stepped.final_observation)
    turn = play.shown.turn
    if turn is not None:
        at_chance = turn.player == 0
        assert np.isin(turn.player, (0, 1, 2)).all() and np.isin(turn.seat, (1, 2)).all()
        assert (turn.legal_A.any(-1) == ~at_chance).all(), "players have a legal action, chance has none"
        np.testing.assert_allclose(turn.chance_C.sum(-1), at_chance, atol=1e-5)
        # An environment keeps its seat, and every other one sits in the other.
        np.testing.assert_array_equal(
            turn.seat, np.broadcast_to(1 + np.arange(turn.seat.shape[1]) % 2, turn.seat.shape)
        )


def check_rewards(environment: Environment, shown: TimeStep) -> None:
    """Each reward is within half a class of a level, apart from what health adds where statistics count health.

    `shown`: T + 1 time steps of play that goes on from one to the next, [T + 1, B].
    """
    spec, statistics, reward = environment.spec, shown.statistics, shown.reward[1:]
    if "health_return" in statistics:
        ended = (shown.terminated | shown.truncated)[:-1]

        def gained(name: str) -> np.ndarray:
            """What a step added to a sum, which is zero where an episode begins."""
            return statistics[name][1:] - np.where(ended, 0, statistics[name][:-1])

        np.testing.assert_allclose(reward, gained("achievement_return") + gained("health_return"), atol=1e-5)
        np.testing.assert_allclose(
            statistics["achievements"] @ np.array(spec.achievement_rewards), statistics["achievement_return"]
        )
        reward = reward - gained("health_return")
    levels = np.array(spec.reward_classes, np.float32)
    distance = np.abs(reward[..., None] - levels)
    gaps = np.diff(levels)
    half = np.minimum(np.append(gaps, math.inf), np.insert(gaps, 0, math.inf)) / 2
    assert (distance <= half + 1e-5).any(-1).all(), "a reward far from every class"


def check_auto_reset(play: Play) -> None:
    """What ended begins anew with its own key, what did not goes on untouched, and no step's result is lost."""
    ended = play.ended
    after = jax.tree.map(lambda array: array[1:], (play.states, play.shown))
    _equal(after[0], _where(ended, play.fresh_states, play.stepped_states))
    for name in ("observation", "turn"):
        expected = _where(ended, getattr(play.fresh, name), getattr(play.stepped, name))
        _equal(getattr(after[1], name), expected)
    np.testing.assert_array_equal(after[1].first, ended)
    for name in ("reward", "terminated", "truncated", "final_observation", "statistics"):
        _equal(getattr(after[1], name), getattr(play.stepped, name))


@functools.cache
def programs(environment: Environment, num_envs: int, steps: int):
    """Compiled once for each environment object: B resets by hand, with keys and seats [B], and T events of a batch.

    An event is what the batch makes of it, and what stepping alone does: in one program, as a large game takes a minute
    to compile.
    """
    batched = Batched(environment, num_envs)

    def event(carry, key):
        state, shown = carry
        action_key, turn_key, step_key = jax.random.split(key, 3)
        if shown.turn is None:
            action_B = jax.random.randint(action_key, (num_envs,), 0, environment.spec.num_actions)
        else:
            legal = jnp.where(shown.turn.legal_A, 0.0, -jnp.inf)
            ours_B = jax.random.categorical(action_key, legal).astype(jnp.int32)
            action_B = choose_event(turn_key, shown.turn, ours_B)
        by_hand = jax.vmap(environment.step)(jax.random.split(step_key, (2, num_envs))[0], state, action_B)
        carry = batched.step(step_key, state, action_B)
        return carry, (carry, by_hand, step_key)

    def reset(key, seat):
        return environment.reset(key, seat) if environment.spec.two_player else environment.reset(key)

    return (
        jax.jit(jax.vmap(reset)),
        jax.jit(lambda carry, key: jax.lax.scan(event, carry, jax.random.split(key, steps))),
    )


def _play(environment, key, steps, num_envs, prepare) -> tuple[Play, list[TimeStep]]:
    """The play, and what went on from there."""
    resets, events = programs(environment, num_envs, steps)
    reset_key, events_key = jax.random.split(key)
    beginning = jax.random.split(reset_key, num_envs), seats_of(np.arange(num_envs))
    state, shown = resets(*beginning)
    _equal(shown, resets(*beginning)[1])
    assert bool(shown.first.all())
    start = prepare(state), shown
    carry, (after, by_hand, keys) = events(start, events_key)
    _equal(after, events(start, events_key)[1][0])  # the same key, state and actions give the same
    further = []
    for played in range(steps, max(REWARDS // num_envs, 2 * steps), steps):
        last, (carry, (later, _, _)) = carry[1], events(carry, jax.random.fold_in(events_key, played))
        further.append(_following(last, later[1]))
    assert events._cache_size() == 1, "a step's output makes a step compile again"
    states = jax.tree.map(lambda one, many: jnp.concatenate([one[None], many]), start[0], after[0])
    shown = _following(start[1], after[1])
    states, shown, (stepped_states, stepped) = jax.tree.map(_numpy, (states, shown, by_hand))
    fresh_states, fresh = jax.tree.map(np.zeros_like, (stepped_states, stepped))
    reset_keys_TB = jax.vmap(lambda key: jax.random.split(key, (2, num_envs))[1])(keys)
    ends = np.argwhere(stepped.terminated | stepped.truncated)
    for some in np.split(ends, range(num_envs, len(ends), num_envs)):
        t, b = np.resize(some, (num_envs, 2)).T  # as many as are compiled
        begun = resets(reset_keys_TB[t, b], seats_of(b))
        for whole, part in zip(*map(jax.tree.leaves, ((fresh_states, fresh), begun)), strict=True):
            whole[t, b] = _numpy(part)
    return Play(states, shown, stepped_states, stepped, fresh_states, fresh), further


def seats_of(index_B: np.ndarray) -> jax.Array:
    """The seats that `Batched` gives environments of these indices."""
    return jnp.asarray(1 + index_B % 2, jnp.int32)


def _following(first: TimeStep, later: TimeStep) -> TimeStep:
    return jax.tree.map(lambda one, many: _numpy(jnp.concatenate([one[None], many])), first, later)


def _numpy(array: jax.Array) -> np.ndarray:
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        array = jax.random.key_data(array)
    return np.asarray(array)


def _types(tree: Any) -> Any:
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(leaf.shape, leaf.dtype, leaf.weak_type) for leaf in leaves]


def _wide(mask: np.ndarray, array: np.ndarray) -> np.ndarray:
    return mask.reshape(mask.shape + (1,) * (array.ndim - mask.ndim))


def _where(mask: np.ndarray, yes: Any, no: Any) -> Any:
    return jax.tree.map(lambda a, b: np.where(_wide(mask, a), a, b), yes, no)


def _equal(actual: Any, expected: Any) -> None:
    """Exactly, but for the last bits of floats, which depend on what else a program computes."""
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        a, b = _numpy(a), _numpy(b)
        if a.dtype.kind == "f":
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)
        else:
            np.testing.assert_array_equal(a, b)
