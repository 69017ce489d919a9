"""The correspondence head: a mixture of copying from around a place and of making a token new."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from suite.interface.tokens import TokenSpec
from suite.nn.sampling import draw
from suite.runtime.errors import UserError
from suite.world_model import training
from suite.world_model.correspondence import OUTSIDE, inside, mixture_loss, mixture_odds, neighbourhood
from suite.world_model.sequences import Sequences
from suite.world_model.transformer import WorldModel
from tests.world_model.small import small_config

GRID, CODES, SOURCES = (3, 4), 5, 9
PLACES = GRID[0] * GRID[1]
TOKENS = TokenSpec(tokens_per_frame=PLACES, num_codes=CODES, num_actions=3, reward_classes=(0.0, 1.0))


def parts(seed: int = 0, batch: int = 2, dtype=jnp.float32):
    """Logits, normalised gates, sources and targets, all random."""
    keys = jax.random.split(jax.random.key(seed), 4)
    frame = jax.random.randint(keys[0], (batch, PLACES), 0, CODES)
    gate = jax.random.normal(keys[1], (batch, PLACES, 1 + SOURCES), dtype)
    open_LS = np.pad(inside(GRID, 1), ((0, 0), (1, 0)), constant_values=True)
    return (
        2 * jax.random.normal(keys[2], (batch, PLACES, CODES), dtype),
        jax.nn.log_softmax(jnp.where(open_LS[None], gate, -jnp.inf)),
        neighbourhood(frame, GRID, 1, 1, OUTSIDE),
        jax.random.randint(keys[3], (batch, PLACES), 0, CODES),
    )


def test_the_neighbours_of_a_place():
    place = jnp.arange(PLACES)
    around = np.asarray(neighbourhood(place, GRID, 1, 0, OUTSIDE))
    assert around[5].tolist() == [0, 1, 2, 4, 5, 6, 8, 9, 10]
    assert around[0].tolist() == [-1, -1, -1, -1, 0, 1, -1, 4, 5]
    assert around[11].tolist() == [6, 7, -1, 10, 11, -1, -1, -1, -1]
    assert neighbourhood(place, GRID, 0, 0).tolist() == [[i] for i in range(PLACES)]
    assert (inside(GRID, 1) == (around >= 0)).all()


def test_odds_sum_to_one_and_are_those_of_the_loss():
    logits, log_gate, source, target = parts()
    odds = mixture_odds(jax.nn.softmax(logits), log_gate, source)
    np.testing.assert_allclose(odds.sum(-1), 1, rtol=1e-5)
    loss, correct, copied = mixture_loss(logits, log_gate, source, target)
    chosen = jnp.take_along_axis(odds, target[..., None], axis=-1)[..., 0]
    np.testing.assert_allclose(jnp.exp(-loss), chosen, rtol=1e-5)
    np.testing.assert_array_equal(correct, odds.argmax(-1) == target)
    assert 0 < correct.mean() < 1
    np.testing.assert_allclose(copied, 1 - jnp.exp(log_gate[..., 0]), rtol=1e-5)


def test_what_stands_outside_the_frame_is_never_copied():
    _, log_gate, source, _ = parts()
    outside = np.broadcast_to(~inside(GRID, 1), source.shape)
    assert (np.asarray(source)[outside] == OUTSIDE).all() and (np.asarray(source)[~outside] >= 0).all()
    assert (np.exp(np.asarray(log_gate))[..., 1:][outside] == 0).all()


def test_tokens_are_drawn_with_the_odds():
    logits, log_gate, source, _ = parts(batch=1)
    odds = mixture_odds(jax.nn.softmax(logits), log_gate, source)
    drawn = draw(jax.random.key(1), jnp.broadcast_to(odds, (40_000, PLACES, CODES)))
    shares = jax.nn.one_hot(drawn, CODES).mean(0)
    np.testing.assert_allclose(shares, odds[0], atol=5 * np.sqrt(0.25 / 40_000))


def test_codes_below_min_p_are_not_drawn_and_the_rest_keep_their_odds():
    odds = jnp.array([0.5, 0.3, 0.15, 0.05])
    drawn = draw(jax.random.key(0), jnp.broadcast_to(odds, (40_000, 1, 4)), min_p=0.35)
    shares = jax.nn.one_hot(drawn[:, 0], 4).mean(0)
    np.testing.assert_allclose(shares, [0.625, 0.375, 0, 0], atol=5 * np.sqrt(0.25 / 40_000))


def model_of(seed: int = 0, **changes) -> WorldModel:
    return WorldModel(small_config(**changes), TOKENS, GRID, nnx.Rngs(seed))


def sequences(batch: int = 2, steps: int = 3) -> Sequences:
    keys = jax.random.split(jax.random.key(7), 4)
    return Sequences(
        tokens_BTL=jax.random.randint(keys[0], (batch, steps + 1, PLACES), 0, CODES),
        action_BT=jax.random.randint(keys[1], (batch, steps), 0, 3),
        reward_BT=jax.random.bernoulli(keys[2], 0.3, (batch, steps)).astype(jnp.float32),
        terminated_BT=jax.random.bernoulli(keys[3], 0.2, (batch, steps)),
    )


def test_with_the_gates_at_new_it_is_the_plain_head_to_the_bit():
    plain, head = model_of(), model_of(correspondence=True)
    never = jnp.full((1 + SOURCES,), -jnp.inf).at[0].set(0.0)
    head.gate_head.kernel[...] *= 0
    head.gate_head.bias[...] = never
    real = sequences()
    frame, action, valid = real.tokens_BTL[:, 0], real.action_BT[:, 0], jnp.arange(CODES) < 4
    cache = plain.init_cache(2, 1)
    _, hidden = plain.step(cache, frame, action)
    _, same_hidden = head.step(cache, frame, action)
    np.testing.assert_array_equal(hidden, same_hidden)
    np.testing.assert_array_equal(plain.token_odds(hidden, frame, valid), head.token_odds(hidden, frame, valid))
    losses, same = (training.losses(model, real, model.config, TOKENS)[1] for model in (plain, head))
    assert same.pop("copied_share") == 0
    for name, value in losses.items():
        np.testing.assert_allclose(value, same[name], rtol=1e-6, err_msg=name)


def test_gradients_are_those_of_finite_differences():
    with jax.enable_x64():
        logits, log_gate, source, target = parts(batch=1, dtype=jnp.float64)

        def loss(logits, gate):
            return mixture_loss(logits, jax.nn.log_softmax(gate), source, target)[0].sum()

        gradients = jax.grad(loss, argnums=(0, 1))(logits, log_gate)
        for argument, gradient in enumerate(gradients):
            place = [logits, log_gate][argument]
            for index in [(0, 0, 0), (0, 5, 2), (0, 6, 4), (0, 11, 1)]:
                if not jnp.isfinite(place[index]):
                    assert gradient[index] == 0  # a source outside the frame
                    continue
                step, ends = 1e-6, []
                for sign in (1, -1):
                    moved = [logits, log_gate]
                    moved[argument] = place.at[index].add(sign * step)
                    ends.append(loss(*moved))
                np.testing.assert_allclose(gradient[index], (ends[0] - ends[1]) / (2 * step), rtol=1e-6, atol=1e-9)


def test_learning_to_shift():
    """A frame that is the one before, moved by a column: three columns of four are copied, the first is new."""
    spec = dataclasses.replace(TOKENS, num_codes=50)
    config = small_config(correspondence=True, positions="grid", initial_std=0.1, learning_rate=3e-3)
    graph, params = nnx.split(WorldModel(config, spec, GRID, nnx.Rngs(0)))
    optimizer = training.make_optimizer(config)

    def batch(key):
        first = jax.random.randint(key, (16, 1, *GRID), 0, 50)
        moved = jnp.pad(first[..., :-1], [(0, 0)] * 3 + [(1, 0)])
        none = jnp.zeros((16, 1))
        tokens = jnp.concatenate([first, moved], axis=1).reshape(16, 2, PLACES)
        return Sequences(tokens, none.astype(jnp.int32), none, none.astype(bool))

    def update(model_state, key):
        return training.update(config, optimizer, graph, spec, model_state, batch(key), key)

    model_state = training.WorldModelTrainState(params, optimizer.init(params))
    _, metrics = jax.jit(lambda *x: jax.lax.scan(update, *x))(model_state, jax.random.split(jax.random.key(0), 300))
    assert metrics["token_accuracy"][-20:].mean() > 0.98  # 50 codes were never learned one by one in so many updates
    assert metrics["copied_share"][-20:].mean() == pytest.approx(0.75, abs=0.05)


@pytest.mark.parametrize("other", ["world_model.block_teacher_forcing=false", "tokenizer.kind=continuous"])
def test_only_with_codes_and_block_teacher_forcing(other):
    from suite import registry

    with pytest.raises(UserError, match=r"world_model\.correspondence=true needs"):
        registry.resolve("craftax_classic", "m5", "smoke", ["world_model.correspondence=true", other])
