"""Tokenizers: from observations to tokens and back."""

from __future__ import annotations

from suite.config import TokenizerConfig
from suite.errors import UserError
from suite.interface.environment import ObservationSpec
from suite.tokenizers.nearest_neighbor import NearestNeighborTokenizer
from suite.tokenizers.patches import patch_grid
from suite.tokenizers.symbols import SymbolTokenizer


def make_tokenizer(config: TokenizerConfig, observation: ObservationSpec) -> NearestNeighborTokenizer | SymbolTokenizer:
    """The tokenizer that `config.kind` names, for these observations; symbols are tokens whatever it names.

    Raises:
      UserError: the patches do not fill the frame.
    """
    if observation.kind == "symbols":
        return SymbolTokenizer(observation)
    patch = config.patch or observation.patch
    if patch is None:
        raise UserError(f"tokenizer.kind={config.kind} needs frames of patches, not {observation.kind}")
    try:
        patch_grid(observation.shape, patch)
    except ValueError as error:
        raise UserError(f"tokenizer.patch={patch}: {error}") from error
    return NearestNeighborTokenizer(config.codebook_size, config.threshold, patch, observation)
