"""A world model that has learned a tiny game of two players and chance."""

from __future__ import annotations

import functools

import jax
import pytest

from suite import registry
from suite.agent.phases import Agent
from tests.tiny import PENNIES, Pennies

PLAYS, UPDATES = 12, 60


def agent_of(**overrides) -> Agent:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "TASKS", (PENNIES,))
        changes = [f"{name.replace('__', '.')}={value}" for name, value in overrides.items()]
        return Agent(registry.resolve("pennies", "m5", "smoke", changes), Pennies())


@functools.cache
def played():
    """An agent and its state after random play and no learning."""
    agent = agent_of(
        world_model__updates=10,
        world_model__layers=2,
        world_model__sequences=32,
        imagination__num_envs=64,
        imagination__horizon=4,
    )
    state = agent.init(jax.random.key(0))
    rollout_state, replay = state.rollout, state.replay
    for i in range(PLAYS):
        rollout_state, trajectory, _ = agent.collect(state.policy.acting, rollout_state, jax.random.key(i))
        replay = agent.remember(replay, trajectory)
    return agent, state.replace(rollout=rollout_state), replay, trajectory


@functools.cache
def learned():
    """The same, its world model trained, and the last metrics."""
    agent, state, replay, _ = played()
    model = state.world_model
    for i in range(UPDATES):
        model, metrics = agent.update_world_model(model, state.tokenizer, replay, jax.random.key(100 + i))
    return agent, state, replay, model, jax.device_get(metrics)
