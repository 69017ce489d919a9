"""Writes the page: for each task a table, ours and published, and the figures that its runs give."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import markupsafe
import pandas as pd

from leaderboards.boards import IMPROVEMENT, OVERALL, as_csv, tables_digest
from leaderboards.families import families
from leaderboards.page import plots
from leaderboards.publish import PAGE
from leaderboards.published import OF_FAMILY
from leaderboards.qualification import overrides
from leaderboards.results import Entry
from leaderboards.scoring import main_score
from suite import registry
from suite.record import require_writable
from suite.tables import write_whole

HERE = Path(__file__).parent
PARTS = 20  # points of a learning curve
BARS = 4  # agents beside each other in a bar chart, at most
TITLES = {"craftax_classic": "Craftax-classic", "craftax_full": "Craftax (full)", "overall": "Families of games"}
LABELS = {
    "reward_percent": "Reward, % of the maximum",
    "reward_percent_with_health": "Reward with health, %",
    "score_percent": "Crafter score, %",
    "normalized_return": "Normalized return (1: best response)",
    OF_FAMILY: "Return, mfrl = 1",
    IMPROVEMENT: "P(better than mfrl)",
}
OVERALL_SUMMARY = (
    "Each game's scores on one scale (MinAtar: the mean return of mfrl under the same preset is 1; OpenSpiel: 0 is a "
    "uniform player and 1 the best response), then the mean over games, which weigh alike. Minutes are those of one "
    "run of every game. Published rows of single games stand with their games."
)


@dataclasses.dataclass(frozen=True)
class Cell:
    """Of a table: its text, what it sorts by ("" last), and small print."""

    text: str
    value: str | float = ""
    note: str = ""
    numeric: bool = False
    badge: str = ""


@dataclasses.dataclass(frozen=True)
class Column:
    """Of a table; numbers stand right, and sort from the best down."""

    label: str
    numeric: bool = False


def write_page(entries: Sequence[Entry], tables: Mapping[str, pd.DataFrame], folder: Path) -> Path:
    """Writes `folder/index.html`, which holds everything that it shows.

    Args:
      entries: for the figures.
      tables: what `leaderboards.boards` makes of them.
      folder: is made if it is not there.

    Raises:
      UserError: the folder cannot be written.
    """
    require_writable(folder)
    sections = [_section(name, table, entries) for name, table in tables.items() if len(table)]
    budgets = sorted({int(steps) for table in tables.values() for steps in table["steps"].dropna()})
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(HERE), autoescape=True, undefined=jinja2.StrictUndefined
    )
    html = environment.get_template("page.html.jinja").render(
        css=markupsafe.Markup((HERE / "page.css").read_text()),
        script=markupsafe.Markup((HERE / "page.js").read_text()),
        digest=tables_digest({name: as_csv(table) for name, table in tables.items()}),
        sections=sections,
        runs=sum(len(entry.records) for entry in entries),
        filters=[
            {"name": "observation", "label": "Sees", "options": [("pixels", "pixels"), ("symbolic", "symbols")]},
            {"name": "steps", "label": "Budget", "options": [(steps, f"{steps:,} steps") for steps in budgets]},
            {"name": "origin", "label": "From", "options": [("ours", "measured here"), ("theirs", "published")]},
        ],
    )
    write_whole(folder / PAGE, html.encode())
    return folder / PAGE


def _section(name: str, table: pd.DataFrame, entries: Sequence[Entry]) -> dict[str, Any]:
    id = name.removesuffix(".csv")
    overall = name == OVERALL
    task = "" if overall else str(table["task"].iloc[0])
    metrics = _shown(table["metric"])
    title = TITLES.get(id, task)
    return {
        "id": id,
        "title": title,
        "summary": OVERALL_SUMMARY if overall else registry.task(task).summary,
        "caption": f"{title}: headings sort; {name} has more columns.",
        "columns": _columns(metrics, overall),
        "rows": list(_rows(table, metrics, overall)),
        "figures": list(
            _family_figures(entries) if overall else _figures([e for e in entries if e.config.task == task], table)
        ),
    }


def _shown(metrics: pd.Series) -> list[str]:
    """Scores with a column of their own: each achievement's and each seat's stand in the CSV alone."""
    names = list(dict.fromkeys(metrics))
    names.sort(key=lambda name: name == IMPROVEMENT)
    return [name for name in names if "/" not in name and not name.startswith(("success_percent", "return_seat"))]


def _label(metric: str) -> str:
    return LABELS.get(metric, metric.replace("_percent", " %").replace("_", " ").capitalize())


def _columns(metrics: Sequence[str], overall: bool) -> list[Column]:
    words = ["Rank", "Method", *(["Family"] if overall else []), "From", "Preset"]
    numbers = [*map(_label, metrics), "Seeds", "Steps", "Minutes", "Parameters, M"]
    return [
        *(Column(word, numeric=word == "Rank") for word in words),
        *(Column(word, numeric=True) for word in numbers),
        *(Column(word) for word in ("Sees", "Game", "Hardware", "Source")),
    ]


def _rows(table: pd.DataFrame, metrics: Sequence[str], overall: bool) -> Iterator[dict[str, Any]]:
    """One for each method, its scores beside each other."""
    by = ["task", "preset", "protocol", "method", "overrides", "steps", "source"]
    for _, group in table.groupby(by, sort=False, dropna=False):
        scores = {row["metric"]: row for row in group.to_dict("records")}
        row = next(iter(scores.values()))
        ours = bool(row["measured_here"])
        remark = _text(row["note"]) if ours else ""
        method = Cell(row["method"], row["method"], "; ".join(filter(None, [_text(row["overrides"]), remark])))
        cells = [_number(row["rank"], "{:.0f}"), method]
        cells += [Cell(row["task"], row["task"])] if overall else []
        cells.append(Cell("measured" if ours else "published", badge="ours" if ours else "theirs"))
        cells.append(Cell(_text(row["preset"]), _text(row["preset"])))
        cells += [_score(scores.get(metric)) for metric in metrics]
        cells += [_number(row["seeds"], "{:.0f}"), _number(row["steps"], "{:,.0f}"), _number(row["minutes"], "{:,.4g}")]
        cells.append(_number(row["parameters_millions"], "{:g}"))
        game = f"{_text(row['environment'])} {_text(row['environment_version'])}".strip()
        words = {"pixels": "pixels", "symbolic": "symbols"}[row["observation"]], game, _text(row["hardware"])
        cells += [Cell(word, word) for word in words]
        where = row["evidence"] if ours else row["source"]
        cells.append(Cell(_text(where), _text(where), _text(row["note"])))
        yield {
            "origin": "ours" if ours else "theirs",
            "observation": row["observation"],
            "steps": "" if pd.isna(row["steps"]) else int(row["steps"]),
            "cells": cells,
        }


def _score(row: Mapping[Any, Any] | None) -> Cell:
    """Mean and error; beside them, the interval of the interquartile mean."""
    if row is None:
        return Cell("", numeric=True)
    text = _digits(row["value"])
    if not pd.isna(row["error"]):
        text += f" \N{PLUS-MINUS SIGN} {_digits(row['error'], row['value'])}"
    interval = "" if pd.isna(row["iqm_low"]) else f"[{_digits(row['iqm_low'])}, {_digits(row['iqm_high'])}]"
    return Cell(text, row["value"], interval, numeric=True)


def _digits(value: float, like: float | None = None) -> str:
    """Two decimals, three below 1: an error with as many as its value."""
    return f"{value:.{2 if abs(value if like is None else like) >= 1 else 3}f}"


def _number(value: Any, form: str) -> Cell:
    return Cell("", numeric=True) if pd.isna(value) else Cell(form.format(value), float(value), numeric=True)


def _text(value: Any) -> str:
    return "" if value is None or pd.isna(value) else str(value)


def _figures(entries: Sequence[Entry], table: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Of a task: one set for each preset and protocol that runs were made under."""
    groups: dict[tuple[str, str], list[Entry]] = {}
    for entry in entries:
        if not overrides(entry.config):
            groups.setdefault((entry.config.preset, entry.protocol_hash), []).append(entry)
    for (preset, _), group in groups.items():
        score = main_score(group[0].scores)
        label = _label(score).lower()
        steps = group[0].config.protocol.steps
        under = f"Preset {preset}, {steps:,} steps"
        yield _figure(
            plots.learning_curves(group, score, PARTS, label),
            f"{under}: {label} of the training episodes that end in each twentieth of the budget; mean over seeds, "
            "shaded its 95 % bootstrap interval.",
        )
        if group[0].spec.achievements:
            best = sorted(group, key=lambda entry: -entry.scores[score].mean())[:BARS]
            yield _figure(
                plots.achievement_bars(best),
                f"{under}: training episodes that unlocked each achievement, the {len(best)} best agents by {label}; "
                "achievements that none of them unlocked are left out.",
            )
        several = [entry for entry in group if len(entry.seeds) > 1]  # one run has no share of runs
        if several:
            profiles = {entry.config.agent: [entry.scores[score]] for entry in several}
            yield _figure(plots.performance_profiles(profiles, label), f"{under}: the share of runs above a {label}.")
    points = _points(table)
    if len(points) > 1:
        score = points[0][0]
        yield _figure(
            plots.time_against_score([point[1:] for point in points], _label(score).lower()),
            "What a run takes on its own hardware, measured here (filled) and published (hollow), and what it scores "
            "with its own budget.",
        )


