"""`suite inspect` of single-agent runs, on the corridor: the evaluation set, the extractor, tables and pictures."""

from __future__ import annotations

import dataclasses
import io

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from flax import nnx
from PIL import Image

from suite import registry
from suite.agent.phases import Agent
from suite.diagnostics import evaluation_set, filmstrips, inspection, rollouts, symbols
from suite.diagnostics.evaluation_set import Pairs, WithSymbols
from suite.records import checkpoint
from suite.records.record import RunRecord, run_folder
from suite.registry import Lazy
from suite.runs.saved_model import SavedModel, agent_for, restore
from suite.runtime.errors import UserError
from suite.runtime.reporting import QuietReporter
from suite.world_model.history import History, ages_of
from tests.tiny import CORRIDOR, PENNIES, Corridor

QUIET = QuietReporter()
MODULE = "tests.diagnostics.test_inspection"


def corridor_symbols(state):
    """Where the walker is, and where not: next to him, ahead."""
    return jnp.stack([state.position, (state.position + 1) % 4])


KNOWN = dataclasses.replace(CORRIDOR, symbols=Lazy(f"{MODULE}:corridor_symbols"), symbol_values=4)
UNKNOWN = dataclasses.replace(CORRIDOR, id="unknown", family="unknown")


@pytest.fixture(autouse=True, scope="module")
def tasks(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "TASKS", (KNOWN, UNKNOWN, PENNIES))
        patch.setenv("SUITE_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def collected():
    config = registry.resolve("corridor", "mfrl", "smoke")
    return evaluation_set.collect(Agent(config, WithSymbols(Corridor(), corridor_symbols)), 40, QUIET)


def begun(out, task, agent):
    """The folder of a run that has not come far."""
    config = registry.resolve(task, agent, "smoke")
    with RunRecord.create(run_folder(out, config), config, registry.task(task).spec()) as record:
        return record.folder


def untrained(out, task, agent):
    """The folder of a run with a checkpoint, made in seconds: the codebook has all there is to see, and no more."""
    folder = begun(out, task, agent)
    state = agent_for(registry.resolve(task, agent, "smoke"), QUIET).init(jax.random.key(0))
    tokenizer = state.tokenizer
    if agent != "m5_continuous":
        codes_KP = jnp.zeros_like(tokenizer.codes_KP).at[1].set(255)
        tokenizer = dataclasses.replace(tokenizer, codes_KP=codes_KP, count=jnp.int32(2))
        with RunRecord.open(folder) as record:
            record.append_metrics({"step": 32, "tokenizer/codes": 2.0})
    model = SavedModel.of(dataclasses.replace(state, tokenizer=tokenizer))
    checkpoint.save(folder / "checkpoints", 32, model, {}, {})
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs")
    return [untrained(out, "corridor", agent) for agent in ("m5", "m5_continuous")]


def places(frames):
    """Where the corner of frames [..., 4, 4, 1] is white."""
    return frames[..., ::2, ::2, 0].reshape(*frames.shape[:-3], 4).argmax(-1)


def test_the_evaluation_set(collected):
    real, pairs = collected
    count, steps = real.action.shape
    assert (count, steps) == (12, 8)  # half of six iterations' four rollouts, each of eight steps
    assert real.frames.shape == (12, 9, 4, 4, 1) and real.symbols.shape == (12, 8, 2)
    place, after = places(real.frames[:, :-1]), places(real.frames[:, 1:])
    moved = np.clip(place + 2 * real.action - 1, 0, 3)
    same_episode = ~real.ended
    assert real.ended.any() and same_episode.any()
    assert (moved == after)[same_episode].all()  # an action leads from its frame to the next
    assert (real.symbols[..., 0] == moved).all()  # also of the frame that an episode ends with
    assert (real.terminated == (moved == 3)).all() and (real.reward == real.terminated).all()
    assert (real.symbols[..., 1] == (moved + 1) % 4).all()
    ended_before = np.array([[row[:t].any() for t in range(steps)] for row in real.ended])
    assert (real.counted == ~ended_before).all()
    assert (real.frame_counted == ~(ended_before | real.ended)).all()

    assert len(pairs.frames) == len(pairs.symbols) == 40
    assert (places(pairs.frames) == pairs.symbols[:, 0]).all()
    assert 0 < pairs.validation.sum() < 40


def test_it_is_built_once(monkeypatch):
    real = evaluation_set.load("corridor", "smoke", QUIET)
    extractor = symbols.load("corridor", "smoke", QUIET)
    monkeypatch.setattr(evaluation_set, "_build", None)
    monkeypatch.setattr(symbols, "train", None)
    again = evaluation_set.load("corridor", "smoke", QUIET)
    assert all((getattr(again, name) == value).all() for name, value in vars(real).items())
    stored = symbols.load("corridor", "smoke", QUIET)
    assert stored.accuracy == extractor.accuracy
    assert (stored(real.frames) == extractor(real.frames)).all()
    folder = evaluation_set.cache_folder("corridor", "smoke")
    assert sorted(path.name for path in folder.iterdir()) == ["extractor-1.npz", "pairs.npz", "trajectories.npz"]
    assert folder != evaluation_set.cache_folder("unknown", "smoke")


@pytest.mark.parametrize("name", ["trajectories.npz", "pairs.npz"])
def test_what_is_broken_is_built_again(monkeypatch, name):
    evaluation_set.load("corridor", "smoke", QUIET)
    path = evaluation_set.cache_folder("corridor", "smoke") / name
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    monkeypatch.setattr(evaluation_set, "_build", lambda *arguments: path.write_bytes(whole))
    load = evaluation_set.load if name == "trajectories.npz" else evaluation_set.load_pairs
    assert len(load("corridor", "smoke", QUIET).frames) > 0
    assert path.read_bytes() == whole


def test_the_extractor_learns(collected):
    place = np.random.default_rng(0).integers(0, 4, 400)
    frames = np.kron(np.eye(4, dtype=np.uint8)[place].reshape(-1, 2, 2, 1), np.full((1, 2, 2, 1), 255, np.uint8))
    pairs = Pairs(frames, np.stack([place, (place + 1) % 4], -1).astype(np.int32), np.arange(400) >= 300)
    extractor = symbols.train(pairs, KNOWN.spec().observation, 4, 100, QUIET)
    assert extractor.accuracy == 1
    real, _ = collected
    assert (extractor(real.frames[:, 1:])[real.frame_counted] == real.symbols[real.frame_counted]).all()
    shuffled = dataclasses.replace(pairs, symbols=np.random.default_rng(1).permutation(pairs.symbols))
    assert symbols.train(shuffled, KNOWN.spec().observation, 4, 100, QUIET).accuracy < 0.5


def test_the_paper_s_network():
    spec = registry.Lazy("adapters.craftax.task:CLASSIC_SPEC")().observation
    network = symbols.nnx.eval_shape(lambda: symbols.Network(spec, 145, 17, symbols.nnx.Rngs(0)))
    assert network.first.kernel.shape == (7 * 7 * 3, 128) and network.second.kernel.shape == (128, 128)
    assert network.last.kernel.shape == (81 * 128, 2465)


def test_two_runs_side_by_side(runs, tmp_path):
    found = inspection.inspect(runs, tmp_path / "out", QUIET)
    out = tmp_path / "out"
    assert found["folder"] == str(out) and list(found["runs"]) == ["m5", "m5_continuous"]
    steps, summary = pd.read_csv(out / "steps.csv"), pd.read_csv(out / "summary.csv")
    assert steps.run.tolist() == ["m5"] * 8 + ["m5_continuous"] * 8  # they learn from sequences of four
    assert steps.step.tolist() == [*range(1, 9)] * 2
    assert summary.set_index("run").error.to_dict() == {
        name: pytest.approx(row["error"]) for name, row in found["runs"].items()
    }
    assert {"symbols_percent", "real_symbols_percent", "reward_percent", "termination_probability"} <= set(steps)
    # Patches that are not quantized lose nothing, and a code for white and one for black are all that frames need.
    assert summary.tokenizer_error.tolist() == [0, 0]
    assert found["runs"]["m5"]["codes_used"] == 2 and "codes_used" not in found["runs"]["m5_continuous"]
    assert set(pd.read_csv(out / "codes.csv").run) == {"m5"}
    pictures = sorted(path.name for path in out.glob("*.png"))
    assert pictures[:3] == ["codes-m5.png", "curves.png", "filmstrip.png"] and len(pictures) > 3
    with Image.open(out / "filmstrip.png") as strip:
        said = strip.info["Description"]
        assert strip.size == (6 * 60 + 5 * 2, 3 * 60 + 2 * 2)  # frames of 4x4, fifteen times as large, one row a run
    assert said.startswith("corridor, trajectory ") and said.endswith("from above real, m5, m5_continuous.")
    for path in out.iterdir():
        if path.suffix == ".gif":
            with Image.open(path) as film:
                assert film.n_frames == 6  # no episode of the corridor here goes on for more than five steps
        elif path.suffix == ".png":
            with Image.open(path) as image:
                assert len(image.convert("RGB").getcolors(2**24)) > 2  # not blank


def strip_of(frames, runs=("m5",)):
    return filmstrips.Strip("Trajectory 3.", frames, dict.fromkeys(runs, frames[1:]), [], (7, 7), 255)


def test_a_small_filmstrip_is_of_the_frames():
    """Every second one of ten steps; those of a run that ended early are missing."""
    colors = np.random.default_rng(0).integers(0, 256, (11, 9, 9, 3), np.uint8)
    colors[:, :, :, 1:] //= 128  # few enough for a palette
    frames = (colors // 64 * 64).repeat(7, 1).repeat(7, 2)
    strip = dataclasses.replace(strip_of(frames), imagined={"m5": frames[:5]})
    with Image.open(io.BytesIO(filmstrips.small_filmstrip(strip))) as image:
        shown = np.asarray(image.convert("RGB"))
        assert image.info["Description"].endswith("steps 0, 2, 4, 6, 8, 10; from above real, m5.")
    assert shown.shape == (2 * 63 + 2, 6 * 63 + 5 * 2, 3)
    for i, t in enumerate((0, 2, 4, 6, 8, 10)):
        real, imagined = (shown[top : top + 63, 65 * i : 65 * i + 63] for top in (0, 65))
        assert (real == frames[t]).all()
        assert (imagined == (frames[max(t - 1, 0)] if t <= 5 else 255)).all()


def test_a_small_filmstrip_stays_small():
    """The worst that a page can be given: noise, of seven rows."""
    frames = np.random.default_rng(0).integers(0, 256, (11, 63, 63, 3), np.uint8)
    content = filmstrips.small_filmstrip(strip_of(frames, [f"m{i}" for i in range(1, 7)]))
    assert 10_000 < len(content) <= filmstrips.SMALL_BYTES


def test_a_small_filmstrip_has_the_first_run_of_each_agent(runs, tmp_path):
    records = [RunRecord.open(folder, lock=False) for folder in (runs[0], runs[0], runs[1])]
    real = evaluation_set.load("corridor", "smoke", QUIET)
    nothing = np.zeros(real.action.shape)
    same = rollouts.Rollouts(real.frames[:, 1:], nothing, nothing, real.frames, nothing, nothing, None)
    names = ["m5 seed 0", "m5 seed 1", "m5_continuous seed 0"]
    inspection._write_strips(tmp_path, real, dict.fromkeys(names, same), records)
    with Image.open(tmp_path / "filmstrip.png") as strip:
        assert strip.info["Description"].endswith("; from above real, m5 seed 0, m5_continuous seed 0.")


def test_one_run_of_a_task_without_symbols(tmp_path):
    folder = untrained(tmp_path, "unknown", "m5")
    found = inspection.inspect([folder], None, QUIET)
    assert found["folder"] == str(folder.resolve() / "inspect")
    row = found["runs"]["m5"]
    assert row["error"] >= 0 and not [name for name in row if "symbols" in name or "extractor" in name]
    assert (folder / "inspect" / "curves.png").exists()


def test_a_model_that_knows_what_came_before(tmp_path):
    """Its rollouts begin where those of the others do, and its odds are of a model that knows the frames before."""
    folders = [untrained(tmp_path, "unknown", agent) for agent in ("m5", "m6")]
    inspection.inspect(folders, tmp_path / "out", QUIET)
    steps = pd.read_csv(tmp_path / "out" / "steps.csv").set_index("run")
    assert steps.step.m5.tolist() == steps.step.m6.tolist() == [1, 2, 3, 4, 5]
    assert steps.repeated_error.m5.tolist() == steps.repeated_error.m6.tolist()

    run = restore(RunRecord.open(folders[1], lock=False), QUIET)
    model, tokenizer = run.model.world_model, run.model.tokenizer
    real, past = evaluation_set.load("unknown", "smoke", QUIET), run.agent.past
    paid = np.random.default_rng(0).integers(0, 9, real.paid.shape, np.uint8)  # the corridor pays at its end alone
    real = dataclasses.replace(real, paid=paid)
    found = rollouts.imagine(run.agent, model, tokenizer, real, jax.random.key(0), start=past)
    tokens_NTL = run.agent.tokenizer.encode(tokenizer, real.frames)
    whole = nnx.merge(run.agent.world_model_graph, model)
    age_NTL = ages_of(tokens_NTL, run.agent.ages)
    shown = slice(past, past + found.steps)
    assert run.agent.told_of_pay
    history = History(age_NTL[:, shown], jnp.asarray(real.paid[:, shown]))
    hidden = whole(tokens_NTL[:, shown], real.action[:, shown], history_BT=history)
    np.testing.assert_allclose(found.reward_odds, jax.nn.softmax(whole.reward_logits(hidden)), rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(
        found.tokenized, run.agent.tokenizer.decode(tokenizer, tokens_NTL[:, past : past + found.steps + 1])
    )


def test_what_cannot_be_inspected(runs, tmp_path):
    for folders, message in (
        ([begun(tmp_path, "corridor", "mfrl")], "has no world model: mfrl learns from real play only"),
        ([begun(tmp_path, "corridor", "m5")], "has no checkpoint; run it first: suite run corridor"),
        ([runs[0], begun(tmp_path, "unknown", "m5")], "is of task unknown, .* of corridor: inspect them apart"),
        ([begun(tmp_path, "pennies", "m5"), runs[0]], "is a run of a two-player game: inspect it apart"),
        ([runs[0], runs[0]], "is named twice"),
        ([tmp_path], "is no run folder"),
    ):
        with pytest.raises(UserError, match=message):
            inspection.inspect(folders, None, QUIET)
    with pytest.raises(UserError, match="choose another --out"):
        inspection.inspect(runs, runs[0] / "record.json" / "x", QUIET)
