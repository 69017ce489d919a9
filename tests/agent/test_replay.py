"""Tokens that are kept beside stored frames are what the tokenizer says of them now."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from suite.agent.replay import Replay
from suite.interface.environment import EnvironmentSpec, ObservationSpec
from suite.policy.ppo import Trajectory
from suite.tokenizers import nearest_neighbor
from suite.tokenizers.nearest_neighbor import NearestNeighborTokenizer

ENVS, ROOM, STEPS = 2, 10, 4
OBSERVATION = ObservationSpec((4, 6, 3), 255, "pixels", (2, 2))
TOKENIZER = NearestNeighborTokenizer(90, 0.1, (2, 2), OBSERVATION)
SPEC = EnvironmentSpec("test", OBSERVATION, num_actions=2, reward_classes=(0.0, 1.0))


def played(rng) -> Trajectory:
    """Frames whose patches differ a little from one of four, so that more and more codes are worth having."""
    kinds = np.array([0, 80, 160, 240])[rng.integers(0, 4, (STEPS, ENVS, 2, 1, 3, 1, 1))]
    frames = np.broadcast_to(kinds, (STEPS, ENVS, 2, 2, 3, 2, 3)).reshape(STEPS, ENVS, *OBSERVATION.shape)
    noisy = frames + rng.integers(0, 60, (STEPS, ENVS, *OBSERVATION.shape))
    none = jnp.zeros((STEPS, ENVS))
    fields = {field.name: none for field in dataclasses.fields(Trajectory)} | {
        "observation_TB": jnp.asarray(np.minimum(noisy, 255), jnp.uint8),
        "action_TB": jnp.zeros((STEPS, ENVS), jnp.int32),
        "terminated_TB": none > 0,
        "first_TB": none > 0,
        "turn_TB": None,
        "state_TB": None,
    }
    return Trajectory(**fields)


def test_kept_tokens_are_those_of_the_present_codebook(monkeypatch):
    monkeypatch.setattr(nearest_neighbor, "NEWCOMERS", 3)  # fewer than come in an iteration
    rng, replay = np.random.default_rng(0), Replay(ENVS, ROOM)
    state, codebook = replay.init(SPEC, tokens=TOKENIZER.tokens_per_frame), TOKENIZER.init(jax.random.key(0))
    code = jax.jit(lambda state, codebook, known: replay.code(state, TOKENIZER, codebook, known, STEPS))
    renewed = 0
    for iteration in range(5):  # the buffer is full in the third
        trajectory = played(rng)
        state = replay.add(state, trajectory)
        known = codebook.count
        if iteration != 3:  # then nothing is learned
            codebook, _ = TOKENIZER.update(codebook, trajectory.observation_TB[:, 0])
        before = np.asarray(state.experience.coded.tokens)
        state = code(state, codebook, known)
        stored = slice(0, min(ROOM, STEPS * (iteration + 1)))
        kept = jax.tree.map(lambda x, stored=stored: np.asarray(x[:, stored]), state.experience)
        tokens, distance = TOKENIZER.nearest(codebook, jnp.asarray(kept.observation))
        np.testing.assert_array_equal(kept.coded.tokens, tokens)
        np.testing.assert_array_equal(kept.coded.distance, distance)
        old = np.arange(STEPS * (iteration + 1) - ROOM, STEPS * iteration) % ROOM if iteration > 1 else []
        renewed += (before[:, old] != np.asarray(state.experience.coded.tokens)[:, old]).sum()
    assert renewed > 5 and codebook.count > 12
    sampled = replay.sample(state, jax.random.key(1), 20, 3)
    np.testing.assert_array_equal(sampled.coded.tokens, TOKENIZER.encode(codebook, sampled.observation))


def test_without_tokens_none_are_kept():
    replay = Replay(ENVS, ROOM)
    state = replay.add(replay.init(SPEC), played(np.random.default_rng(0)))
    assert state.experience.coded is None and replay.sample(state, jax.random.key(1), 2, 3).coded is None
