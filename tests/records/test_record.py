from __future__ import annotations

import contextlib
import errno
import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from suite.records import tables
from suite.records.event_files import EventFile
from suite.records.record import RunRecord, require_writable, run_folder
from suite.records.tables import CsvTable, cell, write_whole
from suite.registry import resolve
from suite.runtime.errors import RunError, UserError, refusals_are_errors
from tests.tiny import CORRIDOR_SPEC

CONFIG = resolve("craftax_classic", "m5", "smoke")
OTHER = resolve("craftax_classic", "m5", "smoke", ["ppo.discount=0.5"])


def play(record, steps):
    """What a run writes, determined by the step."""
    for step in steps:
        value = float(np.float32(step) / 3)
        episode = {"step": step, "return": value, "length": step, "achievement_return": 1.0, "health_return": value}
        record.append_episodes([episode | {"arrive": step % 2}])
        metrics = {"step": step, "episodes": 1, "return": None if step % 2 else value}
        record.append_metrics(metrics | ({"imagine/loss": value} if step > 20 else {}), ["imagine/loss"])
        record.append_timing({"step": step, "collect": 0.1})


def contents(folder):
    names = ("episodes", "metrics", "evaluations", "timing")
    return {name: path.read_bytes() for name in names if (path := folder / f"{name}.csv").exists()}


def create(tmp_path, config=CONFIG):
    return RunRecord.create(run_folder(tmp_path, config), config, CORRIDOR_SPEC)


def test_folder_and_files(tmp_path):
    with create(tmp_path) as record:
        play(record, [10, 20])
        record.finish(20)
    assert record.folder == tmp_path / "craftax_classic" / "m5" / "smoke" / "seed_0"
    fields = json.loads((record.folder / "record.json").read_text())
    assert fields["schema"] == 1 and fields["status"] == "finished" and fields["steps"] == 20
    assert fields["protocol"]["package_version"] == np.__version__
    assert fields["packages"]["jax"] and fields["device"]["platform"] == "cpu"
    assert (record.folder / "episodes.csv").read_text().splitlines() == [
        "step,return,length,achievement_return,health_return,arrive",
        "10,3.3333332538604736,10,1.0,3.3333332538604736,0",
        "20,6.666666507720947,20,1.0,6.666666507720947,0",
    ]
    with RunRecord.open(record.folder, lock=False) as again:
        assert again.config == CONFIG and again.finished
        assert again.episodes()["return"].tolist() == [float(np.float32(step) / 3) for step in (10, 20)]


def test_the_protocol_hash_tells_comparable_results_apart(tmp_path):
    with create(tmp_path / "a") as one, create(tmp_path / "b", OTHER) as two:
        assert one.fields.protocol_hash == two.fields.protocol_hash
        assert one.fields.config_digest != two.fields.config_digest
    longer = resolve("craftax_classic", "m5", "smoke", steps=128)
    with create(tmp_path / "c", longer) as three:
        assert three.fields.protocol_hash != one.fields.protocol_hash


def test_replaying_after_a_rewind_writes_the_same_bytes_and_loses_nothing(tmp_path):
    with create(tmp_path / "whole") as record:
        assert record.rewind(0) == 0
        assert record.fields.resumed == []  # that was the start
        play(record, range(10, 60, 10))
    whole = contents(record.folder)
    with create(tmp_path / "stopped") as record:
        play(record, range(10, 50, 10))
    before = contents(record.folder)
    with RunRecord.open(record.folder, CONFIG) as record:
        assert record.rewind(20) == 2 * 3  # steps 30 and 40 of three tables
        assert record.steps == 20
        play(record, range(30, 60, 10))
    assert contents(record.folder) == whole
    assert [entry["step"] for entry in record.fields.resumed] == [20]
    aside = record.folder / "replaced" / "0001_after_step_20"
    for name in ("episodes", "metrics", "timing"):
        header, *rows = before[name].splitlines(keepends=True)
        assert (aside / f"{name}.csv").read_bytes() == header + b"".join(rows[2:])


