"""Runs, sweeps and `suite publish`, killed at random instants or out of disk: nothing is lost, and what they come to is
the same.

It takes a quarter of an hour and more, so that only `pytest -m kills` runs it. KILLS is how many kills there are of
each kind (default 7), SEED is of when they come (default 0).
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from suite import cli
from suite.configuration.schema import Config
from suite.records import record
from tests.leaderboards import test_publish as published
from tests.runs.sweeping import alive, owner

KILLS, SEED = int(os.environ.get("KILLS", "7")), int(os.environ.get("SEED", "0"))
pytestmark = [pytest.mark.kills, pytest.mark.usefixtures("elsewhere"), pytest.mark.timeout(3600)]

SAVING = "checkpoint.every_steps=64", "evaluation.every_steps=96"
RUNS = {
    "craftax_classic": ("craftax_classic", "--agent", "mfrl", "--steps", "256"),
    "minatar": ("minatar/breakout", "--agent", "m5", "--steps", "256"),
    "openspiel": ("openspiel/leduc", "--agent", "m5", "--steps", "256"),
    "gymnasium": ("gymnasium/FrozenLake-v1", "--agent", "mfrl", "--steps", "256"),
}
# What must not depend on how often a run was killed.
FILES = ("config.json", "episodes.csv", "metrics.csv", "evaluations.csv")


def start(*words):
    """A command as a process of its own; its output is in the file `log`."""
    with Path("log").open("ab") as log:
        return subprocess.Popen([sys.executable, "-m", "suite", *words], stdout=log, stderr=log)


def finish(*words):
    begun = time.monotonic()
    code = start(*words).wait()
    assert code == 0, Path("log").read_text()[-2000:]
    return time.monotonic() - begun


def kill(process, reached, delay):
    """Kills it so many seconds after it has got somewhere, unless it ends before; whether it was killed."""
    while process.poll() is None and not reached():
        time.sleep(0.002)
    try:
        process.wait(delay)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
    return process.wait() == -signal.SIGKILL


def lines(path):
    """Those that were written whole."""
    return path.read_bytes().split(b"\n")[1:-1] if path.exists() else []


def state(folders):
    """What runs came to, but for times; and that nothing is left over."""
    found = {}
    for folder in folders:
        fields = json.loads((folder / "record.json").read_text())
        assert fields["status"] == "finished"
        assert not [*folder.rglob("*.partial"), *folder.glob("config.next.json")]
        more = not Config(**json.loads((folder / "config.json").read_text())).tied_to_budget
        assert bool([*folder.glob("checkpoints/*/resume")]) == more
        assert len([*(folder / "checkpoints").iterdir()]) == 1
        steps = [row.partition(b",")[0] for row in lines(folder / "timing.csv")]
        found[folder.name] = ([(folder / name).read_bytes() for name in FILES], fields["steps"], steps)
    return found


def kept(folder, before):
    """Every row that was there at a kill is there, or was put aside."""
    for name, rows in before.items():
        places = [folder / name, *folder.glob(f"replaced/*/{name}")]
        assert set(rows) <= {row for path in places for row in lines(path)}


@pytest.mark.parametrize("family", RUNS)
def test_runs(family):
    words = ("run", *RUNS[family], "--preset", "smoke", *SAVING, "--quiet", "--out")
    finish(*words, "whole")
    (whole,) = Path("whole").rglob("seed_0")
    iterations = len(lines(whole / "metrics.csv"))
    finish(*words, "warm")  # nothing is compiled any more
    (warm,) = Path("warm").rglob("seed_0")
    took = json.loads((warm / "record.json").read_text())["wall_clock_seconds"]
    seconds = (took["total"] - took["start"]) / iterations
    expected = state([whole])
    assert state([warm]) == expected
    draw, killed = random.Random(f"{SEED} {family}"), 0
    for number in range(KILLS):
        out = f"killed_{number}"
        folder = out / whole.relative_to("whole")
        if "m5" in words and draw.random() < 0.5:
            finish(*words, out, "--steps", "128")  # so that it is killed while it is given the rest, or after
        for _ in range(draw.choice((1, 1, 2))):
            rows, delay = draw.randrange(iterations + 1), draw.uniform(0, seconds)
            killed += kill(
                start(*words, out),
                lambda rows=rows, folder=folder: (
                    (folder / "record.json").exists() and len(lines(folder / "metrics.csv")) >= rows
                ),
                delay,
            )
            before = {name: lines(folder / name) for name in FILES[1:]}
        finish(*words, out)
        assert state([folder]) == expected, f"{family}, kill {number}: {rows} iterations and {delay:.3f} seconds"
        kept(folder, before)
    assert killed > KILLS // 2


def test_a_sweep():
    """Its runs are told to stop when it dies; half of the time they are killed as well."""
    words = ("sweep", "--tasks", "minatar/breakout,openspiel/kuhn_poker", "--agents", "mfrl", "--preset", "smoke")
    words = (*words, "--steps", "256", *SAVING, "--quiet", "--out")
    finish(*words, "whole")
    seconds = finish(*words, "warm")
    runs = [path.parent.relative_to("whole") for path in Path("whole").rglob("record.json")]
    expected = [state(["whole" / run]) for run in runs]
    assert len(runs) == 2
    draw, killed = random.Random(f"{SEED} sweep"), 0
    for number in range(KILLS):
        out = Path(f"killed_{number}")
        killed += kill(start(*words, str(out)), lambda: True, draw.uniform(0, seconds))
        owners = [owner(path.parent) for path in out.rglob("run.lock")]
        if draw.random() < 0.5:
            for process in filter(None, owners):
                if alive(process):
                    os.kill(process, signal.SIGKILL)
        finish(*words, str(out))
        assert [state([out / run]) for run in runs] == expected, f"sweep, kill {number}"
    assert killed > KILLS // 2


def test_publish(monkeypatch):
    monkeypatch.setattr(record, "provenance", lambda: published.PROVENANCE)
    for seed in range(3):
        published.write(seed=seed)
        published.write("m5", seed, (0.0, 2.0 + seed))
    words = ("publish", "runs", "--out")
    finish(*words, "whole", "--page", "whole")

    def tree(out):
        return {path.relative_to(out): path.read_bytes() for path in sorted(Path(out).rglob("*")) if path.is_file()}

    expected = tree("whole")
    draw, killed = random.Random(f"{SEED} publish"), 0
    for number in range(KILLS):
        out = Path(f"killed_{number}")
        files, delay = draw.randrange(len(expected)), draw.uniform(0, 0.02)
        process = start(*words, str(out), "--page", str(out))
        killed += kill(
            process, lambda out=out, files=files: sum(path.is_file() for path in out.rglob("*")) >= files, delay
        )
        finish(*words, str(out), "--page", str(out))
        assert tree(out) == expected, f"publish, kill {number}: {files} files and {delay:.3f} seconds"
        finish("verify", str(out))
    assert killed > KILLS // 2


@pytest.fixture
def disk(tmp_path):
    """A disk of 3 MiB, and how to fill it up to so many free bytes (None: empty it) or to make it read-only."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", folder], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("needs to mount a disk")

    def fill(free):
        (folder / "filling").unlink(missing_ok=True)
        if free is not None:
            found = os.statvfs(folder)
            (folder / "filling").write_bytes(bytes(max(found.f_bavail * found.f_bsize - free, 0)))

    def read_only():
        subprocess.run(["mount", "-o", "remount,ro", folder], check=True)

    yield folder, fill, read_only
    subprocess.run(["umount", folder], check=True)


