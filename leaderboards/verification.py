"""`suite verify`: whether every row of ours follows from its evidence."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from leaderboards.boards import as_csv, boards, tables_digest
from leaderboards.publish import PAGE, evidence_in
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
    tables = {name: as_csv(board) for name, board in boards(standings).items()}
    for name, content in tables.items():
        problems += (f"{name}: {problem}" for problem in _differences(out / name, content))
    page = out / PAGE
    if page.exists() and f'content="{tables_digest(tables)}"' not in page.read_text(errors="replace"):
        problems.append(f"{PAGE}: made from other tables: publish again with --page {out}")
    others = {path.name for path in out.glob("*.csv")} - tables.keys() - {"published.csv"}
    return [*problems, *(f"{name}: made from no evidence" for name in sorted(others))]


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