def test_each_rewind_keeps_its_own_rows(tmp_path):
    with create(tmp_path) as record:
        play(record, [10, 20])
    for number in (1, 2):
        with RunRecord.open(record.folder, CONFIG) as record:
            record.rewind(10)
            play(record, [20])
        assert len(list((record.folder / "replaced").iterdir())) == number


def test_a_row_cut_off_by_a_kill(tmp_path):
    with create(tmp_path) as record:
        play(record, [10, 20])
    whole = contents(record.folder)
    for name in ("episodes", "metrics"):
        with (record.folder / f"{name}.csv").open("ab") as file:
            file.write(b"30,0.12")
    with RunRecord.open(record.folder, CONFIG) as record:
        assert record.rewind(20) == 2
    assert contents(record.folder) == whole


def test_an_evaluation_that_is_killed_leaves_all_of_its_rows_or_none(tmp_path, monkeypatch):
    row = {"step": 20, "return": 1.0, "length": 3, "achievement_return": 1.0, "health_return": 0.0, "arrive": 1}
    with create(tmp_path) as record:
        record.append_evaluation([row])
        with (record.folder / "evaluations.csv").open("ab") as file:
            file.write(b"20,1")  # as earlier versions left it
        before = (record.folder / "evaluations.csv").read_bytes()
        with full_disk(monkeypatch), pytest.raises(OSError):
            record.append_evaluation([row, row])
        assert (record.folder / "evaluations.csv").read_bytes() == before
        record.append_evaluation([row, row])
        assert record.table("evaluations")["return"].tolist() == [1.0] * 3
        assert record.has_evaluation(20, 3) and not record.has_evaluation(20, 4) and not record.has_evaluation(2, 1)


def test_an_episode_that_ends_with_a_move_of_chance_is_not_kept_twice(tmp_path):
    """Such a move is no step: the first one after a checkpoint has the checkpoint's step."""
    with create(tmp_path) as record:
        play(record, [10, 20])
        row = {"step": 20, "return": 1.0, "length": 3, "achievement_return": 1.0, "health_return": 0.0, "arrive": 1}
        record.append_episodes([row])
    with RunRecord.open(record.folder, CONFIG) as record:
        assert record.rewind(20) == 1
        assert record.episodes()["step"].tolist() == [10, 20]


def test_a_run_that_goes_on_reads_whole_rows_only(tmp_path):
    with create(tmp_path) as record:
        assert record.table("metrics").empty and record.episodes().empty
        play(record, [10])
        with (record.folder / "metrics.csv").open("ab") as file:
            file.write(b"20,0.")
        assert record.table("metrics")["step"].tolist() == [10]


def test_appending_after_a_cut_off_row_or_header(tmp_path):
    path = tmp_path / "table.csv"
    path.write_bytes(b"step,va")
    CsvTable(path, ["step", "value"]).append([{"step": 1, "value": 2}])
    with path.open("ab") as file:
        file.write(b"2,")
    CsvTable(path, ["step", "value"]).append([{"step": 3}])
    assert path.read_bytes() == b"step,value\n1,2\n3,\n"


def test_a_header_cut_off_is_written_anew(tmp_path):
    with create(tmp_path) as record:
        pass
    header = (record.folder / "episodes.csv").read_bytes()
    (record.folder / "episodes.csv").write_bytes(header[:-5])
    with RunRecord.open(record.folder, CONFIG) as record:
        record.rewind(0)
    assert (record.folder / "episodes.csv").read_bytes() == header


def test_unknown_columns_and_fields_are_refused(tmp_path):
    with create(tmp_path) as record:
        with pytest.raises(ValueError, match="no column colour"):
            record.append_episodes([{"step": 1, "colour": 2}])
        with pytest.raises(ValueError, match="no field colour"):
            record.update(colour=2)


@pytest.mark.parametrize("value", [0.1, 1e-30, 1 / 3, 123456789.123, float("inf")])
@pytest.mark.parametrize("kind", [np.float32, np.float64, float])
def test_floats_are_read_back_to_the_bit(value, kind):
    assert kind(cell(kind(value))) == kind(value)


