"""What is worth running on a borrowed GPU, in the minutes there are: tests, speeds, then real runs (docs/gpu.md).

    python scripts/gpu.py --minutes 15 --out gpu

It needs the packages of this project and no network. Stopped, or started again with more minutes, it goes on where it
was: a part whose result is in the folder is done, and runs continue from their checkpoints.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
# What differs between devices: products, scans, sampling, optimizers. Games and boards are the same everywhere.
FAST_TESTS = ("tests/nn", "tests/world_model", "tests/policy", "tests/tokenizers", "tests/agent", "tests/interface")
TEST_MINUTES = 2.0
BENCHES = (("craftax_classic", "mfrl"), ("craftax_classic", "m5"))
RUNS = (("craftax_classic", "mfrl"), ("openspiel/tic_tac_toe", "m5"))
BENCH = 0.35  # of the minutes that are left, for one at most
FIRST_RUN = 0.7  # of the minutes that are left for runs, unless it is finished earlier
LAST_CHECKPOINT = 60.0  # seconds that a run which is told to stop may take to finish its iteration and save
STOPPED = 130  # the exit code of a run that stopped with a checkpoint
KEPT = ("config.json", "record.json", "metrics.csv", "episodes.csv", "evaluations.csv", "timing.csv")

Parts = Sequence[tuple[str, str]]


def main(
    words: Sequence[str] | None = None, tests: Sequence[str] = FAST_TESTS, benches: Parts = BENCHES, runs: Parts = RUNS
) -> int:
    """The script; the lists are of what is tested, measured and trained, in this order.

    Returns:
      0, or 1 if a test failed or a command did. What came after it was run all the same.
    """
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=15.0, metavar="N", help="for everything (default 15)")
    parser.add_argument("--out", type=Path, default=Path("gpu"), metavar="DIR", help="of results (default gpu)")
    parser.add_argument("--preset", default="paper", metavar="P", help="of speeds and runs (default paper)")
    args = parser.parse_args(words)
    if args.minutes <= 0:
        parser.error(f"--minutes {args.minutes:g} must be above 0")
    end = time.monotonic() + 60 * args.minutes
    args.out = args.out.resolve()  # commands run in the project's folder
    args.out.mkdir(parents=True, exist_ok=True)
    device = _device()
    if device["platform"] == "cpu":
        print("no accelerator: what follows are numbers of a CPU", file=sys.stderr)
    environment = os.environ | {"JAX_PLATFORMS": {"gpu": "cuda"}.get(device["platform"], device["platform"])}
    _write(args.out / "device.json", device)

    def left() -> float:
        return max(end - time.monotonic(), 0.0)

    failed = []
    if not run_tests(args.out / "tests.json", tests, min(60 * TEST_MINUTES, left()), environment):
        failed.append("tests")
    for task, agent in benches:
        path = args.out / f"bench_{task.replace('/', '_')}_{agent}.json"
        if not _bench(path, [task, "--agent", agent, "--preset", args.preset], BENCH * left(), environment):
            failed.append(path.stem)
    for index, (task, agent) in enumerate(runs):
        seconds = left() * (1.0 if index == len(runs) - 1 else FIRST_RUN) - LAST_CHECKPOINT
        run = [task, "--agent", agent, "--preset", args.preset, "--out", str(args.out / "runs")]
        if seconds > 0 and not train(run, seconds, environment):
            failed.append(f"run of {agent} on {task}")
    _keep(args.out / "runs", args.out / "records")
    print(f"results in {args.out}; records for `suite publish` in {args.out / 'records'}")
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def _device() -> dict[str, Any]:
    """Name, platform and JAX version, asked in a process of its own: whoever asks holds the device's memory."""
    code = (
        "import json, jax; device = jax.devices()[0]; "
        "print(json.dumps({'device': device.device_kind, 'platform': device.platform, 'jax': jax.__version__}))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    return json.loads(found.stdout.splitlines()[-1])


def run_tests(path: Path, tests: Sequence[str], seconds: float, environment: dict[str, str]) -> bool:
    """Runs tests for so long; whether none failed. `path` gets the counts and what pytest printed last."""
    if path.exists():
        return json.loads(path.read_text())["failed"] == 0
    print(f"tests, for {seconds:.0f} s at most", flush=True)
    # In one process: each would take the device's memory for itself.
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-rf", "--tb=short", *tests]
    code, lines, took = _timed(command, seconds, environment)
    marks = "".join(line.partition(" ")[0] for line in lines if not line.strip(".FEsx [%]0123456789"))
    found = {"passed": marks.count("."), "failed": marks.count("F") + marks.count("E"), "skipped": marks.count("s")}
    found |= {"in_time": code is not None, "seconds": round(took, 1), "last_lines": lines[-40:]}
    if code not in (None, 0) and not found["failed"]:
        found["failed"] = 1  # it did not come to the tests
    _write(path, found)
    print(f"  {found['passed']} passed, {found['failed']} failed, in time: {found['in_time']}", flush=True)
    return found["failed"] == 0


def _bench(path: Path, words: Sequence[str], seconds: float, environment: dict[str, str]) -> bool:
    """`suite bench` into `path`; true as well if there was no time for it."""
    if path.exists():
        return True
    print(f"suite bench {' '.join(words)}", flush=True)
    command = [sys.executable, "-m", "suite.cli", "bench", *words, "--quiet", "--json", "--no-start-up"]
    code, lines, took = _timed(command, seconds, environment)
    if code is None:
        print(f"  not in {seconds:.0f} s", flush=True)
        return True
    if code:
        print(*lines[-10:], sep="\n", file=sys.stderr)
        return False
    _write(path, json.loads(lines[-1]))
    print(f"  {took:.0f} s", flush=True)
    return True


def train(words: Sequence[str], seconds: float, environment: dict[str, str]) -> bool:
    """`suite run` until it is finished or the time is up, when it stops with a checkpoint."""
    print(f"suite run {' '.join(words)}, for {seconds:.0f} s at most", flush=True)
    command = [sys.executable, "-m", "suite.cli", "run", *words, "--quiet"]
    with subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as run:
        try:
            output, _ = run.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            run.send_signal(signal.SIGTERM)
            try:
                run.communicate(timeout=LAST_CHECKPOINT)
            except subprocess.TimeoutExpired:  # it was compiling, or in an iteration that takes longer
                run.kill()
                run.communicate()
            saved = run.returncode == STOPPED
            print("  stopped with a checkpoint" if saved else "  ended before it could save", flush=True)
            return True
    if run.returncode:
        print(output.decode(errors="replace"), file=sys.stderr)
    return run.returncode == 0


def _timed(command: Sequence[str], seconds: float, environment: dict[str, str]) -> tuple[int | None, list[str], float]:
    """Exit code, or None if it did not end in time; the lines of its output; and the seconds that it took."""
    start = time.monotonic()
    with subprocess.Popen(
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        try:
            output, _ = process.communicate(timeout=max(seconds, 0.1))
            code: int | None = process.returncode
        except subprocess.TimeoutExpired:
            process.kill()
            output, _ = process.communicate()
            code = None
    return code, output.splitlines() or [""], time.monotonic() - start


def _keep(runs: Path, records: Path) -> None:
    """Copies what leaderboards are made of, without checkpoints: some hundred kilobytes a run."""
    for record in sorted(runs.rglob("record.json")):
        target = records / record.parent.relative_to(runs)
        target.mkdir(parents=True, exist_ok=True)
        for name in KEPT:
            if (record.parent / name).exists():
                shutil.copy2(record.parent / name, target / name)


def _write(path: Path, value: Any) -> None:
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(value, indent=1) + "\n")
    partial.replace(path)


if __name__ == "__main__":
    sys.exit(main())
