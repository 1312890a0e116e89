"""The numbers of a summary, against what a few plain loops over the log's facts come to."""

import json
import math
import shutil

import numpy as np
import pytest

from deploy import cli
from deploy.run.lockstep import LockStep
from tests.tmc.analysis.conftest import flown_as
from tmc.analysis.metrics import event_waits, summarize, summary
from tmc.analysis.run_data import read
from tmc.center.journal import Journal
from tmc.kernel.config import JournalConfig, build, flat
from tmc.kernel.roadmap import load_map
from tmc.kernel.uncertainty import lower_bound
from tmc.kernel.world import World
from tmc.record import overfly_pb2, queries
from tmc.record.errors import RecordError
from tmc.record.reader import Log
from tmc.record.writer import LogWriter
from tmc.wire.messages import Hello

SCENARIO_1 = {"scenario": 1, "team.controller": "planner:greedy", "training.episodes": 2, "world.alpha": 0.2}


def world_of(folder):
    return World(build(json.loads((folder / "config.json").read_text())))


def age_sum(world, moves, ticks):
    """Eq. (6) by hand: sum over cells of 1 - exp(-alpha age), mean of ticks 1..T."""
    visited = dict.fromkeys(np.flatnonzero(world.map.road).tolist(), 0)
    at = {}
    for tick, _, cell in moves:
        at.setdefault(tick, set()).add(cell)
    total = 0.0
    for t in range(ticks + 1):
        visited.update(dict.fromkeys(visited.keys() & at[t], t))
        total += sum(1 - math.exp(-0.01 * (t - v)) for v in visited.values()) if t else 0.0
    return total / ticks


def test_uncertainty_is_eq_6_and_the_ratio_that_to_the_bound(fly):
    folder = fly()
    s, world = summary(folder), world_of(folder)
    expected = age_sum(world, queries.moves(folder, 1), 60)
    bound = lower_bound(world.alpha, 3, 60)
    assert s.last.uncertainty == pytest.approx(expected, rel=1e-12)
    assert s.last.uncertainty == pytest.approx(queries.episodes(folder)[-1].uncertainty, rel=1e-12)
    assert s.last.per_cell == pytest.approx(expected / 323, rel=1e-12)
    assert s.lower_bound == pytest.approx(bound, rel=1e-12)
    assert s.last.times_bound == pytest.approx(expected / bound, rel=1e-12)
    assert s.first == s.last == s.best == s.episodes[0]


def test_roads_come_from_the_cells_flown(fly):
    folder = fly()
    s, road = summary(folder), set(np.flatnonzero(world_of(folder).map.road).tolist())
    moves = list(queries.moves(folder, 1))
    over = [cell in road for tick, _, cell in moves if tick]
    assert s.last.on_road == pytest.approx(sum(over) / len(over))
    assert s.last.coverage == pytest.approx(len(road & {cell for _, _, cell in moves}) / len(road))
    assert 0.3 < s.last.on_road < 1 and 0 < s.last.coverage < 1


def test_blocked_moves_and_reward_are_those_of_the_episodes(fly):
    folder = fly(**{"training.episodes": 2, "team.size": 12})
    s = summary(folder)
    ends = [e for e in queries.episodes(folder) if e.phase == "end"]
    assert (s.blocked_grid, s.blocked_obstacle, s.blocked_uav) == tuple(
        sum(getattr(e, f"blocked_{cause}") for e in ends) for cause in ("grid", "obstacle", "uav")
    )
    assert s.moves == 2 * 60 * 12
    assert s.blocked_share == pytest.approx(s.blocked / s.moves) and s.blocked > 0
    for found, end in zip(s.episodes, ends, strict=True):
        assert found.reward == pytest.approx(sum(end.reward) / 12 / 60, rel=1e-6)


def test_events_wait_from_the_slot_they_appear_in_to_the_next_visit(fly):
    folder = fly(**SCENARIO_1)
    s = summary(folder)
    for found in s.episodes:
        moves = list(queries.moves(folder, found.episode))
        events = list(queries.events(folder, found.episode))
        waits = [min((t - tick for t, _, c in moves if c == cell and t > tick), default=None) for tick, cell in events]
        done = [w for w in waits if w is not None]
        assert (found.events_appeared, found.events_cleared) == (len(events), len(done))
        assert found.mean_wait == pytest.approx(sum(done) / len(done))
        # What appeared and was not cleared is what is active at the end.
        assert len(events) - len(done) == dict(queries.uncertainty(folder, found.episode))[60]
    assert s.lower_bound is None and s.last.times_bound is None


