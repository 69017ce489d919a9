"""Runs side by side against numbers computed by hand."""

from __future__ import annotations

import math

import pytest
from matplotlib.figure import Figure
from PIL import Image

from leaderboards.compare import compare, tables
from leaderboards.results import finished_in
from suite import cli
from suite.records.record import RunRecord, run_folder
from suite.registry import resolve, task
from suite.runtime.errors import UserError

savefig = Figure.savefig
SPEC = task("craftax_classic").spec()


@pytest.fixture
def write(tmp_path):
    """Writes a run of 64 steps with an episode in each half: how many achievements each unlocked."""

    def write(agent, seed, halves, finish=True, overrides=(), out="runs"):
        config = resolve("craftax_classic", agent, "smoke", overrides, seed)
        with RunRecord.create(run_folder(tmp_path / out, config), config, SPEC) as record:
            for step, count in zip((32, 64), halves, strict=True):
                unlocked = {name: int(i < count) for i, name in enumerate(SPEC.achievements)}
                row = {"step": step, "return": count - 0.9, "length": 9, "health_return": -0.9, **unlocked}
                record.append_episodes([row | {"achievement_return": float(count)}])
                record.append_metrics({"step": step, "episodes": 1, "return": row["return"]})
            if finish:
                record.finish(64)
        return record.folder

    return write


def test_means_and_errors_over_seeds(write, tmp_path):
    write("m5", 0, (0, 11))
    write("m5", 1, (2, 22))
    write("random", 0, (0, 0))
    write("mfrl", 0, (0, 5), finish=False)
    (found,) = compare(finished_in([tmp_path]), parts=2)
    assert (found.task, found.preset, found.steps) == ("craftax_classic", "smoke", 64)
    assert found.seeds == {"random": 1, "m5": 2}  # in the order of the registry; the unfinished run is left out
    # 50 % and 100 % in the last tenth: 75, and a deviation of 25 sqrt(2) over sqrt(2) seeds.
    assert found.scores["m5"]["reward_percent"] == pytest.approx((75, 25))
    assert found.scores["random"]["reward_percent"][0] == 0 and math.isnan(found.scores["random"]["reward_percent"][1])
    assert found.curve_of == "reward_percent"
    assert found.curve["m5"][0] == pytest.approx((100 / 22, 100 / 22))
    assert found.curve["m5"][1] == pytest.approx((75, 25))


def test_the_command_prints_markdown(write, tmp_path, capsys):
    write("m5", 0, (0, 11))
    write("m5", 1, (2, 22))
    assert cli.main(["compare", str(tmp_path), "--parts", "2", "--score", "reward_percent_with_health"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "craftax_classic, preset smoke, 64 steps"
    assert lines[2] == "| agent | seeds | reward % | reward % with health | score % | minutes |"
    assert lines[4].startswith("| m5 | 2 | 75.00 +- 25.00 | 70.91 +- 25.00 |")
    assert lines[6] == "| reward % with health, steps | to 32 | to 64 |"
    assert lines[8] == "| m5 | 0.455 +- 4.545 | 70.91 +- 25.00 |"


def test_curves_are_drawn(write, tmp_path, suite, monkeypatch):
    write("m5", 0, (0, 11))
    write("m5", 1, (2, 22))
    write("random", 0, (0, 0))
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *args, **kw: drawn.append(self) or savefig(self, *args, **kw))
    path = tmp_path / "curves.png"
    code, out, err = suite("compare", tmp_path, "--plot", path, "--parts", "2")
    assert (code, err) == (0, "") and out.endswith(f"curves {path}\n")
    (axes,) = drawn[0].axes
    random, m5 = axes.lines
    assert (random.get_label(), m5.get_label()) == ("random (1)", "m5 (2)")
    assert m5.get_xdata().tolist() == [32, 64] and m5.get_ydata().tolist() == pytest.approx([100 / 22, 75])
    band = axes.collections[1].get_paths()[0].get_extents()
    assert (band.y0, band.y1) == pytest.approx((0, 100))  # 100 / 22 +- 100 / 22 at first, 75 +- 25 in the end
    assert axes.get_ylabel() == "reward %"
    with Image.open(path) as image:
        assert image.width > 600


@pytest.mark.parametrize(
    ("name", "message"), [("curves", "must end in"), ("curves.csv", ".png"), ("no/curves.png", "no is no folder")]
)
def test_what_cannot_be_drawn(write, tmp_path, suite, monkeypatch, name, message):
    write("m5", 0, (0, 11))
    monkeypatch.chdir(tmp_path)
    code, out, err = suite("compare", "runs", "--plot", name)
    assert (code, out) == (2, "") and message in err and err.count("\n") == 1


def test_protocols_are_kept_apart(write, tmp_path):
    write("m5", 0, (0, 11))
    write("m5", 0, (0, 11), overrides=["protocol.final_fraction=0.5"], out="other")
    assert len(compare(finished_in([tmp_path]))) == 2


def test_what_cannot_be_compared(write, tmp_path):
    with pytest.raises(UserError, match=f"no finished run in {tmp_path}$"):
        finished_in([tmp_path])
    write("m5", 0, (0, 11), finish=False)
    with pytest.raises(UserError, match=r"no finished run in .*; 1 unfinished"):
        finished_in([tmp_path])
    write("mfrl", 0, (0, 11))
    with pytest.raises(UserError, match="craftax_classic has no score 'rewards'"):
        compare(finished_in([tmp_path]), score="rewards")
    write("mfrl", 0, (0, 11), out="other")
    with pytest.raises(UserError, match="are both seed 0 of mfrl: leave one out"):
        compare(finished_in([tmp_path]))


def test_seeds_of_different_settings_are_refused(write, tmp_path):
    write("mfrl", 0, (0, 11))
    write("mfrl", 1, (0, 11), overrides=["ppo.discount=0.5"])
    with pytest.raises(UserError, match="are of mfrl, but with different settings"):
        compare(finished_in([tmp_path]))


def test_numbers_are_written_with_their_error():
    from leaderboards.compare import Comparison

    one = {"a": (0.5, math.nan)}
    scores, curve = tables(
        Comparison("t", "p", 10, {"a": 1}, {"a": {"return": one["a"]}}, one, "return", {"a": [(2.0, 0.1)]})
    )
    assert scores.loc[0, "return"] == "0.500" and curve.iloc[0, 1] == "2.00 +- 0.10"
