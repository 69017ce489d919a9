"""The run record: one folder per run, from which every score can be recomputed. Nothing in it is ever overwritten.

`runs/<task>/<agent>/<preset>/seed_<n>/` holds

    config.json       the whole configuration
    record.json       what ran where: task, agent, preset, seed, protocol, versions, device, times, status
    episodes.csv      one row per real training episode
    metrics.csv       one row per iteration
    evaluations.csv   one row per evaluation episode; never mixed with training's
    timing.csv        seconds per phase, one row per iteration (of evaluations, record.json has the sum)
    tensorboard/      the metrics as curves; wandb/ for Weights & Biases, where it was asked for
    checkpoints/      see `suite.records.checkpoint`
    replaced/         rows of iterations that a resumed run played again, and of last evaluations that no longer are

No clock enters episodes.csv and metrics.csv, so that a run that was stopped and resumed writes the same bytes.
"""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import os
import tempfile
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Protocol

from suite import registry
from suite.configuration.schema import Config
from suite.records.fields import SCHEMA, ProtocolFields, RecordFields, write_json
from suite.records.lock import LOCK, acquire, closed_on_error
from suite.records.provenance import package_version, peak_memory, provenance
from suite.records.stored_config import (
    NEXT_CONFIG,
    read_config,
    require_rest,
    require_same_rules,
    require_same_run,
    settle_config,
)
from suite.records.tables import CsvTable, read_table
from suite.runtime.errors import RunError, UserError

if TYPE_CHECKING:
    import pandas as pd

    from suite.interface.environment import EnvironmentSpec


class Curves(Protocol):
    """Where the numbers of each iteration become curves."""

    def append(self, step: int, values: Mapping[str, float]) -> None:
        """One point on each curve."""

    def close(self) -> None:
        """No more will come."""


def run_folder(out: Path, config: Config) -> Path:
    """Where a run's record lies under `out`."""
    return out / config.task / config.agent / config.preset / f"seed_{config.seed}"


