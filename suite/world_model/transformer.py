"""The transformer world model: a GPT-2 over a stream of blocks [q_1 .. q_L, a] (Section 3.6, Appendix A.2.2).

Which tokens see one another, and what the output at each of them predicts, is decided by
`suite.world_model.block_teacher_forcing`: block teacher forcing, or token by token. The output at a_t predicts reward
and termination, and in a two-player game who is next, what is then legal, and the probabilities of chance (Section 4.7,
Appendix G).
Shapes: B streams, T time steps, L tokens per frame, S = L + 1 tokens per block, D width, N heads, H = D / N. Where
tokens are no codes but vectors (`TokenSpec.token_size`), arrays of them have a further last axis.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx, struct
from jax.typing import DTypeLike

from suite.configuration.schema import WorldModelConfig
from suite.interface.tokens import TokenSpec
from suite.nn.dropout import dropout
from suite.world_model.attention import cached_attention, causal_attention, held_tokens, rope, token_positions
from suite.world_model.block_teacher_forcing import factorization
from suite.world_model.correspondence import OUTSIDE, inside, mixture_odds, neighbourhood
from suite.world_model.heads import Head, PlaceHead, SymbolsHead, TurnHead, TurnLogits, filled_odds
from suite.world_model.history import History

TERMINATION_CLASSES = 2


@struct.dataclass
class Cache:
    """Keys and values of the latest tokens.

    Attributes:
      keys, values: [layers, B, N, slots, H]; keys are rotated already. Token n stands in slot n modulo their number,
        so that a block for which there is no room takes the place of the oldest.
      index: int32 scalar; tokens seen so far.
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
        """Queries, keys and values [..., N, H] of the stream [..., D]."""
        mixed = self.query_key_value(self.attention_norm(x))
        return [part.reshape(*x.shape[:-1], self.heads, -1) for part in jnp.split(mixed, 3, axis=-1)]

    def add(self, x: jax.Array, attended: jax.Array, dropout_key: jax.Array | None) -> jax.Array:
        """The stream [..., D] after the attention's result [..., N, H] and the MLP are added to it."""
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


class Contents(nnx.Variable):
    """What each code stands for (`Tokenizer.contents`): given by the tokenizer, not learned."""