def test_cells():
    assert [cell(v) for v in (None, True, np.bool_(False), np.int32(7), "a", np.nan)] == ["", "1", "0", "7", "a", "nan"]


def test_wall_clock_adds_up_over_processes(tmp_path):
    with create(tmp_path) as record:
        record.add_wall_clock(2.0, {"collect": 1.5})
    with RunRecord.open(record.folder, CONFIG) as record:
        record.add_wall_clock(3.0, {"collect": 4.0})
    assert record.fields.wall_clock_seconds == {"collect": 4.0, "total": 5.0}
    assert record.fields.peak_memory_bytes["process"] > 2**20


# Bad input.


def test_another_process_is_refused_and_a_dead_one_is_not(tmp_path):
    with create(tmp_path) as record:
        code = (
            "import sys; from pathlib import Path; from suite.records.record import RunRecord\n"
            "try: RunRecord.open(Path(sys.argv[1]))\n"
            "except Exception as error: print(type(error).__name__, error)"
        )
        command = [sys.executable, "-c", code, str(record.folder)]
        output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        assert output.startswith(f"FolderInUseError {record.folder} is in use by another process (pid ")
        RunRecord.open(record.folder, lock=False)  # reading is free
    subprocess.run(command, capture_output=True, check=True)  # takes the lock, and dies with it
    RunRecord.open(record.folder, CONFIG).close()


def test_a_refused_open_leaves_no_lock(tmp_path):
    with create(tmp_path) as record:
        pass
    with pytest.raises(UserError, match="discount"):
        RunRecord.open(record.folder, OTHER)
    RunRecord.open(record.folder, CONFIG).close()


def test_a_record_of_another_configuration_is_refused(tmp_path):
    with create(tmp_path) as record:
        pass
    with pytest.raises(UserError, match=r"holds a run with ppo.discount=0.925, not 0.5; choose another --out"):
        RunRecord.open_or_create(record.folder, OTHER, CORRIDOR_SPEC)
    more_often = resolve("craftax_classic", "m5", "smoke", ["checkpoint.every_steps=1"])
    RunRecord.open_or_create(record.folder, more_often, CORRIDOR_SPEC).close()  # changes no result


def test_a_record_of_other_rules_is_refused(tmp_path):
    with create(tmp_path) as record:
        record.update(protocol=record.fields.protocol.model_dump() | {"package_version": "0.1"})
    with pytest.raises(UserError, match=r"package_version=0\.1, not the present"):
        RunRecord.open_or_create(record.folder, CONFIG, CORRIDOR_SPEC)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("record.json", None, "is no run folder: it has no record.json"),
        ("config.json", None, "is no run folder: it has no config.json"),
        ("record.json", "{", "record.json is damaged"),
        ("record.json", "\xff", "record.json is damaged"),
        ("record.json", "[]", "record.json is damaged: not an object"),
        ("record.json", '{"schema": 99}', "has a record of schema 99; this version reads 1"),
        ("record.json", '{"schema": 1}', "record.json is damaged: it lacks task"),
        ("config.json", "", "config.json is damaged"),
        ("config.json", '{"task": "a", "agent": "b", "preset": "c", "x": 1}', "is not of this version: x=1"),
        ("config.json", '{"task": "a", "agent": "b", "preset": "c", "ppo": {"clip": 0}}', "ppo.clip=0"),
    ],
)
@pytest.mark.parametrize("lock", [True, False])
def test_damaged_records(tmp_path, name, content, message, lock):
    with create(tmp_path) as record:
        pass
    (record.folder / name).unlink()
    if content is not None:
        (record.folder / name).write_bytes(content.encode("latin1"))
    with pytest.raises(UserError) as caught:
        RunRecord.open(record.folder, lock=lock)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(UserError, match="is no run folder"):
        RunRecord.open(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    (tmp_path / "episodes.csv").touch()
    with pytest.raises(UserError, match=r"already holds episodes.csv"):
        RunRecord.create(tmp_path, CONFIG, CORRIDOR_SPEC)


def test_a_folder_that_cannot_be(tmp_path):
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "x"):
        with pytest.raises(UserError, match=r"cannot write to .*; choose another --out"):
            require_writable(folder)
        with pytest.raises(UserError, match="cannot write"):
            RunRecord.open_or_create(folder, CONFIG, CORRIDOR_SPEC)
    with pytest.raises(UserError, match=r"choose another --page$"):
        require_writable(tmp_path / "file", "--page")


