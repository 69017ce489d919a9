"""Tokenizers that are learned: VQ-VAEs of whole frames (M1, M2) and of patches (M3); Appendix A.2.1, fidelity note 15.

Shapes: N frames, L latents per frame of D numbers, K codes. Codes and latents have unit norm, so the nearest code is
the one with the largest inner product.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx, struct

from suite.configuration.schema import TokenizerConfig
from suite.interface.environment import ObservationSpec
from suite.nn.per_device import of_each_device
from suite.tokenizers.autoencoders import FrameDecoder, FrameEncoder, PatchDecoder, PatchEncoder, latent_grid
from suite.tokenizers.patches import patch_grid


@struct.dataclass
class VQState:
    """Parameters (an `nnx.State`) and the optimizer's state."""

    params: Any
    optimizer: optax.OptState


class VQVAE(nnx.Module):
    """Encoder, codebook and decoder. `patch` None: of whole frames."""

    def __init__(
        self, config: TokenizerConfig, shape: tuple[int, ...], patch: tuple[int, int] | None, rngs: nnx.Rngs
    ) -> None:
        size = config.embed_dim
        self.encoder: FrameEncoder | PatchEncoder
        self.decoder: FrameDecoder | PatchDecoder
        if patch is None:
            self.encoder = FrameEncoder(shape, config.channels, size, rngs)
            self.decoder = FrameDecoder(shape, config.channels, size, rngs)
        else:
            self.encoder = PatchEncoder(shape, patch, size, rngs)
            self.decoder = PatchDecoder(shape, patch, size, rngs)
        self.codebook = nnx.Param(jax.random.normal(rngs.params(), (config.codebook_size, size)))

    def codes(self) -> jax.Array:
        """float32 [K, D], unit norm."""
        return unit(self.codebook[...])

    def latents(self, frame_NHWC: jax.Array) -> jax.Array:
        """float32 [N, L, D], unit norm, of frames in [0, 1]."""
        return unit(self.encoder(frame_NHWC))

    def frames(self, z_NLD: jax.Array) -> jax.Array:
        """Frames [N, H, W, C], about in [0, 1], of latents or codes."""
        frame_NHWC: jax.Array = self.decoder(z_NLD)
        return frame_NHWC

    def nearest(self, z_NLD: jax.Array) -> jax.Array:
        """int32 [N, L]: the codes nearest to latents of unit norm."""
        return jnp.argmax(z_NLD @ self.codes().T, axis=-1).astype(jnp.int32)


def unit(x: jax.Array) -> jax.Array:
    """Vectors [..., D] scaled to norm 1."""
    return x * jax.lax.rsqrt(jnp.square(x).sum(-1, keepdims=True) + 1e-12)


