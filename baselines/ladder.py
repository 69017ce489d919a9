"""The paper's ladder of model-based agents (Section 4.1), from its top rung downwards."""

from __future__ import annotations

from suite.config import Config
from suite.overrides import apply_changes


def m5(config: Config) -> Config:
    """M5, best MBRL (fast): 67.42 +- 0.55 % reward, 27.91 +- 0.63 % score. The defaults of `suite.config`."""
    return config


def m5_slow(config: Config) -> Config:
    """M5, best MBRL (slow): 69.66 +- 1.20 % reward, 31.77 +- 1.43 % score (fidelity note 27).

    4000 world-model updates per iteration instead of 500; under a scaled preset, eight times the preset's.
    """
    return apply_changes(config, {"world_model.updates": 8 * config.world_model.updates})
