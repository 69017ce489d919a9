"""Does a game's world model keep the rules? Whole imagined games, replayed event by event in the real one.

`suite inspect RUN_DIR` prints it for the newest checkpoint of a run.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx, struct

from suite.agent import rollout as play
from suite.agent.phases import Agent
from suite.interface.environment import State, TimeStep
from suite.interface.turns import CHANCE, Turn
from suite.policy.actor_critic import UniformPolicy
from suite.policy.ppo import PolicyTrainState
from suite.records.record import RunRecord
from suite.runs.saved_model import restore
from suite.runtime.errors import UserError
from suite.runtime.reporting import QuietReporter, Reporter

GAMES = 1_000


@struct.dataclass
class RuleCheck:
    """Imagined events beside the real ones that the same event led to; all [T, B].

    Attributes:
      counted: the game has gone by the rules so far: no event before was illegal, or an end, real or imagined.
      legal: the event is possible in the real game, and whoever plays it is to act there.
      player, legal_set, observations: what it led to is right; counted where `goes_on`, for after an end another game
        begins.
      reward, terminated: what it led to is right.
      ended: the real game ended there.
      chance_next: chance is really next; `chance_error` is the total variation distance of its odds.
      outcome: int32, what chance did, -1 where a player acted; [T, B, C] `odds` are the real ones.
    """

    counted: jax.Array
    legal: jax.Array
    player: jax.Array
    legal_set: jax.Array
    observations: jax.Array
    reward: jax.Array
    terminated: jax.Array
    ended: jax.Array
    goes_on: jax.Array
    chance_next: jax.Array
    chance_error: jax.Array
    outcome: jax.Array
    odds: jax.Array


@struct.dataclass
class Games:
    """B imagined games, each beside the real game in which the same happened.

    Attributes:
      state, turn: of the real environments.
      imagined: what the model shows instead.
      hidden_BH: the policy's memory before it sees that.
      alive_B: bool; see `RuleCheck.counted`.
    """

    state: State
    turn: Turn
    imagined: TimeStep
    hidden_BH: jax.Array
    alive_B: jax.Array


def rules_kept(
    agent: Agent,
    policy_state: PolicyTrainState,
    world_model: nnx.State,
    tokenizer: Any,
    key: jax.Array,
    games: int,
    uniform: bool,
) -> dict[str, float]:
    """How well imagined games keep the rules.

    A game is imagined from its first frame to its end, as dreams are that the agent learns from: our policy, a uniform
    opponent and chance move as the model lets them. Where the model's context is full, another dream goes on from the
    last imagined frame.

    Args:
      agent: of a two-player task; the event alone must determine what its environment does.
      policy_state: whose policy plays.
      world_model, tokenizer: their parameters and state.
      key: of the games.
      games: at least so many.
      uniform: our side moves uniformly too, among what the model says is legal.

    Returns:
      Percent of events: `legal_percent`; of the legal ones `player_percent`, `legal_set_percent` (next to act, and all
      that is then legal), `observations_percent` (both players', every symbol), `reward_percent`, `terminated_percent`,
      `chance_error_percent` (mean total variation distance of chance's odds). Percent of games: `return_percent`, of
      those legal to the end, which came when it should, with the right return. `chance_largest_z`: over chance's
      outcomes, by how many standard deviations of its real odds one was drawn too often or too rarely. `games`,
      `events`.
    """
    seats = agent.batched.num_envs
    parts: list[RuleCheck] = []
    for i in range(-(-games // seats)):
        start_key, dream_key = jax.random.split(jax.random.fold_in(key, i))
        state, now = _start(agent, policy_state, start_key, uniform), 0
        columns = []
        while now == 0 or bool(state.alive_B.any()):  # a real game's end ends it, whatever the model thinks
            step_key = jax.random.fold_in(dream_key, now)
            state, compared = _go_on(agent, policy_state, world_model, tokenizer, step_key, state, uniform)
            columns.append(jax.device_get(compared))
            now += 1
        parts.append(jax.tree.map(lambda *x: np.concatenate(x), *columns))
    return _summary(parts)


def _summary(parts: list[RuleCheck]) -> dict[str, float]:
    """Of batches of games of different lengths."""

    def flat(name: str) -> np.ndarray:
        return np.concatenate([event_B for part in parts for event_B in getattr(part, name)])

    def percent(name: str, where: np.ndarray) -> float:
        return 100 * float(flat(name)[where].mean()) if where.any() else float("nan")

    counted = flat("counted")
    followed = counted & flat("legal")
    names = ("player", "legal_set", "observations")
    right = np.concatenate(
        [
            (part.counted & part.ended & part.terminated).any(0)
            & ~(part.counted & ~(part.legal & part.reward & part.terminated)).any(0)
            for part in parts
        ]
    )
    return {
        "legal_percent": percent("legal", counted),
        **{f"{name}_percent": percent(name, followed & flat("goes_on")) for name in names},
        "reward_percent": percent("reward", followed),
        "terminated_percent": percent("terminated", followed),
        "return_percent": 100 * float(right.mean()),
        "chance_error_percent": percent("chance_error", followed & flat("chance_next")),
        "chance_largest_z": largest_z(flat("outcome")[followed], flat("odds")[followed]),
        "games": len(right),
        "events": int(counted.sum()),
    }


def largest_z(outcome_N: np.ndarray, odds_NC: np.ndarray) -> float:
    """Largest standardized difference between how often an outcome was drawn and how often it should be."""
    drawn = outcome_N >= 0
    if not drawn.any():
        return float("nan")
    odds = odds_NC[drawn].astype(np.float64)
    count_C = np.bincount(outcome_N[drawn], minlength=odds.shape[1])
    variance_C = (odds * (1 - odds)).sum(0)
    open_C = variance_C > 1e-9
    if not open_C.any():
        return 0.0
    return float(np.abs((count_C - odds.sum(0))[open_C] / np.sqrt(variance_C[open_C])).max())


def _policy(agent: Agent, policy_state: PolicyTrainState, uniform: bool) -> Any:
    return UniformPolicy(agent.spec.num_actions) if uniform else nnx.merge(agent.policy_graph, policy_state.params)


@functools.partial(jax.jit, static_argnums=(0, 3))
def _start(agent: Agent, policy_state: PolicyTrainState, key: jax.Array, uniform: bool) -> Games:
    """Games at their first frame, where imagined and real ones agree."""
    state, time_step = agent.batched.reset(key)
    batch = agent.batched.num_envs
    hidden_BH = _policy(agent, policy_state, uniform).initial_hidden(batch)
    assert time_step.turn is not None
    return Games(state, time_step.turn, time_step, hidden_BH, jnp.ones(batch, bool))


@functools.partial(jax.jit, static_argnums=(0, 6))
def _go_on(
    agent: Agent,
    policy_state: PolicyTrainState,
    world_model: nnx.State,
    tokenizer: Any,
    key: jax.Array,
    games: Games,
    uniform: bool,
) -> tuple[Games, RuleCheck]:
    """One dream, from where the imagined games are, and what the real ones make of its events."""
    policy, model = _policy(agent, policy_state, uniform), nnx.merge(agent.world_model_graph, world_model)
    start, horizon = games.imagined, agent.config.imagination.horizon
    dream = agent.dream_from(model, tokenizer, start.observation, start.turn, horizon)
    rollout_state = play.start(policy, dream, key, burn_in=0)
    time_step = dataclasses.replace(rollout_state.time_step, first=start.first)
    rollout_state = dataclasses.replace(rollout_state, time_step=time_step, hidden_BH=games.hidden_BH)
    rollout_state, trajectory, _ = play.rollout(key, policy, policy_state.targets, dream, rollout_state, horizon)
    # What was imagined after each event.
    seen = jax.tree.map(
        lambda during, last: jnp.concatenate([during[1:], last[None]]),
        (trajectory.observation_TB, trajectory.turn_TB),
        (rollout_state.time_step.observation, rollout_state.time_step.turn),
    )

    def event(carry: tuple[State, Turn, jax.Array], imagined: Any) -> tuple[Any, RuleCheck]:
        state, real, alive_B = carry
        event_B, turn, (observation, seen_turn), reward_B, terminated_B, step_key = imagined
        possible_BN = jnp.concatenate([real.legal_A, real.chance_C > 0], axis=1)
        chance_B = turn.player == CHANCE
        column_B = event_B + jnp.where(chance_B, agent.spec.num_actions, 0)
        legal_B = jnp.take_along_axis(possible_BN, column_B[:, None], axis=1)[:, 0] & (turn.player == real.player)
        state, after = agent.batched.step(step_key, state, event_B)
        wanted = after.turn
        assert wanted is not None
        ended_B = after.terminated | after.truncated
        result = RuleCheck(
            counted=alive_B,
            legal=legal_B,
            player=seen_turn.player == wanted.player,
            legal_set=(seen_turn.legal_A == wanted.legal_A).all(-1),
            observations=(observation == after.final_observation).all(-1)
            & (seen_turn.opponent_observation == wanted.opponent_observation).all(-1),
            reward=agent.tokens.reward_to_class(reward_B) == agent.tokens.reward_to_class(after.reward),
            terminated=terminated_B == after.terminated,
            ended=ended_B,
            goes_on=~ended_B & ~terminated_B,
            chance_next=(wanted.player == CHANCE) & ~ended_B & ~terminated_B,
            chance_error=jnp.abs(seen_turn.chance_C - wanted.chance_C).sum(-1) / 2,
            outcome=jnp.where(chance_B, event_B, -1),
            odds=real.chance_C,
        )
        return (state, wanted, alive_B & legal_B & ~ended_B & ~terminated_B), result

    keys = jax.random.split(jax.random.fold_in(key, 1), horizon)
    imagined = (
        trajectory.action_TB,
        trajectory.turn_TB,
        seen,
        trajectory.reward_TB,
        trajectory.terminated_TB,
        keys,
    )
    (state, turn, alive_B), compared = jax.lax.scan(event, (games.state, games.turn, games.alive_B), imagined)
    return Games(state, turn, rollout_state.time_step, rollout_state.hidden_BH, alive_B), compared


def rules_of_run(folder: Path, games: int = GAMES, reporter: Reporter | None = None) -> dict[str, dict[str, float]]:
    """`rules_kept` by the newest checkpoint of a run folder: in the "agent"'s own play, and in "uniform" play.

    Raises:
      UserError: no run folder, no checkpoint, no world model or no two-player game.
    """
    reporter = reporter or QuietReporter()
    record = RunRecord.open(folder, lock=False)
    if not (record.config.world_model.enabled and record.spec.two_player):
        raise UserError(f"{folder} has no world model of a two-player game")
    saved = restore(record, reporter)
    model = saved.model
    play_as = functools.partial(rules_kept, saved.agent, model.policy_state, model.world_model, model.tokenizer)
    kept = {}
    for name in ("agent", "uniform"):
        reporter.message(f"imagining {games} games, {name} play")
        kept[name] = play_as(jax.random.key(0), games, uniform=name == "uniform")
    return kept
