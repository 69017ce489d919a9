"""Evidence of world models: what is read of `suite inspect`'s files, what is refused, and how curves show it."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest

from leaderboards import inspections
from leaderboards.inspections import comparisons, inspections_in
from leaderboards.page import plots, world_models
from suite.diagnostics import filmstrips
from suite.runtime.errors import UserError
from tests.leaderboards.test_publish import elsewhere, write

__all__ = ["elsewhere"]  # a fixture
TASK = "minatar/breakout"
REPOSITORY = Path(__file__).parents[2]


def write_inspection(out, runs, folder="", task=TASK, steps=5, bound=98.0, trained=102_400, symbols=True, of=None):
    """What `suite inspect` writes of runs: by name, what each loses in every step. `of`: a run's folder; None: none."""
    folder = Path(out, "evidence", task, "inspect", folder)
    folder.mkdir(parents=True)
    tables = []
    for name, loss in runs.items():
        step = np.arange(1, steps + 1)
        table = {"run": name, "step": step, "error": 10 * loss * step, "repeated_error": (100 - bound) * step}
        if symbols:
            table |= {"symbols_percent": 99 - loss * step, "repeated_symbols_percent": bound - step}
            table |= {"real_symbols_percent": 99.5 + 0.0 * step}
        tables.append(pd.DataFrame(table))
    pd.concat(tables).to_csv(folder / "steps.csv", index=False)
    digest = "of no run" if of is None else hashlib.sha256((of / "episodes.csv").read_bytes()).hexdigest()
    summary = pd.DataFrame({"run": list(runs), "checkpoint": trained, "episodes_sha256": digest})
    summary.to_csv(folder / "summary.csv", index=False)
    real = np.random.default_rng(0).integers(0, 2, (steps + 1, 10, 10, 4), np.uint8)
    strip = filmstrips.Strip("Trajectory 3.", real, dict.fromkeys(list(runs)[:1], real[1:]), [], (1, 1), 1)
    (folder / "filmstrip.png").write_bytes(filmstrips.small_filmstrip(strip))
    return folder


def names(groups):
    return [[run.name for run in group] for group in groups]


def test_runs_are_compared_where_their_rollouts_begin_alike(tmp_path):
    """With the same bounds, over as many steps as both have, after as much training."""
    write_inspection(tmp_path, {"m5 seed 0": 1.0, "m5 seed 1": 2.0}, "any/name")
    write_inspection(tmp_path, {"m1": 3.0}, "longer", steps=10)
    write_inspection(tmp_path, {"m6": 0.5}, "other frames", bound=97.0)
    write_inspection(tmp_path, {"m5 seed 0": 1.0}, "trained", trained=204_800)
    write_inspection(tmp_path, {"m5": 1.0}, task="craftax_classic")
    found = inspections_in(tmp_path)
    assert [inspection.task for inspection in found] == ["craftax_classic"] + [TASK] * 4
    groups = names(comparisons(found[1:]))
    assert sorted(map(sorted, groups)) == [["m1", "m5 seed 0", "m5 seed 1"], ["m5 seed 0"], ["m6"]]


def test_curves_are_means_beside_bounds(tmp_path, monkeypatch):
    write_inspection(tmp_path, {"m5 seed 0": 1.0, "m5 seed 1": 3.0, "m1 seed 0": 4.0})
    monkeypatch.setattr(plots, "svg_of", lambda figure, *_: figure)
    figure = plots.world_models([("", comparisons(inspections_in(tmp_path))[0])])
    symbols, error = figure.axes
    step = np.arange(1, 6)
    drawn = {line.get_label(): line.get_ydata() for line in symbols.lines}
    assert list(drawn) == ["m1", "m5", "first frame repeated", "real frame"]
    for label, values in zip(drawn, (99 - 4 * step, 99 - 2 * step, 98 - step, 99.5 + 0 * step), strict=True):
        np.testing.assert_allclose(drawn[label], values)
    drawn = {line.get_label(): line.get_ydata() for line in error.lines}
    for label, values in zip(drawn, (40 * step, 20 * step, 2 * step, 0 * step), strict=True):
        np.testing.assert_allclose(drawn[label], values)
    (band,) = symbols.collections  # of the agent with several runs
    low, high = (int(side(band.get_paths()[0].vertices[:, 1])) for side in (min, max))
    assert (low, high) == (99 - 3 * 5, 99 - 1)


