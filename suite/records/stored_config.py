"""The configuration that a run's folder keeps, and whether the run there is the one that is asked for."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from suite.configuration.overrides import dotted, first_problem
from suite.configuration.schema import Config, hash_of
from suite.records.fields import ProtocolFields, RecordFields, read_json
from suite.runtime.errors import UserError

NEXT_CONFIG = "config.next.json"  # of a run that is being given more steps, until its record says that it has them


def require_same_run(folder: Path, stored: Config, asked: Config) -> None:
    """Raises a UserError if the settings that matter are not those of the run, but for a budget that can grow."""
    old, new = dotted(stored), dotted(asked)
    for name in new:
        if old[name] == new[name] or name.startswith(("checkpoint.", "evaluation.")):
            continue
        why = ""
        if name == "protocol.steps" and asked.protocol.steps > stored.protocol.steps:
            if not asked.tied_to_budget:
                continue
            why = f", and what it learned depends on the budget, by {' and '.join(asked.tied_to_budget)}"
        raise UserError(f"{folder} holds a run with {name}={old[name]}, not {new[name]}{why}; choose another --out")


def require_rest(folder: Path, fields: RecordFields, asked: Config) -> None:
    """Raises a UserError if more steps are asked of a finished run without the half of a checkpoint that they need."""
    had = fields.protocol.steps
    if fields.status != "finished" or asked.protocol.steps <= had:
        return
    if not any((folder / "checkpoints").glob("step_*/resume")):
        raise UserError(
            f"{folder} holds a run that is finished after protocol.steps={had} and did not keep what more steps need "
            "(checkpoint.keep_resume=false, or an earlier version); choose another --out"
        )


def require_same_rules(folder: Path, old: ProtocolFields, new: ProtocolFields) -> None:
    """Raises a UserError if the game, or how it is scored, is not what it was when the run began."""
    for name, value in new:
        before = getattr(old, name)
        if before != value and not (name == "steps" and value > before):  # more may be asked for
            raise UserError(
                f"{folder} was started under {name}={before}, not the present {value}; choose another --out"
            )


def read_config(folder: Path, record: RecordFields) -> Config:
    """The configuration that was run: what `record` has the digest of.

    Raises:
      UserError: the file is missing, damaged, of another version, or another run's.
    """
    stored = read_json(folder, _config_file(folder, record))
    try:
        config = Config(**stored)
    except ValidationError as error:
        raise UserError(f"{folder}/config.json is not of this version: {first_problem(error)}") from error
    for name in ("task", "agent", "preset", "seed"):
        if getattr(record, name) != getattr(config, name):
            raise UserError(
                f"{folder}/record.json says {name}={getattr(record, name)}, config.json {getattr(config, name)}"
            )
    if record.config_digest != _digest_of(stored):
        raise UserError(f"{folder}/config.json is not the configuration that was run ({record.config_digest})")
    return config


def _digest_of(stored: Mapping[str, Any]) -> str:
    """`Config.digest` of a file as it was written: later versions may have fields more."""
    return hash_of({name: value for name, value in stored.items() if name not in ("checkpoint", "evaluation")})


def _config_file(folder: Path, record: RecordFields) -> str:
    """The name of the file that holds the configuration."""
    if not (folder / NEXT_CONFIG).exists() or _digest_of(read_json(folder, NEXT_CONFIG)) != record.config_digest:
        return "config.json"
    return NEXT_CONFIG


def settle_config(folder: Path, record: RecordFields) -> None:
    """Gives the file of a run that was given more steps its usual name."""
    if (name := _config_file(folder, record)) == NEXT_CONFIG:
        os.replace(folder / name, folder / "config.json")
