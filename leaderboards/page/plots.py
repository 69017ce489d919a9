"""Figures of the page as SVG, drawn by matplotlib.

Colours are CSS variables (`--ink`, `--grid`, `--series-0` to `--series-7`), so that the page's style, light or dark, is
theirs. Agents are told apart by dashes and markers as well.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from leaderboards import statistics
from leaderboards.inspections import ERROR, SYMBOLS, InspectedRun
from leaderboards.page.svg import svg_of
from leaderboards.results import Entry
from suite import registry

INK, GRID = "#010203", "#030201"  # stand-ins that no figure has by itself
SERIES = tuple(f"#0a0b{i:02x}" for i in range(8))
VARIABLES = {INK: "var(--ink)", GRID: "var(--grid)"} | {color: f"var(--series-{i})" for i, color in enumerate(SERIES)}
STORY = ("mfrl", "m5", "m6", "oracle")  # what a learning curve shows first: without dreams, with them, with true ones
MOST = (*STORY, "random", "m1", "m2", "m3")  # each with a colour of its own
DASHES = ("-", (0, (5, 2)), (0, (1, 1.5)))
MARKERS = "osD^vPX*"
PARTS = (20, 10, 5, 2)  # points of a learning curve
WIDTH, HEIGHT = 5.6, 3.6  # inches of 72 points: text keeps its size on a phone
STYLE: Any = {
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "suite",  # the same figure is the same bytes
    "font.family": "sans-serif",
    "font.size": 11,
    "text.color": INK,
    "axes.edgecolor": GRID,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "legend.fontsize": 10,
}


@dataclasses.dataclass(frozen=True)
class Panel:
    """The learning curves of one game.

    Attributes:
      title: stands above it, "" for nothing.
      entries: agents that played under the same rules, each a curve.
      score: which one, by its name.
      label: what to call it.
      published: the best published score for the same budget, with its method's name, where there is one.
    """

    title: str
    entries: Sequence[Entry]
    score: str
    label: str
    published: tuple[str, float] | None = None


def learning_curves(panels: Sequence[Panel]) -> str:
    """A score against steps, game by game: mean over seeds, and its 95 % bootstrap interval where there are several.

    A point is over the episodes that end in a part of the budget: a twentieth, or more where games last so long that
    none of some run ends in one.
    """
    columns = min(2, len(panels))
    rows = math.ceil(len(panels) / columns)
    with _figure(rows * (HEIGHT if columns == 1 else HEIGHT * 0.72), rows, columns) as (figure, grid):
        for axes, panel in zip(grid, panels, strict=False):
            _learning_curve(axes, panel)
        for axes in grid[len(panels) :]:
            axes.set_axis_off()
        _legend(figure)
        what = ", ".join(dict.fromkeys(panel.label for panel in panels))
        return svg_of(figure, f"Learning curves: {what} against real environment steps", VARIABLES)


def _learning_curve(axes: Axes, panel: Panel) -> None:
    steps = panel.entries[0].config.protocol.steps
    for parts in PARTS:
        curves = [entry.curve(panel.score, parts) for entry in panel.entries]
        if not any(np.isnan(curve_PS).any() for curve_PS in curves):
            break
    at = (np.arange(parts) + 1) * steps / parts
    for entry, curve_PS in zip(panel.entries, curves, strict=True):
        mean_P, low_P, high_P = statistics.sample_efficiency_curve(curve_PS)
        color, dashes, _ = style_of(entry.config.agent)
        axes.plot(at, mean_P, color=color, linestyle=dashes, label=entry.config.agent)
        if len(entry.seeds) > 1:
            axes.fill_between(at, low_P, high_P, color=color, alpha=0.18, linewidth=0)
    if panel.published is not None:
        method, value = panel.published
        axes.axhline(value, color=INK, linewidth=0.8, linestyle=(0, (4, 3)), label=f"published: {method}")
    axes.set(xlabel="real environment steps", ylabel=panel.label, xlim=(0, steps), title=panel.title)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k")


def world_models(rows: Sequence[tuple[str, Sequence[InspectedRun]]]) -> str:
    """Rollouts beside reality: symbols right, where they are known, and the error of frames; a line for each agent.

    Args:
      rows: of panels: a title, "" for none, and runs that may be compared.
    """
    measures = [SYMBOLS, ERROR] if any(SYMBOLS in run.steps for _, runs in rows for run in runs) else [ERROR]
    with _figure(len(rows) * HEIGHT * 0.8, len(rows), len(measures)) as (figure, grid):
        for i, (title, runs) in enumerate(rows):
            for axes, measure in zip(grid[i * len(measures) :], measures, strict=False):
                if measure in runs[0].steps:
                    _rollouts(axes, runs, measure)
                else:
                    axes.set_axis_off()
            grid[i * len(measures)].set_title(title, loc="left", fontsize=10).set_in_layout(False)  # goes on
        _legend(figure, columns=4, last=("first frame repeated", "real frame"))
        return svg_of(figure, "World models beside reality: errors step by step", VARIABLES)


def _rollouts(axes: Axes, runs: Sequence[InspectedRun], measure: str) -> None:
    for agent in sorted({run.agent for run in runs}):  # m1 to m6
        table = pd.concat([run.steps[measure] for run in runs if run.agent == agent], axis=1)
        mean_T, low_T, high_T = statistics.sample_efficiency_curve(table.to_numpy())
        color, dashes, _ = style_of(agent)
        axes.plot(table.index, mean_T, color=color, linestyle=dashes, label=agent)
        if table.shape[1] > 1:
            axes.fill_between(table.index, low_T, high_T, color=color, alpha=0.18, linewidth=0)
    longest = max((run.steps for run in runs), key=len)
    bounds = {"first frame repeated": longest[f"repeated_{measure}"], "real frame": longest.get(f"real_{measure}", 0)}
    for (label, bound), dashes in zip(bounds.items(), ((0, (4, 3)), "-"), strict=True):
        axes.plot(longest.index, bound + 0 * longest[measure], color=INK, linewidth=0.8, linestyle=dashes, label=label)
    axes.set(xlabel="steps ahead", ylabel="symbols right, %" if measure == SYMBOLS else "squared error")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))


def achievement_bars(entries: Sequence[Entry]) -> str:
    """The percentage of training episodes that unlocked each achievement; those that nobody unlocked are left out."""
    names = [name for name in entries[0].spec.achievements if _success(entries, name).any()]
    names.sort(key=lambda name: _success(entries, name).max())
    with _figure(height=0.9 + len(names) * (0.13 + 0.075 * len(entries))) as (figure, (axes,)):
        thickness = 0.8 / len(entries)
        for i, entry in enumerate(entries):
            values = [entry.scores[f"success_percent/{name}"].mean() for name in names]
            at = np.arange(len(names)) + 0.4 - (i + 0.5) * thickness
            axes.barh(at, values, height=thickness, color=style_of(entry.config.agent)[0], label=entry.config.agent)
        axes.set_yticks(np.arange(len(names)), [name.replace("_", " ") for name in names])
        axes.set(xlabel="episodes that unlocked it, %", xlim=(0, 100), ylim=(-0.6, len(names) - 0.4))
        axes.grid(False, axis="y")
        _legend(figure)
        return svg_of(figure, "Bars: percentage of training episodes that unlocked each achievement", VARIABLES)


def performance_profiles(scores: Mapping[str, Sequence[np.ndarray]], label: str) -> str:
    """By agent, each task's seeds: the share of runs above each threshold (Agarwal et al. 2021)."""
    top = max(values.max() for tasks in scores.values() for values in tasks)
    thresholds = np.linspace(0, 1.05 * top, 101)
    with _figure() as (figure, (axes,)):
        for agent, tasks in scores.items():
            share = np.mean([statistics.performance_profile(values, thresholds) for values in tasks], axis=0)
            color, dashes, _ = style_of(agent)
            axes.plot(thresholds, share, color=color, linestyle=dashes, label=agent, drawstyle="steps-post")
        axes.set(xlabel=label, ylabel="share of runs above", ylim=(0, 1.03), xlim=(0, thresholds[-1]))
        _legend(figure)
        return svg_of(figure, f"Performance profiles: share of runs whose {label} is above a threshold", VARIABLES)