def test_a_task_without_symbols_has_errors_alone(tmp_path):
    write_inspection(tmp_path, {"m5": 1.0}, symbols=False)
    (figure, strip) = world_models.figures(inspections_in(tmp_path))
    assert "squared error" in figure.picture and "symbols right" not in figure.picture
    assert "symbols" not in world_models.reading(inspections_in(tmp_path))
    assert figure.facts == strip.facts == {"origin": "ours", "observation": "symbolic", "steps": 102_400}


def spoil(folder, name, old, new):
    path = folder / name
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new))


FAULTS = {
    "no table": (lambda f: (f / "steps.csv").unlink(), r"cannot read .*steps.csv \(No such file"),
    "no summary": (lambda f: (f / "summary.csv").unlink(), r"cannot read .*summary.csv \(No such file"),
    "empty": (lambda f: (f / "steps.csv").write_text(""), r"cannot read .*steps.csv \(No columns to parse"),
    "binary": (lambda f: (f / "steps.csv").write_bytes(b"\xff\0"), r"cannot read .*steps.csv \("),
    "a column": (lambda f: spoil(f, "steps.csv", b"repeated_error", b"x"), "steps.csv has no column repeated_error"),
    "text": (lambda f: spoil(f, "steps.csv", b"99.5", b"high"), "steps.csv has no rows, or some without"),
    "infinity": (lambda f: spoil(f, "steps.csv", b"99.5", b"inf"), "steps.csv has no rows, or some without"),
    "no number": (lambda f: spoil(f, "summary.csv", b"102400", b""), "summary.csv has no rows, or some without"),
    "no digest": (lambda f: spoil(f, "summary.csv", b"episodes", b"e"), "summary.csv has no column episodes_sha256"),
    "no run": (lambda f: spoil(f, "steps.csv", b"m5", b" "), "steps.csv has no rows, or some without"),
    "no rows": (
        lambda f: (f / "summary.csv").write_text("run,checkpoint,episodes_sha256\n"),
        "summary.csv has no rows, or some",
    ),
    "a step": (lambda f: spoil(f, "steps.csv", b"m5,3", b"m5,2"), "has not each step of m5 once, from 1 on"),
    "another run": (lambda f: spoil(f, "summary.csv", b"m5", b"m6"), "are not of the same runs"),
    "no picture": (lambda f: (f / "filmstrip.png").write_text("GIF"), "filmstrip.png is no whole PNG"),
    "a broken picture": (lambda f: spoil(f, "filmstrip.png", b"Trajectory 3", b"Trajectory 4"), "is no whole PNG"),
    "too large": (
        lambda f: (f / "filmstrip.png").write_bytes((f / "filmstrip.png").read_bytes() + bytes(30_000)),
        "filmstrip.png has 30,[0-9]{3} bytes: at most 30,000",
    ),
    "twice": (lambda f: shutil.copytree(f, f / "again"), "m5 stands in .*inspect/steps.csv and in .*again/steps.csv"),
    "no task": (lambda f: shutil.copytree(f, f.parents[2] / "chess" / "inspect"), "unknown task 'chess'"),
}


@pytest.mark.parametrize(("spoiled", "message"), FAULTS.values(), ids=FAULTS)
def test_what_inspect_did_not_write_so_is_refused(tmp_path, spoiled, message):
    spoiled(write_inspection(tmp_path, {"m5": 1.0}))
    with pytest.raises(UserError, match=message) as refusal:
        inspections_in(tmp_path)
    assert "\n" not in str(refusal.value)


def test_inspect_writes_no_larger_filmstrips_than_pages_take():
    assert filmstrips.SMALL_BYTES <= inspections.FILMSTRIP_BYTES


def test_a_change_in_any_file_changes_the_page(tmp_path):
    folder = write_inspection(tmp_path, {"m5": 1.0})
    (folder / "codes.csv").write_text("run,step,codes\nm5,1,2\n")
    seen = {inspections_in(tmp_path)[0].sha256}
    for name, old, new in (
        ("steps.csv", b"99.5", b"99.4"),
        ("summary.csv", b"102400", b"1"),
        ("codes.csv", b"2", b"3"),
    ):
        spoil(folder, name, old, new)
        seen.add(inspections_in(tmp_path)[0].sha256)
    write_inspection(tmp_path / "other", {"m5": 1.0}, steps=3)
    shutil.copy(next(tmp_path.glob("other/**/filmstrip.png")), folder)
    assert len(seen | {inspections_in(tmp_path)[0].sha256}) == 5


