"""How good a world model's rollouts are, step by step (Section 4.4, Appendix D).

The measures are functions of arrays, so that any model, the environment itself too, can be measured. Shapes: N
trajectories of T steps, O a frame's own axes, R symbols. `counted` arrays, bool [N, T], say what enters a mean; the
mean of nothing is nan.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from suite.agent.phases import Agent
from suite.diagnostics.evaluation_set import STEPS, EvaluationSet
from suite.interface.tokens import TokenizerState, TokenSpec
from suite.world_model.history import History, ages_of
from suite.world_model.imagination import Past
from suite.world_model.transformer import WorldModel

CHUNK = 32  # trajectories imagined together
BINS = 10  # of probabilities, for calibration
Read = Callable[[np.ndarray], np.ndarray]  # uint8 [..., O] to int32 [..., R]


@dataclasses.dataclass(frozen=True)
class Rollouts:
    """What a world model makes of the first T steps of the evaluation set.

    Attributes:
      frames: uint8 [N, T, O]; imagined from the real first frame and the real actions, each frame from those before.
      reward, terminated: float32 levels and bool, [N, T]; drawn with them.
      tokenized: uint8 [N, T + 1, O]; the real frames through the tokenizer alone.
      reward_odds: float32 [N, T, classes]; probabilities of the reward's classes, given the real frames so far.
      termination_odds: float32 [N, T]; probability that the episode ends, given the real frames so far.
      codes: codes that the real frames use; None where tokens are no codes.
      copied: float32 [N, T]; the share of the next frame's tokens that is copied and not made anew, given the real
        frames so far; None for models that copy nothing.
    """

    frames: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    tokenized: np.ndarray
    reward_odds: np.ndarray
    termination_odds: np.ndarray
    codes: np.ndarray | None
    copied: np.ndarray | None = None

    @property
    def steps(self) -> int:
        """T."""
        return self.reward.shape[1]


def imagine(
    agent: Agent, world_model: nnx.State, tokenizer: TokenizerState, real: EvaluationSet, key: jax.Array, start: int = 0
) -> Rollouts:
    """Replays the actions of the evaluation set in a world model, its samples drawn as in training.

    A model whose dreams know the frames before their first knows them here too.

    Args:
      agent: of a single-agent task.
      world_model, tokenizer: parameters and state.
      real: the evaluation set.
      key: of the samples.
      start: the frame that rollouts begin with; no fewer stand before it than the agent's dreams know.
    """
    past = agent.past
    assert start >= past
    real = real.after(start - past)
    steps = min(real.action.shape[1] - past, STEPS)
    seen = past + steps
    parts: list[list[np.ndarray]] = []
    copies: list[np.ndarray] = []
    used: set[int] = set()
    shown_NT = np.pad(real.after(past).frame_counted[:, :steps], ((0, 0), (1, 0)), constant_values=True)
    for first in range(0, len(real.action), CHUNK):
        frames = real.frames[first : first + CHUNK, : seen + 1]
        action = real.action[first : first + CHUNK, :seen]
        missing = [(0, min(CHUNK, len(real.action)) - len(action))]  # one shape, one compilation
        paid = real.paid[first : first + CHUNK, :seen]
        padded = [np.pad(x, missing + [(0, 0)] * (x.ndim - 1), mode="edge") for x in (frames, action, paid)]
        batch_rollouts = _imagine(agent, world_model, tokenizer, *padded, jax.random.fold_in(key, first))
        *arrays, copied, tokens = (np.asarray(x)[: len(action)] for x in jax.device_get(batch_rollouts))
        copies.append(copied)
        parts.append(arrays)
        if agent.tokenizer.num_codes:
            used.update(np.unique(tokens[shown_NT[first : first + CHUNK]]).tolist())
    codes = np.array(sorted(used)) if agent.tokenizer.num_codes else None
    whole = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    shares = np.concatenate(copies) if agent.config.world_model.correspondence else None
    return Rollouts(*whole, codes=codes, copied=shares)  # type: ignore[misc]


@functools.partial(jax.jit, static_argnums=0)
def _imagine(
    agent: Agent,
    world_model: nnx.State,
    tokenizer: TokenizerState,
    frames_NTO: jax.Array,
    action_NT: jax.Array,
    paid_NTA: jax.Array,
    key: jax.Array,
) -> tuple[jax.Array, ...]:
    """The fields of `Rollouts` in their order but for the last two: what is copied, and the real frames' tokens.

    Of the frames and actions the first are those that the agent's dreams know besides; nothing is returned of them.
    """
    model = nnx.merge(agent.world_model_graph, world_model)
    context = agent.config.imagination.context
    past, horizon = agent.past, action_NT.shape[1] - agent.past
    known = None
    if past:
        frames, action, paid = (jnp.swapaxes(x[:, :past], 0, 1) for x in (frames_NTO, action_NT, paid_NTA))
        known = Past(frames, action, paid_PBA=paid)
    dream = agent.dream_from(model, tokenizer, frames_NTO[:, past], None, horizon, known, None, paid_NTA[:, past])
    start, _ = dream.reset(key)

    def step(state: Any, inputs: Any) -> Any:
        step_key, action_N = inputs
        state, seen = dream.step(step_key, state, action_N)
        return state, (seen.observation, seen.reward, seen.terminated)

    _, imagined = jax.lax.scan(step, start, (jax.random.split(key, horizon), action_NT[:, past:].T))
    tokens_NTL = agent.tokenizer.encode(tokenizer, frames_NTO)
    read = slice(past - context, -1)
    history_NT = History(
        ages_of(tokens_NTL, agent.ages)[:, read] if agent.ages else None, paid_NTA[:, past - context :]
    )
    hidden = _hidden_states(model, tokens_NTL[:, read], action_NT[:, past - context :], history_NT)[:, context:]
    tokens_NTL = tokens_NTL[:, past:]
    copied_NT = jnp.zeros(hidden.shape[:2])
    if model.gate_head is not None:
        copied_NT = 1 - jnp.exp(model.log_gate(hidden)[..., 0]).mean(-1)
    return (
        *(jnp.swapaxes(x, 0, 1) for x in imagined),
        agent.tokenizer.decode(tokenizer, tokens_NTL),
        jax.nn.softmax(model.reward_logits(hidden)),
        jax.nn.softmax(model.termination_logits(hidden))[..., 1],
        copied_NT,
        tokens_NTL,
    )


def _hidden_states(model: WorldModel, tokens_NTL: jax.Array, action_NT: jax.Array, history_NT: History) -> jax.Array:
    """The model's hidden states [N, T, S, D] of real frames, of which it reads the latest at each, as in a dream."""
    cache = model.init_cache(len(action_NT), min(action_NT.shape[1], model.config.sequence_length))
    steps = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), (tokens_NTL, action_NT, history_NT))
    _, hidden_TNSD = jax.lax.scan(lambda cache, step: model.step(cache, *step), cache, steps)
    return jnp.swapaxes(hidden_TNSD, 0, 1)


