"""The actor-critic network: embedding, memory, policy and value (Appendix A.1.1, Algorithm 2).

Shapes: T steps, B environments, A actions, H memory units, F features of the embedding z.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx, struct

from suite.configuration.schema import PolicyConfig
from suite.interface.environment import ObservationSpec
from suite.nn.per_device import of_each_device
from suite.policy.moon import MoonCNN, MoonTrunk
from suite.policy.networks import GRU, RELU_GAIN, DenseTrunk, ImpalaCNN, Norm, SymbolMLP, dense

# Finite, so that entropy and gradients stay finite; far enough for a probability of exactly zero.
ILLEGAL = -1e9


@struct.dataclass
class PolicyOutput:
    """What a policy says of each step.

    Attributes:
      logits_TBA: float32, unnormalized log-probabilities of the actions.
      value_TB: float32, the expected return in standardized units; see `ppo.TargetStatistics.denormalize`.
    """

    logits_TBA: jax.Array
    value_TB: jax.Array


class ActorCritic(nnx.Module):
    """z = CNN(o); y, h = GRU(h, z); policy and value from [y, z] (Algorithm 2, fidelity note 2).

    With `config.rnn_size` 0 there is no memory: h has size 0 and the heads see z alone. `config.kind` "moon" is the
    network of `suite.policy.moon` instead.
    """

    def __init__(self, config: PolicyConfig, observation: ObservationSpec, num_actions: int, rngs: nnx.Rngs):
        dtype = jnp.bfloat16 if config.compute_type == "bfloat16" else jnp.float32
        self.rnn_size, self.high, self.dtype = config.rnn_size, observation.high, dtype
        self.symbolic = observation.kind == "symbols"
        self.resized = None
        moon = config.kind == "moon"
        self.embed: SymbolMLP | ImpalaCNN | MoonCNN
        if self.symbolic:
            (symbols,) = observation.shape
            self.embed = SymbolMLP(symbols, observation.high + 1, config.hidden_size, dtype, rngs)
        else:
            height, width, channels = observation.shape
            if observation.kind == "pixels" and max(height, width) > config.max_pixels:
                self.resized = (min(height, config.max_pixels), min(width, config.max_pixels))
            network = MoonCNN if moon else ImpalaCNN
            self.embed = network((*(self.resized or (height, width)), channels), config, dtype, rngs)
        self.memory = Memory(self.embed.features, config.rnn_size, dtype, rngs) if config.rnn_size else None

        inputs = self.embed.features + config.rnn_size
        self.trunks = nnx.List(  # one that is shared, or the actor's and the critic's
            MoonTrunk(inputs, config.hidden_size, dtype, rngs)
            if moon
            else DenseTrunk(inputs, config.hidden_size, config.dense_blocks, dtype, rngs)
            for _ in range(1 if config.shared_trunk or moon else 2)
        )
        self.policy_head = dense(config.hidden_size, num_actions, 0.01, jnp.float32, rngs)
        self.value_head = dense(config.hidden_size, 1, 0.1 if moon else 1.0, jnp.float32, rngs)

    def initial_hidden(self, batch: int) -> jax.Array:
        """float32 zeros [batch, H]."""
        return jnp.zeros((batch, self.rnn_size), jnp.float32)

    def __call__(
        self,
        observation_TB: jax.Array,
        first_TB: jax.Array,
        hidden_BH: jax.Array,
        acting_TB: jax.Array | None = None,
    ) -> tuple[PolicyOutput, jax.Array]:
        """Policy and value at each step, and the hidden state after the last one.

        Args:
          observation_TB: uint8 [T, B, ...].
          first_TB: bool; the hidden state is zeroed before these steps.
          hidden_BH: float32; the hidden state before the first step.
          acting_TB: bool; the hidden state does not advance where it is someone else's turn. None: always ours.
        """
        own = of_each_device(type(self)._outputs, self, (1, 1, 0, 1), (1, 0))
        return own(observation_TB, first_TB, hidden_BH, acting_TB)

    def _outputs(
        self, observation_TB: jax.Array, first_TB: jax.Array, hidden_BH: jax.Array, acting_TB: jax.Array | None
    ) -> tuple[PolicyOutput, jax.Array]:
        features_TBF = self._embed(observation_TB)
        if self.memory is not None:
            y_TBH, hidden_BH = self.memory(features_TBF, first_TB, hidden_BH, acting_TB)
            features_TBF = jnp.concatenate([y_TBH, features_TBF], axis=-1)
        outputs = [trunk(features_TBF) for trunk in self.trunks]
        logits_TBA = self.policy_head(outputs[0])
        value_TB = self.value_head(outputs[-1])[..., 0]
        return PolicyOutput(logits_TBA, value_TB), hidden_BH

    def advance(
        self,
        observation_TB: jax.Array,
        first_TB: jax.Array,
        hidden_BH: jax.Array,
        acting_TB: jax.Array | None = None,
    ) -> jax.Array:
        """The hidden state after the given steps; computes neither policy nor value (burn-in of Algorithm 4)."""
        if self.memory is None:
            return hidden_BH
        own = of_each_device(type(self)._advanced, self, (1, 1, 0, 1), 0)
        return own(observation_TB, first_TB, hidden_BH, acting_TB)

    def _advanced(
        self, observation_TB: jax.Array, first_TB: jax.Array, hidden_BH: jax.Array, acting_TB: jax.Array | None
    ) -> jax.Array:
        assert self.memory is not None
        _, hidden_BH = self.memory(self._embed(observation_TB), first_TB, hidden_BH, acting_TB)
        return hidden_BH

    def _embed(self, observation_TB: jax.Array) -> jax.Array:
        """Embeddings z [T, B, F]; the CNN sees all T x B frames at once."""
        steps, batch = observation_TB.shape[:2]
        x_N = observation_TB.reshape(steps * batch, *observation_TB.shape[2:])
        if self.resized:
            x_N = jax.image.resize(x_N, (steps * batch, *self.resized, x_N.shape[-1]), "nearest")
        if not self.symbolic:
            x_N = x_N.astype(jnp.float32) / self.high
        return self.embed(x_N).reshape(steps, batch, self.embed.features)


class Memory(nnx.Module):
    """Layer norm, dense, ReLU, GRU, output projection, ReLU (Appendix A.1.1); all but z of size H."""

    def __init__(self, inputs: int, size: int, dtype, rngs: nnx.Rngs):
        self.norm = Norm(inputs, (-1,), dtype)
        self.input = dense(inputs, size, RELU_GAIN, dtype, rngs)
        self.gru = GRU(size, dtype, rngs)
        self.output = dense(size, size, RELU_GAIN, dtype, rngs)

    def __call__(
        self, z_TBF: jax.Array, first_TB: jax.Array, hidden_BH: jax.Array, acting_TB: jax.Array | None
    ) -> tuple[jax.Array, jax.Array]:
        """Outputs y [T, B, H] and the hidden state after the last step."""
        x_TBH = jax.nn.relu(self.input(self.norm(z_TBF)))
        output_TBH, hidden_BH = self.gru(x_TBH, first_TB, hidden_BH, acting_TB)
        return jax.nn.relu(self.output(output_TBH)), hidden_BH


class UniformPolicy(nnx.Module):
    """Every action equally likely, every state worth nothing; no parameters. Same interface as `ActorCritic`."""

    def __init__(self, num_actions: int):
        self.num_actions = num_actions

    def initial_hidden(self, batch: int) -> jax.Array:
        """float32 [batch, 0]: it remembers nothing."""
        return jnp.zeros((batch, 0), jnp.float32)

    def __call__(
        self,
        observation_TB: jax.Array,
        first_TB: jax.Array,
        hidden_BH: jax.Array,
        acting_TB: jax.Array | None = None,
    ) -> tuple[PolicyOutput, jax.Array]:
        """Zero logits and values."""
        shape_TB = observation_TB.shape[:2]
        zeros_TBA = jnp.zeros((*shape_TB, self.num_actions), jnp.float32)
        return PolicyOutput(zeros_TBA, jnp.zeros(shape_TB, jnp.float32)), hidden_BH

    def advance(
        self,
        observation_TB: jax.Array,
        first_TB: jax.Array,
        hidden_BH: jax.Array,
        acting_TB: jax.Array | None = None,
    ) -> jax.Array:
        """`hidden_BH` itself."""
        return hidden_BH


Policy = ActorCritic | UniformPolicy


def make_policy(config: PolicyConfig, observation: ObservationSpec, num_actions: int, rngs: nnx.Rngs) -> Policy:
    """The policy that `config.kind` names, freshly initialized."""
    if config.kind == "uniform":
        return UniformPolicy(num_actions)
    return ActorCritic(config, observation, num_actions, rngs)


def mask_logits(logits: jax.Array, legal: jax.Array | None) -> jax.Array:
    """Logits [..., A] with illegal actions at probability zero; `legal` bool [..., A], None if all are legal."""
    return logits if legal is None else jnp.where(legal, logits, ILLEGAL)


def log_probability(logits: jax.Array, action: jax.Array) -> jax.Array:
    """Log-probability log pi(action) [...] under logits [..., A]; `action` int32 [...]."""
    return jnp.take_along_axis(jax.nn.log_softmax(logits), action[..., None], axis=-1)[..., 0]
