"""Tokenizers: from observations to tokens and back."""

from __future__ import annotations

from suite.configuration.schema import TokenizerConfig
from suite.interface.environment import ObservationSpec
from suite.interface.tokens import Tokenizer
from suite.runtime.errors import UserError
from suite.tokenizers.continuous import ContinuousTokenizer
from suite.tokenizers.nearest_neighbor import NearestNeighborTokenizer
from suite.tokenizers.patches import patch_grid
from suite.tokenizers.symbols import SymbolTokenizer
from suite.tokenizers.vq_vae import VQTokenizer


def make_tokenizer(config: TokenizerConfig, observation: ObservationSpec) -> Tokenizer:
    """The tokenizer that `config.kind` names, for these observations; symbols are tokens whatever it names.

    Raises:
      UserError: these observations have no patches, or smaller ones.
    """
    if observation.kind == "symbols":
        return SymbolTokenizer(observation)
    if config.kind == "vq_vae":
        return VQTokenizer(config, observation, None)
    patch = config.patch or observation.patch
    if patch is None:
        raise UserError(f"tokenizer.kind={config.kind} needs frames of patches, not {observation.kind}")
    try:
        patch_grid(observation.shape, patch)
    except ValueError as error:
        raise UserError(f"tokenizer.patch={patch}: {error}") from error
    if config.kind == "patch_vq_vae":
        return VQTokenizer(config, observation, patch)
    if config.kind == "continuous":
        return ContinuousTokenizer(observation, patch)
    return NearestNeighborTokenizer(config.codebook_size, config.threshold, patch, observation)
