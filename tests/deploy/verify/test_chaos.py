"""The parts of `overfly verify chaos`: the checker finds lost, doubled and altered records; faults, cuts and seeds."""

from __future__ import annotations

import socket
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from random import Random
from types import SimpleNamespace

import numpy as np
import pytest

from deploy.cli import main
from deploy.verify.chaos import proxy
from deploy.verify.chaos.checker import Snapshot, check_delivery
from deploy.verify.chaos.faults import CUT, KILL, POWER, STOP, draw_faults, role
from deploy.verify.chaos.power import cut_tails
from deploy.verify.chaos.proxy import Forwarder
from deploy.verify.chaos.schedule import FaultSchedule, Growth
from tests.command import PATIENCE_S
from tmc.kernel.config import JournalConfig
from tmc.record import builders
from tmc.record.builders import record_digest
from tmc.record.writer import LogWriter
from tmc.wire import messages as m

NAMES = ["tmc", "learner", "uav-000", "uav-001", "uav-002"]
NONE = np.zeros(0, "u1")


def record(uav: int, sequence: int, cell: int = 7) -> m.Record:
    cells = np.array([cell], "<u2")
    return m.Record(
        uav=uav,
        incarnation=5,
        sequence=sequence,
        episode=1,
        first=sequence,
        tick=sequence,
        version=0,
        policy=0,
        cells=cells,
        actions=NONE,
        blocks=NONE,
        rewards=np.zeros(0, "<f4"),
        seen_tick=m.EMPTY,
        seen_cell=m.EMPTY,
    )


def prepare(out: Path, journalled: list[m.Record], acknowledged: list[m.Record]) -> None:
    """Make a run folder with these records in the journal, and these in the logs of acknowledgements."""
    (out / "acks").mkdir(parents=True)
    with LogWriter(out / "tmc.mcap", "tmc", JournalConfig(), {}) as log:
        for one in journalled:
            log.write(f"/uav/{one.uav}/record", builders.flight_record(one))
    for one in acknowledged:
        with (out / "acks" / f"uav-{one.uav:03d}.txt").open("a") as file:
            file.write(f"{one.sequence} {record_digest(one)}\n")


FLOWN = [record(uav, sequence) for sequence in range(4) for uav in range(2)]


def test_acknowledged_and_journalled_records_are_neither_lost_nor_doubled(tmp_path: Path) -> None:
    prepare(tmp_path, FLOWN, [*FLOWN[:6], replace(FLOWN[6], incarnation=99)])  # another incarnation, the same flight
    found = check_delivery(tmp_path)
    assert (found.acknowledged, found.journalled, found.lost, found.doubled) == (7, 8, 0, 0)


def test_a_lost_record_is_seen(tmp_path: Path) -> None:
    prepare(tmp_path, FLOWN[:7], FLOWN)
    found = check_delivery(tmp_path)
    assert (found.acknowledged, found.journalled, found.lost, found.doubled) == (8, 7, 1, 0)


def test_a_doubled_record_is_seen(tmp_path: Path) -> None:
    prepare(tmp_path, [*FLOWN, FLOWN[3], FLOWN[3], FLOWN[5]], FLOWN)
    assert (check_delivery(tmp_path).lost, check_delivery(tmp_path).doubled) == (0, 2)


def test_another_digest_is_seen(tmp_path: Path) -> None:
    prepare(tmp_path, [record(0, 0, cell=8), *FLOWN[1:]], FLOWN)
    assert (check_delivery(tmp_path).lost, check_delivery(tmp_path).doubled) == (1, 0)


def test_a_record_that_was_lost_by_a_kill_and_flown_again_counts_as_lost(tmp_path: Path) -> None:
    prepare(tmp_path, FLOWN[:4], FLOWN[:7])
    snapshot = Snapshot.capture(tmp_path)
    (tmp_path / "tmc.mcap").unlink()
    with LogWriter(tmp_path / "tmc.mcap", "tmc", JournalConfig(), {}) as log:
        for one in FLOWN:
            log.write(f"/uav/{one.uav}/record", builders.flight_record(one))
    assert check_delivery(tmp_path).lost == 0
    assert snapshot.lost() == {(0, 2), (1, 2), (0, 3)}
    assert check_delivery(tmp_path, [(0, 2), (1, 2), (0, 3)]).lost == 3
    assert not list((tmp_path / "acks").glob("killed*"))


# Faults.


@pytest.mark.parametrize("power", [False, True])
def test_faults_are_drawn_from_their_seed(power: bool) -> None:
    drawn = draw_faults(200, 4, NAMES, power=power)
    assert drawn == draw_faults(200, 4, NAMES, power=power) != draw_faults(200, 5, NAMES, power=power)
    assert sum(fault.kills for fault in drawn) == 200
    kinds = Counter(fault.kind for fault in drawn)
    assert kinds[STOP] > 30 and kinds[CUT] > 30 and (kinds[POWER] > 60 if power else not kinds[POWER])
    killed = Counter(role(name) for fault in drawn if fault.kind == KILL for name in fault.targets)
    assert min(killed.values()) > 0.6 * max(killed.values()) and set(killed) == {"tmc", "learner", "uav"}
    assert any(len(fault.targets) == 2 for fault in drawn) and all(0.1 <= fault.seconds <= 1.0 for fault in drawn)


