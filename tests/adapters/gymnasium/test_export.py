"""Our tasks as Gymnasium environments."""

from __future__ import annotations

import subprocess
import sys
import warnings

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from adapters.gymnasium import export as gymnasium_export
from adapters.gymnasium import register_all
from suite import registry
from suite.interface.batching import Batched
from suite.interface.environment import EnvironmentSpec, ObservationSpec, TimeStep
from suite.runtime.errors import UserError
from tests.documents import REPOSITORY, code
from tests.tiny import CORRIDOR, Corridor, Pennies

EXPORTED = sorted(id for id, task in registry.tasks().items() if task.family not in gymnasium_export.NOT_EXPORTED)


@pytest.fixture
def corridor(monkeypatch):
    """The corridor as a registered task; its name in Gymnasium."""
    monkeypatch.setattr(registry, "TASKS", (*registry.TASKS, CORRIDOR))
    register_all()
    yield "suite/corridor-v0"
    gymnasium.registry.pop("suite/corridor-v0")


class Symbols:
    """Shows its time as two symbols, and never ends."""

    spec = EnvironmentSpec("symbols", ObservationSpec((2,), 255, "symbols"), 2, (0.0, 1.0))

    def reset(self, key):
        return jax.numpy.int32(0), self._show(0)

    def step(self, key, state, action):
        return state + 1, self._show(state + 1)

    def _show(self, time):
        no, observation = jax.numpy.zeros((), bool), jax.numpy.stack([time % 256, 255]).astype(jax.numpy.uint8)
        return TimeStep(observation, jax.numpy.float32(0), no, no, no, observation, {})


def test_importing_registers_and_builds_nothing():
    code = (
        "import adapters.gymnasium, gymnasium, sys; spec = gymnasium.spec('suite/craftax_classic-v0'); "
        "assert spec.vector_entry_point and 'jax' not in sys.modules and 'craftax' not in sys.modules; print(spec.id)"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("suite/craftax_classic-v0\n", "")


def test_every_single_agent_task_is_registered():
    assert "craftax_classic" in EXPORTED
    for id in EXPORTED:
        assert gymnasium.spec(f"suite/{id.replace('/', '_')}-v0").kwargs == {"task": id}


@pytest.mark.parametrize("id", [id for id in EXPORTED if id != "craftax_full"])
def test_check_env(id):
    """Craftax (full) goes the way of Craftax-classic; compiling it alone takes half a minute."""
    check_env(gymnasium.make(f"adapters.gymnasium:suite/{id.replace('/', '_')}-v0").unwrapped)


def test_readmes_example_runs():
    """Behind `test_check_env`, which compiled the game that it plays."""
    names: dict = {}
    exec(code("README.md", "python", "gymnasium.make"), names)
    assert names["game"].observation_space.contains(names["game"].step(1)[0])
    assert isinstance(names["info"], dict) and names["leduc"].agents


def test_the_example_of_another_library_runs():
    """Where that library is: it brings PyTorch, which is too much for our own environment."""
    pytest.importorskip("stable_baselines3")
    exec(code("docs/extending.md", "python", "stable_baselines3"), {})


def test_check_env_of_a_tiny_task(corridor):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*minimum and maximum|.*image")  # what a picture should be
        check_env(gymnasium.make(corridor).unwrapped)


def test_single_plays_the_environment_by_its_seed(corridor):
    environment = Corridor()
    env = gymnasium_export.SuiteEnv(environment)
    observation, info = env.reset(seed=5)
    key, reset_key = jax.random.split(jax.random.key(5))
    state, shown = environment.reset(reset_key)
    np.testing.assert_array_equal(observation, shown.observation)
    assert info["achievement_return"] == 0.0
    random = np.random.default_rng(0)
    ends = {"terminated": 0, "truncated": 0}
    for _ in range(60):
        action = int(random.random() < 0.6)
        observation, reward, terminated, truncated, info = env.step(action)
        key, step_key = jax.random.split(key)
        state, shown = environment.step(step_key, state, jax.numpy.int32(action))
        np.testing.assert_array_equal(observation, shown.observation)
        assert (reward, terminated, truncated) == (shown.reward, shown.terminated, shown.truncated)
        assert set(info) == {"achievements", "achievement_return", "health_return"}
        np.testing.assert_array_equal(info["achievements"], shown.statistics["achievements"])
        if terminated or truncated:
            ends["terminated" if terminated else "truncated"] += 1
            with pytest.raises(gymnasium.error.ResetNeeded):
                env.step(0)
            env.reset()
            key, reset_key = jax.random.split(key)
            state, shown = environment.reset(reset_key)
    assert min(ends.values()) > 0


def test_vector_is_batched(corridor):
    B = 5
    envs = gymnasium.make_vec(corridor, num_envs=B)
    assert envs.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    batched = Batched(Corridor(), B)
    step = jax.jit(batched.step)
    observation_B, _ = envs.reset(seed=3)
    key, reset_key = jax.random.split(jax.random.key(3))
    state, shown = batched.reset(reset_key)
    np.testing.assert_array_equal(observation_B, shown.observation)
    random = np.random.default_rng(0)
    for _ in range(40):
        action_B = (random.random(B) < 0.7).astype(int)
        observation_B, reward_B, terminated_B, truncated_B, info = envs.step(action_B)
        key, step_key = jax.random.split(key)
        state, shown = step(step_key, state, action_B.astype(np.int32))
        assert envs.observation_space.contains(observation_B)
        np.testing.assert_array_equal(observation_B, shown.observation)
        np.testing.assert_array_equal(reward_B, shown.reward)
        np.testing.assert_array_equal(terminated_B, shown.terminated)
        np.testing.assert_array_equal(truncated_B, shown.truncated)
        ended_B = terminated_B | truncated_B
        np.testing.assert_array_equal(info["_achievement_return"], ~ended_B)
        assert ("final_obs" in info) == ended_B.any()
        if ended_B.any():
            np.testing.assert_array_equal(info["_final_obs"], ended_B)
            np.testing.assert_array_equal(info["final_info"]["achievement_return"], np.where(ended_B, reward_B, 0))
            for b in range(B):
                if ended_B[b]:
                    np.testing.assert_array_equal(info["final_obs"][b], shown.final_observation[b])
                else:
                    assert info["final_obs"][b] is None


def test_vector_tells_what_gymnasiums_own_vector_tells(corridor):
    """Same spaces, and the same information at an end, but for the new episode's statistics, which are not known."""
    ours = gymnasium.make_vec(corridor, num_envs=2)
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    theirs = gymnasium.make_vec(corridor, 2, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode})
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space

    def to_the_end(envs):
        envs.reset(seed=0)
        steps = [envs.step(np.ones(2, int)) for _ in range(3)]  # both arrive within three
        return next(step for step in steps if "final_obs" in step[-1])

    (*shown, info), (*expected, expected_info) = to_the_end(ours), to_the_end(theirs)
    for array, other in zip(shown, expected, strict=True):
        assert array.shape == other.shape
    assert set(info) == set(expected_info)
    assert set(info["final_info"]) == set(expected_info["final_info"])
    for name, value in info["final_info"].items():
        assert (value.shape, value.dtype.kind) == (
            expected_info["final_info"][name].shape,
            expected_info["final_info"][name].dtype.kind,
        )


