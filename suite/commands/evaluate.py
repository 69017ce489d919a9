"""`suite evaluate`: whole episodes with a run's newest checkpoint, or with somebody else's policy."""

from __future__ import annotations

import argparse
from pathlib import Path

from suite.commands.configuration import whole
from suite.commands.printing import make_reporter, print_json, print_scores
from suite.runtime.errors import UserError

SUMMARY = "play whole episodes with a run's newest checkpoint"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", metavar="RUN_DIR|TASK", help="a run's folder, or with --policy a task")
    parser.add_argument("--policy", metavar="module:Class", help="somebody else's policy")
    parser.add_argument("--episodes", type=whole(1), metavar="N", help="at least so many")
    parser.add_argument("--quiet", action="store_true", help="no progress")


def execute(args: argparse.Namespace) -> int:
    from suite import registry

    if args.policy:
        from suite.runs.external import evaluate_policy

        scores = evaluate_policy(args.what, args.policy, args.episodes, make_reporter(args.quiet))
        print_scores(scores)
        if args.json:
            print_json({"task": args.what, "policy": args.policy, **scores})
        return 0
    folder = Path(args.what)
    if not folder.exists() and args.what in registry.tasks():
        raise UserError(f"{args.what} is a task: say whose policy to play it with, --policy module:Class")

    from suite import api

    scores = api.load(folder).evaluate(args.episodes, progress=not args.quiet)
    print_scores(scores)
    print(f"record {folder}")
    if args.json:
        print_json({"folder": str(folder), **scores})
    return 0
