"""Replay of real frames: flashbax's trajectory buffer, one row per environment, uint8 (fidelity note 14).

Rows are contiguous in time over the whole run, so a sampled sequence may cross an episode's end (note 21).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flashbax as fbx
import jax
import jax.numpy as jnp
from flax import struct

from suite.configuration.schema import Config
from suite.interface.environment import EnvironmentSpec, State
from suite.interface.turns import Turn
from suite.policy.ppo import Trajectory
from suite.runtime import layout
from suite.tokenizers.nearest_neighbor import NearestNeighborState, NearestNeighborTokenizer
from suite.world_model.history import next_paid, paid_before

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
      paid: uint8 [..., A]; how often each action had earned a reward in the episode, where that is kept; else None.
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    first: jax.Array
    turn: Turn | None = None
    state: State = None
    coded: Coded | None = None
    paid: jax.Array | None = None


@struct.dataclass
class Eventful:
    """Which sequences of one length hold an event, by environment (E) and first step (L), the oldest step first.

    Attributes:
      holds_EL: bool.
      rank_N: int32 [E * L]; how many do up to each, so that one of them can be drawn.
    """

    holds_EL: jax.Array
    rank_N: jax.Array


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

    def init(self, spec: EnvironmentSpec, state: State = None, tokens: int = 0, paid: bool = False) -> ReplayState:
        """An empty buffer.

        Args:
          spec: the task's.
          state: the shapes of one environment's state, where states are kept.
          tokens: L, where the tokens of frames are kept; else 0.
          paid: whether it is kept how often each action had earned a reward.
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
            paid=jnp.zeros(spec.num_actions, jnp.uint8) if paid else None,
        )
        # flashbax counts with Python's numbers, whose weak types a restored buffer does not have: another program each.
        return jax.tree.map(lambda x: x.astype(x.dtype), self._buffer(1, 1).init(step))

    def add(
        self, state: ReplayState, trajectory: Trajectory, pays: Callable[[jax.Array], jax.Array] | None = None
    ) -> ReplayState:
        """Appends a trajectory (time-major, [T, B]); the oldest steps give way. Its frames have no tokens yet.

        `pays` tells of rewards, float32 of any shape, which of them count as paid, where that is kept.
        """
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
            paid=None if state.experience.paid is None or pays is None else self._paid(state, trajectory, pays),
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
        nearer = layout.per_device(tokenizer.nearer, (None, None, 0, 0, 0), 0)
        nearest = layout.per_device(tokenizer.nearest, (None, 0), 0)

        def recode(slot: jax.Array, coded: Coded) -> Coded:
            tokens, distance = coded.tokens[:, slot], coded.distance[:, slot]
            return _written(coded, slot, *nearer(codebook, known, frames[:, slot], tokens, distance))

        def code(i: jax.Array, coded: Coded) -> Coded:
            slot = (state.current_index - 1 - i) % self.length
            return _written(coded, slot, *nearest(codebook, frames[:, slot]))

        coded = jax.lax.fori_loop(0, jnp.where(codebook.count > known, self._stored(state), 0), recode, coded)
        coded = jax.lax.fori_loop(0, new, code, coded)
        return state.replace(experience=state.experience.replace(coded=coded))

    def _paid(self, state: ReplayState, trajectory: Trajectory, pays: Callable[[jax.Array], jax.Array]) -> jax.Array:
        """uint8 [T, B, A]: how often each action had earned a reward before each step of a trajectory that follows."""
        newest = jax.tree.map(lambda x: x[:, (state.current_index - 1) % self.length], state.experience)
        start_BA = next_paid(newest.paid, newest.action, pays(newest.reward))
        return paid_before(start_BA, trajectory.action_TB, pays(trajectory.reward_TB), trajectory.first_TB)[0]

    def sample(self, state: ReplayState, key: jax.Array, batch: int, length: int, recent: int = 0) -> Experience:
        """`batch` sequences of `length` consecutive steps; leading axes [batch, length].

        Uniform over all that is stored or, with `recent`, over those that end in the latest so many steps of each
        environment.
        """
        if recent:
            return self._sample_recent(state, key, batch, length, recent)
        with jax.numpy_rank_promotion("allow"):  # flashbax broadcasts as NumPy does
            if layout.devices() == 1:
                return self._buffer(batch, length).sample(state, key).experience
            # Asked for numbers of steps instead of steps, it says which ones it would take.
            number_EL = jnp.arange(self.num_envs * self.length).reshape(self.num_envs, self.length)
            number_BT = self._buffer(batch, length).sample(state.replace(experience=number_EL), key).experience
        return layout.take(state.experience, number_BT[:, 0] // self.length, number_BT % self.length)

    def eventful(
        self, state: ReplayState, pays: Callable[[jax.Array], jax.Array], length: int, skipped: int = 0
    ) -> Eventful:
        """Which sequences hold an event: a step that pays, or one that ends its episode by the rules.

        Args:
          state: the buffer.
          pays: as for `add`.
          length: of the sequences. The last step does not count: it only says what the others led to.
          skipped: so many first steps do not count either.
        """
        oldest = self._oldest(state)
        event_EL = pays(state.experience.reward) | state.experience.terminated
        event_EL = jnp.roll(event_EL.astype(jnp.int32), -oldest, axis=1)
        before_EL = jnp.pad(jnp.cumsum(event_EL, axis=1), ((0, 0), (1, 0)))
        first_L = jnp.arange(self.length)
        count_EL = before_EL[:, (first_L + length - 1) % self.length] - before_EL[:, (first_L + skipped) % self.length]
        holds_EL = (count_EL > 0) & (first_L + length <= self._stored(state))[None]
        holds_EL = layout.replicated(holds_EL)  # one bit for every step: each device ranks them all
        return Eventful(holds_EL, jnp.cumsum(holds_EL.reshape(-1).astype(jnp.int32)))

    def sample_eventful(
        self, state: ReplayState, key: jax.Array, batch: int, length: int, eventful: Eventful, share: float
    ) -> tuple[Experience, jax.Array]:
        """As `sample`, but a share of the sequences is drawn among those that hold an event.

        Args:
          state, batch, length: as for `sample`.
          key: of the draw.
          eventful: which sequences of this length hold one.
          share: how many, on average, are drawn among these, in [0, 1).

        Returns:
          the sequences, and float32 [B]: how much less or more often than by `sample` each of them is drawn, so that
          means weighed by it are what they are there.
        """
        row_key, time_key, which_key, rank_key = jax.random.split(key, 4)
        row_B = jax.random.randint(row_key, (batch,), 0, self.num_envs)
        first_B = jax.random.randint(time_key, (batch,), 0, self._stored(state) - length + 1)
        held = eventful.rank_N[-1]
        drawn_B = jnp.searchsorted(eventful.rank_N, jax.random.randint(rank_key, (batch,), 1, jnp.maximum(held, 1) + 1))
        wanted_B = (jax.random.uniform(which_key, (batch,)) < share) & (held > 0)
        row_B = jnp.where(wanted_B, drawn_B // self.length, row_B)
        first_B = jnp.where(wanted_B, drawn_B % self.length, first_B)
        number = (self.num_envs * (self._stored(state) - length + 1)).astype(jnp.float32)
        among = jnp.where(eventful.holds_EL[row_B, first_B], number / jnp.maximum(held, 1).astype(jnp.float32), 0.0)
        weight_B = jnp.where(held > 0, 1 / (1 - share + share * among), 1.0)
        return self._sequences(state, row_B, self._oldest(state) + first_B, length), weight_B

    def _oldest(self, state: ReplayState) -> jax.Array:
        """int32 scalar; where the oldest step stands."""
        return jnp.where(state.is_full, state.current_index, 0)

    def _stored(self, state: ReplayState) -> jax.Array:
        """int32 scalar; steps that are stored of each environment."""
        return jnp.where(state.is_full, self.length, state.current_index)

    def _sample_recent(self, state: ReplayState, key: jax.Array, batch: int, length: int, recent: int) -> Experience:
        row_key, age_key = jax.random.split(key)
        row_B = jax.random.randint(row_key, (batch,), 0, self.num_envs)
        age_B = jax.random.randint(age_key, (batch,), 0, jnp.minimum(recent, self._stored(state) - length + 1))
        return self._sequences(state, row_B, state.current_index - length - age_B, length)

    def _sequences(self, state: ReplayState, row_B: jax.Array, slot_B: jax.Array, length: int) -> Experience:
        """Sequences [B, T] of these environments that begin in these slots, counted modulo the buffer's length."""
        slot_BT = (slot_B[:, None] + jnp.arange(length)[None]) % self.length
        return layout.take(state.experience, row_B, slot_BT)


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
