"""`scripts/gpu.py`: its whole path, on a CPU."""

from __future__ import annotations

import importlib.util
import json
import os
from pathlib import Path

import pytest

GAME = "openspiel/tic_tac_toe"


@pytest.fixture(scope="module")
def gpu():
    path = Path(__file__).parent.parent / "scripts" / "gpu.py"
    specification = importlib.util.spec_from_file_location("gpu_script", path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_the_whole_path(gpu, tmp_path, capsys, suite):
    words = ["--minutes", "8", "--preset", "smoke", "--out", tmp_path]
    parts = {
        "tests": ["tests/tokenizers/test_symbols.py"],
        "benches": [(GAME, "mfrl_no_rnn")],
        "runs": [(GAME, "random"), (GAME, "mfrl_no_rnn")],
    }
    assert gpu.main(list(map(str, words)), **parts) == 0, capsys.readouterr().err
    assert "numbers of a CPU" in capsys.readouterr().err
    assert json.loads((tmp_path / "device.json").read_text())["platform"] == "cpu"
    tests = json.loads((tmp_path / "tests.json").read_text())
    assert tests["passed"] > 1 and tests["failed"] == 0 and tests["in_time"]
    phases = json.loads((tmp_path / "bench_openspiel_tic_tac_toe_mfrl_no_rnn.json").read_text())
    assert phases["phases of one iteration"][0]["phase"] == "collect"
    assert "seconds to the first training step" not in phases
    found = sorted(path.parent.relative_to(tmp_path / "records") for path in tmp_path.glob("records/**/record.json"))
    assert [str(path) for path in found] == [f"{GAME}/{agent}/smoke/seed_0" for agent in ("mfrl_no_rnn", "random")]
    assert not list(tmp_path.glob("records/**/checkpoints"))
    code, _, error = suite("publish", tmp_path / "records", "--out", tmp_path / "leaderboards")
    assert code == 2 and error.count("refused") == error.count("preset smoke is for tests") == 2  # found, and read

    # Again: everything is there.
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.json") if path.name != "device.json"}
    assert gpu.main(list(map(str, words)), **parts) == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_a_run_that_the_time_ends_keeps_a_checkpoint_and_goes_on(gpu, tmp_path):
    run = [GAME, "--agent", "random", "--preset", "smoke", "--steps", "20000000", "--out", str(tmp_path)]
    folder = tmp_path / GAME / "random" / "smoke" / "seed_0"

    def go_on(before):
        for _ in range(8):  # a busy machine may not get to the first iteration in time
            assert gpu.train(run, 10.0, dict(os.environ))
            if (folder / "record.json").exists():
                record = json.loads((folder / "record.json").read_text())
                if record["status"] == "stopped" and record["steps"] > before:
                    return record
        raise AssertionError("it never got further")

    first = go_on(0)
    assert len(go_on(first["steps"])["resumed"]) > len(first["resumed"])


def test_a_test_that_fails_and_one_that_takes_too_long(gpu, tmp_path):
    (tmp_path / "test_bad.py").write_text("def test_good(): pass\ndef test_bad(): assert False\n")
    assert not gpu.run_tests(tmp_path / "bad.json", [str(tmp_path / "test_bad.py")], 60.0, dict(os.environ))
    found = json.loads((tmp_path / "bad.json").read_text())
    assert (found["passed"], found["failed"], found["in_time"]) == (1, 1, True)
    (tmp_path / "test_slow.py").write_text("import time\ndef test_slow(): time.sleep(600)\n")
    assert gpu.run_tests(tmp_path / "slow.json", [str(tmp_path / "test_slow.py")], 5.0, dict(os.environ))
    assert json.loads((tmp_path / "slow.json").read_text())["in_time"] is False


def test_minutes_that_are_none(gpu, capsys):
    with pytest.raises(SystemExit) as stop:
        gpu.main(["--minutes", "0"])
    assert stop.value.code == 2 and "must be above 0" in capsys.readouterr().err
