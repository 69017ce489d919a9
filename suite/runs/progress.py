"""One run as it goes: its record and checkpoints, and where it is. What computes it is `suite.runs.training`."""

from __future__ import annotations

import dataclasses
import itertools
import time
from typing import Any

import jax
import numpy as np

from suite.agent.seeds import unstacked
from suite.agent.state import TrainState
from suite.interface.environment import EnvironmentSpec
from suite.records import checkpoint
from suite.records.record import RunRecord
from suite.runs.evaluation import episode_rows
from suite.runs.saved_model import Remainder, SavedModel
from suite.runtime import layout, processes
from suite.runtime.errors import RunError, UserError
from suite.runtime.reporting import Reporter

PHASES = ("start", "collect", "learn", "tokenizer", "world_model", "imagine", "checkpoint")


@dataclasses.dataclass(frozen=True)
class Iteration:
    """What one iteration of Algorithm 1 left in the record.

    Attributes:
      step: real steps taken by then.
      metrics: its row of `metrics.csv`, by column.
      episodes: the rows of `episodes.csv` of the episodes that ended in it, by column.
      seed: of which run.
    """

    step: int
    metrics: dict[str, Any]
    episodes: list[dict[str, Any]]
    seed: int = 0


def told(phase: str, result: Any, seeds: int = 1) -> list[Any]:
    """What the host is told of what a phase returned, for each run: metrics; of real play the mean reward and the log.

    `seeds`: how many runs have gone through it together.
    """
    if phase != "collect":
        return unstacked(jax.device_get(result[1]), seeds)
    _, trajectory, log = result
    rewards = [float(reward_TB.mean()) for reward_TB in unstacked(trajectory.reward_TB, seeds)]
    return list(zip(rewards, unstacked(jax.device_get(log), seeds), strict=True))


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

    def add(self, phase: str, part: Any) -> dict[str, float]:
        """Takes what was `told` of a phase; its metrics, prefixed by the phase."""
        if phase == "collect":
            self.metrics["reward_per_step"], log = part
            self.rows, taken = episode_rows(log, self.spec, log.ended_TB, self.steps)
            self.steps += taken
            return {}
        values = {f"{phase}/{name}": float(value) for name, value in part.items()}
        self.metrics |= values
        return values

    def row(self) -> dict[str, Any]:
        """The iteration's row of `metrics.csv`."""
        returns = [row["return"] for row in self.rows]
        first = {"reward_per_step": self.metrics["reward_per_step"], "episodes": len(returns)}
        return {"step": self.steps, **first, "return": float(np.mean(returns)) if returns else None} | self.metrics


