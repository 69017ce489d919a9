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

# The games that a family's mean is over: the paper's.
GAMES = {
    "craftax_classic": ("craftax_classic",),
    "craftax_full": ("craftax_full",),
    "minatar": ("minatar/asterix", "minatar/breakout", "minatar/freeway", "minatar/space_invaders"),
    "openspiel": ("openspiel/tic_tac_toe", "openspiel/leduc", "openspiel/bargaining"),
}
# MinAtar's returns have no common unit: 1 is what the model-free agent earns in a game (the paper's Section 4.6).
METRICS = {"minatar": OF_FAMILY, "openspiel": "normalized_return"}
BASELINE = "mfrl"


@dataclasses.dataclass(frozen=True)
class FamilyScores:
    """An agent that has played every game of a family under the same preset, without overrides.

    Attributes:
      family: its name.
      entries: the agent's, in the order of `GAMES`.
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

    MinAtar's are left out where the baseline has not played all of them.
    """
    groups: dict[tuple[Any, ...], dict[str, dict[str, Entry]]] = {}
    for entry in entries:
        config, rules = entry.config, entry.records[0].fields.protocol.model_dump()
        family = registry.task(config.task).family
        if config.task in GAMES.get(family, ()) and not overrides(config):
            key = (family, config.preset, *(rules[name] for name in sorted(rules) if name != "task"))
            groups.setdefault(key, {}).setdefault(config.agent, {})[config.task] = entry
    comparable = []
    for (family, *_), agents in groups.items():
        whole = {
            agent: tuple(played[game] for game in GAMES[family])
            for agent, played in agents.items()
            if played.keys() == set(GAMES[family])
        }
        if family != "minatar" or BASELINE in whole:
            comparable.append([_scores(family, own, whole.get(BASELINE, ())) for own in whole.values()])
    return [group for group in comparable if group]


def _scores(family: str, own: tuple[Entry, ...], baseline: tuple[Entry, ...]) -> FamilyScores:
    metric = METRICS.get(family, "reward_percent")
    if metric == OF_FAMILY:
        pairs = zip(own, baseline, strict=True)
        values = [entry.scores["return"] / unit.scores["return"].mean() for entry, unit in pairs]
    else:
        values = [entry.scores[metric] for entry in own]
    return FamilyScores(family, own, metric, tuple(values))
