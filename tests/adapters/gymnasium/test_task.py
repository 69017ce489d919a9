"""Gymnasium's environments as our tasks."""

from __future__ import annotations

import copy

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium import spaces

from adapters.gymnasium import export as gymnasium_export
from adapters.gymnasium import task as gymnasium_bridge
from suite.interface.batching import Batched
from suite.interface.environment import ObservationSpec
from suite.runtime.errors import UserError
from tests.contract import check_environment, check_spec, check_types

MINIGRID = pytest.param("MiniGrid-Empty-5x5-v0", marks=pytest.mark.skipif("not has_minigrid()"))


def has_minigrid():
    import importlib.util

    return importlib.util.find_spec("minigrid") is not None


def as_seen(id, observation):
    if id.startswith("MiniGrid"):
        return observation["image"]
    return [observation // 23, observation % 23] if id.startswith("Taxi") else [observation]


@pytest.mark.parametrize("id", ["FrozenLake-v1", "Taxi-v4", MINIGRID])
def test_imported_equals_the_engine(id):
    """Over resets, ends and time limits; ours batched and compiled, theirs driven directly."""
    T, B = 250, 3
    environment = gymnasium_bridge.make(id)
    batched = Batched(environment, B)
    action_TB = np.random.default_rng(1).integers(environment.spec.num_actions, size=(T, B)).astype(np.int32)

    def step(carry, inputs):
        carry = batched.step(inputs[0], carry[0], inputs[1])
        return carry, carry

    start = jax.jit(batched.reset)(jax.random.key(0))
    _, (state, shown) = jax.jit(lambda *a: jax.lax.scan(step, *a))(
        start, (jax.random.split(jax.random.key(1), T), action_TB)
    )
    state, shown = jax.device_get((state, shown))
    ends = 0
    for b in range(B):
        env = gymnasium.make("minigrid:" + id if id.startswith("MiniGrid") else id)
        observation, _ = env.reset(seed=int(start[0].seed[b]))
        np.testing.assert_array_equal(start[1].observation[b], as_seen(id, observation))
        for t in range(T):
            observation, reward, terminated, truncated, _ = env.step(action_TB[t, b])
            np.testing.assert_array_equal(shown.final_observation[t, b], as_seen(id, observation))
            assert shown.reward[t, b] == np.float32(reward)
            assert (shown.terminated[t, b], shown.truncated[t, b]) == (terminated, truncated and not terminated)
            if terminated or truncated:
                ends += 1
                observation, _ = env.reset(seed=int(state.seed[t, b]))
            np.testing.assert_array_equal(shown.observation[t, b], as_seen(id, observation))
    assert ends >= 3


@pytest.mark.parametrize("id", ["FrozenLake-v1", "Taxi-v4", MINIGRID])
def test_imported_contract(id):
    assert check_environment(gymnasium_bridge.make(id), jax.random.key(0), steps=210, num_envs=4).ended.any()


def test_imported_is_exported_again():
    env = gymnasium_export.SuiteEnv(gymnasium_bridge.make("FrozenLake-v1"))
    env.reset(seed=0)
    assert env.observation_space == spaces.MultiDiscrete([16])
    assert env.step(1)[1:4] == (0.0, False, False)


class Foreign(gymnasium.Env):
    """With any spaces."""

    def __init__(self, observation_space, actions=spaces.Discrete(3, start=5)):  # noqa: B008
        self.observation_space, self.action_space = copy.deepcopy(observation_space), actions

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return self.observation_space.sample(), 0.5 * (action - 5), False, False, {}


@pytest.fixture
def foreign():
    """Registers an environment with given spaces."""

    def register(*args, **kwargs):
        gymnasium.register("tests/foreign-v0", entry_point=lambda: Foreign(*args), **kwargs)
        gymnasium_bridge._imported.cache_clear()
        return "tests/foreign-v0"

    yield register
    gymnasium.registry.pop("tests/foreign-v0", None)


@pytest.mark.parametrize(
    ("space", "seen"),
    [
        (spaces.Box(0, 255, (12, 8, 3), np.uint8), ObservationSpec((12, 8, 3), 255, "pixels", (2, 2))),
        (spaces.Box(0, 255, (21, 9), np.uint8), ObservationSpec((21, 9, 1), 255, "pixels", (3, 3))),
        (spaces.Box(0, 1, (6, 7, 2), np.uint8), ObservationSpec((6, 7, 2), 1, "grid", (1, 1))),
        (spaces.Discrete(256, start=-3), ObservationSpec((1,), 255, "symbols")),
        (spaces.Discrete(257), ObservationSpec((2,), 16, "symbols")),
        (spaces.MultiDiscrete([[3, 4], [256, 2]], start=[[1, 0], [0, 0]]), ObservationSpec((4,), 255, "symbols")),
    ],
)
def test_observations(foreign, space, seen):
    environment = gymnasium_bridge.make(foreign(space, max_episode_steps=7))
    assert environment.spec.observation == seen
    assert environment.spec.reward_classes == (0.0, 0.5, 1.0)
    assert environment.limit == 7
    check_spec(environment)
    check_types(environment, num_envs=2)
    state, shown = environment.reset(jax.random.key(0))
    env = Foreign(space)
    expected, _ = env.reset(seed=int(state.seed))
    for _ in range(7):
        np.testing.assert_array_equal(number(seen, shown.observation), number_of(space, expected))
        state, shown = environment.step(jax.random.key(0), state, jax.numpy.int32(2))
        expected, *_ = env.step(7)
        assert shown.reward == 1
    assert shown.truncated and not shown.terminated


def number(seen, observation):
    """Digits are put together again."""
    if seen.kind != "symbols" or len(observation) != 2:
        return np.asarray(observation).ravel()
    return np.asarray(observation, int) @ [seen.high + 1, 1]


def number_of(space, observation):
    return np.ravel(observation) - np.ravel(getattr(space, "start", 0))


@pytest.mark.parametrize(
    ("id", "message"),
    [
        ("Pendulum-v1", "gymnasium/Pendulum-v1 cannot be a task: its actions are Box of float32, not Discrete"),
        ("CartPole-v1", "cannot be a task: its observations are Box of float32, not uint8 boxes or discrete"),
        ("Blackjack-v1", "cannot be a task: its observations are Tuple, not uint8 boxes or discrete"),
        ("FrozenLoch-v1", "gymnasium/FrozenLoch-v1: Environment `FrozenLoch` doesn't exist"),
        ("no_such_package:Lake-v1", "gymnasium/no_such_package:Lake-v1: No module named 'no_such_package'"),
        ("Taxi-v3", "deprecated"),
    ],
)
def test_unsupported(id, message):
    for ask in (gymnasium_bridge.spec, gymnasium_bridge.make):
        with pytest.raises(UserError) as error:
            ask(id)
        assert message in str(error.value)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("args", "kwargs", "message"),
    [
        ((spaces.Box(0, 255, (8, 8, 4), np.uint8),), {}, r"not \[height, width\]"),
        ((spaces.Discrete(2), spaces.Discrete(1)), {}, "two or more"),
        ((spaces.Discrete(2),), {"nondeterministic": True}, "not determined by its seed"),
    ],
)
def test_unsupported_spaces(foreign, args, kwargs, message):
    with pytest.raises(UserError, match=message):
        gymnasium_bridge.spec(foreign(*args, **kwargs))


@pytest.mark.parametrize(
    ("sides", "patch"),
    [((63, 63), (7, 7)), ((7, 7), (1, 1)), ((84, 84), (12, 12)), ((210, 160), (30, 20)), ((97, 9), (97, 1))],
)
def test_patch(sides, patch):
    assert gymnasium_bridge.patch(*sides) == patch