def time_against_score(points: Sequence[tuple[str, str, float, float]], label: str) -> str:
    """Each (method, agent id or "" if published, minutes, score): ours filled, published hollow."""
    points = sorted(points, key=lambda point: point[3])
    with _figure(height=max(HEIGHT, 0.9 + 0.19 * len(points))) as (figure, (axes,)):
        axes.set(xscale="log", xlabel="minutes of one run, wall-clock", ylabel=label)
        for _, agent, minutes, score in points:
            color, _, marker = style_of(agent) if agent else (INK, "-", "o")
            axes.plot(minutes, score, marker, color=color, fillstyle="full" if agent else "none", markersize=6)
        axes.margins(x=0.12, y=0.06)
        axes.xaxis.set_major_locator(LogLocator(numticks=5))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:,g}")
        low, high = axes.get_ylim()
        heights = [(score - low) / (high - low) for *_, score in points]
        for (method, _, minutes, score), height in zip(points, _apart(heights, 1 / (len(points) + 1)), strict=True):
            axes.annotate(
                f"{method[:32]}\N{HORIZONTAL ELLIPSIS}" if len(method) > 33 else method,
                (minutes, score),
                (1.03, height),
                textcoords="axes fraction",
                fontsize=9,
                verticalalignment="center",
                arrowprops={"arrowstyle": "-", "color": GRID, "linewidth": 0.6, "shrinkB": 4},
            )
        return svg_of(figure, f"Scatter: {label} against minutes of one run", VARIABLES)


