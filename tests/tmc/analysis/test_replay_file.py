"""The replay file: each map in it is the one that was true, or that the UAV acted on, at that tick."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import MethodType
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader

from actors.airspace import Waiting
from actors.pilot import Pilot
from deploy import cli
from deploy.run.lockstep import LockStep
from tests.command import PATIENCE_S
from tests.tmc.analysis.conftest import flown_as
from tmc.analysis import palette
from tmc.analysis.viewer import replay_file
from tmc.analysis.viewer.layout import FILE, topics_of
from tmc.analysis.viewer.messages import SHAPES
from tmc.analysis.viewer.replay_file import TICK_NS, TRAIL_TICKS, centre_of
from tmc.center.journal import Journal
from tmc.kernel.config import build
from tmc.kernel.roadmap import parse_raster
from tmc.kernel.world import World
from tmc.record import builders, queries
from tmc.record.channels import REPLAY_CHANNELS
from tmc.record.errors import RecordError
from tmc.record.reader import Log
from tmc.record.run_folder import run_files
from tmc.record.writer import LogWriter
from tmc.wire import messages as m

T, N = 60, 3
BASE = {"training.ticks": T, "training.episodes": 2, "team.size": N, "team.controller": "planner:random-road",
        "training.seed": 3}  # fmt: skip
MISSIONS: dict[str, dict[str, Any]] = {
    "together": {},
    "staggered": {"comms.phase": "staggered", "comms.period": 7},
    "every tick": {"comms.period": 1},
    "never": {"comms.period": 1000},
    "random map": {"world.initial_map": "random", "world.rates": "volume", "comms.phase": "staggered"},
    "blocked": {"team.controller": "planner:random", "team.size": 12},
    "events": {"scenario": 1, "world.alpha": 0.2},
    "events, alone": {"scenario": 1, "team.size": 1, "world.alpha": 0.05},
}


@dataclass
class RunData:
    """A mission in lock step with its log, and what its pilots held when they were about to act."""

    folder: Path
    world: World
    last_visit: dict[tuple[int, int, int], np.ndarray[Any, Any]] = field(default_factory=dict)
    own: dict[tuple[int, int, int], np.ndarray[Any, Any]] = field(default_factory=dict)
    """(episode, tick, uav) -> the UAV's own map: its ticks, and U_i(t)."""

    def watch(self, pilot: Pilot) -> None:
        """Note the maps each time that the pilot is about to act."""
        act = pilot._act

        def noting(self_: Pilot) -> None:
            key = (self_.episode, self_.t, self_.uav)
            self.last_visit[key] = self_.last_visit.copy()
            self.own[key] = self_.map_of(self_.t).copy()
            act()

        pilot._act = MethodType(noting, pilot)  # type: ignore[method-assign]


def fly(folder: Path, fleet: Callable[[LockStep], None] = LockStep.run, **values: Any) -> RunData:
    """Fly a mission in lock step, with its journal."""
    folder.mkdir(parents=True)
    world = World(build({**BASE, **values}))
    flown, journal = RunData(folder, world), Journal(folder, world, "run")
    mission = LockStep(world, None, journal.take)
    for pilot in mission.fleet.pilots:
        flown.watch(pilot)
    fleet(mission)
    journal.writer.close()
    return flown


