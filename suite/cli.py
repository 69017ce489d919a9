"""The `suite` command: parsing, and errors as one line. What each word does is in `suite.commands`.

Results go to stdout, progress and errors to stderr. Bad input is one line and exit code 2, or 75 where another process
has the run open and the same command may do later. A run that cannot go on is one line and exit code 1. A run that was
told to stop exits with 130. Nothing that imports JAX is imported before the words of the command are known to be right.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import NoReturn

from suite.runtime.compilation import quiet_xla, refuse_other_arithmetic
from suite.runtime.errors import RunError, UserError, did_you_mean, host_errors, refusals_are_errors

COMMANDS = ("run", "list", "describe", "evaluate", "inspect", "watch", "compare", "sweep", "publish", "verify", "bench")
STOPPED = 130
COMPLETION = "--print-completion"
SHELLS = ("bash", "zsh", "tcsh")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code."""
    quiet_xla()
    try:
        refuse_other_arithmetic()
        with refusals_are_errors(), host_errors():
            return _dispatch(sys.argv[1:] if argv is None else list(argv))
    except (UserError, RunError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return STOPPED
    except BrokenPipeError:  # whoever read our output has enough of it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return RunError.exit_code


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """One line, without the usage."""
        raise UserError(message)


def _dispatch(argv: list[str]) -> int:
    if argv == ["--version"]:
        print(f"suite {importlib.metadata.version('world-model-suite')}")
        return 0
    if argv[:1] == [COMPLETION]:
        print(completion(*argv[1:]))
        return 0
    args = parse(argv)
    return importlib.import_module(f"suite.commands.{args.command}").execute(args)


def parse(argv: list[str]) -> argparse.Namespace:
    """The words of a command, with the command itself as `command`.

    Raises:
      UserError: an unknown command or option, a word too many or too few.
    """
    if argv and not argv[0].startswith("-") and argv[0] not in COMMANDS:
        raise UserError(f"unknown command {argv[0]!r}; {did_you_mean(argv[0], COMMANDS)}")
    parser, parsers = _parsers({name: importlib.import_module(f"suite.commands.{name}") for name in COMMANDS})
    args, rest = parser.parse_known_args(argv)
    # argparse takes positional arguments in one go only: settings after an option are left over.
    options = [word.partition("=")[0] for word in rest if word.startswith("-")]
    if options:
        known = re.findall(r"--[a-z]+", parsers[args.command].format_help())
        raise UserError(f"unknown option {options[0]!r}; {did_you_mean(options[0], known)}")
    if rest and "overrides" not in args:
        raise UserError(f"unexpected argument {rest[0]!r}")
    if rest:
        args.overrides = [*args.overrides, *rest]
    return args


def completion(shell: str = "", *rest: str) -> str:
    """What a shell must read so that it completes commands, options, and ids of tasks, agents and presets.

    Raises:
      UserError: no shell, or none that is known.
    """
    if shell not in SHELLS or rest:
        raise UserError(f"{COMPLETION} takes one of {', '.join(SHELLS)}")
    import shtab

    from suite import registry

    ids: dict[str, list[str]] = {
        "task": [*registry.tasks()],
        "agent": [*registry.agents()],
        "preset": [*registry.presets()],
    }
    parser, parsers = _parsers({name: importlib.import_module(f"suite.commands.{name}") for name in COMMANDS})
    for command in parsers.values():
        for action in command._actions:
            if action.dest in ids:
                action.choices = ids[action.dest]
            elif action.type is Path:
                vars(action)["complete"] = shtab.FILE
    return str(shtab.complete(parser, shell=shell))


def _parsers(modules: dict[str, ModuleType]) -> tuple[_Parser, dict[str, _Parser]]:
    parser = _Parser(
        prog="suite", description="Sample-efficient reinforcement learning with a transformer world model."
    )
    parser.add_argument("--version", action="store_true", help="print the version, and nothing else")
    parser.add_argument(COMPLETION, metavar="SHELL", help=f"print what {', '.join(SHELLS)} read to complete words")
    sub = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    parsers: dict[str, _Parser] = {}
    for name, module in modules.items():
        command = sub.add_parser(name, help=module.SUMMARY, description=module.SUMMARY, allow_abbrev=False)
        module.add_arguments(command)
        command.add_argument("--json", action="store_true", help="the last line of stdout is one JSON object")
        parsers[name] = command
    return parser, parsers


if __name__ == "__main__":
    sys.exit(main())
