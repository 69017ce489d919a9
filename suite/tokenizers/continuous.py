"""Patches that are not quantized: the ablation in which the world model regresses them (Section 4.3)."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp

from suite.interface.environment import ObservationSpec
from suite.tokenizers.patches import join_patches, patch_grid, split_patches


@dataclasses.dataclass(frozen=True)
class ContinuousTokenizer:
    """A token is its patch: h*w*C numbers in [0, 1]. Learns nothing; its state is empty.

    See `suite.interface.tokens.Tokenizer`.
    """

    observation: ObservationSpec
    patch: tuple[int, int]

    @property
    def grid(self) -> tuple[int, int]:
        """(rows, columns) of patches in a frame."""
        return patch_grid(self.observation.shape, self.patch)

    @property
    def tokens_per_frame(self) -> int:
        """L."""
        return math.prod(self.grid)

    @property
    def num_codes(self) -> int:
        """0: there are no codes."""
        return 0

    @property
    def token_size(self) -> int:
        """P, the numbers of a patch."""
        return math.prod(self.patch) * self.observation.shape[-1]

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
        """float32 vectors [..., L, P] in [0, 1]."""
        del state
        return split_patches(observation, self.patch).astype(jnp.float32) / self.observation.high

    def decode(self, state: dict[str, jax.Array], tokens: jax.Array) -> jax.Array:
        """uint8 [..., H, W, C], of the nearest levels."""
        del state
        pixels = jnp.round(jnp.clip(tokens, 0, 1) * self.observation.high).astype(jnp.uint8)
        return join_patches(pixels, self.observation.shape, self.patch)

    def valid_codes(self, state: dict[str, jax.Array]) -> jax.Array:
        """Bool [0]."""
        del state
        return jnp.ones(0, bool)

    def contents(self, state: dict[str, jax.Array]) -> jax.Array:
        """[0, 0]: there are no codes."""
        del state
        return jnp.zeros((0, 0), jnp.float32)
