"""Gymnasium's environments as our tasks."""

from __future__ import annotations

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium import spaces

from adapters.gymnasium import export as gymnasium_export
from adapters.gymnasium import observations
from adapters.gymnasium import task as gymnasium_bridge
from adapters.gymnasium.observations import Bins
from suite.interface.batching import Batched
from suite.interface.environment import ObservationSpec
from tests.adapters.foreign import Env
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


@pytest.fixture
def foreign():
    """Registers an environment."""

    def register(**peculiarity):
        options = {"max_episode_steps": peculiarity.pop("limit", None)}
        gymnasium.register("tests/foreign-v0", entry_point=lambda: Env(**peculiarity), **options)
        gymnasium_bridge._imported.cache_clear()
        return "tests/foreign-v0"

    yield register
    gymnasium.registry.pop("tests/foreign-v0", None)


def same(observation):
    return np.ravel(observation)


@pytest.mark.parametrize(
    ("space", "seen", "number"),
    [
        (spaces.Box(0, 255, (12, 8, 3), np.uint8), ObservationSpec((12, 8, 3), 255, "pixels", (2, 2)), same),
        (spaces.Box(0, 255, (21, 9), np.uint8), ObservationSpec((21, 9, 1), 255, "pixels", (3, 3)), same),
        (spaces.Box(0, 1, (6, 7, 2), np.uint8), ObservationSpec((6, 7, 2), 1, "grid", (1, 1)), same),
        (
            spaces.Box(0, 255, (3, 21, 9), np.uint8),
            ObservationSpec((21, 9, 3), 255, "pixels", (3, 3)),
            lambda image: np.moveaxis(image, 0, -1).ravel(),
        ),
        (
            spaces.Box(-1, 1, (9, 9, 2), np.float32),
            ObservationSpec((9, 9, 2), 255, "pixels", (1, 1)),
            lambda image: np.round((image.ravel().astype(float) + 1) * 127.5),
        ),
        (spaces.Discrete(256, start=-3), ObservationSpec((1,), 255, "symbols"), lambda number: [number + 3]),
        (spaces.Discrete(257), ObservationSpec((2,), 16, "symbols"), lambda number: [number // 17, number % 17]),
        (
            spaces.MultiDiscrete([[3, 4], [256, 2]], start=[[1, 0], [0, 0]]),
            ObservationSpec((4,), 255, "symbols"),
            lambda numbers: numbers.ravel() - [1, 0, 0, 0],
        ),
        (spaces.Box(-3, 4, (2,), np.int16), ObservationSpec((2,), 7, "symbols"), lambda numbers: numbers + 3),
        (
            spaces.Tuple((spaces.Discrete(3), spaces.Dict(a=spaces.MultiBinary(2)))),
            ObservationSpec((5,), 1, "symbols"),
            lambda parts: [*(parts[0] == np.arange(3)), *parts[1]["a"]],
        ),
    ],
)
def test_observations(foreign, space, seen, number):
    """Each is seen as it is, in our types; actions are in the environment's own."""
    actions, pay = spaces.Discrete(3, start=5), lambda taken: 0.5 * (taken[-1] - 5)
    environment = gymnasium_bridge.make(foreign(observation=space, actions=actions, pay=pay, limit=7))
    assert environment.spec.observation == seen
    assert environment.spec.reward_classes == (0.0, 0.5, 1.0)
    assert environment.limit == 7
    check_spec(environment)
    check_types(environment, num_envs=2)
    state, shown = environment.reset(jax.random.key(0))
    env = Env(space, actions)
    expected, _ = env.reset(seed=int(state.seed))
    for _ in range(7):
        np.testing.assert_array_equal(np.ravel(shown.observation), number(expected))
        state, shown = environment.step(jax.random.key(0), state, jax.numpy.int32(2))
        expected, *_ = env.step(7)
        assert shown.reward == 1
    assert shown.truncated and not shown.terminated


def test_several_actions_are_one():
    count, native = gymnasium_bridge._actions("x", spaces.MultiDiscrete([2, 3], start=[1, 0]))
    assert [tuple(native(action)) for action in range(count)] == [(1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2)]
    count, native = gymnasium_bridge._actions("x", spaces.MultiBinary(2))
    assert [tuple(native(action)) for action in range(count)] == [(0, 0), (0, 1), (1, 0), (1, 1)]


def test_bins_hold_equal_shares_of_what_is_shown_and_reach_beyond():
    shown_N1 = np.random.default_rng(0).normal(size=(20_000, 1))
    bins = Bins(shown_N1, np.array([-np.inf]), np.array([np.inf]))
    held = np.bincount([bins(shown)[0] for shown in shown_N1], minlength=bins.high + 1)
    inside = held[7:-7][1:-1]
    assert len(inside) == 30 or len(inside) == 31
    np.testing.assert_allclose(inside, 20_000 / 31, rtol=0.05)
    low, high = shown_N1.min(), shown_N1.max()
    outside = [high + (high - low) * times for times in (0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8, np.inf)]
    assert np.diff([bins(np.array([number]))[0] for number in outside]).tolist() == [1, 1, 1, 1, 1, 1, 1, 0]
    assert bins(np.array([high + 100]))[0] == bins.high and bins(np.array([-np.inf]))[0] == 0


def test_bins_of_few_values_constants_and_bounds():
    shown_NO = np.array([[0, 5.0, 0, np.nan], [1, 5.0, 0, np.inf], [0, 5.0, 0, -np.inf]])
    bins = Bins(shown_NO, np.array([0, -np.inf, 0, -np.inf]), np.array([1, np.inf, 1, np.inf]))
    for dimension, numbers in enumerate([[0, 1], [-99, 4, 4.7, 5, 5.3, 6, 99], [0, 1], [-0.5, 0.5]]):
        found = [bins(np.eye(4)[dimension] * number)[dimension] for number in numbers]
        assert found == sorted(set(found)), "each has a bin of its own"
    assert bins(np.array([7.0, 5, 0, 0]))[0] == bins(np.array([1.0, 5, 0, 0]))[0], "none outside the bounds"


def test_bins_belong_to_the_task():
    """Every process fits the same ones, whatever it plays and in whatever order."""
    _, shown = gymnasium_bridge.make("CartPole-v1").reset(jax.random.key(3))
    gymnasium_bridge._imported.cache_clear()
    environment = gymnasium_bridge.make("CartPole-v1")
    for action in (0, 1, 1):
        environment.step(jax.random.key(0), environment.reset(jax.random.key(4))[0], jax.numpy.int32(action))
    np.testing.assert_array_equal(environment.reset(jax.random.key(3))[1].observation, shown.observation)
    assert environment.spec.observation.kind == "symbols" and shown.observation.min() > 0


@pytest.mark.parametrize(
    ("sides", "patch"),
    [((63, 63), (7, 7)), ((7, 7), (1, 1)), ((84, 84), (12, 12)), ((210, 160), (30, 20)), ((97, 9), (97, 1))],
)
def test_patch(sides, patch):
    assert observations.patch(*sides) == patch
