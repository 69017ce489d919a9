"""`suite inspect` of single-agent runs: everything about their world models, side by side, as tables and pictures."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import pandas as pd

from suite.diagnostics import evaluation_set, filmstrips, pictures, symbols
from suite.diagnostics.evaluation_set import EvaluationSet
from suite.diagnostics.rollouts import Rollouts, compare, imagine
from suite.records import checkpoint
from suite.records.record import RunRecord, require_writable
from suite.records.tables import write_whole
from suite.runs.saved_model import no_checkpoint, restore
from suite.runtime.errors import UserError
from suite.runtime.reporting import Reporter

STRIPS = 4


def inspect(folders: Sequence[Path], out: Path | None, reporter: Reporter) -> dict[str, Any]:
    """Compares the world models of runs on the evaluation set of Section 4.4, and writes what it finds.

    Files: `summary.csv` (a row per run), `steps.csv` (a row per run and step, see `rollouts.compare`), `codes.csv`
    (codebook over time), `curves.png`, per run `codes-<run>.png`, filmstrips `rollout-<n>.png` and `.gif`, and a small
    one for a page, `filmstrip.png`, with the first run of each agent.

    Args:
      folders: of runs of one single-agent task and preset.
      out: where to; None: "inspect" in the run's folder, or in the folder that all runs have in common.
      reporter: where progress goes.

    Returns:
      "folder" and by run the summary's rows.

    Raises:
      UserError: no world model, no checkpoint, several tasks or presets, or `out` cannot be written.
    """
    records = [RunRecord.open(folder, lock=False) for folder in folders]
    _check(records)
    out = out or Path(os.path.commonpath([folder.resolve() for folder in folders])) / "inspect"
    require_writable(out)
    config, spec = records[0].config, records[0].spec
    whole = evaluation_set.load(config.task, config.preset, reporter)
    runs = [restore(record, reporter) for record in records]
    start = max(run.agent.past for run in runs)  # all rollouts begin with the same frames
    real = whole.after(start)
    extractor = symbols.load(config.task, config.preset, reporter) if real.symbols.shape[-1] else None
    if extractor is not None:
        reporter.message(f"the symbol extractor reads {100 * extractor.accuracy:.2f} % of validation symbols right")
    out.mkdir(parents=True, exist_ok=True)

    grid = len(spec.observation.shape) == 3
    rollouts_of: dict[str, Rollouts] = {}
    rows, steps, codes = {}, {}, {}
    for record, run, name in zip(records, runs, _names(records), strict=True):
        reporter.message(f"imagining {len(real.action)} rollouts of {name}")
        world_model, tokenizer = run.model.world_model, run.model.tokenizer
        rollouts_of[name] = imagine(run.agent, world_model, tokenizer, whole, jax.random.key(0), start)
        high = spec.observation.high
        table, summary = compare(real, rollouts_of[name], run.agent.tokens, high, extractor)
        steps[name] = pd.DataFrame(table)
        codebook = _codebook(record)
        if len(codebook):
            codes[name] = codebook
            summary["codes"] = int(codebook.codes.iloc[-1])
        if extractor is not None:
            summary["extractor_percent"] = 100 * extractor.accuracy
        rows[name] = {"checkpoint": run.step, **summary}
        used = rollouts_of[name].codes
        if grid and used is not None:
            picture = pictures.code_picture(run.agent.tokenizer, tokenizer, used, spec.observation.shape, high)
            pictures.save(out / f"codes-{name.replace(' ', '-').replace('/', '-')}.png", picture)

    # So that leaderboards can tell whether it is of the runs that they publish.
    digests = [record.episodes_digest() for record in records]
    summaries = [
        pd.DataFrame([row | {"episodes_sha256": digest}]) for row, digest in zip(rows.values(), digests, strict=True)
    ]
    _write_table(out / "summary.csv", dict(zip(rows, summaries, strict=True)))
    _write_table(out / "steps.csv", steps)
    if codes:
        _write_table(out / "codes.csv", codes)
    pictures.curves(out / "curves.png", steps, codes)
    if grid:
        _write_strips(out, real, rollouts_of, records)
    return {"folder": str(out), "runs": rows}


def _check(records: Sequence[RunRecord]) -> None:
    first = records[0]
    for record in records:
        config = record.config
        if record.spec.two_player:
            raise UserError(f"{record.folder} is a run of a two-player game: inspect it apart from the others")
        if not config.world_model.enabled:
            raise UserError(f"{record.folder} has no world model: {config.agent} learns from real play only")
        for field in ("task", "preset"):
            ours, theirs = getattr(config, field), getattr(first.config, field)
            if ours != theirs:
                raise UserError(f"{record.folder} is of {field} {ours}, {first.folder} of {theirs}: inspect them apart")
        if checkpoint.latest_step(record.folder / "checkpoints") is None:
            raise no_checkpoint(record)
    folders = [record.folder.resolve() for record in records]
    for i, folder in enumerate(folders):
        if folder in folders[:i]:
            raise UserError(f"{records[i].folder} is named twice")


def _names(records: Sequence[RunRecord]) -> list[str]:
    """Short names that tell the runs apart: agents, and where that is not enough seeds, and a number."""
    agents = [record.config.agent for record in records]
    seeded = [f"{record.config.agent} seed {record.config.seed}" for record in records]
    names = agents if len(set(agents)) == len(agents) else seeded
    return names if len(set(names)) == len(names) else [f"{name} ({i + 1})" for i, name in enumerate(names)]


def _codebook(record: RunRecord) -> pd.DataFrame:
    """How many codes the tokenizer had or used over training: columns "step" and "codes", maybe no rows."""
    table, column = record.table("metrics"), "tokenizer/codes"
    if column not in table:
        return pd.DataFrame({"step": [], "codes": []})
    return table[["step", column]].rename(columns={column: "codes"}).dropna()


def _write_table(path: Path, tables: dict[str, pd.DataFrame]) -> None:
    """Tables of runs below each other, the run's name in the first column."""
    parts = [table.assign(run=name) for name, table in tables.items()]
    whole = pd.concat(parts, ignore_index=True)
    whole = whole[["run", *(name for name in whole.columns if name != "run")]]
    write_whole(path, whole.to_csv(index=False, lineterminator="\n").encode())


