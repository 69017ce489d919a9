"""Writes the page: for each task a table, ours and published, and the figures that its runs give."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import markupsafe
import pandas as pd

from leaderboards.boards import IMPROVEMENT, OVERALL
from leaderboards.families import families
from leaderboards.inspections import Inspection
from leaderboards.page import plots, world_models
from leaderboards.page.figures import PageFigure, facts_of, write_once
from leaderboards.publish import PAGE
from leaderboards.published import OF_FAMILY
from leaderboards.qualification import overrides
from leaderboards.results import Entry
from leaderboards.scoring import DETAILS, LABELS, main_score
from suite import registry
from suite.interface.scores import ScoreName
from suite.records.record import require_writable
from suite.records.tables import write_whole

HERE = Path(__file__).parent
BARS = 4  # agents beside each other in a bar chart, at most
PROFILE_RUNS = 10  # of an agent: the profile of fewer is a stair
OVERALL_TITLE = "Families of games"
ABOVE = LABELS | {OF_FAMILY: "Return, mfrl = 1", IMPROVEMENT: "P(better than mfrl)"}  # what stands above a score
OVERALL_SUMMARY = (
    "Each game's scores on one scale (MinAtar: the mean return of mfrl under the same preset is 1; OpenSpiel: 0 is a "
    "uniform player and 1 the best response), then the mean over games, which weigh alike. Minutes are those of one "
    "run of every game. Published rows of single games stand with their games."
)


@dataclasses.dataclass(frozen=True)
class Cell:
    """Of a table.

    Attributes:
      text: what it shows.
      value: what it sorts by; "" stands last.
      error: behind the text, in a line of its own where there is little room.
      note: small print.
      folded: what is shown when asked for, with the words to ask by.
      badge: whether there is a frame around the text, of the row's colour.
    """

    text: str
    value: str | float = ""
    error: str = ""
    note: str = ""
    folded: tuple[str, str] | None = None
    badge: bool = False

    @property
    def key(self) -> str:
        """What the page's script sorts by, where that is not what the text begins with."""
        if isinstance(self.value, str):
            return "" if self.value == self.text else self.value
        key = f"{self.value:.6g}"
        return "" if float(self.text.replace(",", "")) == float(key) else key


@dataclasses.dataclass(frozen=True)
class Column:
    """Of a table; numbers stand right, and sort from the best down. A minor one is left out on a phone.

    What cells look like, page.css says by the place of their column: the last six are the same in all tables.
    """

    label: str
    numeric: bool = False
    minor: bool = False


def write_page(
    entries: Sequence[Entry],
    tables: Mapping[str, pd.DataFrame],
    folder: Path,
    inspections: Sequence[Inspection] = (),
) -> Path:
    """Writes `folder/index.html`, which holds everything that it shows.

    Args:
      entries, tables, inspections: as for `page`.
      folder: is made if it is not there.

    Raises:
      UserError: the folder cannot be written.
    """
    require_writable(folder, "--page")
    write_whole(folder / PAGE, page(entries, tables, inspections))
    return folder / PAGE


def page(entries: Sequence[Entry], tables: Mapping[str, pd.DataFrame], inspections: Sequence[Inspection] = ()) -> bytes:
    """The page, always the same bytes for the same runs.

    Args:
      entries: for the figures.
      tables: what `leaderboards.boards` makes of them.
      inspections: of world models, for the sections of their tasks.
    """
    everything = pd.concat([table for table in tables.values() if len(table)], ignore_index=True)
    sections = [_section(name, table, entries, everything, inspections) for name, table in tables.items() if len(table)]
    write_once(figure for section in sections for figure in (*section["lead"], *section["more"]))
    budgets = sorted({int(steps) for table in tables.values() for steps in table["steps"].dropna()})
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(HERE), autoescape=True, undefined=jinja2.StrictUndefined
    )
    html = environment.get_template("page.html.jinja").render(
        css=markupsafe.Markup((HERE / "page.css").read_text()),
        script=markupsafe.Markup((HERE / "page.js").read_text()),
        sections=sections,
        runs=sum(len(entry.records) for entry in entries),
        filters=[
            {"name": "observation", "label": "Sees", "options": [("pixels", "pixels"), ("symbolic", "symbols")]},
            {"name": "steps", "label": "Budget", "options": [(steps, f"{steps:,} steps") for steps in budgets]},
            {"name": "origin", "label": "From", "options": [("ours", "measured here"), ("theirs", "published")]},
        ],
    )
    return _classes_for_styles(html).encode()


def _classes_for_styles(html: str) -> str:
    """Gives each way in which figures draw, some dozens in thousands of places, a class in place of its own words."""
    classes: dict[str, str] = {}

    def named(match: re.Match[str]) -> str:
        return f' class="{classes.setdefault(match[1], f"f{len(classes)}")}"'

    html = re.sub(r' style="([^"]*)"', named, html)
    rules = "".join(f".{name} {{ {style} }}\n" for style, name in classes.items())
    return html.replace("</style>", f"{rules}</style>", 1)


