"""The suite from Python: `suite.make`, `suite.train`, `suite.train_together`, `suite.load` and `suite.results`.

Arrays are NumPy's and lead with B, whatever is side by side; what is given without that axis is answered without it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from flax import nnx

from leaderboards.results import COUNTS, finished_in
from suite import registry
from suite.agent.phases import Agent
from suite.configuration.schema import Config
from suite.interface.batching import Batched
from suite.interface.environment import EnvironmentSpec
from suite.policy.actor_critic import mask_logits
from suite.records.record import RunRecord
from suite.runs import evaluation, training
from suite.runs.saved_model import RestoredRun, restore
from suite.runs.training import Callback, Result
from suite.runtime.compilation import device_kind, enable_compilation_cache, quiet_xla, refuse_other_arithmetic
from suite.runtime.errors import UserError
from suite.runtime.reporting import QuietReporter, Reporter, RichReporter
from suite.world_model.history import MOST
from suite.world_model.imagination import Past


def make(task: str, num_envs: int = 1) -> Batched:
    """The environment of a task, `num_envs` of them side by side, with exact auto-reset.

    It is pure: `state, time_step = environment.reset(key)`, then `environment.step(key, state, actions)`, inside
    `jax.jit` or not.

    Raises:
      UserError: no such task, or nothing to compute on.
    """
    _begin()
    device_kind()
    return Batched(registry.task(task).make()(QuietReporter().texture), num_envs)


def train(
    task: str,
    agent: str | None = None,
    preset: str | None = None,
    *,
    seed: int = 0,
    steps: int | None = None,
    settings: Mapping[str, Any] | Sequence[str] | None = None,
    out: str | Path = "runs",
    resume: bool = False,
    callbacks: Iterable[Callback] = (),
    wandb: str | None = None,
    devices: int | Literal["all"] | None = None,
    progress: bool = False,
) -> Run:
    """Trains an agent, or goes on with a run that was stopped: `suite run` calls this for each seed.

    Args:
      task, agent, preset: ids; None: as `suite run` without that word.
      seed: of all randomness.
      steps: real environment steps; None: the preset's. With more of them a finished run goes on.
      settings: fields by dotted name, such as {"ppo.discount": 0.95}, or as words, such as ["ppo.discount=0.95"].
      out: the folder of all runs.
      resume: insist that there is a run to go on with.
      callbacks: each is called after every iteration with what it left (`suite.runs.training.Iteration`). If one
        returns True, the run stops with a checkpoint, and the same call goes on with it.
      wandb: the project at Weights & Biases that gets curves, beside TensorBoard's; None: it gets none.
      devices: on how many of this process's its batches are split; None: one CPU, or as many accelerators as fit.
      progress: whether progress is shown.

    Raises:
      UserError: what is asked for is wrong, or the folder is in use or holds another run.
      RunError: the run cannot go on.
    """
    _begin()
    config = registry.resolve(task, agent, preset, settings or (), seed, steps)
    result = training.run(config, Path(out), _reporter(progress), resume, tuple(callbacks), wandb, devices)
    return Run(RunRecord.open(result.folder, lock=False), result)


def train_together(
    task: str,
    agent: str | None = None,
    preset: str | None = None,
    *,
    seeds: Sequence[int],
    steps: int | None = None,
    settings: Mapping[str, Any] | Sequence[str] | None = None,
    out: str | Path = "runs",
    callbacks: Iterable[Callback] = (),
    wandb: str | None = None,
    devices: int | Literal["all"] | None = None,
    progress: bool = False,
) -> list[Run]:
    """Trains several seeds as one program, or goes on with those that were stopped: `suite run --together`.

    Each leaves the record that `train` leaves of it. One whose loss diverges does not stop the others: the status of
    its result is "failed".

    Args:
      seeds: of one run each.
      devices: of this process's, between which runs are divided; None: one CPU, or all accelerators.
      task, agent, preset, steps, settings, out, callbacks, wandb, progress: as of `train`; a callback that returns True
        stops all of them.

    Returns:
      the runs, in the order of `seeds`.

    Raises:
      UserError: as of `train`, or the task steps on the host.
      RunError: none of them can go on.
    """
    _begin()
    if not seeds:
        raise UserError("seeds: there must be at least one")
    configs = [registry.resolve(task, agent, preset, settings or (), seed, steps) for seed in dict.fromkeys(seeds)]
    results = training.run_together(configs, Path(out), _reporter(progress), tuple(callbacks), wandb, devices)
    return [Run(RunRecord.open(result.folder, lock=False), result) for result in results]


def load(folder: str | Path) -> Run:
    """A run by its folder, finished or not.

    Raises:
      UserError: it holds no run, or one that cannot be read.
    """
    _begin()
    return Run(RunRecord.open(Path(folder), lock=False))


def results(*folders: str | Path) -> pd.DataFrame:
    """All finished runs in or below these folders: a row for each, with what it is and its scores.

    Raises:
      UserError: there is none, or one cannot be read.
    """
    rows = []
    for run in map(Run, finished_in([Path(folder) for folder in folders])):
        config = run.config
        what = {"task": config.task, "agent": config.agent, "preset": config.preset, "seed": config.seed}
        rows.append({**what, "steps": run.steps, **run.scores, "folder": str(run.folder)})
    return pd.DataFrame(rows)


class Run:
    """One run: its record as data frames, and the newest checkpoint's policy, world model and tokenizer."""

    def __init__(self, record: RunRecord, result: Result | None = None):
        self._record, self._result = record, result

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r}, {self.status} at step {self.steps:,})"

    @property
    def folder(self) -> Path:
        """Where it is."""
        return self._record.folder

    @property
    def config(self) -> Config:
        """All its settings."""
        return self._record.config

    @property
    def spec(self) -> EnvironmentSpec:
        """What its task is."""
        return self._record.spec

    @property
    def status(self) -> str:
        """Whether it is "running", "stopped", "failed" or "finished"."""
        return self._record.fields.status

    @property
    def steps(self) -> int:
        """Real environment steps taken."""
        return self._record.steps

    @property
    def episodes(self) -> pd.DataFrame:
        """Training episodes: a row for each, by when it ended ("step")."""
        return self._record.table("episodes")

    @property
    def evaluations(self) -> pd.DataFrame:
        """Episodes of evaluations; "step" is the checkpoint's."""
        return self._record.table("evaluations")

    @property
    def metrics(self) -> pd.DataFrame:
        """Losses and the like: a row for each iteration."""
        return self._record.table("metrics")

    @property
    def timing(self) -> pd.DataFrame:
        """Seconds of each phase: a row for each iteration."""
        return self._record.table("timing")

    @functools.cached_property
    def result(self) -> Result:
        """What it came to, as `suite run` prints it. Its status is "already finished" if `train` had nothing to do."""
        return self._result or training.result_of(self._record, self.status)

    @functools.cached_property
    def scores(self) -> dict[str, float]:
        """By name, computed from the training episodes as the task says."""
        score = registry.task(self.config.task).scores()
        found = score(self._record.episodes(), self.config, self.spec)
        return {name: value for name, value in found.items() if name not in COUNTS}

    def evaluate(self, episodes: int | None = None, *, progress: bool = False) -> dict[str, Any]:
        """Plays whole episodes with the newest checkpoint and records them: what `suite evaluate` does.

        Args:
          episodes: at least so many; None: the run's setting.
          progress: whether progress is shown.

        Returns:
          the task's scores over them, their number ("episodes") and the checkpoint's "step".

        Raises:
          UserError: there is no usable checkpoint, or the run is in use.
        """
        return evaluation.evaluate(self.folder, episodes, _reporter(progress))

    @functools.cached_property
    def _restored(self) -> RestoredRun:
        return restore(self._record, QuietReporter())

    @functools.cached_property
    def policy(self) -> Player:
        """The policy, which remembers what it has seen until it is reset."""
        return Player(self._restored)

    @functools.cached_property
    def world_model(self) -> Dreamer:
        """The world model of a single-agent task.

        Raises:
          UserError: the agent has none, or the task is a game of two players.
        """
        if not self.config.world_model.enabled:
            raise UserError(f"{self.folder} has no world model: {self.config.agent} learns from real play only")
        if self.spec.two_player:
            raise UserError(f"{self.folder} is a run of a two-player game: `suite inspect` imagines whole games of it")
        return Dreamer(self._restored)


