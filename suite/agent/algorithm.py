"""Algorithm 1: one iteration of real play, learning from it, the world model and dreams, in the paper's order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from suite.agent.phases import Agent
from suite.agent.seeds import split
from suite.agent.state import TrainState, laid_out

Call = Callable[..., Any]
Steps = int | np.ndarray


def start_key(seed: int) -> jax.Array:
    """Randomness of a fresh agent."""
    return jax.random.fold_in(jax.random.key(seed), 0)


def evaluation_key(seed: int, step: int) -> jax.Array:
    """Randomness of the evaluation at a step, apart from training's."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 1), step)


def iteration_key(seed: int, iteration: int) -> jax.Array:
    """Randomness of an iteration, which depends on nothing else: a run that goes on needs no other."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 2), iteration)


def first_programs(agent: Agent, state: TrainState) -> Iterator[tuple[str, jax.stages.Lowered]]:
    """What a run's first iteration will call, dreams apart, by phase and in its order: traced, and not yet compiled.

    Args:
      agent: whose phases they are.
      state: shapes and dtypes of a fresh state, from `jax.eval_shape`, laid out.
    """
    each = () if agent.seeds == 1 else (agent.seeds,)
    key = laid_out(jax.ShapeDtypeStruct(each, jax.eval_shape(lambda: start_key(0)).dtype))
    policy_state, replay, tokenizer, world_model = state.policy, state.replay, state.tokenizer, state.world_model
    collected = Agent.collect.lower(agent, policy_state.acting, state.rollout, key)
    yield "collect", collected
    trajectory = laid_out(collected.out_info[1])
    if replay is not None:
        yield "remember", Agent.remember.lower(agent, replay, trajectory)
    if agent.learns_from_real:
        steps = laid_out(jax.ShapeDtypeStruct((*each, 2), jnp.float32))
        yield "learn", Agent.learn.lower(agent, policy_state, trajectory, steps)
    if world_model is not None and tokenizer is not None:
        yield "tokenizer", Agent.update_tokenizer.lower(agent, tokenizer, replay, key)
        if agent.lasting_tokenizer is not None:
            yield "code", Agent.code.lower(agent, replay, tokenizer, tokenizer.count)
        yield "world_model", Agent.update_world_model.lower(agent, world_model, tokenizer, replay, key)


def plain_call(phase: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """`function(*arguments)`."""
    return function(*arguments)


def iterate(
    agent: Agent,
    state: TrainState,
    key: jax.Array,
    steps: Steps,
    call: Call = plain_call,
    imagined_updates: Callable[[int, float | None], int] | None = None,
) -> tuple[TrainState, Steps]:
    """One iteration of Algorithm 1.

    Args:
      agent: whose phases are run.
      state: before it; its arrays are donated.
      key: of its randomness; of several seeds one for each, [S].
      steps: real steps taken before it, of several seeds int [S]; an event of chance is none (note 32).
      call: runs each phase, `call(phase, function, *arguments)`, and returns what the function does, so that whoever
        asks can time it and see its results. Phases are collect, remember, learn, tokenizer, code, world_model and
        imagine; learn, tokenizer, world_model and imagine also return their metrics. Those of dreams are nan for a
        seed that dreams not at all beside others that do.
      imagined_updates: how many there are after so many steps, given what share of new rewards the world model knew, if
        that is measured; None: as the configuration says.

    Returns:
      the state after it, and the real steps taken by then.
    """
    imagined_updates = imagined_updates or agent.config.imagined_updates
    collect_key, tokenizer_key, model_key, dream_key = split(key, 4)
    policy_state, rollout_state, replay = state.policy, state.rollout, state.replay
    tokenizer, world_model = state.tokenizer, state.world_model
    del state

    # Step 1: N_env environments play T_env real steps, which enter the replay buffer.
    rollout_state, trajectory, log = call("collect", agent.collect, policy_state.acting, rollout_state, collect_key)
    before, steps = steps, steps + np.asarray(log.counts_TB).sum((-2, -1))
    if replay is not None:
        replay = call("remember", agent.remember, replay, trajectory)

    # Step 2: the policy learns from them.
    if agent.learns_from_real:
        taken = jnp.asarray(np.stack([before, steps], -1), jnp.float32)
        policy_state, _ = call("learn", agent.learn, policy_state, trajectory, taken)
    del trajectory, log  # their memory is the world model's now

    # Step 3: tokenizer and world model learn from replayed steps.
    known = None
    if world_model is not None:
        lasting = agent.lasting_tokenizer is not None
        codes = jnp.copy(tokenizer.count) if lasting and tokenizer is not None else None
        tokenizer, _ = call("tokenizer", agent.update_tokenizer, tokenizer, replay, tokenizer_key)
        if lasting:
            replay = call("code", agent.code, replay, tokenizer, codes)
        world_model, metrics = call("world_model", agent.update_world_model, world_model, tokenizer, replay, model_key)
        known = np.asarray(metrics["reward_known"], float) if "reward_known" in metrics else None

    # Step 4: the policy learns from dreams, which begin at replayed frames.
    updates = np.vectorize(imagined_updates, otypes=[int])(steps, known)
    if updates.any():
        dreamt = None if world_model is None else world_model.dreaming
        when = jnp.asarray(updates, jnp.int32), jnp.asarray(steps, jnp.float32)
        policy_state, _ = call("imagine", agent.imagine, policy_state, dreamt, tokenizer, replay, dream_key, *when)
    return TrainState(policy_state, rollout_state, replay, tokenizer, world_model), steps
