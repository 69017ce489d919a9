"""`suite verify`: are published leaderboards what their evidence gives, and did those runs begin as it says?"""

from __future__ import annotations

import argparse
from pathlib import Path

from suite.commands.configuration import whole
from suite.commands.printing import make_reporter, print_json
from suite.runtime.errors import UserError

SUMMARY = "recompute every row of leaderboards from its evidence; exit code 1 if anything differs"
DIFFERS = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="DIR", help="where `suite publish` wrote them")
    parser.add_argument("--replay", action="store_true", help="also run each run's first iteration again, and compare")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    parser.add_argument(
        "--jobs",
        type=whole(1),
        metavar="N",
        help="with --replay: processes side by side (default: one for each CPU core, or one on an accelerator)",
    )
    parser.add_argument("--runs", type=whole(1), metavar="K", help="with --replay: only K of the runs, drawn at random")


def execute(args: argparse.Namespace) -> int:
    from leaderboards.verification import verify

    for option, value in {"--runs": args.runs, "--jobs": args.jobs}.items():
        if value is not None and not args.replay:
            raise UserError(f"{option} needs --replay")
    problems = verify(args.folder)
    for problem in problems:
        print(problem)
    if args.replay:
        problems += _replayed(args)
    print(
        f"{args.folder}: {len(problems)} differences" if problems else f"{args.folder}: all rows follow from evidence"
    )
    if args.json:
        print_json({"folder": str(args.folder), "problems": problems})
    return DIFFERS if problems else 0


def _replayed(args: argparse.Namespace) -> list[str]:
    """Differences between the beginnings of runs and their records; prints each as it is found."""
    from leaderboards.publish import evidence_in
    from leaderboards.replay import replay
    from suite.runs.places import default_jobs

    problems, count = list[str](), 0
    standings, jobs = evidence_in(args.folder)[0], args.jobs or default_jobs(cores_each=1)
    for path, differences in replay(standings, args.runs, make_reporter(args.quiet), jobs):
        count += 1
        for difference in differences:
            problems.append(f"{path}: {difference}")
            print(problems[-1], flush=True)
    wrong = len({problem.split(":")[0] for problem in problems})
    print(f"{count - wrong} of {count} runs begin as their records say")
    return problems
