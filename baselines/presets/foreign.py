"""Of tasks of other libraries, whatever they show."""

from __future__ import annotations

from typing import Any

from baselines.presets.openspiel import OPENSPIEL_SMALL, OPENSPIEL_SMOKE
from suite.configuration.overrides import apply_changes
from suite.configuration.schema import Config

# Tasks of other libraries: whatever they show, symbols or small images.
FOREIGN_SMALL: dict[str, Any] = OPENSPIEL_SMALL | {
    "protocol.steps": 50_000,
    "policy.cnn_channels": (16, 32),
    "policy.blocks_per_stack": 1,
    "policy.convs_per_block": 1,
    "policy.shared_trunk": True,
    "tokenizer.codebook_size": 512,
    "tokenizer.updates": 5,
    "imagination.start_step": 10_000,
    "imagination.entropy_coefficient": 0.05,
    "checkpoint.every_steps": 10_000,
}

FOREIGN_SMOKE: dict[str, Any] = OPENSPIEL_SMOKE | {
    "policy.cnn_channels": (4,),
    "policy.blocks_per_stack": 1,
    "policy.convs_per_block": 1,
    "tokenizer.codebook_size": 128,
    "tokenizer.updates": 1,
    "imagination.start_step": 0,
}


def foreign_small(config: Config) -> Config:
    """Minutes on two CPU cores."""
    return apply_changes(config, FOREIGN_SMALL)


def foreign_smoke(config: Config) -> Config:
    """Two iterations, with imagination."""
    return apply_changes(config, FOREIGN_SMOKE)
