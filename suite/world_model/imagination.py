"""The trained world model behind the environment interface: the dream (Algorithm 4, fidelity notes 22 and 24)."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from suite.interface.environment import EnvironmentSpec, TimeStep
from suite.interface.tokens import Tokenizer, TokenizerState, TokenSpec, decode_frame, encode_frame
from suite.interface.turns import CHANCE, Turn, stream_action
from suite.world_model.heads import TurnLogits
from suite.world_model.history import History, ages_of, next_ages, next_paid
from suite.world_model.transformer import Cache, WorldModel


@struct.dataclass
class DreamState:
    """The cache of all blocks before this frame, its tokens (int32 [B, L]) and, in a game, whose turn it is.

    Also the frame's history, for a model that is told something of it.
    """

    cache: Cache
    tokens_BL: jax.Array
    turn_B: Turn | None = None
    history_B: History = History()


@struct.dataclass
class Past:
    """P real steps that lead to a dream's start frames, time-major, oldest first.

    Attributes:
      observation_PBO: uint8.
      action_PB: int32, taken on them, in the player's own numbering.
      turn_PB: whose turns they were; None for single-agent tasks.
      tokens_PBL: the frames' tokens, if they are known.
      paid_PBA: uint8; how often each action had earned a reward before; None: that is not known.
    """

    observation_PBO: jax.Array
    action_PB: jax.Array
    turn_PB: Turn | None = None
    tokens_PBL: jax.Array | None = None
    paid_PBA: jax.Array | None = None


@dataclasses.dataclass(frozen=True)
class Dream:
    """A `BatchedEnvironment` whose rules are a world model's. Build it inside the jitted function that uses it.

    Every episode starts from a given real frame, and lasts `horizon` steps. The model reads the latest frames, as many
    as in the sequences that it learned from: a longer view is one that it has never had. A termination does not end it:
    the model goes on, and the time step says `first`, so that memory is dropped. Rewards are class levels, nothing is
    truncated, and time steps carry no statistics (an empty dict). In a game the model also says whose turn is next,
    what is legal and how chance falls; our seat is the one we started in.

    Attributes:
      model: evaluated without dropout.
      tokenizer, tokenizer_state: encode the start frames, decode every imagined one, and say which codes are filled.
      spec: the real task's.
      tokens: the stream's vocabulary.
      horizon: T_WM, steps.
      start_observation_BO: uint8; real frames. Callers that know what came before them burn the policy's memory in.
      start_turn_B: whose turn it is there; None for single-agent tasks.
      start_tokens_BL: their tokens, if they are known.
      start_paid_BA: how often each action had earned a reward, uint8 [B, A]; None: nothing was paid yet.
      past: real steps before them, at least as many as the context and, to tell ages by, as the model's highest age.
      context: how many of the last of these the model reads; 0: its view begins with the start frames (note 24).
      min_p: codes less likely than this share of the likeliest are not drawn.
    """

    model: WorldModel
    tokenizer: Tokenizer
    tokenizer_state: TokenizerState
    spec: EnvironmentSpec
    tokens: TokenSpec
    horizon: int
    start_observation_BO: jax.Array
    start_turn_B: Turn | None = None
    start_tokens_BL: jax.Array | None = None
    start_paid_BA: jax.Array | None = None
    past: Past | None = None
    context: int = 0
    min_p: float = 0.0

    @property
    def num_envs(self) -> int:
        """B, the number of start frames."""
        return self.start_observation_BO.shape[0]

    def reset(self, key: jax.Array) -> tuple[DreamState, TimeStep]:
        """The start frames as they are, `first` false; `key` is not used."""
        del key
        turn_B = self.start_turn_B
        tokens_BL = self.start_tokens_BL
        if tokens_BL is None:
            tokens_BL = encode_frame(self.tokenizer, self.tokenizer_state, self.start_observation_BO, turn_B)
        never_B = jnp.zeros((self.num_envs,), bool)
        cache, history_B = self._remember(tokens_BL)
        time_step = _time_step(self.start_observation_BO, jnp.zeros((self.num_envs,), jnp.float32), never_B, turn_B)
        return DreamState(cache, tokens_BL, turn_B, history_B), time_step

    def _remember(self, start_BL: jax.Array) -> tuple[Cache, History]:
        """A cache with what the model reads before the start frames, and the history of these."""
        longest = self.model.config.sequence_length
        cache = self.model.init_cache(self.num_envs, min(self.context + self.horizon, longest))
        paid_BA = self.start_paid_BA if self.model.config.paid else None
        if self.model.config.paid and paid_BA is None:
            paid_BA = jnp.zeros((self.num_envs, self.tokens.num_actions), jnp.uint8)
        if self.past is None:
            return cache, History(paid=paid_BA)
        turn_PB, action_PB = self.past.turn_PB, self.past.action_PB
        tokens_PBL = self.past.tokens_PBL
        if tokens_PBL is None:
            observation_PBO = self.past.observation_PBO
            tokens_PBL = encode_frame(self.tokenizer, self.tokenizer_state, observation_PBO, turn_PB, axis=1)
        if turn_PB is not None:
            action_PB = stream_action(turn_PB, action_PB)
        tokens_BPL, action_BP, age_BPL = tokens_PBL.swapaxes(0, 1), action_PB.swapaxes(0, 1), None
        if self.model.ages:
            age_BPL = ages_of(jnp.concatenate([tokens_BPL, start_BL[:, None]], axis=1), self.model.ages)
        if self.context:
            read = slice(-self.context, None)
            ages = None if age_BPL is None else age_BPL[:, :-1][:, read]
            paid_PBA = self.past.paid_PBA
            paid = None if paid_PBA is None else paid_PBA.swapaxes(0, 1)[:, read]
            cache = self.model.remember(cache, tokens_BPL[:, read], action_BP[:, read], History(ages, paid))
        return cache, History(None if age_BPL is None else age_BPL[:, -1], paid_BA)

    def step(self, key: jax.Array, state: DreamState, action_B: jax.Array) -> tuple[DreamState, TimeStep]:
        """Samples reward, termination, the next frame's tokens and turn, given everything since the start frame."""
        token_key, reward_key, termination_key = jax.random.split(key, 3)
        turn_B = state.turn_B
        seat_B = None if turn_B is None else turn_B.seat
        stream_action_B = action_B if turn_B is None else stream_action(turn_B, action_B)
        valid_K = self.tokenizer.valid_codes(self.tokenizer_state)
        cache, hidden_BSD, tokens_BL = next_frame(
            token_key, self.model, state.cache, state.tokens_BL, stream_action_B, valid_K, self.min_p, state.history_B
        )
        reward_class_B = jax.random.categorical(reward_key, self.model.reward_logits(hidden_BSD, seat_B))
        terminated_B = jax.random.categorical(termination_key, self.model.termination_logits(hidden_BSD)) == 1
        observation_BO, theirs_BO = decode_frame(self.tokenizer, self.tokenizer_state, tokens_BL, seat_B)
        if seat_B is not None and theirs_BO is not None:
            turn_B = next_turn(jax.random.fold_in(key, 3), self.model.turn_logits(hidden_BSD), seat_B, theirs_BO)
        reward_B = self.tokens.class_to_reward(reward_class_B)
        time_step = _time_step(observation_BO, reward_B, terminated_B, turn_B)
        age_BL, paid_BA = state.history_B.age, state.history_B.paid
        if age_BL is not None:
            age_BL = next_ages(age_BL, state.tokens_BL, tokens_BL, self.model.ages)
        if paid_BA is not None:
            paid_BA = next_paid(paid_BA, stream_action_B, reward_B > 0)
            paid_BA = jnp.where(terminated_B[:, None], jnp.zeros_like(paid_BA), paid_BA)
        return DreamState(cache, tokens_BL, turn_B, History(age_BL, paid_BA)), time_step


