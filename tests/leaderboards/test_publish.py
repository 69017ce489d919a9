"""From run records to leaderboards and back: what is refused, what is written, and what `suite verify` finds."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from leaderboards.boards import COLUMNS
from leaderboards.qualification import EVIDENCE, impossible
from suite.records import record
from suite.records.record import RunRecord, run_folder
from suite.registry import resolve, task

TASK = "minatar/breakout"
PROVENANCE = {
    "python": "3.11.7",
    "packages": {"jax": "0.10.2"},
    "git_commit": "0123456789abcdef0123456789abcdef01234567",
    "device": {"platform": "cpu", "kind": "cpu", "cpu_cores": 2},
}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """An empty folder, and code that is committed whatever the state of this checkout."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(record, "provenance", lambda: PROVENANCE)


def write(
    agent="mfrl", seed=0, returns=(1.0, 3.0), task_id=TASK, out="runs", overrides=(), preset="small", finish=True
):
    """A run whose episodes end at equal distances, the last one with the budget."""
    config = resolve(task_id, agent, preset, overrides, seed)
    with RunRecord.create(run_folder(Path(out), config), config, task(task_id).spec()) as run:
        ends = np.linspace(0, config.total_steps, len(returns) + 1).astype(int)[1:]
        rows = [
            {"step": int(end), "return": value, "length": max(5, math.ceil(value))}
            for end, value in zip(ends, returns, strict=True)
        ]
        run.append_episodes(rows)
        count = {"episodes": len(rows), "return": float(np.mean(returns)) if returns else None}
        run.append_metrics({"step": config.total_steps, **count})
        run.append_timing({"step": config.total_steps, "collect": 1.0})
        run.add_wall_clock(60.0 * (seed + 1), {"collect": 1.0})
        if finish:
            run.finish(config.total_steps)
    return run.folder


def board(name="minatar_breakout.csv"):
    return pd.read_csv(Path("leaderboards") / name)


def files(folder="leaderboards"):
    return {path: path.read_bytes() for path in sorted(Path(folder).rglob("*")) if path.is_file()}


def edit_json(path, **changes):
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_rows_ranks_and_evidence(suite):
    for seed, last in enumerate((2.0, 4.0, 9.0)):
        write("mfrl", seed, (0.0, 0.0, 0.0, last))
    write("m5", 0, (0.0, 0.0, 0.0, 6.0))
    write("m5", 1, (0.0, 0.0, 0.0, 8.0), overrides=["ppo.clip=0.3"])
    code, out, err = suite("publish")
    assert (code, err) == (0, "")
    assert out.splitlines()[0] == "5 runs added, 0 refused; 5 runs in 3 entries"
    table = board()
    assert tuple(table) == COLUMNS
    ours = table[table["measured_here"]].set_index(["agent", "seeds"])
    assert ours["rank"].tolist()[:2] == [1, 2] and math.isnan(ours["rank"].iloc[2])  # one has other settings: no rank
    mfrl, m5, changed = ours.loc[("mfrl", 3)], ours.loc[("m5", 1)].iloc[0], ours.loc[("m5", 1)].iloc[1]
    assert changed["overrides"] == "ppo.clip=0.3" and math.isnan(m5["error"])
    # 2, 4 and 9: mean 5, deviation sqrt(13) over sqrt(3) seeds; an interquartile mean cuts nothing of three.
    assert (mfrl["value"], mfrl["iqm"]) == (5, 5) and mfrl["error"] == pytest.approx(math.sqrt(13 / 3), rel=1e-7)
    assert mfrl["iqm_low"] == 2 and mfrl["iqm_high"] == 9
    assert mfrl["minutes"] == 2 and mfrl["hardware"] == "2 CPU cores" and mfrl["environment"] == "gymnax"
    assert mfrl["git_commit"] == PROVENANCE["git_commit"] and "jax==0.10.2" in mfrl["packages"]
    assert mfrl["evidence"] == "evidence/minatar/breakout/mfrl/small"
    assert changed["evidence"].startswith("evidence/minatar/breakout/m5/small-")
    kept = {path.name for path in Path("leaderboards", mfrl["evidence"], "seed_2").iterdir()}
    assert kept == set(EVIDENCE)
    assert suite("verify", "leaderboards")[0] == 0


