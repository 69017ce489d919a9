"""Contract 3: tokens. Every observation becomes L tokens out of K; the world model sees nothing else."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import jax
import jax.numpy as jnp

TokenizerState = Any  # A tokenizer's own pytree of arrays: parameters, codebook, optimizer.


@dataclasses.dataclass(frozen=True)
class TokenSpec:
    """The vocabulary of one token stream: L tokens per frame out of K codes, A actions, the reward classes.

    `reward_classes` are ascending reward levels; see `EnvironmentSpec.reward_classes`.
    """

    tokens_per_frame: int
    num_codes: int
    num_actions: int
    reward_classes: tuple[float, ...]

    def reward_to_class(self, reward: jax.Array) -> jax.Array:
        """int32 index of the level nearest to each reward, ties to the higher level (fidelity note 22)."""
        levels = jnp.asarray(self.reward_classes, jnp.float32)
        boundaries = (levels[1:] + levels[:-1]) / 2
        return jnp.searchsorted(boundaries, reward, side="right").astype(jnp.int32)

    def class_to_reward(self, index: jax.Array) -> jax.Array:
        """float32 reward level of each class index."""
        return jnp.asarray(self.reward_classes, jnp.float32)[index]


class Tokenizer(Protocol):
    """Turns observations into tokens and back. Pure: its state is a pytree that callers carry.

    `...` stands for any leading axes (batch, time); O for an observation's own axes (uint8).
    """

    @property
    def tokens_per_frame(self) -> int:
        """L."""

    @property
    def num_codes(self) -> int:
        """K."""

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the scalars that `update` returns."""

    def init(self, key: jax.Array) -> TokenizerState:
        """A fresh state."""

    def update(self, state: TokenizerState, observation_NO: jax.Array) -> tuple[TokenizerState, dict[str, jax.Array]]:
        """Learns from one batch of N observations; returns the new state and scalar metrics."""

    def encode(self, state: TokenizerState, observation: jax.Array) -> jax.Array:
        """int32 tokens [..., L] of observations [..., O]."""

    def decode(self, state: TokenizerState, tokens: jax.Array) -> jax.Array:
        """uint8 observations [..., O] of tokens [..., L]."""

    def valid_codes(self, state: TokenizerState) -> jax.Array:
        """Bool [K]: codes that have a meaning; the others must never be sampled."""