def next_frame(
    key: jax.Array,
    model: WorldModel,
    cache: Cache,
    tokens_BL: jax.Array,
    action_B: jax.Array,
    valid_K: jax.Array,
    min_p: float = 0.0,
    history_B: History | None = None,
) -> tuple[Cache, jax.Array, jax.Array]:
    """The cache with this frame and action, their hidden states [B, S, D], and the next frame's tokens [B, L]."""
    cache, hidden_BSD = model.step(cache, tokens_BL, action_B, history_B)
    next_BL = model.factorization.sample(key, model, cache, hidden_BSD, tokens_BL, valid_K, min_p)
    return cache, hidden_BSD, next_BL


def next_turn(key: jax.Array, logits_B: TurnLogits, seat_B: jax.Array, opponent_observation_BO: jax.Array) -> Turn:
    """The turn that a game's world model predicts: a sampled player, and what is then legal, or chance's odds.

    An action is legal if that is likelier than not, and the likeliest always is: somebody must be able to move.
    """
    outcomes = logits_B.chance.shape[-1]
    acts_1P = jnp.array([[outcomes > 0, True, True]])  # chance, unless there is none
    player_B = jax.random.categorical(key, jnp.where(acts_1P, logits_B.player, -jnp.inf)).astype(jnp.int32)
    chance_B1 = (player_B == CHANCE)[:, None]
    legal_BA = (logits_B.legal > 0) | (logits_B.legal >= logits_B.legal.max(-1, keepdims=True))
    chance_BC = jax.nn.softmax(logits_B.chance) if outcomes else logits_B.chance
    return Turn(
        player=player_B,
        seat=seat_B,
        legal_A=legal_BA & ~chance_B1,
        chance_C=jnp.where(chance_B1, chance_BC, 0.0),
        opponent_observation=opponent_observation_BO,
    )


def _time_step(
    observation_BO: jax.Array, reward_B: jax.Array, terminated_B: jax.Array, turn_B: Turn | None
) -> TimeStep:
    return TimeStep(
        observation=observation_BO,
        reward=reward_B,
        terminated=terminated_B,
        truncated=jnp.zeros_like(terminated_B),
        first=terminated_B,
        final_observation=observation_BO,
        statistics={},
        turn=turn_B,
    )