def _points(table: pd.DataFrame) -> list[tuple[str, str, str, float, float]]:
    """(score, method, our agent's id or "", minutes, value) of the main score, where minutes are known."""
    score = main_score(table["metric"])
    timed = table[(table["metric"] == score) & table["minutes"].notna()].drop_duplicates(["method", "minutes"])
    return [
        (score, f"{row['method']} ({row['preset']})" if row["measured_here"] else row["method"],
         row["agent"] if row["measured_here"] else "", float(row["minutes"]), float(row["value"]))
        for row in timed.to_dict("records")
    ]  # fmt: skip


def _family_figures(entries: Sequence[Entry]) -> Iterator[dict[str, Any]]:
    """Performance profiles over all runs of all games of a family."""
    for group in families(entries):
        first = group[0]
        if len(first.entries) > 1:
            label = _label(first.metric).lower()
            profiles = {scores.agent: list(scores.values) for scores in group}
            yield _figure(
                plots.performance_profiles(profiles, label),
                f"{first.family}, preset {first.entries[0].config.preset}: the share of runs above a {label}; "
                f"mean over {len(first.entries)} games.",
            )


def _figure(svg: str, caption: str) -> dict[str, Any]:
    """Ids are unique on the page: every figure has those of its own."""
    prefix = hashlib.sha256(svg.encode()).hexdigest()[:8]
    for mark in ('id="', 'href="#', "url(#"):
        svg = svg.replace(mark, f"{mark}{prefix}-")
    return {"svg": markupsafe.Markup(svg), "caption": caption}
