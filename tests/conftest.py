"""For all tests: machines are shared and noisy, so no example of a property has a deadline; pytest's time-out holds.
The examples are the same in every run, so that what fails was broken by the change at hand; `make explore` draws new
ones. And what several tests need and none changes is made once, by the first worker that needs it.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.command import line_of_trial, overfly

PATIENT = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("overfly", derandomize=True, **PATIENT)
settings.register_profile("explore", derandomize=False, **PATIENT)
settings.load_profile("overfly")

for name in ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR", "PYTHONWARNINGS"):
    os.environ.pop(name, None)  # what the user's terminal and other programs are to do must not reach the tests

# A suite that a script runs in the background has INT ignored, and so would the commands that it starts; nohup: HUP.
signal.pthread_sigmask(signal.SIG_SETMASK, [])
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL),
                        (signal.SIGTERM, signal.SIG_DFL), (signal.SIGTSTP, signal.SIG_DFL),
                        (signal.SIGCHLD, signal.SIG_DFL)):  # fmt: skip
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

Once = Callable[[str, Callable[[Path], object]], Path]
TRAINED = ("run", "quick", "--ticks", 60, "--episodes", 2, "--no-pictures",
           *(word for change in ("replay.learn_start=60", "dqn.batch_size=16", "journal.flush_interval=0.1")
             for word in ("--set", change)))  # fmt: skip


@pytest.fixture
def short() -> Iterator[Path]:
    """A folder with room for the name of a socket: the system takes 107 bytes in all, and `tmp_path` may be longer."""
    folders = {tempfile.gettempdir(), "/tmp", "/dev/shm"}
    folder = min((f for f in folders if os.access(f, os.W_OK)), key=lambda f: len(os.fsencode(f)))
    with tempfile.TemporaryDirectory(prefix="ofly-", dir=folder) as name:
        yield Path(name)


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Once:
    """The folder of a name, filled by `make(folder)` unless another test or worker has done so: only read it."""
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def get(name: str, make: Callable[[Path], object]) -> Path:
        folder, ready = base / name, base / f"{name}.ready"
        with (base / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not ready.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                ready.touch()
        return folder

    return get


@pytest.fixture(scope="session")
def trained(once: Once) -> Callable[[int], Path]:
    """The run folder of a short training of three UAVs in a scenario, with processes: only read it."""

    def train(scenario: int) -> Path:
        def make(folder: Path) -> None:
            line = line_of_trial(observation_hash=True)
            done = overfly(*TRAINED, "--scenario", scenario, "--out", "R", cwd=folder, line=line)
            assert done.returncode == 0, done.stderr

        return once(f"trained-{scenario}", make) / "R"

    return train
