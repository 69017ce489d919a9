"""Runs of one agent under the same rules and settings, and what they scored: what tables and pages show."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from leaderboards.qualification import settings
from leaderboards.scoring import main_score
from suite import registry
from suite.configuration.schema import Config, hash_of
from suite.interface.environment import EnvironmentSpec
from suite.records.record import RunRecord
from suite.runtime.errors import UserError

COUNTS = frozenset({"episodes", "final_episodes"})


@dataclasses.dataclass(frozen=True)
class Entry:
    """One row of a leaderboard: runs that differ in nothing but their seeds.

    Attributes:
      records: one for each seed S, in the order of seeds.
    """

    records: tuple[RunRecord, ...]

    @property
    def config(self) -> Config:
        """The first run's; the others' are the same but for the seed."""
        return self.records[0].config

    @property
    def protocol_hash(self) -> str:
        """Of the rules that all its runs were made under."""
        return self.records[0].fields.protocol_hash

    @functools.cached_property
    def spec(self) -> EnvironmentSpec:
        """The task's."""
        return registry.task(self.config.task).spec()

    @property
    def seeds(self) -> tuple[int, ...]:
        """Of the runs."""
        return tuple(record.config.seed for record in self.records)

    @functools.cached_property
    def scores(self) -> dict[str, np.ndarray]:
        """By name, each seed's score [S], computed from its episodes as the task says; counts of episodes left out."""
        score = registry.task(self.config.task).scores()
        runs = [score(record.episodes(), record.config, self.spec) for record in self.records]
        return {name: np.array([run[name] for run in runs], float) for name in runs[0] if name not in COUNTS}

    @property
    def main_score(self) -> str:
        """See `leaderboards.scoring.main_score`."""
        return main_score(self.scores)

    @property
    def minutes(self) -> np.ndarray:
        """Wall-clock of each seed's run [S]."""
        return np.array([record.wall_seconds / 60 for record in self.records])

    def curve(self, score: str, parts: int) -> np.ndarray:
        """A score over the episodes that end in each of the budget's equal parts, [P, S]; nan where none does."""
        task, budget = registry.task(self.config.task), self.config.protocol.steps
        curve_PS = np.empty((parts, len(self.records)))
        for i, record in enumerate(self.records):
            episodes = record.episodes()
            part = np.ceil(episodes["step"] * parts / budget).astype(int)  # 1 to `parts`
            for j in range(parts):
                curve_PS[j, i] = task.scores()(episodes[part == j + 1], None, self.spec)[score]
        return curve_PS


def finished_in(folders: Sequence[Path]) -> list[RunRecord]:
    """Every finished run in these folders or below them.

    Raises:
      UserError: there is none, or one cannot be read.
    """
    records = [RunRecord.open(path, lock=False) for path in run_folders(folders)]
    finished = [record for record in records if record.finished]
    if not finished:
        begun = f"; {len(records)} unfinished" if records else ""
        raise UserError(f"no finished run in {', '.join(map(str, folders))}{begun}")
    return finished


def run_folders(folders: Iterable[Path]) -> list[Path]:
    """Every folder of a run, finished or not, in these or below them."""
    return sorted({path.parent for folder in folders for path in folder.rglob("record.json")})


def entries_of(records: Iterable[RunRecord]) -> list[Entry]:
    """Groups runs that differ in nothing but their seeds: task by task, agents in the order of the registry."""
    ids = list(registry.agents())
    groups: dict[tuple[str, str, str, str], list[RunRecord]] = {}
    for record in records:
        config = record.config
        key = (config.task, config.preset, record.fields.protocol_hash, hash_of(settings(config)))
        groups.setdefault(key, []).append(record)

    def place(item: tuple[tuple[str, str, str, str], list[RunRecord]]) -> tuple[str, str, str, int, str, str]:
        (task, preset, protocol, same), (first, *_) = item
        agent = first.config.agent
        return task, preset, protocol, ids.index(agent) if agent in ids else len(ids), agent, same

    return [
        Entry(tuple(sorted(group, key=lambda record: record.config.seed)))
        for _, group in sorted(groups.items(), key=place)
    ]
