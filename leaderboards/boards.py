"""Leaderboards as tables: one for each task, and one over all games of a family."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from leaderboards import statistics
from leaderboards.families import BASELINE, FamilyScores, families
from leaderboards.published import OF_FAMILY, published
from leaderboards.qualification import evidence_files, overrides
from leaderboards.results import Entry
from suite import registry
from suite.interface.environment import EnvironmentSpec
from suite.records.fields import DeviceFields, RecordFields

COLUMNS = (
    "task",
    "preset",  # "" for what others published
    # Within the same preset and protocol; none where fields differ from the preset, others measured, or the agent
    # learns from the simulator.
    "rank",
    "method",
    "agent",
    "overrides",
    "metric",
    "value",  # mean over seeds
    "error",
    "error_kind",
    "iqm",  # interquartile mean over seeds
    "iqm_low",  # its 95 % bootstrap interval
    "iqm_high",
    "seeds",  # how many
    "seed_list",  # which: "0-4", or "0-2 5"; over games those that all have in common
    "steps",
    "observation",
    "environment",
    "environment_version",
    "protocol",
    "hardware",
    "minutes",  # wall-clock of one run, the mean over seeds
    "parameters_millions",
    "packages",
    "git_commit",
    "measured_here",
    "source",
    "note",
    "evidence",  # folders below that of the leaderboards
    "evidence_sha256",
)
OVERALL = "overall.csv"
SOURCE = "this suite"
USES_SIMULATOR = "uses the simulator: a bound, not ranked"
IMPROVEMENT = f"probability_of_improvement_over_{BASELINE}"

Rows = list[dict[str, Any]]


@dataclasses.dataclass(frozen=True)
class Standing:
    """An entry and where its runs' evidence lies, relative to the folder of the leaderboards, one path a seed."""

    entry: Entry
    paths: tuple[Path, ...]


def boards(standings: Sequence[Standing]) -> dict[str, pd.DataFrame]:
    """Every leaderboard by its file's name: our rows, best first, then the published ones in their sources' order."""
    literature = published()
    by_task: dict[str, Rows] = {}
    for standing in standings:
        by_task.setdefault(standing.entry.config.task, []).extend(_rows(standing))
    groups = families([standing.entry for standing in standings])
    overall = pd.DataFrame([row for group in groups for row in _family_rows(group)], columns=list(COLUMNS))
    of_families = literature["metric"] == OF_FAMILY
    tables = {OVERALL: _ordered(overall, literature[of_families])}
    for task in sorted({*by_task, *literature["task"][~of_families]}):
        ours = pd.DataFrame(by_task.get(task, []), columns=list(COLUMNS))
        tables[file_name(task)] = _ordered(ours, literature[~of_families & (literature["task"] == task)])
    return tables


def file_name(task: str) -> str:
    """`minatar/breakout` as "minatar_breakout.csv"."""
    return f"{task.replace('/', '_')}.csv"


def ranges(numbers: Iterable[int]) -> str:
    """Whole numbers in order, what follows each other as a range: {0, 1, 2, 5} as "0-2 5"."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return " ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


def as_csv(board: pd.DataFrame) -> bytes:
    """Numbers with eight digits: what differs between machines' ways of adding up is far below."""
    return board.map(_cell).astype(str).to_csv(index=False, lineterminator="\n").encode()


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if pd.isna(value):
        return ""
    return f"{value:.8g}" if isinstance(value, float) else str(value)


def _rows(standing: Standing) -> Rows:
    """One for each score of an entry."""
    entry, record = standing.entry, standing.entry.records[0]
    rules = record.fields.protocol
    digest = hashlib.sha256()
    for member in entry.records:
        for name, content in evidence_files(member.folder).items():
            digest.update(f"{member.config.seed}/{name} {len(content)}\n".encode() + content)
    common = {
        "task": entry.config.task,
        "preset": entry.config.preset,
        "method": entry.config.agent,
        "agent": entry.config.agent,
        "overrides": " ".join(overrides(entry.config)),
        "error_kind": "standard error",
        "seeds": len(entry.seeds),
        "seed_list": ranges(entry.seeds),
        "steps": rules.steps,
        "observation": sees(entry.spec),
        "environment": rules.package,
        "environment_version": rules.package_version,
        "protocol": entry.protocol_hash,
        "hardware": _each(_device(member.fields.device) for member in entry.records),
        "minutes": float(entry.minutes.mean()),
        "packages": _each(_packages(member.fields) for member in entry.records),
        "git_commit": _each(str(member.fields.git_commit) for member in entry.records),
        "measured_here": True,
        "source": SOURCE,
        "note": _note(entry.config.agent),
        "evidence": _each(str(path.parent) for path in standing.paths),
        "evidence_sha256": digest.hexdigest(),
    }
    return [common | {"metric": name} | _estimates([values]) for name, values in entry.scores.items()]


