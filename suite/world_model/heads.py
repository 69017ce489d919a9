"""What is read off the transformer's outputs: one small network per prediction (Appendix A.2.2)."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from flax import nnx, struct
from jax.typing import DTypeLike

from suite.configuration.schema import WorldModelConfig
from suite.interface.tokens import TokenSpec
from suite.nn.bias import add_bias

NARROWER = 4  # so many times fewer numbers a symbol in `SymbolsHead` than in a token's hidden state


class Head(nnx.Module):
    """Dense(D), ReLU, Dense(classes): float32 logits [..., classes] of hidden states [..., D], or of `inputs` numbers.

    Products are in `dtype`; logits are accumulated and kept in float32, since their differences decide what is sampled.
    """

    def __init__(
        self, config: WorldModelConfig, classes: int, dtype: DTypeLike, rngs: nnx.Rngs, inputs: int | None = None
    ):
        width, init = config.embed_dim, nnx.initializers.normal(config.initial_std)
        self.hidden = nnx.Linear(inputs or width, width, dtype=dtype, kernel_init=init, rngs=rngs)
        self.kernel = nnx.Param(init(rngs.params(), (width, classes), jnp.float32))
        self.bias = nnx.Param(jnp.zeros((classes,), jnp.float32))
        self.dtype = dtype

    def __call__(self, hidden: jax.Array) -> jax.Array:
        return self.logits(hidden)

    def logits(self, hidden: jax.Array, more: jax.Array | None = None) -> jax.Array:
        """The same; `more`, [D, classes], is added to the matrix that logits are read off with."""
        # Along one axis: on a CPU, a bias's gradient, a sum over several axes, takes several times as long.
        features = nnx.relu(self.hidden(hidden.reshape(-1, hidden.shape[-1])))
        kernel = self.kernel[...] if more is None else self.kernel[...] + more
        logits = jnp.dot(features, kernel.astype(self.dtype), preferred_element_type=jnp.float32)
        return add_bias(logits, self.bias[...]).reshape(*hidden.shape[:-1], logits.shape[-1])


class PlaceHead(Head):
    """Logits [..., classes] of what happens at any of L places: the logarithm of the mean of exp of those at each.

    One network for all places: what it learns of a rare event at one of them it knows at all. Not the paper's.
    """

    def __call__(self, hidden: jax.Array) -> jax.Array:
        """From hidden states [..., L, D]."""
        logits = super().__call__(hidden)
        return jax.nn.logsumexp(logits, axis=-2) - math.log(logits.shape[-2])


class SymbolsHead(Head):
    """Logits [..., classes] of all of a frame's symbols together, each of them first made `NARROWER` times narrower.

    A game's winner is a matter of several squares at once, which the sum that attention forms in the action's token
    tells badly, and which no single place knows. Narrower, because the hidden matrix grows with the number of symbols,
    and Muon's time with its smaller side. Not the paper's.
    """

    def __init__(self, config: WorldModelConfig, symbols: int, classes: int, dtype: DTypeLike, rngs: nnx.Rngs):
        each = max(config.embed_dim // NARROWER, 1)
        super().__init__(config, classes, dtype, rngs, inputs=symbols * each)
        init = nnx.initializers.normal(config.initial_std)
        self.narrow = nnx.Linear(config.embed_dim, each, dtype=dtype, kernel_init=init, rngs=rngs)

    def __call__(self, hidden: jax.Array) -> jax.Array:
        """From hidden states [..., L, D]."""
        narrow = self.narrow(hidden)
        return super().__call__(narrow.reshape(*narrow.shape[:-2], -1))


def filled_odds(logits: jax.Array, valid_K: jax.Array) -> jax.Array:
    """Probabilities [..., K] of logits [..., K] among the filled codes (bool [K])."""
    return jax.nn.softmax(jnp.where(valid_K.reshape((1,) * (logits.ndim - 1) + (-1,)), logits, -jnp.inf))


PLAYERS = 3  # chance, player 1, player 2


@struct.dataclass
class TurnLogits:
    """float32 logits of a game's next turn, with the leading axes of the hidden states they are of.

    Attributes:
      player: [..., 3]; chance, player 1, player 2.
      legal: [..., A]; one binary logit for each action of whoever it is that acts.
      chance: [..., C]; of chance's outcomes.
    """

    player: jax.Array
    legal: jax.Array
    chance: jax.Array


class TurnHead(nnx.Module):
    """The full-information heads of a two-player game (Appendix G, losses 4 to 6)."""

    def __init__(self, config: WorldModelConfig, tokens: TokenSpec, dtype: DTypeLike, rngs: nnx.Rngs):
        self.player = Head(config, PLAYERS, dtype, rngs)
        self.legal = Head(config, tokens.player_actions, dtype, rngs)
        self.chance = Head(config, tokens.chance_outcomes, dtype, rngs) if tokens.chance_outcomes else None

    def __call__(self, hidden: jax.Array) -> TurnLogits:
        """From hidden states [..., D]."""
        none = jnp.zeros((*hidden.shape[:-1], 0), jnp.float32)
        return TurnLogits(
            player=self.player(hidden),
            legal=self.legal(hidden),
            chance=none if self.chance is None else self.chance(hidden),
        )
