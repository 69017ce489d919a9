"""One run, start to finish: build, resume, train, evaluate, record."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from suite import registry
from suite.agent.algorithm import first_programs, iterate, iteration_key, start_key
from suite.agent.phases import Agent
from suite.agent.state import TrainState, laid_out
from suite.configuration.schema import Config
from suite.interface.environment import EnvironmentSpec
from suite.records import checkpoint
from suite.records.record import RunRecord, run_folder
from suite.records.wandb_runs import WandbRun, require_wandb
from suite.runs.devices import Asked, used
from suite.runs.evaluation import episode_rows, record_evaluation
from suite.runs.own_record import opened
from suite.runs.saved_model import Remainder, SavedModel, agent_for
from suite.runtime import layout, processes
from suite.runtime.compilation import Ahead
from suite.runtime.errors import RunError, UserError, host_errors, refusals_are_errors
from suite.runtime.reporting import Reporter
from suite.runtime.signals import stop_signals

PART_OF = {"remember": "collect", "code": "tokenizer"}  # phases without metrics, which are not timed by themselves
PHASES = ("start", "collect", "learn", "tokenizer", "world_model", "imagine", "checkpoint")


@dataclasses.dataclass(frozen=True)
class Result:
    """What a run came to.

    Attributes:
      folder: where its record is.
      status: "finished", "stopped" (by a signal or a callback) or "already finished".
      steps: real steps taken.
      wall_seconds: of all its processes.
      scores: by name, from its training episodes.
      evaluation: by name, from the episodes of its newest evaluation; empty if there was none.
    """

    folder: Path
    status: str
    steps: int
    wall_seconds: float
    scores: dict[str, float]
    evaluation: dict[str, float] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Iteration:
    """What one iteration of Algorithm 1 left in the record.

    Attributes:
      step: real steps taken by then.
      metrics: its row of `metrics.csv`, by column.
      episodes: the rows of `episodes.csv` of the episodes that ended in it, by column.
    """

    step: int
    metrics: dict[str, Any]
    episodes: list[dict[str, Any]]


Callback = Callable[[Iteration], bool | None]


def run(
    config: Config,
    out: Path,
    reporter: Reporter,
    resume: bool = False,
    callbacks: Sequence[Callback] = (),
    wandb: str | None = None,
    devices: Asked = None,
) -> Result:
    """Trains one agent on one task, or goes on where an earlier call of the same command stopped.

    Args:
      config: the resolved configuration.
      out: the folder of all runs; this one's is `<out>/<task>/<agent>/<preset>/seed_<n>`.
      reporter: where progress goes.
      resume: insist that there is a run to go on with.
      callbacks: called after each iteration; if one returns True, the run stops with a checkpoint.
      wandb: the project at Weights & Biases that gets curves, beside TensorBoard's; None: it gets none.
      devices: between how many its batches are split, which may be others than when it was stopped; see
        `suite.runs.devices.used`.

    Raises:
      UserError: before anything is compiled: the folder cannot be written, is in use, or holds another run; or Weights
        & Biases, or so many devices, cannot be used.
      RunError: the loss diverged or the disk is full; the last good checkpoint stays.
    """
    entry = registry.task(config.task)
    folder = run_folder(out, config)
    if resume and not (folder / "record.json").exists():
        raise UserError(f"nothing to resume in {folder}: run without --resume to start there")
    if wandb is not None:
        require_wandb()
    with (
        layout.over(used(config, devices, reporter)),
        refusals_are_errors(),
        processes.lost_ones(),
        opened(folder, config, entry.spec()) as record,
    ):
        if record.finished:
            _forget(record)  # a kill may have come before, or more was kept until now
            return result_of(record, "already finished", folder)
        if wandb is not None and processes.is_first():
            there = WandbRun(folder, config, wandb)
            record.draw_curves_at(there)
            reporter.message(f"Weights & Biases: {there.place}")
        return _Training(config, agent_for(config, reporter), record, folder, reporter, callbacks).run()


class IterationLog:
    """What the phases of one iteration gave.

    Attributes:
      steps: real steps taken by its end.
      rows: of the episodes that ended in it, as in `episodes.csv`.
      metrics: by name, as in `metrics.csv`.
    """

    def __init__(self, spec: EnvironmentSpec, steps: int):
        self.spec, self.steps = spec, steps
        self.rows: list[dict[str, Any]] = []
        self.metrics: dict[str, Any] = {}

    def add(self, phase: str, result: Any) -> dict[str, float]:
        """Takes what a phase returned; its metrics, on the host, prefixed by the phase."""
        if phase == "collect":
            _, trajectory, log = result
            log = jax.device_get(log)
            self.rows, taken = episode_rows(log, self.spec, log.ended_TB, self.steps)
            self.steps += taken
            self.metrics["reward_per_step"] = float(trajectory.reward_TB.mean())
            return {}
        values = {f"{phase}/{name}": float(value) for name, value in jax.device_get(result[1]).items()}
        self.metrics |= values
        return values

    def row(self) -> dict[str, Any]:
        """The iteration's row of `metrics.csv`."""
        returns = [row["return"] for row in self.rows]
        first = {"reward_per_step": self.metrics["reward_per_step"], "episodes": len(returns)}
        return {"step": self.steps, **first, "return": float(np.mean(returns)) if returns else None} | self.metrics


