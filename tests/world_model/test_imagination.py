"""A small deterministic game is learned, and the dream of it then is the game."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from suite.interface.batching import Batched
from suite.interface.environment import EnvironmentSpec, ObservationSpec, TimeStep
from suite.nn.sampling import draw
from suite.tokenizers.nearest_neighbor import NearestNeighborTokenizer
from suite.world_model import training
from suite.world_model.heads import filled_odds
from suite.world_model.history import History, ages_of
from suite.world_model.imagination import Dream, Past
from suite.world_model.sequences import Sequences
from suite.world_model.transformer import WorldModel
from tests.world_model.small import SPEC, small_config, small_model

HORIZON = 5
FRAMES = ObservationSpec(shape=(2, 3, 1), high=255, kind="pixels", patch=(1, 1))


class Walk:
    """A walker on a 2 x 3 torus of one color, which turns when it changes rows: 18 states.

    Action 0 changes rows, 1 and 2 go right and left. Arriving at cell 5 pays 1. Arriving at cell 3 ends the episode;
    all begin in cell 0 in the first color, so that even the next frame is certain.
    """

    spec = EnvironmentSpec("walk", FRAMES, num_actions=3, reward_classes=(0.0, 1.0))

    def reset(self, key: jax.Array) -> tuple[jax.Array, TimeStep]:
        state = jnp.zeros((2,), jnp.int32)
        no = jnp.zeros((), bool)
        return state, self._show(state, jnp.float32(0), no, ~no)

    def step(self, key: jax.Array, state: jax.Array, action: jax.Array) -> tuple[jax.Array, TimeStep]:
        cell, color = state
        down, right = jnp.asarray([1, 0, 0])[action], jnp.asarray([0, 1, -1])[action]
        state = jnp.stack([(cell // 3 + down) % 2 * 3 + (cell % 3 + right) % 3, (color + down) % 3])
        return state, self._show(state, (state[0] == 5).astype(jnp.float32), state[0] == 3, jnp.zeros((), bool))

    def _show(self, state, reward, terminated, first) -> TimeStep:
        cell, color = state
        frame = jnp.where(jnp.arange(6) == cell, 0, 85 * (color + 1)).astype(jnp.uint8).reshape(FRAMES.shape)
        return TimeStep(frame, reward, terminated, jnp.zeros((), bool), first, frame, {})


@dataclasses.dataclass
class Learned:
    model: WorldModel
    tokenizer: NearestNeighborTokenizer
    codes: Any
    accuracy: float


def play(environment, key: jax.Array, action_TB: jax.Array) -> tuple[TimeStep, TimeStep]:
    """The first time step, and those that the actions lead to [T, B]."""
    state, start = environment.reset(key)
    keys = jax.random.split(key, len(action_TB))
    _, steps = jax.lax.scan(lambda state, x: environment.step(x[0], state, x[1]), state, (keys, action_TB))
    return start, steps


@functools.partial(jax.jit, static_argnames=("steps", "batch"))
def real_play(seed: int, steps: int, batch: int = 32) -> tuple[jax.Array, jax.Array, TimeStep]:
    """Frames [T + 1, B], actions [T, B] and time steps [T, B] of random play, from states all over the game."""
    action_TB = jax.random.randint(jax.random.key(seed), (steps, batch), 0, 3)
    start, shown = play(Batched(Walk(), batch), jax.random.key(seed), action_TB)
    return jnp.concatenate([start.observation[None], shown.observation]), action_TB, shown


@pytest.fixture(scope="module")
def learned() -> Learned:
    frames, action, shown = real_play(seed=0, steps=200)
    tokenizer = NearestNeighborTokenizer(SPEC.num_codes, 0.05, (1, 1), FRAMES)
    codes, _ = tokenizer.update(tokenizer.init(jax.random.key(0)), frames[:20].reshape(-1, *FRAMES.shape))
    tokens = tokenizer.encode(codes, frames)
    config = small_config(learning_rate=3e-3, dropout=0.0)
    graph, params = nnx.split(small_model(std=0.15, dropout=0.0))
    optimizer = training.make_optimizer(config)

    def update(model_state, key):
        starts = jax.random.randint(key, (32,), 0, 200 - HORIZON)

        def window(start, index):
            def cut(x, length):
                return jax.lax.dynamic_slice_in_dim(x[:, index], start, length)

            terminated = cut(shown.terminated, HORIZON)
            return Sequences(cut(tokens, HORIZON + 1), cut(action, HORIZON), cut(shown.reward, HORIZON), terminated)

        return training.update(
            config, optimizer, graph, SPEC, model_state, jax.vmap(window)(starts, jnp.arange(32)), key
        )

    model_state = training.WorldModelTrainState(params, optimizer.init(params))
    keys = jax.random.split(jax.random.key(1), 800)
    model_state, _ = jax.jit(lambda model_state, keys: jax.lax.scan(update, model_state, keys))(model_state, keys)
    model = nnx.merge(graph, model_state.params)

    frames, action, shown = (jax.tree.map(lambda x: x[-HORIZON - 1 :], x) for x in real_play(seed=5, steps=200))
    tokens_BTL = tokenizer.encode(codes, frames).swapaxes(0, 1)
    sequences = Sequences(tokens_BTL, action[-HORIZON:].T, shown.reward[-HORIZON:].T, shown.terminated[-HORIZON:].T)
    metrics = jax.jit(lambda sequences: training.losses(model, sequences, config, SPEC)[1])(sequences)
    return Learned(model, tokenizer, codes, float(metrics["token_accuracy"]))


def dream_of(learned: Learned, frames: jax.Array, model: WorldModel | None = None, horizon: int = HORIZON) -> Dream:
    return Dream(model or learned.model, learned.tokenizer, learned.codes, Walk.spec, SPEC, horizon, frames)


def test_the_game_is_learned(learned):
    assert learned.accuracy > 0.99


@pytest.mark.parametrize("horizon", [HORIZON, 4 * HORIZON])  # as long as what the model learned from, and longer
def test_the_dream_is_the_game(learned, horizon):
    frames, action, shown = real_play(seed=7, steps=30, batch=16)
    action = action[-horizon:]
    real = jax.tree.map(lambda x: x[-horizon:], shown)
    start, imagined = jax.jit(
        lambda frames, key, action: play(dream_of(learned, frames, horizon=horizon), key, action)
    )(frames[-horizon - 1], jax.random.key(3), action)
    np.testing.assert_array_equal(start.observation, frames[-horizon - 1])
    np.testing.assert_array_equal(imagined.observation, real.observation)
    np.testing.assert_array_equal(imagined.reward, real.reward)
    np.testing.assert_array_equal(imagined.terminated, real.terminated)
    assert 0 < real.reward.mean() < 1 and 0 < real.terminated.mean() < 1
    assert len(np.unique(np.asarray(real.observation).reshape(-1, 6), axis=0)) > 6


def test_the_dream_keeps_the_contract_of_batched_environments(learned):
    frames, action, _ = real_play(seed=2, steps=HORIZON, batch=4)
    _, real = Batched(Walk(), 4).reset(jax.random.key(0))

    @jax.jit
    def start(frames, key):
        return dream_of(learned, frames).reset(key)

    @jax.jit
    def step(frames, key, state, action):
        return dream_of(learned, frames).step(key, state, action)

    state, first = start(frames[0], jax.random.key(0))
    assert dream_of(learned, frames[0]).num_envs == 4 and dream_of(learned, frames[0]).spec is Walk.spec
    assert not first.first.any() and not first.terminated.any() and (first.reward == 0).all()
    shape = jax.tree.map(lambda x: (x.shape, x.dtype), state)
    for time in range(HORIZON):
        state, shown = step(frames[0], jax.random.key(time), state, action[time])
        assert jax.tree.map(lambda x: (x.shape, x.dtype), state) == shape
        assert jax.tree.map(lambda x: (x.shape, x.dtype), shown) == jax.tree.map(lambda x: (x.shape, x.dtype), real)
        np.testing.assert_array_equal(shown.first, shown.terminated)
        np.testing.assert_array_equal(shown.final_observation, shown.observation)
        assert not shown.truncated.any()


def test_unfilled_codes_are_never_sampled(learned):
    """Not even by a model that was not trained, nor by one that likes them best."""
    assert int(learned.codes.count) == 4 < SPEC.num_codes
    frames, action, _ = real_play(seed=3, steps=HORIZON, batch=64)
    untrained = dream_of(learned, frames[0], small_model(seed=1))
    state, _ = untrained.reset(jax.random.key(0))
    seen = set()
    for time in range(HORIZON):
        state, _ = untrained.step(jax.random.key(time), state, action[time])
        seen |= set(np.unique(state.tokens_BL))
    assert seen == {0, 1, 2, 3}
    logits = jnp.zeros((50, 6, 8)).at[..., 6].set(50.0)
    tokens = draw(jax.random.key(0), filled_odds(logits, learned.tokenizer.valid_codes(learned.codes)))
    assert int(tokens.max()) == 3 and tokens.dtype == jnp.int32


def test_tokens_are_sampled_from_the_softmax():
    logits = jnp.log(jnp.asarray([0.1, 0.2, 0.3, 0.4]))
    tokens = draw(jax.random.key(0), filled_odds(jnp.broadcast_to(logits, (20_000, 2, 4)), jnp.arange(4) < 3))
    frequency = np.bincount(np.asarray(tokens).ravel(), minlength=4) / tokens.size
    np.testing.assert_allclose(frequency, [1 / 6, 2 / 6, 3 / 6, 0], atol=0.01)
    one, other = np.asarray(tokens).T  # independent of each other
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.03


def test_rewards_are_class_levels(learned):
    frames, action, _ = real_play(seed=4, steps=1, batch=64)
    levels = dataclasses.replace(SPEC, reward_classes=(-2.0, 7.0))
    dream = dataclasses.replace(dream_of(learned, frames[0], small_model(seed=1)), tokens=levels)
    _, shown = play(dream, jax.random.key(0), action)
    assert set(np.unique(shown.reward)) == {-2.0, 7.0}
    assert 0 < shown.terminated.mean() < 1  # sampled, not argmaxed


def test_context_is_what_the_model_would_remember(learned):
    """A dream that is shown the frames before its first goes on as one that has dreamt through them."""
    frames, action, _ = real_play(seed=5, steps=4, batch=3)
    tokens = learned.tokenizer.encode(learned.codes, frames)
    cache = learned.model.init_cache(3, 4)
    for t in range(3):
        cache, hidden = learned.model.step(cache, tokens[t], action[t])
    past = Past(frames[:2], action[:2])
    dream = Dream(learned.model, learned.tokenizer, learned.codes, Walk.spec, SPEC, 2, frames[2], past=past, context=2)
    state, _ = dream.reset(jax.random.key(0))
    assert state.cache.keys.shape == cache.keys.shape
    longer, _ = dataclasses.replace(dream, horizon=20).reset(jax.random.key(0))  # no more than the model has seen
    assert longer.cache.keys.shape == (2, 3, 4, 5 * 7, 8)
    after, same_hidden = learned.model.step(state.cache, state.tokens_BL, action[2])
    np.testing.assert_allclose(hidden, same_hidden, atol=1e-4)
    np.testing.assert_allclose(cache.keys, after.keys, atol=1e-4)


@pytest.mark.parametrize("context", [0, 2])
def test_dreams_know_how_old_tokens_are(learned, context):
    """They go on as the model does that is told the ages in the whole sequence, real frames and dreamt ones."""
    model = small_model(std=0.2, dropout=0.0, ages=3)
    frames, action, _ = real_play(seed=6, steps=7, batch=3)
    past = Past(frames[:4], action[:4])
    dream = Dream(model, learned.tokenizer, learned.codes, Walk.spec, SPEC, 3, frames[4], past=past, context=context)
    state, _ = dream.reset(jax.random.key(0))
    shown = [*learned.tokenizer.encode(learned.codes, frames[:5])]
    for t in (4, 5):
        state, _ = dream.step(jax.random.key(t), state, action[t])
        shown.append(state.tokens_BL)
    _, hidden = model.step(state.cache, state.tokens_BL, action[6], state.history_B)
    tokens_BTL, action_BT = jnp.stack(shown, axis=1), action.swapaxes(0, 1)
    age_BTL, read = ages_of(tokens_BTL, 3), slice(4 - context, 7)
    whole = model(tokens_BTL[:, read], action_BT[:, read], history_BT=History(age_BTL[:, read]))
    np.testing.assert_allclose(hidden, whole[:, -1], atol=1e-4)
    untold = model(tokens_BTL[:, read], action_BT[:, read], history_BT=History(0 * age_BTL[:, read]))
    assert abs(whole - untold).max() > 0.1
