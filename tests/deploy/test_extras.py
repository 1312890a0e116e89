"""Missing, old or broken packages give one sentence, before anything starts, with the line that fixes it."""

from __future__ import annotations

import json
import os
import re
import shlex
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from deploy import extras
from tests.command import here, overfly

ROOT = Path(__file__).parents[2]
LEARNERS = ("torch", "onnx", "safetensors")
WITH_LEARNER = (("run", "quick"), ("run", "quick", "--lockstep"), ("learner",), ("verify", "chaos"),
                *(("bench", name) for name in ("learner", "train", "startup", "memory", "actor")))  # fmt: skip
Fake = Callable[[str, str], None]


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fake:
    """Put a file into a folder where processes look for packages first."""
    folder = tmp_path / "packages"

    def put(name: str, text: str) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)

    paths = [str(folder), str(ROOT), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    return put


def hide(fake: Fake, *modules: str) -> None:
    """Hide these modules from processes, as if they were not installed."""
    fake("sitecustomize.py", f"""
import shlex
import sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {modules!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Hidden())
""")  # fmt: skip


def lacks(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Hide these modules in this process."""
    there = extras._is_there
    monkeypatch.setattr(extras, "_is_there", lambda module: module not in names and there(module))


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """Return a folder to start commands in."""
    (tmp_path / "place").mkdir()
    return tmp_path / "place"


def test_the_table_is_that_of_pyproject() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    optional = project["optional-dependencies"]
    lines = [*project["dependencies"], *optional["learner"], *optional["figures"]]
    assert {extras._REQUIREMENT.fullmatch(line)[1] for line in lines} == set(extras.PURPOSES)  # type: ignore[index]
    assert optional["all"] == ["overfly[learner,figures]"]


def test_all_is_well_here() -> None:
    assert [p.name for p in extras.packages()] == list(extras.PURPOSES)
    assert [p.problem() for p in extras.packages()] == [""] * len(extras.PURPOSES)
    extras.require(extras.LEARNER, extras.FIGURES)


@pytest.mark.parametrize("command", WITH_LEARNER, ids=" ".join)
def test_what_needs_a_learner_says_what_is_missing(
    command: tuple[str, ...], place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lacks(monkeypatch, *LEARNERS)
    done = here(*command, cwd=place)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    listed = "torch (not installed), onnx (not installed) and safetensors (not installed)"
    assert done.stderr.startswith(
        f"overfly: a learner needs {listed}: run {shlex.quote(sys.executable)} -m pip install "
    )
    assert list(place.iterdir()) == []


def test_without_the_extras_a_run_ends_before_it_begins_and_all_else_works(fake: Fake, place: Path) -> None:
    hide(fake, *LEARNERS, "matplotlib")
    done = overfly("run", "quick", "--out", "R", cwd=place)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1) and "torch (not installed)" in done.stderr
    assert list(place.iterdir()) == []
    done = overfly("fly", "planner:greedy", "--actors", "2", "--ticks", "20", "--out", "F", cwd=place)
    assert done.returncode == 0 and not (place / "F" / "report").exists()
    assert "overfly: no pictures: a picture needs matplotlib (not installed): run " in done.stderr
    for command in (("log", "check", "F"), ("map", "show"), ("doctor",)):
        done = overfly(*command, cwd=place)
        assert done.returncode == 0, done.stderr
    done = overfly("map", "show", "--out", "m.png", cwd=place)
    assert done.returncode == 2 and "a picture needs matplotlib (not installed)" in done.stderr


def test_a_planner_trains_nothing_so_it_needs_no_learner(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lacks(monkeypatch, *LEARNERS)
    options = (
        "--set",
        "team.controller=planner:greedy",
        "--episodes",
        "1",
        "--ticks",
        "10",
        "--lockstep",
        "--no-pictures",
    )
    assert here("run", "quick", *options, "--out", "R", cwd=place).returncode == 0


def test_what_is_too_old_is_said_with_both_versions(fake: Fake, place: Path) -> None:
    for name in ("torch", "mcap"):
        fake(f"{name}-0.3.1.dist-info/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.3.1\n")
    done = overfly("fly", "planner:greedy", cwd=place)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert re.search(r"Overfly needs mcap \(0\.3\.1 is older than [\d.]+\): run .* -m pip install", done.stderr)
    told = overfly("doctor", cwd=place)
    assert told.returncode == 1
    assert re.search(r"^  BAD   torch \(0\.3\.1 is older than [\d.]+\): needed for training; run ", told.stdout, re.M)
    assert list(place.iterdir()) == []


LIBRARY = "import ctypes\nctypes.CDLL('libnowhere.so.12')\n"
CHAINED = """
try:
    import ctypes
    ctypes.CDLL("libnowhere.so.12")
except OSError as error:
    raise ImportError("a page\\nof advice") from error
"""
BROKEN = [
    ("torch", LIBRARY, ("run", "quick", "--actors", "1"), 1),
    ("torch", LIBRARY, ("run", "quick", "--lockstep"), 2),
    ("torch", LIBRARY, ("learner",), 2),
    ("numpy", CHAINED, ("run", "quick"), 2),
    ("numpy", CHAINED, ("map", "list"), 2),
    ("zmq", LIBRARY, ("fly", "planner:greedy"), 2),
]


@pytest.mark.parametrize(("name", "text", "command", "code"), BROKEN, ids=[f"{b[0]}-{' '.join(b[2])}" for b in BROKEN])
def test_what_cannot_be_imported_is_said_with_the_reason(
    name: str, text: str, command: tuple[str, ...], code: int, fake: Fake, place: Path
) -> None:
    fake(f"{name}/__init__.py", text)
    done = overfly(*command, cwd=place)
    assert done.returncode == code and "Traceback" not in done.stderr
    said = [line for line in done.stderr.splitlines() if "cannot be imported" in line]
    package = {"zmq": "pyzmq"}.get(name, name)
    assert len(said) == 1 and f"{package} cannot be imported (libnowhere.so" in said[0]
    assert f"-m pip install --force-reinstall {package}" in said[0]
    assert "started again" not in done.stderr


def test_a_runtime_for_policies_that_is_gone_is_said(trained: Callable[[int], Path], fake: Fake, place: Path) -> None:
    run = trained(1)
    hide(fake, "onnxruntime")
    for command in ("fly", "evaluate"):
        done = overfly(command, run, cwd=place)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
        assert done.stderr.startswith("overfly: Overfly needs onnxruntime (not installed): run ")


def test_errors_of_other_kinds_are_not_taken_for_broken_packages() -> None:
    for wrong in ("import nowhere", "import tmc.nowhere", "import numpy; numpy.zeros(-1)", "open('/nowhere')"):
        with pytest.raises(Exception) as caught:
            exec(wrong, {"__name__": "tmc.somewhere"})
        assert extras.broken(caught.value) == ""


@pytest.mark.parametrize(
    ("older", "newer"), [("2.4", "2.13.0+cpu"), ("2.4", "2.4.1"), ("1.9", "1.10"), ("5.29.6", "6"), ("26", "27.3.0rc1")]
)
def test_versions_are_compared_by_their_numbers(older: str, newer: str) -> None:
    assert extras._release(older) < extras._release(newer)
    assert extras._release(f"{older}.0") == extras._release(older) == extras._release(f"{older}+local")


class Installed:
    """Return a distribution with pip's note of where it was installed from."""

    def __init__(self, told: Any) -> None:
        self.told = told

    def read_text(self, _name: str) -> str | None:
        return None if self.told is None else json.dumps(self.told)


def test_the_line_fits_how_it_was_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "my folder"
    folder.mkdir()
    wheel = folder / "overfly-0.1.0-py3-none-any.whl"
    wheel.touch()
    least = [f"{p.name}>={p.least}" for p in extras.packages() if p.extra == "learner"]
    cases: list[tuple[Any, list[str]]] = [
        ({"url": folder.as_uri(), "dir_info": {"editable": True}}, ["-e", f"{folder}[learner]"]),
        ({"url": folder.as_uri(), "dir_info": {}}, [f"overfly[learner] @ {folder.as_uri()}"]),
        ({"url": wheel.as_uri(), "archive_info": {}}, [f"overfly[learner] @ {wheel.as_uri()}"]),
        ({"url": (tmp_path / "gone.whl").as_uri(), "archive_info": {}}, least),
        (None, least),
        ([], least),
    ]
    for told, words in cases:
        monkeypatch.setattr(extras, "distribution", lambda _, told=told: Installed(told))
        assert shlex.split(extras.install("learner")) == [sys.executable, "-m", "pip", "install", *words]