def _apart(heights: Sequence[float], gap: float) -> list[float]:
    """Ascending heights from 0 to 1, moved as little as it takes to have them `gap` apart: upwards, then back down."""
    placed: list[float] = []
    for height in heights:
        placed.append(max(height, placed[-1] + gap) if placed else height)
    ceiling = 1.0
    for i in reversed(range(len(placed))):
        placed[i] = min(placed[i], ceiling)
        ceiling = placed[i] - gap
    return placed


@functools.cache
def style_of(agent: str) -> tuple[str, object, str]:
    """Colour, dashes and marker, the same in every figure."""
    ids = [*MOST, *(id for id in registry.agents() if id not in MOST)]
    i = ids.index(agent) if agent in ids else len(ids)
    return SERIES[i % len(SERIES)], DASHES[i % len(DASHES)], MARKERS[i % len(MARKERS)]


def _success(entries: Sequence[Entry], name: str) -> np.ndarray:
    return np.array([entry.scores[f"success_percent/{name}"].mean() for entry in entries])


@contextmanager
def _figure(height: float = HEIGHT, rows: int = 1, columns: int = 1) -> Iterator[tuple[Figure, list[Axes]]]:
    """A figure and its axes, row by row."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        FigureCanvasSVG(figure)
        yield figure, list(figure.subplots(rows, columns, squeeze=False).flat)


def _legend(figure: Figure, columns: int = 5, last: Sequence[str] = ()) -> None:
    """Each name once, whichever axes it is in; some of them after all others."""
    handles: dict[Any, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    handles |= {label: handles.pop(label) for label in last}
    figure.legend(
        handles=list(handles.values()),
        labels=list(handles),
        loc="outside upper left",
        ncols=columns,
        handlelength=1.6,
        columnspacing=1.0,
    )
