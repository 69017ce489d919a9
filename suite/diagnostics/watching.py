"""`suite watch`: whole episodes of a trained policy as a film and, beside each frame, what the world model expected."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from suite import registry
from suite.agent.algorithm import evaluation_key
from suite.agent.phases import Agent
from suite.diagnostics.filmstrips import FRAME_SIDE, Strip, film
from suite.diagnostics.pictures import pages
from suite.interface.environment import EnvironmentSpec
from suite.interface.tokens import TokenizerState
from suite.interface.turns import CHANCE
from suite.policy.ppo import PolicyTrainState
from suite.records.record import RunRecord, require_writable
from suite.runs.saved_model import restore
from suite.runtime.errors import UserError
from suite.runtime.reporting import Reporter
from suite.world_model.history import paid_before
from suite.world_model.imagination import Past

CHUNK = 32  # frames from which the next ones are imagined at once
SECONDS = 0.2  # of each frame
READING = 1.5  # seconds of each page of text
ACROSS = 16  # symbols in a line
MOVERS = ("chance", "agent", "opponent")


@dataclasses.dataclass(frozen=True)
class Episode:
    """T steps of one episode, as a policy played them.

    Attributes:
      frames: uint8 [T, O]; what was acted on.
      action: int32 [T].
      reward: float32 [T]; what the step earned.
      value: float32 [T]; what the policy expected from there on.
      achievements: bool [T, N]; unlocked by the step or before; N = 0 for a task without.
      ended: whether its last step is the episode's, and not merely the last that was asked for.
      mover: whose event it was, int [T] into `MOVERS`; None for single-agent tasks.
    """

    frames: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    value: np.ndarray
    achievements: np.ndarray
    ended: bool
    mover: np.ndarray | None = None


def watch(
    folder: Path, out: Path | None, episodes: int, steps: int, dream: bool, seed: int, reporter: Reporter
) -> tuple[Path, list[Episode]]:
    """Films whole episodes of a run's newest checkpoint.

    Args:
      folder: of a run. What has no frames is shown as the game's own text, or its symbols' values.
      out: of the GIF; None: `watch.gif` in the folder.
      episodes: so many, one after the other.
      steps: of each at most.
      dream: also show what the world model expected of each frame, one step before.
      seed: of play, and of what is drawn.
      reporter: where progress goes.

    Raises:
      UserError: the run has no checkpoint, or `dream` is asked for and it has no world model or no frames.
    """
    with RunRecord.open(folder, lock=False) as record:
        spec, name = record.spec, f"{record.config.task} {record.config.agent} seed {record.config.seed}"
        text = spec.observation.kind == "symbols"
        if dream and text:
            raise UserError(f"{spec.id} shows symbols, and --dream compares frames; see suite inspect, or leave it out")
        if dream and not record.config.world_model.enabled:
            raise UserError(f"{folder} has no world model to dream with: {record.config.agent}")
        path = out or folder / "watch.gif"
        require_writable(path.parent)
        run = restore(record, reporter)
    key = jax.random.fold_in(evaluation_key(seed, run.step), 2)
    played = play(run.agent, run.model.policy_state, key, episodes, steps)
    if text:
        notes, texts = told(played, spec)
        frames = pages(texts, FRAME_SIDE)
        film(path, Strip(name, frames, {}, notes, frames.shape[1:3], 255), READING)
        return path, played
    frames = np.concatenate([episode.frames for episode in played])
    imagined = {}
    if dream:
        assert run.model.tokenizer is not None
        expected = [expectations(run.agent, run.model.world_model, run.model.tokenizer, one, key) for one in played]
        # Of an episode's first frame nothing was expected: it stands for itself.
        shown = [np.concatenate([one.frames[:1], frames]) for one, frames in zip(played, expected, strict=True)]
        imagined["expected"] = np.concatenate(shown)[1:]
    notes = [note for number, episode in enumerate(played) for note in captions(episode, spec, number + 1)]
    patch = run.agent.tokenizer.patch if dream and hasattr(run.agent.tokenizer, "patch") else spec.observation.patch
    film(path, Strip(name, frames, imagined, notes, patch or (1, 1), spec.observation.high), SECONDS)
    return path, played


def play(agent: Agent, policy_state: PolicyTrainState, key: jax.Array, episodes: int, steps: int) -> list[Episode]:
    """The first episode of each of the first environments, at most so many steps of each."""
    if episodes > agent.batched.num_envs:
        raise UserError(f"{episodes} episodes are too many: {agent.batched.num_envs} environments play side by side")
    key, start_key = jax.random.split(key)
    rollout_state = agent.start(policy_state, start_key)
    parts: list[dict[str, np.ndarray]] = []
    taken, going = 0, np.ones(episodes, bool)
    while taken < steps and going.any():
        key, play_key = jax.random.split(key)
        rollout_state, trajectory, log = agent.collect(policy_state, rollout_state, play_key)
        trajectory, log = jax.device_get((trajectory, log))
        nothing = np.zeros((*trajectory.action_TB.shape, 0), bool)
        parts.append(
            {
                "frames": trajectory.observation_TB[:, :episodes],
                "action": trajectory.action_TB[:, :episodes],
                "reward": trajectory.reward_TB[:, :episodes],
                "value": trajectory.value_TB[:, :episodes],
                "achievements": log.statistics_TB.get("achievements", nothing)[:, :episodes].astype(bool),
                "ended": log.ended_TB[:, :episodes],
            }
        )
        if (turn := trajectory.turn_TB) is not None:
            parts[-1]["mover"] = np.where(turn.ours, 1, np.where(turn.player == CHANCE, 0, 2))[:, :episodes]
        taken += len(log.ended_TB)
        going &= ~log.ended_TB[:, :episodes].any(axis=0)
    whole = {name: np.concatenate([part[name] for part in parts])[:steps] for name in parts[0]}
    ended_TB = whole.pop("ended")
    found = []
    for b in range(episodes):
        ends = np.flatnonzero(ended_TB[:, b])
        last = int(ends[0]) + 1 if len(ends) else len(ended_TB)
        found.append(Episode(**{name: x[:last, b] for name, x in whole.items()}, ended=bool(len(ends))))
    return found


def expectations(
    agent: Agent, world_model: nnx.State, tokenizer: TokenizerState, episode: Episode, key: jax.Array
) -> np.ndarray:
    """What a world model expected of every frame but the first, given the one before it: uint8 [T - 1, O].

    Each is drawn as the first step of a dream is that starts at the frame before, with all that dreams are told of what
    happened earlier. Before the episode's beginning the first frame is taken to have stood still.
    """
    steps, before = len(episode.action) - 1, agent.past
    frames = np.concatenate([episode.frames[:1].repeat(before, 0), episode.frames])
    action = np.concatenate([np.zeros(before, np.int32), episode.action])
    pays = agent.spec.pays(jnp.asarray(episode.reward))[:, None]
    nothing = jnp.zeros((1, agent.spec.num_actions), jnp.uint8)
    first = jnp.zeros((len(episode.action), 1), bool)
    paid = np.asarray(paid_before(nothing, jnp.asarray(episode.action)[:, None], pays, first)[0][:, 0])
    window = np.arange(before)
    shown = []
    for start in range(0, steps, CHUNK):
        now = np.minimum(np.arange(start, start + CHUNK), steps - 1)  # one shape, one compilation
        earlier = now[None] + window[:, None]  # [P, B] in `frames`, which begin `before` earlier
        expected = _expected(
            agent,
            world_model,
            tokenizer,
            jnp.asarray(episode.frames[now]),
            jnp.asarray(episode.action[now]),
            jnp.asarray(paid[now]),
            Past(jnp.asarray(frames[earlier]), jnp.asarray(action[earlier])) if before else None,
            jax.random.fold_in(key, start),
        )
        shown.append(np.asarray(expected)[: steps - start])
    return np.concatenate(shown) if shown else episode.frames[:0]


@functools.partial(jax.jit, static_argnums=0)
def _expected(
    agent: Agent,
    world_model: nnx.State,
    tokenizer: TokenizerState,
    frames_BO: jax.Array,
    action_B: jax.Array,
    paid_BA: jax.Array,
    past: Past | None,
    key: jax.Array,
) -> jax.Array:
    model = nnx.merge(agent.world_model_graph, world_model)
    dream = agent.dream_from(model, tokenizer, frames_BO, None, 1, past, None, paid_BA)
    state, _ = dream.reset(key)
    observation_BO: jax.Array = dream.step(key, state, action_B)[1].observation
    return observation_BO


def told(episodes: Sequence[Episode], spec: EnvironmentSpec) -> tuple[list[str], list[str]]:
    """Captions and texts: a page for each step and, where the game tells it, one for how an episode ends."""
    notes, texts = [], []
    tell = registry.task(spec.id).text
    for number, episode in enumerate(episodes, 1):
        if tell is None:
            notes += captions(episode, spec, number)
            texts += [
                "\n".join(map(_values, np.split(frame, range(ACROSS, len(frame), ACROSS)))) for frame in episode.frames
            ]
            continue
        states, moves = tell()(episode.action)
        notes += captions(episode, spec, number, moves)
        texts += states if episode.ended else states[:-1]
        if episode.ended:
            notes.append(f"episode {number}: over\nreturn {episode.reward.sum():.1f}")
    return notes, texts


def _values(symbols: np.ndarray) -> str:
    return " ".join(f"{symbol:3d}" for symbol in symbols)


def captions(episode: Episode, spec: EnvironmentSpec, number: int, moves: Sequence[str] = ()) -> list[str]:
    """What stands above each frame: step, action, what it earned, the return by then, and the policy's value.

    `moves`: what the game calls the episode's events.
    """
    lines, total = [], 0.0
    unlocked = np.diff(episode.achievements.astype(int), axis=0, prepend=0) > 0
    for t, action in enumerate(episode.action):
        total += float(episode.reward[t])
        name = spec.action_names[action] if spec.action_names else f"action {action}"
        if episode.mover is not None:
            name = f"{MOVERS[episode.mover[t]]}: {moves[t] if moves else name}"
        earned = f" {episode.reward[t]:+.1f}" if abs(episode.reward[t]) > 0.05 else ""
        won = "".join(f" {spec.achievements[i]}!" for i in np.flatnonzero(unlocked[t]))
        lines.append(
            f"episode {number}, step {t + 1}: {name}{earned}{won}\nreturn {total:.1f}, value {episode.value[t]:.2f}"
        )
    return lines
