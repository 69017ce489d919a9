"""Block teacher forcing, or token by token: how the probability of the next frame is written as a product.

This is the paper's main idea (Section 3.6), and a configuration chooses between its two sides:

- `BlockParallel` is block teacher forcing (M5, Equation 3). The tokens of frame t+1 are independent, given all frames
  up to t and the action a_t. A token sees its whole own block, and the output at q_t^i predicts q_{t+1}^i. So one pass
  imagines a frame, and the correspondence head can copy tokens of the frame before.
- `TokenByToken` is the order of a language model (M1 to M4). A token of frame t+1 is given those before it in its own
  frame, too. A token sees itself and what came before; the output at q_t^i predicts q_t^{i+1}, and that at a_t predicts
  q_{t+1}^1. A frame is imagined in L passes.

Shapes: B streams, T time steps, L tokens per frame, S = L + 1 tokens per block, D width, K codes.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from suite.nn.sampling import draw
from suite.world_model.heads import filled_odds
from suite.world_model.history import History
from suite.world_model.sequences import Sequences

Cache = Any  # A model's own pytree of arrays: what it remembers of the blocks before.


class Predictor(Protocol):
    """What sampling asks of a world model (`suite.world_model.transformer.WorldModel`, where it is explained)."""

    block: int
    token_size: int

    def observation_logits(self, hidden: jax.Array) -> jax.Array: ...

    def code_logits(self, hidden: jax.Array) -> jax.Array: ...

    def token_odds(self, hidden_BSD: jax.Array, tokens_BL: jax.Array, valid_K: jax.Array) -> jax.Array: ...

    def append_token(self, cache: Cache, token_B: jax.Array, place: jax.Array) -> tuple[Cache, jax.Array]: ...


@struct.dataclass
class Lesson:
    """What one pass over replayed sequences of T steps reads, and what it must predict; F frames, T or T + 1.

    Attributes:
      frame_BFL: tokens that are read, int32 [B, F, L] (or float32 vectors [B, F, L, P]).
      action_BF: int32; actions that are read.
      target_BFL: the tokens that the observation logits are of.
      before_BFL: what stood at a target's place one frame earlier: where it differs, the token has changed.
      weight_BFL: float32, 0 or 1; whether a target counts.
      history_BF: of the frames that are read, for a model that is told something; else None.
    """

    frame_BFL: jax.Array
    action_BF: jax.Array
    target_BFL: jax.Array
    before_BFL: jax.Array
    weight_BFL: jax.Array
    history_BF: History | None = None


class Factorization(Protocol):
    """What the world model, its training and its dreams ask of either side."""

    def unit(self, block: int) -> int:
        """How many tokens see one another, of the `block` tokens of a time step."""

    def blocks(self, steps: int) -> int:
        """How many blocks a cache needs for `steps` time steps and for imagining the frame that the last leads to."""

    def predicting(self, hidden: jax.Array) -> jax.Array:
        """The hidden states [..., L, D] that predict tokens, of a block's [..., S, D]."""

    def targets(self, frame: jax.Array, following: jax.Array) -> jax.Array:
        """What those predict, [..., L], of two frames' tokens, or of any other array of one entry a token."""

    def lesson(self, sequences: Sequences, token_weight_BT: jax.Array) -> Lesson:
        """What to read of replayed sequences, and what to predict.

        Args:
          sequences: T steps and T + 1 frames.
          token_weight_BT: float32; whether the frame that a step leads to counts.
        """

    def sample(
        self,
        key: jax.Array,
        model: Predictor,
        cache: Cache,
        hidden_BSD: jax.Array,
        tokens_BL: jax.Array,
        valid_K: jax.Array,
        min_p: float,
    ) -> jax.Array:
        """The next frame's tokens [B, L].

        Args:
          key: of the draws.
          model: the world model.
          cache: with the present frame and its action.
          hidden_BSD: their hidden states.
          tokens_BL: the present frame's tokens.
          valid_K: bool; codes that may be drawn.
          min_p: codes less likely than this share of the likeliest are not drawn.
        """


@dataclasses.dataclass(frozen=True)
class BlockParallel:
    """Block teacher forcing (Section 3.6): all tokens of the next frame are independent, given what came before."""

    def unit(self, block: int) -> int:
        return block

    def blocks(self, steps: int) -> int:
        return steps

    def predicting(self, hidden: jax.Array) -> jax.Array:
        return hidden[..., :-1, :]

    def targets(self, frame: jax.Array, following: jax.Array) -> jax.Array:
        del frame
        return following

    def lesson(self, sequences: Sequences, token_weight_BT: jax.Array) -> Lesson:
        frame, following = sequences.tokens_BTL[:, :-1], sequences.tokens_BTL[:, 1:]
        return Lesson(
            frame_BFL=frame,
            action_BF=sequences.action_BT,
            target_BFL=self.targets(frame, following),
            before_BFL=frame,
            weight_BFL=jnp.broadcast_to(token_weight_BT[..., None], frame.shape[:3]),
            history_BF=sequences.history_BT,
        )

    def sample(
        self,
        key: jax.Array,
        model: Predictor,
        cache: Cache,
        hidden_BSD: jax.Array,
        tokens_BL: jax.Array,
        valid_K: jax.Array,
        min_p: float,
    ) -> jax.Array:
        del cache
        if model.token_size:
            return jnp.clip(model.observation_logits(hidden_BSD), 0, 1)  # a regression's only guess
        return draw(key, model.token_odds(hidden_BSD, tokens_BL, valid_K), min_p)


