"""The trained world model behind the environment interface: the dream (Algorithm 4, fidelity notes 22 and 24)."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from suite.interface.environment import EnvironmentSpec, TimeStep
from suite.interface.tokens import Tokenizer, TokenizerState, TokenSpec
from suite.world_model.transformer import Cache, WorldModel


@struct.dataclass
class DreamState:
    """The cache of all blocks before this frame, and this frame's tokens (int32 [B, L])."""

    cache: Cache
    tokens_BL: jax.Array


@dataclasses.dataclass(frozen=True)
class Dream:
    """A `BatchedEnvironment` whose rules are a world model's. Build it inside the jitted function that uses it.

    Every episode starts from a given real frame, and lasts `horizon` steps at most: no more fit into the cache.
    A termination does not end it: the model goes on, and the time step says `first`, so that memory is dropped.
    Rewards are class levels, nothing is truncated, and time steps carry no statistics (an empty dict) and no turn.

    Attributes:
      model: evaluated without dropout.
      tokenizer, tokenizer_state: encode the start frames, decode every imagined one, and say which codes are filled.
      spec: the real task's.
      tokens: the stream's vocabulary.
      horizon: T_WM, steps.
      start_observation_BO: uint8; real frames. Callers that know what came before them burn the policy's memory in.
    """

    model: WorldModel
    tokenizer: Tokenizer
    tokenizer_state: TokenizerState
    spec: EnvironmentSpec
    tokens: TokenSpec
    horizon: int
    start_observation_BO: jax.Array

    @property
    def num_envs(self) -> int:
        """B, the number of start frames."""
        return self.start_observation_BO.shape[0]

    def reset(self, key: jax.Array) -> tuple[DreamState, TimeStep]:
        """The start frames as they are, `first` false; `key` is not used."""
        del key
        tokens_BL = self.tokenizer.encode(self.tokenizer_state, self.start_observation_BO)
        never_B = jnp.zeros((self.num_envs,), bool)
        cache = self.model.init_cache(self.num_envs, self.horizon)
        time_step = _time_step(self.start_observation_BO, jnp.zeros((self.num_envs,), jnp.float32), never_B)
        return DreamState(cache, tokens_BL), time_step

    def step(self, key: jax.Array, state: DreamState, action_B: jax.Array) -> tuple[DreamState, TimeStep]:
        """Samples reward, termination and the next frame's tokens, given everything since the start frame."""
        token_key, reward_key, termination_key = jax.random.split(key, 3)
        cache, hidden_BSD = self.model.step(state.cache, state.tokens_BL, action_B)
        tokens_BL = sample_next_tokens(
            token_key, self.model.observation_logits(hidden_BSD), self.tokenizer.valid_codes(self.tokenizer_state)
        )
        reward_class_B = jax.random.categorical(reward_key, self.model.reward_logits(hidden_BSD))
        terminated_B = jax.random.categorical(termination_key, self.model.termination_logits(hidden_BSD)) == 1
        observation_BO = self.tokenizer.decode(self.tokenizer_state, tokens_BL)
        time_step = _time_step(observation_BO, self.tokens.class_to_reward(reward_class_B), terminated_B)
        return DreamState(cache, tokens_BL), time_step


def sample_next_tokens(key: jax.Array, logits_BLK: jax.Array, valid_K: jax.Array) -> jax.Array:
    """int32 [B, L]: every token of the next frame, in parallel and independently, among the filled codes.

    By inverting the cumulative distribution, which takes one random number per token. Adding noise to every logit takes
    K of them, and on a CPU six times as long as this (K = 512).
    """
    probability_BLK = jax.nn.softmax(jnp.where(valid_K[None, None], logits_BLK, -jnp.inf))
    cumulative_BLK = jnp.cumsum(probability_BLK, axis=-1)
    # Keep off the very end, where rounding would let the unfilled codes behind the last filled one in.
    uniform_BL1 = jax.random.uniform(key, (*logits_BLK.shape[:-1], 1)) * (1 - 1e-5)
    return (cumulative_BLK <= uniform_BL1 * cumulative_BLK[..., -1:]).sum(-1, dtype=jnp.int32)


def _time_step(observation_BO: jax.Array, reward_B: jax.Array, terminated_B: jax.Array) -> TimeStep:
    return TimeStep(
        observation=observation_BO,
        reward=reward_B,
        terminated=terminated_B,
        truncated=jnp.zeros_like(terminated_B),
        first=terminated_B,
        final_observation=observation_BO,
        statistics={},
    )