class Player:
    """A trained policy that acts on observations."""

    def __init__(self, restored: RestoredRun):
        self._agent, self._state = restored.agent, restored.model.policy_state
        self.spec = restored.agent.spec
        self.reset()

    def reset(self, seed: int = 0) -> None:
        """Forgets what it has seen; `seed` is of the actions that it samples from then on."""
        self._key = jax.random.key(seed)
        self._hidden_BH: jax.Array | None = None

    def act(
        self,
        observation: np.ndarray,
        first: np.ndarray | bool | None = None,
        legal: np.ndarray | None = None,
        acting: np.ndarray | bool | None = None,
        greedy: bool = False,
    ) -> np.ndarray:
        """Actions, int32 [B].

        Args:
          observation: uint8 [B, *spec.observation.shape].
          first: bool [B]; whether each opens an episode, so that the memory of what came before is dropped. None: if
            this is the first call since `reset`.
          legal: bool [B, A]; in games, which actions are.
          acting: bool [B]; in games, whose turn it is: where it is not ours the memory stays, and the action is of no
            use. None: all are ours.
          greedy: the likeliest action instead of a sampled one, as episodes are never scored.

        Raises:
          UserError: arrays of other shapes or types.
        """
        logits = self.preferences(observation, first, acting)
        if legal is not None:
            logits = np.asarray(mask_logits(jnp.asarray(logits), jnp.asarray(legal, bool)))
        if greedy:
            return logits.argmax(-1).astype(np.int32)
        self._key, key = jax.random.split(self._key)
        return np.asarray(jax.random.categorical(key, jnp.asarray(logits)), np.int32)

    def preferences(
        self,
        observation: np.ndarray,
        first: np.ndarray | bool | None = None,
        acting: np.ndarray | bool | None = None,
    ) -> np.ndarray:
        """Logits of all actions, float32 [B, A]; arguments and errors as of `act`. The memory advances."""
        observation_BO, alone = _batch(observation, self.spec.observation.shape, "observation")
        batch = len(observation_BO)
        if self._hidden_BH is None or len(self._hidden_BH) != batch:
            self._hidden_BH = _nothing(self._agent, self._state.params, batch)
            first = True if first is None else first
        flags = [False if first is None else first, True if acting is None else acting]
        first_B, acting_B = (jnp.broadcast_to(jnp.asarray(flag, bool), (batch,)) for flag in flags)
        logits_BA, self._hidden_BH = _preferences(
            self._agent, self._state.params, observation_BO, first_B, acting_B, self._hidden_BH
        )
        return np.asarray(logits_BA[0] if alone else logits_BA)