def test_verify_knows_what_the_page_shows_of_world_models(suite):
    folder = write_inspection("leaderboards", {"m5 seed 0": 1.0}, "m5", of=write("m5"))
    (folder / "codes.csv").write_text("run,step,codes\nm5 seed 0,1,2\n")
    assert suite("publish", "--page", "leaderboards", "--plot", "w.svg")[0] == 0
    assert suite("verify", "leaderboards")[0] == 0
    spoil(folder, "codes.csv", b"1,2", b"1,3")
    assert suite("verify", "leaderboards")[1].startswith("index.html: not what these runs give")
    spoil(folder, "codes.csv", b"1,3", b"1,2")
    for name in ("notes.csv", "rollout-003.png"):
        (folder / name).write_text("")
    (folder.parents[1] / "filmstrip.png").write_text("")
    code, out, _ = suite("verify", "leaderboards")
    assert code == 1 and [line.split(": ") for line in out.splitlines()[:-1]] == [
        ["evidence/minatar/breakout/filmstrip.png", "belongs to no run"],
        ["evidence/minatar/breakout/inspect/m5/notes.csv", "belongs to no run"],
        ["evidence/minatar/breakout/inspect/m5/rollout-003.png", "belongs to no run"],
    ]
    (folder / "steps.csv").unlink()
    code, out, _ = suite("verify", "leaderboards")
    assert code == 1 and out.startswith("cannot read leaderboards/evidence/minatar/breakout/inspect/m5/steps.csv")
    before = Path("leaderboards/minatar_breakout.csv").read_bytes()
    write(seed=1)
    assert suite("publish", "--page", "leaderboards")[::2] == (2, f"error: {out.splitlines()[0]}\n")
    assert Path("leaderboards/minatar_breakout.csv").read_bytes() == before


def test_it_must_be_of_runs_that_are_published(suite):
    """Not of one that has been replaced since, nor of another agent's."""
    first = write("m5", out="first")
    folder = write_inspection("leaderboards", {"m5 seed 0": 1.0}, of=first)
    assert suite("publish", "first", "--page", "leaderboards")[0] == 0
    spoil(folder, "summary.csv", b"m5", b"m6")
    spoil(folder, "steps.csv", b"m5", b"m6")
    code, out, _ = suite("verify", "leaderboards")
    assert code == 1 and "summary.csv: m6 seed 0 is none of the published runs of m6" in out
    shutil.rmtree("leaderboards")
    write_inspection("leaderboards", {"m5 seed 0": 1.0}, of=first)
    write("m5", out="second", returns=(2.0, 5.0))
    code, _, error = suite("publish", "second")
    assert code == 2 and "m5 seed 0 is none of the published runs of m5" in error
    assert not list(Path("leaderboards").glob("*.csv"))


def test_a_picture_of_its_own(suite):
    write()
    for words, message in (
        (["w.png"], "cannot draw w.png: its name must end in .svg"),
        (["w.svg"], "--plot has nothing to show: no steps.csv of suite inspect in evidence/<task>/inspect/"),
    ):
        assert suite("publish", "--plot", *words)[::2] == (2, f"error: {message}\n")
    assert not Path("leaderboards").exists()
    write_inspection("leaderboards", {"m5": 1.0}, of=write("m5"))
    write_inspection("leaderboards", {"m6": 1.0}, "m6", bound=97.0, of=write("m6"))
    assert "plot w.svg\n" in suite("publish", "--plot", "w.svg")[1]
    root = ElementTree.parse("w.svg").getroot()
    texts = [element.text for element in root.iter("{http://www.w3.org/2000/svg}text")]
    for text in ("m5", "m6", "first frame repeated", "real frame", "minatar/breakout, 102,400 real steps: m6"):
        assert texts.count(text) == 1


def test_the_picture_in_the_docs_is_of_the_evidence(tmp_path):
    """Make it again with the command that docs/performance.md names."""
    world_models.write_picture(tmp_path / "w.svg", inspections_in(REPOSITORY / "leaderboards"))
    assert (tmp_path / "w.svg").read_bytes() == (REPOSITORY / "docs" / "world_models.svg").read_bytes()
