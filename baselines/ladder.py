"""The paper's ladder of model-based agents (Section 4.1, Table 1), rung by rung."""

from __future__ import annotations

from suite.configuration.overrides import apply_changes
from suite.configuration.schema import Config

VQ_CODES = 512  # "methods M1-3 use a codebook size of 512"


def m1(config: Config) -> Config:
    """M1, baseline: 31.93 +- 2.22 % reward, 4.98 +- 0.50 % score, 60.0M parameters.

    A convolutional VQ-VAE, an autoregressive world model, and a policy that learns from imagination alone, hence
    nothing before imagination starts (fidelity note 26).
    """
    return apply_changes(m2(config), {"ppo.learn_from_real": False})


def m2(config: Config) -> Config:
    """M2, M1 + Dyna: 43.36 +- 1.84 % reward, 8.85 +- 0.63 % score, 60.0M parameters."""
    return without_block_teacher_forcing(with_vq_vae(config))


def m3(config: Config) -> Config:
    """M3, M2 + patches: 58.92 +- 1.03 % reward, 19.36 +- 1.42 % score, 56.6M parameters."""
    return without_block_teacher_forcing(with_patch_vq_vae(config))


def m4(config: Config) -> Config:
    """M4, M3 + NNT: 64.96 +- 1.13 % reward, 25.55 +- 0.86 % score, 58.5M parameters."""
    return without_block_teacher_forcing(config)


def m5(config: Config) -> Config:
    """M5, M4 + BTF, best MBRL (fast): 67.42 +- 0.55 % reward, 27.91 +- 0.63 % score, 58.5M parameters.

    The defaults of `suite.configuration.schema`.
    """
    return config


def m5_slow(config: Config) -> Config:
    """M5, best MBRL (slow): 69.66 +- 1.20 % reward, 31.77 +- 1.43 % score (fidelity note 27).

    4000 world-model updates per iteration instead of 500; under a scaled preset, eight times the preset's.
    """
    return apply_changes(config, {"world_model.updates": 8 * config.world_model.updates})


def without_block_teacher_forcing(config: Config) -> Config:
    """Frames are modelled and imagined token by token (fidelity note 19)."""
    return apply_changes(config, {"world_model.block_teacher_forcing": False})


def with_vq_vae(config: Config) -> Config:
    """IRIS's tokenizer: 8x8 codes of a convolutional VQ-VAE, lambda (1, 0, 1, 0.25) (fidelity note 15)."""
    return _learned(config, {"tokenizer.kind": "vq_vae"})


def with_patch_vq_vae(config: Config) -> Config:
    """A VQ-VAE of each patch alone, lambda (0.1, 1, 1, 0.02) (Appendix A.2.1)."""
    return _learned(config, {"tokenizer.kind": "patch_vq_vae", "tokenizer.loss_weights": (0.1, 1.0, 1.0, 0.02)})


def _learned(config: Config, changes: dict) -> Config:
    """512 codes, or the preset's if those are fewer, and as many updates as the world model has: 500."""
    codes = min(VQ_CODES, config.tokenizer.codebook_size)
    common = {"tokenizer.codebook_size": codes, "tokenizer.updates": config.world_model.updates}
    return apply_changes(config, common | changes)
