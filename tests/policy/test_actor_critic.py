"""The network as a whole: the paper's sizes, and one function however it is called."""

from __future__ import annotations

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from suite.configuration.schema import PolicyConfig
from suite.interface.environment import ObservationSpec
from suite.policy.actor_critic import (
    ActorCritic,
    UniformPolicy,
    log_probability,
    make_policy,
    mask_logits,
)

CRAFTAX = ObservationSpec((63, 63, 3), 255, "pixels", (7, 7))
PICTURE = ObservationSpec((9, 8, 3), 255, "pixels", (3, 4))
SYMBOLS = ObservationSpec((4,), 5, "symbols")
TINY = PolicyConfig(cnn_channels=(4, 4), hidden_size=12, rnn_size=6)


def structure(config: PolicyConfig, observation: ObservationSpec, num_actions: int):
    """The network's shapes; nothing is allocated."""
    return nnx.eval_shape(lambda: ActorCritic(config, observation, num_actions, nnx.Rngs(0)))


def count(module) -> int:
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(nnx.state(module, nnx.Param)))


@functools.cache
def built(observation: ObservationSpec, config: PolicyConfig):
    return nnx.jit(lambda: make_policy(config, observation, 3, nnx.Rngs(0)))()


def build(observation: ObservationSpec, **changes):
    """A network of one's own, to change at will."""
    return nnx.clone(built(observation, dataclasses.replace(TINY, **changes)))


def tiny(observation: ObservationSpec = PICTURE, **changes) -> ActorCritic:
    policy = build(observation, **changes)
    # The head starts near zero; tests must see what the rest of the network says.
    policy.policy_head.kernel[...] = 100.0 * policy.policy_head.kernel[...]
    return policy


@nnx.jit
def call(policy, *inputs):
    return policy(*inputs)


def frames(observation: ObservationSpec, steps: int, batch: int, seed: int = 0) -> jax.Array:
    shape = (steps, batch, *observation.shape)
    return jax.random.randint(jax.random.key(seed), shape, 0, observation.high + 1).astype(jnp.uint8)


@pytest.mark.parametrize(
    ("changes", "parameters"),
    [
        ({}, 55_599_768),  # the paper's 55.6M
        # Its text read literally, which has no projection behind the GRU; ours, 256 -> 256, stays.
        ({"cnn_channels": (64, 64, 128), "convs_per_block": 1}, 54_536_152 + 256 * 256 + 256),
    ],
)
def test_parameter_count(changes, parameters):
    assert count(structure(PolicyConfig(**changes), CRAFTAX, 17)) == parameters


def test_sizes_of_the_paper():
    """z 8192; actor and critic see [y, z], 8448 numbers (Appendix A.1.1, fidelity note 2)."""
    policy = structure(PolicyConfig(), CRAFTAX, 17)
    assert policy.embed.features == 8192
    assert policy.memory.input.kernel.shape == (8192, 256)
    assert [trunk.first.kernel.shape for trunk in policy.trunks] == [(8448, 2048)] * 2
    assert policy.policy_head.kernel.shape == (2048, 17)


def test_large_pictures_are_resized():
    """Craftax-full is 130x110; the actor-critic input stays 8448 (fidelity note 4)."""
    observation = ObservationSpec((130, 110, 3), 255, "pixels", (10, 10))
    policy = structure(PolicyConfig(), observation, 43)
    assert policy.trunks[0].first.kernel.shape[0] == 8448
    assert structure(PolicyConfig(), CRAFTAX, 17).resized is None

    large = dataclasses.replace(observation, shape=(126, 189, 3))
    resized, plain = tiny(large, hidden_size=4), tiny(CRAFTAX, hidden_size=4)
    nnx.update(plain, nnx.state(resized))
    frame = frames(large, 1, 1)
    first, hidden_BH = jnp.zeros((1, 1), bool), resized.initial_hidden(1)
    output, _ = call(resized, frame, first, hidden_BH)
    expected, _ = call(plain, frame[:, :, 1::2, 1::3], first, hidden_BH)  # the pixel at each cell's center
    np.testing.assert_allclose(output.logits_TBA, expected.logits_TBA, rtol=1e-5, atol=1e-6)


def test_minatar_sizes():
    """Fidelity note 5: 2x2x128 from the CNN, so 768 with the memory; one trunk for both heads."""
    config = PolicyConfig(cnn_norm="layer", activation="swish", shared_trunk=True)
    policy = structure(config, ObservationSpec((10, 10, 4), 1, "grid", (1, 1)), 3)
    assert policy.trunks[0].first.kernel.shape == (768, 2048)
    assert len(policy.trunks) == 1


