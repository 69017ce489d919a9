"""Tiny environments with known answers, for tests of everything above the adapters."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from suite.configuration.overrides import apply_changes
from suite.configuration.schema import Config
from suite.interface.environment import EnvironmentSpec, ObservationSpec, TimeStep
from suite.interface.turns import Turn
from suite.registry import Lazy, TaskEntry

CORRIDOR_SPEC = EnvironmentSpec(
    id="corridor",
    observation=ObservationSpec(shape=(4, 4, 1), high=255, kind="pixels", patch=(2, 2)),
    num_actions=2,
    reward_classes=(0.0, 1.0),
    achievements=("arrive",),
    achievement_rewards=(1.0,),
    statistics=(("achievements", (1,)), ("achievement_return", ()), ("health_return", ())),
    package="numpy",
)


@struct.dataclass
class CorridorState:
    position: jax.Array
    time: jax.Array


class Corridor:
    """Four cells, one of the corners of the picture each; action 1 goes on, 0 back; the fourth cell pays 1 and ends.

    Starts in cell 0 or 1. Truncated after `limit` steps.
    """

    spec = CORRIDOR_SPEC

    def __init__(self, limit: int = 6):
        self.limit = limit

    def reset(self, key: jax.Array) -> tuple[CorridorState, TimeStep]:
        state = CorridorState(jax.random.randint(key, (), 0, 2), jnp.int32(0))
        no = jnp.zeros((), bool)
        return state, self._show(state, jnp.float32(0), no, no, ~no)

    def step(self, key: jax.Array, state: CorridorState, action: jax.Array) -> tuple[CorridorState, TimeStep]:
        state = CorridorState(jnp.clip(state.position + 2 * action - 1, 0, 3), state.time + 1)
        terminated = state.position == 3
        truncated = ~terminated & (state.time >= self.limit)
        return state, self._show(state, terminated.astype(jnp.float32), terminated, truncated, jnp.zeros((), bool))

    def _show(self, state, reward, terminated, truncated, first) -> TimeStep:
        corner = jnp.arange(4) == state.position
        frame = jnp.where(corner, 255, 0).astype(jnp.uint8).reshape(2, 2)
        observation = jnp.repeat(jnp.repeat(frame, 2, 0), 2, 1)[..., None]
        statistics = {"achievements": (reward > 0)[None], "achievement_return": reward, "health_return": 0 * reward}
        return TimeStep(observation, reward, terminated, truncated, first, observation, statistics)


WIDE_CORRIDOR_SPEC = dataclasses.replace(
    CORRIDOR_SPEC,
    id="wide_corridor",
    observation=dataclasses.replace(CORRIDOR_SPEC.observation, shape=(10, 10, 1), patch=(5, 5)),
)


class WideCorridor(Corridor):
    """The same from frames of 10x10, so that patches of every size that the agents have fit."""

    spec = WIDE_CORRIDOR_SPEC

    def _show(self, *what) -> TimeStep:
        small = super()._show(*what)
        frame = jnp.kron(small.observation[::2, ::2, 0], jnp.ones((5, 5), jnp.uint8))[..., None]
        return dataclasses.replace(small, observation=frame, final_observation=frame)


PENNIES_SPEC = EnvironmentSpec(
    id="pennies",
    observation=ObservationSpec(shape=(2,), high=3, kind="symbols"),
    num_actions=2,
    reward_classes=(-1.0, 0.0, 1.0),
    two_player=True,
    chance_outcomes=3,
)


class Pennies:
    """Chance deals a coin (outcome 0 or 2 of three), player 1 guesses, player 2 passes (one legal action).

    The pass carries the reward, +-1 for player 1 and the opposite for player 2, so that it must reach player 1's
    guess two events before.
    """

    spec = PENNIES_SPEC

    def reset(self, key: jax.Array, seat: jax.Array) -> tuple[jax.Array, TimeStep]:
        zero = jnp.int32(0)
        state = jnp.stack([zero, zero, zero, seat])  # who is to act: 0 chance, 1, 2; the coin; the guess; our seat
        return state, self._show(state, jnp.float32(0), jnp.zeros((), bool), jnp.ones((), bool))

    def step(self, key: jax.Array, state: jax.Array, action: jax.Array) -> tuple[jax.Array, TimeStep]:
        player, coin, guess, seat = state
        coin = jnp.where(player == 0, action // 2, coin)
        guess = jnp.where(player == 1, action, guess)
        done = player == 2
        payment = jnp.where((coin == guess) == (seat == 1), jnp.float32(1), jnp.float32(-1))
        state = jnp.stack([(player + 1) % 3, coin, guess, seat])
        return state, self._show(state, jnp.where(done, payment, jnp.float32(0)), done, jnp.zeros((), bool))

    def _show(self, state, reward, terminated, first) -> TimeStep:
        player, coin, _, seat = state
        of_1 = jnp.stack([player, jnp.where(player == 1, 1 + coin, 0)]).astype(jnp.uint8)
        of_2 = jnp.stack([player, jnp.int32(0)]).astype(jnp.uint8)
        ours, theirs = jnp.where(seat == 1, of_1, of_2), jnp.where(seat == 1, of_2, of_1)
        turn = Turn(
            player=player,
            seat=seat,
            legal_A=jnp.where(player == 0, False, jnp.array([True, True]) & ((player == 1) | jnp.array([True, False]))),
            chance_C=jnp.where(player == 0, jnp.array([0.5, 0.0, 0.5], jnp.float32), jnp.float32(0)),
            opponent_observation=theirs,
        )
        no = jnp.zeros((), bool)
        return TimeStep(ours, reward, terminated, no, first, ours, {}, turn)


def make_pennies(progress=None) -> Pennies:
    """As a task's factory."""
    return Pennies()


