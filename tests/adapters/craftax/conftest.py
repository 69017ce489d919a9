"""One play of Craftax-classic, compiled once and looked at by many tests."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

from adapters.craftax.task import CraftaxClassic
from tests.contract import check_environment

STEPS, BATCH = 250, 8
LAVA = 14  # craftax's BlockType


@pytest.fixture(scope="session")
def environment():
    return CraftaxClassic()


def lava_under(state, index):
    row, column = state.player_position[index]
    return state.replace(map=state.map.at[index, row, column].set(LAVA))


@pytest.fixture(scope="session")
def play(environment):
    """Environment 0 dies exactly at the time limit, 1 only reaches it, 2 only dies; 4, 5 and 6 reach it later.

    3 and 7 begin in the evening.
    """

    def prepare(state):
        state = lava_under(lava_under(state, 0), 2)
        return state.replace(timestep=jnp.array([9999, 9999, 5, 205, 9990, 9980, 9970, 250], jnp.int32))

    return check_environment(environment, jax.random.key(3), STEPS, BATCH, prepare)
