"""Finished runs side by side: scores and learning curves over seeds, computed from their episodes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from suite import registry
from suite.errors import UserError, did_you_mean
from suite.record import RunRecord

Spread = tuple[float, float]  # mean and standard error; nan where there is none
COUNTS = frozenset({"episodes", "final_episodes"})


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Agents under one protocol and preset.

    Attributes:
      task, preset: of all runs.
      steps: real ones.
      seeds: by agent, how many.
      scores: by agent and score.
      minutes: by agent, wall-clock of a run.
      curve_of: the score that the curve is of.
      curve: by agent, that score over the episodes that end in each of the budget's equal parts.
    """

    task: str
    preset: str
    steps: int
    seeds: dict[str, int]
    scores: dict[str, dict[str, Spread]]
    minutes: dict[str, Spread]
    curve_of: str
    curve: dict[str, list[Spread]]


def records_in(folders: Sequence[Path]) -> list[RunRecord]:
    """Every finished run in these folders or below them.

    Raises:
      UserError: there is none, or one cannot be read.
    """
    paths = sorted({path.parent for folder in folders for path in folder.rglob("record.json")})
    records = [RunRecord.open(path, lock=False) for path in paths]
    finished = [record for record in records if record.finished]
    if not finished:
        begun = f"; {len(records)} unfinished" if records else ""
        raise UserError(f"no finished run in {', '.join(map(str, folders))}{begun}")
    return finished


def compare(records: Sequence[RunRecord], parts: int = 5, score: str | None = None) -> list[Comparison]:
    """What agents scored, one comparison for each protocol and preset: those of different ones mean nothing together.

    Args:
      records: of finished runs.
      parts: into how many equal parts of the budget the curves are cut.
      score: what curves are of; None: "return", or the task's first score where it has no such.

    Raises:
      UserError: a score that a task has not, or two runs of one seed that differ in their settings.
    """
    groups: dict[tuple[str, str], list[RunRecord]] = {}
    for record in records:
        groups.setdefault((record.fields["protocol_hash"], record.config.preset), []).append(record)
    return [_compare(group, parts, score) for group in groups.values()]


def _compare(records: list[RunRecord], parts: int, score: str | None) -> Comparison:
    config = records[0].config
    _require_one_run_a_seed(records)
    task = registry.task(config.task)
    scores_of, spec = task.scores(), task.spec()
    ids = list(registry.agents())
    by_agent: dict[str, list[RunRecord]] = {}
    for record in sorted(records, key=lambda r: (_place(ids, r.config.agent), r.config.agent, r.config.seed)):
        by_agent.setdefault(record.config.agent, []).append(record)
    found: dict[str, list[dict[str, float]]] = {}
    pieces: dict[str, list[list[dict[str, float]]]] = {}
    for agent, runs in by_agent.items():
        for record in runs:
            episodes = record.episodes()
            part = np.ceil(episodes["step"] * parts / config.protocol.steps).astype(int)  # 1 to `parts`
            found.setdefault(agent, []).append(scores_of(episodes, record.config, spec))
            pieces.setdefault(agent, []).append([scores_of(episodes[part == i + 1], None, spec) for i in range(parts)])
    names = [name for name in found[records[0].config.agent][0] if "/" not in name and name not in COUNTS]
    curve_of = score or ("return" if "return" in names else names[0])
    if curve_of not in names:
        raise UserError(f"{config.task} has no score {curve_of!r}; {did_you_mean(curve_of, names)}")
    return Comparison(
        task=config.task,
        preset=config.preset,
        steps=config.total_steps,
        seeds={agent: len(runs) for agent, runs in by_agent.items()},
        scores={agent: {name: spread(run[name] for run in runs) for name in names} for agent, runs in found.items()},
        minutes={agent: spread(record.wall_seconds / 60 for record in runs) for agent, runs in by_agent.items()},
        curve_of=curve_of,
        curve={
            agent: [spread(run[i][curve_of] for run in runs) for i in range(parts)] for agent, runs in pieces.items()
        },
    )


def _place(ids: list[str], agent: str) -> int:
    return ids.index(agent) if agent in ids else len(ids)


def _require_one_run_a_seed(records: list[RunRecord]) -> None:
    """Also that all seeds of an agent have the same settings."""
    seen: dict[tuple[str, int], Path] = {}
    settings: dict[str, tuple[str, Path]] = {}
    for record in records:
        config = record.config
        if (other := seen.setdefault((config.agent, config.seed), record.folder)) != record.folder:
            raise UserError(f"{other} and {record.folder} are both seed {config.seed} of {config.agent}: leave one out")
        digest = dataclasses.replace(config, seed=0).digest()
        before, folder = settings.setdefault(config.agent, (digest, record.folder))
        if digest != before:
            raise UserError(f"{folder} and {record.folder} are of {config.agent}, but with different settings")


def spread(values: Iterable[float]) -> Spread:
    """Mean and standard error over seeds; the error of one seed is nan."""
    array = np.array(list(values), float)
    error = array.std(ddof=1) / math.sqrt(len(array)) if len(array) > 1 else math.nan
    return float(array.mean()), float(error)


def tables(comparison: Comparison) -> list[pd.DataFrame]:
    """Scores, and the curve, as text: one row per agent, "mean +- standard error"."""
    scores, curve = [], []
    parts = len(next(iter(comparison.curve.values())))
    for agent, by_name in comparison.scores.items():
        named = {_label(name): _text(value) for name, value in by_name.items()}
        minutes = {"minutes": f"{comparison.minutes[agent][0]:.1f}"}
        scores.append({"agent": agent, "seeds": str(comparison.seeds[agent]), **named, **minutes})
        ends = [f"to {round((i + 1) * comparison.steps / parts):,}" for i in range(parts)]
        curve.append(
            {f"{_label(comparison.curve_of)}, steps": agent}
            | dict(zip(ends, map(_text, comparison.curve[agent]), strict=True))
        )
    return [pd.DataFrame(scores), pd.DataFrame(curve)]


def _label(name: str) -> str:
    return name.replace("_percent", " %").replace("_", " ")


def _text(value: Spread) -> str:
    mean, error = value
    if math.isnan(mean):
        return "n/a"
    digits = 2 if abs(mean) >= 1 else 3
    return f"{mean:.{digits}f}" + ("" if math.isnan(error) else f" +- {error:.{digits}f}")
