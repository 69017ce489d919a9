"""Comparing our frames with those of craftax's own renderers."""

from __future__ import annotations

import numpy as np
import pytest

from adapters.numerics import loose_numerics

ROUNDING = 1e-4  # of 255: the last bits of float32


def original_renderer(constants, renderer, make: str):
    """craftax's own renderer from `EnvState` to float frames in [0, 255], with textures of the one size it needs.

    Args:
      constants, renderer: the game's modules.
      make: the function of the latter that makes it.
    """
    size = constants.BLOCK_PIXEL_SIZE_AGENT
    with pytest.MonkeyPatch.context() as patch, loose_numerics():
        textures = {size: constants.load_all_textures_given_size(size)}
        patch.setattr(renderer, "load_all_textures", lambda: textures)
        render = getattr(renderer, make)(size)

    def original(state):
        with loose_numerics():
            return render(state)

    return original


def check_equal(ours, theirs):
    """Equal bytes, but where craftax's own value is a tie: the same code compiled otherwise rounds those otherwise."""
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    assert ours.shape == theirs.shape and ours.dtype == np.float32
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=ROUNDING)
    tie = np.abs(theirs % 1 - 0.5) < ROUNDING
    np.testing.assert_array_equal(np.round(ours)[~tie], np.round(theirs)[~tie])
    assert (np.round(ours) != np.round(theirs)).mean() < 1e-5
