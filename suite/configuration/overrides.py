"""Changes to a configuration by dotted names: `ppo.discount=0.97`, checked against the schema's types."""

from __future__ import annotations

import ast
import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from suite.configuration.schema import Config
from suite.runtime.errors import UserError, did_you_mean

# Fields that have options of their own.
OPTIONS = {"task": "TASK", "agent": "--agent", "preset": "--preset", "seed": "--seed", "steps": "--steps"}

# The paper's names and common ones, for those who know them better than ours.
ALIASES = {
    "gamma": "ppo.discount",
    "lambda": "ppo.gae_lambda",
    "epsilon": "ppo.clip",
    "lambda_td": "ppo.value_coefficient",
    "lambda_ent": "ppo.entropy_coefficient",
    "alpha": "ppo.target_decay",
    "lr": "ppo.learning_rate",
    "n_env": "environment.num_envs",
    "t_env": "environment.rollout_length",
    "m": "environment.burn_in",
    "k": "tokenizer.codebook_size",
    "tau": "tokenizer.threshold",
    "n_tok": "tokenizer.updates",
    "t_wm": "world_model.sequence_length",
    "n_twm": "world_model.updates",
    "t_bp": "imagination.start_step",
    "n_ac": "imagination.updates",
    "t_total": "protocol.steps",
}


def dotted(config: Config) -> dict[str, Any]:
    """Every field's value by dotted name: `{"task": ..., "ppo.discount": 0.925, ...}`."""
    fields: dict[str, Any] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            fields |= {f"{field.name}.{inner.name}": getattr(value, inner.name) for inner in dataclasses.fields(value)}
        else:
            fields[field.name] = value
    return fields


def parse_overrides(overrides: Sequence[str] | Mapping[str, Any]) -> dict[str, Any]:
    """Dotted names to values; where they are text, values are JSON or Python literals, anything else is a string.

    Raises:
      UserError: not of the form `dotted.name=value`, or no such field.
    """
    changes = dict(overrides) if isinstance(overrides, Mapping) else dict(map(_parsed, overrides))
    names = [name for name in dotted(Config(task="", agent="", preset="")) if "." in name]
    for name in changes:
        if name not in names:
            raise UserError(f"unknown field {name!r}; {_suggestion(name, names)}")
    return changes


def _parsed(override: str) -> tuple[str, Any]:
    name, equals, text = override.partition("=")
    if not equals:
        raise UserError(f"{override!r} is no setting; write dotted.name=value, such as ppo.discount=0.97")
    return name, _literal(text)


def apply_changes(config: Config, changes: Mapping[str, Any]) -> Config:
    """`config` with fields replaced, by dotted name, all at once.

    Raises:
      UserError: a value of the wrong type or out of range, or values that do not fit each other.
    """
    sections: dict[str, dict[str, Any]] = {}
    top: dict[str, Any] = {}
    for name, value in changes.items():
        section, dot, field = name.partition(".")
        if dot:
            sections.setdefault(section, {})[field] = value
        else:
            top[name] = value
    for section, fields in sections.items():
        top[section] = _replace(getattr(config, section), fields, f"{section}.")
    return _replace(config, top, "")


def _replace(part: Any, fields: Mapping[str, Any], prefix: str) -> Any:
    try:
        replaced = dataclasses.replace(part, **fields)
    except ValidationError as error:
        raise UserError(first_problem(error, prefix)) from error
    for name, value in fields.items():
        # pydantic reads 1 as true and true as 1; in a hyperparameter that is a slip of the pen.
        if isinstance(value, bool) != isinstance(getattr(replaced, name), bool):
            wanted = "a number" if isinstance(value, bool) else "true or false"
            raise UserError(f"{prefix}{name}={value!r}: input should be {wanted}")
    return replaced


def first_problem(error: ValidationError, prefix: str = "") -> str:
    """The first of pydantic's complaints, in one line: the field, the value, what would be right."""
    first = error.errors()[0]
    place = prefix + ".".join(str(part) for part in first["loc"])
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "missing":  # the value would be all that is there
        return f"it lacks {place}"
    if first["type"] == "value_error":  # of the whole: the message names the fields
        return message
    return f"{place}={first['input']!r}: {message[:1].lower()}{message[1:]}"


def _literal(text: str) -> Any:
    for parse in (json.loads, ast.literal_eval):
        try:
            return parse(text)
        except (ValueError, SyntaxError):
            continue
    return text


def _suggestion(name: str, names: Sequence[str]) -> str:
    if name in OPTIONS:
        return f"it is set by {OPTIONS[name]}"
    last = name.rpartition(".")[2]
    if last.lower() in ALIASES:
        return f"did you mean {ALIASES[last.lower()]!r}?"
    same = [valid for valid in names if valid.rpartition(".")[2] == last]
    if same:
        return f"did you mean {' or '.join(map(repr, same))}?"
    hint = did_you_mean(name, names)
    return hint if hint.startswith("did") else "`suite describe TASK` lists every field"
