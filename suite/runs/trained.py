"""What a run has learned, from Python: a policy that acts, and a world model that dreams.

Arrays are NumPy's and lead with B, whatever is side by side; what is given without that axis is answered without it.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from suite.agent.phases import Agent
from suite.policy.actor_critic import mask_logits
from suite.runs.saved_model import RestoredRun
from suite.runtime.errors import UserError
from suite.world_model.history import MOST
from suite.world_model.imagination import Past


class Player:
    """A trained policy that acts on observations."""

    def __init__(self, restored: RestoredRun):
        self._agent, self._state = restored.agent, restored.model.policy_state
        self.spec = restored.agent.spec
        self.reset()

    def reset(self, seed: int = 0) -> None:
        """Forgets what it has seen; `seed` is of the actions that it samples from then on."""
        self._key = jax.random.key(seed)
        self._hidden_BH: jax.Array | None = None

    def act(
        self,
        observation: np.ndarray,
        first: np.ndarray | bool | None = None,
        legal: np.ndarray | None = None,
        acting: np.ndarray | bool | None = None,
        greedy: bool = False,
    ) -> np.ndarray:
        """Actions, int32 [B].

        Args:
          observation: uint8 [B, *spec.observation.shape].
          first: bool [B]; whether each opens an episode, so that the memory of what came before is dropped. None: if
            this is the first call since `reset`.
          legal: bool [B, A]; in games, which actions are.
          acting: bool [B]; in games, whose turn it is: where it is not ours the memory stays, and the action is of no
            use. None: all are ours.
          greedy: the likeliest action instead of a sampled one, as episodes are never scored.

        Raises:
          UserError: arrays of other shapes or types.
        """
        logits = self.preferences(observation, first, acting)
        if legal is not None:
            logits = np.asarray(mask_logits(jnp.asarray(logits), jnp.asarray(legal, bool)))
        if greedy:
            return logits.argmax(-1).astype(np.int32)
        self._key, key = jax.random.split(self._key)
        return np.asarray(jax.random.categorical(key, jnp.asarray(logits)), np.int32)

    def preferences(
        self,
        observation: np.ndarray,
        first: np.ndarray | bool | None = None,
        acting: np.ndarray | bool | None = None,
    ) -> np.ndarray:
        """Logits of all actions, float32 [B, A]; arguments and errors as of `act`. The memory advances."""
        observation_BO, alone = _batch(observation, self.spec.observation.shape, "observation")
        batch = len(observation_BO)
        if self._hidden_BH is None or len(self._hidden_BH) != batch:
            self._hidden_BH = _nothing(self._agent, self._state.params, batch)
            first = True if first is None else first
        flags = [False if first is None else first, True if acting is None else acting]
        first_B, acting_B = (jnp.broadcast_to(jnp.asarray(flag, bool), (batch,)) for flag in flags)
        logits_BA, self._hidden_BH = _preferences(
            self._agent, self._state.params, observation_BO, first_B, acting_B, self._hidden_BH
        )
        return np.asarray(logits_BA[0] if alone else logits_BA)


@dataclasses.dataclass(frozen=True)
class Imagined:
    """What a world model made of T actions.

    Attributes:
      frames: uint8 [B, T, *spec.observation.shape]; what each action led to.
      rewards: float32 [B, T]; levels that the world model tells apart.
      ends: bool [B, T]; whether the episode ended there. The model goes on all the same.
    """

    frames: np.ndarray
    rewards: np.ndarray
    ends: np.ndarray


class Dreamer:
    """A trained world model and its tokenizer."""

    def __init__(self, restored: RestoredRun):
        self._agent, self._model = restored.agent, restored.model
        self.spec = restored.agent.spec

    def dream(
        self,
        frames: np.ndarray,
        actions: np.ndarray,
        before: tuple[np.ndarray, np.ndarray] | None = None,
        paid: np.ndarray | None = None,
        seed: int = 0,
    ) -> Imagined:
        """What happens if these actions are taken from these frames on.

        Args:
          frames: uint8 [B, *spec.observation.shape].
          actions: int [B, T].
          before: the P frames before those, uint8 [B, P, *spec.observation.shape], oldest first, and the actions taken
            on them, int [B, P]. A model that is told what happened earlier (m6's ages) dreams worse without them; P
            must be at least what it is told, `needs`.
          paid: int [B, A]; how often each action has earned a reward in the episode, for a model that is told (m6's on
            Craftax). None: nothing was paid yet.
          seed: of what is drawn.

        Raises:
          UserError: arrays of other shapes or types, or actions that there are not.
        """
        shape = self.spec.observation.shape
        frames_BO, alone = _batch(frames, shape, "frames")
        actions_BT = np.atleast_2d(np.asarray(actions, np.int32))
        if actions_BT.ndim != 2 or len(actions_BT) != len(frames_BO):
            raise UserError(f"actions have shape {list(np.shape(actions))}, expected {len(frames_BO)} times steps")
        most = self.spec.num_actions - 1
        if actions_BT.size and not 0 <= actions_BT.min() <= actions_BT.max() <= most:
            raise UserError(f"actions are {actions_BT.min()} to {actions_BT.max()}, expected 0 to {most}")
        past = None
        if before is not None:
            earlier, taken = np.asarray(before[0], np.uint8), np.asarray(before[1], np.int32)
            if alone:
                earlier, taken = earlier[None], taken[None]
            steps = taken.shape[-1]
            if earlier.shape != (len(frames_BO), steps, *shape) or taken.shape != (len(frames_BO), steps):
                raise UserError(
                    f"frames before have shape {list(earlier.shape)}, and their actions {list(taken.shape)}"
                )
            if steps < self.needs:
                raise UserError(f"{steps} frames come before, and this model is told of {self.needs}")
            past = Past(
                jnp.asarray(earlier[:, steps - self.needs :].swapaxes(0, 1)),
                jnp.asarray(taken[:, steps - self.needs :].T),
            )
        paid_BA = None
        if paid is not None:
            paid_BA = jnp.asarray(np.atleast_2d(np.asarray(paid)).clip(0, MOST), jnp.uint8)
            if paid_BA.shape != (len(frames_BO), most + 1):
                expected = [len(frames_BO), most + 1]
                raise UserError(f"paid has shape {list(np.shape(paid))}, expected {expected}: a count for each action")
        seen = _dream(
            self._agent,
            self._model.world_model,
            self._model.tokenizer,
            frames_BO,
            jnp.asarray(actions_BT.T),
            past if self.needs else None,
            paid_BA,
            jax.random.key(seed),
        )
        arrays = [np.asarray(x).swapaxes(0, 1) for x in seen]
        return Imagined(*(array[0] if alone else array for array in arrays))

    @property
    def needs(self) -> int:
        """How many frames before a dream's first one the model is told of, in training."""
        return self._agent.past

    def encode(self, frames: np.ndarray) -> np.ndarray:
        """Tokens of frames, int32 [B, L] (float32 vectors for a tokenizer without codes)."""
        frames_BO, alone = _batch(frames, self.spec.observation.shape, "frames")
        tokens_BL = np.asarray(self._agent.tokenizer.encode(self._model.tokenizer, frames_BO))
        return tokens_BL[0] if alone else tokens_BL

    def decode(self, tokens: np.ndarray) -> np.ndarray:
        """Frames that tokens [..., L] stand for, uint8."""
        return np.asarray(self._agent.tokenizer.decode(self._model.tokenizer, jnp.asarray(tokens)))


@functools.partial(jax.jit, static_argnums=0)
def _preferences(
    agent: Agent, params: Any, observation_BO: jax.Array, first_B: jax.Array, acting_B: jax.Array, hidden_BH: jax.Array
) -> tuple[jax.Array, jax.Array]:
    policy = nnx.merge(agent.policy_graph, params)
    acting_1B = acting_B[None] if agent.spec.two_player else None
    output, hidden_BH = policy(observation_BO[None], first_B[None], hidden_BH, acting_1B)
    return output.logits_TBA[0], hidden_BH


@functools.partial(jax.jit, static_argnums=0)
def _dream(
    agent: Agent,
    world_model: nnx.State,
    tokenizer: Any,
    frames_BO: jax.Array,
    action_TB: jax.Array,
    past: Past | None,
    paid_BA: jax.Array | None,
    key: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    model = nnx.merge(agent.world_model_graph, world_model)
    dream = agent.dream_from(model, tokenizer, frames_BO, None, len(action_TB), past, None, paid_BA)
    start, _ = dream.reset(key)

    def step(state: Any, inputs: tuple[jax.Array, jax.Array]) -> tuple[Any, Any]:
        state, shown = dream.step(inputs[0], state, inputs[1])
        return state, (shown.observation, shown.reward, shown.terminated)

    _, seen = jax.lax.scan(step, start, (jax.random.split(key, len(action_TB)), action_TB))
    return seen


def _nothing(agent: Agent, params: Any, batch: int) -> jax.Array:
    """What a policy remembers that has seen nothing."""
    hidden_BH: jax.Array = nnx.merge(agent.policy_graph, params).initial_hidden(batch)
    return hidden_BH


def _batch(array: np.ndarray, shape: tuple[int, ...], name: str) -> tuple[jax.Array, bool]:
    """The array with a batch's axis, and whether it came without."""
    found = np.asarray(array)
    alone = found.shape == shape
    if not alone and found.shape[1:] != shape:
        raise UserError(f"{name}: shape {list(found.shape)}, expected {list(shape)}, or several of it")
    if found.dtype.kind not in "bui":
        raise UserError(f"{name}: numbers of type {found.dtype}, expected whole ones, as the task shows them (uint8)")
    return jnp.asarray(found[None] if alone else found, jnp.uint8), alone
