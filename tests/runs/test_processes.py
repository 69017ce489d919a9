"""Two processes of this machine train one run together, and one of them dies."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

LONG = pytest.mark.timeout(3600)
STEPS = 640  # twenty iterations of 4 x 8, with a checkpoint after each
RUN = ["run", "minatar/breakout", "--agent", "mfrl", "--preset", "smoke", "--steps", str(STEPS), "--quiet"]
FOLDER = Path("minatar/breakout/mfrl/smoke/seed_0")


@contextlib.contextmanager
def started(out, *options):
    """A command, whose stdout and stderr are files in `out`."""
    out.mkdir(exist_ok=True)
    name = "_".join(options).replace(":", "_").replace("-", "") or "alone"
    with open(out / f"{name}.out", "w") as stdout, open(out / f"{name}.err", "w") as stderr:
        words = [sys.executable, "-m", "suite.cli", *RUN, "--out", str(out), *options]
        process = subprocess.Popen(words, stdout=stdout, stderr=stderr, env=os.environ | {"JAX_PLATFORMS": "cpu"})
    process.told = lambda: (out / f"{name}.err").read_text()  # type: ignore[attr-defined]
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextlib.contextmanager
def together(out):
    """Two processes of one run."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        coordinator = f"127.0.0.1:{free.getsockname()[1]}"
    words = ["--coordinator", coordinator, "--processes", "2", "--process"]
    with started(out, *words, "0") as first, started(out, *words, "1") as second:
        yield first, second


def table(out, name):
    return pd.read_csv(out / FOLDER / f"{name}.csv")


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """Folders: of one process; of two; of two, one of which was killed, and of one that went on. And what was told."""
    root = tmp_path_factory.mktemp("processes")
    with started(root / "one") as process:
        assert process.wait(timeout=300) == 0, process.told()
    with together(root / "two") as processes:
        for process in processes:
            assert process.wait(timeout=300) == 0, process.told()
    with together(root / "killed") as (first, second):
        end = time.monotonic() + 300
        while not list((root / "killed" / FOLDER / "checkpoints").glob("step_*/manifest.json")):
            assert time.monotonic() < end and first.poll() is None, first.told()
            time.sleep(0.02)
        second.send_signal(signal.SIGKILL)
        code, told = first.wait(timeout=120), first.told()
    kept = table(root / "killed", "metrics")["step"].max()
    with started(root / "killed") as process:
        assert process.wait(timeout=300) == 0, process.told()
    return root, (code, told, kept)


@LONG
@pytest.mark.devices
@pytest.mark.parametrize("name", ["two", "killed"])
def test_one_record_as_of_one_process(records, name):
    root, _ = records
    assert [path.parent for path in (root / name).rglob("record.json")] == [root / name / FOLDER]
    pd.testing.assert_frame_equal(table(root / name, "metrics"), table(root / "one", "metrics"), rtol=1e-4, atol=1e-6)
    record = json.loads((root / name / FOLDER / "record.json").read_text())
    assert (record["status"], record["steps"], record["device"]["count"]) == ("finished", STEPS, 2)


@LONG
@pytest.mark.devices
def test_the_one_that_is_left_says_so_and_keeps_a_checkpoint(records):
    root, (code, told, kept) = records
    assert code == 1 and told.startswith("error: another process of this run was lost") and told.count("\n") == 1
    assert kept < STEPS
    resumed = json.loads((root / "killed" / FOLDER / "record.json").read_text())["resumed"]
    assert len(resumed) == 1 and 0 < resumed[0]["step"] <= kept and resumed[0]["device"]["count"] == 1


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--coordinator", "here:1"], "needs --processes N and --process I"),
        (["--coordinator", "here:1", "--processes", "2", "--process", "2"], "I from 0 to N - 1"),
        (["--processes", "2", "--process", "0"], "belong to --coordinator HOST:PORT"),
        (["--coordinator", "auto", "--processes", "2"], "belong to --coordinator HOST:PORT"),
        (["--coordinator", "here"], "'here' is neither HOST:PORT nor auto"),
    ],
)
def test_half_an_address_is_one_line(suite, words, line):
    code, _, err = suite("run", "minatar/breakout", *words)
    assert code == 2 and line in err and err.count("\n") == 1
