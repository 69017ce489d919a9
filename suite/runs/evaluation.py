"""Whole episodes of a checkpoint's policy under a task's protocol: sampled actions, no learning."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd

from suite import registry
from suite.agent.algorithm import evaluation_key
from suite.agent.phases import Agent
from suite.agent.rollout import EpisodeLog
from suite.interface.environment import EnvironmentSpec
from suite.policy.ppo import PolicyTrainState
from suite.records.record import RunRecord
from suite.runs.saved_model import restore
from suite.runtime.reporting import Reporter


def episode_rows(
    log: EpisodeLog, spec: EnvironmentSpec, ended_TB: np.ndarray, first_step: int
) -> tuple[list[dict[str, Any]], int]:
    """One row per ended episode, in the order of play, and how many real steps were taken.

    Args:
      log: totals at every step, on the host.
      spec: names the statistics.
      ended_TB: which episodes to report.
      first_step: real steps taken before this rollout; an episode's `step` counts all environments' steps up to
        and including its last.
    """
    rows = []
    steps_T = first_step + np.cumsum(log.counts_TB.sum(axis=1))
    for t, b in zip(*np.nonzero(ended_TB), strict=True):
        row: dict[str, Any] = {
            "step": int(steps_T[t]),
            "return": float(log.return_TB[t, b]),
            "length": int(log.length_TB[t, b]),
        }
        for name, shape in spec.statistics:
            value = log.statistics_TB[name][t, b]
            if shape:
                row |= {achievement: int(v) for achievement, v in zip(spec.achievements, value, strict=True)}
            else:
                row[name] = float(value)
        rows.append(row)
    return rows, int(log.counts_TB.sum())


def play_episodes(
    agent: Any, policy_state: PolicyTrainState | None, key: jax.Array, episodes: int
) -> list[dict[str, Any]]:
    """At least `episodes` whole episodes: the first of each of N_env environments, as often as it takes.

    Taking each environment's first episode, however long, keeps short episodes from being over-counted. Rows have
    `step` counted from the start of the evaluation. Of `agent` only `start`, `collect`, `batched` and `spec` are used.
    """
    rows: list[dict[str, Any]] = []
    while len(rows) < episodes:
        key, start_key = jax.random.split(key)
        rollout_state = agent.start(policy_state, start_key)
        unfinished_B = np.ones(agent.batched.num_envs, bool)
        step = 0
        while unfinished_B.any():
            key, play_key = jax.random.split(key)
            rollout_state, _, log = agent.collect(policy_state, rollout_state, play_key)
            log = jax.device_get(log)
            earlier_TB = np.cumsum(log.ended_TB, axis=0) - log.ended_TB  # ends before each step
            ended_TB = log.ended_TB & (earlier_TB == 0) & unfinished_B
            ended, taken = episode_rows(log, agent.spec, ended_TB, step)
            rows += ended
            unfinished_B &= ~log.ended_TB.any(axis=0)
            step += taken
    return rows


def evaluate(folder: Path, episodes: int | None, reporter: Reporter) -> dict[str, Any]:
    """Plays whole episodes with the newest checkpoint of a run folder and appends them to `evaluations.csv`.

    Args:
      folder: a run folder.
      episodes: at least so many; None: `evaluation.episodes`.
      reporter: where progress goes.

    Returns:
      the task's scores over those episodes, plus "episodes" and "step" of the checkpoint.

    Raises:
      UserError: not a run folder, another schema, or no usable checkpoint.
    """
    with RunRecord.open(folder) as record:
        run = restore(record, reporter)
        episodes = episodes or record.config.evaluation.episodes
        return record_evaluation(record, run.agent, run.model.policy_state, run.step, episodes)


def record_evaluation(
    record: RunRecord, agent: Agent, policy_state: PolicyTrainState, step: int, episodes: int
) -> dict[str, Any]:
    """Plays whole episodes with the policy of `step`, records them, and returns their scores."""
    rows = play_episodes(agent, policy_state, evaluation_key(record.config.seed, step), episodes)
    record.append_evaluation({**row, "step": step} for row in rows)
    scores = registry.task(record.config.task).scores()(pd.DataFrame(rows), None, agent.spec)
    return {"step": step, "episodes": len(rows), **scores}
