"""The options with which commands name a configuration: task, agent, preset, steps, single fields, and numbers."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable

from suite.runtime.errors import UserError

MOST = 2**31 - 1  # of what is counted: arrays are indexed by 32 bits
SEEDS = 10_000  # in one command


def add_configuration(parser: argparse.ArgumentParser) -> None:
    """The arguments of `suite.registry.resolve`."""
    parser.add_argument("task", metavar="TASK", help="see `suite list tasks`")
    parser.add_argument(
        "--agent", metavar="A", help="see `suite list agents` (default m5; craftax_full paper: m5_slow)"
    )
    parser.add_argument("--preset", metavar="P", help="see `suite list presets` (default: fit for this machine)")
    parser.add_argument("--steps", type=int, metavar="N", help="real environment steps (default: the preset's)")
    parser.add_argument(
        "overrides", nargs="*", default=[], metavar="dotted.name=value", help="any field that `suite describe` shows"
    )


def whole(least: int, most: int = MOST) -> Callable[[str], int]:
    """The type of an option that is a whole number of this range."""

    def parse(text: str) -> int:
        if not re.fullmatch("[+-]?[0-9]{1,30}", text) or not least <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number from {least:,} to {most:,}")
        return int(text)

    return parse


def add_wandb(parser: argparse.ArgumentParser) -> None:
    """The option for curves at Weights & Biases."""
    parser.add_argument(
        "--wandb", metavar="PROJECT", help="curves at Weights & Biases too (offline: WANDB_MODE=offline)"
    )


def add_devices(parser: argparse.ArgumentParser) -> None:
    """The option for the number of devices."""
    parser.add_argument(
        "--devices",
        type=_devices,
        metavar="N",
        help="of this machine, between which batches are split, or all (default: one CPU; all accelerators that fit)",
    )


def add_processes(parser: argparse.ArgumentParser) -> None:
    """The options for several processes that train one run."""
    parser.add_argument(
        "--coordinator",
        type=_coordinator,
        metavar="A",
        help="several processes train one run: HOST:PORT of the first one, or auto (under SLURM or MPI)",
    )
    parser.add_argument("--processes", type=whole(1), metavar="N", help="so many, each started with this command")
    parser.add_argument("--process", type=whole(0), metavar="I", help="which one this is, from 0")


def join_processes(args: argparse.Namespace) -> None:
    """Meets the other processes, if there are to be any; all but the first are quiet."""
    given = [args.processes is not None, args.process is not None]
    if args.coordinator is None or args.coordinator == "auto":
        if any(given):
            raise UserError("--processes and --process belong to --coordinator HOST:PORT, the address of process 0")
    elif not all(given) or args.process >= args.processes:
        raise UserError(
            f"--coordinator {args.coordinator} needs --processes N and --process I, I from 0 to N - 1, another for each"
        )
    if args.coordinator is not None:
        from suite.runtime import processes

        processes.join(args.coordinator, args.processes, args.process)
        args.quiet = args.quiet or not processes.is_first()


def _coordinator(text: str) -> str:
    if text != "auto" and not re.fullmatch(r"\S+:[0-9]{1,5}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is neither HOST:PORT nor auto")
    return text


def _devices(text: str) -> int | str:
    return "all" if text == "all" else whole(1)(text)


def require_wandb_of(args: argparse.Namespace) -> None:
    """Raises a UserError if it is asked for and not installed."""
    if args.wandb is not None:
        from suite.records.wandb_runs import require_wandb

        require_wandb()


def parse_seeds(text: str) -> list[int]:
    """Seeds of "0-2" or "0,3,5", or of both mixed."""
    seeds: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"([0-9]+)(?:-([0-9]+))?", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, -1)
        if last < first:
            raise argparse.ArgumentTypeError(f"{text!r} is not of the form 0-2 or 0,3,5")
        if len(seeds) + last - first >= SEEDS:
            raise argparse.ArgumentTypeError(f"{text!r} are more than {SEEDS:,} seeds")
        seeds += range(first, last + 1)
    return list(dict.fromkeys(seeds))