def _section(
    name: str,
    table: pd.DataFrame,
    entries: Sequence[Entry],
    everything: pd.DataFrame,
    inspections: Sequence[Inspection],
) -> dict[str, Any]:
    """`everything`: all tables' rows, as a family's picture shows what was published of its games."""
    id = name.removesuffix(".csv")
    overall = name == OVERALL
    task = "" if overall else str(table["task"].iloc[0])
    title = OVERALL_TITLE if overall else registry.task(task).title
    own = entries if overall else [entry for entry in entries if entry.config.task == task]
    inspected = [] if overall else [found for found in inspections if found.task == task]
    parts = list(table.groupby("task", sort=False)) if overall else [("", table)]
    metrics = [] if overall else _shown(table["metric"])
    return {
        "id": id,
        "title": title,
        "summary": OVERALL_SUMMARY if overall else registry.task(task).summary,
        "caption": f"{title}: headings sort; {name} has more columns.",
        "columns": _columns(["Score", ABOVE[IMPROVEMENT]] if overall else list(map(_label, metrics))),
        "groups": [
            {"title": _heading(str(family), part), "rows": list(_rows(part, metrics or _shown(part["metric"], pad=2)))}
            for family, part in parts
        ],
        "lead": list(_stories(own, everything)),
        "models": list(world_models.figures(inspected)),
        "reading": world_models.reading(inspected),
        "inspected": " ".join(found.sha256 for found in inspected),
        "more": list(_family_figures(entries) if overall else _figures(own, table)),
    }


def _shown(metrics: pd.Series, pad: int = 0) -> list[str]:
    """Scores with a column of their own, at least `pad`: each achievement's and each seat's stand in the CSV alone."""
    names = list(dict.fromkeys(metrics))
    names.sort(key=lambda name: name == IMPROVEMENT)
    names = [name for name in names if not ScoreName(name).is_of_part and name not in DETAILS]
    return names + [""] * (pad - len(names))


def _heading(family: str, part: pd.DataFrame) -> str:
    """What a family's games are scored by, above its rows."""
    if not family:
        return ""
    label = _label(_shown(part["metric"])[0])
    return f"{registry.family(family).title}: {label[0].lower()}{label[1:]}"


def _label(metric: str) -> str:
    return ABOVE.get(metric, ScoreName(metric).heading.capitalize())


def _columns(scores: Sequence[str]) -> list[Column]:
    return [
        Column("Rank", numeric=True),
        Column("Method"),
        *(Column(score, numeric=True) for score in scores),
        *(Column(word, minor=True) for word in ("From", "Preset")),
        *(Column(word, numeric=True, minor=True) for word in ("Seeds", "Steps", "Minutes")),
        Column("Source", minor=True),
    ]


def _rows(table: pd.DataFrame, metrics: Sequence[str]) -> Iterator[dict[str, Any]]:
    """One for each method, its scores beside each other."""
    by = ["task", "preset", "protocol", "method", "overrides", "steps", "source"]
    for _, group in table.groupby(by, sort=False, dropna=False):
        scores = {row["metric"]: row for row in group.to_dict("records")}
        row = next(iter(scores.values()))
        ours = bool(row["measured_here"])
        differs = _text(row["overrides"])
        method = Cell(
            row["method"],
            row["method"],
            note=_text(row["note"]) if ours else "",
            folded=("other settings", differs) if differs else None,
        )
        cells = [_number(row["rank"], "{:.0f}"), method, *(_score(scores.get(metric)) for metric in metrics)]
        origin = "measured" if ours else "published"
        lesser = [Cell(origin, origin, badge=True)]
        lesser.append(Cell(_text(row["preset"]), _text(row["preset"])))
        which = f"which: {row['seed_list']}" if ours and row["seed_list"] else ""
        lesser.append(dataclasses.replace(_number(row["seeds"], "{:.0f}"), note=which))
        lesser += [_number(row["steps"], "{:,.0f}"), _number(row["minutes"], "{:,.4g}")]
        where = _text(row["evidence"] if ours else row["source"])
        lesser.append(Cell(where, where, folded=("more", _circumstances(row))))
        yield {
            "origin": "ours" if ours else "theirs",
            "observation": row["observation"],
            "steps": "" if pd.isna(row["steps"]) else int(row["steps"]),
            "cells": cells + lesser,
        }


def _circumstances(row: Mapping[Any, Any]) -> str:
    """What else is known of a row: the game and what the agent sees of it, its size, hardware, the source's remark."""
    game = f"{_text(row['environment'])} {_text(row['environment_version'])}".strip()
    sees = {"pixels": "pixels", "symbolic": "symbols"}[row["observation"]]
    size = "" if pd.isna(row["parameters_millions"]) else f"{row['parameters_millions']:g} million parameters"
    return "; ".join(filter(None, [f"sees {sees}", game, size, _text(row["hardware"]), _text(row["note"])]))


