"""`suite inspect`: how good world models are."""

from __future__ import annotations

import argparse
from pathlib import Path

from suite.commands.configuration import whole
from suite.commands.printing import format_value, make_reporter, print_json, print_table
from suite.interface.scores import ScoreName

SUMMARY = "how good world models are: rollouts beside reality; of games, whether they keep the rules"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folders", nargs="+", type=Path, metavar="RUN_DIR", help="a run's folder")
    parser.add_argument(
        "--games", type=whole(1, 1_000_000), default=1000, metavar="N", help="games to imagine (default 1000)"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="where to (default: inspect, where the runs are)")
    parser.add_argument("--quiet", action="store_true", help="no progress")


def execute(args: argparse.Namespace) -> int:
    from suite.records.record import RunRecord

    records = [RunRecord.open(folder, lock=False) for folder in args.folders]
    return _inspect_games(args) if all(record.spec.two_player for record in records) else _inspect_rollouts(args)


def _inspect_games(args: argparse.Namespace) -> int:
    from suite.diagnostics.rules import rules_of_run

    reporter = make_reporter(args.quiet)
    kept = {str(folder): rules_of_run(folder, args.games, reporter) for folder in args.folders}
    reporter.stop()
    for name, plays in kept.items():
        print(name)
        columns = [[format_value(kept[row]) for row in kept] for kept in plays.values()]
        rows = [ScoreName(row).heading for row in next(iter(plays.values()))]
        print_table([["played by", *plays], *zip(rows, *columns, strict=True)])
    if args.json:
        print_json(kept)
    return 0


def _inspect_rollouts(args: argparse.Namespace) -> int:
    from suite.diagnostics.inspection import inspect

    reporter = make_reporter(args.quiet)
    result = inspect(args.folders, args.out, reporter)
    reporter.stop()
    runs = result["runs"]
    names = list(dict.fromkeys(name for row in runs.values() for name in row))
    rows = [[ScoreName(name).heading, *(format_value(row.get(name, "")) for row in runs.values())] for name in names]
    print_table([["mean over rollout steps", *runs], *rows])
    print(f"tables, curves and filmstrips in {result['folder']}")
    if args.json:
        print_json(result)
    return 0
