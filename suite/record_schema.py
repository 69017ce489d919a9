"""What record.json holds: a record is read only if every field is there, and of its kind."""

from __future__ import annotations

from typing import Any

from pydantic import (
    BaseModel,
    ConfigDict,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    field_validator,
)

SCHEMA = 1


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid")


class ProtocolFields(_Part):
    """What must be equal for two results to be compared."""

    task: str
    steps: PositiveInt
    final_fraction: PositiveFloat
    package: str
    package_version: str | None


class DeviceFields(_Part):
    """What was computed on."""

    platform: str
    kind: str
    cpu_cores: PositiveInt | None


class RecordFields(_Part):
    """All of record.json; `suite.record` says what the fields are for."""

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
    status: str
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
