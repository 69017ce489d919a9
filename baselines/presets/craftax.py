"""Of Craftax-classic and Craftax (full)."""

from __future__ import annotations

from typing import Any

from suite import registry
from suite.configuration.overrides import apply_changes
from suite.configuration.schema import Config


def paper(config: Config) -> Config:
    """Appendix A to the letter, as the fidelity notes settle it."""
    return config


CRAFTAX_CLASSIC_SMALL: dict[str, Any] = {
    "protocol.steps": 40_960,  # 40 iterations of 16 x 64
    "protocol.final_fraction": 0.2,
    "environment.num_envs": 16,
    "environment.rollout_length": 64,
    "policy.max_pixels": 27,  # three pixels a tile
    "policy.cnn_channels": (16, 32, 32),
    "policy.blocks_per_stack": 1,
    "policy.convs_per_block": 1,
    "policy.hidden_size": 256,
    "policy.dense_blocks": 1,
    "policy.rnn_size": 128,
    "ppo.minibatches": 4,
    "ppo.epochs": 3,
    "replay.capacity": 32_000,
    "tokenizer.codebook_size": 512,
    "tokenizer.updates": 100,  # twice as many frames as an iteration brings; the paper's 25 see five times as many
    "tokenizer.embed_dim": 32,
    "tokenizer.channels": (8, 8, 16, 16, 32),
    "world_model.embed_dim": 64,
    "world_model.layers": 2,
    "world_model.heads": 4,
    "world_model.initial_std": 0.1,
    "world_model.sequence_length": 5,
    # Many steps on few sequences each: a fifth less loss than a quarter of the steps on four times as many.
    "world_model.sequences": 4,
    "world_model.minibatches": 2,
    "world_model.updates": 300,
    "world_model.dropout": 0.0,
    "imagination.start_step": 10_000,
    "imagination.horizon": 5,
    "imagination.num_envs": 32,
    "imagination.updates": 16,
    # An achievement pays once an episode. From all over the buffer dreams start before rewards that the policy has long
    # collected, pay three times what real play does, and teach it to grab them within five steps and nothing else.
    "imagination.recent": 64,
    "imagination.entropy_coefficient": 0.05,
    "evaluation.episodes": 16,
    "checkpoint.every_steps": 10_000,
}

# Five times as many steps, and dreams of twenty steps, as the paper's are: in the true game they are worth four points
# where those of five are worth one. The model learns from sequences of five all the same, since those of twenty cost
# four times as much, and half as often, which leaves an hour's run as many updates as it needs.
CRAFTAX_CLASSIC_MEDIUM: dict[str, Any] = CRAFTAX_CLASSIC_SMALL | {
    "protocol.steps": 204_800,
    "world_model.updates": 150,
    "imagination.start_step": 20_480,
    "imagination.horizon": 20,
    "checkpoint.every_steps": 20_480,
}

CRAFTAX_CLASSIC_SMOKE: dict[str, Any] = {
    "protocol.steps": 64,
    "environment.num_envs": 4,
    "environment.rollout_length": 8,
    "environment.burn_in": 2,
    "policy.cnn_channels": (4, 4, 4),
    "policy.blocks_per_stack": 1,
    "policy.convs_per_block": 1,
    "policy.hidden_size": 16,
    "policy.dense_blocks": 1,
    "policy.rnn_size": 8,
    "ppo.minibatches": 2,
    "ppo.epochs": 1,
    "replay.capacity": 128,
    "tokenizer.codebook_size": 128,
    "tokenizer.updates": 1,
    "tokenizer.embed_dim": 8,
    "tokenizer.channels": (4, 4, 4, 4, 8),
    "world_model.embed_dim": 16,
    "world_model.layers": 1,
    "world_model.heads": 2,
    "world_model.sequence_length": 4,
    "world_model.sequences": 4,
    "world_model.minibatches": 2,
    "world_model.updates": 2,
    "imagination.start_step": 64,
    "imagination.horizon": 3,
    "imagination.num_envs": 4,
    "imagination.updates": 2,
    "evaluation.episodes": 4,
    "checkpoint.every_steps": 32,
}


def craftax_classic_small(config: Config) -> Config:
    """Minutes on two CPU cores."""
    return apply_changes(config, CRAFTAX_CLASSIC_SMALL)


def craftax_classic_medium(config: Config) -> Config:
    """An hour on one CPU core."""
    return apply_changes(config, CRAFTAX_CLASSIC_MEDIUM)


def craftax_classic_smoke(config: Config) -> Config:
    """Two iterations, the second one with imagination."""
    return apply_changes(config, CRAFTAX_CLASSIC_SMOKE)


# Table "Craftax-classic vs Craftax (full)", fidelity note 28. What it leaves out is as for Craftax-classic.
CRAFTAX_FULL_MODEL_FREE: dict[str, Any] = {"environment.num_envs": 64, "environment.rollout_length": 64}
CRAFTAX_FULL_MODEL_BASED: dict[str, Any] = {
    "environment.num_envs": 16,
    "environment.rollout_length": 96,
    "replay.capacity": 48_000,
    # N_env is one number in Algorithms 1, 4 and 5. Its 16 sequences do not split into three minibatches: three of five.
    "world_model.sequences": 15,
    "imagination.num_envs": 16,
}

CRAFTAX_FULL_SMALL: dict[str, Any] = CRAFTAX_CLASSIC_SMALL | {
    "policy.max_pixels": 39,  # three pixels a tile, in height
    "tokenizer.updates": 50,
    "world_model.sequence_length": 4,
    "world_model.updates": 60,
    "imagination.horizon": 4,
}

CRAFTAX_FULL_MEDIUM: dict[str, Any] = CRAFTAX_FULL_SMALL | {
    "protocol.steps": 102_400,
    "imagination.start_step": 20_480,
    "imagination.horizon": 20,
    "checkpoint.every_steps": 20_480,
}


def craftax_full_paper(config: Config) -> Config:
    """Table "Craftax-classic vs Craftax (full)": how many environments depends on whether the agent has a model."""
    dreams = registry.agent(config.agent).configure()(config).dreams
    return apply_changes(config, CRAFTAX_FULL_MODEL_BASED if dreams else CRAFTAX_FULL_MODEL_FREE)


def craftax_full_small(config: Config) -> Config:
    """Minutes on two CPU cores."""
    return apply_changes(config, CRAFTAX_FULL_SMALL)


def craftax_full_medium(config: Config) -> Config:
    """A hundred iterations instead of forty, with dreams of twenty steps; how long that takes was not measured."""
    return apply_changes(config, CRAFTAX_FULL_MEDIUM)


def craftax_full_smoke(config: Config) -> Config:
    """Two iterations, the second one with imagination."""
    return apply_changes(config, CRAFTAX_CLASSIC_SMOKE)
