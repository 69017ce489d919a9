"""The token stream of a task: what the world model is told a frame, an action and a reward are."""

from __future__ import annotations

import jax

from suite.configuration.schema import Config
from suite.interface.environment import EnvironmentSpec
from suite.interface.tokens import Tokenizer, TokenSpec
from suite.tokenizers import make_tokenizer


def build_tokenizer(config: Config, spec: EnvironmentSpec) -> tuple[Tokenizer, TokenSpec, tuple[int, int]]:
    """The tokenizer, the token stream it makes for the world model, and the frame's (rows, columns) of tokens."""
    tokenizer = make_tokenizer(config.tokenizer, spec.observation)
    rows, columns = tokenizer.grid
    players = 2 if spec.two_player else 1
    tokens = TokenSpec(
        tokens_per_frame=players * tokenizer.tokens_per_frame,
        num_codes=tokenizer.num_codes,
        num_actions=players * spec.num_actions + spec.chance_outcomes,
        reward_classes=config.world_model.reward_classes or spec.reward_classes,
        placed=spec.observation.kind == "symbols" and config.world_model.symbol_places,
        player_actions=spec.num_actions if spec.two_player else 0,
        chance_outcomes=spec.chance_outcomes,
        token_size=tokenizer.token_size,
        spatial=spec.observation.kind != "symbols",
        content_size=jax.eval_shape(lambda: tokenizer.contents(tokenizer.init(jax.random.key(0)))).shape[1],
    )
    return tokenizer, tokens, (players * rows, columns)
