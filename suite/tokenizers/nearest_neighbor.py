"""The nearest-neighbor tokenizer: a codebook of patches that grows, and never changes (Section 3.5, Eq. 1).

Distances are exact. Patches are integers of 0..high, and while h*w*C * high**2 < 2**24 every product and partial sum of
a float32 matrix product of them is an integer that float32 holds: the order of summation does not matter, a stored
patch is at distance 0 from its code, and every device chooses the same code. (Craftax: 147 * 255**2 = 0.57 * 2**24.)
Beyond that bound a distance is off by a few parts in 2**24 of the patch's squared norm.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
from flax import struct

from suite.interface.environment import ObservationSpec
from suite.runtime import layout
from suite.tokenizers.patches import join_patches, patch_grid, split_patches

# Distances held at once: 64 MiB. On a CPU 4 MiB, which its caches hold: a tenth of the time.
CHUNK_DISTANCES = 2**24
CPU_CHUNK_DISTANCES = 2**20
NEWCOMERS = 32  # codes that stored frames are compared with at once


@struct.dataclass
class NearestNeighborState:
    """The codebook.

    Attributes:
      codes_KP: uint8; stored patches as seen, the first `count` of them meaningful.
      count: int32 scalar.
    """

    codes_KP: jax.Array
    count: jax.Array


@dataclasses.dataclass(frozen=True)
class NearestNeighborTokenizer:
    """A `Tokenizer` whose codes are patches that were seen (fidelity note 13).

    Attributes:
      codebook_size: K; a full codebook stops growing.
      threshold: squared Euclidean distance, of patches scaled to [0, 1], above which a patch becomes a code.
      patch: (height, width) of a patch.
      observation: the frames, of kind "pixels" or "grid".
      metrics: names of what `update` returns.
    """

    codebook_size: int
    threshold: float
    patch: tuple[int, int]
    observation: ObservationSpec

    @property
    def metrics(self) -> tuple[str, ...]:
        """What `update` reports."""
        return ("codes", "new_codes", "mean_distance", "max_distance")

    @property
    def grid(self) -> tuple[int, int]:
        """(rows, columns) of tokens in a frame."""
        return patch_grid(self.observation.shape, self.patch)

    @property
    def tokens_per_frame(self) -> int:
        """L."""
        return math.prod(self.grid)

    @property
    def num_codes(self) -> int:
        """K."""
        return self.codebook_size

    @property
    def token_size(self) -> int:
        """0: tokens are codes."""
        return 0

    def init(self, key: jax.Array) -> NearestNeighborState:
        """An empty codebook; `key` is not used."""
        del key
        size = math.prod(self.patch) * self.observation.shape[-1]
        return NearestNeighborState(jnp.zeros((self.codebook_size, size), jnp.uint8), jnp.int32(0))

    def update(
        self, state: NearestNeighborState, observation_NO: jax.Array
    ) -> tuple[NearestNeighborState, dict[str, jax.Array]]:
        """Examines every patch in order and stores those farther than `threshold` from all codes before them.

        Equal to examining them one after another, at the price of one iteration per new code. The metrics'
        distances are squared, of all patches to their nearest code afterwards. Every device examines all patches, which
        are few: codes are added one by one, each of which depends on those before.
        """
        observation_NO = layout.replicated(observation_NO)
        patches_MP = split_patches(observation_NO, self.patch).reshape(-1, state.codes_KP.shape[-1])
        distance_M, _ = self._nearest(state, patches_MP)
        limit = jnp.float32(self.threshold * self.observation.high**2)
        values_MP = patches_MP.astype(jnp.float32)
        norm_M = _squared_norm(values_MP)

        def growing(carry: tuple[NearestNeighborState, jax.Array]) -> jax.Array:
            state, distance_M = carry
            return (state.count < self.codebook_size) & jnp.any(distance_M > limit)

        def grow(carry: tuple[NearestNeighborState, jax.Array]) -> tuple[NearestNeighborState, jax.Array]:
            state, distance_M = carry
            first = jnp.argmax(distance_M > limit)
            product_M = jnp.dot(values_MP, values_MP[first], precision=jax.lax.Precision.HIGHEST)
            to_new_M = jnp.maximum((norm_M - product_M) + (norm_M[first] - product_M), 0)
            codes_KP = state.codes_KP.at[state.count].set(patches_MP[first])
            # A code is at distance 0 from itself, whatever rounding says: this also makes the loop end.
            nearest_M = jnp.minimum(distance_M, to_new_M).at[first].set(0)
            return NearestNeighborState(codes_KP, state.count + 1), nearest_M

        grown, distance_M = jax.lax.while_loop(growing, grow, (state, distance_M))
        squared_M = distance_M / self.observation.high**2
        metrics = {
            "codes": grown.count,
            "new_codes": grown.count - state.count,
            "mean_distance": squared_M.mean(),
            "max_distance": squared_M.max(),
        }
        return grown, metrics

    def encode(self, state: NearestNeighborState, observation: jax.Array) -> jax.Array:
        """int32 [..., L]: the nearest stored code of each patch, ties to the older; 0 while the codebook is empty."""
        return self.nearest(state, observation)[0]

    def nearest(self, state: NearestNeighborState, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """`encode`'s tokens, and float32 [..., L], how far each patch is from its code."""
        patches = split_patches(observation, self.patch)
        distance_M, code_M = self._nearest(state, patches.reshape(-1, patches.shape[-1]))
        return code_M.reshape(patches.shape[:-1]), distance_M.reshape(patches.shape[:-1])

    def nearer(
        self,
        state: NearestNeighborState,
        known: jax.Array,
        observation: jax.Array,
        tokens: jax.Array,
        distance: jax.Array,
    ) -> tuple[jax.Array, jax.Array]:
        """What `nearest` returns, if it returned these tokens and distances when there were `known` codes (int32).

        Only codes that have come since are looked at.
        """
        patches = split_patches(observation, self.patch)
        values_MP = patches.reshape(-1, patches.shape[-1]).astype(jnp.float32)
        norm_M1 = _squared_norm(values_MP)[:, None]
        codes_KP = jnp.pad(state.codes_KP, ((0, NEWCOMERS), (0, 0)))

        def compare(i: jax.Array, found: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            first = known + i * NEWCOMERS
            codes_CP = jax.lax.dynamic_slice_in_dim(codes_KP, first, NEWCOMERS).astype(jnp.float32)
            filled_1C = (first + jnp.arange(NEWCOMERS) < state.count)[None]
            product_MC = jnp.dot(values_MP, codes_CP.T, precision=jax.lax.Precision.HIGHEST)
            norm_1C = jnp.where(filled_1C, _squared_norm(codes_CP)[None], jnp.inf)
            least_M, code_M = _least((norm_1C - product_MC) + (norm_M1 - product_MC))
            tokens_M, distance_M = found
            return jnp.where(least_M < distance_M, first + code_M, tokens_M), jnp.minimum(least_M, distance_M)

        chunks = (state.count - known + NEWCOMERS - 1) // NEWCOMERS
        found = jax.lax.fori_loop(0, chunks, compare, (tokens.reshape(-1), distance.reshape(-1)))
        return found[0].reshape(tokens.shape), found[1].reshape(tokens.shape)

    def decode(self, state: NearestNeighborState, tokens: jax.Array) -> jax.Array:
        """uint8 [..., H, W, C]: the stored patches themselves."""
        return join_patches(state.codes_KP[tokens], self.observation.shape, self.patch)

    def valid_codes(self, state: NearestNeighborState) -> jax.Array:
        """Bool [K]: the codes that are filled."""
        return jnp.arange(self.codebook_size) < state.count

    def contents(self, state: NearestNeighborState) -> jax.Array:
        """float32 [K, P]: the stored patches; zeros of codes that are not filled."""
        return state.codes_KP.astype(jnp.float32) / self.observation.high

    def _nearest(self, state: NearestNeighborState, patches_MP: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Squared distance (in units of 1/high**2) and index of each patch's nearest code; infinity where none is."""
        codes_KP = state.codes_KP.astype(jnp.float32)
        norm_K = jnp.where(self.valid_codes(state), _squared_norm(codes_KP), jnp.inf)

        def nearest(chunk_CP: jax.Array) -> tuple[jax.Array, jax.Array]:
            values_CP = chunk_CP.astype(jnp.float32)
            product_CK = jnp.dot(values_CP, codes_KP.T, precision=jax.lax.Precision.HIGHEST)
            return _least((norm_K[None] - product_CK) + (_squared_norm(values_CP)[:, None] - product_CK))

        total = patches_MP.shape[0]
        limit = CPU_CHUNK_DISTANCES if jax.default_backend() == "cpu" else CHUNK_DISTANCES
        chunks = math.ceil(total * self.codebook_size / limit)
        size = math.ceil(total / chunks)
        padded_MP = jnp.pad(patches_MP, ((0, chunks * size - total), (0, 0)))
        distance, code = jax.lax.map(nearest, padded_MP.reshape(chunks, size, -1))
        return distance.reshape(-1)[:total], code.reshape(-1)[:total]


def _least(distance_CK: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The least of each row's distances, at least 0, and the index (int32) of the first that is so small."""
    distance_CK = jax.lax.optimization_barrier(distance_CK)  # both passes read the same numbers
    least_C, number = distance_CK.min(-1), distance_CK.shape[-1]
    # Two plain minima: on a CPU, argmin is several times slower.
    code_CK = jnp.where(distance_CK == least_C[:, None], jnp.arange(number)[None], number)
    return jnp.maximum(least_C, 0), code_CK.min(-1).astype(jnp.int32)


def _squared_norm(values: jax.Array) -> jax.Array:
    # A product: on a CPU, row sums are slower.
    return jnp.dot(jnp.square(values), jnp.ones(values.shape[-1]), precision=jax.lax.Precision.HIGHEST)
