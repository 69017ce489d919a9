"""Symbols are tokens already."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from suite.configuration.schema import TokenizerConfig
from suite.interface.environment import ObservationSpec
from suite.tokenizers import make_tokenizer
from suite.tokenizers.symbols import SymbolTokenizer

SPEC = ObservationSpec((16,), 13, "symbols")


def test_symbols_need_no_codebook_whatever_is_configured():
    tokenizer = make_tokenizer(TokenizerConfig(), SPEC)
    assert isinstance(tokenizer, SymbolTokenizer)
    assert (tokenizer.tokens_per_frame, tokenizer.num_codes, tokenizer.grid) == (16, 14, (1, 16))
    state = tokenizer.init(jax.random.key(0))
    assert not jax.tree.leaves(state) and tokenizer.valid_codes(state).all()


def test_round_trip():
    tokenizer = SymbolTokenizer(SPEC)
    observation = jnp.asarray(np.random.default_rng(0).integers(0, 14, (3, 5, 16)), jnp.uint8)
    tokens = tokenizer.encode({}, observation)
    assert tokens.dtype == jnp.int32 and tokens.shape == (3, 5, 16)
    back = tokenizer.decode({}, tokens)
    assert back.dtype == jnp.uint8
    np.testing.assert_array_equal(back, observation)
    assert tokenizer.update({}, observation.reshape(-1, 16)) == ({}, {})
