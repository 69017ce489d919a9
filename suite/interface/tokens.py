"""Contract 3: tokens. Every observation becomes L tokens out of K; the world model sees nothing else."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from suite.interface.environment import nearest_level
from suite.interface.turns import Turn
from suite.runtime import layout

TokenizerState = Any  # A tokenizer's own pytree of arrays: parameters, codebook, optimizer.


@dataclasses.dataclass(frozen=True)
class TokenSpec:
    """The vocabulary of one token stream, and what is predicted of it.

    Attributes:
      tokens_per_frame: L; in a game both players' observations, player 1's first.
      num_codes: K; 0 where tokens are no codes.
      num_actions: of the stream; in a game those of both players and chance, see `turns.stream_action`.
      reward_classes: ascending reward levels; see `EnvironmentSpec.reward_classes`.
      placed: a code means something else at each of the L places, and is embedded so.
      player_actions: A of a two-player game, whose turns are predicted too; 0 for single-agent tasks.
      chance_outcomes: C of a two-player game.
      token_size: numbers in a token that is no code but a vector; 0: tokens are codes.
      spatial: tokens are patches of a picture, whose neighbours in the grid are neighbours in what is shown.
      content_size: P, numbers in what a code stands for (`Tokenizer.contents`); 0: nothing is known of it.
    """

    tokens_per_frame: int
    num_codes: int
    num_actions: int
    reward_classes: tuple[float, ...]
    placed: bool = False
    player_actions: int = 0
    chance_outcomes: int = 0
    token_size: int = 0
    spatial: bool = True
    content_size: int = 0

    @property
    def two_player(self) -> bool:
        """Whether the stream is a game's."""
        return self.player_actions > 0

    def reward_to_class(self, reward: jax.Array) -> jax.Array:
        """int32 index of the level nearest to each reward, ties to the higher level (fidelity note 22)."""
        return nearest_level(self.reward_classes, reward)

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
        """K; 0 where tokens are vectors."""

    @property
    def token_size(self) -> int:
        """Numbers in a token that is a vector; 0: tokens are codes."""

    @property
    def grid(self) -> tuple[int, int]:
        """(rows, columns) of tokens in a frame."""

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the scalars that `update` returns."""

    def init(self, key: jax.Array) -> TokenizerState:
        """A fresh state."""

    def update(self, state: TokenizerState, observation_NO: jax.Array) -> tuple[TokenizerState, dict[str, jax.Array]]:
        """Learns from one batch of N observations; returns the new state and scalar metrics."""

    def encode(self, state: TokenizerState, observation: jax.Array) -> jax.Array:
        """int32 tokens [..., L], or float32 vectors [..., L, P], of observations [..., O]."""

    def decode(self, state: TokenizerState, tokens: jax.Array) -> jax.Array:
        """uint8 observations [..., O] of tokens [..., L] or [..., L, P]."""

    def valid_codes(self, state: TokenizerState) -> jax.Array:
        """Bool [K]: codes that have a meaning; the others must never be sampled."""

    def contents(self, state: TokenizerState) -> jax.Array:
        """float32 [K, P]: what each code stands for, in numbers from 0 to 1; P = 0 where codes are only names."""


def encode_frame(
    tokenizer: Tokenizer, state: TokenizerState, observation: jax.Array, turn: Turn | None, axis: int = 0
) -> jax.Array:
    """int32 tokens [..., L] of a frame: the observation's; in a game player 1's observation, then player 2's.

    `axis` is the batch's among the leading ones: every device encodes its own part of it.
    """
    encode = layout.per_device(tokenizer.encode, (None, axis), axis)
    ours = encode(state, observation)
    if turn is None:
        return ours
    theirs = encode(state, turn.opponent_observation)
    first = (turn.seat == 1)[..., None]
    return jnp.concatenate([jnp.where(first, ours, theirs), jnp.where(first, theirs, ours)], axis=-1)


def decode_frame(
    tokenizer: Tokenizer, state: TokenizerState, tokens: jax.Array, seat: jax.Array | None
) -> tuple[jax.Array, jax.Array | None]:
    """The inverse: our observation and, where there is a seat (int32 [...], ours), the other player's.

    The batch is the first of the leading axes.
    """
    decode = layout.per_device(tokenizer.decode, (None, 0), 0)
    if seat is None:
        return decode(state, tokens), None
    first, second = jnp.split(tokens, 2, axis=-1)
    ours_first = (seat == 1)[..., None]
    ours, theirs = jnp.where(ours_first, first, second), jnp.where(ours_first, second, first)
    return decode(state, ours), decode(state, theirs)
