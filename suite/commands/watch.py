"""`suite watch`: a trained policy's episodes as a film."""

from __future__ import annotations

import argparse
from pathlib import Path

from suite.commands.configuration import whole
from suite.commands.printing import make_reporter, print_json

SUMMARY = "films episodes of a trained policy (GIF); with --dream beside what its world model expected"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="RUN_DIR", help="a run's folder")
    parser.add_argument("--dream", action="store_true", help="also what the world model expected, differences outlined")
    parser.add_argument(
        "--episodes", type=whole(1), default=1, metavar="N", help="so many, one after the other (default 1)"
    )
    parser.add_argument("--steps", type=whole(2), default=500, metavar="N", help="of each at most (default 500)")
    parser.add_argument("--seed", type=whole(0, 2**32 - 1), default=0, metavar="N", help="of play (default 0)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="of the GIF (default: watch.gif in RUN_DIR)")
    parser.add_argument("--quiet", action="store_true", help="no progress")


def execute(args: argparse.Namespace) -> int:
    from suite.diagnostics.watching import watch

    reporter = make_reporter(args.quiet)
    path, episodes = watch(args.folder, args.out, args.episodes, args.steps, args.dream, args.seed, reporter)
    reporter.stop()
    for number, episode in enumerate(episodes, 1):
        end = "" if episode.ended else ", not yet over"
        print(f"episode {number}: {len(episode.action)} steps, return {episode.reward.sum():.2f}{end}")
    print(f"film {path}")
    if args.json:
        returns = [float(episode.reward.sum()) for episode in episodes]
        lengths = [len(episode.action) for episode in episodes]
        print_json({"film": str(path), "returns": returns, "lengths": lengths})
    return 0
