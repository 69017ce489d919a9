"""Runs, start to finish: build, resume, train, evaluate, record. One, or several seeds of one that go on together."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from suite import registry
from suite.agent.algorithm import evaluation_key, first_programs, iterate, iteration_key, start_key
from suite.agent.phases import Agent
from suite.agent.seeds import part, stacked, unstacked
from suite.agent.state import TrainState, laid_out
from suite.configuration.schema import Config
from suite.records import checkpoint
from suite.records.record import RunRecord, run_folder
from suite.records.wandb_runs import WandbRun, require_wandb
from suite.runs.devices import Asked, computed, used, used_together
from suite.runs.evaluation import play_episodes
from suite.runs.own_record import opened
from suite.runs.progress import Iteration, Progress, forget, told
from suite.runs.saved_model import Remainder, agent_for
from suite.runtime import layout, processes
from suite.runtime.compilation import Ahead
from suite.runtime.errors import RunError, UserError, host_errors, refusals_are_errors
from suite.runtime.reporting import Reporter
from suite.runtime.signals import stop_signals

PART_OF = {"remember": "collect", "code": "tokenizer"}  # phases without metrics, which are not timed by themselves

Tree = TypeVar("Tree")


@dataclasses.dataclass(frozen=True)
class Result:
    """What a run came to.

    Attributes:
      folder: where its record is.
      status: "finished", "stopped" (by a signal or a callback), "already finished", or, of one among others that went
        on together, "failed".
      steps: real steps taken.
      wall_seconds: of all its processes.
      scores: by name, from its training episodes.
      evaluation: by name, from the episodes of its newest evaluation; empty if there was none.
      reason: why it failed.
    """

    folder: Path
    status: str
    steps: int
    wall_seconds: float
    scores: dict[str, float]
    evaluation: dict[str, float] = dataclasses.field(default_factory=dict)
    reason: str = ""


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
    folder = run_folder(out, config)
    if resume and not (folder / "record.json").exists():
        raise UserError(f"nothing to resume in {folder}: run without --resume to start there")
    if wandb is not None:
        require_wandb()
    with layout.over(used(config, devices, reporter)):
        [result] = _run([config], [folder], reporter, callbacks, wandb)
    return result


def run_together(
    configs: Sequence[Config],
    out: Path,
    reporter: Reporter,
    callbacks: Sequence[Callback] = (),
    wandb: str | None = None,
    devices: Asked = None,
) -> list[Result]:
    """Trains several runs that differ by their seed as one program, or goes on with those of them that were stopped.

    Each has the record that it has if it is run alone. One that fails does not stop the others.

    Args:
      configs: the resolved configurations.
      out, reporter, callbacks, wandb: as of `run`; a callback that returns True stops all of them.
      devices: between how many the runs are divided, each of which is on one; None: one CPU, or all accelerators.

    Returns:
      what they came to, in the same order.

    Raises:
      UserError, RunError: as of `run`; and a UserError for a task that steps on the host.
    """
    if wandb is not None:
        require_wandb()
    spec = registry.task(configs[0].task).spec()
    folders = [run_folder(out, config) for config in configs]
    going = [
        config
        for config, folder in zip(configs, folders, strict=True)
        if not (folder / "record.json").exists() or not RunRecord.open(folder, config, spec, lock=False).finished
    ]
    chosen = used_together(configs[0], max(1, len(going)), devices, reporter)
    # One that is left alone is a run like any other.
    with layout.over(chosen, layout.SEEDS):
        return _run(configs, folders, reporter, callbacks, wandb)


def _run(
    configs: Sequence[Config],
    folders: Sequence[Path],
    reporter: Reporter,
    callbacks: Sequence[Callback],
    wandb: str | None,
) -> list[Result]:
    spec = registry.task(configs[0].task).spec()
    with contextlib.ExitStack() as stack:
        stack.enter_context(refusals_are_errors())
        stack.enter_context(processes.lost_ones())
        opening = zip(folders, configs, strict=True)
        records = [stack.enter_context(opened(folder, config, spec)) for folder, config in opening]
        going: dict[int, Progress] = {}
        for i, record in enumerate(records):
            if record.finished:
                forget(record)  # a kill may have come before, or more was kept until now
            else:
                going[i] = Progress(record, spec)
        for progress in going.values():
            progress.record.note_company(len(going))
            if wandb is not None and processes.is_first():
                there = WandbRun(progress.record.folder, progress.config, wandb)
                progress.record.draw_curves_at(there)
                reporter.message(f"Weights & Biases: {there.place}")
        if going:
            _Training(list(going.values()), reporter, callbacks).run()
        return [
            result_of(record, _status(going.get(i)), folder, going[i].reason if i in going else "")
            for i, (record, folder) in enumerate(zip(records, folders, strict=True))
        ]


def _status(progress: Progress | None) -> str:
    if progress is None:
        return "already finished"
    return "failed" if progress.reason else "finished" if progress.record.finished else "stopped"


class _Training:
    """The host's side of runs that go on together: phases in order, timing, checkpoints, signals, callbacks."""

    def __init__(self, runs: Sequence[Progress], reporter: Reporter, callbacks: Sequence[Callback]):
        self.runs, self.reporter, self.callbacks = runs, reporter, callbacks
        # The first run stands for those that are missing so that devices have equal shares.
        self.seeds = 1 if len(runs) == 1 else computed(len(runs), layout.devices())
        self.agent: Agent = agent_for(runs[0].config, reporter, self.seeds)
        self.stop_requested = self.stop_now = self.saving = False
        self.ahead = Ahead()

    @property
    def going(self) -> list[Progress]:
        """Those that are not at their end."""
        return [run for run in self.runs if not run.ended]

    def run(self) -> None:
        total = sum(run.config.protocol.steps for run in self.runs)
        self.reporter.start(total, 0)
        status: str | None = None
        try:
            with self._phase("start"):
                state = self._restore()
            self.reporter.start(total, self._steps())
            with stop_signals(self._heard), host_errors():
                self._finish(state)
                while self.going and not self.stop_requested:
                    state = self._iterate(state)
                    # Before the checkpoint: what is evaluated after it would be missing if the run died in between.
                    self._evaluate(state, [run for run in self.going if run.passed(run.config.evaluation.every_steps)])
                    self._save(
                        state,
                        [
                            run
                            for run in self.going
                            if run.passed(run.config.checkpoint.every_steps) or self.stop_requested
                        ],
                    )
                    self._finish(state)
            status = "stopped"
        except RunError:
            status = "failed"
            raise
        finally:
            self.ahead.close()
            self.reporter.stop()
            for run in self.runs:
                run.leave(status)

    def _steps(self) -> int:
        return sum(run.steps for run in self.runs)

    def _together(self, parts: Sequence[Tree]) -> Tree:
        """What each run has, as the agent takes it."""
        return stacked([*parts, *[parts[0]] * (self.seeds - len(parts))])

    def _restore(self) -> TrainState:
        keys = self._together([start_key(run.config.seed) for run in self.runs])
        template = laid_out(jax.eval_shape(self.agent.init, keys))
        of_one = template
        if self.seeds > 1:
            of_one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), template)
        saved = [run.restore(of_one, self.reporter) for run in self.runs]
        if not all(run.done for run in self.runs):
            self.ahead.begin(first_programs(self.agent, template))
        if not any(saved):
            return self.agent.init(keys)
        # What a run has not saved is that of its start; of one that is at its end it does not matter.
        missing = len(self.runs) > 1 and not all(each and each[1] for each in saved)
        starts = unstacked(self.agent.init(keys), self.seeds) if missing else [None] * self.seeds
        return laid_out(self._together([_joined(*pair) for pair in zip(saved, starts, strict=False)]))

    def _iterate(self, state: TrainState) -> TrainState:
        """One iteration of Algorithm 1, and what it leaves in the records."""
        for run in self.going:
            run.begin_iteration()
        keys = self._together([iteration_key(run.config.seed, run.iteration - 1) for run in self.runs])
        steps = self._together([np.array(run.steps) for run in self.runs])
        state, _ = iterate(self.agent, state, keys, np.asarray(steps), self._call)
        left = [run.end_iteration(self.agent.metric_names) for run in self.going]
        self._show(left)
        for callback in self.callbacks:
            for iteration in left:
                if callback(iteration):
                    self.stop_requested = True
        self.stop_requested = any(processes.votes(self.stop_requested))
        return state

    def _show(self, left: Sequence[Iteration]) -> None:
        shown: dict[str, float] = {}
        if returns := [iteration.metrics["return"] for iteration in left if iteration.metrics["return"] is not None]:
            shown["return"] = float(np.mean(returns))
        if self.agent.spec.achievements:
            shown["achievements"] = float(np.mean([len(run.unlocked) for run in self.runs]))
        self.reporter.update(self._steps(), "", shown)

    def _call(self, phase: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Runs and times a phase; keeps its metrics and, of real play, the episodes."""
        if phase in PART_OF:
            with self._timed(PART_OF[phase]):
                self.ahead.wait(phase)
                return jax.block_until_ready(function(*arguments))
        with self._phase(phase):
            self.ahead.wait(phase)
            result = function(*arguments)
            parts = told(phase, result, self.seeds)
            dreams_S = np.atleast_1d(arguments[-2]) > 0 if phase == "imagine" else np.ones(self.seeds, bool)
            for run, own, learns in zip(self.runs, parts, dreams_S, strict=False):
                if learns and not run.ended:
                    self._take(run, phase, own)
        return result

    def _take(self, run: Progress, phase: str, own: Any) -> None:
        try:
            run.take(phase, own)
        except RunError as error:
            if len(self.runs) == 1:
                raise
            run.fail(str(error))
            self.reporter.warning(f"seed {run.config.seed} ends here, the others go on: {error}")

    @contextlib.contextmanager
    def _phase(self, name: str) -> Iterator[None]:
        self.reporter.update(self._steps(), name, {})
        with self._timed(name):
            yield

    @contextlib.contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        start = time.monotonic()
        yield
        for run in self.going:
            run.spent(name, time.monotonic() - start)

    def _evaluate(self, state: TrainState, runs: Sequence[Progress]) -> None:
        """Plays whole episodes with the present policies of these, unless there are enough already."""
        lacking = [run for run in runs if run.lacks_evaluation()]
        if not lacking:
            return
        with self._phase("evaluate"):
            keys = [evaluation_key(run.config.seed, run.steps) if run in lacking else None for run in self.runs]
            keys += [None] * (self.seeds - len(keys))
            played = play_episodes(self.agent, state.policy.acting, keys, runs[0].config.evaluation.episodes)
            for run, rows in zip(self.runs, played, strict=False):
                if run in lacking:
                    run.record.append_evaluation({**row, "step": run.steps} for row in rows)

    def _save(self, state: TrainState, runs: Sequence[Progress]) -> None:
        for run in runs:
            with self._phase("checkpoint"):
                own = part(state, self.seeds, self.runs.index(run))
                self.saving = True
                run.save(own)
                self.saving = False
            if self.stop_now:
                raise KeyboardInterrupt

    def _finish(self, state: TrainState) -> None:
        """Saves the last checkpoints of runs at their end, plays the final evaluation, and closes the records."""
        done = [run for run in self.going if run.done]
        self._save(state, [run for run in done if checkpoint.latest_step(run.checkpoints) != run.steps])
        self._evaluate(state, done)
        for run in done:
            run.finish()

    def _heard(self, count: int) -> None:
        """The first signal ends the run after this iteration, with a checkpoint; the second at once.

        A checkpoint that is being written is not interrupted: it takes seconds, and its threads would go on.
        """
        self.stop_now = count > 1
        if self.stop_now and not self.saving:
            raise KeyboardInterrupt
        self.stop_requested = True
        self.reporter.message("stopping after this iteration, with a checkpoint (again: stop now)")


def _joined(saved: Any, start: TrainState | None) -> TrainState:
    """The state of a run from what it has saved, if it has, and of the rest from its `start`, if that is given."""
    if saved is None:
        assert start is not None
        return start
    model, remainder = saved
    if remainder is None:
        nothing: dict[str, Any] = dict.fromkeys(field.name for field in dataclasses.fields(Remainder))
        remainder = Remainder(**nothing) if start is None else Remainder.of(start)
    return remainder.with_model(model)


def result_of(record: RunRecord, status: str, folder: Path | None = None, reason: str = "") -> Result:
    """What a run came to so far. `folder` is where its record lasts, if this one is a copy."""
    score = registry.task(record.config.task).scores()
    scores = score(record.episodes(), record.config, record.spec)
    evaluations = record.table("evaluations")
    newest = evaluations[evaluations["step"] == evaluations["step"].max()]
    evaluation = score(newest, None, record.spec) if len(newest) else {}
    return Result(folder or record.folder, status, record.steps, record.wall_seconds, scores, evaluation, reason)
