"""The evaluation set of Section 4.4: what the paper's best model-free agent saw and did while it learned.

Built once per task, preset and package version, and kept in the user's cache folder (`suite.runtime.cache`).
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from suite import registry
from suite.agent.algorithm import iterate, iteration_key, start_key
from suite.agent.phases import Agent
from suite.configuration.schema import Config, hash_of
from suite.interface.environment import Environment, EnvironmentSpec, State, TimeStep
from suite.records.tables import write_whole
from suite.runtime.cache import cache_dir, read_arrays
from suite.runtime.compilation import enable_compilation_cache
from suite.runtime.reporting import Reporter
from suite.world_model.history import paid_before

COLLECTOR = "mfrl"
TRAJECTORIES, STEPS = 160, 20  # N_eval, T_eval
BEFORE = 15  # steps before those: some models are told of what happened earlier
PAIRS = {"paper": 100_000, "small": 20_000, "smoke": 200}
VALIDATION = 8  # every so many environments, one is kept for validation; one at least
SYMBOLS = "symbols"
VERSION = 3  # of what is kept and how it is drawn


@dataclasses.dataclass(frozen=True)
class EvaluationSet:
    """N real trajectories of T steps; frame t + 1 is what step t led to.

    Attributes:
      frames: uint8 [N, T + 1, O].
      action: int32 [N, T].
      reward: float32 [N, T].
      terminated, ended: bool [N, T]; an end by the rules; any end.
      symbols: int32 [N, T, R], of the frames that steps led to; R = 0 for a task without symbols.
      paid: uint8 [N, T, A]; how often each action had earned a reward in the episode before the step.
    """

    frames: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    ended: np.ndarray
    symbols: np.ndarray
    paid: np.ndarray

    @property
    def counted(self) -> np.ndarray:
        """Bool [N, T]: no earlier step ended the episode, so that reward and termination count."""
        return np.cumsum(self.ended, axis=1) - self.ended == 0

    @property
    def frame_counted(self) -> np.ndarray:
        """Bool [N, T]: the frame that the step led to is the same episode's."""
        return np.cumsum(self.ended, axis=1) == 0

    def after(self, steps: int) -> EvaluationSet:
        """The same trajectories without their first `steps` steps."""
        return EvaluationSet(**{name: array[:, steps:] for name, array in vars(self).items()})


@dataclasses.dataclass(frozen=True)
class Pairs:
    """M frames, uint8 [M, O], and what they show, int32 [M, R]; bool [M] `validation`: seen by other environments."""

    frames: np.ndarray
    symbols: np.ndarray
    validation: np.ndarray


@dataclasses.dataclass(frozen=True)
class WithSymbols:
    """An environment whose statistics say what each frame shows besides: "symbols", int32 [R]."""

    environment: Environment
    symbols: Callable[[State], jax.Array]

    @property
    def spec(self) -> EnvironmentSpec:
        """The environment's own."""
        return self.environment.spec

    def reset(self, key: jax.Array) -> tuple[State, TimeStep]:
        """As the environment."""
        return self._described(*self.environment.reset(key))

    def step(self, key: jax.Array, state: State, action: jax.Array) -> tuple[State, TimeStep]:
        """As the environment."""
        return self._described(*self.environment.step(key, state, action))

    def _described(self, state: State, time_step: TimeStep) -> tuple[State, TimeStep]:
        statistics = time_step.statistics | {SYMBOLS: self.symbols(state)}
        return state, dataclasses.replace(time_step, statistics=statistics)


def cache_folder(task: str, preset: str) -> Path:
    """Where the set of a task and preset is kept, with all that is made from it; it may not exist yet."""
    config, entry = _collector(task, preset), registry.task(task)
    package = entry.spec().package
    version = importlib.metadata.version(package) if package else ""
    digest = hash_of({"config": config.digest(), "package": [package, version], "version": VERSION})
    return cache_dir() / "inspect" / f"{task.replace('/', '_')}-{preset}-seed_{config.seed}-{digest}"


def load(task: str, preset: str, reporter: Reporter) -> EvaluationSet:
    """The evaluation set of a task, collected first where it is not cached yet.

    Args:
      task: id of a single-agent task.
      preset: how long the collecting agent learns, and how large it is.
      reporter: where progress goes.
    """
    return EvaluationSet(**_cached(task, preset, "trajectories.npz", reporter))


def load_pairs(task: str, preset: str, reporter: Reporter) -> Pairs:
    """What the extractor learns from; as `load`."""
    return Pairs(**_cached(task, preset, "pairs.npz", reporter))


def write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """A compressed .npz file, whole or not at all, in a folder that may not exist yet."""
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # type: ignore[arg-type]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, content.getvalue())


def _cached(task: str, preset: str, name: str, reporter: Reporter) -> dict[str, np.ndarray]:
    path = cache_folder(task, preset) / name
    arrays = read_arrays(path)
    if arrays is None:
        _build(path.parent, _collector(task, preset), reporter)
        arrays = read_arrays(path)
    assert arrays is not None
    return arrays