def compare(
    real: EvaluationSet, imagined: Rollouts, tokens: TokenSpec, high: int, read: Read | None
) -> tuple[list[dict[str, float]], dict[str, float]]:
    """Rollouts beside reality.

    Args:
      real: the evaluation set.
      imagined: of a model.
      tokens: tells the classes of rewards.
      high: largest value of a pixel.
      read: the symbol extractor; None: symbols are not known.

    Returns:
      One row per step, and a summary. Errors are squared L2 distances of frames with pixels in [0, 1]: of the rollout,
      of the tokenizer alone (the least that the rollout can have), and of the first frame `repeated`. Percents of
      whole frames that are those of the tokenizer, of the rollout and of the first frame; and, of models that copy
      tokens, which percentage of the next frame they copy. Accuracies of
      symbols are in percent, of the same, and of the extractor on the real frame (the most that a rollout can have).
      Percents of rewards and terminations that are right; and, for events, that is rewards other than 0 and
      terminations, how often they come, how likely they are by the model on the real frames, and precision and recall
      of the rollouts'. The summary has means over all steps, precision and recall of all steps' events together, and
      the calibration error of their probabilities.
    """
    steps = imagined.steps
    counted, frame_counted = real.counted[:, :steps], real.frame_counted[:, :steps]
    after, first = real.frames[:, 1 : steps + 1], real.frames[:, :1]
    seen = {
        "": imagined.frames,
        "tokenizer_": imagined.tokenized[:, 1:],
        "repeated_": np.broadcast_to(first, after.shape),
    }
    columns = {f"{name}error": (squared_error(frames, after, high), frame_counted) for name, frames in seen.items()}
    right = {"": imagined.frames, "repeated_": np.broadcast_to(imagined.tokenized[:, :1], after.shape)}
    for name, frames in right.items():
        whole = (frames == imagined.tokenized[:, 1:]).reshape(*frame_counted.shape, -1).all(-1)
        columns[f"{name}frames_percent"] = (100.0 * whole, frame_counted)
    if imagined.copied is not None:
        columns["copied_percent"] = (100.0 * imagined.copied, frame_counted)
    if read is not None:
        truth = real.symbols[:, :steps]
        for name, frames in {**seen, "real_": after}.items():
            percent = 100 * (read(frames) == truth).mean(-1)
            columns[f"{name}symbols_percent"] = (percent, frame_counted)

    class_of = {name: np.asarray(tokens.reward_to_class(x)) for name, x in _rewards(real, imagined).items()}
    none = int(tokens.reward_to_class(jnp.zeros(())))
    ended = real.terminated[:, :steps]
    events = {
        "reward": (class_of["imagined"], class_of["real"], none, 1 - imagined.reward_odds[..., none]),
        "termination": (imagined.terminated.astype(int), ended.astype(int), 0, imagined.termination_odds),
    }
    summary: dict[str, float] = {}
    shares: dict[str, list[float]] = {}
    for name, (foretold, true, nothing, odds) in events.items():
        columns |= {
            f"{name}_percent": (100.0 * (foretold == true), counted),
            f"{name}_frequency": (100.0 * (true != nothing), counted),
            f"{name}_probability": (100.0 * odds, counted),
        }
        at_step = [precision_recall(x[c], y[c], nothing) for x, y, c in zip(foretold.T, true.T, counted.T, strict=True)]
        for measure, values in zip(("precision", "recall"), zip(*at_step, strict=True), strict=True):
            shares[f"{name}_{measure}_percent"] = [100 * value for value in values]
        precision, recall = precision_recall(foretold[counted], true[counted], nothing)
        summary |= {
            f"{name}_precision_percent": 100 * precision,
            f"{name}_recall_percent": 100 * recall,
            f"{name}_calibration_error": 100 * calibration_error(odds[counted], true[counted] != nothing),
        }
    per_step = {name: mean_per_step(*column) for name, column in columns.items()} | shares
    rows = [{"step": t + 1, **{name: float(values[t]) for name, values in per_step.items()}} for t in range(steps)]
    overall = {name: _mean(*column) for name, column in columns.items()}
    all_frames = np.pad(frame_counted, ((0, 0), (1, 0)), constant_values=True)
    overall["tokenizer_error"] = _mean(squared_error(imagined.tokenized, real.frames[:, : steps + 1], high), all_frames)
    codes = {} if imagined.codes is None else {"codes_used": len(imagined.codes)}
    return rows, {"steps": steps, "trajectories": len(counted), **overall, **summary, **codes}