@dataclasses.dataclass(frozen=True)
class Imagined:
    """What a world model made of T actions.

    Attributes:
      frames: uint8 [B, T, *spec.observation.shape]; what each action led to.
      rewards: float32 [B, T]; levels that the world model tells apart.
      ends: bool [B, T]; whether the episode ended there. The model goes on all the same.
    """

    frames: np.ndarray
    rewards: np.ndarray
    ends: np.ndarray


class Dreamer:
    """A trained world model and its tokenizer."""

    def __init__(self, restored: RestoredRun):
        self._agent, self._model = restored.agent, restored.model
        self.spec = restored.agent.spec

    def dream(
        self,
        frames: np.ndarray,
        actions: np.ndarray,
        before: tuple[np.ndarray, np.ndarray] | None = None,
        paid: np.ndarray | None = None,
        seed: int = 0,
    ) -> Imagined:
        """What happens if these actions are taken from these frames on.

        Args:
          frames: uint8 [B, *spec.observation.shape].
          actions: int [B, T].
          before: the P frames before those, uint8 [B, P, *spec.observation.shape], oldest first, and the actions taken
            on them, int [B, P]. A model that is told what happened earlier (m6's ages) dreams worse without them; P
            must be at least what it is told, `needs`.
          paid: int [B, A]; how often each action has earned a reward in the episode, for a model that is told (m6's on
            Craftax). None: nothing was paid yet.
          seed: of what is drawn.

        Raises:
          UserError: arrays of other shapes or types, or actions that there are not.
        """
        shape = self.spec.observation.shape
        frames_BO, alone = _batch(frames, shape, "frames")
        actions_BT = np.atleast_2d(np.asarray(actions, np.int32))
        if actions_BT.ndim != 2 or len(actions_BT) != len(frames_BO):
            raise UserError(f"actions have shape {list(np.shape(actions))}, expected {len(frames_BO)} times steps")
        most = self.spec.num_actions - 1
        if actions_BT.size and not 0 <= actions_BT.min() <= actions_BT.max() <= most:
            raise UserError(f"actions are {actions_BT.min()} to {actions_BT.max()}, expected 0 to {most}")
        past = None
        if before is not None:
            earlier, taken = np.asarray(before[0], np.uint8), np.asarray(before[1], np.int32)
            if alone:
                earlier, taken = earlier[None], taken[None]
            steps = taken.shape[-1]
            if earlier.shape != (len(frames_BO), steps, *shape) or taken.shape != (len(frames_BO), steps):
                raise UserError(
                    f"frames before have shape {list(earlier.shape)}, and their actions {list(taken.shape)}"
                )
            if steps < self.needs:
                raise UserError(f"{steps} frames come before, and this model is told of {self.needs}")
            past = Past(
                jnp.asarray(earlier[:, steps - self.needs :].swapaxes(0, 1)),
                jnp.asarray(taken[:, steps - self.needs :].T),
            )
        paid_BA = None
        if paid is not None:
            paid_BA = jnp.asarray(np.atleast_2d(np.asarray(paid)).clip(0, MOST), jnp.uint8)
            if paid_BA.shape != (len(frames_BO), most + 1):
                expected = [len(frames_BO), most + 1]
                raise UserError(f"paid has shape {list(np.shape(paid))}, expected {expected}: a count for each action")
        seen = _dream(
            self._agent,
            self._model.world_model,
            self._model.tokenizer,
            frames_BO,
            jnp.asarray(actions_BT.T),
            past if self.needs else None,
            paid_BA,
            jax.random.key(seed),
        )
        arrays = [np.asarray(x).swapaxes(0, 1) for x in seen]
        return Imagined(*(array[0] if alone else array for array in arrays))

    @property
    def needs(self) -> int:
        """How many frames before a dream's first one the model is told of, in training."""
        return self._agent.past

    def encode(self, frames: np.ndarray) -> np.ndarray:
        """Tokens of frames, int32 [B, L] (float32 vectors for a tokenizer without codes)."""
        frames_BO, alone = _batch(frames, self.spec.observation.shape, "frames")
        tokens_BL = np.asarray(self._agent.tokenizer.encode(self._model.tokenizer, frames_BO))
        return tokens_BL[0] if alone else tokens_BL

    def decode(self, tokens: np.ndarray) -> np.ndarray:
        """Frames that tokens [..., L] stand for, uint8."""
        return np.asarray(self._agent.tokenizer.decode(self._model.tokenizer, jnp.asarray(tokens)))