def _collector(task: str, preset: str) -> Config:
    return registry.resolve(task, COLLECTOR, preset)


def _build(folder: Path, config: Config, reporter: Reporter) -> None:
    entry = registry.task(config.task)
    enable_compilation_cache()
    environment = entry.make()(progress=reporter.texture)
    if entry.symbols is not None:
        environment = WithSymbols(environment, entry.symbols())
    reporter.message(f"collecting the evaluation set of {config.task}: {config.agent} learns, once")
    pairs = PAIRS.get(config.preset, PAIRS["small"]) if entry.symbols is not None else 0
    evaluation_set, pairs_found = collect(Agent(config, environment), pairs, reporter)
    write_arrays(folder / "pairs.npz", vars(pairs_found))
    write_arrays(folder / "trajectories.npz", vars(evaluation_set))  # last: with it the set is complete


def collect(agent: Agent, pairs: int, reporter: Reporter) -> tuple[EvaluationSet, Pairs]:
    """A whole training run, of which trajectories and pairs are kept.

    Steps are those that `suite run` takes with the same configuration. Trajectories are drawn uniformly from the
    rollouts of all iterations and environments, one from each at most and from no more than half of them; pairs come
    from the other rollouts.

    Args:
      agent: a model-free one.
      pairs: so many, or what there is.
      reporter: where progress goes.
    """
    config = agent.config
    envs, length, iterations = config.environment.num_envs, config.environment.rollout_length, config.iterations
    steps = min(BEFORE + STEPS, length)
    random = np.random.default_rng(config.seed)
    drawn = random.choice(envs * iterations, min(TRAJECTORIES, envs * iterations // 2), replace=False)
    validation_B = np.arange(envs) >= envs - max(1, envs // VALIDATION)
    kept: list[dict[str, np.ndarray]] = []
    pairs_kept: list[dict[str, np.ndarray]] = []
    paid_BA = jnp.zeros((envs, agent.spec.num_actions), jnp.uint8)

    def keep(iteration: int, phase: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Runs a phase of Algorithm 1; of real play it keeps what is wanted."""
        nonlocal paid_BA
        result = function(*arguments)
        if phase == "collect":
            rollout_state, trajectory, log = result
            arrays = _arrays(jax.device_get((trajectory, rollout_state.time_step.observation, log)))
            pays_TB = agent.spec.pays(trajectory.reward_TB)
            paid_TBA, paid_BA = paid_before(paid_BA, trajectory.action_TB, pays_TB, trajectory.first_TB)
            arrays["paid"] = np.asarray(paid_TBA)
            here = np.sort(drawn[drawn // envs == iteration] % envs)
            for env in here:
                start = random.integers(length - steps + 1)
                cut = {name: array[start : start + steps, env] for name, array in arrays.items() if name != "frames"}
                kept.append(cut | {"frames": arrays["frames"][start : start + steps + 1, env]})
            wanted = pairs * (iteration + 1) // iterations - sum(len(part["symbols"]) for part in pairs_kept)
            pairs_kept.append(_pairs(random, arrays, np.setdiff1d(np.arange(envs), here), wanted, validation_B))
        return result

    state, taken = agent.init(start_key(config.seed)), 0
    reporter.start(config.total_steps, 0)
    for iteration in range(iterations):
        key = iteration_key(config.seed, iteration)
        state, after = iterate(agent, state, key, taken, functools.partial(keep, iteration))
        taken = int(after)
        reporter.update(taken, "collect", {})
    reporter.stop()
    return EvaluationSet(**_joined(np.stack, kept)), Pairs(**_joined(np.concatenate, pairs_kept))


def _joined(join: Callable[[list[np.ndarray]], np.ndarray], parts: list[dict[str, np.ndarray]]) -> dict[str, Any]:
    return {name: join([part[name] for part in parts]) for name in parts[0]}


def _arrays(results: Any) -> dict[str, np.ndarray]:
    """One iteration's rollouts by name, [T, B, ...], of frames [T + 1, B, ...]."""
    trajectory, last_BO, log = results
    nothing = np.zeros((*trajectory.action_TB.shape, 0), np.int32)
    return {
        "frames": np.concatenate([trajectory.observation_TB, last_BO[None]]),
        "action": trajectory.action_TB,
        "reward": trajectory.reward_TB,
        "terminated": trajectory.terminated_TB,
        "ended": log.ended_TB,
        "symbols": log.statistics_TB.get(SYMBOLS, nothing),
    }


def _pairs(
    random: np.random.Generator,
    arrays: dict[str, np.ndarray],
    envs: np.ndarray,
    wanted: int,
    validation_B: np.ndarray,
) -> dict[str, np.ndarray]:
    """Frames of these environments and what they show: the symbols of a step that ended belong to no frame kept."""
    step, env = np.nonzero(~arrays["ended"][:, envs])
    some = random.permutation(len(step))[:wanted]
    step, env = step[some], envs[env[some]]
    return {
        "frames": arrays["frames"][step + 1, env],
        "symbols": arrays["symbols"][step, env],
        "validation": validation_B[env],
    }
