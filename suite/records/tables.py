"""CSV files that grow by whole rows, survive a kill, and can go back to an earlier step without losing anything."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from suite.runtime.errors import UserError

if TYPE_CHECKING:
    import pandas as pd


class CsvTable:
    """A CSV file whose first column is `step` and whose columns never change.

    Rows hold nothing but what they are given, and floats are written so that reading them back gives the same
    bits: the same run writes the same bytes.
    """

    def __init__(self, path: Path, columns: Sequence[str] | None = None):
        """The table, whose file need not be there yet.

        Args:
          path: the file.
          columns: its columns, `step` first; None: those of the file, or else of the first row appended.
        """
        self.path = path
        self.columns = tuple(columns) if columns else _header(path)

    def append(self, rows: Iterable[Mapping[str, Any]], names: Iterable[str] = ()) -> None:
        """Adds rows at the end, or at least the header line: all on disk when this returns. What a row leaves out stays
        empty. A kill may leave some rows and a part of one: `rewind` goes back to where all of them are there.

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
        with self.path.open("a+b", buffering=0) as file:
            size = _whole_rows(file)
            lines = self._text(rows, header=not size)
            try:
                if lines:
                    file.truncate(size)
                while lines:  # a nearly full disk takes a part
                    lines = lines[file.write(lines) :]
                os.fsync(file.fileno())
            except OSError:
                file.truncate(size)
                raise

    def append_whole(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """As `append`, but a kill leaves all of the rows or none: the file is written anew, so it should be small."""
        before = self.path.read_bytes() if self.path.exists() else b""
        before = before[: before.rfind(b"\n") + 1]
        write_whole(self.path, before + self._text(list(rows), header=not before))

    def _text(self, rows: Sequence[Mapping[str, Any]], header: bool) -> bytes:
        for row in rows:
            if unknown := row.keys() - set(self.columns):
                raise ValueError(f"{self.path.name} has no column {', '.join(sorted(unknown))}")
        lines = ([cell(row.get(name)) for name in self.columns] for row in rows)
        return _lines([*([self.columns] if header else []), *lines])

    def rewind(self, step: int, aside: Path, most: int | None = None) -> int:
        """Moves rows beyond `step` or `most` of them, and a last row that was cut off, to `aside`; returns how many."""
        return self._set_aside(lambda of, kept: of > step or (most is not None and kept >= most), aside)

    def set_aside(self, which: Callable[[int], bool], aside: Path) -> int:
        """Moves the rows of some steps, and a last row that was cut off, to the file `aside`; returns how many."""
        return self._set_aside(lambda of, kept: which(of), aside)

    def _set_aside(self, which: Callable[[int, int], bool], aside: Path) -> int:
        """`which` is asked with a row's step and how many rows stay before it."""
        if not self.path.exists():
            return 0
        header, *rows = self.path.read_bytes().splitlines(keepends=True) or [b""]
        if not header.endswith(b"\n"):
            header, rows = b"", [header]
        kept, moved = list[bytes](), list[bytes]()
        for row in rows:
            step = _step(row)
            (moved if step is None or which(step, len(kept)) else kept).append(row)
        if moved:
            aside.parent.mkdir(parents=True, exist_ok=True)
            # First the copy, then the cut: a kill in between leaves rows twice, never lost.
            write_whole(aside, header + b"".join(moved))
            write_whole(self.path, header + b"".join(kept))
        return len(moved)


def read_table(path: Path, columns: Sequence[str] | None, growing: bool, gaps: bool) -> pd.DataFrame:
    """All rows of such a file.

    Args:
      path: the file.
      columns: those that it must have; None: whatever its first line says.
      growing: it may not be there yet, and its last row may not be whole yet, and then does not count.
      gaps: cells may be empty.

    Raises:
      UserError: it is missing or cut off, has other columns, or a cell that is no finite number.
    """
    import pandas as pd

    try:
        text = path.read_bytes().decode(errors="replace")
    except FileNotFoundError:
        if growing:
            return pd.DataFrame(columns=list(columns or ("step",)), dtype=float)
        raise UserError(f"{path} is missing") from None
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    whole, newline, rest = text.rpartition("\n")
    lines = whole.split("\n") if newline else []
    if not growing and (rest or not lines):
        raise UserError(f"{path} is cut off in line {len(lines) + 1}")
    header = tuple(lines[0].split(",")) if lines else tuple(columns or ("step",))
    if header != tuple(columns or header) or header[0] != "step":
        raise UserError(f"{path} has columns {', '.join(header)}, not {', '.join(columns or ('step', '...'))}")
    for number, line in enumerate(lines[1:], 2):
        if line.count(",") != len(header) - 1:
            raise UserError(f"{path} line {number} has {line.count(',') + 1} cells, not {len(header)}")
    table = pd.read_csv(io.StringIO("\n".join([",".join(header), *lines[1:]])), keep_default_na=False, na_values=[""])
    for name in map(str, table):
        numbers = pd.to_numeric(table[name], errors="coerce").to_numpy(float)
        wrong = ~np.isfinite(numbers) & (table[name].notna() | (not gaps or name == "step")).to_numpy(bool)
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            raise UserError(f"{path} line {row + 2}: {name} is {table[name].iloc[row]}, not a finite number")
    return table


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
    with path.open(newline="", errors="replace") as file:
        return tuple(next(csv.reader(file), ()))


def _step(row: bytes) -> int | None:
    """The step of a row; None if it was cut off."""
    try:
        return int(row.partition(b",")[0]) if row.endswith(b"\n") else None
    except ValueError:
        return None