def test_what_an_agent_does_not_use_does_not_set_its_runs_apart(suite):
    """A preset whose world model has changed: `mfrl` has none, and its earlier runs are still its preset's."""
    write("mfrl", 0, overrides=["world_model.updates=7", "imagination.updates=7", "replay.capacity=9000"])
    write("mfrl", 1)
    write("oracle", 0, (1.0, 9.0), overrides=["world_model.updates=7"])
    write("oracle", 1, (1.0, 9.0), overrides=["imagination.updates=7"])
    assert suite("publish")[1].splitlines()[0] == "4 runs added, 0 refused; 4 runs in 3 entries"
    table = board()
    ours = table[table["measured_here"]].set_index(["agent", "overrides"])
    assert ours.loc["mfrl", "seeds"].tolist() == [2] and ours.loc["mfrl"].index.isna().all()
    assert ours.loc["mfrl", "rank"].tolist() == [1]
    assert ours.loc["oracle"].index.fillna("").tolist() == ["", "imagination.updates=7"]
    # The oracle's score is the best, but it learned from the simulator.
    assert ours.loc["oracle", "rank"].isna().all() and ours.loc["oracle", "note"].str.contains("not ranked").all()
    write("mfrl", 1, (2.0, 2.0), out="again", overrides=["tokenizer.updates=3"])
    assert "duplicate seed 1" in suite("publish", "again")[2]


def test_published_results_stand_beside_ours(suite):
    write()
    suite("publish")
    theirs = board()[lambda table: ~table["measured_here"]]
    assert 77.8 in theirs["value"].tolist() and theirs["rank"].isna().all() and theirs["source"].notna().all()


def test_publishing_twice_gives_the_same_bytes(suite):
    write()
    suite("publish")
    before = files()
    assert suite("publish")[1].startswith("0 runs added, 0 refused; 1 runs")
    shutil.rmtree("runs")
    suite("publish")  # from the evidence alone
    assert files() == before


def test_a_family_is_scored_on_one_scale(suite):
    for game, unit in (("asterix", 2.0), ("breakout", 10.0), ("freeway", 40.0), ("space_invaders", 100.0)):
        write("mfrl", 0, (unit,), task_id=f"minatar/{game}")
        for seed, factor in enumerate((1.0, 3.0)):
            write("m5", seed, (unit * factor,), task_id=f"minatar/{game}")
    suite("publish")
    overall = board("overall.csv")[lambda table: table["measured_here"]].set_index(["agent", "metric"])
    score = overall.loc[("m5", "return_normalized_to_mfrl")]
    # Of each game 1 and 3: mean 2, error 1; of four games' mean the errors are independent.
    assert (score["value"], score["error"], score["rank"], score["seeds"]) == (2, 0.5, 1, 2)
    assert overall.loc[("mfrl", "return_normalized_to_mfrl"), "value"] == 1
    assert overall.loc[("m5", "probability_of_improvement_over_mfrl"), "value"] == 0.75  # 1 = 1, and 3 > 1


def refused(outcome, *words):
    """Exit code 2, a line for each run and one for all, nothing written."""
    code, out, err = outcome
    *refusals, last = err.splitlines()
    assert (code, out) == (2, "") and last.startswith("error: nothing to publish: ") and len(refusals) <= 1
    assert all(line.startswith("refused ") for line in refusals)
    for word in words:
        assert word in err
    assert not Path("leaderboards").exists()


def says(**changes):
    return lambda folder: edit_json(folder / "record.json", **changes)


def swap(name, old, new):
    return lambda folder: edit(folder / name, old, new)


def put(name, content):
    return lambda folder: (folder / name).write_bytes(content)


