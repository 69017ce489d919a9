"""`suite sweep`: what is refused, what is shown, and real processes that are killed in the middle."""

from __future__ import annotations

import io
import json
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest
from rich.console import Console

from suite import cli
from suite.commands import sweep as command
from suite.records.record import RunRecord
from suite.runs import places, sweep
from suite.runs.sweep import Outcome, Process, log_of, plan
from suite.runtime.errors import UserError
from tests.runs.sweeping import (
    GRID,
    alive,
    finish,
    finished,
    just_begun,
    owner,
    parent,
    records,
    snapshot,
    sweeping,
    until,
)

# JAX fears for forks of its process; Ray's become other programs at once.
pytestmark = [
    pytest.mark.usefixtures("elsewhere"),
    pytest.mark.filterwarnings(r"ignore:os\.fork\(\) was called:RuntimeWarning"),
]

ONE = ["--tasks", "openspiel/tic_tac_toe", "--agents", "random", "--preset", "smoke"]


@pytest.fixture
def suite(capsys):
    """Runs a sweep in this process: its exit code, stdout and stderr."""

    def swept(*words):
        code = cli.main(["sweep", *map(str, words)])
        return code, *capsys.readouterr()

    return swept


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
    "jobs": ([*ONE, "--jobs", "0"], "argument --jobs: '0' is no whole number from 1 to "),
    "retries": ([*ONE, "--retries", "-1"], "argument --retries: '-1' is no whole number from 0 to "),
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
    code, _, err = suite(*ONE, "--seeds", "0-1", "--steps", 64)
    assert code == 2 and "holds a run with protocol.steps=96, not 64; choose another --out" in err
    assert len(records()) == 1


def test_finished_runs_are_given_more_steps():
    (run,) = plan("openspiel/tic_tac_toe", "random", [0], "smoke")
    with RunRecord.create(run.folder, run.config, sweep.registry.task(run.config.task).spec()) as record:
        record.append_metrics({"step": 96, "episodes": 0})
        record.finish(96)
    assert [run.status for run in plan("openspiel/tic_tac_toe", "random", [0], "smoke")] == ["already finished"]
    with pytest.raises(UserError, match="did not keep what more steps need"):
        plan("openspiel/tic_tac_toe", "random", [0], "smoke", steps=960)
    (run.folder / "checkpoints" / "step_000000000096" / "resume").mkdir(parents=True)
    assert [run.status for run in plan("openspiel/tic_tac_toe", "random", [0], "smoke", steps=960)] == ["waiting"]


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


def test_commas_in_brackets_belong_to_an_id():
    games = ["openspiel/mnk(m=3,n=3,k=2)", "openspiel/start_at(game=mnk(m=2,n=2),history=0)", "x(", "y"]
    assert list(sweep._words(",".join(games[:2]))) == games[:2]
    assert list(sweep._words(",".join(games))) == [*games[:2], "x(,y"]
    assert list(sweep._words("a,,b,")) == ["a", "", "b", ""]


def test_the_table_fits_the_terminal():
    runs = plan("minatar/breakout", "random", range(30), "smoke")
    runs[0].end(Outcome("finished", result={"steps": 64, "seconds": 90.0, "scores": {"return": None}}))
    runs[20].status = "running"
    console = Console(file=io.StringIO(), width=100, color_system=None)
    console.print(command.status_table(runs, True, 12))
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
    from suite.runs.sweep_ray import compute_types, cpus_per_run

    asked = {((16, 4), None): 2, ((1, 1), None): 1, ((4, 4), 8): 1, ((8,), 3): 2, ((2,), 4): 0.5, ((0,), 3): 2}
    assert {arguments: cpus_per_run(*arguments) for arguments in asked} == asked
    # On CPUs or GPUs, whatever the machine is that asks.
    for gpus, kind in {0: "float32", 0.5: "bfloat16"}.items():
        (run,) = plan("minatar/breakout", "m5", [0], "smoke", compute_types(gpus))
        assert (run.config.policy.compute_type, run.config.world_model.compute_type) == (kind, kind)