@dataclasses.dataclass(frozen=True)
class TokenByToken:
    """The usual order of a language model (Equation 2, fidelity notes 18 and 19): each token is given those before."""

    def unit(self, block: int) -> int:
        del block
        return 1

    def blocks(self, steps: int) -> int:
        return steps + 1

    def predicting(self, hidden: jax.Array) -> jax.Array:
        return jnp.concatenate([hidden[..., :-2, :], hidden[..., -1:, :]], axis=-2)

    def targets(self, frame: jax.Array, following: jax.Array) -> jax.Array:
        return jnp.concatenate([frame[..., 1:], following[..., :1]], axis=-1)

    def lesson(self, sequences: Sequences, token_weight_BT: jax.Array) -> Lesson:
        # All tokens of the last frame are predicted, for a dream needs them: the model reads it too, with an action
        # that predicts nothing and that nothing sees.
        whole, following = sequences.tokens_BTL, sequences.tokens_BTL[:, 1:]
        behind = jnp.concatenate([following, whole[:, -1:]], axis=1)
        frame_weight_BT = jnp.concatenate([jnp.ones_like(token_weight_BT[:, :1]), token_weight_BT], axis=1)
        next_weight_BT = jnp.pad(token_weight_BT, ((0, 0), (0, 1)))
        return Lesson(
            frame_BFL=whole,
            action_BF=jnp.pad(sequences.action_BT, ((0, 0), (0, 1))),
            target_BFL=self.targets(whole, behind),
            # Changed is what differs from the frame before; the first has none.
            before_BFL=self.targets(jnp.concatenate([whole[:, :1], whole[:, :-1]], axis=1), whole),
            weight_BFL=self.targets(
                *(jnp.broadcast_to(weight[..., None], whole.shape) for weight in (frame_weight_BT, next_weight_BT))
            ),
        )

    def sample(
        self,
        key: jax.Array,
        model: Predictor,
        cache: Cache,
        hidden_BSD: jax.Array,
        tokens_BL: jax.Array,
        valid_K: jax.Array,
        min_p: float,
    ) -> jax.Array:
        del tokens_BL, min_p
        return sample_one_by_one(key, model, cache, hidden_BSD[:, -1], valid_K)[0]


def factorization(block_teacher_forcing: bool) -> Factorization:
    """Which of the two a configuration asks for."""
    return BlockParallel() if block_teacher_forcing else TokenByToken()


def sample_one_by_one(
    key: jax.Array, model: Predictor, cache: Cache, action_hidden_BD: jax.Array, valid_K: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The next frame's tokens, int32 [B, L], each given those before it, and their log-probabilities [B, L] (Eq. 2).

    The tokens enter a copy of the cache: `model.step` appends them again with the next action, all at once.
    """

    def sample(key: jax.Array, hidden_BD: jax.Array) -> tuple[jax.Array, jax.Array]:
        logits_BK = model.code_logits(hidden_BD)
        token_B1 = draw(key, filled_odds(logits_BK[:, None], valid_K))
        log_BK = jax.nn.log_softmax(jnp.where(valid_K[None], logits_BK, -jnp.inf))
        return token_B1[:, 0], jnp.take_along_axis(log_BK, token_B1, axis=1)[:, 0]

    def following(carry: tuple[Cache, jax.Array], inputs: tuple[jax.Array, jax.Array]) -> Any:
        (cache, token_B), (key, place) = carry, inputs
        cache, hidden_BD = model.append_token(cache, token_B, place)
        token_B, log_probability_B = sample(key, hidden_BD)
        return (cache, token_B), (token_B, log_probability_B)

    first_key, *_ = keys = jax.random.split(key, model.block - 1)
    first_B, first_log_B = sample(first_key, action_hidden_BD)
    _, (token_LB, log_LB) = jax.lax.scan(following, (cache, first_B), (keys[1:], jnp.arange(model.block - 2)))
    token_BL = jnp.concatenate([first_B[None], token_LB]).swapaxes(0, 1)
    return token_BL, jnp.concatenate([first_log_B[None], log_LB]).swapaxes(0, 1)
