"""Whole episodes of a checkpoint's policy under a task's protocol: sampled actions, no learning."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd

from suite import registry
from suite.agent.algorithm import evaluation_key
from suite.agent.phases import Agent
from suite.agent.rollout import EpisodeLog
from suite.agent.seeds import stacked, unstacked
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
    agent: Any, policy_state: PolicyTrainState | None, keys: Sequence[jax.Array | None], episodes: int
) -> list[list[dict[str, Any]]]:
    """At least `episodes` whole episodes: the first of each of N_env environments, as often as it takes.

    Taking each environment's first episode, however long, keeps short episodes from being over-counted. Rows have
    `step` counted from the start of the evaluation.

    Args:
      agent: of it only `start`, `collect`, `batched` and `spec` are used.
      policy_state: how it acts.
      keys: of the randomness of each run that `agent` is; None: no episodes of that one are asked for.
      episodes: of each run.

    Returns:
      for each run the rows of its episodes.
    """
    rows: list[list[dict[str, Any]]] = [[] for _ in keys]
    key_S = [jax.random.key(0) if key is None else key for key in keys]

    def advanced(which_S: Iterable[bool]) -> jax.Array:
        """Keys to play with; those of runs that do not play stay what they are."""
        pairs = [jax.random.split(key) for key in key_S]
        key_S[:] = [pair[0] if which else key for key, pair, which in zip(key_S, pairs, which_S, strict=True)]
        return stacked([pair[1] for pair in pairs])

    while any(short_S := [key is not None and len(done) < episodes for key, done in zip(keys, rows, strict=True)]):
        rollout_state = agent.start(policy_state, advanced(short_S))
        unfinished_SB = np.repeat(np.array(short_S)[:, None], agent.batched.num_envs, 1)
        step_S = [0] * len(keys)
        while unfinished_SB.any():
            rollout_state, _, log = agent.collect(
                policy_state, rollout_state, advanced([bool(own_B.any()) for own_B in unfinished_SB])
            )
            for i, own in enumerate(unstacked(jax.device_get(log), len(keys))):
                earlier_TB = np.cumsum(own.ended_TB, axis=0) - own.ended_TB  # ends before each step
                ended_TB = own.ended_TB & (earlier_TB == 0) & unfinished_SB[i]
                ended, taken = episode_rows(own, agent.spec, ended_TB, step_S[i])
                rows[i] += ended
                unfinished_SB[i] &= ~own.ended_TB.any(axis=0)
                step_S[i] += taken
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
    [rows] = play_episodes(agent, policy_state, [evaluation_key(record.config.seed, step)], episodes)
    record.append_evaluation({**row, "step": step} for row in rows)
    scores = registry.task(record.config.task).scores()(pd.DataFrame(rows), None, agent.spec)
    return {"step": step, "episodes": len(rows), **scores}