EPISODES, METRICS, RECORD = "episodes.csv", "metrics.csv", "record.json"
STEPS, NAN = '"steps": 102400,\n  "started"', '"steps": NaN,\n  "started"'
REFUSALS = {
    "unfinished": (says(status="stopped", steps=2048), "unfinished (stopped): 2,048 of 102,400"),
    "schema": (says(schema=0), "schema 0; this version reads 1"),
    "seed": (says(seed=7), "record.json says seed=7, config.json 0"),
    "config": (swap("config.json", '"discount": 0.95', '"discount": 0.9'), "not the configuration that was run"),
    "hash": (says(protocol_hash="0" * 16), "protocol_hash is not that"),
    "budget": (says(steps=50_000), "took 50,000 steps, not the 102,400"),
    "dirty": (says(git_commit="1234-dirty"), "made by changed code"),
    "nan in the record": (swap(RECORD, STEPS, NAN), "record.json is damaged: NaN"),
    "nan in an episode": (swap(EPISODES, ",3.0,", ",nan,"), "line 3: return is nan, not a finite number"),
    "text in an episode": (swap(EPISODES, ",3.0,", ",much,"), "line 3: return is much, not a finite number"),
    "columns": (swap(EPISODES, "length", "duration"), "has columns step, return, duration, not"),
    "order": (swap(EPISODES, "51200,", "102401,"), "steps out of order, or outside 1 to 102,400"),
    "another return": (swap(EPISODES, ",3.0,", ",4.0,"), "2.5 in episodes.csv, 2 in metrics.csv"),
    "an episode less": (swap(EPISODES, "51200,1.0,5\n", ""), "1 episodes, metrics.csv counted 2"),
    "too much for its length": (
        swap(EPISODES, ",3.0,", ",9.0,"),
        "line 3: return is 9, minatar/breakout allows 0 to 5",
    ),
    "too long": (swap(EPISODES, ",3.0,5", ",3.0,1001"), "line 3: length is 1001, minatar/breakout allows 1 to 1000"),
    "no time": (swap(EPISODES, "51200,1.0,5", "32,1.0,5"), "line 2: 5 steps long, and ends before it can have begun"),
    "too many": (
        lambda folder: (
            put(EPISODES, b"step,return,length\n" + b"3200,1.0,200\n" * 17)(folder),
            put(METRICS, b"step,episodes,return\n102400,17,1.0\n")(folder),
        ),
        "line 18: the episodes so far have more steps than were taken, 3,200",
    ),
    "no episodes": (lambda folder: (folder / EPISODES).unlink(), "episodes.csv is missing"),
    "unreadable": (put(EPISODES, b"\xff\xfe\x00"), "episodes.csv is cut off in line 1"),
    "cut off": (put(EPISODES, b"step,return,length\n51200,1.0,5\n102400,3"), "episodes.csv is cut off in line 3"),
    "a cell less": (swap(EPISODES, "51200,1.0,5", "51200,1.0"), "episodes.csv line 2 has 2 cells, not 3"),
    "other metrics": (put(METRICS, b"step\n1\n"), "metrics.csv lacks the iteration that ended at step 102,400"),
    "metrics without returns": (put(METRICS, b"step,episodes\n102400,2\n"), "metrics.csv lacks return"),
    "unreadable metrics": (put(METRICS, b"\xff"), "metrics.csv is cut off in line 1"),
    "no object": (put(RECORD, b"[]"), "record.json is damaged"),
}


@pytest.mark.parametrize(("damage", "reason"), REFUSALS.values(), ids=REFUSALS)
def test_what_does_not_qualify_is_refused_with_its_reason(suite, damage, reason):
    damage(write())
    refused(suite("publish"), "refused runs/minatar/breakout/mfrl/small/seed_0: ", reason)


@pytest.mark.parametrize(
    ("task_id", "row", "problem"),
    [
        ("openspiel/leduc", {"return": 500, "raw_return": 500}, "raw_return is 500, openspiel/leduc allows -13 to 13"),
        ("openspiel/leduc", {"return": 5}, "return is 5, openspiel/leduc allows -1 to 1"),
        ("openspiel/leduc", {"seat": 3}, "seat is 3, openspiel/leduc allows 1 to 2"),
        ("openspiel/tic_tac_toe", {"length": 10}, "length is 10, openspiel/tic_tac_toe allows 1 to 9"),
        ("openspiel/bargaining", {"return": -1}, "return is -1, openspiel/bargaining allows 0 to 10"),
        ("minatar/breakout", {"return": 1e6}, "return is 1e+06, minatar/breakout allows 0 to 100"),
        ("minatar/freeway", {"length": 10_000_000}, "length is 1e+07, minatar/freeway allows 1 to 2500"),
        ("craftax_classic", {"length": 10_001}, "length is 10001, craftax_classic allows 1 to 10000"),
        ("craftax_classic", {"return": 22}, "return is not the sum of achievement_return and health_return"),
        (
            "craftax_classic",
            {"health_return": 20, "return": 22},
            "health_return is 20, craftax_classic allows -0.9 to 0",
        ),
        ("craftax_full", {"health_return": -2, "return": 2}, "health_return is -2, craftax_full allows -0.9 to 0.4"),
    ],
)
def test_what_the_rules_do_not_allow_is_refused(task_id, row, problem):
    spec = task(task_id).spec()
    possible = {name: 0.0 for name, shape in spec.statistics if not shape} | {"return": 0.0, "length": 100}
    if spec.two_player:
        possible |= {"seat": 1.0, "length": 5}
    if spec.achievements:
        possible |= {"achievement_return": 2.0, "return": 2.0}
    assert not [*impossible(pd.DataFrame([possible, possible]), spec)]
    assert f"episodes.csv line 3: {problem}" in impossible(pd.DataFrame([possible, possible | row]), spec)


