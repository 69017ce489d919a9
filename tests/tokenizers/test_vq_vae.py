"""The learned tokenizers: quantization by hand, gradients by hand, and that they learn."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from suite.configuration.schema import TokenizerConfig
from suite.interface.environment import ObservationSpec
from suite.tokenizers import make_tokenizer
from suite.tokenizers.autoencoders import FrameDecoder, FrameEncoder
from suite.tokenizers.vq_vae import VQVAE, unit, vq_losses

FRAME = ObservationSpec(shape=(15, 15, 3), high=255, kind="pixels", patch=(5, 5))
CONFIG = TokenizerConfig(kind="patch_vq_vae", codebook_size=16, embed_dim=8, channels=(4, 4, 4, 4, 8))
KINDS = {"vq_vae": (8, 8), "patch_vq_vae": (3, 3)}


def config_of(kind: str, **changes) -> TokenizerConfig:
    return dataclasses.replace(CONFIG, kind=kind, **changes)


def frames_of(seed: int, count: int) -> jax.Array:
    """Frames of 3x3 cells in four colors."""
    rng = np.random.default_rng(seed)
    colors = np.array([[250, 10, 10], [10, 250, 10], [10, 10, 250], [240, 240, 10]], np.uint8)
    cells = colors[rng.integers(0, 4, (count, 3, 3))]
    return jnp.asarray(cells.repeat(5, axis=1).repeat(5, axis=2))


@pytest.mark.parametrize(("kind", "grid"), KINDS.items())
def test_the_contract_and_learning(kind, grid):
    tokenizer = make_tokenizer(config_of(kind, learning_rate=3e-3), FRAME)
    assert (tokenizer.grid, tokenizer.num_codes, tokenizer.token_size) == (grid, 16, 0)
    state = tokenizer.init(jax.random.key(0))

    def step(state, seed):
        picked = jax.random.randint(jax.random.key(seed), (8,), 0, 64)
        return tokenizer.update(state, frames[picked])

    frames = frames_of(0, 64)
    learned, metrics = jax.jit(lambda s: jax.lax.scan(step, s, jnp.arange(300)))(state)
    assert set(metrics) == set(tokenizer.metrics)
    assert metrics["absolute_error"][-20:].mean() < 0.4 * metrics["absolute_error"][:5].mean()
    assert 1 < int(metrics["codes"][-1]) <= 16

    tokens = tokenizer.encode(learned, frames.reshape(4, 16, *FRAME.shape))
    assert tokens.shape == (4, 16, tokenizer.tokens_per_frame) and tokens.dtype == jnp.int32
    assert int(tokens.min()) >= 0 and int(tokens.max()) < 16
    decoded = tokenizer.decode(learned, tokens)
    assert decoded.shape == (4, 16, *FRAME.shape) and decoded.dtype == jnp.uint8
    single = tokenizer.decode(learned, tokenizer.encode(learned, frames[3]))
    np.testing.assert_allclose(single.astype(int), decoded[0, 3].astype(int), atol=1)
    assert bool(tokenizer.valid_codes(learned).all())


@pytest.mark.parametrize("kind", KINDS)
def test_codes_and_latents_have_unit_norm_and_the_nearest_code_is_chosen(kind):
    patch = (5, 5) if kind == "patch_vq_vae" else None
    model = VQVAE(config_of(kind), FRAME.shape, patch, nnx.Rngs(0))
    z = model.latents(frames_of(1, 3) / 255)
    codes = np.asarray(model.codes(), np.float64)
    np.testing.assert_allclose(np.linalg.norm(codes, axis=-1), 1, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(z, axis=-1), 1, atol=1e-5)
    distance = np.square(np.asarray(z, np.float64)[..., None, :] - codes).sum(-1)
    np.testing.assert_array_equal(model.nearest(z), distance.argmin(-1))


def test_losses_and_gradients_by_hand():
    """Patch VQ-VAE with D = P and an identity decoder: every gradient can be written down."""
    size = 75
    config = config_of("patch_vq_vae", embed_dim=size, codebook_size=4)
    model = VQVAE(config, FRAME.shape, (5, 5), nnx.Rngs(0))
    model.decoder.dense.kernel[...] = jnp.eye(size)
    frames = frames_of(2, 2) / 255
    weights = (0.0, 1.0, 0.7, 0.3)
    graph, params = nnx.split(model)
    loss, parts = vq_losses(model, frames, weights)
    gradient = jax.grad(lambda p: vq_losses(nnx.merge(graph, p), frames, weights)[0])(params)

    z = np.asarray(model.latents(frames), np.float64).reshape(-1, size)
    code = np.asarray(model.nearest(model.latents(frames))).ravel()
    raw = np.asarray(model.codebook[...], np.float64)
    norm = np.linalg.norm(raw, axis=-1, keepdims=True)
    codes = raw / norm
    patches = np.asarray(frames).reshape(2, 3, 5, 3, 5, 3).swapaxes(2, 3).reshape(-1, size)
    count = z.size
    chosen = codes[code]
    expected = {
        "absolute_error": np.abs(patches - chosen).mean(),
        "squared_error": np.square(patches - chosen).mean(),
        "codebook_loss": np.square(z - chosen).mean(),
        "commitment_loss": np.square(z - chosen).mean(),
    }
    for name, value in expected.items():
        np.testing.assert_allclose(parts[name], value, rtol=1e-4)
    total = expected["squared_error"] + 0.7 * expected["codebook_loss"] + 0.3 * expected["commitment_loss"]
    np.testing.assert_allclose(loss, total, rtol=1e-4)

    # The codebook hears of the codebook loss alone; the slope at a unit vector goes on to the stored one projected.
    slope = np.zeros_like(codes)
    np.add.at(slope, code, 0.7 * 2 * (chosen - z) / count)
    projected = (slope - codes * (slope * codes).sum(-1, keepdims=True)) / norm
    np.testing.assert_allclose(gradient["codebook"][...], projected, atol=1e-6)

    # The decoder's input gradient reaches the latents as if nothing had been quantized, beside the commitment.
    along = 2 * (chosen - patches) / count + 0.3 * 2 * (z - chosen) / count

    def at_latents(p):
        encoded = nnx.merge(graph, p).latents(frames).reshape(-1, size)
        return (encoded * jnp.asarray(along, jnp.float32)).sum()

    by_encoder = jax.grad(at_latents)(params)["encoder"]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), gradient["encoder"], by_encoder)


def test_unit():
    np.testing.assert_allclose(unit(jnp.asarray([[3.0, 4.0]])), [[0.6, 0.8]], rtol=1e-6)


@pytest.mark.parametrize(
    ("shape", "latents"),
    [((63, 63, 3), 8 * 8), ((10, 10, 7), 5 * 5), ((130, 110, 3), 17 * 14), ((15, 15, 3), 8 * 8), ((6, 6, 3), 6 * 6)],
)
def test_frames_to_latents_and_back(shape, latents):
    """The first is the paper's (fidelity note 15); small frames are halved less often, MinAtar's to its 25 tokens."""
    channels = TokenizerConfig().channels
    frames = jax.ShapeDtypeStruct((2, *shape), jnp.float32)
    encoder = nnx.eval_shape(lambda: FrameEncoder(shape, channels, 128, nnx.Rngs(0)))
    decoder = nnx.eval_shape(lambda: FrameDecoder(shape, channels, 128, nnx.Rngs(0)))
    found = nnx.eval_shape(lambda m, x: m(x), encoder, frames)
    assert found.shape == (2, latents, 128)
    assert nnx.eval_shape(lambda m, x: m(x), decoder, found).shape == (2, *shape)


def test_continuous_patches_come_back_as_they_were():
    tokenizer = make_tokenizer(TokenizerConfig(kind="continuous", patch=(4, 4)), FRAME)
    assert (tokenizer.tokens_per_frame, tokenizer.num_codes, tokenizer.token_size) == (16, 0, 48)
    frames = frames_of(3, 2)
    state, _ = tokenizer.update(tokenizer.init(jax.random.key(0)), frames)
    tokens = tokenizer.encode(state, frames)
    assert tokens.shape == (2, 16, 48) and float(tokens.max()) <= 1
    np.testing.assert_array_equal(tokenizer.decode(state, tokens), frames)
    assert tokenizer.valid_codes(state).shape == (0,)
