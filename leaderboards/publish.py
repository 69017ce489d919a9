"""`suite publish`: from run records to leaderboards. The way back is `leaderboards.verification`.

A folder of leaderboards holds `evidence/`, the small files of every run that a row of ours is of, and CSV files made of
nothing but that evidence and `published.csv`. So publishing twice writes the same bytes, and anyone can check them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd

from leaderboards.boards import Standing, as_csv, boards
from leaderboards.qualification import Refusal, evidence_files, examine, overrides, settings
from leaderboards.results import Entry, entries_of, run_folders
from suite.configuration.schema import hash_of
from suite.records.record import RunRecord, require_writable
from suite.records.tables import write_whole
from suite.runtime.errors import UserError

PAGE = "index.html"


@dataclasses.dataclass(frozen=True)
class Publication:
    """What `publish` did.

    Attributes:
      entries: everything that the leaderboards now have a row of.
      added: folders of runs whose evidence is new.
      refusals: runs that do not qualify.
      tables: every leaderboard by its file's name.
    """

    entries: tuple[Entry, ...]
    added: tuple[Path, ...]
    refusals: tuple[Refusal, ...]
    tables: dict[str, pd.DataFrame]


def publish(runs: Sequence[Path], out: Path) -> Publication:
    """Adds the evidence of runs that qualify to that in `out`, and writes all leaderboards anew.

    Everything is computed before anything is written; each file is replaced whole, a record's last. If nothing
    qualifies, nothing is written.

    Args:
      runs: folders of runs, or folders above them.
      out: the folder of the leaderboards.

    Raises:
      UserError: there are no runs, or `out` cannot be written.
    """
    kept, new = _collect(runs, out)
    qualified, refusals = _examined(kept, new)
    if not qualified and not refusals:
        raise UserError(f"nothing to publish: no run in {', '.join(map(str, runs)) or out / 'evidence'}")
    if not qualified:
        return Publication((), (), tuple(refusals), {})
    standings = _standings(qualified, out)
    tables = boards(standings)
    contents = {name: as_csv(board) for name, board in tables.items()}
    places = [pair for standing in standings for pair in zip(standing.entry.records, standing.paths, strict=True)]
    added = [(record.folder, out / path) for record, path in places if record.folder not in kept]
    require_writable(out)
    for folder, target in added:
        require_writable(target)
        files = evidence_files(folder)
        for name in sorted(files, key=lambda name: name == "record.json"):
            write_whole(target / name, files[name])
    for name, content in contents.items():
        write_whole(out / name, content)
    return Publication(
        entries=tuple(standing.entry for standing in standings),
        added=tuple(folder for folder, _ in added),
        refusals=tuple(refusals),
        tables=tables,
    )


def evidence_in(out: Path) -> tuple[list[Standing], list[Refusal]]:
    """What a folder of leaderboards has evidence of, and what of that does not qualify."""
    kept, _ = _collect([], out)
    qualified, refusals = _examined(kept, [])
    return _standings(qualified, out), refusals


def _collect(runs: Iterable[Path], out: Path) -> tuple[list[Path], list[Path]]:
    """Folders of runs: those whose evidence is in `out`, and others."""
    for folder in runs:
        if not folder.is_dir():
            raise UserError(f"{folder} is no folder: give a run's folder, or one with runs below it")
    kept = run_folders([out / "evidence"])
    inside = {folder.resolve() for folder in kept}
    return kept, [folder for folder in run_folders(runs) if folder.resolve() not in inside]


def _examined(kept: list[Path], new: list[Path]) -> tuple[list[RunRecord], list[Refusal]]:
    """What qualifies, one record a seed; what was published before is left out of the new."""
    records: list[RunRecord] = []
    refusals: list[Refusal] = []
    for folder in (*kept, *new):
        examined = examine(folder)
        if isinstance(examined, Refusal):
            refusals.append(examined)
        else:
            records.append(examined)
    seen: dict[tuple[int, str, str], list[RunRecord]] = {}
    for record in records:
        run = (record.config.seed, hash_of(settings(record.config)), record.fields.protocol_hash)
        seen.setdefault(run, []).append(record)
    qualified = []
    for same in seen.values():
        different: list[RunRecord] = []
        for record in same:
            if all(evidence_files(record.folder) != evidence_files(other.folder) for other in different):
                different.append(record)
        published = [record for record in different if record.folder in kept]
        chosen = published if published else different
        if len(chosen) == 1:
            qualified += chosen
        refusals += (
            Refusal(record.folder, (f"duplicate seed {record.config.seed}: {other.folder} is another run of it",))
            for record in different
            if [record] != chosen
            for other in [next(other for other in different if other is not record)]
        )
    return qualified, refusals


def _standings(records: list[RunRecord], out: Path) -> list[Standing]:
    """Entries, and where their evidence lies or will lie.

    Evidence that is there already is not moved. New evidence gets a folder as in `runs/`. If its fields differ from the
    preset's, or if another entry has that folder (one of another version of the game, say), a key is added to the
    preset's name.
    """
    entries = entries_of(records)
    paths: dict[Path, Path] = {}
    owners: dict[Path, Entry] = {}
    for entry in entries:
        for record in entry.records:
            if record.folder.is_relative_to(out / "evidence"):
                paths[record.folder] = record.folder.relative_to(out)
                owners.setdefault(paths[record.folder].parent, entry)
    for entry in entries:
        config = entry.config
        home = Path("evidence", config.task, config.agent, config.preset)
        if overrides(config) or owners.setdefault(home, entry) is not entry:
            key = {"settings": dataclasses.replace(config, seed=0).digest(), "protocol": entry.protocol_hash}
            home = home.with_name(f"{config.preset}-{hash_of(key)[:8]}")
        for record in entry.records:
            paths.setdefault(record.folder, home / f"seed_{record.config.seed}")
    return [Standing(entry, tuple(paths[record.folder] for record in entry.records)) for entry in entries]
