"""What `suite inspect` found of world models, as evidence: tables and a filmstrip, in a folder of leaderboards.

A folder that `suite inspect` wrote may lie, under any name, at or below `evidence/<task>/inspect/`: of its files are
kept `steps.csv` and `summary.csv`, and `codes.csv` and `filmstrip.png` where there are such.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from PIL import Image

from leaderboards.results import run_folders
from suite import registry
from suite.runtime.errors import UserError

FOLDER, STEPS, SUMMARY, FILMSTRIP = "inspect", "steps.csv", "summary.csv", "filmstrip.png"
EPISODES = "episodes_sha256"
FILES = (STEPS, SUMMARY, "codes.csv", FILMSTRIP)
FILMSTRIP_BYTES = 30_000  # at most: whoever opens the page loads it
ERROR, SYMBOLS = "error", "symbols_percent"  # measures of a rollout's frames
BOUNDS = ("repeated_error", "repeated_symbols_percent", "real_symbols_percent")  # the same for all models


@dataclasses.dataclass(frozen=True)
class InspectedRun:
    """A run's world model beside reality.

    Attributes:
      name: the run's in its table: "m5", or "m5 seed 0".
      trained: real steps until its checkpoint.
      steps: a row for each step of the rollouts, which is the index.
      episodes: SHA-256 of the run's episodes.csv.
    """

    name: str
    trained: int
    steps: pd.DataFrame
    episodes: str

    @property
    def agent(self) -> str:
        """Its id."""
        return self.name.split()[0]

    def comparable(self, other: InspectedRun) -> bool:
        """Whether it was trained as long, and its rollouts begin with the same real frames, which the bounds show."""
        names = [name for name in BOUNDS if name in self.steps]
        if self.trained != other.trained or names != [name for name in BOUNDS if name in other.steps]:
            return False
        common = min(len(self.steps), len(other.steps))
        return np.allclose(self.steps[names][:common], other.steps[names][:common], rtol=1e-6, equal_nan=True)


@dataclasses.dataclass(frozen=True)
class Filmstrip:
    """Rollouts as frames.

    Attributes:
      png: the file.
      size: width and height in pixels.
      description: what the file says of itself.
    """

    png: bytes
    size: tuple[int, int]
    description: str


@dataclasses.dataclass(frozen=True)
class Inspection:
    """A folder that `suite inspect` wrote.

    Attributes:
      folder: where it is.
      task: of its runs.
      runs: in the order of their tables.
      filmstrip: where there is one.
      sha256: of all its files.
    """

    folder: Path
    task: str
    runs: tuple[InspectedRun, ...]
    filmstrip: Filmstrip | None
    sha256: str


def is_inspection(folder: Path, evidence: Path) -> bool:
    """Whether a folder is where the files of an inspection may lie."""
    return _task_of(folder, evidence) != ""


def _task_of(folder: Path, evidence: Path) -> str:
    parts = folder.relative_to(evidence).parts
    return "/".join(parts[: parts.index(FOLDER)]) if FOLDER in parts else ""


def inspections_in(out: Path) -> list[Inspection]:
    """Every inspection in a folder of leaderboards.

    Raises:
      UserError: one is of no known task, not as `suite inspect` writes it, of a run that another is of too, or its
        filmstrip is too large.
    """
    evidence = out / "evidence"
    folders = sorted({path.parent for name in FILES for path in evidence.rglob(name) if path.is_file()})
    found = [
        _inspection(folder, task, {name: (folder / name).read_bytes() for name in FILES if (folder / name).is_file()})
        for folder in folders
        if (task := _task_of(folder, evidence))
    ]
    for task in {inspection.task for inspection in found}:
        comparisons([inspection for inspection in found if inspection.task == task])
    return found


def require_published(inspections: Sequence[Inspection], folders: Sequence[Path]) -> None:
    """Raises a UserError if one is of another run than any in or below these folders of the same agent."""
    if not inspections:
        return
    runs = {(folder / "episodes.csv"): folder.parts for folder in run_folders(folders)}
    digests = {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in runs if path.is_file()}
    for inspection in inspections:
        for run in inspection.runs:
            if not any(digest == run.episodes and run.agent in runs[path] for path, digest in digests.items()):
                raise UserError(
                    f"{inspection.folder / SUMMARY}: {run.name} is none of the published runs of {run.agent}, by "
                    "their episodes.csv: inspect those"
                )


def _inspection(folder: Path, task: str, files: dict[str, bytes]) -> Inspection:
    registry.task(task)
    steps = _table(folder / STEPS, ("run", "step", ERROR, BOUNDS[0]))
    summary = _table(folder / SUMMARY, ("run", "checkpoint"), (EPISODES,)).set_index("run")
    trained = summary["checkpoint"]
    if set(trained.index) != set(steps["run"]) or trained.index.has_duplicates:
        raise UserError(f"{folder / STEPS} and {folder / SUMMARY} are not of the same runs: copy both from one folder")
    runs = []
    for name, rows in steps.groupby("run", sort=False):
        if rows["step"].tolist() != list(range(1, len(rows) + 1)):
            raise UserError(f"{folder / STEPS} has not each step of {name} once, from 1 on: suite inspect writes it so")
        runs.append(InspectedRun(str(name), int(trained[name]), rows.set_index("step"), summary[EPISODES][name]))
    digest = hashlib.sha256(b"".join(hashlib.sha256(content).digest() for content in files.values()))
    filmstrip = _filmstrip(folder / FILMSTRIP, files[FILMSTRIP]) if FILMSTRIP in files else None
    return Inspection(folder, task, tuple(runs), filmstrip, digest.hexdigest())


def _filmstrip(path: Path, content: bytes) -> Filmstrip:
    if len(content) > FILMSTRIP_BYTES:
        raise UserError(f"{path} has {len(content):,} bytes: at most {FILMSTRIP_BYTES:,} go onto the page")
    try:
        with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
            image.load()
    except (OSError, SyntaxError) as error:  # Pillow's for broken chunks
        raise UserError(f"{path} is no whole PNG: copy the one that suite inspect wrote") from error
    return Filmstrip(content, image.size, str(image.info.get("Description", "")))


def _table(path: Path, columns: Sequence[str], words: Sequence[str] = ()) -> pd.DataFrame:
    """A CSV file of runs; of the columns that are shown, all but the first are numbers, and `words` are none."""
    try:
        table = pd.read_csv(path, dtype={"run": str, **dict.fromkeys(words, str)})
    except (OSError, ValueError) as error:  # among them what pandas finds wrong with it
        reason = error.strerror if isinstance(error, OSError) else str(error).splitlines()[0]
        raise UserError(f"cannot read {path} ({reason}): suite inspect writes it") from error
    if missing := [name for name in (*columns, *words) if name not in table]:
        raise UserError(f"{path} has no column {', '.join(missing)}: suite inspect writes it")
    numbers = table[[name for name in (*columns[1:], SYMBOLS, *BOUNDS) if name in table]]
    named = table["run"].notna() & (table["run"].str.strip() != "")
    right = len(table) and named.all() and all(map(pd.api.types.is_numeric_dtype, numbers.dtypes))
    if not right or np.isinf(numbers).any(axis=None) or numbers[columns[1]].isna().any():
        raise UserError(f"{path} has no rows, or some without a run or a number: suite inspect writes it")
    return table


def comparisons(inspections: Sequence[Inspection]) -> list[list[InspectedRun]]:
    """Runs of a task's inspections that one figure may compare.

    Raises:
      UserError: a run stands in two tables.
    """
    groups: list[list[InspectedRun]] = []
    for inspection in inspections:
        for run in inspection.runs:
            group = next((group for group in groups if run.comparable(group[0])), None)
            groups.append([run]) if group is None else group.append(run)
    for group in groups:
        for name, count in Counter(run.name for run in group).items():
            if count > 1:
                places = [
                    str(found.folder / STEPS) for found in inspections if name in {run.name for run in found.runs}
                ]
                raise UserError(f"{name} stands in {' and in '.join(places)}: keep one")
    return groups
