"""Merging: one file of all logs of a run, in order of time, with nothing lost and nothing changed."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest
from mcap.reader import make_reader

from deploy import cli
from deploy.run.lockstep import run
from deploy.run.progress import Progress
from tests.command import PATIENCE_S
from tmc.kernel.config import JournalConfig, build, flat
from tmc.kernel.world import World
from tmc.record import schemas
from tmc.record.errors import RecordError
from tmc.record.merge import NAME, merge
from tmc.record.reader import Log
from tmc.record.run_folder import run_files
from tmc.record.writer import LogWriter

T, N = 30, 3


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mission in lock step with a log of the TMC and one of each UAV."""
    folder = tmp_path_factory.mktemp("flown")
    values = {"training.ticks": T, "training.episodes": 1, "team.size": N, "team.controller": "planner:greedy"}
    config = build(values | {"trial.observation_hash": True})
    (folder / "config.json").write_text(json.dumps(flat(config)))
    run(World(config), folder, None, Progress(config, 1, 0.0))
    return folder


def of_source(files: dict[str, Path]) -> Counter[tuple[object, ...]]:
    return Counter((p, r.topic, r.schema, r.log_time, r.publish_time, r.sequence, r.data)
                   for p, path in files.items() for r in Log(path).raw())  # fmt: skip


def of_merged(path: Path) -> list[tuple[object, ...]]:
    """What mcap's own reader finds, in the order in which it is written."""
    with path.open("rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        return [(c.metadata["process"], c.topic, s.name, m.log_time, m.publish_time, m.sequence, m.data)
                for s, c, m in found]  # fmt: skip


def write_logs(folder: Path, times: dict[str, list[int]]) -> dict[str, Path]:
    """Logs of /log messages at given times."""
    folder.mkdir(exist_ok=True)
    for process, ticks in times.items():
        with LogWriter(folder / f"{process}.mcap", process, JournalConfig(), {}, clock=lambda: 0) as log:
            for number, tick in enumerate(ticks):
                text = schemas.message_class("foxglove.Log")(message=f"{process} {number}")
                log.put("/log", text.SerializeToString(), tick, tick, number)
    return run_files(folder)


def texts(path: Path) -> list[str]:
    return [entry.message.message for entry in Log(path).entries()]


def test_everything_is_in_it_once_and_in_order_of_time(flown: Path, tmp_path: Path) -> None:
    files = run_files(flown)
    assert set(files) == {"tmc", *(f"uav-{i:03d}" for i in range(N))}
    merged = merge(files, tmp_path / "merged.mcap")
    found = of_merged(merged.path)
    assert Counter(found) == of_source(files)
    assert (merged.messages, merged.files, merged.damage, merged.open) == (len(found), N + 1, (), ())
    assert all(a[3] <= b[3] for a, b in pairwise(found))  # type: ignore[operator]  # log times
    assert Log(merged.path).finished


def test_attachments_metadata_and_schemas_are_carried_over(flown: Path, tmp_path: Path) -> None:
    path = merge(run_files(flown), tmp_path / "merged.mcap").path
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        attached = {a.name: a.data for a in reader.iter_attachments()}
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
        summary = reader.get_summary()
    source = Log(run_files(flown)["tmc"])
    assert attached == {a.name: a.data for a in source.attachments()} and set(attached) == {"config.json", "map.csv"}
    assert set(metadata) == {NAME, "overfly/tmc", *(f"overfly/uav-{i:03d}" for i in range(N))}
    assert all(metadata[f"overfly/{p}"] == Log(path).metadata() for p, path in run_files(flown).items())
    assert metadata[NAME]["files"].split() == [p.name for p in run_files(flown).values()]
    assert summary is not None and summary.statistics is not None
    described = {s.name: s.data for s in summary.schemas.values()}
    assert described == {name: schemas.schema_bytes(name) for name in described}


def test_messages_of_one_time_stay_in_the_order_of_the_files_and_of_the_file(tmp_path: Path) -> None:
    files = write_logs(tmp_path / "run", {"tmc": [1, 5, 5, 9], "learner": [5, 5], "uav-000": [0, 5, 9]})
    expected = ["uav-000 0", "tmc 0", "tmc 1", "tmc 2", "learner 0", "learner 1", "uav-000 1", "tmc 3", "uav-000 2"]
    assert texts(merge(files, tmp_path / "out.mcap").path) == expected