@pytest.mark.parametrize("observation", [PICTURE, SYMBOLS], ids=["picture", "symbols"])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("rnn_size", [6, 0])
def test_a_sequence_is_its_steps(observation, masked, rnn_size):
    policy = tiny(observation, rnn_size=rnn_size)
    steps, batch = 5, 3
    frame_TB = frames(observation, steps, batch)
    first_TB = jax.random.bernoulli(jax.random.key(1), 0.4, (steps, batch))
    acting_TB = jax.random.bernoulli(jax.random.key(2), 0.5, (steps, batch)) if masked else None
    start_BH = hidden_BH = jax.random.normal(jax.random.key(3), (batch, rnn_size))

    output, last_BH = call(policy, frame_TB, first_TB, hidden_BH, acting_TB)
    for t in range(steps):
        acting = None if acting_TB is None else acting_TB[t : t + 1]
        step, hidden_BH = call(policy, frame_TB[t : t + 1], first_TB[t : t + 1], hidden_BH, acting)
        np.testing.assert_allclose(step.logits_TBA[0], output.logits_TBA[t], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(step.value_TB[0], output.value_TB[t], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(hidden_BH, last_BH, rtol=1e-4, atol=1e-5)
    advanced_BH = policy.advance(frame_TB, first_TB, start_BH, acting_TB)
    np.testing.assert_allclose(advanced_BH, last_BH, rtol=1e-3, atol=1e-5)


def test_memory_reaches_the_heads_but_not_across_an_episode():
    policy = tiny(SYMBOLS)
    frame_TB, first_TB = frames(SYMBOLS, 2, 1), jnp.zeros((2, 1), bool)
    hidden_BH = jax.random.normal(jax.random.key(3), (1, 6))

    def influence(first_TB):
        def last(h):
            output, _ = policy(frame_TB, first_TB, h)
            return output.logits_TBA[-1, 0, 0] + output.value_TB[-1, 0]

        return jnp.abs(jax.jit(jax.grad(last))(hidden_BH)).max()

    assert influence(first_TB) > 1e-6
    assert influence(first_TB.at[1].set(True)) == 0.0


def test_actor_and_critic_share_nothing_after_the_embedding_unless_told_to():
    frame_TB, first_TB = frames(SYMBOLS, 1, 2), jnp.ones((1, 2), bool)
    for shared in (False, True):
        policy = tiny(SYMBOLS, shared_trunk=shared)
        before, _ = call(policy, frame_TB, first_TB, policy.initial_hidden(2))
        policy.trunks[0].first.kernel[...] = jnp.flip(policy.trunks[0].first.kernel[...])
        after, _ = call(policy, frame_TB, first_TB, policy.initial_hidden(2))
        assert not np.allclose(before.logits_TBA, after.logits_TBA)
        assert np.allclose(before.value_TB, after.value_TB) != shared


def test_initial_gains_of_heads():
    """Policy head 0.01, value head 1.0 (fidelity note 3): a fresh policy is almost uniform."""
    policy = build(PICTURE)
    for head, gain in ((policy.policy_head, 0.01), (policy.value_head, 1.0)):
        singular = np.linalg.svd(np.asarray(head.kernel[...]), compute_uv=False)
        np.testing.assert_allclose(singular, gain, rtol=1e-3)
        assert not head.bias[...].any()
    output, _ = call(policy, frames(PICTURE, 1, 4), jnp.ones((1, 4), bool), policy.initial_hidden(4))
    np.testing.assert_allclose(jax.nn.softmax(output.logits_TBA), 1 / 3, atol=0.03)


def test_bfloat16_stays_inside():
    policy = tiny(compute_type="bfloat16")
    output, hidden_BH = call(policy, frames(PICTURE, 2, 2), jnp.zeros((2, 2), bool), policy.initial_hidden(2))
    assert output.logits_TBA.dtype == output.value_TB.dtype == hidden_BH.dtype == jnp.float32
    exact, _ = call(tiny(), frames(PICTURE, 2, 2), jnp.zeros((2, 2), bool), policy.initial_hidden(2))
    np.testing.assert_allclose(output.logits_TBA, exact.logits_TBA, atol=0.1)


def test_networks_of_several_seeds_run_side_by_side():
    graphdef = nnx.graphdef(structure(TINY, PICTURE, 3))
    frame_TB, first_TB = frames(PICTURE, 2, 2), jnp.zeros((2, 2), bool)

    @jax.jit
    @jax.vmap
    def logits(key):
        policy = nnx.merge(graphdef, nnx.state(make_policy(TINY, PICTURE, 3, nnx.Rngs(key))))
        return policy(frame_TB, first_TB, policy.initial_hidden(2))[0].logits_TBA

    first, second = logits(jax.random.split(jax.random.key(0), 2))
    assert first.shape == (2, 2, 3) and not np.allclose(first, second)


def test_uniform_policy():
    policy = build(PICTURE, kind="uniform")
    assert isinstance(policy, UniformPolicy) and count(policy) == 0
    hidden_BH = policy.initial_hidden(2)
    first_TB = jnp.zeros((4, 2), bool)
    output, after_BH = call(policy, frames(PICTURE, 4, 2), first_TB, hidden_BH)
    assert output.logits_TBA.shape == (4, 2, 3) and not output.logits_TBA.any() and not output.value_TB.any()
    assert after_BH.shape == policy.advance(frames(PICTURE, 4, 2), first_TB, hidden_BH).shape == (2, 0)


def test_illegal_actions_have_probability_zero_and_finite_gradients():
    logits = jnp.array([1.0, 2.0, 3.0])
    legal = jnp.array([True, False, True])
    probability = jax.nn.softmax(mask_logits(logits, legal))
    assert probability[1] == 0.0 and probability.sum() == pytest.approx(1.0)
    assert mask_logits(logits, None) is logits
    expected = np.log(np.exp(3.0) / (np.exp(1.0) + np.exp(3.0)))
    taken = jnp.int32(2)
    assert log_probability(mask_logits(logits, legal), taken) == pytest.approx(expected, rel=1e-5)
    gradient = jax.grad(lambda x: log_probability(mask_logits(x, legal), taken))(logits)
    assert jnp.isfinite(gradient).all() and gradient[1] == 0.0
