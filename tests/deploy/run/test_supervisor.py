"""The supervisor: which processes are restarted, after how long, when it fails, and that nothing is left behind."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from deploy.run import supervisor as supervisors
from deploy.run.forked import Forked, ForkServer, forkserver_command
from deploy.run.plan import Child, Plan, make
from deploy.run.supervisor import MissionFailed, Supervisor
from tests.command import PATIENCE_S
from tmc.kernel.config import build
from tmc.wire import process

ROOT = Path(__file__).parents[3]


def python(name: str, code: str, *, restart: bool = True, leads: bool = False) -> Child:
    """Return a process of the plan that runs `code`."""
    return Child(name, (sys.executable, "-P", "-c", code), restart=restart, leads=leads)


NOWHERE = "tcp://127.0.0.1:1"
"""Where no TMC ever is."""


def uav(number: int, out: Path) -> Child:
    """Return a forked UAV that sends Hello for ever, without a TMC."""
    command = ("--id", str(number), "--connect", NOWHERE, "--out", str(out))
    return Child(f"uav-{number:03d}", command, restart=True, fork_of="actors")


def learner(out: Path) -> Child:
    """Return a forked learner that sends Hello for ever, without a TMC."""
    command = ("--connect", NOWHERE, "--out", str(out))
    return Child("learner", command, restart=True, fork_of="learner")


@pytest.fixture
def supervise(tmp_path: Path) -> Iterator[Callable[..., Supervisor]]:
    """Return a function that starts a supervisor of children; its notes are in `.notes`."""
    made: list[Supervisor] = []

    def start(*children: Child) -> Supervisor:
        notes: list[str] = []
        scratch = tmp_path / "scratch"
        scratch.mkdir(exist_ok=True)
        plan = Plan(tuple(children), "", scratch / "tracks", scratch)
        made.append(Supervisor(plan, tmp_path, 1, notes.append))
        made[-1].notes = notes  # type: ignore[attr-defined]
        made[-1].start()
        return made[-1]

    yield start
    for supervisor in made:
        supervisor.stop()
        supervisor.close()


def watch_until(supervisor: Supervisor, done: Callable[[], bool]) -> None:
    until = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < until, "it did not happen"
        supervisor.watch()
        time.sleep(0.01)


def alive(pid: int) -> bool:
    """Return whether a process runs; a zombie does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_failing_process_is_restarted_with_back_off_until_the_run_fails(supervise, monkeypatch) -> None:
    monkeypatch.setattr(supervisors, "MAX_CRASHES", 4)
    supervisor = supervise(python("learner", "import sys; sys.exit(1)"))
    begin = time.monotonic()
    with pytest.raises(MissionFailed, match="learner ended with exit code 1"):
        watch_until(supervisor, lambda: False)
    assert supervisor.restarts() == {"learner": 3}
    assert time.monotonic() - begin > 0.1 + 0.2 + 0.4


@pytest.mark.parametrize("code", sorted(supervisors.FINAL))
def test_a_mistake_is_not_tried_again(supervise, code: int) -> None:
    text = f"import sys; print('overfly: what was wrong', file=sys.stderr); sys.exit({code})"
    supervisor = supervise(python("learner", text))
    with pytest.raises(MissionFailed, match="what was wrong; its output is in"):
        watch_until(supervisor, lambda: False)
    assert supervisor.restarts() == {}


def test_a_full_disk_is_named_at_once(supervise, monkeypatch) -> None:
    """The process's log has no space for its own sentence, and a restart would not help."""
    monkeypatch.setattr(supervisors, "FULL_DISK_BYTES", 2**62)
    supervisor = supervise(python("tmc", "import sys; sys.exit(1)", leads=True))
    with pytest.raises(MissionFailed, match="is full; free some space, and resume with `overfly run --resume"):
        watch_until(supervisor, lambda: False)
    assert supervisor.restarts() == {}


def test_the_mission_ends_with_its_leader(supervise) -> None:
    supervisor = supervise(python("tmc", "", restart=False, leads=True))
    watch_until(supervisor, supervisor.watch)
    assert supervisor.exit_codes() == {"tmc": 0}


