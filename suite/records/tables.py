"""CSV files that grow by whole rows, survive a kill, and can go back to an earlier step without losing anything."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np


class CsvTable:
    """A CSV file whose first column is `step` and whose columns never change.

    Rows hold nothing but what they are given, and floats are written so that reading them back gives the same
    bits: the same run writes the same bytes.
    """

    def __init__(self, path: Path, columns: Sequence[str] | None = None):
        """Opens the table, or creates it with its header line.

        Args:
          path: the file.
          columns: its columns, `step` first; None: those of the file, or else of the first row appended.
        """
        self.path = path
        self.columns = tuple(columns) if columns else _header(path)
        if columns:
            self.append([])

    def append(self, rows: Iterable[Mapping[str, Any]], names: Iterable[str] = ()) -> None:
        """Adds rows at the end: all of them, on disk when this returns, or none. What a row leaves out stays empty.

        Args:
          rows: values by column.
          names: further columns that a table gets whose columns are not fixed yet.

        Raises:
          ValueError: a row has a column that the table has not.
          OSError: the file cannot be written; it is as before.
        """
        rows = list(rows)
        if not self.columns:
            if not rows:
                return
            self.columns = tuple(dict.fromkeys([*rows[0], *names]))
        for row in rows:
            if unknown := row.keys() - set(self.columns):
                raise ValueError(f"{self.path.name} has no column {', '.join(sorted(unknown))}")
        with self.path.open("a+b", buffering=0) as file:
            size = _whole_rows(file)
            header = [] if size else [self.columns]
            lines = _lines([*header, *([cell(row.get(name)) for name in self.columns] for row in rows)])
            try:
                if lines:
                    file.truncate(size)
                while lines:  # a nearly full disk takes a part
                    lines = lines[file.write(lines) :]
                os.fsync(file.fileno())
            except OSError:
                file.truncate(size)
                raise

    def rewind(self, step: int, aside: Path) -> int:
        """Moves rows beyond `step`, and a last row that was cut off, to the file `aside`; returns how many."""
        if not self.path.exists():
            return 0
        header, *rows = self.path.read_bytes().splitlines(keepends=True) or [b""]
        if not header.endswith(b"\n"):
            header, rows = b"", [header]
        kept = [row for row in rows if _whole_and_until(row, step)]
        moved = [row for row in rows if not _whole_and_until(row, step)]
        if moved:
            aside.parent.mkdir(parents=True, exist_ok=True)
            # First the copy, then the cut: a kill in between leaves rows twice, never lost.
            write_whole(aside, header + b"".join(moved))
            write_whole(self.path, header + b"".join(kept))
        return len(moved)


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file so that a reader, or a kill at any moment, finds the old content or the new, never a part."""
    temporary = path.with_name(f"{path.name}.partial")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def cell(value: Any) -> str:
    """A number's shortest text that reads back as the same number in its own precision; None is empty."""
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    value = np.asarray(value)[()]
    return str(int(value)) if isinstance(value, np.bool_) else str(value)


def _lines(rows: Iterable[Sequence[str]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


def _whole_rows(file: io.FileIO) -> int:
    """The bytes up to the end of the last row that was written whole: a kill may have cut off the one after it."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - 1, 0))
    if file.read(1) in (b"", b"\n"):
        return size
    file.seek(0)
    return file.readall().rfind(b"\n") + 1


def _header(path: Path) -> tuple[str, ...]:
    if not path.exists():
        return ()
    with path.open(newline="") as file:
        return tuple(next(csv.reader(file), ()))


def _whole_and_until(row: bytes, step: int) -> bool:
    try:
        return row.endswith(b"\n") and int(row.partition(b",")[0]) <= step
    except ValueError:
        return False