def vq_losses(
    model: VQVAE, frame_NHWC: jax.Array, weights: tuple[float, float, float, float]
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Eq. 3 (VQ-VAE) on frames in [0, 1], and its parts, each a mean over its numbers, as in the codes that it follows.

    The decoder's gradient passes the quantization straight through to the latents.
    """
    z_NLD = of_each_device(VQVAE.latents, model, (0,), 0)(frame_NHWC)
    code_NL = model.nearest(z_NLD)
    quantized_NLD = model.codes()[code_NL]
    straight_NLD = z_NLD + jax.lax.stop_gradient(quantized_NLD - z_NLD)
    error = frame_NHWC - of_each_device(VQVAE.frames, model, (0,), 0)(straight_NLD)
    parts = {
        "absolute_error": jnp.abs(error).mean(),
        "squared_error": jnp.square(error).mean(),
        "codebook_loss": jnp.square(jax.lax.stop_gradient(z_NLD) - quantized_NLD).mean(),
        "commitment_loss": jnp.square(z_NLD - jax.lax.stop_gradient(quantized_NLD)).mean(),
    }
    loss = sum((weight * part for weight, part in zip(weights, parts.values(), strict=True)), jnp.zeros(()))
    used_K = jnp.zeros(model.codebook.shape[0], bool).at[code_NL.ravel()].set(True)
    return loss, {"codes": used_K.sum(), "loss": loss, **parts}


@dataclasses.dataclass(frozen=True)
class VQTokenizer:
    """A `Tokenizer` that learns by gradients, and whose codes therefore never stand still.

    Attributes:
      config: sizes, loss weights, learning rate.
      observation: the frames, of kind "pixels" or "grid".
      patch: (height, width) of the patches that are encoded one by one; None: whole frames.
    """

    config: TokenizerConfig
    observation: ObservationSpec
    patch: tuple[int, int] | None

    @property
    def metrics(self) -> tuple[str, ...]:
        """What `update` reports; "codes" are those that the batch uses."""
        return ("codes", "loss", "absolute_error", "squared_error", "codebook_loss", "commitment_loss")

    @property
    def grid(self) -> tuple[int, int]:
        """(rows, columns) of tokens in a frame."""
        shape = self.observation.shape
        return latent_grid(shape) if self.patch is None else patch_grid(shape, self.patch)

    @property
    def tokens_per_frame(self) -> int:
        """L."""
        return math.prod(self.grid)

    @property
    def num_codes(self) -> int:
        """K."""
        return self.config.codebook_size

    @property
    def token_size(self) -> int:
        """0: tokens are codes."""
        return 0

    def init(self, key: jax.Array) -> VQState:
        """Random networks and codes."""
        params = nnx.state(self._new(nnx.Rngs(key)))
        return VQState(params, self._optimizer.init(params))

    def update(self, state: VQState, observation_NO: jax.Array) -> tuple[VQState, dict[str, jax.Array]]:
        """One gradient step on `vq_losses`."""
        frame_NHWC = self._scaled(observation_NO)

        def loss_of(params: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
            return vq_losses(nnx.merge(self._graph, params), frame_NHWC, self.config.loss_weights)

        gradients, metrics = jax.grad(loss_of, has_aux=True)(state.params)
        with jax.numpy_dtype_promotion("standard"):  # Optax's Adam mixes int32 and float
            changes, optimizer = self._optimizer.update(gradients, state.optimizer, state.params)
        return VQState(optax.apply_updates(state.params, changes), optimizer), metrics

    def encode(self, state: VQState, observation: jax.Array) -> jax.Array:
        """int32 [..., L]."""
        shape = self.observation.shape
        lead = observation.shape[: observation.ndim - len(shape)]
        model = self._model(state)
        return model.nearest(model.latents(self._scaled(observation.reshape(-1, *shape)))).reshape(*lead, -1)

    def decode(self, state: VQState, tokens: jax.Array) -> jax.Array:
        """uint8 [..., H, W, C]."""
        model, high = self._model(state), self.observation.high
        frame_NHWC = model.frames(model.codes()[tokens.reshape(-1, self.tokens_per_frame)])
        pixels = jnp.round(jnp.clip(frame_NHWC, 0, 1) * high).astype(jnp.uint8)
        return pixels.reshape(*tokens.shape[:-1], *self.observation.shape)

    def valid_codes(self, state: VQState) -> jax.Array:
        """Bool [K]: all."""
        del state
        return jnp.ones(self.num_codes, bool)

    def contents(self, state: VQState) -> jax.Array:
        """P = 0: what a code stands for changes while it is learned, and depends on its neighbours."""
        del state
        return jnp.zeros((self.num_codes, 0), jnp.float32)

    @functools.cached_property
    def _graph(self) -> Any:
        return nnx.graphdef(nnx.eval_shape(lambda: self._new(nnx.Rngs(0))))

    @property
    def _optimizer(self) -> optax.GradientTransformation:
        return optax.adam(self.config.learning_rate)

    def _new(self, rngs: nnx.Rngs) -> VQVAE:
        return VQVAE(self.config, self.observation.shape, self.patch, rngs)

    def _model(self, state: VQState) -> VQVAE:
        return nnx.merge(self._graph, state.params)

    def _scaled(self, observation: jax.Array) -> jax.Array:
        return observation.astype(jnp.float32) / self.observation.high
