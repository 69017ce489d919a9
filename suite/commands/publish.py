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
    parser.add_argument(
        "--plot", type=Path, metavar="FILE", help="also draw there (.svg) what suite inspect found of world models"
    )


def execute(args: argparse.Namespace) -> int:
    from leaderboards.inspections import inspections_in, require_published
    from leaderboards.publish import publish

    if args.page is not None and args.page.exists() and not args.page.is_dir():
        raise UserError(f"--page {args.page} is no folder")
    inspections = inspections_in(args.out)
    runs = args.runs or ([RUNS] if RUNS.is_dir() else [])
    require_published(inspections, [args.out / "evidence", *runs])
    if args.plot is not None:
        from leaderboards.page.world_models import require_picture, write_picture

        require_picture(args.plot, inspections)
    publication = publish(runs, args.out)
    for refusal in publication.refusals:
        print(f"refused {refusal}", file=sys.stderr)
    if not publication.entries:
        raise UserError(f"nothing to publish: none of {len(publication.refusals)} runs qualifies")
    entries = publication.entries
    count = sum(len(entry.records) for entry in entries)
    print(f"{len(publication.added)} runs added, {len(publication.refusals)} refused; ", end="")
    print(f"{count} runs in {len(entries)} entries")
    print(f"{len(publication.tables)} tables in {args.out}")
    page = None
    if args.page is not None:
        from leaderboards.page.page import write_page

        page = write_page(publication.entries, publication.tables, args.page, inspections)
        print(f"page {page}")
    if args.plot is not None:
        write_picture(args.plot, inspections)
        print(f"plot {args.plot}")
    if args.json:
        fields = {
            "added": [str(folder) for folder in publication.added],
            "refused": {str(refusal.folder): list(refusal.reasons) for refusal in publication.refusals},
            "files": [str(args.out / name) for name in publication.tables],
            "page": None if page is None else str(page),
        }
        print_json(fields)
    return 0
