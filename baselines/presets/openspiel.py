"""Of two-player games of OpenSpiel."""

from __future__ import annotations

from typing import Any

from suite import registry
from suite.configuration.overrides import apply_changes
from suite.configuration.schema import Config

# The paper's tables for OpenSpiel and, where that says so, MinAtar (Appendix G); fidelity note 6. What they leave out
# is as for Craftax-classic.
OPENSPIEL_PAPER: dict[str, Any] = {
    "protocol.steps": 100_000,  # of both players; chance's do not count
    "policy.shared_trunk": True,
    "world_model.updates": 2_000,
    "imagination.start_step": 0,
    "imagination.updates": 2_000,
    "imagination.entropy_coefficient": 0.05,
    "replay.capacity": 128_000,
    "checkpoint.every_steps": 10_000,
}

OPENSPIEL_SMALL: dict[str, Any] = {
    "protocol.final_fraction": 0.2,
    "environment.num_envs": 16,
    "environment.rollout_length": 64,
    "policy.hidden_size": 128,
    "policy.dense_blocks": 1,
    "policy.rnn_size": 64,
    "ppo.minibatches": 4,
    "replay.capacity": 32_000,
    "world_model.embed_dim": 64,
    "world_model.layers": 2,
    "world_model.heads": 4,
    "world_model.dropout": 0.0,
    "world_model.initial_std": 0.1,  # 0.02 hardly learns the rules in as many updates
    "world_model.sequence_length": 4,
    "world_model.sequences": 16,
    "world_model.minibatches": 2,
    "world_model.updates": 40,
    "imagination.horizon": 4,
    "imagination.num_envs": 48,
    "imagination.updates": 10,
    "evaluation.episodes": 16,
}

# 187 tokens an event, and episodes of five: a shallow model that sees many short sequences learns most in the time.
BARGAINING_SMALL: dict[str, Any] = {
    "world_model.layers": 1,
    "world_model.heads": 2,
    "world_model.sequence_length": 2,
    "world_model.sequences": 8,
    "world_model.updates": 60,
    "imagination.horizon": 2,
    "imagination.updates": 3,
}

OPENSPIEL_SMOKE: dict[str, Any] = {
    "protocol.steps": 96,
    "environment.num_envs": 4,
    "environment.rollout_length": 12,
    "environment.burn_in": 2,
    "policy.hidden_size": 16,
    "policy.dense_blocks": 1,
    "policy.rnn_size": 8,
    "ppo.minibatches": 2,
    "ppo.epochs": 1,
    "replay.capacity": 128,
    "world_model.embed_dim": 16,
    "world_model.layers": 1,
    "world_model.heads": 2,
    "world_model.sequence_length": 4,
    "world_model.sequences": 4,
    "world_model.minibatches": 2,
    "world_model.updates": 2,
    "imagination.horizon": 4,
    "imagination.num_envs": 4,
    "imagination.updates": 2,
    "evaluation.episodes": 4,
    "checkpoint.every_steps": 48,
}


def openspiel_paper(config: Config) -> Config:
    """Table "Parameters for OpenSpiel"; a memory only where something is hidden."""
    return _without_needless_memory(apply_changes(config, OPENSPIEL_PAPER))


def openspiel_small(config: Config) -> Config:
    """The paper's budget, with a network and numbers of updates for two CPU cores."""
    return _without_needless_memory(apply_changes(config, OPENSPIEL_PAPER | OPENSPIEL_SMALL))


def bargaining_small(config: Config) -> Config:
    """`openspiel_small` with a shallower model of shorter sequences."""
    return apply_changes(openspiel_small(config), BARGAINING_SMALL)


def openspiel_smoke(config: Config) -> Config:
    """Two iterations or three, with imagination."""
    return _without_needless_memory(apply_changes(config, OPENSPIEL_PAPER | OPENSPIEL_SMOKE))


def _without_needless_memory(config: Config) -> Config:
    """Where both players see everything there is nothing to remember."""
    observed = registry.task(config.task).spec().fully_observed
    return apply_changes(config, {"policy.rnn_size": 0}) if observed else config
