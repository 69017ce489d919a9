"""Replay of real frames: flashbax's trajectory buffer, one row per environment, uint8 (fidelity note 14).

Rows are contiguous in time over the whole run, so a sampled sequence may cross an episode's end (note 21).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import flashbax as fbx
import jax
import jax.numpy as jnp
from flax import struct

from suite.configuration.schema import Config
from suite.interface.environment import EnvironmentSpec, State
from suite.interface.turns import Turn
from suite.policy.ppo import Trajectory
from suite.tokenizers.nearest_neighbor import NearestNeighborState, NearestNeighborTokenizer

ReplayState = Any  # flashbax's TrajectoryBufferState


@struct.dataclass
class Coded:
    """A stored frame's tokens, int32 [..., L], and how far each patch is from its code, float32 [..., L]."""

    tokens: jax.Array
    distance: jax.Array


@struct.dataclass
class Experience:
    """Real steps; leading axes [B, T]. At each: the frame, the action taken on it and what that led to.

    Attributes:
      observation: uint8, the frame acted on.
      action: int32.
      reward: float32.
      terminated: bool; the step ended the episode by the rules.
      first: bool; the frame opens an episode.
      turn: whose move it was and what was allowed; None for single-agent tasks.
      state: the environment's own state at the frame, for agents that dream in the true game; else None.
      coded: the frame's tokens, where those of a stored frame are kept (`Replay.code`); else None.
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    first: jax.Array
    turn: Turn | None = None
    state: State = None
    coded: Coded | None = None


@dataclasses.dataclass(frozen=True)
class Replay:
    """The buffer's shape, and the functions that work on its state."""

    num_envs: int
    length: int  # time steps kept of each environment

    @classmethod
    def of(cls, config: Config) -> Replay:
        """`replay.capacity` frames over all environments: 128,000 / 48 = 2,666 steps of each."""
        return cls(config.environment.num_envs, config.replay.capacity // config.environment.num_envs)

    @functools.lru_cache(maxsize=8)  # noqa: B019 -- frozen, and as long-lived as the process
    def _buffer(self, batch: int, length: int) -> Any:
        return fbx.make_trajectory_buffer(
            add_batch_size=self.num_envs,
            sample_batch_size=batch,
            sample_sequence_length=length,
            period=1,
            min_length_time_axis=length,
            max_length_time_axis=self.length,
        )

    def init(self, spec: EnvironmentSpec, state: State = None, tokens: int = 0) -> ReplayState:
        """An empty buffer.

        Args:
          spec: the task's.
          state: the shapes of one environment's state, where states are kept.
          tokens: L, where the tokens of frames are kept; else 0.
        """
        step = Experience(
            observation=jnp.zeros(spec.observation.shape, jnp.uint8),
            action=jnp.zeros((), jnp.int32),
            reward=jnp.zeros((), jnp.float32),
            terminated=jnp.zeros((), bool),
            first=jnp.zeros((), bool),
            turn=_no_turn(spec) if spec.two_player else None,
            state=jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), state),
            coded=_uncoded((tokens,)) if tokens else None,
        )
        # flashbax counts with Python's numbers, whose weak types a restored buffer does not have: another program each.
        return jax.tree.map(lambda x: x.astype(x.dtype), self._buffer(1, 1).init(step))

    def add(self, state: ReplayState, trajectory: Trajectory) -> ReplayState:
        """Appends a trajectory (time-major, [T, B]); the oldest steps give way. Its frames have no tokens yet."""
        kept = state.experience.coded
        experience = Experience(
            observation=trajectory.observation_TB,
            action=trajectory.action_TB,
            reward=trajectory.reward_TB,
            terminated=trajectory.terminated_TB,
            first=trajectory.first_TB,
            turn=trajectory.turn_TB,
            state=trajectory.state_TB,
            coded=None if kept is None else _uncoded((*trajectory.action_TB.shape, kept.tokens.shape[-1])),
        )
        return self._buffer(1, 1).add(state, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), experience))

    def code(
        self,
        state: ReplayState,
        tokenizer: NearestNeighborTokenizer,
        codebook: NearestNeighborState,
        known: jax.Array,
        new: int,
    ) -> ReplayState:
        """Brings the tokens of stored frames up to date: what `tokenizer.encode` says of every frame now.

        Args:
          state: a buffer with tokens.
          tokenizer: whose codes never change, so that old frames need only be compared with new codes.
          codebook: its state now.
          known: int32 scalar; how many codes it had when all but the newest frames were coded last.
          new: so many of the latest steps of each environment have no tokens yet.
        """
        frames, coded = state.experience.observation, state.experience.coded

        def recode(slot: jax.Array, coded: Coded) -> Coded:
            tokens, distance = coded.tokens[:, slot], coded.distance[:, slot]
            nearer = tokenizer.nearer(codebook, known, frames[:, slot], tokens, distance)
            return _written(coded, slot, *nearer)

        def code(i: jax.Array, coded: Coded) -> Coded:
            slot = (state.current_index - 1 - i) % self.length
            return _written(coded, slot, *tokenizer.nearest(codebook, frames[:, slot]))

        coded = jax.lax.fori_loop(0, jnp.where(codebook.count > known, self._stored(state), 0), recode, coded)
        coded = jax.lax.fori_loop(0, new, code, coded)
        return state.replace(experience=state.experience.replace(coded=coded))

    def sample(self, state: ReplayState, key: jax.Array, batch: int, length: int, recent: int = 0) -> Experience:
        """`batch` sequences of `length` consecutive steps; leading axes [batch, length].

        Uniform over all that is stored or, with `recent`, over those that end in the latest so many steps of each
        environment.
        """
        if recent:
            return self._sample_recent(state, key, batch, length, recent)
        with jax.numpy_rank_promotion("allow"):  # flashbax broadcasts as NumPy does
            return self._buffer(batch, length).sample(state, key).experience

    def _stored(self, state: ReplayState) -> jax.Array:
        """int32 scalar; steps that are stored of each environment."""
        return jnp.where(state.is_full, self.length, state.current_index)

    def _sample_recent(self, state: ReplayState, key: jax.Array, batch: int, length: int, recent: int) -> Experience:
        row_key, age_key = jax.random.split(key)
        row_N = jax.random.randint(row_key, (batch,), 0, self.num_envs)
        age_N = jax.random.randint(age_key, (batch,), 0, jnp.minimum(recent, self._stored(state) - length + 1))
        first_N = state.current_index - length - age_N
        time_NT = (first_N[:, None] + jnp.arange(length)[None]) % self.length
        return jax.tree.map(lambda x: x[row_N[:, None], time_NT], state.experience)


def _uncoded(shape: tuple[int, ...]) -> Coded:
    """Tokens of frames that were never looked at: every code is nearer than theirs."""
    return Coded(jnp.zeros(shape, jnp.int32), jnp.full(shape, jnp.inf, jnp.float32))


def _written(coded: Coded, slot: jax.Array, tokens: jax.Array, distance: jax.Array) -> Coded:
    return Coded(coded.tokens.at[:, slot].set(tokens), coded.distance.at[:, slot].set(distance))


def _no_turn(spec: EnvironmentSpec) -> Turn:
    return Turn(
        player=jnp.zeros((), jnp.int32),
        seat=jnp.zeros((), jnp.int32),
        legal_A=jnp.zeros(spec.num_actions, bool),
        chance_C=jnp.zeros(spec.chance_outcomes, jnp.float32),
        opponent_observation=jnp.zeros(spec.observation.shape, jnp.uint8),
    )
