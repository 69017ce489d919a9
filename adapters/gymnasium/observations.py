"""What Gymnasium's spaces hold as uint8 images and symbols. Importing this module imports no game and no JAX."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatten, flatten_space

from suite.runtime.errors import RunError

if TYPE_CHECKING:
    from suite.interface.environment import ObservationSpec

MAX_PATCHES = 9  # a side, as Craftax-classic has
MAX_CHANNELS = 16
MAX_VALUES = 256 * 256 * 4  # of an image: `small` keeps 32,000 of them, 8 GiB
MAX_CATEGORIES = 256
MAX_SYMBOLS = 128
QUANTILES = 32
BEYOND = 2.0 ** np.arange(-3, 4)  # times the range seen: edges of bins outside of it

Encode = Callable[[Any], np.ndarray]


class Seen(NamedTuple):
    """How an observation becomes one of ours; `encode` raises a `RunError` where it holds what its space does not."""

    spec: ObservationSpec
    encode: Encode


class UnseenError(ValueError):
    """A space whose observations cannot become ours: what they are."""


def seen(space: spaces.Space, play: Callable[[Encode], Iterable[np.ndarray]]) -> Seen:
    """How observations of this space become ours.

    Boxes of two or three axes are images if they are uint8 or have more than 128 values: channels are the last axis, or
    the first where that leaves an image; floats between two bounds become 0 to 255. Of a `Dict` with an "image" that is
    seen. All else is flattened to a vector of at most 128 symbols: see `symbols`; a larger `Discrete` becomes digits,
    and all other numbers bins (`Bins`).

    Args:
      space: of the observations.
      play: shows the observations of random play, each as the function that it is given makes it.

    Raises:
      UnseenError: they cannot.
    """
    from suite.interface.environment import ObservationSpec

    if isinstance(space, spaces.Dict) and "image" in space.spaces:
        inner = seen(space["image"], play)
        return Seen(inner.spec, lambda observation: inner.encode(observation["image"]))
    if isinstance(space, spaces.Discrete) and int(space.n) > MAX_CATEGORIES:
        return _digits(int(space.n), int(space.start))
    large = isinstance(space, spaces.Box) and (space.dtype == np.uint8 or math.prod(space.shape) > MAX_SYMBOLS)
    if isinstance(space, spaces.Box) and large and len(space.shape) in (2, 3):
        return _image(space)
    low_O, high_O, vector = _as_vector(space)
    size = len(low_O)
    if not 1 <= size <= MAX_SYMBOLS:
        raise UnseenError(
            f"{size} numbers; 1 to {MAX_SYMBOLS} can be symbols, and images are uint8 or floats in bounds"
        )
    whole = symbols(space)
    if whole is not None:
        return whole
    bins = Bins(np.stack([*play(vector)]), low_O, high_O)
    return Seen(ObservationSpec((size,), bins.high, "symbols"), lambda observation: bins(vector(observation)))


def symbols(space: spaces.Space) -> Seen | None:
    """Whole numbers of up to 256 values each as symbols, flattened, each from its lowest value on; None: not such.

    Raises:
      UnseenError: the space cannot be flattened.
    """
    from suite.interface.environment import ObservationSpec

    low_O, high_O, vector = _as_vector(space)
    if low_O.dtype.kind not in "biu" or (high_O.astype(float) - low_O).max(initial=0) >= MAX_CATEGORIES:
        return None
    low_O = low_O.astype(np.int64)
    high = max(int((high_O - low_O).max(initial=0)), 1)
    spec = ObservationSpec(low_O.shape, high, "symbols")
    return Seen(spec, lambda observation: _within(vector(observation).astype(np.int64) - low_O, high).astype(np.uint8))


class Bins:
    """Numbers as bins: 32 quantiles of what random play shows and, as a good policy may leave that, bins outside of it.

    Equal numbers count once, so up to 32 values that are shown have a bin each. The outer edges are at 1/8, 1/4, ..., 8
    times the range shown (1 where it is a single number) on either side, as far as the space's bounds; the last bins
    hold all that lies further out.

    Args:
      shown_NO: float, the observations of random play.
      low_O, high_O: bounds of the space.
    """

    def __init__(self, shown_NO: np.ndarray, low_O: np.ndarray, high_O: np.ndarray):
        edges = [_edges(*dimension) for dimension in zip(shown_NO.T, low_O, high_O, strict=True)]
        self.high = max(1, *map(len, edges))  # the last bin
        self._edges_OE = np.array([np.pad(e, (0, self.high - len(e)), constant_values=np.inf) for e in edges])

    def __call__(self, number_O: np.ndarray) -> np.ndarray:
        """uint8 [O]: how many edges lie below each number."""
        return (number_O[:, None] > self._edges_OE).sum(1).astype(np.uint8)


def _edges(shown_N: np.ndarray, low: float, high: float) -> np.ndarray:
    """Ascending edges of one dimension's bins."""
    distinct = np.unique(shown_N[np.isfinite(shown_N)]) if np.isfinite(shown_N).any() else np.zeros(1)
    quantiles = np.quantile(distinct, np.linspace(0, 1, QUANTILES), method="nearest")
    # To six digits: another processor may compute the last ones of what is shown otherwise.
    inner = np.array([float(f"{quantile:.6g}") for quantile in quantiles])
    width = float(inner[-1] - inner[0]) or 1.0
    lower = inner[0] - width * BEYOND
    edges = np.concatenate([inner, inner[-1] + width * BEYOND, lower[lower > low]])
    return np.unique(edges[edges < high])


