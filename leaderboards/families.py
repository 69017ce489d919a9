"""Agents over all games of a family, on one scale that the games share."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from leaderboards.published import OF_FAMILY
from leaderboards.qualification import overrides
from leaderboards.results import Entry
from suite import registry

BASELINE = "mfrl"  # where a family's returns have no common unit, 1 is what this agent earns (the paper's Section 4.6)


@dataclasses.dataclass(frozen=True)
class FamilyScores:
    """An agent that has played every game of a family under the same preset, without overrides.

    Attributes:
      family: its name.
      entries: the agent's, in the order of the family's `games`.
      metric: what is scored: comparable between games.
      values: of each game, the seeds' scores [S].
    """

    family: str
    entries: tuple[Entry, ...]
    metric: str
    values: tuple[np.ndarray, ...]

    @property
    def agent(self) -> str:
        """Its id."""
        return self.entries[0].config.agent


def families(entries: Sequence[Entry]) -> list[list[FamilyScores]]:
    """Agents that may be compared with each other: one list for each family, preset, budget and version of the games.

    Those whose unit is the baseline's return are left out where it has not played all of the games.
    """
    groups: dict[tuple[Any, ...], dict[str, dict[str, Entry]]] = {}
    for entry in entries:
        config, rules = entry.config, entry.records[0].fields.protocol.model_dump()
        family = registry.task(config.task).family
        if config.task in registry.family(family).games and not overrides(config):
            key = (family, config.preset, *(rules[name] for name in sorted(rules) if name != "task"))
            groups.setdefault(key, {}).setdefault(config.agent, {})[config.task] = entry
    comparable = []
    for (family, *_), agents in groups.items():
        games, relative = registry.family(family).games, not registry.family(family).metric
        whole = {
            agent: tuple(played[game] for game in games)
            for agent, played in agents.items()
            if played.keys() == set(games)
        }
        if not relative or BASELINE in whole:
            comparable.append([_scores(family, own, whole.get(BASELINE, ())) for own in whole.values()])
    return [group for group in comparable if group]


def _scores(family: str, own: tuple[Entry, ...], baseline: tuple[Entry, ...]) -> FamilyScores:
    metric = registry.family(family).metric or OF_FAMILY
    if metric == OF_FAMILY:
        pairs = zip(own, baseline, strict=True)
        values = [entry.scores["return"] / unit.scores["return"].mean() for entry, unit in pairs]
    else:
        values = [entry.scores[metric] for entry in own]
    return FamilyScores(family, own, metric, tuple(values))
