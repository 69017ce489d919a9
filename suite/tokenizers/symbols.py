"""The tokenizer of symbolic observations: every symbol is a token already (Section 4.7)."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from suite.interface.environment import ObservationSpec


@dataclasses.dataclass(frozen=True)
class SymbolTokenizer:
    """The identity: token i is symbol i, and its code is the symbol's value. Learns nothing; its state is empty.

    See `suite.interface.tokens.Tokenizer`.
    """

    observation: ObservationSpec

    @property
    def tokens_per_frame(self) -> int:
        """L, the number of symbols."""
        return self.observation.shape[0]

    @property
    def num_codes(self) -> int:
        """K, the number of values that a symbol may have."""
        return self.observation.high + 1

    @property
    def token_size(self) -> int:
        """0: tokens are codes."""
        return 0

    @property
    def grid(self) -> tuple[int, int]:
        """Symbols have no rows: (1, L)."""
        return (1, self.tokens_per_frame)

    @property
    def metrics(self) -> tuple[str, ...]:
        """None: there is nothing to learn."""
        return ()

    def init(self, key: jax.Array) -> dict[str, jax.Array]:
        """An empty state."""
        del key
        return {}

    def update(
        self, state: dict[str, jax.Array], observation_NO: jax.Array
    ) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
        """The same state."""
        del observation_NO
        return state, {}

    def encode(self, state: dict[str, jax.Array], observation: jax.Array) -> jax.Array:
        """int32 tokens [..., L]."""
        del state
        return observation.astype(jnp.int32)

    def decode(self, state: dict[str, jax.Array], tokens: jax.Array) -> jax.Array:
        """uint8 observations [..., L]."""
        del state
        return tokens.astype(jnp.uint8)

    def valid_codes(self, state: dict[str, jax.Array]) -> jax.Array:
        """Bool [K]: all."""
        del state
        return jnp.ones(self.num_codes, bool)

    def contents(self, state: dict[str, jax.Array]) -> jax.Array:
        """P = 0: the value of a symbol is its name."""
        del state
        return jnp.zeros((self.num_codes, 0), jnp.float32)