class _Training:
    """The host's side of a run: phases in order, their metrics and timing, checkpoints, signals, callbacks."""

    def __init__(
        self,
        config: Config,
        agent: Agent,
        record: RunRecord,
        folder: Path,
        reporter: Reporter,
        callbacks: Sequence[Callback],
    ):
        self.config, self.agent, self.record, self.reporter = config, agent, record, reporter
        self.callbacks = callbacks
        self.checkpoints = folder / "checkpoints"
        self.iteration = self.steps = 0
        self.log = IterationLog(agent.spec, 0)  # of the present iteration
        self.unlocked: set[str] = set()  # achievements, in any episode so far
        self.seconds: dict[str, float] = {}  # wall-clock per phase, over all of the run's processes
        self.recorded_seconds: dict[str, float] = {}  # of those, what timing.csv has
        self.stop_requested = self.stop_now = self.saving = False
        self.ahead = Ahead()

    @property
    def done(self) -> bool:
        """No whole iteration fits the budget any more."""
        return self.steps + self.config.steps_per_iteration > self.config.protocol.steps

    def run(self) -> Result:
        started = time.monotonic()
        self.reporter.start(self.config.protocol.steps, 0)
        try:
            with self._phase("start"):
                state = self._restore()
            self.reporter.start(self.config.protocol.steps, self.steps)
            with stop_signals(self._heard), host_errors():
                while not self.done and not self.stop_requested:
                    before = self.steps
                    state = self._iterate(state)
                    # Before the checkpoint: what is evaluated after it would be missing if the run died in between.
                    if self._passed(before, self.config.evaluation.every_steps):
                        self._evaluate(state)
                    if self._passed(before, self.config.checkpoint.every_steps) or self.stop_requested:
                        self._save(state)
                if self.done:
                    self._finish(state)
                else:
                    self.record.update(status="stopped")
        except RunError:
            self.record.update(status="failed")
            raise
        finally:
            self.ahead.close()
            self.reporter.stop()
            self.record.add_wall_clock(time.monotonic() - started, self.seconds)
        return result_of(self.record, "finished" if self.record.finished else "stopped", self.checkpoints.parent)

    def _passed(self, before: int, every: int) -> bool:
        """Whether the last iteration, begun at step `before`, reached another multiple of `every` (0: of nothing)."""
        return _passes(before, self.steps, every)

    def _restore(self) -> TrainState:
        key = start_key(self.config.seed)
        template = laid_out(jax.eval_shape(self.agent.init, key))
        remainder = Remainder.of(template).stored()
        try:
            with layout.over([]):
                restored = checkpoint.restore_latest(self.checkpoints, SavedModel.of(template), remainder)
        except UserError as error:
            raise UserError(f"{error}; choose another --out to start anew") from error
        if restored is None:
            self.record.rewind(0)
            self._extend()
            self.ahead.begin(first_programs(self.agent, template))
            return self.agent.init(key)
        for warning in restored.warnings:
            self.reporter.warning(warning)
        self.iteration, self.steps = restored.host["iteration"], restored.host["steps"]
        self.seconds = restored.host["seconds"]
        self.recorded_seconds = dict(self.seconds)
        if restored.resume is None and not self.done:
            raise UserError(
                f"{self.checkpoints} holds only the model of step {self.steps:,}, which cannot be trained on"
            )
        self.record.rewind(self.steps)
        self._extend()
        achievements = self.record.episodes()[list(self.agent.spec.achievements)]
        self.unlocked.update(achievements.columns[achievements.any()])
        self.reporter.message(f"resuming at step {self.steps:,}")
        if not self.done:
            self.ahead.begin(first_programs(self.agent, template))
        # A run that was killed at its end has dropped what only going on needs.
        resume = restored.resume or dict.fromkeys(remainder)
        return laid_out(Remainder(**resume).with_model(restored.model))

    def _extend(self) -> None:
        """Gives a run that went back to its newest checkpoint the larger budget, if it is asked for."""
        if self.record.asks_for_more:
            every = self.config.evaluation.every_steps
            ends = itertools.pairwise([0, *self.record.table("metrics")["step"]])
            self.record.extend({end for before, end in ends if _passes(before, end, every)})

    def _iterate(self, state: TrainState) -> TrainState:
        """One iteration of Algorithm 1, and what it leaves in the record."""
        self.log = IterationLog(self.agent.spec, self.steps)
        key = iteration_key(self.config.seed, self.iteration)
        self.iteration += 1
        state, _ = iterate(self.agent, state, key, self.steps, self._call)
        self.record.append_episodes(self.log.rows)
        row = self.log.row()
        self.record.append_metrics(row, self.agent.metric_names)
        self._record_timing()
        self.unlocked.update(name for name in self.agent.spec.achievements if any(row[name] for row in self.log.rows))
        shown = {} if row["return"] is None else {"return": row["return"]}
        if self.agent.spec.achievements:
            shown["achievements"] = len(self.unlocked)
        self.reporter.update(self.steps, "", shown)
        for callback in self.callbacks:
            if callback(Iteration(self.steps, row, self.log.rows)):
                self.stop_requested = True
        self.stop_requested = any(processes.votes(self.stop_requested))
        return state

    def _call(self, phase: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Runs and times a phase; keeps its metrics and, of real play, the episodes."""
        if phase in PART_OF:
            with self._timed(PART_OF[phase]):
                self.ahead.wait(phase)
                return jax.block_until_ready(function(*arguments))
        with self._phase(phase):
            self.ahead.wait(phase)
            result = function(*arguments)
            self._check(phase, self.log.add(phase, result))
            self.steps = self.log.steps
        return result

    def _record_timing(self) -> None:
        """Seconds per phase since the last iteration's row; the first compiles."""
        since = {name: self.seconds.get(name, 0.0) - self.recorded_seconds.get(name, 0.0) for name in PHASES}
        self.record.append_timing({"step": self.steps, **since})
        self.recorded_seconds = dict(self.seconds)

    @contextlib.contextmanager
    def _phase(self, name: str) -> Iterator[None]:
        self.reporter.update(self.steps, name, {})
        with self._timed(name):
            yield

    @contextlib.contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        start = time.monotonic()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - start

    def _check(self, phase: str, values: dict[str, float]) -> None:
        """Stops the run where a loss or gradient is not finite."""
        for name, value in values.items():
            if not np.isfinite(value):
                kept = checkpoint.latest_step(self.checkpoints)
                where = "no checkpoint was saved yet" if kept is None else f"the checkpoint at step {kept:,} is kept"
                raise RunError(f"{name} became {value} in phase {phase} at step {self.steps:,}; {where}")

    def _evaluate(self, state: TrainState) -> None:
        """Plays whole episodes with the present policy, unless there are enough of this step already."""
        episodes = self.config.evaluation.episodes
        if self.record.has_evaluation(self.steps, episodes):
            return
        with self._phase("evaluate"):
            self.record.rewind_evaluations(self.steps)
            record_evaluation(self.record, self.agent, state.policy.acting, self.steps, episodes)

    def _save(self, state: TrainState) -> None:
        with self._phase("checkpoint"):
            host = {"iteration": self.iteration, "seconds": self.seconds}
            model, remainder = processes.whole((SavedModel.of(state), Remainder.of(state).stored()))
            self.record.require_own_folder()
            self.saving = True
            if processes.is_first():
                with layout.over([]):
                    keep = self.config.checkpoint.keep
                    checkpoint.save(self.checkpoints, self.steps, model, remainder, host, keep)
            processes.votes(True)
            self.saving = False
        if self.stop_now:
            raise KeyboardInterrupt

    def _finish(self, state: TrainState) -> None:
        """Saves the last checkpoint, plays the final evaluation, and closes the record."""
        if checkpoint.latest_step(self.checkpoints) != self.steps:
            self._save(state)
        self._evaluate(state)
        _forget(self.record)
        self.record.finish(self.steps)  # last: what is finished goes on only if it is given more steps

    def _heard(self, count: int) -> None:
        """The first signal ends the run after this iteration, with a checkpoint; the second at once.

        A checkpoint that is being written is not interrupted: it takes seconds, and its threads would go on.
        """
        self.stop_now = count > 1
        if self.stop_now and not self.saving:
            raise KeyboardInterrupt
        self.stop_requested = True
        self.reporter.message("stopping after this iteration, with a checkpoint (again: stop now)")


def _passes(before: int, steps: int, every: int) -> bool:
    """Whether there is a multiple of `every` after `before` and up to `steps`."""
    return bool(every) and steps // every > before // every


def _forget(record: RunRecord) -> None:
    """Deletes what a finished run needs no longer."""
    config = record.config
    more = config.checkpoint.keep_resume and not config.tied_to_budget
    checkpoint.drop_resume(record.folder / "checkpoints", but_newest=more)


def result_of(record: RunRecord, status: str, folder: Path | None = None) -> Result:
    """What a run came to so far. `folder` is where its record lasts, if this one is a copy."""
    score = registry.task(record.config.task).scores()
    scores = score(record.episodes(), record.config, record.spec)
    evaluations = record.table("evaluations")
    newest = evaluations[evaluations["step"] == evaluations["step"].max()]
    evaluation = score(newest, None, record.spec) if len(newest) else {}
    return Result(folder or record.folder, status, record.steps, record.wall_seconds, scores, evaluation)
