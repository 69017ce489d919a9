"""`suite sweep`: what is refused, what is shown, and real processes that are killed in the middle."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from suite import cli
from suite.commands import sweep as command
from suite.records.record import RunRecord
from suite.runs import sweep
from suite.runs.sweep import Outcome, Process, log_of, plan

# JAX fears for forks of its process; Ray's become other programs at once.
pytestmark = pytest.mark.filterwarnings(r"ignore:os\.fork\(\) was called:RuntimeWarning")

TASKS = "openspiel/tic_tac_toe,openspiel/kuhn_poker"
GRID = ["--tasks", TASKS, "--agents", "random,mfrl_no_rnn", "--seeds", "0-1", "--preset", "smoke"]
ONE = ["--tasks", "openspiel/tic_tac_toe", "--agents", "random", "--preset", "smoke"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Commands run in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(cli.__file__).parents[1]))
    monkeypatch.delenv("RAY_ADDRESS", raising=False)


@pytest.fixture
def suite(capsys):
    """Runs a sweep in this process: its exit code, stdout and stderr."""

    def swept(*words):
        code = cli.main(["sweep", *map(str, words)])
        return code, *capsys.readouterr()

    return swept


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


# What is refused.

BAD = {
    "task": (["--tasks", "openspiel/leduc,minatr/breakout", "--agents", "m5"], "did you mean 'minatar/breakout'?"),
    "agent": (["--tasks", "minatar/*", "--agents", "mfrl,m55"], "unknown agent 'm55'; did you mean 'm5'?"),
    "no task matches": (["--tasks", "minatr/*", "--agents", "m5"], "--tasks: nothing matches 'minatr/*'; valid: craft"),
    "no agent matches": (["--tasks", "minatar/*", "--agents", "x*"], "--agents: nothing matches 'x*'; valid: m1, m2,"),
    "empty": (["--tasks", "", "--agents", "m5"], "unknown task ''"),
    "preset": ([*ONE, "--preset", "tiny"], "openspiel/tic_tac_toe, agent random: unknown preset 'tiny'"),
    "field": ([*ONE, "ppo.gamma=1"], "unknown field 'ppo.gamma'; did you mean 'ppo.discount'?"),
    "misfit": ([*ONE, "ppo.minibatches=3"], "ppo.minibatches=3 must divide environment.num_envs="),
    "steps": ([*ONE, "--steps", "3"], "protocol.steps=3 is less than one iteration"),
    "seeds": ([*ONE, "--seeds", "3-1"], "'3-1' is not of the form"),
    "jobs": ([*ONE, "--jobs", "0"], "--jobs=0: must be at least 1"),
    "retries": ([*ONE, "--retries", "-1"], "--retries=-1: must be at least 0"),
    "gpus": ([*ONE, "--engine", "ray", "--gpus", "-1"], "--gpus=-1: must be at least 0"),
    "no number": ([*ONE, "--engine", "ray", "--gpus", "nan"], "--gpus=nan: must be at least 0"),
    "one and a half": ([*ONE, "--engine", "ray", "--gpus", "1.5"], "--gpus=1.5: Ray gives a part of one, or whole"),
    "GPUs here": ([*ONE, "--gpus", "1"], "--gpus is Ray's: add --engine ray"),
    "address here": ([*ONE, "--address", "auto"], "--address is Ray's: add --engine ray"),
    "engine": ([*ONE, "--engine", "slurm"], "invalid choice: 'slurm'"),
    "out": ([*ONE, "--out", "/dev/null/x"], "cannot write to /dev/null/x: Not a directory; choose another --out"),
    "no tasks": (["--agents", "m5"], "the following arguments are required: --tasks"),
    "option": ([*ONE, "--seed", "3"], "unknown option '--seed'; did you mean '--seeds'?"),
}


def refused(outcome, message):
    """Exit code 2, one line on stderr that holds the message, nothing on stdout, not even a folder."""
    code, out, err = outcome
    assert (code, out) == (2, "")
    assert err.startswith("error: ") and err.count("\n") == 1 and message in err
    assert os.listdir() == []


@pytest.mark.parametrize("name", BAD)
def test_bad_input(suite, monkeypatch, name):
    monkeypatch.setattr(sweep, "Process", None)
    words, message = BAD[name]
    refused(suite(*words), message)


def test_ray_that_is_not_installed(suite, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    refused(suite(*ONE, "--engine", "ray"), "--engine ray needs Ray: pip install 'world-model-suite[ray]'")


def test_ray_that_nobody_answers_for(suite):
    pytest.importorskip("ray")
    code, out, err = suite(*ONE, "--engine", "ray", "--address", "127.0.0.1:1")
    assert (code, out) == (2, "") and "cannot use Ray at 127.0.0.1:1: " in err and err.count("\n") == 1


def test_the_folder_of_another_run(suite, monkeypatch):
    (run,) = plan("openspiel/tic_tac_toe", "random", [1], "smoke")
    with RunRecord.create(run.folder, run.config, sweep.registry.task(run.config.task).spec()):
        pass
    monkeypatch.setattr(sweep, "Process", None)
    code, _, err = suite(*ONE, "--seeds", "0-1", "--steps", 960)
    assert code == 2 and "holds a run with protocol.steps=96, not 960; choose another --out" in err
    assert len(records()) == 1


# What is planned and shown.


def test_patterns_and_ids_give_each_run_once():
    runs = plan("minatar/*,minatar/breakout,openspiel/kuhn_poker", "mfrl,mfrl*", [0, 1], "smoke", ["ppo.clip=0.3"], 960)
    tasks = list(dict.fromkeys(run.config.task for run in runs))
    assert tasks[-1] == "openspiel/kuhn_poker" and len(tasks) == 6
    assert [run.config.agent for run in runs[:8:2]] == ["mfrl", "mfrl_no_rnn", "mfrl_small", "mfrl_prior"]
    assert len(runs) == len({run.folder for run in runs}) == 6 * 4 * 2
    assert {run.status for run in runs} == {"waiting"}
    words = "run minatar/asterix --agent mfrl --preset smoke --seed 1 --out runs --steps 960 ppo.clip=0.3 --json"
    assert " ".join(runs[1].words) == words
    assert runs[1].config.ppo.clip == 0.3


def test_the_table_fits_the_terminal():
    runs = plan("minatar/breakout", "random", range(30), "smoke")
    runs[0].end(Outcome("finished", result={"steps": 64, "seconds": 90.0, "scores": {"return": None}}))
    runs[20].status = "running"
    console = Console(file=io.StringIO(), width=100, color_system=None)
    console.print(command._table(runs, True, 12))
    lines = console.file.getvalue().splitlines()
    assert len(lines) < 12
    assert "return n/a" not in console.file.getvalue()  # what has ended gives way
    assert any(" 20 " in line and "running" in line for line in lines)
    assert lines[-2:] == ["1 finished, 1 running, 28 waiting; 22 not shown", command.STOPPING]


def test_what_was_stopped_before_it_began_still_waits():
    begun, pending = plan("minatar/breakout", "random", [0, 1], "smoke")
    begun.folder.mkdir(parents=True)
    log_of(begun.folder).write_text("--- begun\n")
    for run in (begun, pending):
        run.end(Outcome("stopped"))
    assert (begun.status, pending.status) == ("stopped", "waiting")


def test_the_last_step_of_a_row_that_is_being_written(tmp_path):
    assert sweep.last_step(tmp_path) == 0
    for text, step in {"": 0, "step,x\n": 0, "step,x\n64,1\n": 64, "step,x\n64,1\n128,": 64}.items():
        (tmp_path / "metrics.csv").write_text(text)
        assert sweep.last_step(tmp_path) == step


def test_what_runs_ask_of_ray():
    pytest.importorskip("ray")
    from suite.runs.sweep_ray import _cpus, compute_types

    asked = {((16, 4), None): 2, ((1, 1), None): 1, ((4, 4), 8): 1, ((8,), 3): 2, ((2,), 4): 0.5, ((0,), 3): 2}
    assert {arguments: _cpus(*arguments) for arguments in asked} == asked
    # On CPUs or GPUs, whatever the machine is that asks.
    for gpus, kind in {0: "float32", 0.5: "bfloat16"}.items():
        (run,) = plan("minatar/breakout", "m5", [0], "smoke", compute_types(gpus))
        assert (run.config.policy.compute_type, run.config.world_model.compute_type) == (kind, kind)


# What a run's process comes to. These are real processes, but no runs.


@pytest.fixture
def processed(monkeypatch):
    """Polls a process that executes this program until it has ended; each attempt adds a line to the file "tries"."""

    def outcome(program, retries=None, act=lambda process: None):
        head = "import os, signal, sys, time\nprint('try', file=open('tries', 'a'))\ntries = len(list(open('tries')))\n"
        monkeypatch.setattr(sweep, "LAUNCHER", head + program)
        monkeypatch.setattr(sweep, "AGAIN", 0.1)
        process = Process(["run", "it"], Path("folder"), retries)
        assert process.poll() is None
        act(process)
        return until(process.poll, seconds=60), len(Path("tries").read_text().splitlines())

    return outcome


RESULT = 'print(\'{"status": "finished", "steps": 3}\')'


def test_the_result_is_the_last_object_told(processed):
    found, tries = processed(f"print('{{\"a\": 1}}\\n[2]'); {RESULT}; print('{{}}\\nbye')")
    assert (found, tries) == (Outcome("finished", result={"status": "finished", "steps": 3}), 1)
    assert "suite run it" in log_of(Path("folder")).read_text()


@pytest.mark.parametrize(("retries", "tries"), [(None, 1), (0, 1), (2, 3)])
def test_a_run_that_failed(processed, retries, tries):
    found = processed("print('error: the loss became nan', file=sys.stderr); sys.exit(1)", retries)
    assert found == (Outcome("failed", "the loss became nan"), tries)


def test_bad_input_is_not_tried_again(processed):
    assert processed("sys.exit('x')if 0 else sys.stderr.write('error: no\\n'); sys.exit(2)", 5)[1] == 1


@pytest.mark.parametrize(("retries", "tries"), [(None, 3), (0, 1), (1, 2)])
def test_a_run_that_died(processed, retries, tries):
    found = processed("os.kill(os.getpid(), signal.SIGKILL)", retries)
    assert found == (Outcome("failed", "died of SIGKILL"), tries)


def test_a_run_that_died_once(processed):
    found, tries = processed(f"tries > 1 or os.kill(os.getpid(), signal.SIGKILL); {RESULT}")
    assert (found.status, tries) == ("finished", 2)


def test_a_folder_in_use_is_waited_for(processed, monkeypatch):
    in_use = "sys.stderr.write('error: f is in use by another process (pid 1 on n)\\n'); sys.exit(2)"
    found, tries = processed(f"if tries < 4: {in_use}\n{RESULT}")
    assert (found.status, tries) == ("finished", 4)
    monkeypatch.setattr(sweep, "PATIENCE", 0.0)
    Path("tries").unlink()
    found, tries = processed(in_use)
    assert (found.status, tries) == ("failed", 1) and "in use by another process (pid 1 on n)" in found.reason


def test_stopping_and_killing(processed):
    begun = "open('begun', 'w').close(); time.sleep(60)"

    def act(how):
        until(Path("begun").exists)
        Path("begun").unlink()
        how()

    assert processed(begun, act=lambda process: act(process.stop))[0] == Outcome("stopped")
    deaf = f"signal.signal(signal.SIGTERM, signal.SIG_IGN); {begun}"
    assert processed(deaf, act=lambda process: act(process.kill))[0] == Outcome("stopped")
    polite = f"signal.signal(signal.SIGTERM, lambda *_: os._exit(130)); {begun}"
    assert processed(polite, act=lambda process: act(process.stop))[0] == Outcome("stopped")


# Real runs.


def test_a_sweep_that_was_killed_does_what_is_missing():
    with sweeping(*GRID, "--jobs", "2") as first:
        (cut_off, *_) = until(lambda: finished() and just_begun(), first)
        children = [int(path.name) for path in Path("/proc").glob("[0-9]*") if parent(path.name) == first.pid]
    assert owner(cut_off) in children
    until(lambda: not any(map(alive, children)), seconds=60)  # nobody is there to stop them: they notice themselves
    before = finished()
    assert 1 <= len(before) < 8 and cut_off not in before
    files = snapshot(before)
    with sweeping(*GRID, "--jobs", "2") as second:
        code, runs = finish(second)
    assert code == 0
    assert {folder for folder, run in runs.items() if run["status"] == "already finished"} == before
    assert {folder for folder, run in runs.items() if run["status"] == "finished"} == runs.keys() - before
    assert len(finished()) == len(runs) == 8
    assert snapshot(before) == files
    assert len(records()[cut_off]["resumed"]) == 1
    assert runs[min(before)]["scores"]["episodes"] > 0


def test_an_interrupt_stops_runs_with_checkpoints():
    words = [*ONE, "--jobs", "1", "--steps", "4800", "checkpoint.every_steps=480"]
    with sweeping(*words, "--seeds", "0-1") as first:
        until(lambda: any(sweep.last_step(folder) >= 96 for folder in records()), first)
        first.send_signal(signal.SIGINT)
        code, runs = finish(first)
    stopped, waiting = sorted(runs)
    assert code == 130
    assert [runs[stopped]["status"], runs[waiting]["status"]] == ["stopped", "waiting"]
    assert "1 stopped, 1 waiting; the same command goes on from there\n" in Path("stdout").read_text()
    assert not alive(owner(stopped)) and not waiting.exists()
    record = records()[stopped]
    assert record["status"] == "stopped" and 96 <= record["steps"] == runs[stopped]["steps"] < 4800
    with sweeping(*words, "--seeds", "0") as second:
        assert finish(second)[0] == 0
    assert [again["step"] for again in records()[stopped]["resumed"]] == [record["steps"]]
    assert finished() == {stopped}


def test_a_run_that_fails_does_not_stop_the_others(suite):
    runs = plan("openspiel/tic_tac_toe", "random", [0, 1], "smoke")
    runs[0].folder.mkdir(parents=True)
    (runs[0].folder / "episodes.csv").touch()  # as a run's whose record was lost
    code, out, err = suite(*ONE, "--seeds", "0-1", "--jobs", "1", "--json")
    lines = out.splitlines()
    why = f"{runs[0].folder} already holds episodes.csv; choose another --out"
    assert code == 1
    assert lines[-2] == "1 finished, 1 failed"
    assert lines[-3] == f"openspiel/tic_tac_toe, agent random, seed 0: {why}; see {log_of(runs[0].folder)}"
    failed, done = json.loads(lines[-1])["runs"]
    assert (failed["status"], failed["reason"], failed["scores"]) == ("failed", why, {})
    assert (done["status"], done["steps"], done["seed"]) == ("finished", 96, 1)
    assert "[1/2] openspiel/tic_tac_toe, agent random, seed 0: failed" in err
    assert "[2/2] openspiel/tic_tac_toe, agent random, seed 1: finished, 96/96 steps" in err


@pytest.fixture
def cluster():
    """Ray with two nodes of one CPU each, on this machine."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    sizes = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
    cluster = Cluster(initialize_head=True, head_node_args={**sizes, "include_dashboard": False})
    cluster.add_node(**sizes)
    yield cluster
    cluster.shutdown()


def test_a_cluster_that_loses_a_node_in_the_middle(cluster):
    (node,) = cluster.worker_nodes
    raylet = node.all_processes["raylet"][0].process.pid

    def on_node(folder):
        pid = owner(folder)
        while pid and pid != raylet:
            pid = parent(pid)
        return pid == raylet

    with sweeping(*GRID, "--engine", "ray", "--address", cluster.address) as driver:
        (cut_off, *_) = until(lambda: finished() and list(filter(on_node, just_begun())), driver)
        files = snapshot(finished())
        cluster.remove_node(node, allow_graceful=False)
        code, runs = finish(driver)
    assert code == 0, Path("stdout").read_text()
    assert {run["status"] for run in runs.values()} == {"finished"}
    assert {folder.resolve() for folder in finished()} == runs.keys() and len(runs) == 8
    assert files and snapshot(path.parent for path in files if path.name == "record.json") == files
    assert len(records()[cut_off]["resumed"]) == 1
    assert log_of(cut_off).read_text().count(": suite run ") == 2
