"""`suite verify`: whether every row of ours follows from its evidence, and the page from the rows."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from leaderboards.boards import as_csv, boards
from leaderboards.inspections import FILES, inspections_in, is_inspection, require_published
from leaderboards.publish import PAGE, evidence_in
from leaderboards.published import PATH
from leaderboards.qualification import EVIDENCE
from leaderboards.results import run_folders
from suite.runtime.errors import UserError


def verify(out: Path) -> list[str]:
    """Recomputes every leaderboard in a folder from its evidence; returns each difference as one line.

    Raises:
      UserError: there is no evidence in the folder.
    """
    standings, refusals = evidence_in(out)
    if not standings and not refusals:
        raise UserError(f"no run in {out / 'evidence'}: nothing to verify {out} with")
    problems = [f"evidence does not qualify: {refusal}" for refusal in refusals]
    tables = boards(standings)
    for name, board in tables.items():
        problems += (f"{name}: {problem}" for problem in _differences(out / name, as_csv(board)))
    try:
        inspections = inspections_in(out)
        require_published(inspections, [out / "evidence"])
    except UserError as error:
        problems.append(str(error))
    else:
        if (out / PAGE).exists():
            from leaderboards.page.page import page

            if (out / PAGE).read_bytes() != page([standing.entry for standing in standings], tables, inspections):
                problems.append(f"{PAGE}: not what these runs give: publish again with --page {out}")
    literature = out / PATH.name
    if literature.exists() and literature.read_bytes() != PATH.read_bytes():
        problems.append(f"{PATH.name}: not this version's")
    others = {path.name for path in out.glob("*.csv")} - tables.keys() - {PATH.name}
    problems += (f"{name}: made from no evidence" for name in sorted(others))
    return problems + [f"{path.relative_to(out)}: belongs to no run" for path in _foreign(out / "evidence")]


def _foreign(evidence: Path) -> list[Path]:
    """Files that are neither evidence of a run nor what `suite inspect` found of some."""
    runs = set(run_folders([evidence]))
    return [
        path
        for path in sorted(evidence.rglob("*"))
        if path.is_file()
        and not (path.parent in runs and path.name in EVIDENCE)
        and not (is_inspection(path.parent, evidence) and path.name in FILES)
    ]


def _differences(path: Path, expected: bytes) -> list[str]:
    """What a CSV file says otherwise, row by row."""
    try:
        present = path.read_bytes()
    except OSError as error:
        return [f"cannot be read ({error.strerror})"]
    if present == expected:
        return []
    rows, right = (list(csv.reader(io.StringIO(text.decode(errors="replace")))) for text in (present, expected))
    if rows[:1] != right[:1]:
        return ["the columns are not those of this version: publish again"]
    problems = [] if len(rows) == len(right) else [f"{len(rows) - 1} rows, the evidence gives {len(right) - 1}"]
    header = right[0]
    for number, (row, true) in enumerate(zip(rows[1:], right[1:], strict=False), 2):
        cells = [
            f"{name} is {cell!r}, the evidence gives {value!r}"
            for name, cell, value in zip(header, row, true, strict=False)
            if cell != value
        ]
        if cells or len(row) != len(true):
            method, metric = (true[header.index(name)] for name in ("method", "metric"))
            problems.append(f"line {number} ({method}, {metric}): {'; '.join(cells) or 'not as many cells'}")
    return problems or ["other bytes, though the cells are the same: publish again"]