# Where they go on.


@pytest.mark.parametrize(
    ("waiting", "jobs", "devices", "gpus", "share"),
    [
        (9, None, None, ["4", "5", "6", "7"], ""),
        (2, None, None, ["4,5", "6,7"], ""),
        (1, None, None, ["4,5,6,7"], ""),
        (9, 3, None, ["4", "5", "6"], ""),
        (9, 8, None, ["4", "5", "6", "7"] * 2, "0.45"),
        (9, None, 2, ["4,5", "6,7"], ""),
        (9, None, 3, ["4,5,6"], ""),
        (9, None, "all", ["4,5,6,7"], ""),
        (9, 2, "all", ["4,5,6,7"] * 2, "0.45"),
    ],
)
def test_runs_have_gpus_of_their_own_while_there_are_enough(monkeypatch, waiting, jobs, devices, gpus, share):
    monkeypatch.setattr(places, "device_kind", lambda: "gpu")
    monkeypatch.setattr(jax, "local_devices", lambda: [SimpleNamespace(local_hardware_id=n) for n in range(4, 8)])
    found = places.places(waiting, jobs, devices)
    # Which are variables that this JAX knows; what they hold is part of what CUDA_VISIBLE_DEVICES leaves.
    assert {"jax_cuda_visible_devices", "jax_rocm_visible_devices"} <= set(jax.config.values)
    for variable in ("JAX_CUDA_VISIBLE_DEVICES", "JAX_ROCM_VISIBLE_DEVICES"):
        assert [place[variable] for place in found] == gpus
    assert {place.get("XLA_PYTHON_CLIENT_MEM_FRACTION", "") for place in found} == {share}


def test_a_run_that_ends_leaves_its_place_to_the_next(monkeypatch):
    monkeypatch.setattr(sweep, "PAUSE", 0.0)
    runs = plan("openspiel/tic_tac_toe", "random", range(5), "smoke")
    began, going = [], set()

    class Ends:
        def __init__(self, run, place):
            self.name, self.left = place["NAME"], 1 + run.config.seed % 3
            assert self.name not in going
            going.add(self.name)
            began.append(self.name)

        def poll(self):
            self.left -= 1
            if self.left:
                return None
            going.remove(self.name)
            return Outcome("finished", result={"steps": 1, "seconds": 0.0, "scores": {}})

    sweep.sweep(runs, Ends, [{"NAME": "a"}, {"NAME": "b"}])
    assert {run.status for run in runs} == {"finished"} and not going
    assert began[:2] == ["a", "b"] and set(began[2:]) == {"a", "b"}


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
    in_use = "sys.stderr.write('error: f is in use by another process (pid 1 on n)\\n'); sys.exit(75)"
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
    with sweeping(*GRID, "--seeds", "0-1", "--jobs", "2") as first:
        (cut_off, *_) = until(lambda: finished() and just_begun(), first)
        children = [int(path.name) for path in Path("/proc").glob("[0-9]*") if parent(path.name) == first.pid]
    assert owner(cut_off) in children
    until(lambda: not any(map(alive, children)), seconds=60)  # nobody is there to stop them: they notice themselves
    before = finished()
    assert 1 <= len(before) < 4 and cut_off not in before
    files = snapshot(before)
    with sweeping(*GRID, "--seeds", "0-1", "--jobs", "2") as second:
        code, runs = finish(second)
    assert code == 0
    assert {folder for folder, run in runs.items() if run["status"] == "already finished"} == before
    assert {folder for folder, run in runs.items() if run["status"] == "finished"} == runs.keys() - before
    assert len(finished()) == len(runs) == 4
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


def test_the_reason_is_the_error_and_not_what_a_library_says_after_it(tmp_path):
    log_of(tmp_path).write_text("  0% | start\nerror: disk full: free some space\nTraceback\nRuntimeError: closed\n")
    outcome = Process(["run"], tmp_path)._ended(1)
    assert (outcome.status, outcome.reason) == ("failed", "disk full: free some space")