def pennies_smoke(config: Config) -> Config:
    """The corridor's, with a world model that is large enough for the rules."""
    return apply_changes(
        corridor_smoke(config),
        {
            "protocol.steps": 150,
            "world_model.initial_std": 0.1,
            "world_model.embed_dim": 32,
            "imagination.start_step": 40,
        },
    )


def make_corridor(progress=None) -> Corridor:
    """As a task's factory."""
    return Corridor()


def make_wide_corridor(progress=None) -> WideCorridor:
    """As a task's factory."""
    return WideCorridor()


def two_iterations(config: Config) -> Config:
    """As `corridor_smoke`, with networks for VQ-VAEs; imagination from the second iteration."""
    changes = {
        "protocol.steps": 64,
        "imagination.start_step": 64,
        "imagination.updates": 1,
        "tokenizer.embed_dim": 4,
        "tokenizer.channels": (2, 2, 2, 2, 2),
    }
    return apply_changes(corridor_smoke(config), changes)


def corridor_smoke(config: Config) -> Config:
    """Six iterations of 32 steps; imagination from the third."""
    changes = {
        "protocol.steps": 192,
        "environment.num_envs": 4,
        "environment.rollout_length": 8,
        "environment.burn_in": 2,
        "policy.cnn_channels": (4,),
        "policy.blocks_per_stack": 1,
        "policy.convs_per_block": 1,
        "policy.hidden_size": 16,
        "policy.dense_blocks": 1,
        "policy.rnn_size": 8,
        "ppo.minibatches": 2,
        "ppo.epochs": 1,
        "replay.capacity": 128,
        "tokenizer.codebook_size": 8,
        "tokenizer.updates": 1,
        "world_model.embed_dim": 16,
        "world_model.layers": 1,
        "world_model.heads": 2,
        "world_model.sequence_length": 4,
        "world_model.sequences": 4,
        "world_model.minibatches": 2,
        "world_model.updates": 2,
        "imagination.start_step": 96,
        "imagination.horizon": 3,
        "imagination.num_envs": 4,
        "imagination.updates": 2,
        "evaluation.episodes": 4,
        "checkpoint.every_steps": 64,
    }
    return apply_changes(config, changes)


CORRIDOR = TaskEntry(
    id="corridor",
    family="corridor",
    summary="for tests",
    spec=Lazy("tests.tiny:CORRIDOR_SPEC"),
    make=Lazy("tests.tiny:make_corridor"),
    scores=Lazy("leaderboards.scoring:craftax"),
    presets={"smoke": Lazy("tests.tiny:corridor_smoke")},
)

WIDE_CORRIDOR = TaskEntry(
    id="wide_corridor",
    family="corridor",
    summary="for tests",
    spec=Lazy("tests.tiny:WIDE_CORRIDOR_SPEC"),
    make=Lazy("tests.tiny:make_wide_corridor"),
    scores=Lazy("leaderboards.scoring:craftax"),
    presets={"smoke": Lazy("tests.tiny:two_iterations")},
)

PENNIES = TaskEntry(
    id="pennies",
    family="pennies",
    summary="for tests",
    spec=Lazy("tests.tiny:PENNIES_SPEC"),
    make=Lazy("tests.tiny:make_pennies"),
    scores=Lazy("leaderboards.scoring:returns"),
    presets={"smoke": Lazy("tests.tiny:pennies_smoke")},
)
