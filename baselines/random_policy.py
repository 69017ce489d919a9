"""The agent that acts uniformly at random: the floor under every learning curve."""

from __future__ import annotations

from suite.config import Config
from suite.overrides import apply_changes


def random(config: Config) -> Config:
    """Uniform over actions; learns nothing. No row of the paper."""
    return apply_changes(config, {"policy.kind": "uniform", "ppo.learn_from_real": False, "world_model.enabled": False})