def one_line(words, capfd):
    """The command's exit code, and what it says on stderr, wherever in the process that is written."""
    code = cli.main(list(map(str, words)))
    said = capfd.readouterr().err.splitlines()
    assert len(said) == (code != 0), "\n".join(said)
    return code, "".join(said)


def test_a_full_disk(disk, capfd):
    folder, fill, _ = disk
    words = ("run", "minatar/breakout", "--agent", "mfrl", "--preset", "smoke", *SAVING, "--quiet", "--out")
    assert cli.main([*words, "whole"]) == 0
    (whole,) = Path("whole").rglob("seed_0")
    expected = state([whole])
    capfd.readouterr()
    refused = 0
    for free in range(0, 400_000, 16_384):
        fill(free)
        code, said = one_line((*words, folder / "runs"), capfd)
        refused += code
        assert (code, said[:16]) in ((0, ""), (1, "error: disk full"))
        fill(None)
        assert one_line((*words, folder / "runs"), capfd) == (0, "")
        run = folder / "runs" / whole.relative_to("whole")
        assert state([run]) == expected
        fill(0)
        assert one_line(("evaluate", run, "--quiet"), capfd)[0] == 1
        fill(None)
        assert state([run]) == expected
        shutil.rmtree(folder / "runs")
    assert refused > 10


def test_a_read_only_disk(disk, capfd, monkeypatch):
    folder, _, read_only = disk
    words = ("--preset", "smoke", "--quiet", "--out", folder / "runs")
    task = ("run", "minatar/breakout", "--agent", "m5")
    assert cli.main(list(map(str, (*task, *words)))) == 0
    (run,) = folder.rglob("seed_0")
    monkeypatch.setattr(record, "provenance", lambda: published.PROVENANCE)
    publishable = published.write(out=folder / "others")
    before = published.files(folder)
    read_only()
    capfd.readouterr()
    for command in (
        (*task, *words),
        (*task, "--seed", "1", *words),
        ("evaluate", run),
        ("watch", run),
        ("inspect", run),
        ("publish", publishable, "--out", folder / "boards"),
        ("sweep", "--tasks", "minatar/breakout", "--agents", "mfrl", *words),
    ):
        code, said = one_line(command, capfd)
        if code:
            assert said.startswith(f"error: cannot write to {folder}"), said
    assert published.files(folder) == before