@pytest.fixture
def once(tmp_path: Path) -> Callable[[str, float, int], Child]:
    """Return a maker of processes that end with `code` after `wait` seconds; once restarted, they stay."""

    def make(name: str, wait: float, code: int) -> Child:
        text = (
            f"import pathlib, sys, time; seen = pathlib.Path({str(tmp_path)!r}) / {name!r}; new = not seen.exists(); "
        )
        text += f"seen.touch(); time.sleep({wait} if new else 60); sys.exit({code} if new else 0)"
        return python(name, text, leads=name == "tmc")

    return make


def test_a_process_that_left_before_the_tmc_was_back_is_restarted(supervise, once) -> None:
    """It left because the mission was over, or the TMC stopped. The TMC's next incarnation may still need it."""
    supervisor = supervise(once("tmc", 1.0, process.STOPPED), once("uav-000", 0.0, 0))
    watch_until(supervisor, lambda: supervisor.restarts() == {"tmc": 1, "uav-000": 1} and len(supervisor.pids()) == 2)


def test_a_process_that_left_a_killed_tmc_late_is_restarted(supervise, once, monkeypatch) -> None:
    """The TMC's previous incarnation ended it. A process that started after the current TMC is not restarted."""
    monkeypatch.setattr(supervisors, "LEAVE_TIMEOUT_S", 1.0)
    supervisor = supervise(once("tmc", 0.5, process.STOPPED), once("learner", 4.0, 0))
    begin = time.monotonic()
    watch_until(supervisor, lambda: supervisor.restarts() == {"tmc": 1, "learner": 1})
    assert time.monotonic() - begin > 5.0
    supervisor.running[1].started = supervisor.running[0].started - 1.0
    supervisor.running[1].left = time.monotonic() - 9.0
    assert supervisor._left_previous_incarnation(supervisor.running[1])
    supervisor.running[1].started = supervisor.running[0].started + 1.0
    assert not supervisor._left_previous_incarnation(supervisor.running[1])


def test_kills_from_outside_do_not_count(supervise, tmp_path: Path) -> None:
    supervisor = supervise(uav(0, tmp_path))
    seen: set[int] = set()
    for _ in range(supervisors.MAX_CRASHES + 4):
        watch_until(supervisor, lambda: supervisor.pids().get("uav-000", -1) not in {*seen, -1})
        pid = supervisor.pids()["uav-000"]
        seen.add(pid)
        os.kill(pid, signal.SIGKILL)
        watch_until(supervisor, lambda pid=pid: not alive(pid))
    watch_until(supervisor, lambda: supervisor.restarts() == {"uav-000": supervisors.MAX_CRASHES + 4})
    assert any("uav-000 was killed by SIGKILL; it is started again" in note for note in supervisor.notes)