def _family_rows(group: Sequence[FamilyScores]) -> Rows:
    """Two for each agent over all games of a family: its score, and how probably it beats the baseline."""
    baseline = next((scores for scores in group if scores.agent == BASELINE), None)
    rows: Rows = []
    for scores in group:
        first = scores.entries[0]
        rules = first.records[0].fields.protocol
        common = {
            "task": scores.family,
            "preset": first.config.preset,
            "method": scores.agent,
            "agent": scores.agent,
            "overrides": "",
            "seeds": min(len(entry.seeds) for entry in scores.entries),
            "seed_list": ranges(set.intersection(*(set(entry.seeds) for entry in scores.entries))),
            "steps": rules.steps,
            "observation": sees(first.spec),
            "environment": rules.package,
            "environment_version": rules.package_version,
            "minutes": float(sum(entry.minutes.mean() for entry in scores.entries)),
            "measured_here": True,
            "source": SOURCE,
            "note": _note(scores.agent),
            "evidence": _each(file_name(entry.config.task) for entry in scores.entries),
        }
        kind = {"metric": scores.metric, "error_kind": "standard error"}
        rows.append(common | kind | _estimates(scores.values))
        if baseline is not None and baseline is not scores:
            better = statistics.probability_of_improvement(scores.values, baseline.values)
            rows.append(common | {"metric": IMPROVEMENT, "value": float(better)})
    return rows


def _estimates(values: Sequence[np.ndarray]) -> dict[str, float]:
    """Mean, error and interquartile mean of one task's seeds, or over several tasks that weigh alike."""
    errors = [statistics.mean_and_standard_error(task)[1] for task in values]
    low, high = statistics.stratified_bootstrap_interval(values, statistics.interquartile_mean)
    return {
        "value": float(statistics.aggregate_mean(values)),
        "error": float(np.sqrt(np.sum(np.square(errors)))) / len(errors),
        "iqm": float(statistics.interquartile_mean(values)),
        "iqm_low": low,
        "iqm_high": high,
    }


def _note(agent: str) -> str | None:
    """What is to be known of an agent beside its scores."""
    known = registry.agents()
    return USES_SIMULATOR if agent in known and known[agent].uses_simulator else None


def sees(spec: EnvironmentSpec) -> str:
    """What a task shows: "pixels" or "symbolic"."""
    return "pixels" if spec.observation.kind == "pixels" else "symbolic"


def _ordered(ours: pd.DataFrame, literature: pd.DataFrame) -> pd.DataFrame:
    """Ranks ours, best first within each group, and puts the published rows after them."""
    group = ["task", "preset", "steps", "environment_version", "protocol", "metric"]
    ranked = ours[(ours["overrides"] == "") & (ours["note"] != USES_SIMULATOR)]
    ranks = ranked.groupby(group, dropna=False, sort=False)["value"].rank(method="min", ascending=False)
    ours = ours.assign(rank=ranks.astype("Int64"))
    names = sorted(dict.fromkeys(ours["metric"]), key=lambda name: name == IMPROVEMENT)  # which stands last
    ours = ours.assign(place=ours["metric"].map({name: i for i, name in enumerate(names)}))
    order = ["task", "preset", "steps", "protocol", "environment_version", "place", "rank", "method", "overrides"]
    ours = ours.sort_values(order, kind="stable", na_position="last")[list(COLUMNS)]
    theirs = literature.assign(preset="", overrides="").reindex(columns=list(COLUMNS))
    return pd.concat([part.astype(object) for part in (ours, theirs) if len(part)], ignore_index=True)


def _each(words: Iterable[str]) -> str:
    """Different ones, once each."""
    return "; ".join(dict.fromkeys(words))


def _device(fields: DeviceFields) -> str:
    kind = f"{fields.cpu_cores} CPU cores" if fields.platform == "cpu" else fields.kind
    devices = kind if fields.count == 1 else f"{fields.count} devices ({kind})"
    return devices if fields.seeds == 1 else f"{devices}, {fields.seeds} seeds together"


def _packages(fields: RecordFields) -> str:
    versions = {"python": fields.python, **fields.packages}
    return " ".join(f"{name}=={version}" for name, version in versions.items())