def require_writable(folder: Path, option: str = "--out") -> None:
    """Creates `folder`, which the user chose by this option, if it is not there.

    Raises:
      UserError: it cannot be created or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()  # has no name that a kill could leave behind
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error.strerror}; choose another {option}") from error


def protocol(config: Config, spec: EnvironmentSpec) -> ProtocolFields:
    """What must be equal for two results to be compared: budget, scoring, task, and the version of its rules."""
    return ProtocolFields(
        task=config.task,
        steps=config.protocol.steps,
        final_fraction=config.protocol.final_fraction,
        package=spec.package,
        package_version=package_version(spec.package) if spec.package else "",
    )


def episode_columns(spec: EnvironmentSpec) -> list[str]:
    """Of episodes.csv and evaluations.csv."""
    scalars = [name for name, shape in spec.statistics if shape == ()]
    return ["step", "return", "length", *scalars, *spec.achievements]


class RunRecord:
    """A run's folder, open. At most one process has it open for writing.

    Attributes:
      folder: where it lies.
      config: the run's configuration.
      fields: the content of record.json.
    """

    def __init__(
        self, folder: Path, config: Config, fields: RecordFields, spec: EnvironmentSpec | None, lock: IO[str] | None
    ):
        """Use `create`, `open` or `open_or_create`."""
        self.folder, self.config, self.fields, self._lock = folder, config, fields, lock
        self._spec = spec
        self._tables = {
            name: CsvTable(folder / f"{name}.csv", columns) for name, columns in fields.columns.items() if lock
        }
        self._curves: list[Curves] = []
        self._events: Curves | None = None  # TensorBoard's
        self._purge_step: int | None = None
        self._new = self._all_counted = False
        self._company = 1

    @classmethod
    def create(cls, folder: Path, config: Config, spec: EnvironmentSpec) -> RunRecord:
        """Starts the record of a new run.

        Raises:
          UserError: the folder cannot be written, is in use, or holds a run already.
        """
        require_writable(folder)
        lock = acquire(folder)
        with closed_on_error(lock):
            taken = [path for path in (folder / "record.json", *folder.glob("*.csv")) if path.exists()]
            if taken:
                raise UserError(f"{folder} already holds {taken[0].name}; choose another --out")
            rules = protocol(config, spec)
            fields = RecordFields(
                schema=SCHEMA,
                task=config.task,
                agent=config.agent,
                preset=config.preset,
                seed=config.seed,
                config_digest=config.digest(),
                protocol=rules,
                protocol_hash=rules.hash,
                max_return=spec.max_return,
                achievements=list(spec.achievements),
                columns={
                    "episodes": episode_columns(spec),
                    "evaluations": episode_columns(spec),
                    "metrics": None,  # those of the first row
                    "timing": None,
                },
                status="running",
                steps=0,
                started=_now(),
                ended=None,
                wall_clock_seconds={"total": 0.0},
                peak_memory_bytes={},
                **provenance(),
                resumed=[],
            )
            write_json(folder / "config.json", config.as_dict())
            fields.write(folder)  # last: a folder is a run from here on
            record = cls(folder, config, fields, spec, lock)
            record._new = True
            record._begin_tables()
            return record

    @classmethod
    def open(
        cls, folder: Path, config: Config | None = None, spec: EnvironmentSpec | None = None, lock: bool = True
    ) -> RunRecord:
        """Opens an existing record.

        Args:
          folder: the run's folder.
          config: what the run is expected to be; None: whatever it is.
          spec: the task's, to compare the protocol with; None: not compared.
          lock: for writing; without it, only for reading.

        Raises:
          UserError: no run folder, another schema, damaged, changed, another run than expected, or in use; or a larger
            budget is expected (`asks_for_more`) of a run that cannot be given one.
        """
        RecordFields.read(folder)  # nothing, not even a lock, is written into a folder that holds no run
        held = acquire(folder) if lock else None
        with closed_on_error(held):
            fields = RecordFields.read(folder)
            if held is not None:
                settle_config(folder, fields)
            stored = read_config(folder, fields)
            if config is not None:
                require_same_run(folder, stored, config)
                require_rest(folder, fields, config)
            if config is not None and spec is not None:
                require_same_rules(folder, fields.protocol, protocol(config, spec))
            return cls(folder, config or stored, fields, spec, held)

    @classmethod
    def open_or_create(cls, folder: Path, config: Config, spec: EnvironmentSpec) -> RunRecord:
        """The record of this very run, begun or new; errors as `open` and `create`."""
        if (folder / "record.json").exists():
            return cls.open(folder, config, spec)
        return cls.create(folder, config, spec)

    @property
    def finished(self) -> bool:
        """Whether the run took all its steps: those that are asked for."""
        return self.fields.status == "finished" and not self.asks_for_more

    @property
    def asks_for_more(self) -> bool:
        """Whether it was opened with a larger budget than it has; see `extend`."""
        return self.config.protocol.steps > self.fields.protocol.steps

    @property
    def steps(self) -> int:
        """Real environment steps recorded so far."""
        return self.fields.steps

    @property
    def wall_seconds(self) -> float:
        """Seconds that the run took, over all processes that worked on it."""
        return self.fields.wall_clock_seconds["total"]

    @property
    def spec(self) -> EnvironmentSpec:
        """The task's specification."""
        return self._spec or registry.task(self.config.task).spec()

    def note_company(self, seeds: int) -> None:
        """So many runs, this one among them, go on together; before it goes on."""
        self._company = seeds
        if self._new:
            self.update(device=provenance(seeds)["device"])

    def append_episodes(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Adds training episodes, in the order in which they ended.

        Each row has `step` (real steps of the run when it ended), `return`, `length`, the task's scalar statistics,
        and 0 or 1 for each achievement, all by name.
        """
        self._append("episodes", rows)

    def append_evaluation(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Adds evaluation episodes, all or none: as `append_episodes`, `step` being that of the checkpoint."""
        self.require_own_folder()
        self._tables["evaluations"].append_whole(rows)

    def has_evaluation(self, step: int, episodes: int) -> bool:
        """Whether there are at least so many evaluation episodes of the checkpoint at `step`."""
        return int((self.table("evaluations")["step"] == step).sum()) >= episodes

    def append_metrics(self, row: Mapping[str, Any], names: Iterable[str] = ()) -> None:
        """Adds one iteration's metrics, `step` first.

        The first row fixes the columns: its own and `names`, those that later rows may have. What a row lacks, or
        has as None, stays empty.
        """
        from suite.records.event_files import EventFile

        self._append("metrics", [row], names)
        self.fields.steps = int(row["step"])
        if self._events is None:
            self._events = EventFile(self.folder / "tensorboard", self._purge_step)
            self._curves.append(self._events)
        numbers = {name: float(value) for name, value in row.items() if value is not None and name != "step"}
        for curves in self._curves:
            curves.append(int(row["step"]), numbers)

    def draw_curves_at(self, curves: Curves) -> None:
        """Every iteration's metrics go there too, until the record is closed."""
        self._curves.append(curves)

    def append_timing(self, row: Mapping[str, Any]) -> None:
        """Adds one iteration's seconds per phase, `step` first. The first row fixes the columns."""
        self._append("timing", [row])

    def _append(self, table: str, rows: Iterable[Mapping[str, Any]], names: Iterable[str] = ()) -> None:
        self.require_own_folder()
        self._tables[table].append(rows, names)

    def require_own_folder(self) -> None:
        """Raises a RunError if the folder was removed, or made anew by another run: rows of the two would mix."""
        assert self._lock is not None, "opened for reading only"
        held = os.fstat(self._lock.fileno())
        try:
            present = (self.folder / LOCK).stat()
        except OSError:
            present = None
        if present is None or (held.st_dev, held.st_ino) != (present.st_dev, present.st_ino):
            raise RunError(f"{self.folder} was removed or replaced while this run was writing into it")

    def rewind(self, step: int) -> int:
        """Goes back to a checkpoint: rows beyond `step` move to `replaced/`. Returns how many did.

        The run plays those steps again, identically. What TensorBoard shows of them is replaced as well.

        Raises:
          UserError: rows up to `step` are missing or damaged; nothing was moved.
        """
        # Of a game that ends with a move of chance, which is no step, an episode may have the step of an iteration
        # that ended before it: so many are counted, not those up to a step.
        most = self._counted(step, self.table("episodes"))
        aside = self._aside(f"after_step_{step}")
        moved = sum(
            table.rewind(step, aside / f"{name}.csv", most if name == "episodes" else None)
            for name, table in self._tables.items()
        )
        self._begin_tables()
        if not self._new:  # a run that has only just begun is not resumed
            self._purge_step = step + 1
            resumed = {"step": step, "date": _now(), **provenance(self._company)}
            self.update(steps=step, resumed=[*self.fields.resumed, resumed])
        return moved

    def extend(self, evaluated: Collection[int]) -> None:
        """Takes the larger budget that it was opened with, as if it had had that from the start.

        Args:
          evaluated: after which steps it would then have been evaluated; evaluations of others move to `replaced/`.
        """
        rules, digest = protocol(self.config, self.spec), self.config.digest()
        aside = self._aside(f"with_{self.fields.protocol.steps}_steps") / "evaluations.csv"
        write_json(self.folder / NEXT_CONFIG, self.config.as_dict())
        self._tables["evaluations"].set_aside(lambda step: step not in evaluated, aside)
        # From here on it has that budget. If it is killed before, whoever asks for as much again comes here again.
        self.update(config_digest=digest, protocol=rules, protocol_hash=rules.hash, status="running", ended=None)
        settle_config(self.folder, self.fields)

    def rewind_evaluations(self, step: int) -> None:
        """Moves the evaluation episodes of the checkpoint at `step`, the newest, to `replaced/`: not all are there."""
        self._tables["evaluations"].rewind(step - 1, self._aside(f"after_step_{step - 1}") / "evaluations.csv")

    def _aside(self, why: str) -> Path:
        folders = self.folder / "replaced"
        return folders / f"{1 + sum(1 for _ in folders.glob('*')):04d}_{why}"

    def _begin_tables(self) -> None:
        for name, columns in self.fields.columns.items():
            self._tables[name] = CsvTable(self.folder / f"{name}.csv", columns)
            self._append(name, [])

    def _counted(self, step: int, episodes: pd.DataFrame) -> int:
        """How many episodes had ended by the iteration that ended at `step`; a UserError if others are there."""
        metrics = self.table("metrics")
        until = metrics[metrics["step"] <= step]
        if not step and until.empty:
            return 0
        if until.empty or until["step"].iloc[-1] != step or "episodes" not in until:
            raise UserError(f"{self.folder}/metrics.csv lacks the iteration that ended at step {step:,}")
        found, counted = len(episodes), int(until["episodes"].sum())
        if found < counted or (self.finished and found > counted):
            raise UserError(f"{self.folder}/episodes.csv has {found:,} episodes, metrics.csv counted {counted:,}")
        return counted

    def update(self, **fields: Any) -> None:
        """Replaces fields of record.json."""
        replaced = self.fields.replaced(**fields)
        self.require_own_folder()
        self.fields = replaced
        self.fields.write(self.folder)

    def add_wall_clock(self, seconds: float, phases: Mapping[str, float]) -> None:
        """Notes the time that this process took, and each phase's over all processes; and the peak memory so far."""
        peaks = peak_memory()
        before = self.fields.peak_memory_bytes
        self.update(
            wall_clock_seconds={**phases, "total": self.wall_seconds + seconds},
            peak_memory_bytes={name: max(peak, before.get(name, 0)) for name, peak in peaks.items()},
        )

    def finish(self, steps: int) -> None:
        """Marks the run as finished."""
        self.update(status="finished", steps=steps, ended=_now())

    def episodes(self) -> pd.DataFrame:
        """The training episodes; see `leaderboards.scoring`.

        Raises:
          UserError: the table cannot be read, or of a finished run other episodes are there than were counted.
        """
        episodes = self.table("episodes")
        if self.finished and not self._all_counted:
            self._counted(self.steps, episodes)
            self._all_counted = True  # what is finished does not change
        return episodes

    def episodes_digest(self) -> str:
        """SHA-256 of episodes.csv, which tells runs apart."""
        return hashlib.sha256((self.folder / "episodes.csv").read_bytes()).hexdigest()

    def table(self, name: str) -> pd.DataFrame:
        """One of the CSV files, by its name without the ending; of a run that is not finished, the rows so far.

        Raises:
          UserError: it is missing, cut off, has other columns, or holds what is no number.
        """
        path, columns = self.folder / f"{name}.csv", self.fields.columns[name]
        # A metric may have none: of dreams before the first one, or of episodes where none ended.
        return read_table(path, columns, growing=not self.finished, gaps=name == "metrics")

    def close(self) -> None:
        """Lets other processes open the folder."""
        curves, lock, self._curves, self._events, self._lock = self._curves, self._lock, [], None, None
        with contextlib.ExitStack() as stack:  # all of them, whatever one of them raises, and the lock last
            if lock is not None:
                stack.callback(lock.close)
            for each in curves:
                stack.callback(each.close)

    def __enter__(self) -> RunRecord:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
