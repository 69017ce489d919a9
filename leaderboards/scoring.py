"""Scores from episodes: pure functions of the tables in run records.

Units are in the names: `percent` is 0 to 100.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from leaderboards.best_response import REFERENCE, normalized
from suite.interface.scores import ScoreName

if TYPE_CHECKING:
    from suite.configuration.schema import Config
    from suite.interface.environment import EnvironmentSpec


# What stands above scores on pages.
LABELS = {
    "reward_percent": "Reward, % of the maximum",
    "reward_percent_with_health": "Reward with health, %",
    "score_percent": "Crafter score, %",
    "return": "Return",
    "normalized_return": "Normalized return (1: best response)",
}
# What Craftax calls its achievements by what they pay.
TIERS = {1.0: "basic", 3.0: "intermediate", 5.0: "advanced", 8.0: "very_advanced"}
SEATS = (1, 2)
# Scores of a part of the achievements or of one seat, which tables of many agents leave to the CSV files.
DETAILS = frozenset(
    {*(f"success_percent_{tier}" for tier in TIERS.values()), *(f"return_seat_{seat}" for seat in SEATS)}
)


def craftax(
    episodes: pd.DataFrame | Sequence[Mapping[str, Any]], config: Config | None, spec: EnvironmentSpec
) -> dict[str, float]:
    """Crafter's and Craftax's numbers over training episodes (fidelity note 29).

    Args:
      episodes: one row per training episode: `step` at which it ended, `return`, `achievement_return`, and a 0/1 column
        for each achievement.
      config: says the budget, beyond which episodes do not count, and its last part: rewards are of episodes that end
        in it. Without a configuration all episodes count alike, as in an evaluation.
      spec: the game's; says what each achievement pays.

    Returns:
      reward_percent: mean achievement return of the final episodes, of the most there is; nan if none ended there.
      reward_percent_with_health: the same with the reward for health.
      score_percent: Crafter's score over all episodes, see `crafter_score`; nan if there are none.
      success_percent/<achievement>: the share of all episodes that unlocked it.
      success_percent_<tier>: the mean of that over the achievements that pay the same, where not all do (`TIERS`).
      episodes, final_episodes: how many there were.
    """
    assert spec.max_return is not None
    columns = ["step", "return", "achievement_return", *spec.achievements]
    episodes, final = _final(episodes, config, columns)
    success = {name: 100 * float(episodes[name].mean()) for name in spec.achievements}
    tiers: dict[str, list[float]] = {}
    for name, reward in zip(spec.achievements, spec.achievement_rewards, strict=True):
        tiers.setdefault(TIERS[reward], []).append(success[name])
    return {
        "reward_percent": 100 * float(final["achievement_return"].mean()) / spec.max_return,
        "reward_percent_with_health": 100 * float(final["return"].mean()) / spec.max_return,
        "score_percent": crafter_score(list(success.values())),
        "episodes": len(episodes),
        "final_episodes": len(final),
        **{ScoreName.of_part("success_percent", name): percent for name, percent in success.items()},
        **(
            {f"success_percent_{name}": float(np.mean(rates)) for name, rates in tiers.items()}
            if len(tiers) > 1
            else {}
        ),
    }


def crafter_score(success_percent: list[float]) -> float:
    """exp(mean(ln(1 + s_i))) - 1 over achievements' success rates s_i in percent (Hafner 2021): 0 to 100."""
    return float(np.expm1(np.log1p(success_percent).mean()))


def games(
    episodes: pd.DataFrame | Sequence[Mapping[str, Any]], config: Config | None, spec: EnvironmentSpec
) -> dict[str, float]:
    """A two-player game's scores, in its own units, over the episodes that end in the last part of the budget.

    Args:
      episodes: one row per training episode: `step` at which it ended, `return`, `seat` (1 or 2), and `raw_return`
        where the reward that is learned from is another.
      config: says the budget and its last part; without it all episodes count, as in an evaluation.
      spec: the game's.

    Returns:
      return_seat_1, return_seat_2: mean raw return in each seat; nan if none of its episodes counts.
      return: the mean of the two, so that neither seat weighs more by having shorter games.
      normalized_return: the mean of the two seats' returns on the scale where 0 is the uniform random player and 1 the
        exact best response, both against the uniform random opponent; only where `best_response.REFERENCE` has them.
      episodes, final_episodes: how many there were.
    """
    episodes, final = _final(episodes, config, ["step", "return", "seat"])
    raw_return = final["raw_return" if "raw_return" in final else "return"]
    returns = [float(raw_return[final["seat"] == seat].mean()) for seat in SEATS]
    scores = {f"return_seat_{seat}": value for seat, value in zip(SEATS, returns, strict=True)}
    scores["return"] = sum(returns) / 2
    if spec.id in REFERENCE:
        reference = REFERENCE[spec.id]
        ours = map(normalized, returns, reference.random, reference.best_response)
        scores["normalized_return"] = sum(ours) / 2
    return scores | {"episodes": len(episodes), "final_episodes": len(final)}


def returns(
    episodes: pd.DataFrame | Sequence[Mapping[str, Any]], config: Config | None, spec: EnvironmentSpec
) -> dict[str, float]:
    """The score of a task without one of its own: `return`, the mean over the episodes that `games` would count."""
    episodes, final = _final(episodes, config, ["step", "return"])
    return {"return": float(final["return"].mean()), "episodes": len(episodes), "final_episodes": len(final)}


def _final(
    episodes: pd.DataFrame | Sequence[Mapping[str, Any]], config: Config | None, columns: list[str]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The episodes within the budget, and those that end in its last part; without a configuration both are all."""
    episodes = pd.DataFrame(episodes)
    if episodes.empty:  # then not even the columns need be there
        episodes = pd.DataFrame(columns=columns, dtype=float)
    if config is None:
        return episodes, episodes
    steps = config.protocol.steps
    episodes = episodes[episodes["step"] <= steps]
    return episodes, episodes[episodes["step"] > steps * (1 - config.protocol.final_fraction)]


def main_score(names: Iterable[str]) -> str:
    """Which of a task's scores curves and orders are of: `return` in the game's own units, or the first there is."""
    names = list(names)
    return "return" if "return" in names else names[0]