def _write_strips(
    out: Path, real: EvaluationSet, rollouts_of: dict[str, Rollouts], records: Sequence[RunRecord]
) -> None:
    task, observation = records[0].config.task, records[0].spec.observation
    first = {record.config.agent: name for name, record in zip(reversed(rollouts_of), reversed(records), strict=True)}
    longest = max(rollouts.steps for rollouts in rollouts_of.values())
    for i, number in enumerate(filmstrips.choose(real, longest, STRIPS)):
        steps = int(real.frame_counted[number, :longest].sum())
        notes = ["step 0: start"]
        for t in range(steps):
            reward = real.reward[number, t]
            earned = f", reward {reward:+.3g}" if abs(reward) > 1e-6 else ""
            notes.append(f"step {t + 1}: action {real.action[number, t]}{earned}")
        strip = filmstrips.Strip(
            title=f"{task}, trajectory {number}. Outlined: patches that differ from the real frame.",
            real=real.frames[number, : steps + 1],
            imagined={name: rollouts.frames[number, :steps] for name, rollouts in rollouts_of.items()},
            notes=notes,
            patch=observation.patch or observation.shape[:2],  # type: ignore[arg-type]
            high=observation.high,
        )
        pictures.save(out / f"rollout-{number:03}.png", filmstrips.filmstrip(strip))
        filmstrips.film(out / f"rollout-{number:03}.gif", strip)
        if i == 0:
            few = {name: frames for name, frames in strip.imagined.items() if name in first.values()}
            small = dataclasses.replace(strip, title=f"{task}, trajectory {number}.", imagined=few)
            write_whole(out / "filmstrip.png", filmstrips.small_filmstrip(small))
