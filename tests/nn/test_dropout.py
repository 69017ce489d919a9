"""Dropout's cheap bits, statistically."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.nn.dropout import dropout

RATE = 0.1


@pytest.fixture(scope="module")
def kept() -> np.ndarray:
    """bool [64, 256, 256]."""
    return np.asarray(dropout(jnp.ones((64, 256, 256)), RATE, jax.random.key(0)) > 0)


def test_identity_without_a_key_or_a_rate():
    x = jax.random.normal(jax.random.key(0), (3, 4, 5))
    assert dropout(x, RATE, None) is x
    assert dropout(x, 0.0, jax.random.key(0)) is x


def test_what_is_kept_is_scaled_and_the_type_stays():
    x = jax.random.normal(jax.random.key(0), (50, 40))
    y = dropout(x, RATE, jax.random.key(1))
    np.testing.assert_allclose(y, jnp.where(y == 0, 0, x / 0.9), rtol=1e-6)
    assert dropout(x.astype(jnp.bfloat16), RATE, jax.random.key(1)).dtype == jnp.bfloat16


@pytest.mark.parametrize("rate", [0.1, 0.5, 0.9])
def test_rate(rate):
    dropped = np.mean(dropout(jnp.ones((16, 512, 256)), rate, jax.random.key(2)) == 0)
    assert abs(dropped - rate) < 5 * np.sqrt(rate * (1 - rate) / 2**21)


def test_rows_and_columns_vary_as_independent_bits_would(kept):
    for axis, count in ((2, 256), (1, 256), (0, 64)):
        means = kept.mean(axis)
        expected = np.sqrt(RATE * (1 - RATE) / count)
        assert abs(means.std() / expected - 1) < 0.03
        assert abs(means - (1 - RATE)).max() < 6 * expected


def test_pairs_of_entries_are_uncorrelated(kept):
    bits = (kept - kept.mean()) / kept.std()
    rows = bits.reshape(-1, 256)
    between_columns = rows.T @ rows / len(rows)
    columns = bits.transpose(1, 0, 2).reshape(256, -1)
    between_rows = columns @ columns.T / columns.shape[1]
    matrices = bits.reshape(64, -1)
    between_matrices = matrices @ matrices.T / matrices.shape[1]
    for correlation, samples in (
        (between_columns, len(rows)),
        (between_rows, columns.shape[1]),
        (between_matrices, matrices.shape[1]),
    ):
        off = correlation[~np.eye(len(correlation), dtype=bool)]
        assert abs(off).max() < 6 / np.sqrt(samples)
        assert abs(off.std() * np.sqrt(samples) - 1) < 0.1


def test_the_four_corners_of_rectangles_are_uncorrelated(kept):
    # What a row's word and a column's word would show if they were mixed badly (by xor, say).
    bits = (kept - kept.mean()) / kept.std()
    for down, right in ((1, 1), (3, 7), (128, 64)):
        product = bits * np.roll(bits, down, 1) * np.roll(bits, right, 2) * np.roll(bits, (down, right), (1, 2))
        assert abs(product.mean()) < 5 / np.sqrt(product.size)


def test_keys_differ():
    one, two = (np.asarray(dropout(jnp.ones((64, 64)), 0.5, jax.random.key(seed))) for seed in (0, 1))
    assert 0.4 < np.mean(one == two) < 0.6
