"""What record.json holds: a record is read only if every field is there, and of its kind."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    field_validator,
)

from suite.configuration.overrides import first_problem
from suite.configuration.schema import hash_of
from suite.records.tables import write_whole
from suite.runtime.errors import UserError

SCHEMA = 1
Status = Literal["running", "stopped", "failed", "finished"]
FILE = "record.json"


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid")


class ProtocolFields(_Part):
    """What must be equal for two results to be compared."""

    task: str
    steps: PositiveInt
    final_fraction: PositiveFloat
    package: str
    package_version: str | None

    @property
    def hash(self) -> str:
        """Stands beside results, so that equal rules are found at a glance."""
        return hash_of(self.model_dump())


class DeviceFields(_Part):
    """What was computed on. It is no part of the protocol: results of one device and of several compare."""

    platform: str
    kind: str
    cpu_cores: PositiveInt | None
    count: PositiveInt = 1  # of devices; records of earlier versions, which had one, do not say
    seeds: PositiveInt = 1  # that went on together there; likewise


class RecordFields(_Part):
    """All of record.json; `suite.records.record` says what the fields are for."""

    schema_: int
    task: str
    agent: str
    preset: str
    seed: NonNegativeInt
    config_digest: str
    protocol: ProtocolFields
    protocol_hash: str
    max_return: float | None
    achievements: list[str]
    columns: dict[str, list[str] | None]
    status: Status
    steps: NonNegativeInt
    started: str
    ended: str | None
    wall_clock_seconds: dict[str, NonNegativeFloat]
    peak_memory_bytes: dict[str, NonNegativeInt]
    python: str
    packages: dict[str, str | None]
    git_commit: str | None
    device: DeviceFields
    resumed: list[dict[str, Any]]

    model_config = ConfigDict(strict=True, extra="forbid", alias_generator=lambda name: name.rstrip("_"))

    @field_validator("columns")
    @classmethod
    def _every_table(cls, columns: dict[str, list[str] | None]) -> dict[str, list[str] | None]:
        if columns.keys() != {"episodes", "evaluations", "metrics", "timing"} or not columns["episodes"]:
            raise ValueError("columns are not those of episodes, evaluations, metrics and timing")
        return columns

    @field_validator("wall_clock_seconds")
    @classmethod
    def _total(cls, seconds: dict[str, float]) -> dict[str, float]:
        if "total" not in seconds:
            raise ValueError("wall_clock_seconds has no total")
        return seconds

    @classmethod
    def read(cls, folder: Path) -> RecordFields:
        """Those of a run's folder.

        Raises:
          UserError: it holds no run, or its record is damaged or of another schema.
        """
        fields = read_json(folder, FILE)
        if fields.get("schema") != SCHEMA:
            raise UserError(f"{folder} has a record of schema {fields.get('schema')}; this version reads {SCHEMA}")
        try:
            return cls.model_validate(fields)
        except ValidationError as error:
            raise UserError(f"{folder}/{FILE} is damaged: {first_problem(error)}") from error

    def write(self, folder: Path) -> None:
        """Puts them into a run's folder, all at once."""
        write_json(folder / FILE, self.model_dump(by_alias=True))

    def replaced(self, **changes: Any) -> RecordFields:
        """The same with other values for some fields, checked like those of a file."""
        if unknown := changes.keys() - type(self).model_fields.keys():
            raise ValueError(f"{FILE} has no field {', '.join(sorted(unknown))}")
        return type(self).model_validate(self.model_dump(by_alias=True) | changes)


def write_json(path: Path, value: Any) -> None:
    """Writes numbers that JSON has, all at once."""
    write_whole(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def read_json(folder: Path, name: str) -> dict[str, Any]:
    """An object of a run's folder.

    Raises:
      UserError: the file is not there, cannot be read, or holds something else.
    """
    path = folder / name
    try:
        value = json.loads(path.read_text(), parse_constant=_no_number)
    except FileNotFoundError:
        raise UserError(f"{folder} is no run folder: it has no {name}") from None
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise UserError(f"{path} is damaged: {error}") from error
    if not isinstance(value, dict):
        raise UserError(f"{path} is damaged: not an object")
    return value


def _no_number(text: str) -> Any:
    raise ValueError(f"{text} is not a number that JSON has")
