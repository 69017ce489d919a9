"""`suite verify`: are published leaderboards what their evidence gives?"""

from __future__ import annotations

import argparse
from pathlib import Path

from suite.commands.printing import print_json

SUMMARY = "recompute every row of leaderboards from its evidence; exit code 1 if anything differs"
DIFFERS = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="DIR", help="where `suite publish` wrote them")


def execute(args: argparse.Namespace) -> int:
    from leaderboards.verification import verify

    problems = verify(args.folder)
    for problem in problems:
        print(problem)
    print(
        f"{args.folder}: {len(problems)} differences" if problems else f"{args.folder}: all rows follow from evidence"
    )
    if args.json:
        print_json({"folder": str(args.folder), "problems": problems})
    return DIFFERS if problems else 0
