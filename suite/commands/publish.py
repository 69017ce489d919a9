"""`suite publish`: from run records to leaderboards."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from suite.commands.printing import print_json
from suite.runtime.errors import UserError

SUMMARY = "check finished runs, keep their evidence, and write leaderboards (CSV) and a page of them"
RUNS = Path("runs")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUNS", help="runs in or below it (default: runs)")
    parser.add_argument(
        "--out", type=Path, default=Path("leaderboards"), metavar="DIR", help="of the CSVs (default leaderboards)"
    )
    parser.add_argument("--page", type=Path, metavar="DIR", help="also write DIR/index.html, to open with a browser")


def execute(args: argparse.Namespace) -> int:
    from leaderboards.publish import publish

    if args.page is not None and args.page.exists() and not args.page.is_dir():
        raise UserError(f"--page {args.page} is no folder")
    found = publish(args.runs or ([RUNS] if RUNS.is_dir() else []), args.out)
    for refusal in found.refusals:
        print(f"refused {refusal}", file=sys.stderr)
    if not found.entries:
        raise UserError(f"nothing to publish: none of {len(found.refusals)} runs qualifies")
    runs = sum(len(entry.records) for entry in found.entries)
    print(f"{len(found.added)} runs added, {len(found.refusals)} refused; {runs} runs in {len(found.entries)} entries")
    print(f"{len(found.tables)} tables in {args.out}")
    page = None
    if args.page is not None:
        from leaderboards.page.page import write_page

        page = write_page(found.entries, found.tables, args.page)
        print(f"page {page}")
    if args.json:
        fields = {
            "added": [str(folder) for folder in found.added],
            "refused": {str(refusal.folder): list(refusal.reasons) for refusal in found.refusals},
            "files": [str(args.out / name) for name in found.tables],
            "page": None if page is None else str(page),
        }
        print_json(fields)
    return 0
