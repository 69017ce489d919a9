"""What commands print with: tables, scores, JSON; and the progress that they show."""

from __future__ import annotations

import json
import math
import numbers
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from suite.interface.scores import ScoreName

if TYPE_CHECKING:
    from suite.runtime.reporting import Reporter


def make_reporter(quiet: bool) -> Reporter:
    """Progress on stderr, or warnings only."""
    from suite.runtime.reporting import QuietReporter, RichReporter

    return QuietReporter() if quiet else RichReporter()


def device_name(count: int = 1) -> str:
    """What JAX computes on, so many of them."""
    import jax

    device = jax.devices()[0]
    name = f"{os.cpu_count()} CPU cores" if device.platform == "cpu" else device.device_kind
    return name if count == 1 else f"{count} devices ({name})"


def print_scores(scores: Mapping[str, Any]) -> None:
    """One line each, but for the parts of a score ("success_percent/..."); nan is a mean over no episodes."""
    reason = "no episode ended in the part that counts" if scores.get("episodes") else "no episode ended yet"
    for name, value in scores.items():
        if not ScoreName(name).is_of_part:
            print(score_line(name, value) + (f", {reason}" if value != value else ""))


def score_line(name: str, value: float, error: float | None = None) -> str:
    """`("reward_percent", 12.34, 0.56)` as "reward 12.34 % +- 0.56 %"."""
    label, unit = ScoreName(name).words, ScoreName(name).unit
    if math.isnan(value):
        return f"{label} n/a"
    deviation = "" if error is None else f" +- {format_value(error)}{unit}"
    return f"{label} {format_value(value)}{unit}{deviation}"


def format_value(value: Any) -> str:
    """A cell: whole numbers whole, measured ones with two decimals or three digits."""
    if isinstance(value, bool) or not isinstance(value, float):
        return str(value)
    if not math.isfinite(value):
        return "n/a" if math.isnan(value) else f"{value:g}"
    if value == int(value):
        return f"{value:.0f}"
    return f"{value:.2f}" if abs(value) >= 1 else f"{value:.3g}"


def print_table(rows: Iterable[Sequence[str]]) -> None:
    """Columns side by side, each as wide as its widest cell."""
    rows = [list(map(str, row)) for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  " + "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip())


def print_json(value: Any) -> None:
    """One line; nan becomes null, for JSON has none."""
    print(json.dumps(_finite(value), allow_nan=False, default=float), flush=True)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, numbers.Real) and not math.isfinite(value) else value