def test_other_protocols_are_refused(suite):
    write(overrides=["protocol.steps=51200"])
    refused(suite("publish"), "another protocol: steps=51200, preset small has 102400")
    write(out="other", overrides=["protocol.final_fraction=0.5"])
    refused(suite("publish", "other"), "another protocol: final_fraction=0.5, preset small has 0.25")
    write(out="third", preset="smoke")
    refused(suite("publish", "third"), "preset smoke is for tests")


def test_other_versions_of_a_game_are_ranked_apart(suite, monkeypatch, tmp_path):
    write("mfrl", returns=(2.0,))
    monkeypatch.setattr(record, "package_version", lambda package: "1.0.0")
    write("m5", returns=(1.0,))
    monkeypatch.undo()
    monkeypatch.setattr(record, "provenance", lambda: PROVENANCE)
    monkeypatch.chdir(tmp_path)
    assert suite("publish", "runs")[0] == 0
    ours = board()[lambda table: table["measured_here"]]
    assert set(zip(ours["agent"], ours["environment_version"], ours["rank"], strict=True)) == {
        ("m5", "1.0.0", 1),
        ("mfrl", record.package_version("gymnax"), 1),
    }


def test_the_same_agent_in_two_versions_of_a_game_keeps_both_evidences(suite, monkeypatch):
    write(returns=(2.0,), out="new")
    with monkeypatch.context() as older:
        older.setattr(record, "package_version", lambda package: "1.0.0")
        write(returns=(1.0,), out="old")
    assert suite("publish", "new", "old")[1].startswith("2 runs added, 0 refused; 2 runs in 2 entries")
    assert len(set(board()[lambda table: table["measured_here"]]["evidence"])) == 2
    before = files()
    assert suite("verify", "leaderboards")[0] == 0
    suite("publish", "old", "new")
    assert files() == before
    shutil.rmtree("leaderboards")
    for folder in ("old", "new"):  # one after the other likewise
        assert suite("publish", folder)[1].startswith("1 runs added, 0 refused")
    assert suite("verify", "leaderboards")[0] == 0


def test_a_seed_that_was_run_twice_is_refused(suite):
    write("random", returns=(0.5,))
    write(returns=(1.0,), out="a")
    write(returns=(2.0,), out="b")
    code, out, err = suite("publish", "runs", "a", "b")
    assert code == 0 and out.startswith("1 runs added, 2 refused")
    assert "refused a/minatar/breakout/mfrl/small/seed_0: duplicate seed 0: b/minatar" in err
    assert suite("publish", "a")[1].startswith("1 runs added, 0 refused; 2 runs")
    code, out, err = suite("publish", "b")  # what is published stays
    assert code == 0 and out.startswith("0 runs added, 1 refused; 2 runs") and "duplicate seed 0" in err
    assert board()[lambda table: table["measured_here"] & (table["agent"] == "mfrl")]["value"].tolist() == [1.0]
    shutil.copytree("a", "copy")
    assert suite("publish", "copy")[1].startswith("0 runs added, 0 refused; 2 runs")  # the very same run


def test_what_qualifies_is_published_beside_what_does_not(suite):
    write("mfrl")
    write("m5", finish=False)
    code, out, err = suite("publish", "--json")
    assert (
        code == 0
        and err.startswith("refused runs/minatar/breakout/m5/small/seed_0: unfinished")
        and err.count("\n") == 1
    )
    fields = json.loads(out.splitlines()[-1])
    assert fields["added"] == ["runs/minatar/breakout/mfrl/small/seed_0"] and len(fields["refused"]) == 1
    assert not Path("leaderboards/evidence/minatar/breakout/m5").exists()


