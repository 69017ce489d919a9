"""`suite compare`: finished runs as Markdown tables and, with --plot, as curves."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from suite.commands.configuration import whole
from suite.commands.printing import print_json

SUMMARY = "finished runs: scores and curves, mean and standard error over seeds, as Markdown tables and a plot"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="runs in or below it are compared")
    parser.add_argument(
        "--parts", type=whole(1, 10_000), metavar="N", help="points of a curve (default 5 in tables, 20 in a plot)"
    )
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draws the curves there (.png, .svg, .pdf)")
    parser.add_argument("--score", metavar="S", help="what curves are of (default: return, or the first score)")


def execute(args: argparse.Namespace) -> int:
    from leaderboards.compare import compare, plot, require_plot, tables
    from leaderboards.results import finished_in

    if args.plot is not None:
        require_plot(args.plot)
    records = finished_in(args.folders)
    comparisons = compare(records, args.parts or 5, args.score)
    for comparison in comparisons:
        print(f"{comparison.task}, preset {comparison.preset}, {comparison.steps:,} steps\n")
        for table in tables(comparison):
            head = list(map(str, table.columns))
            for row in (head, ["---"] * len(head), *table.to_numpy().tolist()):
                print(f"| {' | '.join(row)} |")
            print()
    if args.plot is not None:
        plot(args.plot, compare(records, args.parts or 20, args.score))
        print(f"curves {args.plot}")
    if args.json:
        print_json([dataclasses.asdict(comparison) for comparison in comparisons])
    return 0
