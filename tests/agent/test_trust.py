"""Dreams teach only where the world model foresees rewards."""

from __future__ import annotations

import jax.numpy as jnp
import pytest

from suite import registry
from suite.errors import UserError
from suite.interface.tokens import TokenSpec
from suite.world_model.training import known_share

SPEC = TokenSpec(tokens_per_frame=1, num_codes=2, num_actions=2, reward_classes=(-1.0, 0.0, 1.0))
REWARDS = jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
ENTROPY = 4 / 6 * jnp.log(6 / 4) + 2 * (1 / 6 * jnp.log(6.0))


@pytest.mark.parametrize(("loss", "known"), [(0.0, 1.0), (ENTROPY, 0.0), (ENTROPY / 4, 0.75), (2 * ENTROPY, -1.0)])
def test_what_is_known_of_rewards(loss, known):
    assert known_share(SPEC, jnp.asarray(loss), REWARDS) == pytest.approx(known, abs=1e-6)


def test_of_rewards_that_are_all_alike_nothing_is_known():
    assert known_share(SPEC, jnp.asarray(0.3), 0 * REWARDS) == 0


def test_no_dreams_below_the_threshold():
    config = registry.resolve("minatar/breakout", "m6", "small")
    after = config.imagination.start_step
    updates = [config.imagined_updates(after, known) for known in (0.69, 0.7, 1.0, None)]
    assert updates == [0, *[config.imagination.updates] * 3]
    assert config.imagined_updates(after - 1, 1.0) == 0


def test_the_true_game_needs_no_trust():
    with pytest.raises(UserError, match="its rewards are the true ones"):
        registry.resolve("minatar/breakout", "oracle", "small", ["imagination.trust=0.5"])
