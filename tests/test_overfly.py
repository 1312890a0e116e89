"""The Python face: its examples, what it loads, what it gives, its errors, and that it leaves its host as it was."""

from __future__ import annotations

import doctest
import json
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import overfly
from actors.planners import LocalState
from actors.policy import PolicyController
from tests.command import PATIENCE_S, here
from tmc.kernel.observation import ObservationBuilder
from tmc.record import queries

ROOT = Path(__file__).parents[1]
SMALL: dict[str, Any] = {"replay.learn_start": 8, "dqn.batch_size": 8}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> overfly.Run:
    out = tmp_path_factory.mktemp("flown") / "R"
    return overfly.fly("planner:greedy", out=out, lockstep=True, actors=2, ticks=30, episodes=2, quiet=True)


def python(code: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a program of a user's."""
    (cwd / "program.py").write_text(code)
    line = [sys.executable, "program.py"]
    return subprocess.run(line, cwd=cwd, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def test_the_examples_of_the_docstrings(place: Path) -> None:
    """The first two make the runs that the others read."""
    finder, runner = doctest.DocTestFinder(exclude_empty=True), doctest.DocTestRunner()
    tests = [test for test in finder.find(overfly, globs={"overfly": overfly}) if test.examples]
    tests.sort(key=lambda test: (test.name not in {"overfly", "overfly.train"}, test.name))
    results = [runner.run(test) for test in tests]
    assert len(results) >= 10 and sum(result.failed for result in results) == 0


def examples(document: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", (ROOT / document).read_text("utf-8"), re.MULTILINE | re.DOTALL)


@pytest.mark.slow
def test_the_first_example_of_the_document(place: Path) -> None:
    code = examples("docs/guides/python.md")[0]
    assert len([line for line in code.splitlines() if line]) <= 12
    done = python(code, place)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == "(1, 2) 3 UAVs" and any(line.startswith("demo ") for line in lines)
    assert lines[-2].startswith("(301, 3) [") and re.fullmatch(r"ego [0-8]", lines[-1])


def test_the_other_examples_of_the_document(place: Path) -> None:
    for code in examples("docs/guides/python.md")[1:]:
        done = python(code, place)
        assert done.returncode == 0, done.stderr


def test_importing_it_loads_nothing_heavy_and_touches_no_signal(place: Path) -> None:
    code = """
import signal, sys
def handlers(): return [signal.getsignal(number) for number in sorted(signal.valid_signals())]
before = handlers()
import overfly
heavy = {"numpy", "torch", "zmq", "onnxruntime", "mcap", "google", "deploy", "actors", "learner", "matplotlib"}
print(sorted(heavy & set(sys.modules)), handlers() == before, overfly.__version__, overfly.Table.__name__)
"""
    done = python(code, place)
    assert done.stdout.split() == ["[]", "True", overfly.__version__, "Table"], done.stderr


def test_every_name_is_there() -> None:
    assert {name for name in overfly.__all__ if not hasattr(overfly, name)} == set()
    assert set(overfly.__all__) <= set(dir(overfly))
    with pytest.raises(AttributeError, match="has no attribute 'tarin'"):
        _ = overfly.tarin  # type: ignore[attr-defined]


def test_it_gives_what_the_log_holds(flown: overfly.Run) -> None:
    run = overfly.open_run(flown.folder)
    assert run.episodes == (1, 2) and (run.config.team.size, run.config.training.ticks) == (2, 30)
    rows = list(queries.moves(run.folder, 2))
    assert run.moves(2).dtype.kind == "i" and run.moves(2).shape == (31, 2)
    assert [(t, i, run.moves(2)[t, i]) for t, i, _ in rows] == rows
    assert dict(enumerate(run.uncertainty(1).tolist())) == dict(queries.uncertainty(run.folder, 1))
    assert np.isfinite(run.reward(1)[1:]).all() and run.events(1).shape == (0, 2)
    assert run.metrics["uncertainty"][0] == pytest.approx(run.uncertainty(1)[1:].mean())
    assert run.summary.lower_bound == run.world.lower_bound
    assert run.learning.updates.size == 0


def test_records_are_the_moves(flown: overfly.Run) -> None:
    cells = np.full((31, 2), -1)
    for record in flown.records(1):
        cells[record.first : record.first + record.cells.size, record.uav] = record.cells
        assert record.actions.size == record.blocks.size == record.rewards.size
    assert np.array_equal(cells, flown.moves(1))
    assert {record.episode for record in flown.records()} == {1, 2}
    assert [m.message.episode for m in flown.messages("/tmc/episode")] == [1, 1, 2, 2]


def test_the_command_does_the_same(place: Path) -> None:
    assert here("fly", "planner:greedy", "--lockstep", "--ticks", 30, "--no-pictures", "--out", "A", cwd=place)
    run = overfly.fly("planner:greedy", out="B", lockstep=True, ticks=30, quiet=True)
    assert queries.digest("A") == queries.digest(run.folder)
    told = json.loads((place / "B" / "run.json").read_text())["command"]
    assert told == "overfly.fly('planner:greedy', ticks=30)"
    printed = here("evaluate", "planner:random", "--seeds", 2, "--ticks", 20, "--jobs", 1, cwd=place).stdout
    table = overfly.evaluate("planner:random", seeds=2, ticks=20, jobs=1)
    assert str(table).split()[:-1] == printed.split()[:-1]  # the last word is how long it took
    assert table.rows[0].uncertainty == pytest.approx(np.mean([m.uncertainty for m in table.missions]))


ERRORS: tuple[tuple[Callable[[], object], type[overfly.Error], str], ...] = (
    (lambda: overfly.train("fast"), overfly.ConfigError, "there is no preset 'fast'"),
    (lambda: overfly.train(ticks=0), overfly.ConfigError, "training.ticks = 0 is out of range"),
    (lambda: overfly.train(actor=3), overfly.ConfigError, "train takes no 'actor': did you mean actors?"),  # type: ignore[call-arg]
    (lambda: overfly.fly("planner:greedy", batch_size=3), overfly.ConfigError, '"dqn.batch_size"'),  # type: ignore[call-arg]
    (lambda: overfly.fly("planner:greedy", settings={"gamma": 1}), overfly.ConfigError, "did you mean dqn.gamma"),
    (lambda: overfly.fly("nowhere.onnx"), overfly.ConfigError, "not a policy file, a run folder or a planner"),
    (lambda: overfly.evaluate([]), overfly.ConfigError, "nothing to evaluate"),
    (lambda: overfly.evaluate("planner:greedy", seeds=0), overfly.ConfigError, "seeds = 0"),
    (lambda: overfly.open_run("nowhere"), overfly.RecordError, "holds no logs of a run"),
    (lambda: overfly.resume("nowhere"), overfly.Error, "nowhere"),
    (lambda: overfly.Map.load("atlantis"), overfly.MapError, "atlantis"),
    (lambda: overfly.World("paper", actors=400), overfly.ConfigError, "larger than the 323 road cells"),
    (lambda: overfly.World().observe(900), overfly.ConfigError, "from 0 to 899"),
    (lambda: overfly.World().observe(0, uncertainty=[1.0]), overfly.ConfigError, "(30, 30)"),
    (lambda: overfly.Policy.load("planner:greedy"), overfly.PolicyError, "flies a planner"),
    (lambda: overfly.Policy(b"not a model"), overfly.PolicyError, "not an ONNX model"),
)


@pytest.mark.parametrize(("call", "kind", "words"), ERRORS, ids=[words for _, _, words in ERRORS])
def test_a_mistake_is_one_sentence(
    call: Callable[[], object], kind: type[overfly.Error], words: str, place: Path
) -> None:
    with pytest.raises(kind, match=re.escape(words)) as caught:
        call()
    assert isinstance(caught.value, overfly.Error) and "\n" not in str(caught.value)
    assert list(place.iterdir()) == []


def test_quiet_says_nothing(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    overfly.train(
        out="R", lockstep=True, quiet=True, episodes=1, ticks=20, settings=SMALL | {"dqn.target_updates": 900}
    )
    overfly.evaluate("R", seeds=1, jobs=1, quiet=True)
    assert capfd.readouterr() == ("", "")
    overfly.train(out="S", lockstep=True, episodes=1, ticks=20, settings=SMALL | {"dqn.target_updates": 900})
    assert capfd.readouterr().err.startswith("overfly: ")


def test_a_policy_chooses_as_a_uav_does(trained: Callable[[int], Path]) -> None:
    """Over states in which edges, obstacles and other UAVs block moves."""
    run = overfly.open_run(trained(2))
    world, policy = run.world, run.policy
    assert policy.card.mask_blocked
    observer = ObservationBuilder(world._world)
    controller = PolicyController((run.folder / "policies" / "final.onnx").read_bytes(), run.config, observer)
    chance, cells = np.random.default_rng(0), [0, 29, 870, 899, *np.flatnonzero(~world.map.blocked)[::9].tolist()]
    for cell in cells:
        near = [k for k in world._world.grid.target_lists[cell][:8] if k >= 0 and not world.map.blocked.ravel()[k]]
        peers = [int(k) for k in chance.permutation(near)[:3]]
        u = np.zeros(900)
        u[world._world.law.cells] = chance.random(observer.R)
        seen = world.observe(cell, peers, u.reshape(30, 30))
        allowed = observer.allowed(cell, peers)
        state = LocalState(1, cell, cell, peers, u[world._world.law.cells], allowed, 0.5)
        assert policy.act(seen) == controller.choose(state) and policy.act(seen) in allowed
    many = np.stack([world.observe(cell) for cell in cells[:5]])
    assert np.allclose(policy.q_values(many)[3], policy.q_values(many[3]), atol=1e-5)
    with pytest.raises(overfly.PolicyError, match=r"has the shape \(3, 17, 17\)"):
        policy.q_values(np.zeros((3, 5, 5)))


def test_a_mission_leaves_signal_handlers_as_they_were(place: Path) -> None:
    numbers = sorted(signal.valid_signals())
    before = [signal.getsignal(number) for number in numbers]
    overfly.fly("planner:greedy", out="A", actors=2, ticks=30, quiet=True)
    overfly.evaluate("planner:greedy", seeds=2, ticks=10, jobs=2, quiet=True)
    assert [signal.getsignal(number) for number in numbers] == before


def test_two_threads_fly_at_once(place: Path) -> None:
    runs: dict[str, overfly.Run] = {}

    def fly(name: str) -> None:
        runs[name] = overfly.fly("planner:greedy", out=name, actors=2, ticks=40, quiet=True)

    threads = [threading.Thread(target=fly, args=(name,)) for name in "AB"]
    for thread in threads:
        thread.start()
    table = overfly.evaluate("planner:greedy", seeds=2, ticks=10, jobs=2, quiet=True)
    for thread in threads:
        thread.join()
    assert np.array_equal(runs["A"].moves(1), runs["B"].moves(1)) and len(table.missions) == 2


def test_children_of_the_program_are_left_to_it(place: Path) -> None:
    """Also where it has the place of process 1, to which orphans come."""
    code = """
import ctypes, subprocess, sys
import overfly
ctypes.CDLL(None).prctl(36, 1)  # PR_SET_CHILD_SUBREAPER
child = subprocess.Popen([sys.executable, "-c", "raise SystemExit(7)"])
overfly.fly("planner:greedy", actors=2, ticks=30, quiet=True)
print(child.wait())
"""
    assert python(code, place).stdout == "7\n"


def test_a_program_that_is_interrupted_ends_its_processes_and_may_go_on(place: Path) -> None:
    code = """
import os, signal, threading, time
from pathlib import Path
import overfly
def interrupt():
    while not Path("R/uav-000.mcap.active").exists():
        time.sleep(0.05)
    os.kill(os.getpid(), signal.SIGINT)
threading.Thread(target=interrupt).start()
try:
    overfly.fly("planner:greedy", out="R", actors=2, ticks=20_000, settings={"trial.stall": 0.001})
except KeyboardInterrupt:
    print("interrupted", not list(Path("R").glob("uav-*.active")))
"""
    done = python(code, place)
    assert done.stdout == "interrupted True\n" and "overfly: stopped; what was flown is in R" in done.stderr, (
        done.stderr
    )


def test_a_file_named_like_the_module_is_not_taken_by_the_command(place: Path) -> None:
    (place / "overfly.py").write_text("raise SystemExit('taken from the current folder')\n")
    command = Path(sys.executable).with_name("overfly")
    lines = [[str(command)]] if command.exists() else []
    for line in [*lines, [sys.executable, "-P", "-m", "deploy.cli"]]:
        words = [*line, "fly", "planner:greedy", "--actors", "2", "--ticks", "10", "--no-pictures"]
        done = subprocess.run(words, cwd=place, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        assert done.returncode == 0, done.stderr
