"""PPO learns, and what needs a memory only with one."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from flax import nnx, struct

from suite.agent import rollout as play
from suite.configuration.schema import PolicyConfig, PPOConfig
from suite.interface.batching import Batched
from suite.interface.environment import EnvironmentSpec, ObservationSpec, TimeStep
from suite.policy import ppo
from suite.policy.actor_critic import make_policy

CUE_LENGTH = 3


@struct.dataclass
class CueState:
    cue: jax.Array
    time: jax.Array


class Cue:
    """Shows one of two cues at time 0, blanks after; the action at the last step must name the cue (1 or -1)."""

    spec = EnvironmentSpec("cue", ObservationSpec((1,), 2, "symbols"), 2, (-1.0, 0.0, 1.0))

    def reset(self, key):
        state = CueState(jax.random.randint(key, (), 0, 2), jnp.int32(0))
        return state, self._show(state, jnp.float32(0), jnp.zeros((), bool), jnp.ones((), bool))

    def step(self, key, state, action):
        done = state.time == CUE_LENGTH - 1
        reward = jnp.where(done, jnp.where(action == state.cue, 1.0, -1.0), 0.0)
        state = state.replace(time=state.time + 1)
        return state, self._show(state, reward, done, jnp.zeros((), bool))

    def _show(self, state, reward, terminated, first):
        observation = jnp.where(state.time == 0, 1 + state.cue, 0).astype(jnp.uint8)[None]
        no = jnp.zeros((), bool)
        return TimeStep(observation, reward, terminated, no, first, observation, {})


def learn_cue(rnn_size: int, iterations: int = 60) -> float:
    """The mean outcome of the last iterations' episodes, in [-1, 1]; 0 is chance."""
    config = PPOConfig(learning_rate=3e-3, discount=0.9)
    environment = Batched(Cue(), 32)
    policy_config = PolicyConfig(hidden_size=32, rnn_size=rnn_size, dense_blocks=1)
    new_policy = functools.partial(make_policy, policy_config, environment.spec.observation, 2)
    graphdef, params = nnx.split(nnx.jit(lambda: new_policy(nnx.Rngs(0)))())
    optimizer = ppo.make_optimizer(config)

    def iteration(carry, key):
        policy_state, rollout_state = carry
        policy = nnx.merge(graphdef, policy_state.params)
        rollout_state, trajectory, log = play.rollout(
            key, policy, policy_state.targets, environment, rollout_state, 4 * CUE_LENGTH
        )
        policy_state, _ = ppo.update(
            config, optimizer, graphdef, policy_state, trajectory, epochs=4, minibatches=2, entropy_coefficient=0.01
        )
        return (policy_state, rollout_state), log.return_TB.mean(where=log.ended_TB)

    @jax.jit
    def train(params):
        policy_state = ppo.PolicyTrainState.create(config, optimizer, params)
        rollout_state = play.start(nnx.merge(graphdef, params), environment, jax.random.key(1), burn_in=0)
        return jax.lax.scan(iteration, (policy_state, rollout_state), jax.random.split(jax.random.key(2), iterations))[
            1
        ]

    return float(train(params)[-10:].mean())


def test_ppo_learns_what_needs_memory():
    assert learn_cue(rnn_size=16) > 0.9


def test_without_memory_it_stays_at_chance():
    assert abs(learn_cue(rnn_size=0)) < 0.15
