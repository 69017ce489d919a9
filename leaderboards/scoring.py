"""Scores from episodes: pure functions of the tables in run records.

Units are in the names: `percent` is 0 to 100.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

if TYPE_CHECKING:
    from suite.config import Config
    from suite.interface.environment import EnvironmentSpec


def craftax(
    episodes: pd.DataFrame | Sequence[Mapping[str, Any]], config: Config | None, spec: EnvironmentSpec
) -> dict[str, float]:
    """`craftax_scores` under a run's protocol, flat: each success rate is `success_percent/<achievement>`.

    Without a configuration all episodes count alike, as in an evaluation.
    """
    assert spec.max_return is not None
    episodes = pd.DataFrame(episodes)
    if episodes.empty:  # then not even the columns need be there
        episodes = pd.DataFrame(columns=["step", "return", "achievement_return", *spec.achievements], dtype=float)
    steps, final_fraction = (
        (config.protocol.steps, config.protocol.final_fraction) if config else (episodes["step"].max(), 1.0)
    )
    scores = craftax_scores(episodes, spec.achievements, spec.max_return, steps, final_fraction)
    success = scores.pop("success_percent")
    return scores | {f"success_percent/{name}": percent for name, percent in success.items()}


def craftax_scores(
    episodes: pd.DataFrame, achievements: Sequence[str], max_return: float, steps: int, final_fraction: float = 0.1
) -> dict[str, Any]:
    """Crafter's and Craftax's numbers over training episodes (fidelity note 29).

    Args:
      episodes: one row per training episode: `step` at which it ended, `return`, `achievement_return`, and a 0/1 column
        for each achievement.
      achievements: their names.
      max_return: the sum of all achievements' rewards (22 for Craftax-classic).
      steps: the budget; later episodes do not count.
      final_fraction: rewards are of episodes that end in this last part of the budget.

    Returns:
      reward_percent: mean achievement return of the final episodes, of `max_return`; nan if none ended there.
      reward_percent_with_health: the same with the reward for health.
      score_percent: Crafter's score over all episodes, see `crafter_score`; nan if there are none.
      success_percent: by achievement, the share of all episodes that unlocked it.
      episodes, final_episodes: how many there were.
    """
    episodes = episodes[episodes["step"] <= steps]
    final = episodes[episodes["step"] > steps * (1 - final_fraction)]
    success = {name: 100 * float(episodes[name].mean()) for name in achievements}
    return {
        "reward_percent": 100 * float(final["achievement_return"].mean()) / max_return,
        "reward_percent_with_health": 100 * float(final["return"].mean()) / max_return,
        "score_percent": crafter_score(list(success.values())),
        "success_percent": success,
        "episodes": len(episodes),
        "final_episodes": len(final),
    }


def crafter_score(success_percent: list[float]) -> float:
    """exp(mean(ln(1 + s_i))) - 1 over achievements' success rates s_i in percent (Hafner 2021): 0 to 100."""
    return float(np.expm1(np.log1p(success_percent).mean()))