def _mean(values: np.ndarray, counted: np.ndarray) -> float:
    return float(values[counted].mean()) if counted.any() else np.nan


def _rewards(real: EvaluationSet, imagined: Rollouts) -> dict[str, jax.Array]:
    return {"real": jnp.asarray(real.reward[:, : imagined.steps]), "imagined": jnp.asarray(imagined.reward)}


def squared_error(frames: np.ndarray, others: np.ndarray, high: int) -> np.ndarray:
    """Squared L2 distance of frames, uint8 [N, T, O], with values divided by `high`: float64 [N, T]."""
    difference = (frames.astype(np.float32) - others) / high
    return np.square(difference, dtype=np.float64).reshape(*frames.shape[:2], -1).sum(-1)


def mean_per_step(values: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """Means over trajectories, [T] of [N, T]; nan where nothing counts."""
    count = counted.sum(0)
    return np.where(count > 0, np.where(counted, values, 0).sum(0) / np.maximum(count, 1), np.nan)


def precision_recall(said: np.ndarray, true: np.ndarray, nothing: int) -> tuple[float, float]:
    """Share of the events said that are true, and of the true ones that are said; events are all but `nothing`."""
    right = ((said == true) & (true != nothing)).sum()

    def share(of: np.ndarray) -> float:
        return float(right / (of != nothing).sum()) if (of != nothing).any() else np.nan

    return share(said), share(true)


def calibration_error(probability: np.ndarray, happened: np.ndarray, bins: int = BINS) -> float:
    """Expected calibration error: mean distance, over bins of equal width, of mean probability and frequency."""
    if not len(probability):
        return np.nan
    bin_of = np.minimum((probability * bins).astype(int), bins - 1)
    gap = np.bincount(bin_of, probability, bins) - np.bincount(bin_of, happened, bins)
    return float(np.abs(gap).sum() / len(probability))