def test_a_file_whose_times_go_back_is_put_in_order(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    write_logs(folder, {"tmc": [2, 4]})
    with LogWriter(folder / "uav-000.mcap", "uav-000", JournalConfig(), {}, clock=lambda: 0) as log:
        for topic, tick in (("/log", 3), ("/uav/0/status", 1), ("/log", 5)):
            kind = "foxglove.Log" if topic == "/log" else "overfly.UavStatus"
            log.put(topic, schemas.message_class(kind)().SerializeToString(), tick, tick, int(tick == 5))
    merged = merge(run_files(folder), tmp_path / "out.mcap")
    assert [row[3] for row in of_merged(merged.path)] == [1, 2, 3, 4, 5]
    assert merged.damage == ()


def test_a_prefix_goes_before_each_topic(flown: Path, tmp_path: Path) -> None:
    files = run_files(flown)
    for prefix in ("A/", "A", "/A/"):
        path = merge(files, tmp_path / "out.mcap", prefix).path
        assert {row[1] for row in of_merged(path)} == {f"/A{row[1]}" for row in of_source(files)}
    for bad in ("a b", "a//b", "é", "a.b"):
        with pytest.raises(RecordError, match="is not part of a topic"):
            merge(files, tmp_path / "bad.mcap", bad)
    assert not (tmp_path / "bad.mcap").exists()


def test_attachments_that_differ_keep_apart(tmp_path: Path) -> None:
    for process, data in (("tmc", b"1"), ("learner", b"2"), ("uav-000", b"1")):
        with LogWriter(tmp_path / f"{process}.mcap", process, JournalConfig(), {}) as log:
            log.attach("note.txt", "text/plain", data)
    attached = Log(merge(run_files(tmp_path), tmp_path / "out.mcap").path).attachments()
    expected = [("note.txt", b"1"), ("learner/note.txt", b"2"), ("note.txt", b"1")]
    assert [(a.name, a.data) for a in attached] == expected


def test_what_is_sound_of_a_cut_file_is_merged_and_the_damage_is_said(flown: Path, tmp_path: Path) -> None:
    for process, path in run_files(flown).items():
        data = path.read_bytes()
        (tmp_path / path.name).write_bytes(data[: len(data) * 2 // 3] if process == "tmc" else data)
    (tmp_path / "uav-001.mcap").rename(tmp_path / "uav-001.mcap.active")
    (tmp_path / "uav-002.mcap").write_bytes(b"")
    merged = merge(run_files(tmp_path), tmp_path / "out.mcap")
    intact = {p: path for p, path in run_files(tmp_path).items() if p != "uav-002"}
    assert Counter(of_merged(merged.path)) == of_source(intact)
    assert {row[0] for row in of_merged(merged.path)} == set(intact)
    assert sorted(text.partition(":")[0].rpartition("/")[2] for text in merged.damage) == [
        "tmc.mcap", "uav-002.mcap is empty",
    ]  # fmt: skip


def test_a_log_that_is_still_written_is_merged_as_far_as_it_is(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "tmc.mcap", "tmc", JournalConfig(), {})
    try:
        log.log("info", "one")
        log.flush()
        merged = merge(run_files(tmp_path), tmp_path / "out.mcap")
    finally:
        log.close()
    assert texts(merged.path) == ["one"]
    assert (merged.damage, merged.open) == ((), (tmp_path / "tmc.mcap.active",))


def test_a_log_is_never_written_over(flown: Path, tmp_path: Path) -> None:
    files, before = run_files(flown), {p: path.read_bytes() for p, path in run_files(flown).items()}
    for out in (files["tmc"], tmp_path / "uav-007.mcap", tmp_path / "learner.mcap.active"):
        with pytest.raises(RecordError, match=r"one of the files to merge|is the name of a run's log"):
            merge(files, out)
    assert before == {p: path.read_bytes() for p, path in files.items()} and not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_written_leaves_nothing(flown: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    for out in (tmp_path / "taken" / "out.mcap", tmp_path):
        with pytest.raises(RecordError, match="cannot be written"):
            merge(run_files(flown), out)
    assert [p.name for p in tmp_path.iterdir()] == ["taken"]


def test_a_full_disk_leaves_nothing_and_is_said_in_a_sentence(flown: Path, tmp_path: Path) -> None:
    code = f"""
import resource, signal, sys
from deploy import cli
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, {resource.RLIM_INFINITY}))
sys.exit(cli.main(["log", "merge", {str(flown)!r}, "--out", {str(tmp_path / "out.mcap")!r}]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith(f"overfly: {tmp_path / 'out.mcap'} cannot be written")
    assert done.stderr.count("\n") == 1 and not list(tmp_path.iterdir())


def test_the_command(flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "A.mcap"
    assert cli.main(["log", "merge", str(flown), "--prefix", "A/", "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert said.out.startswith(f"{out}: {len(of_merged(out)):,} messages of {N + 1} files") and not said.err
    before = out.read_bytes()
    for view in ("merge", "replay"):  # a file that the user names is never written over
        assert cli.main(["log", view, str(flown), "--out", str(out)]) == 2
        assert capsys.readouterr().err == f"overfly: {out} exists already: choose another --out, or remove it\n"
    assert out.read_bytes() == before
    assert cli.main(["log", "merge", str(out), "--prefix", "B", "--out", str(tmp_path / "B.mcap")]) == 0
    assert {row[1].partition("/A/")[0] for row in of_merged(tmp_path / "B.mcap")} == {"/B"}  # type: ignore[attr-defined]
    capsys.readouterr()
    (tmp_path / "tmc.mcap").write_bytes(next(iter(run_files(flown).values())).read_bytes()[:-50])
    assert cli.main(["log", "merge", str(tmp_path)]) == 1
    said = capsys.readouterr()
    assert said.err.startswith("overfly: the output is incomplete: tmc.mcap: ") and (tmp_path / "merged.mcap").is_file()
    assert cli.main(["log", "merge", str(tmp_path / "nowhere")]) == 2
