"""The paper's model-free agent: the same policy and PPO, on real play only."""

from __future__ import annotations

from suite.config import Config
from suite.overrides import apply_changes


def mfrl(config: Config) -> Config:
    """Best MFRL (Appendix A.1, Table "MFRL hyperparameters"): 55.49 +- 1.33 % reward, 16.77 +- 1.11 % score.

    Four epochs of eight minibatches are what the model-based agents do on real play too, so a preset may scale them.
    """
    return apply_changes(config, {"world_model.enabled": False, "ppo.anneal_learning_rate": True})
