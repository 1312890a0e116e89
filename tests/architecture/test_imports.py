"""PolicySpec may import whom: the contracts of pyproject.toml, and where the heavy and the networked packages may
appear.
"""

from __future__ import annotations

import ast
import statistics
import subprocess
import sys
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

import pytest

from tests.command import PATIENCE_S

ROOT = Path(__file__).parents[2]
PACKAGES = ("actors", "learner", "tmc", "deploy")
FACE = Path("overfly.py")
SOURCES = [FACE, *sorted(path.relative_to(ROOT) for package in PACKAGES for path in (ROOT / package).rglob("*.py"))]

# Package -> the only files that may import it, anywhere in their text.
HOMES: dict[str, tuple[str, ...]] = {
    "torch": ("learner/*.py",),
    "safetensors": ("learner/*.py",),
    "onnx": ("learner/*.py",),
    "onnxruntime": ("actors/policy.py",),
    "mcap": ("tmc/record/*.py",),
    "msgpack": ("tmc/wire/codec.py",),
    "matplotlib": ("tmc/analysis/*.py",),
    "zmq": (
        "actors/service.py",
        "learner/service.py",
        "tmc/center/service.py",
        "tmc/wire/sockets.py",
        "deploy/run/progress.py",
        "deploy/bench/startup.py",
        "deploy/commands/doctor.py",
    ),
}
LONGEST, MEDIAN = 70, 10
"""Lines of a function: at most, and the median of all."""


def imported(path: Path) -> Iterator[str]:
    """Top-level names of all that a file imports, within functions as well."""
    for node in ast.walk(ast.parse((ROOT / path).read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.partition(".")[0]


def run(code: str) -> str:
    """What `code` prints in a process of its own."""
    command = [sys.executable, "-P", "-c", code]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_the_contracts_of_pyproject_hold() -> None:
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command; lint_imports_command()"]
    result = subprocess.run(
        [*command, "--no-cache", "--no-logo"], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr


def modules_imported(path: Path) -> Iterator[str]:
    """Modules that a file imports, within functions as well; of `from a import b` both a and a.b."""
    for node in ast.walk(ast.parse((ROOT / path).read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_the_face_stands_between_the_commands_and_all_else() -> None:
    """It imports nothing that is built on it, and of `learner` nothing: deploy knows where that is needed."""
    above = ("deploy.commands", "deploy.cli", "deploy.entry", "learner")
    assert not [name for name in modules_imported(FACE) if name.startswith(above)]
    users = {path.as_posix() for path in SOURCES if "overfly" in imported(path)}
    assert users == {f"deploy/commands/{command}.py" for command in ("run", "fly", "evaluate")}


@pytest.mark.parametrize("package", HOMES)
def test_a_package_is_imported_only_where_it_belongs(package: str) -> None:
    users = [path.as_posix() for path in SOURCES if package in imported(path)]
    assert users, f"nothing imports {package}: correct HOMES"
    assert not [path for path in users if not any(fnmatch(path, home) for home in HOMES[package])]


def loaded_after(modules: str) -> set[str]:
    """Heavy packages in a process that has imported `modules`."""
    heavy = "{'torch', 'onnx', 'onnxruntime', 'safetensors', 'matplotlib', 'learner'}"
    return set(run(f"import sys, {modules}; print(*{heavy} & set(sys.modules))").split())


def test_a_uav_with_a_planner_loads_no_network_library() -> None:
    assert loaded_after("actors.service, actors.__main__") == set()


def test_a_uav_with_a_policy_loads_no_torch() -> None:
    assert loaded_after("actors.service, actors.__main__, actors.policy") == {"onnxruntime"}


def test_the_tmc_loads_no_network_library() -> None:
    assert loaded_after("tmc.__main__") == set()


def test_the_command_loads_nothing_heavy_before_a_command_is_chosen() -> None:
    assert loaded_after("deploy.cli") == set()


def test_the_face_loads_nothing_heavy_before_it_is_used() -> None:
    assert loaded_after("overfly") == set()


@pytest.mark.parametrize("role", ["actors", "tmc"])
def test_help_starts_no_network_library(role: str) -> None:
    command = [sys.executable, "-P", "-X", "importtime", "-m", role, "--help"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    names = {line.rpartition("|")[2].strip() for line in result.stderr.splitlines() if line.startswith("import time:")}
    assert "tmc.kernel.config" in names
    assert not names & {"torch", "onnx", "onnxruntime", "safetensors", "matplotlib"}


def test_importing_does_no_work() -> None:
    """No module that a UAV, the TMC or the command imports opens a socket, writes a file, or starts anything."""
    kept = [p for p in SOURCES if p.parts[0] != "learner" and p.name != "policy.py"]
    modules = [".".join(p.with_suffix("").parts).removesuffix(".__init__") for p in kept]
    code = f"""
import importlib, sys, threading
sys.dont_write_bytecode = True  # or the first import after a change writes what Python keeps of it
import numpy, zmq, google.protobuf.descriptor_pool
def watch(event, args):
    if event == "open":
        busy = isinstance(args[1], str) and set(args[1]) & set("wxa+")
    else:
        busy = event in {{"socket.bind", "socket.connect", "subprocess.Popen", "os.fork", "os.system"}}
    if busy:
        work.append((event, args))
work = []
sys.addaudithook(watch)
for name in {modules!r}:
    importlib.import_module(name)
print(work, threading.active_count(), zmq.Context._instance)
"""
    assert run(code) == "[] 1 None"


def functions() -> dict[str, int]:
    """Lines of each function of the sources, by file and name."""
    found = {}
    for path in SOURCES:
        for node in ast.walk(ast.parse((ROOT / path).read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef):
                found[f"{path}:{node.lineno} {node.name}"] = (node.end_lineno or node.lineno) - node.lineno + 1
    return found


def test_functions_are_short() -> None:
    lengths = functions()
    assert {name: n for name, n in lengths.items() if n > LONGEST} == {}
    assert statistics.median(lengths.values()) <= MEDIAN


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_are_typed(package: str) -> None:
    assert (ROOT / package / "py.typed").is_file()


DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_prose_fits_the_screen(document: Path) -> None:
    """At most 120 characters a line, as in code; tables and what a command printed are as wide as they are."""
    parts = document.read_text().split("\n```")[::2]  # what stands between fences is left out
    long = [line for part in parts for line in part.split("\n") if len(line) > 120 and "|" not in line[:4]]
    assert long == []