def test_vector_wrappers_count_episodes(corridor):
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(gymnasium.make_vec(corridor, num_envs=3))
    envs.reset(seed=0)
    for _ in range(20):
        envs.step(np.ones(3, int))
    assert list(envs.return_queue) == [1.0] * len(envs.return_queue) and envs.episode_count >= 15


def test_processes_that_are_forked_work_or_say_at_once_what_would():
    """`AsyncVectorEnv` forks unless it is told otherwise, and JAX hangs in a fork of a process that used it."""
    code = (
        "import gymnasium, jax, numpy as np; from adapters.gymnasium.export import SuiteEnv; from tests.tiny import *\n"
        "def vector(): return gymnasium.vector.AsyncVectorEnv([lambda: SuiteEnv(Corridor())] * 2, context='fork')\n"
        "envs = vector(); envs.reset(seed=0); print(len(envs.step([1, 1])[1])); envs.close(); jax.numpy.zeros(1)\n"
        "try: vector().reset(seed=0)\n"
        "except Exception as error: print(type(error).__name__, error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=REPOSITORY, timeout=120)
    works, refused = done.stdout.splitlines()
    assert works == "2" and refused.startswith("UserError JAX was used before") and 'context="spawn"' in refused


def test_symbols_are_multi_discrete():
    env = gymnasium_export.SuiteEnv(Symbols())
    assert env.observation_space == spaces.MultiDiscrete([256, 256])
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert env.step(np.int64(1))[0].tolist() == [1, 255]


def test_render_is_the_observation():
    spec = EnvironmentSpec("seen", ObservationSpec((2, 2, 3), 255, "pixels", (1, 1)), 2, (0.0, 1.0))
    environment = Symbols()
    environment.spec = spec
    environment._show = lambda time: TimeStep(
        *(frame := jax.numpy.full((2, 2, 3), 7, jax.numpy.uint8), jax.numpy.float32(0)),
        *[jax.numpy.zeros((), bool)] * 3,
        frame,
        {},
    )
    env = gymnasium_export.SuiteEnv(environment, render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), observation)


def test_misuse_is_one_error():
    env = gymnasium_export.SuiteEnv(Corridor())
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(0)
    env.reset()
    with pytest.raises(gymnasium.error.InvalidAction, match="2 is no action"):
        env.step(2)
    envs = gymnasium_export.SuiteVectorEnv(Corridor(), 2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step([0, 0])
    with pytest.raises(UserError, match="one seed"):
        envs.reset(seed=[1, 2])
    with pytest.raises(UserError, match="reset_mask"):
        envs.reset(options={"reset_mask": np.array([True, False])})
    envs.reset()
    with pytest.raises(gymnasium.error.InvalidAction):
        envs.step([0, 2])
    with pytest.raises(UserError, match="cannot be rendered"):
        gymnasium_export.SuiteEnv(Corridor(), render_mode="rgb_array")
    with pytest.raises(UserError, match="game of two players"):
        gymnasium_export.SuiteEnv(Pennies())
    with pytest.raises(UserError, match="unknown task"):
        gymnasium_export.SuiteEnv("nethack")
