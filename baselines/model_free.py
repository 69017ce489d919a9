"""The paper's model-free agents: PPO on real play only (Tables 1 and 2)."""

from __future__ import annotations

from suite.configuration.overrides import apply_changes
from suite.configuration.schema import Config


def mfrl(config: Config) -> Config:
    """Best MFRL (Appendix A.1, Table "MFRL hyperparameters"): 55.49 +- 1.33 % reward, 16.77 +- 1.11 % score, 55.6M.

    Four epochs of eight minibatches are what the model-based agents do on real play too, so a preset may scale them.
    """
    return apply_changes(config, {"world_model.enabled": False, "ppo.anneal_learning_rate": True})


def mfrl_no_rnn(config: Config) -> Config:
    """Remove RNN: 41.82 +- 0.97 % reward, 8.33 +- 0.44 % score. `mfrl` without the GRU."""
    return apply_changes(mfrl(config), {"policy.rnn_size": 0})


def mfrl_small(config: Config) -> Config:
    """Smaller model: 51.35 +- 0.80 % reward, 12.93 +- 0.56 % score.

    `mfrl`, its GRU kept, with the sizes of `mfrl_prior`'s network (fidelity note 36): the CNN's output is mapped to
    256 numbers, actor and critic have one layer of 1024 and no residual blocks.
    """
    return apply_changes(mfrl(config), _prior_sizes(config) | {"policy.dense_blocks": 0})


def mfrl_prior(config: Config) -> Config:
    """Previous best MFRL (Moon et al. 2023), the paper's own run: 47.40 +- 0.58 % reward, 10.71 +- 0.29 % score, 4.0M.

    PPO with a network without memory, and hyperparameters of its own (fidelity note 36); with the suite's budget of 1M
    steps it has 244 iterations instead of 250. How it collects, 8 environments x 512 steps, belongs to `paper` alone: a
    scaled preset brings its own.
    """
    changes = {
        "world_model.enabled": False,
        "policy.kind": "moon",
        "policy.rnn_size": 0,
        "environment.burn_in": 0,
        "ppo.discount": 0.95,
        "ppo.gae_lambda": 0.65,
        "ppo.clip": 0.2,
        "ppo.value_coefficient": 0.5,
        "ppo.entropy_coefficient": 0.01,
        "ppo.target_decay": 0.99,
        "ppo.target_spread": "mean_square",
        "ppo.target_min_std": 0.1,  # a variance of 0.01
        "ppo.learning_rate": 3e-4,
        "ppo.adam_eps": 1e-8,
        "ppo.max_grad_norm": 0.5,
        "ppo.epochs": min(3, config.ppo.epochs),
    }
    if config.preset == "paper":
        changes |= {"environment.num_envs": 8, "environment.rollout_length": 512, "ppo.minibatches": 8}
    return apply_changes(config, changes | _prior_sizes(config))


def _prior_sizes(config: Config) -> dict:
    """256 and 1024; under a scaled preset in the same proportion to its `policy.hidden_size`."""
    return {
        "policy.embedding_size": config.policy.hidden_size // 8,
        "policy.hidden_size": config.policy.hidden_size // 2,
    }
