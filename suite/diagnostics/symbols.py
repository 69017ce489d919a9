"""The symbol extractor: what an imagined frame shows, read off its pixels (Section 4.4, Appendix D.3)."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from suite import registry
from suite.diagnostics import evaluation_set
from suite.diagnostics.evaluation_set import Pairs
from suite.interface.environment import ObservationSpec
from suite.runtime.cache import read_arrays
from suite.runtime.reporting import Reporter
from suite.tokenizers.patches import patch_grid, split_patches

CHANNELS = 128
BATCH, LEARNING_RATE = 128, 2e-3
UPDATES = {"paper": 4_000, "small": 1_000, "smoke": 10}
# The paper's network looks for every symbol in every patch: 25M numbers, which 18,000 frames leave undetermined, and
# most of what it learns is chance (95.7 % of Craftax-classic's validation symbols right, 99.4 % of the training ones).
# What leads from a patch to a symbol is therefore drawn to zero as a whole, by this times the step size at each update.
SPARSITY = 10.0
CHUNK = 512  # frames looked at together
VERSION = 1


class Network(nnx.Module):
    """Logits [N, R, V] of R symbols with V values, of frames [N, H, W, C].

    Convolutions that step by whole patches, and of one pixel, are the same linear map of every patch.
    """

    def __init__(self, observation: ObservationSpec, symbols: int, values: int, rngs: nnx.Rngs):
        assert observation.patch is not None
        self.patch, self.high = observation.patch, observation.high
        self.symbols, self.values = symbols, values
        patches = math.prod(patch_grid(observation.shape, self.patch))
        self.first = nnx.Linear(math.prod(self.patch) * observation.shape[-1], CHANNELS, rngs=rngs)
        self.second = nnx.Linear(CHANNELS, CHANNELS, rngs=rngs)
        self.last = nnx.Linear(
            patches * CHANNELS, symbols * values, kernel_init=nnx.initializers.zeros_init(), rngs=rngs
        )

    def __call__(self, frames: jax.Array) -> jax.Array:
        patches_NLP = split_patches(frames, self.patch).astype(jnp.float32) / self.high
        features_NLD = nnx.relu(self.second(nnx.relu(self.first(patches_NLP))))
        logits = self.last(features_NLD.reshape(frames.shape[0], -1))
        return logits.reshape(-1, self.symbols, self.values)


@dataclasses.dataclass(frozen=True)
class SymbolExtractor:
    """A trained network.

    Attributes:
      graph, params: its structure and numbers.
      accuracy: share of symbols that it reads right off the validation frames; nan if there are none.
    """

    graph: Any
    params: Any
    accuracy: float

    def __call__(self, frames: np.ndarray) -> np.ndarray:
        """The symbols that frames show: int32 [..., R] of uint8 [..., H, W, C]."""
        flat = frames.reshape(-1, *frames.shape[-3:])
        parts = [_read(self.graph, self.params, flat[i : i + CHUNK]) for i in range(0, len(flat), CHUNK)]
        return np.concatenate(parts).reshape(*frames.shape[:-3], -1)


def load(task: str, preset: str, reporter: Reporter) -> SymbolExtractor:
    """The extractor of a task with symbols, trained first where it is not cached yet, beside the evaluation set."""
    path = evaluation_set.cache_folder(task, preset) / f"extractor-{VERSION}.npz"
    entry = registry.task(task)
    observation = entry.spec().observation
    arrays = read_arrays(path)
    if arrays is None:
        pairs = evaluation_set.load_pairs(task, preset, reporter)
        updates = UPDATES.get(preset, UPDATES["small"])
        reporter.message(f"training the symbol extractor on {np.sum(~pairs.validation):,} frames, once")
        trained = train(pairs, observation, entry.symbol_values, updates, reporter)
        leaves = {f"leaf_{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(trained.params))}
        facts = {"accuracy": np.array(trained.accuracy), "symbols": np.array(pairs.symbols.shape[-1])}
        arrays = leaves | facts
        evaluation_set.write_arrays(path, arrays)
    accuracy, symbols = float(arrays.pop("accuracy")), int(arrays.pop("symbols"))
    graph, template = nnx.split(nnx.eval_shape(lambda: Network(observation, symbols, entry.symbol_values, nnx.Rngs(0))))
    params = jax.tree.unflatten(jax.tree.structure(template), [jnp.asarray(arrays[name]) for name in sorted(arrays)])
    return SymbolExtractor(graph, params, accuracy)


def train(pairs: Pairs, observation: ObservationSpec, values: int, updates: int, reporter: Reporter) -> SymbolExtractor:
    """Adam on the cross-entropy, its step size falling to zero, over the pairs that are not for validation.

    Args:
      pairs: frames and what they show.
      observation: the frames; they have patches.
      values: V, of a symbol.
      updates: of `BATCH` pairs each.
      reporter: where progress goes.
    """
    frames, symbols = pairs.frames[~pairs.validation], pairs.symbols[~pairs.validation]
    graph, params = nnx.split(Network(observation, symbols.shape[-1], values, nnx.Rngs(0)))
    schedule = optax.cosine_decay_schedule(LEARNING_RATE, updates)
    optimizer = optax.adam(schedule)
    state = optimizer.init(params)
    random = np.random.default_rng(0)
    for update in range(updates):
        some = random.integers(len(frames), size=BATCH)
        params, state, loss = _update(graph, optimizer, params, state, frames[some], symbols[some], schedule(update))
        if update % 20 == 0:
            reporter.texture(f"symbol extractor, loss {float(loss):.3g}", update / updates)
    reporter.texture("symbol extractor", 1.0)
    extractor = SymbolExtractor(graph, params, math.nan)
    if not pairs.validation.any():
        return extractor
    right = extractor(pairs.frames[pairs.validation]) == pairs.symbols[pairs.validation]
    return dataclasses.replace(extractor, accuracy=float(right.mean()))


@functools.partial(jax.jit, static_argnums=(0, 1), donate_argnums=(2, 3))
def _update(
    graph: Any,
    optimizer: optax.GradientTransformation,
    params: Any,
    state: optax.OptState,
    frames: jax.Array,
    symbols: jax.Array,
    step_size: jax.Array,
) -> tuple[Any, optax.OptState, jax.Array]:
    def loss(params: Any) -> jax.Array:
        logits = nnx.merge(graph, params)(frames)
        return optax.softmax_cross_entropy_with_integer_labels(logits, symbols).mean()

    value, slope = jax.value_and_grad(loss)(params)
    with jax.numpy_dtype_promotion("standard"):  # Optax's Adam mixes int32 and float
        change, state = optimizer.update(slope, state, params)
    params = optax.apply_updates(params, change)
    kernel = params["last"]["kernel"]
    params["last"]["kernel"] = kernel.replace(_shrunk(kernel[...], symbols.shape[-1], SPARSITY * step_size))
    return params, state, value


def _shrunk(kernel: jax.Array, symbols: int, amount: jax.Array) -> jax.Array:
    """The last kernel, what leads from each patch to each symbol made shorter by `amount`, or zero."""
    groups = kernel.reshape(-1, CHANNELS, symbols, kernel.shape[1] // symbols)
    norm = jnp.sqrt(jnp.square(groups).sum((1, 3), keepdims=True))
    return (groups * jnp.maximum(1 - amount / jnp.maximum(norm, 1e-12), 0)).reshape(kernel.shape)


@functools.partial(jax.jit, static_argnums=0)
def _read(graph: Any, params: Any, frames: jax.Array) -> jax.Array:
    return nnx.merge(graph, params)(frames).argmax(-1).astype(jnp.int32)
