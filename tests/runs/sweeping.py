"""Sweeps as processes of their own, and what they leave behind in the folder `runs` of this process's own."""

from __future__ import annotations

import contextlib
import json
import re
import subprocess
import sys
import time
from pathlib import Path

# Few runs, each long enough to be killed in the middle.
GRID = ["--tasks", "openspiel/tic_tac_toe,openspiel/kuhn_poker", "--agents", "mfrl_no_rnn", "--preset", "smoke"]


@contextlib.contextmanager
def sweeping(*words):
    """A sweep as a process of its own; `finish` ends it in peace."""
    with open("stdout", "w") as out, open("stderr", "w") as err:
        process = subprocess.Popen(
            [sys.executable, "-m", "suite.cli", "sweep", *words, "--json"], stdout=out, stderr=err, text=True
        )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def finish(process):
    """Exit code; the runs, by folder, as the last line has them."""
    code = process.wait(timeout=400)
    text = Path("stdout").read_text()
    assert text, Path("stderr").read_text()
    return code, {Path(run["folder"]): run for run in json.loads(text.splitlines()[-1])["runs"]}


def until(condition, process=None, seconds=300):
    """Waits for what the condition finds, as long as the process goes on."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "waited for too long"
        assert process is None or process.poll() is None, Path("stderr").read_text()
        time.sleep(0.05)
    return found


def records():
    """record.json of all runs, by folder. Looked for at its own depth: deeper folders come and go while runs go on."""
    paths = Path("runs").glob("*/*/*/*/seed_*/record.json")  # family / game / agent / preset
    return {path.parent: json.loads(path.read_text()) for path in paths}


def finished():
    """Runs that have taken all their steps, and whose process has tidied up and gone."""
    return {
        folder for folder, record in records().items() if record["status"] == "finished" and not alive(owner(folder))
    }


def snapshot(folders):
    """Every file's bytes, and when it was written."""
    files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in files}


def owner(folder):
    """The process that has a run open or had it last."""
    found = re.match("pid ([0-9]+) ", (folder / "run.lock").read_text())
    return int(found[1]) if found else None


def parent(pid):
    try:
        return int(re.search(r"^PPid:\s+([0-9]+)", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)[1])
    except OSError:  # it is gone
        return None


def alive(pid):
    return parent(pid) is not None


def just_begun():
    """Runs that have a record and no iteration yet: seconds before they can finish."""
    return [
        folder
        for folder, record in records().items()
        if record["status"] == "running" and not (folder / "metrics.csv").exists() and owner(folder)
    ]