def test_nothing_to_publish(suite, tmp_path):
    refused(suite("publish"), "no run in leaderboards/evidence")
    Path("runs").mkdir()
    refused(suite("publish"), "no run in runs")
    Path("runs/garbage.bin").write_bytes(bytes(range(256)))
    Path("runs/record.txt").write_text("{")
    refused(suite("publish"), "no run in runs")
    Path("runs/record.json").write_bytes(bytes(range(256)))
    refused(suite("publish"), "refused runs: record.json is damaged", "none of 1 runs qualifies")
    code, _, err = suite("publish", "nowhere")
    assert code == 2 and err == "error: nowhere is no folder: give a run's folder, or one with runs below it\n"
    write(out="good")
    Path("file").write_text("")
    code, _, err = suite("publish", "good", "--out", "file")
    assert code == 2 and err.count("\n") == 1 and "cannot write to file" in err
    code, _, err = suite("publish", "good", "--page", "file")
    assert (code, err) == (2, "error: --page file is no folder\n") and not Path("leaderboards").exists()


BOARD, SEED_0 = "minatar_breakout.csv", "evidence/minatar/breakout/mfrl/small/seed_0"
TAMPERINGS = {
    "a row's value": (
        BOARD,
        ",return,3,",
        ",return,30,",
        "(mfrl, return): value is '30', the evidence gives '3'",
    ),
    "a row's minutes": (BOARD, "CPU cores,1,", "CPU cores,0.5,", "minutes is '0.5', the evidence gives '1'"),
    "a published figure": (BOARD, ",77.8,", ",78.8,", "value is '78.8', the evidence gives '77.8'"),
    "an episode": (f"{SEED_0}/episodes.csv", ",3.0,5", ",3.0,6", "evidence_sha256 is"),
    "an episode's return": (f"{SEED_0}/episodes.csv", ",3.0,5", ",9.0,5", "does not qualify"),
    "a record": (f"{SEED_0}/record.json", '"cpu_cores": 2', '"cpu_cores": 1', "hardware is '2 CPU cores'"),
    "what no row shows": (f"{SEED_0}/timing.csv", ",1.0", ",2.0", "evidence_sha256 is"),
}


@pytest.mark.parametrize(("name", "old", "new", "found"), TAMPERINGS.values(), ids=TAMPERINGS)
def test_tampering_is_found(suite, name, old, new, found):
    write()
    suite("publish")
    assert suite("verify", "leaderboards")[:2] == (0, "leaderboards: all rows follow from evidence\n")
    edit(Path("leaderboards") / name, old, new)
    code, out, err = suite("verify", "leaderboards")
    assert (code, err) == (1, "") and found in out


def test_a_changed_page_is_found(suite):
    write()
    suite("publish", "--page", "leaderboards")
    assert suite("verify", "leaderboards")[0] == 0
    edit(Path("leaderboards/index.html"), "breakout", "breakour")
    assert suite("verify", "leaderboards")[1].startswith("index.html: not what these runs give: publish again with")


def test_missing_and_foreign_files_are_found(suite):
    code, out, err = suite("verify", "leaderboards")
    assert code == 2 and err.startswith("error: no run in leaderboards/evidence: nothing to verify")
    write("mfrl")
    write("m5")
    suite("publish", "--page", "leaderboards")
    assert suite("verify", "leaderboards")[0] == 0
    Path("leaderboards/published.csv").write_text("changed")
    Path("leaderboards/evidence/notes.txt").write_text("")
    (Path("leaderboards") / SEED_0 / "extra.csv").write_text("")
    Path("leaderboards/minatar_pong.csv").write_text("rank\n1\n")
    Path("leaderboards/overall.csv").unlink()
    shutil.rmtree("leaderboards/evidence/minatar/breakout/m5")
    code, out, _ = suite("verify", "leaderboards")
    assert code == 1
    for line in (
        "overall.csv: cannot be read (No such file or directory)",
        "minatar_breakout.csv: 6 rows, the evidence gives 5",
        "minatar_pong.csv: made from no evidence",
        "index.html: not what these runs give: publish again with --page leaderboards",
        "published.csv: not this version's",
        "evidence/notes.txt: belongs to no run",
        f"{SEED_0}/extra.csv: belongs to no run",
    ):
        assert line in out.splitlines()


def test_the_committed_leaderboards_follow_from_their_evidence(suite):
    """What CI checks of this repository."""
    folder = Path(__file__).parents[2] / "leaderboards"
    code, out, _ = suite("verify", folder)
    assert code == 0, out


def test_a_foreign_game_may_pay_more_than_once():
    """What its rules allow is not known."""
    spec = dataclasses.replace(task("openspiel/leduc").spec(), ranges=())
    assert not [*impossible(pd.DataFrame([{"return": 3.0, "length": 50}]), spec)]
