"""`suite compare`: finished runs as Markdown tables."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from suite.commands.configuration import whole
from suite.commands.printing import print_json

SUMMARY = "finished runs: scores and curves, mean and standard error over seeds, as Markdown tables"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="runs in or below it are compared")
    parser.add_argument("--parts", type=whole(1, 10_000), default=5, metavar="N", help="points of a curve (default 5)")
    parser.add_argument("--score", metavar="S", help="what curves are of (default: return, or the first score)")


def execute(args: argparse.Namespace) -> int:
    from leaderboards.compare import compare, tables
    from leaderboards.results import finished_in

    comparisons = compare(finished_in(args.folders), args.parts, args.score)
    for comparison in comparisons:
        print(f"{comparison.task}, preset {comparison.preset}, {comparison.steps:,} steps\n")
        for table in tables(comparison):
            head = list(map(str, table.columns))
            for row in (head, ["---"] * len(head), *table.to_numpy().tolist()):
                print(f"| {' | '.join(row)} |")
            print()
    if args.json:
        print_json([dataclasses.asdict(comparison) for comparison in comparisons])
    return 0
