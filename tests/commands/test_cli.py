"""The command line: what is printed, and every documented bad input."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from suite import cli, registry
from suite.records.record import RunRecord, run_folder
from suite.registry import resolve, task
from suite.runs import evaluation, training
from suite.runs.training import Result
from suite.runtime.errors import RunError

SMOKE = ["craftax_classic", "--agent", "mfrl", "--preset", "smoke"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Commands run in an empty folder, without XLA's level leaking into other tests."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "3")


@pytest.fixture
def never(monkeypatch):
    """Fails when a command gets as far as to start something."""

    def started(*args, **kwargs):
        raise AssertionError("the command should have been refused")

    monkeypatch.setattr(training, "run", started)
    monkeypatch.setattr(evaluation, "evaluate", started)


def refused(outcome, *words):
    """Exit code 2, one line on stderr that holds these words, nothing on stdout."""
    code, out, err = outcome
    assert code == 2
    assert out == ""
    assert err.startswith("error: ") and err.endswith("\n") and err.count("\n") == 1
    for word in words:
        assert word in err


BAD_RUNS = {
    "task": (["craftax_clasic"], "unknown task 'craftax_clasic'; did you mean 'craftax_classic'?"),
    "agent": (["craftax_classic", "--agent", "m55"], "unknown agent 'm55'; did you mean 'm5'?"),
    "agent far off": (["craftax_classic", "--agent", "zzz"], f"valid: {', '.join(sorted(registry.agents()))}"),
    "preset": (["craftax_classic", "--preset", "papper"], "unknown preset 'papper'; did you mean 'paper'?"),
    "field": ([*SMOKE, "ppo.gamma=1"], "unknown field 'ppo.gamma'; did you mean 'ppo.discount'?"),
    "value": ([*SMOKE, "ppo.clip=wide"], "ppo.clip='wide': input should be a valid number"),
    "large seed": ([*SMOKE, "--seed", str(2**64)], "seed=18446744073709551616: input should be less than 4294967296"),
    "range": ([*SMOKE, "ppo.clip=-1"], "ppo.clip=-1: input should be greater than 0"),
    "misfit": ([*SMOKE, "environment.num_envs=3"], "ppo.minibatches=2 must divide environment.num_envs=3"),
    "no setting": ([*SMOKE, "fast"], "'fast' is no setting"),
    "negative steps": ([*SMOKE, "--steps", "-5"], "protocol.steps=-5: input should be greater than 0"),
    "zero steps": ([*SMOKE, "--steps", "0"], "protocol.steps=0: input should be greater than 0"),
    "few steps": ([*SMOKE, "--steps", "3"], "protocol.steps=3 is less than one iteration of 32 steps"),
    "many steps": ([*SMOKE, "--steps", str(10**30)], f"protocol.steps={10**30}: input should be less than 2147483648"),
    "large": ([*SMOKE, f"ppo.epochs={2**64}"], f"ppo.epochs={2**64}: input should be less than 2147483648"),
    "seeds without end": ([*SMOKE, "--seeds", f"0-{2**64}"], "'0-18446744073709551616' are more than 10,000 seeds"),
    "large seeds": ([*SMOKE, "--seeds", str(2**64)], "seed=18446744073709551616: input should be less than 4294967296"),
    "no number": ([*SMOKE, "--steps", "many"], "argument --steps: invalid int value: 'many'"),
    "seed": ([*SMOKE, "--seed", "-1"], "seed=-1: input should be greater than or equal to 0"),
    "seeds": ([*SMOKE, "--seeds", "0-"], "'0-' is not of the form 0-2 or 0,3,5"),
    "seeds backwards": ([*SMOKE, "--seeds", "3-1"], "'3-1' is not of the form"),
    "seeds of letters": ([*SMOKE, "--seeds", "a,b"], "'a,b' is not of the form"),
    "seeds empty": ([*SMOKE, "--seeds", ""], "'' is not of the form"),
    "seeds of odd digits": ([*SMOKE, "--seeds", "²"], "'²' is not of the form"),
    "seeds and seed": ([*SMOKE, "--seeds", "0-1", "--seed", "3"], "not allowed with argument"),
    "option": ([*SMOKE, "--sed", "3"], "unknown option '--sed'; did you mean '--seed'?"),
    "out": ([*SMOKE, "--out", "/dev/null/x"], "cannot write to /dev/null/x: Not a directory; choose another --out"),
    "nothing to resume": ([*SMOKE, "--resume"], "nothing to resume in runs/craftax_classic/mfrl/smoke/seed_0"),
    "no task": ([], "the following arguments are required: TASK"),
}


@pytest.mark.parametrize("name", BAD_RUNS)
def test_bad_runs(suite, never, name):
    words, message = BAD_RUNS[name]
    refused(suite("run", *words), message)
    assert os.listdir() == []  # not even a folder


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "required: COMMAND"),
        (["rum"], "unknown command 'rum'; did you mean 'run'?"),
        (["list", "task"], "cannot list 'task'; did you mean 'tasks'?"),
        (["list"], "required: tasks|agents|presets"),
        (["describe", "craftax"], "unknown task 'craftax'; did you mean 'craftax_full'?"),
        (["describe", "craftax_classic", "--agent", "m5x"], "unknown agent 'm5x'; did you mean 'm5'?"),
        (["describe", "craftax_classic", "tokenizer.patch=[70,5]"], "patches of 70x5 are larger than a frame of 63x63"),
        (["bench", "craftax_classic", "--preset", "x"], "unknown preset 'x'; valid: medium, paper, small, smoke"),
        (["evaluate", "nowhere"], "nowhere is no run folder: it has no record.json"),
        (["evaluate", "."], ". is no run folder"),
        (["evaluate", ".", "more"], "unexpected argument 'more'"),
        (["evaluate", ".", "--episodes", "0"], "argument --episodes: '0' is no whole number from 1 to 2,147,483,647"),
        (["evaluate", "/dev/null"], "record.json"),
        (["inspect"], "required: RUN_DIR"),
        (["inspect", "nowhere"], "nowhere is no run folder: it has no record.json"),
        (["inspect", ".", "--games", "0"], "argument --games: '0' is no whole number from 1 to 1,000,000"),
        (["inspect", ".", "--games", "9" * 5000], "is no whole number from 1 to 1,000,000"),
        (["watch", ".", "--seed", str(2**64)], "'18446744073709551616' is no whole number from 0 to 4,294,967,295"),
        (["compare", ".", "--parts", "1e9"], "argument --parts: '1e9' is no whole number from 1 to 10,000"),
        (["verify", ".", "--runs", "-1"], "argument --runs: '-1' is no whole number from 1 to "),
        (["inspect", ".", "--game", "3"], "unknown option '--game'; did you mean '--games'?"),
    ],
)
def test_bad_commands(suite, never, words, message):
    refused(suite(*words), message)
    assert os.listdir() == []


def test_inspecting_a_run_without_a_world_model(suite, folder):
    refused(suite("inspect", str(folder)), f"{folder} has no world model: mfrl learns from real play only")


@pytest.fixture
def folder():
    """The record of a run that was begun."""
    config = resolve("craftax_classic", "mfrl", "smoke")
    with RunRecord.create(run_folder(Path("runs"), config), config, task("craftax_classic").spec()) as record:
        pass
    return record.folder


def test_a_run_folder_of_another_configuration(suite, never, folder):
    before = sorted(Path().rglob("*"))
    refused(suite("run", *SMOKE, "ppo.clip=0.3"), "holds a run with ppo.clip=0.2, not 0.3; choose another --out")
    refused(suite("run", *SMOKE, "--steps", 96), "holds a run with protocol.steps=64, not 96")
    assert sorted(Path().rglob("*")) == before


def test_the_last_seeds_folder_is_checked_before_the_first_ones_run(suite, never, folder):
    folder.rename(folder.with_name("seed_2"))
    refused(suite("run", *SMOKE, "--seeds", "1-2"), "holds a run with seed=0, not 2")


@pytest.mark.parametrize(
    ("content", "message"), [('{"schema": 0}', "schema 0; this version reads 1"), ("{", "record.json is damaged")]
)
def test_a_run_folder_that_cannot_be_read(suite, never, folder, content, message):
    (folder / "record.json").write_text(content)
    refused(suite("run", *SMOKE), message)
    refused(suite("evaluate", folder), message)


def test_a_run_folder_in_use(suite, folder):
    with RunRecord.open(folder):
        code, _, err = suite("run", *SMOKE)
        assert code == 75 and f"{folder} is in use by another process (pid {os.getpid()}" in err
        code, _, err = suite("evaluate", folder)
        assert code == 75 and "in use by another process" in err


def test_evaluating_without_a_checkpoint(suite, folder):
    refused(suite("evaluate", folder, "--quiet"), "has no checkpoint")


# What is printed.

SCORES = {
    "reward_percent": 10.0,
    "reward_percent_with_health": 5.5,
    "score_percent": 1.25,
    "episodes": 12,
    "final_episodes": 3,
    "success_percent/wake_up": 50.0,
}


@pytest.fixture
def fake_run(monkeypatch):
    """Replaces training; seed n scores n more. The calls so far, and what was put in place."""
    calls = []

    def result(config, out, reporter, resume, callbacks, wandb, devices, status="finished", scores=SCORES):
        calls.append((config, out, resume))
        scores = {name: value + config.seed for name, value in scores.items()}
        folder = run_folder(out, config)
        RunRecord.open_or_create(folder, config, task(config.task).spec()).close()
        return Result(folder, status, config.total_steps, 1.5, scores)

    monkeypatch.setattr(training, "run", result)
    return calls, result


def test_run_prints_scores_and_the_record(suite, fake_run):
    code, out, err = suite("run", *SMOKE, "--out", "there")
    assert (code, err) == (0, "")
    folder = "there/craftax_classic/mfrl/smoke/seed_0"
    assert out.splitlines() == [
        f"craftax_classic, agent mfrl, preset smoke, seed 0, on {os.cpu_count()} CPU cores; files in {folder}",
        "reward 10 %",
        "reward with health 5.50 %",
        "score 1.25 %",
        "episodes 12",
        "final episodes 3",
        f"record {folder}",
    ]


def test_json_is_one_object_on_the_last_line(suite, fake_run):
    _, out, _ = suite("run", *SMOKE, "--json", "--quiet")
    assert json.loads(out.splitlines()[-1]) == {
        "task": "craftax_classic",
        "agent": "mfrl",
        "preset": "smoke",
        "seed": 0,
        "status": "finished",
        "steps": 64,
        "seconds": 1.5,
        "folder": "runs/craftax_classic/mfrl/smoke/seed_0",
        "scores": SCORES,
    }


def test_seeds_give_mean_and_standard_error(suite, fake_run):
    code, out, _ = suite("run", *SMOKE, "--seeds", "0-1,3", "--quiet", "--json")
    assert code == 0
    assert [config.seed for config, *_ in fake_run[0]] == [0, 1, 3]
    lines = out.splitlines()
    # Seeds score 10, 11, 13: mean 11.33, standard deviation 1.53, of which 1/sqrt(3).
    assert lines[-7:-5] == ["3 seeds, mean +- standard error:", "reward 11.33 % +- 0.882 %"]
    last = json.loads(lines[-1])
    assert last["mean"]["reward_percent"] == pytest.approx(34 / 3)
    assert last["standard_error"]["reward_percent"] == pytest.approx((7 / 3 / 3) ** 0.5)
    assert [one["seed"] for one in last["runs"]] == [0, 1, 3]


def test_no_episode_yet_is_said_and_null(suite, fake_run, monkeypatch):
    nan = float("nan")
    result = fake_run[1]
    none = {"reward_percent": nan, "score_percent": nan, "episodes": 0}
    monkeypatch.setattr(training, "run", lambda *args, **options: result(*args, **options, scores=none))
    _, out, _ = suite("run", *SMOKE, "--quiet", "--json")
    lines = out.splitlines()
    assert lines[:2] == ["reward n/a, no episode ended yet", "score n/a, no episode ended yet"]
    assert json.loads(lines[-1])["scores"] == {"reward_percent": None, "score_percent": None, "episodes": 0}
    early = {"reward_percent": nan, "score_percent": 3.0, "episodes": 4}
    monkeypatch.setattr(training, "run", lambda *args, **options: result(*args, **options, scores=early))
    _, out, _ = suite("run", *SMOKE, "--seeds", "0-1", "--quiet", "--json")
    lines = out.splitlines()
    assert lines[:2] == ["reward n/a, no episode ended in the part that counts", "score 3 %"]
    assert lines[-4:-2] == ["reward n/a", "score 3.50 % +- 0.5 %"]
    assert "nan" not in out.lower()
    assert json.loads(lines[-1])["mean"]["reward_percent"] is None


def test_a_stopped_run_stops_the_seeds(suite, fake_run, monkeypatch):
    result = fake_run[1]
    monkeypatch.setattr(training, "run", lambda *args, **options: result(*args, **options, status="stopped"))
    code, out, _ = suite("run", *SMOKE, "--seeds", "0-4", "--quiet")
    assert code == 130
    assert len(fake_run[0]) == 1
    assert out.startswith("stopped at step 64; the same command goes on from there\n")
    assert "standard error" not in out


def test_resume_insists_on_what_was_begun_only(suite, fake_run, folder):
    suite("run", *SMOKE, "--seeds", "0-1", "--resume", "--quiet")
    assert [resume for *_, resume in fake_run[0]] == [True, False]


def test_a_run_that_cannot_go_on_exits_with_1(suite, monkeypatch):
    def diverge(*args, **options):
        raise RunError("loss became nan\nin phase learn")

    monkeypatch.setattr(training, "run", diverge)
    code, _, err = suite("run", *SMOKE, "--quiet")
    assert (code, err) == (1, "error: loss became nan in phase learn\n")


def test_an_interrupt_exits_with_130(suite, monkeypatch):
    def interrupt(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "run", interrupt)
    assert suite("run", *SMOKE, "--quiet")[0] == 130


def test_settings_before_and_after_options(suite, fake_run):
    suite("run", "craftax_classic", "ppo.clip=0.3", "--preset", "smoke", "ppo.epochs=2", "--quiet", "ppo.discount=0.5")
    ppo = fake_run[0][0][0].ppo
    assert (ppo.clip, ppo.epochs, ppo.discount) == (0.3, 2, 0.5)


def test_evaluate_prints_scores(suite, folder, monkeypatch):
    found = {"step": 64, "episodes": 4, "reward_percent": 2.5, "success_percent/wake_up": 0.0}
    monkeypatch.setattr(evaluation, "evaluate", lambda folder, episodes, reporter: found | {"episodes": episodes})
    code, out, _ = suite("evaluate", folder, "--episodes", 7, "--json")
    assert code == 0
    *lines, last = out.splitlines()
    assert lines == ["step 64", "episodes 7", "reward 2.50 %", f"record {folder}"]
    assert json.loads(last) == {"folder": str(folder), **found, "episodes": 7}


def test_lists(suite):
    assert "craftax_classic" in suite("list", "tasks")[1]
    assert "reward 69.66 +- 1.20 %" in suite("list", "agents")[1]
    presets = suite("list", "presets")[1]
    assert [line.split()[0] for line in presets.splitlines()] == ["paper", "medium", "small", "smoke"]
    assert json.loads(suite("list", "agents", "--json")[1]).keys() == registry.agents().keys()


def test_describe_prints_everything(suite):
    code, out, err = suite("describe", "craftax_classic", "--agent", "m5", "--preset", "paper", "ppo.clip=0.3")
    assert (code, err) == (0, "")
    assert re.search(r"ppo\.clip +0\.3 +user\n", out)
    assert "Policy: 55,599,768 parameters\n" in out and "World model: 1,699,972 parameters\n" in out
    assert "Total: 58,503,964 = policy 55,599,768 + world model 1,699,972 + 2 x codebook 602,112" in out
    assert re.search(r"first imagination +202,752 ", out) and re.search(r"iterations +217 ", out)
    _, out, _ = suite("describe", "craftax_classic", "--preset", "paper", "--json")
    assert json.loads(out)["derived"]["imagined policy updates"] == 174 * 150


def test_describe_random(suite):
    code, out, _ = suite("describe", "craftax_classic", "--agent", "random", "--preset", "smoke")
    assert code == 0 and "Total: 0\n" in out


def python(code, **environment):
    env = {name: value for name, value in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"} | environment
    env["PYTHONPATH"] = str(Path(cli.__file__).parents[1])
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)


def test_lists_and_typos_do_not_wait_for_jax():
    done = python(
        "import sys; from suite.cli import main\n"
        "assert main(['list', 'tasks']) == 0 and main(['list', 'agents']) == 0\n"
        "assert main(['run', 'craftax_clasic']) == 2 and main(['run', 'craftax_classic', 'ppo.gama=1']) == 2\n"
        "assert not {'jax', 'pandas', 'rich'} & sys.modules.keys()\n"
    )
    assert done.returncode == 0, done.stderr


def test_a_broken_pipe_is_no_traceback():
    command = f"{sys.executable} -m suite.cli describe craftax_classic --preset smoke --agent random | head -c 1"
    env = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[1])}
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, env=env)
    assert done.stderr == ""


def test_the_version(suite):
    from importlib.metadata import version

    assert suite("--version") == (0, f"suite {version('world-model-suite')}\n", "")


SWITCHES = {
    "JAX_ENABLE_X64": ("1", "False"),
    "JAX_DEBUG_NANS": ("maybe", "0"),
    "JAX_DISABLE_JIT": ("on", "off"),
    "JAX_TRANSFER_GUARD": ("disallow", "allow"),
    "JAX_THREEFRY_PARTITIONABLE": ("0", "1"),
    "JAX_RANDOM_SEED_OFFSET": ("7", "0"),
    "JAX_DEFAULT_PRNG_IMPL": ("rbg", "threefry2x32"),
    "JAX_DEFAULT_MATMUL_PRECISION": ("bfloat16", "highest"),
}


@pytest.mark.parametrize("variable", SWITCHES)
def test_other_arithmetic_is_refused(suite, never, monkeypatch, variable):
    wrong, right = SWITCHES[variable]
    monkeypatch.setenv(variable, wrong)
    refused(suite("run", *SMOKE), f"{variable}={wrong} is set in the environment", "unset it")
    monkeypatch.setenv(variable, right)
    with pytest.raises(AssertionError, match="should have been refused"):
        suite("run", *SMOKE)


def test_other_arithmetic_of_a_program_is_refused(suite, never):
    import jax

    with jax.enable_x64(True):
        refused(suite("run", *SMOKE), "jax.config.jax_enable_x64 is True")


@pytest.mark.parametrize(
    ("variable", "asked"), [("JAX_PLATFORMS", "cuda"), ("JAX_PLATFORMS", "nothing"), ("JAX_PLATFORM_NAME", "cuda")]
)
def test_a_kind_of_device_that_is_not_there(variable, asked):
    """In a process of its own, whose JAX has no device yet; and `python -m suite` is the command."""
    words = [sys.executable, "-m", "suite", "run", *SMOKE]
    environment = {name: value for name, value in os.environ.items() if name != "JAX_PLATFORMS"} | {variable: asked}
    ran = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    refused((ran.returncode, ran.stdout, ran.stderr), f"no device for {variable}={asked}; this machine has: ", "cpu")


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_completion_in_a_shell(suite):
    code, script, err = suite("--print-completion", "bash")
    assert (code, err) == (0, "")
    ask = 'COMP_WORDS=({}); COMP_CWORD={}; _shtab_suite; echo "${{COMPREPLY[@]}}"\n'
    asked = [("suite ver", "verify"), ("suite run openspiel/l", "openspiel/leduc"), ("suite run x --ag", "--agent")]
    script += "".join(ask.format(words, len(words.split()) - 1) for words, _ in asked)
    found = subprocess.run(["bash"], input=script, capture_output=True, text=True, check=True).stdout
    assert found.splitlines() == [expected for _, expected in asked]
    for words in ((), ("fish",), ("bash", "zsh")):
        code, out, err = suite("--print-completion", *words)
        assert (code, out, err) == (2, "", "error: --print-completion takes one of bash, zsh, tcsh\n")