def test_a_forked_uav_fails_like_any_other(supervise, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(supervisors, "MAX_CRASHES", 2)
    command = ("--id", "0", "--connect", "nowhere", "--out", str(tmp_path))
    wrong = Child("uav-000", command, restart=True, fork_of="actors")
    supervisor = supervise(wrong)
    with pytest.raises(MissionFailed, match=r"uav-000 ended with exit code 2: .*nowhere"):
        watch_until(supervisor, lambda: False)
    assert supervisor.exit_codes() == {"uav-000": process.USAGE}


def test_a_forked_uav_has_its_own_title_session_and_output(supervise, tmp_path: Path) -> None:
    supervisor = supervise(uav(0, tmp_path), uav(1, tmp_path))
    watch_until(supervisor, lambda: {"uav-000", "uav-001"} <= set(supervisor.pids()))
    pids = supervisor.pids()

    def line() -> str:
        return Path(f"/proc/{pids['uav-001']}/cmdline").read_bytes().replace(b"\0", b" ").decode()

    watch_until(supervisor, lambda: f"actors --id 1 --connect {NOWHERE}" in line())
    assert f"--out {tmp_path}" in line()
    assert os.getsid(pids["uav-001"]) == pids["uav-001"]
    assert Path(f"/proc/{pids['uav-001']}/fd/2").readlink() == tmp_path / "logs" / "uav-001.txt"
    supervisor.stop()
    assert set(supervisor.exit_codes().values()) <= {process.STOPPED, -signal.SIGTERM}  # before it could note it
    supervisor.close()
    assert not [pid for pid in pids.values() if alive(pid)]


def test_a_lost_forkserver_is_replaced_and_its_uavs_come_back(supervise, tmp_path: Path) -> None:
    supervisor = supervise(uav(0, tmp_path))
    watch_until(supervisor, lambda: "uav-000" in supervisor.pids())
    before = supervisor.pids()
    os.kill(before["forkserver-actors"], signal.SIGKILL)
    watch_until(supervisor, lambda: not alive(before["uav-000"]))
    watch_until(supervisor, lambda: supervisor.pids().get("uav-000", before["uav-000"]) != before["uav-000"])
    assert supervisor.restarts() == {"uav-000": 1}


def test_a_killed_learner_is_forked_again_by_a_process_without_threads(supervise, tmp_path: Path) -> None:
    """A fork has none of the other threads: it would wait for ever for an earlier thread pool."""
    supervisor = supervise(learner(tmp_path))
    watch_until(supervisor, lambda: "learner" in supervisor.pids())
    before = supervisor.pids()
    os.kill(before["learner"], signal.SIGKILL)
    watch_until(supervisor, lambda: supervisor.pids().get("learner", before["learner"]) != before["learner"])
    after = supervisor.pids()
    assert after["forkserver-learner"] == before["forkserver-learner"]
    assert len(list(Path(f"/proc/{after['forkserver-learner']}/task").iterdir())) == 1
    assert supervisor.restarts() == {"learner": 1}


def test_a_forkserver_that_cannot_start_is_a_failure_not_a_kill(tmp_path: Path) -> None:
    server = ForkServer((sys.executable, "-c", "raise SystemExit(3)"), dict(os.environ), tmp_path / "forkserver.txt")
    child = server.start("uav-000", ["--id", "0"], tmp_path / "uav-000.txt")
    assert isinstance(child, Forked) and child.wait(PATIENCE_S) == process.FAILED
    server.close()


@pytest.mark.parametrize(
    ("name", "package", "options"), [("uav-000", "actors", ("--id", "0")), ("learner", "learner", ())]
)
def test_all_processes_end_with_a_killed_supervisor(
    tmp_path: Path, name: str, package: str, options: tuple[str, ...]
) -> None:
    code = f"""
import sys, time
from pathlib import Path
sys.path.insert(0, {str(ROOT)!r})
from deploy.run.plan import Child, Plan
from deploy.run.supervisor import Supervisor
out = Path({str(tmp_path)!r})
command = (*{options}, "--connect", "{NOWHERE}", "--out", str(out))
child = Child("{name}", command, True, fork_of="{package}")
supervisor = Supervisor(Plan((child,), "", out / "tracks", out / "scratch"), out, 1, print)
supervisor.start()
until = time.monotonic() + {PATIENCE_S}
while "{name}" not in supervisor.pids():
    assert time.monotonic() < until
    time.sleep(0.01)
print(*supervisor.pids().values(), flush=True)
time.sleep({PATIENCE_S})
"""
    with subprocess.Popen([sys.executable, "-P", "-c", code], stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        pids = [int(pid) for pid in run.stdout.readline().split()]
        assert len(pids) == 2 and all(alive(pid) for pid in pids)
        run.kill()
    until = time.monotonic() + PATIENCE_S
    while any(alive(pid) for pid in pids):
        assert time.monotonic() < until, "a process outlived its supervisor"
        time.sleep(0.02)


def test_what_a_killed_supervisor_left_in_memory_is_removed_by_the_next(tmp_path: Path) -> None:
    config = build({"team.controller": "planner:random"})
    living, dead = make(config, tmp_path, policy=None), make(config, tmp_path, policy=None)
    assert living.held is not None and dead.held is not None
    try:
        dead.held.close()  # as a kill does
        after = make(config, tmp_path, policy=None)
        assert living.scratch.exists() and after.scratch.exists() and not dead.scratch.exists()
        shutil.rmtree(after.scratch)
        after.held.close()  # type: ignore[union-attr]
    finally:
        living.held.close()
        shutil.rmtree(living.scratch)


def threads_of(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/task").iterdir()))


def test_processes_are_forked_from_one_without_threads(tmp_path: Path) -> None:
    """A fork has none of the other threads. The preloaded modules start none with the installed versions."""
    plan = make(build({"team.size": 1}), tmp_path, policy=None)
    supervisor = Supervisor(plan, tmp_path, 1, lambda _: None)
    supervisor.start()
    try:
        watch_until(supervisor, lambda: {"uav-000", "learner"} <= set(supervisor.pids()))
        pids = supervisor.pids()
        assert {name: threads_of(pids[name]) for name in ("forkserver-actors", "forkserver-learner")} == {
            "forkserver-actors": 1,
            "forkserver-learner": 1,
        }
        assert plan.preload == {"actors": ("actors.policy",)}
        said = [log.read_text() for log in (tmp_path / "logs").glob("forkserver-*.txt")]
        assert not [text for text in said if "threads run after importing" in text], "what is preloaded was left out"
    finally:
        supervisor.stop()
        supervisor.close()


def test_a_preloaded_module_that_starts_a_thread_is_left_out(tmp_path: Path) -> None:
    """A later version of a library may: the forkserver starts again without it, under the same process id."""
    (tmp_path / "threaded.py").write_text(
        "import threading, time\nthreading.Thread(target=time.sleep, args=(60,), daemon=True).start()\n"
    )
    line = forkserver_command("actors", tmp_path, ["threaded"])
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}
    server = ForkServer(line, environment, tmp_path / "forkserver.txt")
    command = ("--id", "0", "--connect", f"ipc://{tmp_path}/no-tmc", "--out", str(tmp_path))
    child = server.start("uav-000", command, tmp_path / "uav-000.txt")
    try:
        until = time.monotonic() + 60
        while child.pid is None:
            assert child.poll() is None and time.monotonic() < until
            time.sleep(0.01)
        assert server.pid is not None and threads_of(server.pid) == 1
        assert "2 threads run after importing actors, threaded" in (tmp_path / "forkserver.txt").read_text()
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait(10.0)
        server.close()


def test_the_reason_of_a_crash_is_repeated_and_a_note_is_not(supervise, monkeypatch) -> None:
    monkeypatch.setattr(supervisors, "MAX_CRASHES", 1)
    text = (
        "from tmc.wire.process import note, run_child\n"
        "def main():\n    note('it waits for something')\n    return 1 // 0\n"
        "raise SystemExit(run_child(main, ()))"
    )
    supervisor = supervise(python("tmc", text, leads=True))
    with pytest.raises(MissionFailed, match=r"tmc ended with exit code 1: ZeroDivisionError: .*; its output is in"):
        watch_until(supervisor, lambda: False)
    assert "Traceback" in supervisor.log_of("tmc").read_text()


def test_a_program_that_cannot_be_started_is_one_sentence(supervise, tmp_path: Path) -> None:
    with pytest.raises(MissionFailed, match="tmc cannot be started: No such file"):
        supervise(Child("tmc", (str(tmp_path / "none"),), restart=True, leads=True))


def test_the_last_message_before_an_abort_is_shown(supervise, monkeypatch: pytest.MonkeyPatch) -> None:
    """ZeroMQ aborts so in a TMC without a free descriptor."""
    monkeypatch.setattr(supervisors, "MAX_CRASHES", 2)
    said = "Too many open files (src/ip_resolver.cpp:1)\\x1b[31m\\n"
    supervisor = supervise(python("tmc", f"import os; os.write(2, b'{said}'); os.abort()", leads=True))
    with pytest.raises(MissionFailed, match=r"tmc was killed by SIGABRT: Too many open files .*\\x1b\[31m; its output"):
        watch_until(supervisor, lambda: False)
    assert "tmc was killed by SIGABRT: Too many open files" in supervisor.notes[0]
