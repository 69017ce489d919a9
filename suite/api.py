"""The suite from Python: `suite.make`, `suite.train`, `suite.train_together`, `suite.load` and `suite.results`."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from leaderboards.results import COUNTS, finished_in
from suite import registry
from suite.configuration.schema import Config
from suite.interface.batching import Batched
from suite.interface.environment import EnvironmentSpec
from suite.records.record import RunRecord
from suite.runs import evaluation, training
from suite.runs.saved_model import RestoredRun, restore
from suite.runs.trained import Dreamer, Player
from suite.runs.training import Callback, Result
from suite.runtime.compilation import device_kind, enable_compilation_cache, quiet_xla, refuse_other_arithmetic
from suite.runtime.errors import UserError
from suite.runtime.reporting import QuietReporter, Reporter, RichReporter


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


def _reporter(progress: bool) -> Reporter:
    return RichReporter() if progress else QuietReporter()


def _begin() -> None:
    """What every command does before it uses JAX."""
    quiet_xla()
    refuse_other_arithmetic()
    enable_compilation_cache()