def test_the_rest_of_a_fault_is_postponed_to_the_next_mission(tmp_path: Path) -> None:
    schedule = FaultSchedule(draw_faults(1, 1, ["tmc"], power=False), lambda _: None, tmp_path / "history.txt")
    assert schedule.next is not None
    fault = schedule.next
    schedule.start_next()
    schedule.postpone(replace(fault, targets=()))
    assert schedule.next is None or schedule.next.kind != KILL
    schedule.postpone(fault)
    assert schedule.next == fault


def test_updates_lost_by_a_restart_do_not_reduce_the_growth() -> None:
    growth = Growth()
    status = m.Status(
        phase="flying",
        episode=1,
        tick=10,
        ticks=10,
        updates=100,
        policy=1,
        loss=0.0,
        uncertainty=0.0,
        episode_uncertainty=0.0,
        blocked=0,
        rejected=0,
        waiting="",
    )
    for updates in (100, 103, 40, 42):
        growth.update(replace(status, updates=updates))
        growth.update(None)
    assert (growth.ticks, growth.updates) == (0, 5)


# A power cut.


def test_a_power_cut_leaves_what_was_synced(tmp_path: Path) -> None:
    journal, draw, left = tmp_path / "tmc.mcap.active", Random(1), set[int]()
    (tmp_path / "acks").mkdir()
    for _ in range(50):
        journal.write_bytes(bytes(range(200)))
        (tmp_path / "acks" / "tmc.txt").write_text(f"7 400\n{journal.stat().st_ino} 120\n")
        (tmp_path / "uav-000.mcap.active").write_bytes(bytes(100))
        lost = cut_tails(tmp_path, draw)
        left.add(journal.stat().st_size)
        assert journal.stat().st_size == 200 - lost >= 120
        assert journal.read_bytes() == bytes(range(200))[: 200 - lost]
    assert len(left) > 20 and (tmp_path / "uav-000.mcap.active").stat().st_size <= 100


def test_a_journal_that_was_just_replaced_was_synced_as_a_whole(tmp_path: Path) -> None:
    journal = tmp_path / "tmc.mcap.active"
    journal.write_bytes(bytes(200))
    (tmp_path / "acks").mkdir()
    (tmp_path / "acks" / "tmc.txt").write_text(f"{journal.stat().st_ino + 1} 20\n")
    assert cut_tails(tmp_path, Random(1)) == 0 and journal.stat().st_size == 200


# The proxy.


@pytest.fixture
def line(short: Path) -> Iterator[tuple[Forwarder, socket.socket, Path]]:
    """Yield a forwarder, the listener behind it, and the path that it listens at."""
    front, back = short / "front", short / "back"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(back))
        listener.listen()
        forwarder = Forwarder(front, back)
        yield forwarder, listener, front
        forwarder.close()


def call(front: Path) -> socket.socket:
    sock = socket.socket(socket.AF_UNIX)
    sock.settimeout(PATIENCE_S)
    sock.connect(str(front))
    return sock


def test_bytes_pass_both_ways_until_they_are_cut_off(
    line: tuple[Forwarder, socket.socket, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    forwarder, listener, front = line
    now = [100.0]
    monkeypatch.setattr(proxy, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with call(front) as client:
        server, _ = listener.accept()
        with server:
            sent = bytes(range(256)) * 1000
            client.sendall(sent)
            got = b""
            while len(got) < len(sent):
                got += server.recv(65_536)
            assert got == sent
            server.sendall(b"back")
            assert client.recv(10) == b"back"
            for seed in range(20):  # each cut drops some connections or all
                forwarder.cut(0.3, Random(seed))
            assert server.recv(1) == b"" and client.recv(1) == b""
    with call(front) as refused:
        assert refused.recv(1) == b""
    now[0] += 0.31
    with call(front) as again:
        listener.settimeout(PATIENCE_S)
        server, _ = listener.accept()
        again.sendall(b"here")
        assert server.recv(10) == b"here"
        server.close()


def test_a_server_that_is_gone_is_shown_to_the_client(line: tuple[Forwarder, socket.socket, Path]) -> None:
    _, listener, front = line
    listener.close()
    with call(front) as client:
        assert client.recv(1) == b""


# Mistakes.


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--kills", "0"), "--kills must be 1 or more"),
        (("--mode", "fly", "--who", "planner:genius"), "there is no planner"),
        (("nonsense",), "there is no preset"),
        (("--set", "dqn.gama=1"), "there is no setting"),
        (("--actors", "4000"), "team.size"),
    ],
)
def test_mistakes_are_one_sentence(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, options: tuple[str, ...], text: str
) -> None:
    assert main(["verify", "chaos", *options, "--keep", str(tmp_path / "none")]) == 2
    err = capsys.readouterr().err
    assert text in err and err.count("\n") == 1
    assert not (tmp_path / "none").exists()
