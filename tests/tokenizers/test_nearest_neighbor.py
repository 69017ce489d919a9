"""The nearest-neighbor tokenizer against a plain loop, and its promises (fidelity note 13)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.interface.environment import ObservationSpec
from suite.tokenizers.nearest_neighbor import NearestNeighborTokenizer
from suite.tokenizers.patches import join_patches, patch_grid, split_patches

FRAME = ObservationSpec(shape=(4, 6, 1), high=255, kind="pixels", patch=(2, 2))


def tokenizer_of(size: int = 16, threshold: float = 0.75) -> NearestNeighborTokenizer:
    return NearestNeighborTokenizer(size, threshold, (2, 2), FRAME)


def random_frames(seed: int, count: int, levels: int = 256) -> jax.Array:
    values = np.random.default_rng(seed).integers(0, levels, (count, *FRAME.shape)) * (255 // (levels - 1))
    return jnp.asarray(values, jnp.uint8)


def loop_update(codes: list[np.ndarray], patches: np.ndarray, size: int, threshold: float) -> list[np.ndarray]:
    """One patch after another, in integers."""
    codes = list(codes)
    for patch in patches.astype(np.int64):
        distances = [np.square(patch - code).sum() for code in codes]
        if len(codes) < size and (not codes or min(distances) > threshold * 255**2):
            codes.append(patch)
    return codes


def loop_encode(codes: list[np.ndarray], patches: np.ndarray) -> np.ndarray:
    return np.array([np.argmin([np.square(p - code).sum() for code in codes]) for p in patches.astype(np.int64)])


@pytest.fixture(scope="module")
def craftax_frames() -> np.ndarray:
    """uint8 [steps, environments, 63, 63, 3] of random play."""
    from adapters.craftax.task import make_classic

    environment = make_classic()

    @jax.jit
    def play(key):
        reset_key, step_key = jax.random.split(key)
        state, first = jax.vmap(environment.reset)(jax.random.split(reset_key, 4))

        def step(state, key):
            keys = jax.random.split(key, 4)
            action = jax.random.randint(key, (4,), 0, environment.spec.num_actions)
            state, shown = jax.vmap(environment.step)(keys, state, action)
            return state, shown.observation

        _, frames = jax.lax.scan(step, state, jax.random.split(step_key, 11))
        return jnp.concatenate([first.observation[None], frames])

    return np.asarray(play(jax.random.key(0)))


def test_agrees_with_a_plain_loop_on_craftax_frames(craftax_frames):
    observation = ObservationSpec(shape=(63, 63, 3), high=255, kind="pixels", patch=(7, 7))
    tokenizer = NearestNeighborTokenizer(64, 0.75, (7, 7), observation)
    update = jax.jit(tokenizer.update)
    state, codes = tokenizer.init(jax.random.key(0)), []
    for batch in np.split(craftax_frames, 3):  # in three batches, so that the codebook grows over several updates
        frames = batch.reshape(-1, 63, 63, 3)
        state, _ = update(state, jnp.asarray(frames))
        patches = np.asarray(split_patches(jnp.asarray(frames), (7, 7))).reshape(-1, 147)
        codes = loop_update(codes, patches, 64, 0.75)
        assert len(codes) > 8
        assert int(state.count) == len(codes)
        np.testing.assert_array_equal(state.codes_KP[: len(codes)], codes)
        np.testing.assert_array_equal(tokenizer.encode(state, jnp.asarray(frames)).ravel(), loop_encode(codes, patches))


def test_agrees_with_a_plain_loop_under_vmap():
    tokenizer = tokenizer_of(size=24)
    frames = jnp.stack([random_frames(seed, 10) for seed in range(3)])
    states = jax.vmap(lambda key: tokenizer.init(key))(jax.random.split(jax.random.key(0), 3))
    states, _ = jax.jit(jax.vmap(tokenizer.update))(states, frames)
    for seed in range(3):
        codes = loop_update([], np.asarray(split_patches(frames[seed], (2, 2))).reshape(-1, 4), 24, 0.75)
        assert int(states.count[seed]) == len(codes)
        np.testing.assert_array_equal(states.codes_KP[seed, : len(codes)], codes)


def test_stored_codes_round_trip_exactly():
    tokenizer = tokenizer_of(size=512, threshold=0.0)
    frames = random_frames(0, 20)
    state, _ = tokenizer.update(tokenizer.init(jax.random.key(0)), frames)
    tokens = tokenizer.encode(state, frames)
    np.testing.assert_array_equal(tokenizer.decode(state, tokens), frames)
    np.testing.assert_array_equal(tokenizer.encode(state, tokenizer.decode(state, tokens)), tokens)
    assert tokens.shape == (20, 6) and tokens.dtype == jnp.int32


def test_codes_never_change_or_move_and_a_full_codebook_stops_growing():
    tokenizer = tokenizer_of(size=6, threshold=0.5)
    state, counts = tokenizer.init(jax.random.key(0)), [0]
    for seed in range(8):
        before, state_before = counts[-1], state
        state, metrics = tokenizer.update(state, random_frames(seed, 1))
        counts.append(int(state.count))
        np.testing.assert_array_equal(state.codes_KP[:before], state_before.codes_KP[:before])
        assert int(metrics["codes"]) == counts[-1] and int(metrics["new_codes"]) == counts[-1] - before
    assert 0 < counts[1] < 6 and counts[-1] == 6
    full, metrics = tokenizer.update(state, random_frames(99, 4))
    np.testing.assert_array_equal(full.codes_KP, state.codes_KP)
    assert int(full.count) == 6 and int(metrics["new_codes"]) == 0
    # What is far from every code is still encoded, as its nearest one.
    assert float(metrics["max_distance"]) > 0.5
    patches = np.asarray(split_patches(random_frames(99, 4), (2, 2))).reshape(-1, 4)
    expected = loop_encode(list(np.asarray(full.codes_KP, np.int64)), patches)
    np.testing.assert_array_equal(tokenizer.encode(full, random_frames(99, 4)).ravel(), expected)


def test_duplicates_in_a_batch_add_one_code():
    tokenizer = tokenizer_of()
    frames = jnp.concatenate([jnp.zeros((3, 4, 6, 1), jnp.uint8), jnp.full((3, 4, 6, 1), 255, jnp.uint8)])
    state, metrics = tokenizer.update(tokenizer.init(jax.random.key(0)), frames)
    assert int(state.count) == int(metrics["new_codes"]) == 2
    np.testing.assert_array_equal(tokenizer.valid_codes(state), np.arange(16) < 2)


def test_threshold_is_on_the_squared_distance_and_exclusive():
    # One pixel off by 0.8: squared 0.64 is below the threshold 0.75, which 0.8 itself is not.
    zero, near = jnp.zeros((1, 4, 6, 1), jnp.uint8), jnp.zeros((1, 4, 6, 1), jnp.uint8).at[0, 0, 0, 0].set(204)
    tokenizer = tokenizer_of()
    state, metrics = tokenizer.update(tokenizer.init(jax.random.key(0)), jnp.concatenate([zero, near]))
    assert int(state.count) == 1
    np.testing.assert_allclose(metrics["max_distance"], 0.64, rtol=1e-6)
    np.testing.assert_allclose(metrics["mean_distance"], 0.64 / 12, rtol=1e-6)
    exactly = tokenizer_of(threshold=0.64)
    assert int(exactly.update(exactly.init(jax.random.key(0)), jnp.concatenate([zero, near]))[0].count) == 1


def test_chunks_do_not_change_the_codes(monkeypatch):
    tokenizer, frames = tokenizer_of(size=32), random_frames(0, 15)
    state, _ = tokenizer.update(tokenizer.init(jax.random.key(0)), frames)
    whole = tokenizer.encode(state, frames)
    for limit in ("CHUNK_DISTANCES", "CPU_CHUNK_DISTANCES"):
        monkeypatch.setattr(f"suite.tokenizers.nearest_neighbor.{limit}", 32 * 7)  # 13 chunks, the last one padded
    np.testing.assert_array_equal(tokenizer.encode(state, frames), whole)


def test_metrics_are_the_named_ones():
    tokenizer = tokenizer_of()
    _, metrics = tokenizer.update(tokenizer.init(jax.random.key(0)), random_frames(0, 2))
    assert tuple(metrics) == tokenizer.metrics
    assert all(value.shape == () for value in metrics.values())


def test_patches_are_split_row_by_row_and_joined_again():
    frame = jnp.arange(24, dtype=jnp.uint8).reshape(4, 6, 1)
    patches = split_patches(frame, (2, 2))
    np.testing.assert_array_equal(patches[1], [2, 3, 8, 9])
    np.testing.assert_array_equal(patches[3], [12, 13, 18, 19])
    np.testing.assert_array_equal(join_patches(patches, (4, 6, 1), (2, 2)), frame)


def test_a_frame_is_made_larger_until_patches_fill_it():
    """Fidelity note 37: 63 pixels make 13x13 patches of 5; edge pixels are repeated below and on the right."""
    assert patch_grid((63, 63, 3), (5, 5)) == (13, 13)
    frame = jnp.arange(24, dtype=jnp.uint8).reshape(4, 6, 1)
    patches = split_patches(frame, (3, 4))
    assert patches.shape == (4, 12)
    np.testing.assert_array_equal(patches[3].reshape(3, 4), [[22, 23, 23, 23]] * 3)
    np.testing.assert_array_equal(join_patches(patches, (4, 6, 1), (3, 4)), frame)


@pytest.mark.parametrize("patch", [(2, 2), (3, 4)])
def test_patch_factorization_is_exact_for_stored_patches(patch):
    """Split, encode, decode, join: the same pixels, where every patch became a code."""
    tokenizer = NearestNeighborTokenizer(64, 0.0, patch, FRAME)
    frames = random_frames(3, 5)
    state, _ = tokenizer.update(tokenizer.init(jax.random.key(0)), frames)
    np.testing.assert_array_equal(tokenizer.decode(state, tokenizer.encode(state, frames)), frames)


def test_a_patch_larger_than_the_frame_is_refused():
    tokenizer = NearestNeighborTokenizer(4, 0.75, (5, 2), FRAME)
    with pytest.raises(ValueError, match="patches of 5x2 are larger than a frame of 4x6"):
        assert tokenizer.grid