def test_an_event_under_a_uav_waits_for_the_next_tick():
    cells = np.array([[5], [5], [6], [5]])
    assert event_waits(cells, np.array([[1, 5], [2, 6], [2, 5]])).tolist() == [2, 0, 1]


def test_a_fixed_mission_means_all_episodes_and_training_the_last_tenth(fly, learned):
    s = summary(fly(**SCENARIO_1))
    assert s.mean.episodes == 2 and not s.mission.learning
    assert s.mean.uncertainty == pytest.approx(np.mean([e.uncertainty for e in s.episodes]))
    t = summary(learned)
    assert t.mission.learning and t.mission.controller == "a policy in training"
    assert (t.mean.episodes, t.mean.uncertainty) == (1, t.last.uncertainty)
    assert t.best.uncertainty == min(e.uncertainty for e in t.episodes)
    assert t.pace.ticks == 180 and t.pace.updates > 100 and t.pace.loss is not None
    assert 180 / t.pace.ticks_per_second == pytest.approx(t.pace.seconds, abs=0.0006)  # which is in whole ms


def test_mission_says_what_was_planned(fly):
    m = summary(fly(**SCENARIO_1)).mission
    assert (m.controller, m.scenario, m.uavs, m.T_u, m.map, m.seed) == (
        "planner:greedy",
        1,
        3,
        1,
        "downtown-toronto",
        3,
    )
    assert (m.episodes_flown, m.episodes_planned, m.ticks, m.road_cells) == (2, 2, 60, 323)


def test_json_holds_it_all(fly):
    s = summary(fly())
    found = json.loads(s.to_json())
    assert found["last"]["uncertainty"] == s.last.uncertainty
    assert found["episodes"][0] == found["first"] and found["lower_bound"] == s.lower_bound


# Runs that are not whole.


def copy_of(folder, to):
    return shutil.copytree(folder, to / "copy")


def cut(folder, share):
    log = folder / "tmc.mcap"
    data = log.read_bytes()
    log.unlink()
    (folder / "tmc.mcap.active").write_bytes(data[: int(len(data) * share)])


@pytest.fixture
def long_run(fly):
    return fly(**{"training.ticks": 400, "training.episodes": 2, "journal.chunk": 4096})


def test_a_cut_log_gives_what_is_sound(long_run, tmp_path):
    folder = copy_of(long_run, tmp_path)
    cut(folder, 0.7)
    s, whole = summary(folder), summary(long_run)
    assert s.episodes[0] == whole.episodes[0]
    assert s.mission.episodes_flown == 1 and not s.episodes[1].complete and 0 < s.episodes[1].ticks < 400
    assert s.last.episode == 1
    assert any("cut" in note for note in s.health.notes)
    partial = read(folder).episodes[1]
    whole_curve = [u for _, u in queries.uncertainty(long_run, 2)]
    assert s.episodes[1].uncertainty == pytest.approx(np.mean(whole_curve[1 : partial.ticks + 1]))


def test_a_first_episode_that_breaks_off_still_has_numbers(long_run, tmp_path):
    folder = copy_of(long_run, tmp_path)
    cut(folder, 0.3)
    s = summary(folder)
    assert s.mission.episodes_flown == 0 and s.last.episode == 1 and 0 < s.last.ticks < 400
    assert s.last.times_bound is not None and s.last.times_bound >= 1


def test_an_active_log_is_noted_as_such(fly, tmp_path):
    folder = copy_of(fly(), tmp_path)
    data = (folder / "tmc.mcap").read_bytes()
    end = data.rindex(b"\x0f" + (4).to_bytes(8, "little"))  # DataEnd: what a writer that was killed never wrote
    (folder / "tmc.mcap").unlink()
    (folder / "tmc.mcap.active").write_bytes(data[:end])
    s = summary(folder)
    assert s.last.complete and [n for n in s.health.notes if "not closed" in n]


