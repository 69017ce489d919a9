"""`suite verify --replay`: whether runs began as their records say.

Until its first iteration is over, nothing that a run has learned has acted. So its play there follows from its
configuration and seed alone, on every machine, and what it learned from that play does but for rounding. A record that
was copied from another seed, agent or game, or whose configuration was changed, begins otherwise.
"""

from __future__ import annotations

import concurrent.futures
import math
import multiprocessing
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from leaderboards.boards import Standing
from suite.agent.algorithm import iterate, iteration_key, start_key
from suite.configuration.schema import Config
from suite.records.record import RunRecord
from suite.runs.progress import IterationLog, told
from suite.runs.saved_model import agent_for
from suite.runs.training import PART_OF
from suite.runtime.reporting import QuietReporter, Reporter

PLAYED = ("reward_per_step", "episodes", "return")  # of metrics.csv: what play gave
DREAMT = "imagine/"  # dreams are not replayed
EXACT = 1e-5  # sums of float32 in another order
# What was learned: rounding, which tens and hundreds of updates in float32 amplify, by up to 8 % of a metric in one run
# of each row. A setting that changes less than this is not found.
LEARNED, NOTHING = 0.15, 1e-3
# How many codes a VQ-VAE of whole frames uses after its first iteration is chance: of m1's first run parameters that
# differ by 1e-7 of themselves give 33 instead of 12, and the world model's loss of these tokens is 1.9 instead of 1.3.
CHAOTIC = 0.75


def replay(
    standings: Sequence[Standing], runs: int | None, reporter: Reporter, jobs: int = 1
) -> Iterator[tuple[str, list[str]]]:
    """Runs the first iteration of published runs again.

    Args:
      standings: what is published.
      runs: how many of them, drawn anew each time; None: all.
      reporter: where progress goes.
      jobs: processes that do so side by side.

    Yields:
      where a run's evidence lies, and every difference, a line each; in any order, if there are several processes.
    """
    rows = [
        [(path.as_posix(), record.folder) for path, record in zip(standing.paths, standing.entry.records, strict=True)]
        for standing in standings
    ]
    number = sum(map(len, rows))
    if runs is not None and runs < number:
        drawn = iter(np.isin(np.arange(number), np.random.default_rng().choice(number, runs, replace=False)))
        rows = [[run for run in row if next(drawn)] for row in rows]
        number = runs
    for done, (path, found) in enumerate(_replayed(list(filter(None, rows)), jobs)):
        reporter.texture(f"Replayed {path}", (done + 1) / number)
        yield path, found


Runs = list[tuple[str, Path]]  # where the evidence lies relative to the leaderboards, and its folder


def _replayed(rows: list[Runs], jobs: int) -> Iterator[tuple[str, list[str]]]:
    """Paths and differences, as they are found. The runs of a row share an agent, which is built and compiled once."""
    if jobs == 1:
        for row in rows:
            yield from _row(row)
        return
    with concurrent.futures.ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        try:
            for future in concurrent.futures.as_completed([pool.submit(_listed, row) for row in rows]):
                yield from future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _listed(row: Runs) -> list[tuple[str, list[str]]]:
    return list(_row(row))


def _row(row: Runs) -> Iterator[tuple[str, list[str]]]:
    for path, folder in row:
        record = RunRecord.open(folder, lock=False)
        yield path, differences(record, first_iteration(record.config))


def first_iteration(config: Config) -> IterationLog:
    """What a run's first iteration gives, but for dreams."""
    agent = agent_for(config, QuietReporter())
    log = IterationLog(agent.spec, 0)

    def call(phase: str, function: Any, *arguments: Any) -> Any:
        result = function(*arguments)
        if phase not in PART_OF:
            log.add(phase, *told(phase, result))
        return result

    # Dreams come last, cost most to compile, and are of what was learned before them.
    iterate(agent, agent.init(start_key(config.seed)), iteration_key(config.seed, 0), 0, call, lambda *_: 0)
    return log


def differences(record: RunRecord, log: IterationLog) -> list[str]:
    """What a record says otherwise of its first iteration than a replay."""
    episodes, metrics = record.episodes(), record.table("metrics")
    first, row = metrics.iloc[0].to_dict(), log.row()
    if first["step"] != log.steps:
        return [f"its first iteration took {int(first['step']):,} steps, replayed {log.steps:,}"]
    problems = _episodes(episodes[episodes["step"] <= log.steps], pd.DataFrame(log.rows, columns=list(episodes)))
    for name, value in row.items():
        if name == "step":
            continue
        if name not in metrics:
            problems.append(f"metrics.csv lacks {name}")
        elif not _alike(name, first[name], value, record.config.tokenizer.kind == "vq_vae"):
            problems.append(f"{name} is {first[name]:.6g}, replayed {math.nan if value is None else value:.6g}")
    others = [name for name in map(str, metrics) if name not in row and not name.startswith(DREAMT)]
    more = [name for name in others if not pd.isna(first[name])]
    return [*problems, *(f"metrics.csv has {name}, which is not this agent's" for name in more)]


def _episodes(recorded: pd.DataFrame, replayed: pd.DataFrame) -> list[str]:
    """What the first iteration's episodes are otherwise."""
    if len(recorded) != len(replayed):
        return [f"{len(recorded)} episodes ended in its first iteration, replayed {len(replayed)}"]
    for name in recorded:
        a, b = recorded[name].to_numpy(float), replayed[name].to_numpy(float)
        if not np.allclose(a, b, rtol=EXACT, atol=EXACT):
            row = int(np.flatnonzero(~np.isclose(a, b, rtol=EXACT, atol=EXACT))[0])
            return [f"episodes.csv line {row + 2}: {name} is {a[row]:g}, replayed {b[row]:g}"]
    return []


def _alike(name: str, recorded: float, value: float | None, chaotic: bool) -> bool:
    """Whether a metric is what it was, as far as rounding allows."""
    if value is None or pd.isna(recorded):
        return value is None and pd.isna(recorded)
    if name in PLAYED:
        return math.isclose(recorded, value, rel_tol=EXACT, abs_tol=EXACT)
    tolerance = CHAOTIC if chaotic and name.startswith(("tokenizer/", "world_model/")) else LEARNED
    return math.isclose(recorded, value, rel_tol=tolerance, abs_tol=NOTHING)
