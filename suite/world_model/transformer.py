"""The transformer world model: a GPT-2 over a stream of blocks [q_1 .. q_L, a] (Section 3.6, Appendix A.2.2).

With block teacher forcing the output at q_t^i predicts q_{t+1}^i; the output at a_t predicts reward and termination,
and in a two-player game who is next, what is then legal, and the probabilities of chance (Section 4.7, Appendix G).
Shapes: B streams, T time steps, L tokens per frame, S = L + 1 tokens per block, D width, N heads, H = D / N.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx, struct
from jax.typing import DTypeLike

from suite.config import WorldModelConfig
from suite.interface.tokens import TokenSpec
from suite.world_model.attention import block_causal_attention, block_positions, cached_attention, rope
from suite.world_model.dropout import dropout
from suite.world_model.heads import Head, TurnHead, TurnLogits

TERMINATION_CLASSES = 2


@struct.dataclass
class Cache:
    """Keys and values of the blocks seen so far.

    Attributes:
      keys, values: [layers, B, N, length * S, H]; keys are rotated already.
      index: int32 scalar; blocks filled. `length` steps fit; a further one would overwrite the last.
    """

    keys: jax.Array
    values: jax.Array
    index: jax.Array


class Block(nnx.Module):
    """One pre-norm GPT-2 layer: attention and a 4x GELU network, each added to the residual stream (float32)."""

    def __init__(self, config: WorldModelConfig, dtype: DTypeLike, rngs: nnx.Rngs):
        width = config.embed_dim

        def dense(inputs: int, outputs: int) -> nnx.Linear:
            return nnx.Linear(
                inputs, outputs, dtype=dtype, kernel_init=nnx.initializers.normal(config.initial_std), rngs=rngs
            )

        self.heads, self.rate = config.heads, config.dropout
        self.attention_norm = layer_norm(width, rngs)
        self.query_key_value = dense(width, 3 * width)
        self.projection = dense(width, width)
        self.mlp_norm = layer_norm(width, rngs)
        self.expand = dense(width, 4 * width)
        self.contract = dense(4 * width, width)

    def attention_inputs(self, x: jax.Array) -> list[jax.Array]:
        """Queries, keys and values [B, S, N, H] of the stream [B, S, D]."""
        mixed = self.query_key_value(self.attention_norm(x))
        return [part.reshape(*x.shape[:-1], self.heads, -1) for part in jnp.split(mixed, 3, axis=-1)]

    def add(self, x: jax.Array, attended: jax.Array, dropout_key: jax.Array | None) -> jax.Array:
        """The stream [B, S, D] after the attention's result [B, S, N, H] and the MLP are added to it."""
        attention_key, mlp_key = _split(dropout_key, 2)
        update = self.projection(attended.reshape(x.shape)).astype(x.dtype)
        x = x + dropout(update, self.rate, attention_key)
        update = self.contract(nnx.gelu(self.expand(self.mlp_norm(x)))).astype(x.dtype)
        return x + dropout(update, self.rate, mlp_key)


def _stacked_layers(config: WorldModelConfig, dtype: DTypeLike, rngs: nnx.Rngs) -> Block:
    """All layers as one `Block` whose parameters lead with the layer: scanned over, unrolled in training."""

    @nnx.split_rngs(splits=config.layers)
    @nnx.vmap
    def create(rngs: nnx.Rngs) -> Block:
        return Block(config, dtype, rngs)

    return create(rngs)