def test_learner_metrics_count_the_last_time_they_were_done(learned, tmp_path):
    folder = copy_of(learned, tmp_path)
    (folder / "learner.mcap").unlink()
    with LogWriter(folder / "learner.mcap", "learner", JournalConfig(), {}) as log:
        for updates, loss in ((10, 1.0), (20, 2.0), (500, 3.0), (20, 7.0)):
            log.write(
                "/learner/metrics", overfly_pb2.LearnerMetrics(updates=updates, loss=loss, q_mean=loss, target_mean=1)
            )
    learning = read(folder).learning
    assert learning.updates.tolist() == [10, 20, 500] and learning.loss.tolist() == [1.0, 7.0, 3.0]
    s = summary(folder)
    assert (s.pace.updates, s.pace.loss, s.pace.q_mean) == (500, 3.0, 3.0)


def test_without_the_learners_log_the_tmc_knows_its_policies(learned, tmp_path):
    folder = tmp_path / "tmc-host"
    folder.mkdir()
    shutil.copy(learned / "config.json", folder)
    with LogWriter(folder / "tmc.mcap", "tmc", JournalConfig(), {}) as log:
        for version, (updates, loss) in enumerate(((0, 0.0), (100, 0.5), (150, 0.25)), 1):
            log.write("/learner/policy", overfly_pb2.Policy(version=version, updates=updates, loss=loss))
        for entry in Log(learned / "tmc.mcap").entries():
            log.write(entry.topic, entry.message)
    s = summary(folder)
    assert s.mission.learning and (s.pace.updates, s.pace.loss, s.pace.q_mean) == (150, 0.25, None)
    assert read(folder).learning.updates.tolist() == [100, 150]
    assert s.episodes == summary(learned).episodes


def test_an_empty_log_of_another_process_is_a_note(fly, tmp_path):
    folder = copy_of(fly(), tmp_path)
    (folder / "uav-000.mcap.active").write_bytes(b"")
    assert any("is empty" in note for note in summary(folder).health.notes)


def test_exit_codes_and_restarts_come_from_run_json(fly, tmp_path):
    folder = copy_of(fly(), tmp_path)
    (folder / "run.json").write_text('{"command": "overfly fly", "exit_codes": {"tmc": 0}, "restarts": {"uav-000": 2}}')
    s = summary(folder)
    assert (s.mission.command, s.health.exit_codes, s.health.restarts) == ("overfly fly", {"tmc": 0}, {"uav-000": 2})
    (folder / "run.json").write_text("{")
    assert summary(folder).health.exit_codes == {}


def test_a_map_whose_file_is_gone_comes_from_the_log(fly, tmp_path):
    raster = tmp_path / "town.txt"
    raster.write_text("cell_m: 60\n" + "#########\n#...X...#\n#########\n")
    folder = fly(**{"world.map": str(raster)})
    before = summary(folder)
    raster.unlink()
    after = summary(folder)
    assert after.episodes == before.episodes and not before.health.notes
    assert any("is gone" in note for note in after.health.notes)
    raster.write_text("#########\n#.......#\n#########\n")
    assert any("changed since" in note for note in summary(folder).health.notes)


def test_without_config_json_the_log_has_it(fly, tmp_path):
    folder = copy_of(fly(), tmp_path)
    (folder / "config.json").unlink()
    assert summary(folder).episodes == summary(fly()).episodes
    for broken in ('{"scenario": 7}', "", "[]"):  # an empty one is what a power cut may leave
        (folder / "config.json").write_text(broken)
        assert "config.json: not a config; the log's settings are used" in summary(folder).health.notes
        assert summary(folder).episodes == summary(fly()).episodes
    data = bytearray((folder / "tmc.mcap").read_bytes())
    data[data.index(b'"world.map"')] = ord("}")
    (folder / "tmc.mcap").write_bytes(data)
    with pytest.raises(RecordError, match="is not the config of a run of log format 2"):
        read(folder)


def test_a_log_that_does_not_fit_its_settings_is_refused(fly, tmp_path):
    flown_as(fly(), tmp_path / "R", {"team.size": 2})
    with pytest.raises(RecordError, match="does not fit its config of 2 UAVs"):
        read(tmp_path / "R")


