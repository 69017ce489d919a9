"""Published results, the paper's and the literature's since: `published.csv`, one row per method and metric.

Nothing in it was measured here. The paper's tables are counted in the order of its LaTeX source, as in the catalogue:
1 Craftax-classic, 2 ablations, 3 Craftax (full), 4 MinAtar; the PDF captions the second and the fourth as figures.
"""

from __future__ import annotations

import contextlib
import csv
import math
from collections.abc import Collection, Mapping
from pathlib import Path

import pandas as pd

from leaderboards.scoring import LABELS
from suite import registry
from suite.runtime.errors import UserError, did_you_mean

PATH = Path(__file__).with_name("published.csv")
COLUMNS = (
    *("task", "method", "agent", "metric", "value", "error", "error_kind", "seeds", "steps", "observation"),
    *("environment", "environment_version", "hardware", "minutes", "parameters_millions", "source", "note"),
    "measured_here",
)
OF_FAMILY = "return_normalized_to_mfrl"  # a mean over games, MinAtar's: its task is their family
NUMBERS, COUNTS = ("value", "error", "minutes", "parameters_millions"), ("seeds", "steps")
REQUIRED = ("method", "value", "environment", "source")
UNIQUE = ("task", "method", "metric", "steps", "source")


def published(path: Path = PATH) -> pd.DataFrame:
    """Every row of the file; what a source does not say is "" in columns of text and missing in those of numbers.

    Raises:
      UserError: the first line that is wrong.
    """
    tasks, agents = registry.tasks(), registry.agents()
    words: dict[str, Collection[str]] = {
        "metric": (*LABELS, OF_FAMILY),
        "agent": {"", *agents},
        "error_kind": ("", "standard error", "standard deviation"),
        "observation": ("pixels", "symbolic"),
        "measured_here": ("false",),  # what was measured here has run records instead
    }
    rows, first = list[dict[str, str]](), dict[tuple[str, ...], int]()
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.reader(file)
        header = next(reader, [])
        if header != list(COLUMNS):
            differ = f"missing {sorted(set(COLUMNS) - set(header))}, extra {sorted(set(header) - set(COLUMNS))}"
            raise UserError(f"{path}, line 1: {differ}; right columns, in this order: {','.join(COLUMNS)}")
        for cells in reader:
            where = f"{path}, line {reader.line_num}"
            if len(cells) != len(COLUMNS):
                raise UserError(f"{where}: {len(cells)} cells; right: {len(COLUMNS)}, one for each column")
            row = dict(zip(COLUMNS, cells, strict=True))
            ids = {entry.family for entry in tasks.values()} if row["metric"] == OF_FAMILY else tasks
            if wrong := _wrong(row, {"task": ids, **words}):
                raise UserError(f"{where}: {wrong}")
            before = first.setdefault(tuple(row[name] for name in UNIQUE), reader.line_num)
            if before != reader.line_num:
                raise UserError(f"{where}: the same {', '.join(UNIQUE)} as in line {before}; right: one row of each")
            rows.append(row)
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    numbers = {name: pd.to_numeric(table[name]) for name in (*NUMBERS, *COUNTS)}
    types = dict.fromkeys(NUMBERS, "float64") | dict.fromkeys(COUNTS, "Int64")  # the latter may be missing
    return table.assign(**numbers, measured_here=False).astype(types)


def _wrong(row: Mapping[str, str], words: Mapping[str, Collection[str]]) -> str:
    """What is wrong with a row and what would be right, "" if nothing is."""
    for name, valid in words.items():
        if row[name] not in valid:
            return f"unknown {name} {row[name]!r}; {did_you_mean(row[name], filter(None, valid))}"
    for name in REQUIRED:
        if not row[name].strip():
            return f"{name} is empty; right: what the source says"
    for name in (*NUMBERS, *COUNTS):
        if row[name] and not _is_number(row[name], whole=name in COUNTS):
            return f"{name} is {row[name]!r}; right: {'a whole' if name in COUNTS else 'a finite'} number"
    return ""


def _is_number(text: str, whole: bool) -> bool:
    with contextlib.suppress(ValueError):
        return text.isdecimal() if whole else math.isfinite(float(text))
    return False
