"""Does a game's world model keep the rules? Imagined play, replayed event by event in the real game.

`python -m suite.diagnostics.rules RUN_DIR` prints it for the newest checkpoint of a run.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx, struct

from suite import checkpoint
from suite.agent.dyna import Agent
from suite.errors import UserError
from suite.evaluation import agent_for, model_template
from suite.interface.turns import CHANCE, Turn, choose_event
from suite.record import RunRecord
from suite.reporting import QuietReporter
from suite.world_model.imagination import Dream

WARM_UP = 32  # events of real play, and one more for every batch, so that imagined play starts anywhere in a game


@struct.dataclass
class Comparison:
    """Imagined events beside the real ones that the same event would have led to; all [T, B].

    Attributes:
      counted: the event belongs to the imagined play before its first illegal event or end, real or imagined.
      legal: the event is possible in the real game.
      player, legal_set, observations, reward, terminated: what it led to is right. After an end, where the next game
        begins by chance, nothing but reward and end is compared.
      chance_error: total variation distance of chance's odds; where chance is really next.
      chance_next, goes_on: where `chance_error`, and where all but `reward` and `terminated`, are counted.
    """

    counted: jax.Array
    legal: jax.Array
    player: jax.Array
    legal_set: jax.Array
    observations: jax.Array
    reward: jax.Array
    terminated: jax.Array
    chance_error: jax.Array
    chance_next: jax.Array
    goes_on: jax.Array


def rules_kept(agent: Agent, world_model: nnx.State, tokenizer: Any, key: jax.Array, plays: int) -> dict[str, float]:
    """How often imagined events keep the rules, in percent.

    Imagined play starts from real positions after random play, lasts up to `imagination.horizon` events, and everybody
    moves uniformly among what the model says is legal, chance by the odds that it says.

    Args:
      agent: of a two-player task; its environment's `step` must be a function of state and event alone.
      world_model, tokenizer: their parameters and state.
      key: of the random play.
      plays: at least so many imagined plays.

    Returns:
      legal_percent, player_percent, legal_set_percent, observations_percent, reward_percent, terminated_percent,
      chance_error_percent (mean total variation distance), plays, events (how many were compared).
    """
    parts = []
    compare = jax.jit(_compare, static_argnums=0)
    for i in range(-(-plays // agent.batched.num_envs)):
        parts.append(jax.device_get(compare(agent, world_model, tokenizer, jax.random.fold_in(key, i), WARM_UP + i)))
    all_TB: Comparison = jax.tree.map(lambda *x: np.concatenate(x, axis=1), *parts)

    def percent(value, where) -> float:
        return 100 * float(value[where].mean()) if where.any() else float("nan")

    followed = all_TB.counted & all_TB.legal
    names = {"player": all_TB.player, "legal_set": all_TB.legal_set, "observations": all_TB.observations}
    return {
        "legal_percent": percent(all_TB.legal, all_TB.counted),
        **{f"{name}_percent": percent(value, followed & all_TB.goes_on) for name, value in names.items()},
        "reward_percent": percent(all_TB.reward, followed),
        "terminated_percent": percent(all_TB.terminated, followed),
        "chance_error_percent": percent(all_TB.chance_error, followed & all_TB.chance_next),
        "plays": all_TB.counted.shape[1],
        "events": int(all_TB.counted.sum()),
    }


def _compare(agent: Agent, world_model: nnx.State, tokenizer: Any, key: jax.Array, warm_up: int) -> Comparison:
    batched = agent.batched
    start_key, warm_key, play_key = jax.random.split(key, 3)

    def anyone(key: jax.Array, turn: Turn) -> jax.Array:
        """Everybody plays as `choose_event` lets the opponent play."""
        no_seat = jnp.zeros_like(turn.seat) - 1
        return choose_event(key, turn.replace(seat=no_seat), jnp.zeros_like(turn.player))  # type: ignore[attr-defined]

    def real_event(i, carry):
        state, shown = carry
        event_key, step_key = jax.random.split(jax.random.fold_in(warm_key, i))
        return batched.step(step_key, state, anyone(event_key, shown.turn))

    real = jax.lax.fori_loop(0, warm_up, real_event, batched.reset(start_key))
    model = nnx.merge(agent.world_model_graph, world_model)
    horizon = agent.config.imagination.horizon
    shown = real[1]
    dream = Dream(model, agent.tokenizer, tokenizer, agent.spec, agent.tokens, horizon, shown.observation, shown.turn)

    def event(carry, key):
        (state, before), (dreamed_state, dreamed_before), alive_B = carry
        event_key, dream_key = jax.random.split(key)
        event_B = anyone(event_key, dreamed_before.turn)
        possible_BN = jnp.concatenate([before.turn.legal_A, before.turn.chance_C > 0], axis=1)
        offset_B = jnp.where(dreamed_before.turn.player == CHANCE, agent.spec.num_actions, 0)
        legal_B = jnp.take_along_axis(possible_BN, (event_B + offset_B)[:, None], axis=1)[:, 0]
        # One single environment's step, without a reset: the end itself is compared.
        no_keys = jax.random.split(dream_key, batched.num_envs)
        state, after = jax.vmap(batched.environment.step)(no_keys, state, event_B)
        dreamed_state, dreamed = dream.step(dream_key, dreamed_state, event_B)
        wanted, seen = after.turn, dreamed.turn
        assert wanted is not None and seen is not None
        rewards = agent.tokens
        chance_B = (wanted.player == CHANCE) & ~after.terminated
        result = Comparison(
            counted=alive_B,
            legal=legal_B,
            player=seen.player == wanted.player,
            legal_set=(seen.legal_A == wanted.legal_A).all(-1),
            observations=(dreamed.observation == after.observation).all(-1)
            & (seen.opponent_observation == wanted.opponent_observation).all(-1),
            reward=rewards.reward_to_class(dreamed.reward) == rewards.reward_to_class(after.reward),
            terminated=dreamed.terminated == after.terminated,
            chance_error=jnp.abs(seen.chance_C - wanted.chance_C).sum(-1) / 2,
            chance_next=chance_B & ~dreamed.terminated,
            goes_on=~after.terminated & ~dreamed.terminated,
        )
        alive_B = alive_B & legal_B & ~after.terminated & ~dreamed.terminated
        return ((state, after), (dreamed_state, dreamed), alive_B), result

    alive_B = jnp.ones(batched.num_envs, bool)
    carry = (real, dream.reset(play_key), alive_B)
    return jax.lax.scan(event, carry, jax.random.split(play_key, horizon))[1]


def rules_of_run(folder: Path, plays: int = 1_000) -> dict[str, float]:
    """`rules_kept` by the newest checkpoint of a run folder.

    Raises:
      UserError: no run folder, no checkpoint, no world model or no two-player game.
    """
    record = RunRecord.open(folder, lock=False)
    config = record.config
    if not (config.world_model.enabled and record.spec.two_player):
        raise UserError(f"{folder} has no world model of a two-player game")
    agent = agent_for(config, QuietReporter())
    template = jax.eval_shape(agent.init, jax.random.key(0))
    restored = checkpoint.restore_latest(folder / "checkpoints", model_template(template))
    if restored is None:
        raise UserError(f"{folder} has no checkpoint")
    return rules_kept(agent, restored.model["world_model"], restored.model["tokenizer"], jax.random.key(0), plays)


if __name__ == "__main__":
    for name, value in rules_of_run(Path(sys.argv[1])).items():
        print(f"{name} {value:.2f}")