def test_the_settings_in_the_log_count_and_the_edited_ones_are_named(fly, tmp_path):
    folder = copy_of(fly(), tmp_path)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"team.size": 2, "training.seed": 99}))
    s = summary(folder)
    assert (s.mission.uavs, s.mission.seed, s.episodes) == (3, 3, summary(fly()).episodes)
    note = "config.json: team.size, training.seed changed since the run; the log's settings are used"
    assert list(s.health.notes) == [note]
    (folder / "config.json").write_text(json.dumps({k: v for k, v in config.items() if k != "training.seed"}))
    assert "config.json: training.seed changed" in summary(folder).health.notes[0]


def test_the_copy_of_the_map_in_the_run_folder_counts(fly, tmp_path):
    raster = tmp_path / "town.txt"
    raster.write_text("name: Old town\ncell_m: 25\n#########\n#.......#\n#########\n")
    folder = copy_of(fly(**{"world.map": str(raster)}), tmp_path / "moved")
    (folder / "map.txt").write_text(load_map(str(raster)).source)
    raster.unlink()
    s = summary(folder)
    assert (s.mission.map, s.mission.cell_m, s.health.notes) == ("Old town", 25.0, ())
    (folder / "map.txt").write_text("#########\n#...X...#\n#########\n")
    assert "map map.txt: changed since the run; the log's copy is used" in summary(folder).health.notes
    assert summary(folder).episodes == s.episodes


def test_what_is_no_run_is_refused(tmp_path, fly):
    with pytest.raises(RecordError, match="holds no logs of a run"):
        read(tmp_path)
    folder = copy_of(fly(), tmp_path)
    (folder / "tmc.mcap").unlink()
    with LogWriter(folder / "tmc.mcap", "tmc", JournalConfig(), {}) as log:
        log.log("info", "no UAV came")
    with pytest.raises(RecordError, match="holds no flight"):
        read(folder)
    (folder / "tmc.mcap").rename(folder / "uav-000.mcap")
    with pytest.raises(RecordError, match=r"holds no tmc\.mcap"):
        read(folder)


def test_reading_changes_nothing(fly):
    folder = fly()
    before = {p: p.stat().st_mtime_ns for p in folder.rglob("*.mcap")}
    summarize(read(folder))
    assert {p: p.stat().st_mtime_ns for p in folder.rglob("*.mcap")} == before
    assert Log(folder / "tmc.mcap").finished


@pytest.mark.parametrize("ticks", [0, 20])
def test_a_team_of_which_some_or_all_are_missing_is_summed_up_and_drawn(ticks, tmp_path):
    """UAV 1 is gone from the first episode's start on; with `ticks` 0, so is UAV 0 after the start of the second."""
    config = build({"team.size": 2, "team.controller": "planner:greedy", "training.episodes": 2, "training.ticks": 20})
    (tmp_path / "config.json").write_text(json.dumps(flat(config)))
    journal = Journal(tmp_path, world := World(config), "run")
    mission = LockStep(world, None, journal.take)
    for i in (0, 1):
        for to, message in mission._exchange(i, Hello(role="uav", uav=i, incarnation=1)):
            mission.fleet.deliver(to, message)
    mission.fleet.pilots[1].advance = lambda: None
    station, now = mission.station, 100.0
    while station.episodes < 2:
        while (station.episodes == 0 or ticks) and mission.fleet.step():
            pass
        mission.fleet.step()
        now += 100.0
        station.roster[0].heard = now if station.episodes == 0 or ticks else 0.0
        station.tick(now)
        for to, message in mission._collect():
            mission.fleet.deliver(to, message)
    journal.writer.close()
    s = summary(tmp_path)
    last = s.episodes[-1]
    assert (last.reward, last.on_road) == (0.0, 0.0) if not ticks else (last.reward > 0.0 and last.on_road == 1.0)
    assert json.loads(s.to_json())["episodes"][0]["ticks"] == 20
    assert cli.main(["analyze", str(tmp_path)]) == 0
    assert (tmp_path / "report" / "paths.png").stat().st_size > 1000
