"""Finished runs side by side: scores and learning curves over seeds, computed from their episodes."""

from __future__ import annotations

import dataclasses
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from leaderboards.results import Entry, entries_of
from leaderboards.scoring import main_score
from leaderboards.statistics import mean_and_standard_error
from suite.interface.scores import ScoreName
from suite.records.record import RunRecord
from suite.records.tables import write_whole
from suite.runtime.errors import UserError, did_you_mean

Estimate = tuple[float, float]  # mean and standard error; nan where there is none


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
    scores: dict[str, dict[str, Estimate]]
    minutes: dict[str, Estimate]
    curve_of: str
    curve: dict[str, list[Estimate]]


def compare(records: Sequence[RunRecord], parts: int = 5, score: str | None = None) -> list[Comparison]:
    """What agents scored, one comparison for each protocol and preset: those of different ones mean nothing together.

    Args:
      records: of finished runs.
      parts: into how many equal parts of the budget the curves are cut.
      score: what curves are of; None: "return", or the task's first score where it has no such.

    Raises:
      UserError: a score that a task has not, or two runs of one seed that differ in their settings.
    """
    groups: dict[tuple[str, str], list[Entry]] = {}
    for entry in entries_of(records):
        key = (entry.protocol_hash, entry.config.preset)
        groups.setdefault(key, []).append(entry)
    return [_compare(group, parts, score) for group in groups.values()]


def _compare(entries: list[Entry], parts: int, score: str | None) -> Comparison:
    config = entries[0].config
    _require_one_run_a_seed(entries)
    names = [name for name in entries[0].scores if not ScoreName(name).is_of_part]
    curve_of = score or main_score(names)
    if curve_of not in names:
        raise UserError(f"{config.task} has no score {curve_of!r}; {did_you_mean(curve_of, names)}")
    by_agent = {entry.config.agent: entry for entry in entries}
    estimate = mean_and_standard_error
    return Comparison(
        task=config.task,
        preset=config.preset,
        steps=config.total_steps,
        seeds={agent: len(entry.seeds) for agent, entry in by_agent.items()},
        scores={agent: {name: estimate(entry.scores[name]) for name in names} for agent, entry in by_agent.items()},
        minutes={agent: estimate(entry.minutes) for agent, entry in by_agent.items()},
        curve_of=curve_of,
        curve={agent: [estimate(part) for part in entry.curve(curve_of, parts)] for agent, entry in by_agent.items()},
    )


def _require_one_run_a_seed(entries: list[Entry]) -> None:
    """Also that all seeds of an agent have the same settings."""
    first: dict[str, Entry] = {}
    for entry in entries:
        agent, folders = entry.config.agent, [record.folder for record in entry.records]
        if (other := first.setdefault(agent, entry)) is not entry:
            raise UserError(f"{folders[0]} and {other.records[0].folder} are of {agent}, but with different settings")
        for i, seed in enumerate(entry.seeds[1:], 1):
            if seed == entry.seeds[i - 1]:
                raise UserError(f"{folders[i - 1]} and {folders[i]} are both seed {seed} of {agent}: leave one out")


def tables(comparison: Comparison) -> list[pd.DataFrame]:
    """Scores, and the curve, as text: one row per agent, "mean +- standard error"."""
    scores, curve = [], []
    parts = len(next(iter(comparison.curve.values())))
    for agent, by_name in comparison.scores.items():
        named = {ScoreName(name).heading: _text(value) for name, value in by_name.items()}
        minutes = {"minutes": f"{comparison.minutes[agent][0]:.1f}"}
        scores.append({"agent": agent, "seeds": str(comparison.seeds[agent]), **named, **minutes})
        ends = [f"to {round((i + 1) * comparison.steps / parts):,}" for i in range(parts)]
        curve.append(
            {f"{ScoreName(comparison.curve_of).heading}, steps": agent}
            | dict(zip(ends, map(_text, comparison.curve[agent]), strict=True))
        )
    return [pd.DataFrame(scores), pd.DataFrame(curve)]


def require_plot(path: Path) -> None:
    """Raises a UserError if no plot can be written there."""
    from matplotlib.backend_bases import FigureCanvasBase

    kinds = sorted(FigureCanvasBase.get_supported_filetypes())
    if path.suffix[1:].lower() not in kinds:
        raise UserError(f"cannot draw {path}: its name must end in one of {', '.join(f'.{kind}' for kind in kinds)}")
    if not path.parent.is_dir():
        raise UserError(f"cannot write {path}: {path.parent} is no folder")


def plot(path: Path, comparisons: Sequence[Comparison]) -> None:
    """Draws the curves: mean over seeds, and around it a band of one standard error where there are several.

    Args:
      path: of the picture, whose ending says its kind; see `require_plot`.
      comparisons: each a panel.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4 * len(comparisons)), layout="constrained")
    panels = figure.subplots(len(comparisons), squeeze=False)[:, 0]
    for axes, comparison in zip(panels, comparisons, strict=True):
        for agent, curve in comparison.curve.items():
            steps_P = (np.arange(len(curve)) + 1) * comparison.steps / len(curve)
            mean_P, error_P = np.array(curve).T
            (line,) = axes.plot(steps_P, mean_P, label=f"{agent} ({comparison.seeds[agent]})")
            axes.fill_between(steps_P, mean_P - error_P, mean_P + error_P, color=line.get_color(), alpha=0.2, lw=0)
        axes.set_title(f"{comparison.task}, preset {comparison.preset}")
        axes.set_xlabel("real environment steps")
        axes.set_ylabel(ScoreName(comparison.curve_of).heading)
        axes.set_xlim(0, comparison.steps)
        axes.grid(alpha=0.3)
        axes.legend(title="agent (seeds)", frameon=False)
    content = io.BytesIO()
    figure.savefig(content, format=path.suffix[1:].lower(), dpi=150)
    write_whole(path, content.getvalue())


def _text(value: Estimate) -> str:
    mean, error = value
    if math.isnan(mean):
        return "n/a"
    digits = 2 if abs(mean) >= 1 else 3
    return f"{mean:.{digits}f}" + ("" if math.isnan(error) else f" +- {error:.{digits}f}")