class Progress:
    """Where a run is.

    Attributes:
      record, config: of the run.
      checkpoints: their folder.
      iteration: how many it has begun.
      steps: real steps taken.
      unlocked: achievements, in any episode so far.
      ended: whether nothing more is to be done: it is finished, or has failed.
      reason: why it failed; "": it has not.
    """

    def __init__(self, record: RunRecord, spec: EnvironmentSpec):
        """`spec`: the task's."""
        self.record, self.config, self.spec = record, record.config, spec
        self.checkpoints = record.folder / "checkpoints"
        self.iteration = self.steps = 0
        self.unlocked: set[str] = set()
        self.ended, self.reason = False, ""
        self._log = IterationLog(spec, 0)
        self._before = 0  # steps taken before the present iteration
        self._started = time.monotonic()
        self._seconds: dict[str, float] = {}  # wall-clock per phase, over all of the run's processes
        self._recorded_seconds: dict[str, float] = {}  # of those, what timing.csv has

    @property
    def done(self) -> bool:
        """Whether no whole iteration fits the budget any more."""
        return self.steps + self.config.steps_per_iteration > self.config.protocol.steps

    def passed(self, every: int) -> bool:
        """Whether its last iteration reached another multiple of `every` (0: of nothing)."""
        return _passes(self._before, self.steps, every)

    def spent(self, phase: str, seconds: float) -> None:
        """A phase took so long."""
        self._seconds[phase] = self._seconds.get(phase, 0.0) + seconds

    def restore(self, template: TrainState, reporter: Reporter) -> tuple[SavedModel, Remainder | None] | None:
        """Goes to its newest checkpoint, or to its start if there is none (None).

        Args:
          template: shapes of its state, laid out.
          reporter: where warnings about damaged checkpoints go.

        Returns:
          the checkpoint's model and remainder; a run that was killed at its end has dropped the latter.
        """
        remainder = Remainder.of(template).stored()
        try:
            with layout.over([]):
                restored = checkpoint.restore_latest(self.checkpoints, SavedModel.of(template), remainder)
        except UserError as error:
            raise UserError(f"{error}; choose another --out to start anew") from error
        if restored is None:
            self.record.rewind(0)
            self._extend()
            return None
        for warning in restored.warnings:
            reporter.warning(warning)
        self.iteration, self.steps = restored.host["iteration"], restored.host["steps"]
        self._seconds = restored.host["seconds"]
        self._recorded_seconds = dict(self._seconds)
        if restored.resume is None and not self.done:
            raise UserError(
                f"{self.checkpoints} holds only the model of step {self.steps:,}, which cannot be trained on"
            )
        self.record.rewind(self.steps)
        self._extend()
        achievements = self.record.episodes()[list(self.spec.achievements)]
        self.unlocked.update(achievements.columns[achievements.any()])
        reporter.message(f"resuming at step {self.steps:,}")
        return restored.model, None if restored.resume is None else Remainder(**restored.resume)

    def _extend(self) -> None:
        """Gives a run that went back to its newest checkpoint the larger budget, if it is asked for."""
        if self.record.asks_for_more:
            every = self.config.evaluation.every_steps
            ends = itertools.pairwise([0, *self.record.table("metrics")["step"]])
            self.record.extend({end for before, end in ends if _passes(before, end, every)})

    def begin_iteration(self) -> None:
        """The next iteration begins."""
        self._log, self._before = IterationLog(self.spec, self.steps), self.steps
        self.iteration += 1

    def take(self, phase: str, part: Any) -> None:
        """Takes what was `told` of a phase.

        Raises:
          RunError: a loss or gradient is not finite.
        """
        values = self._log.add(phase, part)
        for name, value in values.items():
            if not np.isfinite(value):
                kept = checkpoint.latest_step(self.checkpoints)
                where = "no checkpoint was saved yet" if kept is None else f"the checkpoint at step {kept:,} is kept"
                raise RunError(f"{name} became {value} in phase {phase} at step {self.steps:,}; {where}")
        self.steps = self._log.steps

    def end_iteration(self, metric_names: list[str]) -> Iteration:
        """Records the iteration; `metric_names` are those that any iteration may have."""
        self.record.append_episodes(self._log.rows)
        row = self._log.row()
        self.record.append_metrics(row, metric_names)
        since = {name: self._seconds.get(name, 0.0) - self._recorded_seconds.get(name, 0.0) for name in PHASES}
        self.record.append_timing({"step": self.steps, **since})
        self._recorded_seconds = dict(self._seconds)
        self.unlocked.update(name for name in self.spec.achievements if any(row[name] for row in self._log.rows))
        return Iteration(self.steps, row, self._log.rows, self.config.seed)

    def save(self, state: TrainState) -> None:
        """Writes a checkpoint."""
        host = {"iteration": self.iteration, "seconds": self._seconds}
        model, remainder = processes.whole((SavedModel.of(state), Remainder.of(state).stored()))
        self.record.require_own_folder()
        if processes.is_first():
            with layout.over([]):
                keep = self.config.checkpoint.keep
                checkpoint.save(self.checkpoints, self.steps, model, remainder, host, keep)
        processes.votes(True)

    def lacks_evaluation(self) -> bool:
        """Whether its present policy has not played enough episodes yet; if it has played some, they are set aside."""
        if self.record.has_evaluation(self.steps, self.config.evaluation.episodes):
            return False
        self.record.rewind_evaluations(self.steps)
        return True

    def finish(self) -> None:
        """Closes the record of a run that has come to its end."""
        forget(self.record)
        self.record.finish(self.steps)  # last: what is finished goes on only if it is given more steps
        self._end()

    def fail(self, reason: str) -> None:
        """It cannot go on, but others beside it can."""
        self.reason = reason
        self.record.update(status="failed")
        self._end()

    def leave(self, status: str | None) -> None:
        """Its process ends here; `status` is then its record's, if one is given, unless it has ended already."""
        if not self.ended:
            if status is not None:
                self.record.update(status=status)
            self._end()

    def _end(self) -> None:
        self.ended = True
        self.record.add_wall_clock(time.monotonic() - self._started, self._seconds)


def forget(record: RunRecord) -> None:
    """Deletes what a finished run needs no longer."""
    config = record.config
    more = config.checkpoint.keep_resume and not config.tied_to_budget
    checkpoint.drop_resume(record.folder / "checkpoints", but_newest=more)


def _passes(before: int, steps: int, every: int) -> bool:
    """Whether there is a multiple of `every` after `before` and up to `steps`."""
    return bool(every) and steps // every > before // every
