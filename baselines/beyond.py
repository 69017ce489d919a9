"""Agents that are not the paper's: `m6`, what each of its parts is worth, and the bound of every agent that dreams."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from suite import registry
from suite.configuration.overrides import apply_changes
from suite.configuration.schema import Config

if TYPE_CHECKING:
    from suite.interface.environment import EnvironmentSpec

Part = Callable[[Config], dict[str, Any]]

LOCAL_EMBEDDING = 16  # numbers that the tokens around each one are embedded in
MIN_P = 0.2
# At the paper's 0.75, grass and water at night are one code: distances shrink with the light. A codebook of twice the
# size holds what 0.5 tells apart.
NIGHT_THRESHOLD = 0.5
AGES = 15  # longer than the timers of MinAtar's games
MUON_LEARNING_RATE = 0.003
# Of games of two players: there all that follows from a position is certain, and a model can be right to the last game.
GAMES_LEARNING_RATE = 0.001
AVERAGE = 0.99  # over a hundred gradient steps or so
# Where models knew so much of the rewards of steps that they had not learned from, dreams helped or did nothing. A game
# of two players pays once, at its end, so that what is wrong there is wrong of a whole game.
TRUST = 0.5
GAMES_TRUST = 0.9
TRUST_WINDOW = 10  # iterations; on Asterix there are some ten rewards in one
EVENT_SHARE = 0.3  # more than that teaches more of rewards, but all else in larger and rarer steps
PAID = 8  # as often as an action earns a reward in an episode, or oftener
TOKEN_NOISE = 0.03  # two or three of a frame's 81 tokens

# Each part of M6 by name: what it changes of M5.
PARTS: dict[str, Part] = {
    "correspondence": lambda config: {"world_model.correspondence": True},
    "grid": lambda config: {"world_model.positions": "grid"},
    "local": lambda config: {"world_model.local_embedding": LOCAL_EMBEDDING},
    "contents": lambda config: {"world_model.patch_contents": True} if _shows_objects(config) else {},
    "action": lambda config: {"world_model.action_in_tokens": True},
    "min_p": lambda config: {"imagination.min_p": MIN_P} if _task(config).two_player else {},
    "places": lambda config: {"world_model.place_heads": True},
    "ages": lambda config: {"world_model.ages": _ages(config)},
    "muon": lambda config: {"world_model.optimizer": "muon", "world_model.learning_rate": MUON_LEARNING_RATE},
    "games": lambda config: _patient(config) if _task(config).two_player else {},
    "average": lambda config: {"world_model.average": AVERAGE},
    "codes": lambda config: _finer_codes(config) if _task(config).light_changes else {},
    "events": lambda config: {"world_model.event_share": EVENT_SHARE} if _task(config).achievements else {},
    "paid": lambda config: {"world_model.paid": PAID} if _task(config).achievements else {},
    "noise": lambda config: {"world_model.token_noise": TOKEN_NOISE} if _task(config).achievements else {},
    "trust": lambda config: {"imagination.trust": _trust(config), "imagination.trust_window": TRUST_WINDOW},
}


def m6(config: Config) -> Config:
    """M6: M5 with a world model that knows that most of a frame stands near its place in the frame before.

    Sixteen parts, which docs/agents.md explains: the correspondence head, positions in time, row and column, an
    embedding of the tokens around each one, in MinAtar the patches that codes stand for, the action added to every
    token, rewards and ends that are read off every token, the age of every token, another optimizer of the model, which
    in games of two players is slower and surer, dreams with averaged parameters and, in games of two players, without
    improbable tokens, on Craftax a finer codebook, where achievements pay once an episode more lessons of what pays,
    knowledge of what was paid and wrong tokens to learn from, and no dreams while the model does not foresee rewards.
    """
    return _with_parts(config, PARTS)


def m6_without(part: str, config: Config) -> Config:
    """`m6` without one of its `PARTS`."""
    return _with_parts(config, {name: changes for name, changes in PARTS.items() if name != part})


def oracle(config: Config) -> Config:
    """`m5` whose dreams happen in the true game: what a perfect world model would be worth.

    It steps the simulator far more often than its budget of real steps says, so it is no rival of the others.
    """
    return apply_changes(config, {"world_model.enabled": False, "imagination.world": "game"})


def _task(config: Config) -> EnvironmentSpec:
    """What the task is: m6 asks this, and not which task it is, so that it plays other distributions' tasks too."""
    spec: EnvironmentSpec = registry.task(config.task).spec()
    return spec


def _shows_objects(config: Config) -> bool:
    """Whether a place of a frame says of each kind of object whether one is there, as in MinAtar."""
    observation = _task(config).observation
    return observation.kind == "grid" and observation.high == 1


def _ages(config: Config) -> int:
    """`AGES`, or what the first iteration's steps leave room for before a training sequence."""
    return min(AGES, config.environment.rollout_length - config.world_model.sequence_length - 1)


def _finer_codes(config: Config) -> dict[str, Any]:
    return {"tokenizer.threshold": NIGHT_THRESHOLD, "tokenizer.codebook_size": 2 * config.tokenizer.codebook_size}


def _patient(config: Config) -> dict[str, Any]:
    sequences = 2 * config.world_model.sequences
    return {"world_model.learning_rate": GAMES_LEARNING_RATE, "world_model.sequences": sequences}


def _trust(config: Config) -> float:
    return GAMES_TRUST if _task(config).two_player else TRUST


def _with_parts(config: Config, parts: Mapping[str, Part]) -> Config:
    return apply_changes(config, {name: value for part in parts.values() for name, value in part(config).items()})
