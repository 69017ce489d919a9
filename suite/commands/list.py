"""`suite list`: tasks, agents or presets, one line each."""

from __future__ import annotations

import argparse
from typing import Any

from suite.commands.printing import print_json, print_table
from suite.runtime.errors import UserError, did_you_mean

SUMMARY = "tasks, agents or presets, one line each"
LISTS = ("tasks", "agents", "presets")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", metavar="tasks|agents|presets")


def execute(args: argparse.Namespace) -> int:
    from suite import registry

    if args.what not in LISTS:
        raise UserError(f"cannot list {args.what!r}; {did_you_mean(args.what, LISTS)}")
    entries: dict[str, Any] = getattr(registry, args.what)()
    rows = {
        id: [part for part in (entry.summary, getattr(entry, "cost", ""), published(entry)) if part]
        for id, entry in entries.items()
    }
    if args.json:
        print_json(rows)
    else:
        print_table([id, "; ".join(parts)] for id, parts in rows.items())
    return 0


def published(entry: Any) -> str:
    """What the paper reports of an agent, and where; "" if nothing."""
    millions = getattr(entry, "millions", None)
    parts = [getattr(entry, "row", ""), millions and f"{millions} M parameters", getattr(entry, "published", "")]
    return "; ".join(part for part in parts if part)