@functools.partial(jax.jit, static_argnums=0)
def _preferences(
    agent: Agent, params: Any, observation_BO: jax.Array, first_B: jax.Array, acting_B: jax.Array, hidden_BH: jax.Array
) -> tuple[jax.Array, jax.Array]:
    policy = nnx.merge(agent.policy_graph, params)
    acting_1B = acting_B[None] if agent.spec.two_player else None
    output, hidden_BH = policy(observation_BO[None], first_B[None], hidden_BH, acting_1B)
    return output.logits_TBA[0], hidden_BH


@functools.partial(jax.jit, static_argnums=0)
def _dream(
    agent: Agent,
    world_model: nnx.State,
    tokenizer: Any,
    frames_BO: jax.Array,
    action_TB: jax.Array,
    past: Past | None,
    paid_BA: jax.Array | None,
    key: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    model = nnx.merge(agent.world_model_graph, world_model)
    dream = agent.dream_from(model, tokenizer, frames_BO, None, len(action_TB), past, None, paid_BA)
    start, _ = dream.reset(key)

    def step(state: Any, inputs: tuple[jax.Array, jax.Array]) -> tuple[Any, Any]:
        state, shown = dream.step(inputs[0], state, inputs[1])
        return state, (shown.observation, shown.reward, shown.terminated)

    _, seen = jax.lax.scan(step, start, (jax.random.split(key, len(action_TB)), action_TB))
    return seen


def _nothing(agent: Agent, params: Any, batch: int) -> jax.Array:
    """What a policy remembers that has seen nothing."""
    hidden_BH: jax.Array = nnx.merge(agent.policy_graph, params).initial_hidden(batch)
    return hidden_BH


def _batch(array: np.ndarray, shape: tuple[int, ...], name: str) -> tuple[jax.Array, bool]:
    """The array with a batch's axis, and whether it came without."""
    found = np.asarray(array)
    alone = found.shape == shape
    if not alone and found.shape[1:] != shape:
        raise UserError(f"{name}: shape {list(found.shape)}, expected {list(shape)}, or several of it")
    if found.dtype.kind not in "bui":
        raise UserError(f"{name}: numbers of type {found.dtype}, expected whole ones, as the task shows them (uint8)")
    return jnp.asarray(found[None] if alone else found, jnp.uint8), alone


def _reporter(progress: bool) -> Reporter:
    return RichReporter() if progress else QuietReporter()


def _begin() -> None:
    """What every command does before it uses JAX."""
    quiet_xla()
    refuse_other_arithmetic()
    enable_compilation_cache()