# A full disk.


@contextlib.contextmanager
def full_disk(monkeypatch, after=0):
    """os.fsync fails with ENOSPC after so many calls."""
    calls = iter(range(after))

    def fsync(number):
        if next(calls, None) is None:
            raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(tables.os, "fsync", fsync)
        yield


def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch):
    with create(tmp_path) as record:
        play(record, [10])
        before = contents(record.folder)
        intact = pytest.raises(
            RunError, match=r"^disk full: free some space, and run the same command again; what was saved is intact"
        )
        with full_disk(monkeypatch), intact, refusals_are_errors():
            play(record, [20])
        assert contents(record.folder) == before
        with full_disk(monkeypatch), pytest.raises(OSError):
            record.update(steps=99)
        assert json.loads((record.folder / "record.json").read_text())["steps"] == 0
        assert not list(record.folder.glob("*.partial"))
        play(record, [20])
    assert record.episodes()["step"].tolist() == [10, 20]


def test_write_whole_is_all_or_nothing(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_whole(path, b"old")
    with full_disk(monkeypatch), pytest.raises(OSError):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


def test_curves_can_be_read_back(tmp_path):
    from tensorboardX.proto.event_pb2 import Event

    for purge in (None, 7):
        file = EventFile(tmp_path, purge)
        file.append(5, {"loss": 0.5})
        file.close()
    first, second = sorted(tmp_path.iterdir())
    events = []
    for path in (first, second):
        data, records = path.read_bytes(), []
        while data:
            length = int.from_bytes(data[:8], "little")
            records.append(Event.FromString(data[12 : 12 + length]))
            data = data[16 + length :]
        events.append(records)
    assert [(e.step, e.summary.value[0].tag) for e in events[0] if e.summary.value] == [(5, "loss")]
    assert [e.step for e in events[1] if e.HasField("session_log")] == [7]


@pytest.mark.parametrize("again", [False, True], ids=["removed", "made anew"])
def test_a_folder_that_was_replaced_is_not_written_into(tmp_path, again):
    with create(tmp_path) as old:
        shutil.rmtree(old.folder)
        new = create(tmp_path) if again else None
        before = contents(new.folder) if new else {}
        for write in (lambda: play(old, [10]), lambda: old.update(status="failed")):
            with pytest.raises(RunError, match="was removed or replaced while this run was writing"):
                write()
        if new:
            assert contents(new.folder) == before
            new.close()
        else:
            assert not old.folder.exists()


def test_a_record_with_nan_is_damaged(tmp_path):
    with create(tmp_path) as record:
        path = record.folder / "record.json"
    path.write_text(path.read_text().replace('"total": 0.0', '"total": NaN'))
    with pytest.raises(UserError, match=r"record.json is damaged: NaN is not a number that JSON has"):
        RunRecord.open(record.folder, lock=False)


def test_every_field_of_a_record_must_be_of_its_kind(tmp_path):
    with create(tmp_path) as record:
        path = record.folder / "record.json"
    fields = json.loads(path.read_text())
    assert len(fields) > 20
    for name in fields.keys() - {"schema"}:
        for wrong in (fields | {name: [None]}, {other: value for other, value in fields.items() if other != name}):
            path.write_text(json.dumps(wrong))
            with pytest.raises(UserError, match=f"record.json is damaged: .*{name}"):
                RunRecord.open(record.folder, lock=False)
    path.write_text(json.dumps(fields))
    RunRecord.open(record.folder, lock=False)