def _as_vector(space: spaces.Space) -> tuple[np.ndarray, np.ndarray, Encode]:
    """The bounds of the numbers that a space holds, one after another, and what makes a vector of these numbers.

    Nested spaces are flattened by Gymnasium's own functions: a `Discrete` in them has one number for each category.
    """
    low: np.ndarray
    high: np.ndarray
    if isinstance(space, spaces.Discrete):
        low = np.array(int(space.start))
        high = low + int(space.n) - 1
    elif isinstance(space, spaces.MultiDiscrete):
        low = np.asarray(space.start)
        high = low + np.asarray(space.nvec) - 1
    elif isinstance(space, spaces.MultiBinary):
        low, high = np.zeros(space.shape, np.int8), np.ones(space.shape, np.int8)
    elif isinstance(space, spaces.Box):
        low, high = space.low, space.high
    elif isinstance(box := flatten_space(space), spaces.Box):
        low, high, _ = _as_vector(box)
        return low, high, lambda observation: _number(flatten(space, observation)).reshape(low.shape)
    else:
        raise UnseenError(f"{type(space).__name__}, which cannot be flattened to numbers")
    return np.ravel(low), np.ravel(high), lambda observation: _number(observation).reshape(np.shape(low)).ravel()


def _digits(categories: int, start: int) -> Seen:
    """As few equally large digits as hold the categories, the most significant one first."""
    from suite.interface.environment import ObservationSpec

    count = next(n for n in itertools.count(1) if MAX_CATEGORIES**n >= categories)
    base = next(b for b in itertools.count(1) if b**count >= categories)

    def encode(observation: Any) -> np.ndarray:
        number = int(_within(np.array(int(observation) - start), categories - 1))
        return np.array([number // base**place % base for place in reversed(range(count))], np.uint8)

    return Seen(ObservationSpec((count,), base - 1, "symbols"), encode)


def _image(space: spaces.Box) -> Seen:
    """[height, width], [height, width, channels] or [channels, height, width] as an image with channels last."""
    from suite.interface.environment import ObservationSpec

    rows, columns, channels = sides = space.shape if len(space.shape) == 3 else (*space.shape, 1)
    channels_first = rows < channels and rows != columns
    if channels_first:
        channels, rows, columns = sides
    low, high = float(space.low.min()), float(space.high.max())
    whole = np.dtype(space.dtype).kind in "biu"
    if channels > MAX_CHANNELS:
        raise UnseenError(f"{space.shape}, not [height, width] with up to {MAX_CHANNELS} channels before or behind")
    if math.prod(sides) > MAX_VALUES:
        hint = "gymnasium.wrappers has ResizeObservation"
        raise UnseenError(f"{space.shape}, more than the {MAX_VALUES:,} values that an image may have ({hint})")
    if not (0 <= low < high <= 255 if whole else -math.inf < low < high < math.inf):
        raise UnseenError(
            f"{space.shape} from {low:g} to {high:g}, not an image of 0 to at most 255, or floats in bounds"
        )

    def encode(observation: Any) -> np.ndarray:
        image = _number(observation).reshape(sides)
        image = np.moveaxis(image, 0, -1) if channels_first else image
        levels = _within(image, high) if whole else np.round(255 * np.clip((image - low) / (high - low), 0, 1))
        return levels.astype(np.uint8)

    top = int(high) if whole else 255
    spec = ObservationSpec((rows, columns, channels), top, "pixels" if top == 255 else "grid", patch(rows, columns))
    return Seen(spec, encode)


def _number(observation: Any) -> np.ndarray:
    """An array without NaN."""
    array = np.asarray(observation)
    if array.dtype.kind == "f" and np.isnan(array).any():
        raise RunError("the observation holds nan")
    return array


def _within(integers: np.ndarray, high: float) -> np.ndarray:
    """The same, if all are in [0, high]."""
    if integers.min() < 0 or integers.max() > high:
        raise RunError(f"the observation holds a number from outside its space, which has {high + 1:g} values")
    return integers


def patch(height: int, width: int) -> tuple[int, int]:
    """The smallest patch with at most nine a side: a square that divides both sides, or else each side by itself."""
    square = next((n for n in range(1, math.gcd(height, width) + 1) if _tiles(height, n) and _tiles(width, n)), None)
    if square is not None:
        return square, square
    rows = next(n for n in range(1, height + 1) if _tiles(height, n))
    columns = next(n for n in range(1, width + 1) if _tiles(width, n))
    return rows, columns


def _tiles(side: int, patch: int) -> bool:
    return side % patch == 0 and side // patch <= MAX_PATCHES