class WorldModel(nnx.Module):
    """Predicts the next frame's tokens, the reward's class and termination from tokens and actions.

    Attributes:
      block: S, tokens per time step (the frame's L and the action).
      dtype: of the matrix products and the cache; parameters, norms, softmax, residuals and logits are float32.
    """

    def __init__(self, config: WorldModelConfig, tokens: TokenSpec, grid: tuple[int, int] | None, rngs: nnx.Rngs):
        width = config.embed_dim
        self.config, self.grid = config, grid
        self.block = tokens.tokens_per_frame + 1
        self.dtype = jnp.bfloat16 if config.compute_type == "bfloat16" else jnp.float32
        self.codes_per_place = tokens.num_codes if tokens.placed else 0
        codes = tokens.num_codes * (tokens.tokens_per_frame if tokens.placed else 1)
        init = nnx.initializers.normal(config.initial_std)
        self.token_embedding = nnx.Embed(codes, width, embedding_init=init, rngs=rngs)
        self.action_embedding = nnx.Embed(tokens.num_actions, width, embedding_init=init, rngs=rngs)
        self.layers = _stacked_layers(config, self.dtype, rngs)
        self.norm = layer_norm(width, rngs)
        self.observation_head = Head(config, tokens.num_codes, self.dtype, rngs)
        self.seats = 2 if tokens.two_player else 1
        self.reward_head = Head(config, self.seats * len(tokens.reward_classes), self.dtype, rngs)
        self.termination_head = Head(config, TERMINATION_CLASSES, self.dtype, rngs)
        self.turn_head = TurnHead(config, tokens, self.dtype, rngs) if tokens.two_player else None

    def __call__(self, tokens_BTL: jax.Array, action_BT: jax.Array, dropout_key: jax.Array | None = None) -> jax.Array:
        """Hidden states [B, T, S, D] (float32) of whole sequences; without `dropout_key` nothing is dropped."""
        batch, steps = action_BT.shape
        rate = self.config.dropout
        embedding_key, layer_key = _split(dropout_key, 2)
        x = self._embed(tokens_BTL, action_BT).reshape(batch, steps * self.block, -1)
        position_SA = block_positions(self.config.positions, jnp.arange(steps), self.block, self.grid)
        graphdef, layers = nnx.split(self.layers)

        def run_layer(x: jax.Array, inputs: tuple[nnx.State, jax.Array]) -> tuple[jax.Array, None]:
            params, index = inputs
            layer = nnx.merge(graphdef, params)
            key = None if layer_key is None else jax.random.fold_in(layer_key, index)
            attention_key, residual_key = _split(key, 2)
            query, key_, value = layer.attention_inputs(x)
            attended = block_causal_attention(
                rope(query, position_SA),
                rope(key_, position_SA),
                value,
                block=self.block,
                dropout_rate=rate,
                dropout_key=attention_key,
            )
            return layer.add(x, attended, residual_key), None

        indices = jnp.arange(self.config.layers)
        # Unrolled: on a CPU, moving what the backward pass needs in and out of a loop costs a seventh of the update.
        x, _ = jax.lax.scan(run_layer, dropout(x, rate, embedding_key), (layers, indices), unroll=True)
        return self.norm(x).reshape(batch, steps, self.block, -1)

    def observation_logits(self, hidden: jax.Array) -> jax.Array:
        """float32 [B, T, L, K]: of q_{t+1} at each q_t, from hidden states [B, T, S, D] (or without the T axis)."""
        return self.observation_head(hidden[..., :-1, :])

    def reward_logits(self, hidden: jax.Array, seat: jax.Array | None = None) -> jax.Array:
        """float32 [B, T, R]: of the reward's class, from hidden states [B, T, S, D] (or without the T axis).

        In a game, of the reward of player `seat` (int32 [B, T]): the stream itself does not say which of them is ours.
        """
        logits = self.reward_head(hidden[..., -1, :])
        if seat is None:
            return logits
        first, second = jnp.split(logits, self.seats, axis=-1)
        return jnp.where((seat == 1)[..., None], first, second)

    def termination_logits(self, hidden: jax.Array) -> jax.Array:
        """float32 [B, T, 2]: (goes on, terminated), from hidden states [B, T, S, D] (or without the T axis)."""
        return self.termination_head(hidden[..., -1, :])

    def turn_logits(self, hidden: jax.Array) -> TurnLogits:
        """Of a game's next turn, from hidden states [B, T, S, D] (or without the T axis)."""
        assert self.turn_head is not None
        return self.turn_head(hidden[..., -1, :])

    def init_cache(self, batch: int, length: int) -> Cache:
        """An empty cache for `length` steps of `batch` streams."""
        heads, width = self.config.heads, self.config.embed_dim
        shape = (self.config.layers, batch, heads, length * self.block, width // heads)
        return Cache(jnp.zeros(shape, self.dtype), jnp.zeros(shape, self.dtype), jnp.int32(0))

    def step(self, cache: Cache, tokens_BL: jax.Array, action_B: jax.Array) -> tuple[Cache, jax.Array]:
        """Appends one block to the cache; its hidden states [B, S, D] equal those of the whole sequence's pass."""
        x = self._embed(tokens_BL, action_B)
        start = cache.index * self.block
        position_SA = block_positions(self.config.positions, cache.index[None], self.block, self.grid)
        graphdef, layers = nnx.split(self.layers)

        def append(cached: jax.Array, new_BSNH: jax.Array, index: jax.Array) -> jax.Array:
            return jax.lax.dynamic_update_slice(cached, new_BSNH.swapaxes(1, 2)[None], (index, 0, 0, start, 0))

        # The cache is carried, not stacked anew by the scan: one block of it is written, in place.
        def run_layer(carry: Any, inputs: tuple[nnx.State, jax.Array]) -> tuple[Any, None]:
            (x, keys, values), (params, index) = carry, inputs
            layer = nnx.merge(graphdef, params)
            query, key, value = layer.attention_inputs(x)
            keys, values = append(keys, rope(key, position_SA), index), append(values, value, index)
            attended = cached_attention(rope(query, position_SA), keys[index], values[index], start + self.block)
            return (layer.add(x, attended, None), keys, values), None

        carry = (x, cache.keys, cache.values)
        (x, keys, values), _ = jax.lax.scan(run_layer, carry, (layers, jnp.arange(self.config.layers)))
        return Cache(keys, values, cache.index + 1), self.norm(x)

    def _embed(self, tokens: jax.Array, action: jax.Array) -> jax.Array:
        if self.codes_per_place:
            places = self.codes_per_place * jnp.arange(tokens.shape[-1])
            tokens = tokens + places.reshape((1,) * (tokens.ndim - 1) + (-1,))
        return jnp.concatenate([self.token_embedding(tokens), self.action_embedding(action)[..., None, :]], axis=-2)


def layer_norm(width: int, rngs: nnx.Rngs) -> nnx.LayerNorm:
    """GPT-2's, in float32 whatever it is given."""
    return nnx.LayerNorm(width, epsilon=1e-5, dtype=jnp.float32, rngs=rngs)


def _split(key: jax.Array | None, parts: int) -> list[jax.Array | None]:
    """`jax.random.split` that passes None on."""
    return [None] * parts if key is None else list(jax.random.split(key, parts))