class WorldModel(nnx.Module):
    """Predicts the next frame's tokens, the reward's class and termination from tokens and actions.

    Attributes:
      block: S, tokens per time step (the frame's L and the action).
      factorization: how the next frame's probability is written as a product.
      unit: tokens that see one another: a block, or a token.
      dtype: of the matrix products and the cache; parameters, norms, softmax, residuals and logits are float32.
    """

    def __init__(self, config: WorldModelConfig, tokens: TokenSpec, grid: tuple[int, int] | None, rngs: nnx.Rngs):
        width = config.embed_dim
        self.config, self.grid = config, grid
        self.block = tokens.tokens_per_frame + 1
        self.factorization = factorization(config.block_teacher_forcing)
        self.unit = self.factorization.unit(self.block)
        self._attend: Callable[..., jax.Array] = functools.partial(causal_attention, block=self.block)
        if config.attention == "fused":  # only then is Pallas needed
            from suite.nn.fused_attention import fused_attention

            self._attend = fused_attention
        self.dtype = jnp.bfloat16 if config.compute_type == "bfloat16" else jnp.float32
        self.codes_per_place = tokens.num_codes if tokens.placed else 0
        codes = tokens.num_codes * (tokens.tokens_per_frame if tokens.placed else 1)
        init = nnx.initializers.normal(config.initial_std)
        self.token_size = tokens.token_size
        self.token_embedding: nnx.Embed | nnx.Linear = (
            nnx.Linear(tokens.token_size, width, dtype=self.dtype, kernel_init=init, rngs=rngs)
            if tokens.token_size
            else nnx.Embed(codes, width, embedding_init=init, rngs=rngs)
        )
        self.action_embedding = nnx.Embed(tokens.num_actions, width, embedding_init=init, rngs=rngs)
        self.layers = _stacked_layers(config, self.dtype, rngs)
        self.norm = layer_norm(width, rngs)
        self.observation_head = Head(config, tokens.token_size or tokens.num_codes, self.dtype, rngs)
        self.seats = 2 if tokens.two_player else 1
        rewards = self.seats * len(tokens.reward_classes)
        self.reward_head = Head(config, rewards, self.dtype, rngs)
        self.termination_head = Head(config, TERMINATION_CLASSES, self.dtype, rngs)
        self.turn_head = TurnHead(config, tokens, self.dtype, rngs) if tokens.two_player else None
        # What is not the paper's comes last, so that the rest is initialised as without it.
        self.radius = config.correspondence_radius if tokens.spatial else 0
        sources = (2 * self.radius + 1) ** 2
        self.gate_head = Head(config, 1 + sources, self.dtype, rngs) if config.correspondence else None
        local = config.local_embedding if tokens.spatial else 0  # neighbours in a list of symbols mean nothing
        self.local_embedding = nnx.Embed(codes, local, embedding_init=init, rngs=rngs) if local else None
        self.local_mix = nnx.Linear(9 * local, width, dtype=self.dtype, kernel_init=init, rngs=rngs) if local else None
        self.token_action_embedding = (
            nnx.Embed(tokens.num_actions, width, embedding_init=init, rngs=rngs) if config.action_in_tokens else None
        )
        self.reward_places = _place_head(config, tokens, rewards, self.dtype, rngs)
        self.termination_places = _place_head(config, tokens, TERMINATION_CLASSES, self.dtype, rngs)
        self.ages = config.ages if tokens.spatial else 0
        self.age_embedding = nnx.Embed(self.ages + 1, width, embedding_init=init, rngs=rngs) if self.ages else None
        # Of what the episode has paid: all of it, and what it has paid for the action that is taken now.
        paid = config.paid if tokens.spatial else 0
        self.paid_embedding = (
            nnx.Linear(tokens.num_actions, width, use_bias=False, dtype=self.dtype, kernel_init=init, rngs=rngs)
            if paid
            else None
        )
        self.again_embedding = nnx.Embed(paid + 1, width, embedding_init=init, rngs=rngs) if paid else None
        # What codes stand for, and what embeddings and logits make of it: nothing before training.
        content = tokens.content_size if config.patch_contents else 0
        self.contents = Contents(jnp.zeros((codes, content), jnp.float32)) if content else None

        def reading(numbers: int) -> nnx.Param | None:
            return nnx.Param(jnp.zeros((content, numbers), jnp.float32)) if content and numbers else None

        self.content_embedding, self.content_local, self.content_logits = map(reading, (width, local, width))

    def __call__(
        self,
        tokens_BTL: jax.Array,
        action_BT: jax.Array,
        dropout_key: jax.Array | None = None,
        history_BT: History | None = None,
    ) -> jax.Array:
        """Hidden states [B, T, S, D] (float32) of whole sequences; without `dropout_key` nothing is dropped.

        Here and below, the history is for a model that is told something of it.
        """
        batch, steps = action_BT.shape
        rate = self.config.dropout
        embedding_key, layer_key = _split(dropout_key, 2)
        # All tokens along one axis: on a CPU, a bias's gradient, a sum over two axes, takes several times as long.
        x = self.embed(tokens_BTL, action_BT, history_BT).reshape(batch * steps * self.block, -1)
        position_SA = self._positions(jnp.arange(steps * self.block))
        graphdef, layers = nnx.split(self.layers)

        def run_layer(x: jax.Array, inputs: tuple[nnx.State, jax.Array]) -> tuple[jax.Array, None]:
            params, index = inputs
            layer = nnx.merge(graphdef, params)
            key = None if layer_key is None else jax.random.fold_in(layer_key, index)
            attention_key, residual_key = _split(key, 2)
            query, key_, value = (y.reshape(batch, -1, *y.shape[1:]) for y in layer.attention_inputs(x))
            attended = self._attend(
                rope(query, position_SA),
                rope(key_, position_SA),
                value,
                unit=self.unit,
                dropout_rate=rate,
                dropout_key=attention_key,
            )
            return layer.add(x, attended, residual_key), None

        indices = jnp.arange(self.config.layers)
        # Unrolled: on a CPU, moving what the backward pass needs in and out of a loop costs a seventh of the update.
        x, _ = jax.lax.scan(run_layer, dropout(x, rate, embedding_key), (layers, indices), unroll=True)
        return self.norm(x).reshape(batch, steps, self.block, -1)

    def observation_logits(self, hidden: jax.Array) -> jax.Array:
        """float32 [B, T, L, K]: of `factorization.targets`, from hidden states [B, T, S, D] (or without the T axis).

        Where tokens are vectors these are the predicted tokens themselves, K numbers each.
        """
        return self.code_logits(self.factorization.predicting(hidden))

    def code_logits(self, hidden: jax.Array) -> jax.Array:
        """float32 [..., K]: of one token each, or what it is, from the hidden states [..., D] that predict it."""
        content_KD = self._of_contents(self.content_logits)
        return self.observation_head.logits(hidden, None if content_KD is None else content_KD.T)

    def reward_logits(self, hidden: jax.Array, seat: jax.Array | None = None) -> jax.Array:
        """float32 [B, T, R]: of the reward's class, from hidden states [B, T, S, D] (or without the T axis).

        In a game, of the reward of player `seat` (int32 [B, T]): the stream itself does not say which of them is ours.
        """
        logits = self.reward_head(hidden[..., -1, :])
        if self.reward_places is not None:
            logits = logits + self.reward_places(hidden[..., :-1, :])
        if seat is None:
            return logits
        first, second = jnp.split(logits, self.seats, axis=-1)
        return jnp.where((seat == 1)[..., None], first, second)

    def termination_logits(self, hidden: jax.Array) -> jax.Array:
        """float32 [B, T, 2]: (goes on, terminated), from hidden states [B, T, S, D] (or without the T axis)."""
        logits = self.termination_head(hidden[..., -1, :])
        if self.termination_places is not None:
            logits = logits + self.termination_places(hidden[..., :-1, :])
        return logits

    def turn_logits(self, hidden: jax.Array) -> TurnLogits:
        """Of a game's next turn, from hidden states [B, T, S, D] (or without the T axis)."""
        assert self.turn_head is not None
        return self.turn_head(hidden[..., -1, :])

    def log_gate(self, hidden: jax.Array) -> jax.Array:
        """The correspondence head's gates, float32 [..., L, 1 + S], normalised; -inf where there is no source."""
        assert self.gate_head is not None and self.grid is not None
        open_LS = np.pad(inside(self.grid, self.radius), ((0, 0), (1, 0)), constant_values=True)
        logits = self.gate_head(hidden[..., :-1, :])
        return jax.nn.log_softmax(
            jnp.where(open_LS.reshape((1,) * (logits.ndim - 2) + open_LS.shape), logits, -jnp.inf)
        )

    def sources(self, tokens: jax.Array) -> jax.Array:
        """The tokens that each place of the next frame may be copied from: [..., L] to [..., L, S]."""
        assert self.grid is not None
        return neighbourhood(tokens, self.grid, self.radius, tokens.ndim - 1, OUTSIDE)

    def token_odds(self, hidden_BSD: jax.Array, tokens_BL: jax.Array, valid_K: jax.Array) -> jax.Array:
        """Probabilities [B, L, K] of the next frame's tokens, from this one's hidden states and tokens."""
        made_BLK = filled_odds(self.observation_logits(hidden_BSD), valid_K)
        if self.gate_head is None:
            return made_BLK
        return mixture_odds(made_BLK, self.log_gate(hidden_BSD), self.sources(tokens_BL))

    def init_cache(self, batch: int, length: int) -> Cache:
        """An empty cache for the latest `length` steps of `batch` streams, and the frame that the last leads to."""
        heads, width = self.config.heads, self.config.embed_dim
        tokens = self.factorization.blocks(length) * self.block
        shape = (self.config.layers, batch, heads, tokens, width // heads)
        return Cache(jnp.zeros(shape, self.dtype), jnp.zeros(shape, self.dtype), jnp.int32(0))

    def step(
        self, cache: Cache, tokens_BL: jax.Array, action_B: jax.Array, history_B: History | None = None
    ) -> tuple[Cache, jax.Array]:
        """Appends one block to the cache; its hidden states [B, S, D] equal those of the whole sequence's pass."""
        return self._append(cache, self.embed(tokens_BL, action_B, history_B))

    def remember(
        self, cache: Cache, tokens_BCL: jax.Array, action_BC: jax.Array, history_BC: History | None = None
    ) -> Cache:
        """Appends C blocks to an empty cache that has room for them, all at once."""
        x_BCSD = self.embed(tokens_BCL, action_BC, history_BC)
        cache, _ = self._append(cache, x_BCSD.reshape(len(x_BCSD), -1, x_BCSD.shape[-1]))
        return cache

    def append_token(self, cache: Cache, token_B: jax.Array, place: jax.Array) -> tuple[Cache, jax.Array]:
        """Appends one token of a frame, the one at `place` (int32 scalar) of L; its hidden state [B, D]."""
        assert isinstance(self.token_embedding, nnx.Embed)
        x_BD = self._token_embedding(token_B + place * self.codes_per_place)
        cache, hidden_B1D = self._append(cache, x_BD[:, None])
        return cache, hidden_B1D[:, 0]

    def _append(self, cache: Cache, x_BQD: jax.Array) -> tuple[Cache, jax.Array]:
        """Appends embedded tokens, whole units of them."""
        start, slots = cache.index, cache.keys.shape[3]
        seen, place = start + x_BQD.shape[1], start % slots
        held_S, index_Q = held_tokens(seen, slots), start + jnp.arange(x_BQD.shape[1])
        last_Q = (index_Q // self.unit + 1) * self.unit - 1
        position_SA = self._positions(index_Q)
        graphdef, layers = nnx.split(self.layers)

        def append(cached: jax.Array, new_BSNH: jax.Array, index: jax.Array) -> jax.Array:
            return jax.lax.dynamic_update_slice(cached, new_BSNH.swapaxes(1, 2)[None], (index, 0, 0, place, 0))

        # The cache is carried, not stacked anew by the scan: one block of it is written, in place.
        def run_layer(carry: Any, inputs: tuple[nnx.State, jax.Array]) -> tuple[Any, None]:
            (x, keys, values), (params, index) = carry, inputs
            layer = nnx.merge(graphdef, params)
            query, key, value = layer.attention_inputs(x)
            keys, values = append(keys, rope(key, position_SA), index), append(values, value, index)
            attended = cached_attention(rope(query, position_SA), keys[index], values[index], held_S, last_Q)
            return (layer.add(x, attended, None), keys, values), None

        carry = (x_BQD, cache.keys, cache.values)
        (x, keys, values), _ = jax.lax.scan(run_layer, carry, (layers, jnp.arange(self.config.layers)))
        return Cache(keys, values, seen), self.norm(x)

    def _positions(self, index_S: jax.Array) -> jax.Array:
        return token_positions(self.config.positions, index_S, self.block, self.grid)

    def _token_embedding(self, tokens: jax.Array) -> jax.Array:
        if isinstance(self.token_embedding, nnx.Linear):
            return self.token_embedding(tokens)
        return _looked_up(self.token_embedding, self._of_contents(self.content_embedding), tokens)

    def _of_contents(self, reading: nnx.Param | None) -> jax.Array | None:
        """What a reading [P, N] makes of what codes stand for, [K, N]."""
        if reading is None or self.contents is None:
            return None
        return jax.lax.stop_gradient(self.contents[...]) @ reading[...]

    def embed(self, tokens: jax.Array, action: jax.Array, history: History | None) -> jax.Array:
        history = history or History()
        if self.codes_per_place:
            places = self.codes_per_place * jnp.arange(tokens.shape[-1])
            tokens = tokens + places.reshape((1,) * (tokens.ndim - 1) + (-1,))
        x = self._token_embedding(tokens)
        if self.local_embedding is not None and self.local_mix is not None and self.grid is not None:
            local = _looked_up(self.local_embedding, self._of_contents(self.content_local), tokens)
            around = neighbourhood(local, self.grid, 1, tokens.ndim - 1)
            x = x + self.local_mix(around.reshape(*tokens.shape, -1))
        if self.token_action_embedding is not None:
            x = x + self.token_action_embedding(action)[..., None, :]
        if self.age_embedding is not None and history.age is not None:
            x = x + self.age_embedding(history.age)
        block = jnp.concatenate([x, self.action_embedding(action)[..., None, :]], axis=-2)
        if self.paid_embedding is not None and self.again_embedding is not None and history.paid is not None:
            count = jnp.minimum(history.paid, self.config.paid)
            told = self.paid_embedding(jnp.sqrt(count.astype(jnp.float32)))  # the first counts most
            again = jnp.take_along_axis(count, action[..., None], axis=-1)[..., 0].astype(jnp.int32)
            block = block + (told + self.again_embedding(again))[..., None, :]
        return block


def _place_head(
    config: WorldModelConfig, tokens: TokenSpec, classes: int, dtype: DTypeLike, rngs: nnx.Rngs
) -> Head | None:
    """What reads a frame's tokens beside the head that reads its action's token, if the configuration wants that."""
    if not config.place_heads:
        return None
    if tokens.spatial:
        return PlaceHead(config, classes, dtype, rngs)
    return SymbolsHead(config, tokens.tokens_per_frame, classes, dtype, rngs)


def _looked_up(table: nnx.Embed, more: jax.Array | None, index: jax.Array) -> jax.Array:
    """Rows [..., N] of a table [K, N], to which perhaps another is added."""
    return table(index) if more is None else (table.embedding[...] + more)[index]


def layer_norm(width: int, rngs: nnx.Rngs) -> nnx.LayerNorm:
    """GPT-2's, in float32 whatever it is given."""
    return nnx.LayerNorm(width, epsilon=1e-5, dtype=jnp.float32, rngs=rngs)


def _split(key: jax.Array | None, parts: int) -> list[jax.Array | None]:
    """`jax.random.split` that passes None on."""
    return [None] * parts if key is None else list(jax.random.split(key, parts))