def _score(row: Mapping[Any, Any] | None) -> Cell:
    """Mean and error; below them, the interval of the interquartile mean."""
    if row is None:
        return Cell("")
    known = not pd.isna(row["error"])
    error = f"\N{PLUS-MINUS SIGN}\N{NO-BREAK SPACE}{_digits(row['error'], row['value'])}" if known else ""
    interval = "" if pd.isna(row["iqm_low"]) else f"[{_digits(row['iqm_low'])}, {_digits(row['iqm_high'])}]"
    return Cell(_digits(row["value"]), row["value"], error, interval)


def _digits(value: float, like: float | None = None) -> str:
    """Two decimals, three below 1: an error with as many as its value."""
    return f"{value:.{2 if abs(value if like is None else like) >= 1 else 3}f}"


def _number(value: Any, form: str) -> Cell:
    return Cell("") if pd.isna(value) else Cell(form.format(value), float(value))


def _text(value: Any) -> str:
    return "" if value is None or pd.isna(value) else str(value)


def _groups(entries: Sequence[Entry]) -> dict[tuple[str, str, str], list[Entry]]:
    """Runs that a figure may compare, by task, preset and rules: without overrides."""
    groups: dict[tuple[str, str, str], list[Entry]] = {}
    for entry in entries:
        if not overrides(entry.config):
            groups.setdefault((entry.config.task, entry.config.preset, entry.protocol_hash), []).append(entry)
    return groups


def _stories(entries: Sequence[Entry], table: pd.DataFrame) -> Iterator[PageFigure]:
    """The figure that comes first, one for each family and preset: do agents learn faster with dreams?"""
    games_of: dict[tuple[str, str], dict[str, list[Entry]]] = {}
    for (task, preset, _), group in _groups(entries).items():
        told = [entry for entry in group if entry.config.agent in plots.STORY]
        games = games_of.setdefault((registry.task(task).family, preset), {})
        if len(told) > 1 and _runs(told) > _runs(games.get(task, [])):
            games[task] = told
    for (family, preset), games in games_of.items():
        if games:
            order = [game for game in (*registry.family(family).games, *games) if game in games]
            panels = [panel_of(games[game], table, game if len(games) > 1 else "") for game in dict.fromkeys(order)]
            first = panels[0].entries[0]
            title = registry.family(family).title
            yield _figure(
                plots.learning_curves(panels),
                f"{title}, preset {preset}: {panels[0].label}, of training episodes by when they ended; mean over "
                "seeds, shaded its 95 % bootstrap interval. mfrl learns from real play alone, m5 and m6 also from a "
                "learned world model, the oracle from the true game.",
                first,
            )


def _runs(entries: Sequence[Entry]) -> int:
    return sum(len(entry.seeds) for entry in entries)


def panel_of(entries: Sequence[Entry], table: pd.DataFrame, title: str) -> plots.Panel:
    """Of one game; with the best published score for the same budget."""
    score, steps = entries[0].main_score, entries[0].config.protocol.steps
    theirs = table[
        (table["task"] == entries[0].config.task)
        & (table["metric"] == score)
        & (table["steps"] == steps)
        & ~table["measured_here"].astype(bool)
    ]
    best = max(zip(theirs["value"], theirs["method"], strict=True), default=None)
    published = None if best is None else (str(best[1]), float(best[0]))
    return plots.Panel(title, entries, score, _label(score).lower(), published)


def _figures(entries: Sequence[Entry], table: pd.DataFrame) -> Iterator[PageFigure]:
    """Of a task, the rest: one set for each preset and protocol that runs were made under."""
    for (_, preset, _), group in _groups(entries).items():
        panel = panel_of(group, table, "")
        score, label = panel.score, panel.label
        under = f"Preset {preset}, {group[0].config.protocol.steps:,} steps"
        if any(entry.config.agent not in (*plots.STORY, "random") for entry in group):
            yield _figure(
                plots.learning_curves([panel]), f"{under}: all agents, as in the figure above the table.", group[0]
            )
        if group[0].spec.achievements:
            best = sorted(group, key=lambda entry: -entry.scores[score].mean())[:BARS]
            yield _figure(
                plots.achievement_bars(best),
                f"{under}: training episodes that unlocked each achievement, the {len(best)} best agents by {label}; "
                "achievements that none of them unlocked are left out.",
                group[0],
            )
        several = [entry for entry in group if len(entry.seeds) >= PROFILE_RUNS]
        if several:
            profiles = {entry.config.agent: [entry.scores[score]] for entry in several}
            caption = f"{under}: the share of runs above a {label}."
            yield _figure(plots.performance_profiles(profiles, label), caption, group[0])
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


def _family_figures(entries: Sequence[Entry]) -> Iterator[PageFigure]:
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
                first.entries[0],
            )


def _figure(svg: str, caption: str, of: Entry | None = None) -> PageFigure:
    """`of`: whose task and budget it belongs to."""
    return PageFigure(svg, caption, {} if of is None else facts_of(of.spec, of.config.protocol.steps))