@pytest.fixture(scope="module", params=MISSIONS)
def flown(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RunData:
    return fly(tmp_path_factory.mktemp("flown") / "run", **MISSIONS[request.param])


@pytest.fixture(scope="module")
def together(tmp_path_factory: pytest.TempPathFactory) -> RunData:
    return fly(tmp_path_factory.mktemp("together") / "run")


def replay(folder: Path, episode: int = 2) -> Path:
    path = replay_file.default_path(folder, episode)
    if not path.exists():
        replay_file.write(folder, episode, path)
    return path


def messages(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """{topic: (log time, message)} by mcap's own reader, each message of the class that the file describes."""
    found, classes = defaultdict(list), {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
            if schema.name not in classes:
                pool = descriptor_pool.DescriptorPool()
                for described in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(described)
                classes[schema.name] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            found[channel.topic].append((message.log_time, classes[schema.name].FromString(message.data)))
    return found


def ticks_of(found: dict[str, list[tuple[int, Any]]], topic: str) -> list[tuple[int, Any]]:
    """(tick, message) of a topic."""
    assert all(time % TICK_NS == 0 for time, _ in found[topic])
    return [(time // TICK_NS, message) for time, message in found[topic]]


def true_last_visits(folder: Path, world: World, episode: int) -> list[dict[int, int]]:
    """For each tick {cell: tick of the last visit}, from the moves alone."""
    visits: list[dict[int, int]] = []
    last: dict[int, int] = {}
    for tick, _, cell in queries.moves(folder, episode):
        if tick == len(visits):
            visits.append({})
        last[cell] = tick
        visits[tick] = dict(last)
    return visits


def test_the_true_map_of_each_tick_follows_from_the_moves(flown: RunData) -> None:
    world, found = flown.world, messages(replay(flown.folder))
    visits = true_last_visits(flown.folder, world, 2)
    grids = ticks_of(found, "/tmc/last_visit")
    assert [tick for tick, _ in grids] == list(range(T + 1))
    monitored = set(world.law.cells.tolist())
    for tick, grid in grids:
        expected = [visits[tick].get(k, 0) if k in monitored else 0 for k in range(world.grid.size)]
        assert builders.last_visit(grid).tolist() == expected


def test_the_uncertainty_of_the_true_map_is_what_the_tmc_logged(flown: RunData) -> None:
    found, logged = messages(replay(flown.folder)), dict(queries.uncertainty(flown.folder, 2))
    for tick, grid in ticks_of(found, "/tmc/last_visit"):
        assert builders.layer(grid, "uncertainty").sum(dtype=np.float64) == pytest.approx(logged[tick], rel=1e-5)
    for tick, message in ticks_of(found, "/tmc/tick"):
        assert (message.tick, message.episode) == (tick, 2)
        assert message.uncertainty == pytest.approx(logged[tick], rel=1e-12)
        assert message.uncertainty_per_cell * flown.world.law.cells.size == pytest.approx(message.uncertainty)
        assert message.uavs == flown.world.config.team.size


def test_events_are_where_they_are_until_somebody_comes(flown: RunData) -> None:
    if flown.world.config.scenario == 2:
        return
    found, active = messages(replay(flown.folder)), set[int]()
    appear, cells = defaultdict(set), defaultdict(set)
    for tick, cell in queries.events(flown.folder, 2):
        appear[tick].add(cell)
    for tick, _, cell in queries.moves(flown.folder, 2):
        cells[tick].add(cell)
    most = 0
    for tick, grid in ticks_of(found, "/tmc/last_visit"):
        active = (active - cells[tick]) | appear[tick]
        assert set(np.flatnonzero(builders.layer(grid, "uncertainty")).tolist()) == active
        most = max(most, len(active))
    assert most > 10


def test_a_belief_is_what_the_pilot_held(flown: RunData) -> None:
    world, found = flown.world, messages(replay(flown.folder))
    for uav in range(world.config.team.size):
        grids = ticks_of(found, f"/uav/{uav}/belief")
        assert [tick for tick, _ in grids] == list(range(T + 1))
        for tick, grid in grids:
            held, own = flown.last_visit[2, tick, uav], flown.own[2, tick, uav]
            last_visit, uncertainty = builders.layer(grid, "last_visit"), builders.layer(grid, "uncertainty")
            assert last_visit[world.law.cells].tolist() == held.tolist()
            assert uncertainty[world.law.cells].tobytes() == own.astype("<f4").tobytes()
            assert last_visit.sum() == held.sum(dtype=np.int64)  # nothing outside of the monitored cells
        for tick, message in ticks_of(found, f"/uav/{uav}/tick"):
            assert message.believed == pytest.approx(float(flown.own[2, tick, uav].sum()), rel=1e-12)


def test_beliefs_of_the_tmc_are_those_that_it_logged(flown: RunData) -> None:
    """At each exchange the plot of what the TMC believes passes through what /tmc/sync says."""
    believed = {t: message.believed for t, message in ticks_of(messages(replay(flown.folder)), "/tmc/tick")}
    synced = [e.message for e in Log(run_files(flown.folder)["tmc"]).entries(["/tmc/sync"]) if e.message.episode == 2]
    assert synced and synced[-1].tick == T
    for sync in synced:
        assert believed[sync.tick] == pytest.approx(sync.believed, rel=1e-12)


def test_where_each_uav_is(flown: RunData) -> None:
    world, found = flown.world, messages(replay(flown.folder))
    cells = {(tick, uav): cell for tick, uav, cell in queries.moves(flown.folder, 2)}
    for uav in range(world.config.team.size):
        for tick, message in ticks_of(found, f"/uav/{uav}/tick"):
            assert (message.tick, message.uav, message.cell) == (tick, uav, cells[tick, uav])
        for tick, message in ticks_of(found, f"/uav/{uav}/pose"):
            row, col = divmod(cells[tick, uav], world.grid.cols)
            at = message.pose.position
            assert (message.frame_id, at.x, at.y, at.z) == ("map", 60 * col + 30, 60 * (world.grid.rows - row) - 30, 0)
            if tick and cells[tick, uav] != cells[tick - 1, uav]:
                before = centre_of(world, cells[tick - 1, uav])
                yaw = 2 * math.atan2(message.pose.orientation.z, message.pose.orientation.w)
                towards = math.atan2(at.y - before[1], at.x - before[0])
                assert math.isclose(math.cos(yaw - towards), 1.0)
        for tick, message in ticks_of(found, f"/uav/{uav}/fix"):
            assert (message.longitude, message.latitude) == world.map.lonlat(cells[tick, uav])


def test_the_scene_shows_each_uav_with_its_trail(flown: RunData) -> None:
    found, size = messages(replay(flown.folder)), flown.world.config.team.size
    cells = {(tick, uav): cell for tick, uav, cell in queries.moves(flown.folder, 2)}
    assert len(found["/scene"]) == T + 1
    for tick, message in ticks_of(found, "/scene"):
        assert [e.id for e in message.entities] == [f"uav-{i}" for i in range(size)] and not message.deletions
        for uav, entity in enumerate(message.entities):
            (line,), (text,) = entity.lines, entity.texts
            expected = [centre_of(flown.world, cells[t, uav]) for t in range(max(0, tick - TRAIL_TICKS + 1), tick + 1)]
            assert [(p.x, p.y) for p in line.points] == expected
            (body,) = [*entity.spheres, *entity.cubes, *entity.cylinders]
            assert (body.pose.position.x, body.pose.position.y) == expected[-1] and text.text == str(uav)
            red, green, blue = (int(palette.colour_of(uav)[i : i + 2], 16) / 255 for i in (1, 3, 5))
            assert (body.color.r, body.color.g, body.color.b, body.color.a) == (red, green, blue, 1.0)
            assert len(getattr(entity, SHAPES[uav // len(palette.UAV_COLOURS)][0])) == 1


def test_blocked_moves_and_exchanges_are_said(flown: RunData) -> None:
    found = messages(replay(flown.folder))
    blocked = sum(message.blocked for _, message in found["/tmc/tick"])
    assert sum("was blocked by" in message.message for _, message in found["/log"]) == blocked
    assert blocked == sum(m.block > 0 for topic in found if topic.endswith("/tick") and topic != "/tmc/tick"
                          for _, m in found[topic])  # fmt: skip
    exchanges = [tick for tick, message in ticks_of(found, "/tmc/tick") if message.answered]
    config = flown.world.config
    said = [t for t, message in ticks_of(found, "/log") if "exchange with" in message.message]
    assert said == (exchanges if config.T_u > 1 else [])
    due = [t for t in range(T + 1) if any(config.due(i, t) for i in range(config.team.size))]
    assert exchanges == due


def test_the_file_holds_the_topics_of_the_table_in_order_of_time(flown: RunData) -> None:
    path = replay(flown.folder)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        written = reader.iter_messages(log_time_order=False)
        heads = [(c.topic, s.name, x.log_time, x.publish_time) for s, c, x in written]
        (metadata,) = reader.iter_metadata()
        (attachment,) = reader.iter_attachments()
    assert all(a[2] <= b[2] for a, b in pairwise(heads)) and all(sent == logged for *_, logged, sent in heads)
    held = {(topic, schema) for topic, schema, *_ in heads}
    known = {(c.topic.replace("<id>", str(i)), c.schema) for c in REPLAY_CHANNELS
             for i in range(flown.world.config.team.size)}  # fmt: skip
    assert held == known
    facts_ = {"clock": "simulated", "tick_seconds": "60", "process": "replay", "format": "2", "episode": "2"}
    assert (metadata.name, metadata.metadata) == ("overfly/replay", facts_ | {"ticks": str(T)})
    assert (attachment.name, attachment.media_type) == (FILE, "application/json")
    assert attachment.data == path.with_suffix(".layout.json").read_bytes()


def test_sub_messages_that_are_zero_are_there(flown: RunData) -> None:
    """Converters of viewers look for them."""
    found = messages(replay(flown.folder))
    (_, tf), (_, grid), (_, scene) = found["/tf"][0], found["/tmc/last_visit"][0], found["/scene"][0]
    assert tf.HasField("translation") and tf.HasField("rotation") and tf.HasField("timestamp")
    assert (tf.parent_frame_id, tf.child_frame_id, len(found["/tf"])) == ("world", "map", 1)
    assert grid.HasField("timestamp") and grid.pose.HasField("position") and grid.pose.HasField("orientation")
    for entity in scene.entities:
        assert entity.HasField("lifetime") and entity.HasField("timestamp") and entity.texts[0].HasField("color")
        assert entity.lines[0].pose.HasField("position") and entity.lines[0].pose.HasField("orientation")


def test_the_layout_names_only_topics_of_the_file_and_every_panel_of_it_is_described(flown: RunData) -> None:
    path = replay(flown.folder)
    layout = json.loads(path.with_suffix(".layout.json").read_text())
    found, size = messages(path), flown.world.config.team.size
    named = set(topics_of(layout))
    assert named <= set(found)
    assert named >= {"/scene", "/tmc/last_visit", "/map/terrain", "/map/roads", "/tmc/tick", "/log"}
    assert named >= {f"/uav/{i}/belief" for i in range(size)}
    assert "<" not in json.dumps(layout)
    panels: list[Any] = [layout["layout"]]
    leaves = []
    while panels:
        panel = panels.pop()
        panels += [panel["first"], panel["second"]] if isinstance(panel, dict) else []
        leaves += [panel] if isinstance(panel, str) else []
    assert sorted(leaves) == sorted(layout["configById"])
    fields = {path["value"] for panel in layout["configById"].values() for path in panel.get("paths", [])}
    for value in fields:
        topic, _, name = value.partition(".")
        assert name in found[topic][0][1].DESCRIPTOR.fields_by_name
    for panel in layout["configById"].values():
        for topic, how in panel.get("topics", {}).items():
            if "colorField" in how:
                assert how["colorField"] in [f.name for f in found[topic][0][1].fields]


def test_a_map_without_streets_and_place_on_earth(tmp_path: Path) -> None:
    raster = tmp_path / "town.txt"
    raster.write_text("######\n#.X..#\n#....#\n######\n")
    flown = fly(tmp_path / "run", **{"world.map": str(raster), "training.episodes": 1})
    path = replay(flown.folder, 1)
    found, layout = messages(path), json.loads(path.with_suffix(".layout.json").read_text())
    assert "/map/roads" not in found and "/uav/0/fix" not in found
    assert set(topics_of(layout)) <= set(found)
    terrain = builders.layer(found["/map/terrain"][0][1], "terrain")
    expected = parse_raster(raster.read_text())
    assert terrain.tolist() == np.where(expected.blocked, 2, expected.road).tolist()


def losing(mission: LockStep) -> None:
    """Fly a mission in which UAV 1 says nothing more from tick 25 of episode 1 on."""
    fleet, station, now = mission.fleet, mission.station, 0.0
    for pilot in fleet.pilots:
        for uav, reply in mission._exchange(pilot.uav, m.Hello(role="uav", uav=pilot.uav, incarnation=1)):
            fleet.deliver(uav, reply)
    while station.episode is None or station.episode.number == 1:
        moved = False
        for pilot in fleet.pilots:
            if pilot.uav == 1 and pilot.t >= 25:
                continue
            before = (pilot.t, pilot.phase)
            try:
                record = pilot.advance()
            except Waiting:
                record = None
            if record is not None:
                for uav, reply in mission._exchange(pilot.uav, record):
                    fleet.deliver(uav, reply)
            moved |= before != (pilot.t, pilot.phase)
        if not moved:  # time goes by
            now += 100.0
            for i, member in enumerate(station.roster):
                member.heard = now if i != 1 else member.heard
            station.tick(now)
            for uav, reply in mission._collect():
                if uav != 1:
                    fleet.deliver(uav, reply)
        assert now < 10_000, "the mission hangs"


def test_a_lost_uav_is_there_until_its_last_record(tmp_path: Path) -> None:
    flown = fly(tmp_path / "run", losing, **{"world.alpha": 0.01})
    found = messages(replay(flown.folder, 1))
    last = max(tick for tick, uav, _ in queries.moves(flown.folder, 1) if uav == 1)
    assert 10 <= last < 25
    assert [t for t, _ in ticks_of(found, "/uav/1/belief")] == list(range(last + 1))
    assert [t for t, _ in ticks_of(found, "/uav/0/belief")] == list(range(T + 1))
    for tick, scene in ticks_of(found, "/scene"):
        assert ([e.id for e in scene.entities] == ["uav-0", "uav-1", "uav-2"]) is (tick <= last)
        assert [d.id for d in scene.deletions] == ([] if tick <= last else ["uav-1"])
    logged = dict(queries.uncertainty(flown.folder, 1))
    for tick, message in ticks_of(found, "/tmc/tick"):
        assert message.uncertainty == pytest.approx(logged[tick], rel=1e-12)
        assert message.uavs == (3 if tick <= last else 2)
    for uav in (0, 2):
        for tick, grid in ticks_of(found, f"/uav/{uav}/belief")[:T]:  # at T there is nothing left to act on
            held = flown.last_visit[1, tick, uav]
            assert builders.last_visit(grid)[flown.world.law.cells].tolist() == held.tolist()


def test_a_cut_log_is_replayed_as_far_as_it_goes(together: RunData, tmp_path: Path) -> None:
    whole = messages(replay(together.folder))
    world = World(build({**BASE, "journal.chunk": 2048, "training.ticks": 400}))
    long = tmp_path / "long"
    long.mkdir()
    journal = Journal(long, world, "run")
    LockStep(world, None, journal.take).run()
    journal.writer.close()
    data = (long / "tmc.mcap").read_bytes()
    (long / "tmc.mcap").write_bytes(data[: len(data) // 3])
    made = replay_file.write(long, 1, tmp_path / "cut.mcap")
    found = messages(made.path)
    assert 20 < made.timeline.ticks < 400 and not made.timeline.whole
    assert made.timeline.damage is not None and "it is cut" in made.timeline.damage
    assert [t for t, _ in ticks_of(found, "/scene")] == list(range(made.timeline.ticks + 1))
    assert set(found) == set(whole)
    (long / "tmc.mcap").rename(long / "tmc.mcap.active")
    again = replay_file.write(long, 1, tmp_path / "active.mcap").timeline
    assert (again.damage, again.ticks, again.whole) == (None, made.timeline.ticks, False)


def test_the_same_log_gives_the_same_file(together: RunData, tmp_path: Path) -> None:
    first, again = (replay_file.write(together.folder, 1, tmp_path / name).path for name in ("1.mcap", "2.mcap"))
    assert first.read_bytes() == again.read_bytes()


def test_the_command(together: RunData, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["log", "replay", str(together.folder), "--episode", "1"]) == 0
    said = capsys.readouterr()
    path = together.folder / "replay" / "episode-000001.mcap"
    assert said.out.startswith(f"{path}: episode 1, ticks 0 to {T}") and not said.err
    assert path.with_suffix(".layout.json").is_file()
    assert cli.main(["log", "info", str(path)]) == 0
    assert "/uav/2/belief" in capsys.readouterr().out
    out = tmp_path / "deep" / "x.mcap"
    assert cli.main(["log", "replay", str(together.folder), "--out", str(out)]) == 0 and out.is_file()
    for wrong, words in (
        (["--episode", "9"], "holds no tick of episode 9: ask for 1 to 2"),
        (["--out", str(tmp_path / "tmc.mcap")], "is the name of a run's log"),
    ):
        assert cli.main(["log", "replay", str(together.folder), *wrong]) == 2
        assert words in capsys.readouterr().err
    assert cli.main(["log", "replay", str(tmp_path / "nowhere")]) == 2


def test_a_log_that_does_not_fit_its_config_is_refused(together: RunData, tmp_path: Path) -> None:
    for key, value in (("team.size", 2), ("training.ticks", 30)):
        flown_as(together.folder, tmp_path / key, {key: value})
        with pytest.raises(RecordError, match="the log does not fit its config"):
            replay_file.write(tmp_path / key, 1, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


WRONG: list[tuple[str, Callable[[Any], object]]] = [
    ("/uav/0/record", lambda r: r.cells.pop()),
    ("/uav/0/record", lambda r: r.cells.__setitem__(0, 60_000)),
    ("/uav/0/record", lambda r: r.seen_cell.__setitem__(0, 60_000) if r.seen_cell else r.cells.append(1)),
    ("/uav/0/record", lambda r: r.actions.__setitem__(0, 9) if r.actions else None),
    ("/uav/0/record", lambda r: r.blocks.__setitem__(0, 4) if r.blocks else None),
    ("/tmc/sync", lambda s: s.uavs.append(3)),
    ("/tmc/metrics", lambda s: s.uncertainty.extend([0.0] * 100)),
]


@pytest.mark.parametrize(("topic", "change"), WRONG)
def test_a_log_that_cannot_be_true_is_refused_in_a_sentence(
    together: RunData, tmp_path: Path, topic: str, change: Callable[[Any], object]
) -> None:
    config = (json.dumps(BASE)).encode()
    with LogWriter(tmp_path / "tmc.mcap", "tmc", together.world.config.journal, {}) as log:
        log.attach("config.json", "application/json", config)
        for entry in Log(together.folder / "tmc.mcap").entries():
            if entry.topic == topic:
                change(entry.message)
            log.write(entry.topic, entry.message)
    with pytest.raises(RecordError, match="the log does not fit its config of 3 UAVs and 60 ticks"):
        replay_file.write(tmp_path, 1, tmp_path / "out.mcap")


def test_rerun_finds_every_topic_in_order(together: RunData) -> None:
    rerun = Path(sys.executable).with_name("rerun")
    if not rerun.exists():
        pytest.skip("rerun-sdk is not installed")
    path = replay(together.folder)
    done = subprocess.run(
        [rerun, "mcap", "check", path], capture_output=True, text=True, timeout=PATIENCE_S, check=True,
        env=os.environ | {"RUST_LOG": "error"},
    )  # fmt: skip
    rows = [line.split() for line in done.stdout.splitlines() if " /" in line]
    assert {row[0] for row in rows} == {"ok"}, done.stdout
    assert {row[3] for row in rows} == set(messages(path))
