"""The agent that acts uniformly at random: the floor under every learning curve."""

from __future__ import annotations

from suite.configuration.overrides import apply_changes
from suite.configuration.schema import Config


def random(config: Config) -> Config:
    """Uniform over actions; learns nothing. No row of the paper."""
    return apply_changes(config, {"policy.kind": "uniform", "ppo.learn_from_real": False, "world_model.enabled": False})
