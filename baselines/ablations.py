"""What the paper takes away from its best agent, one thing at a time (Section 4.3, Table 2)."""

from __future__ import annotations

from baselines import ladder
from suite.configuration.overrides import apply_changes
from suite.configuration.schema import Config


def m5_patch5(config: Config) -> Config:
    """5x5 quantized: 57.28 +- 1.14 % reward, 18.26 +- 1.18 % score.

    63 is no multiple of 5: edge pixels are repeated up to 65, below and on the right, for 13x13 patches (note 37).
    """
    return apply_changes(config, {"tokenizer.patch": (5, 5)})


def m5_patch9(config: Config) -> Config:
    """9x9 quantized: 45.55 +- 0.88 % reward, 10.12 +- 0.40 % score. 7x7 patches."""
    return apply_changes(config, {"tokenizer.patch": (9, 9)})


def m5_continuous(config: Config) -> Config:
    """7x7 continuous: 21.20 +- 0.55 % reward, 2.43 +- 0.09 % score.

    The world model regresses the patches, by squared distance, and a dream shows its guess.
    """
    return apply_changes(config, {"tokenizer.kind": "continuous"})


def m5_no_dyna(config: Config) -> Config:
    """Remove Dyna: 55.02 +- 5.34 % reward, 18.79 +- 2.14 % score. No policy update on real play (note 26)."""
    return apply_changes(config, {"ppo.learn_from_real": False})


def m5_no_nnt(config: Config) -> Config:
    """Remove NNT: 60.66 +- 1.38 % reward, 21.79 +- 1.33 % score. The patch VQ-VAE of M3."""
    return ladder.with_patch_vq_vae(config)


def m5_no_nnt_no_patches(config: Config) -> Config:
    """Remove NNT & patches: 45.86 +- 1.42 % reward, 10.36 +- 0.69 % score. The VQ-VAE of M1 and M2."""
    return ladder.with_vq_vae(config)


def m5_no_btf(config: Config) -> Config:
    """Remove BTF: 64.96 +- 1.13 % reward, 25.55 +- 0.86 % score. The same as M4."""
    return ladder.m4(config)


def m5_tbp0(config: Config) -> Config:
    """Use T_BP = 0: 33.54 +- 10.09 % reward, 12.86 +- 4.05 % score. Imagination from the first iteration on."""
    return apply_changes(config, {"imagination.start_step": 0})


def m5_annealed(config: Config) -> Config:
    """Annealed policy updates: 65.71 +- 1.11 % reward (Section 4.3, Appendix C; fidelity note 38).

    Imagined updates grow linearly from 0 at the start to 300, twice the usual number, at the end.
    """
    changes = {
        "imagination.schedule": "linear",
        "imagination.start_step": 0,
        "imagination.updates": 2 * config.imagination.updates,
    }
    return apply_changes(config, changes)
