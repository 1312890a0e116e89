"""The wheel: what is in it, and that it runs where nothing else of the project is."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.command import PATIENCE_S

ROOT = Path(__file__).parents[2]
PACKAGES = {"actors", "learner", "tmc", "deploy"}
FACE = "overfly.py"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built as `pip` builds it, without a network."""
    folder = tmp_path_factory.mktemp("wheel")
    code = f"from hatchling.build import build_wheel; print(build_wheel({str(folder)!r}))"
    result = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert result.returncode == 0, result.stderr
    return folder / result.stdout.split()[-1]


@pytest.fixture(scope="module")
def contents(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel's contents and nothing else: a wheel of pure Python installs by unpacking."""
    folder = tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def overfly(installed: Path, where: Path, *args: str) -> subprocess.CompletedProcess[str]:
    """Run the installed command from another folder; its packages come first, before an editable install's."""
    environment = os.environ | {"PYTHONPATH": str(installed)}
    command = [sys.executable, "-P", "-m", "deploy.cli", *args]
    return subprocess.run(
        command, cwd=where, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )


def test_the_wheel_holds_the_four_packages_the_module_and_no_tests(contents: set[str]) -> None:
    folders = {name.partition("/")[0] for name in contents}
    assert {name for name in folders if not name.endswith(".dist-info")} == PACKAGES | {FACE}
    assert not [name for name in contents if "test" in name or name.endswith(".pyc")]


def test_the_wheel_holds_every_file_of_the_packages(contents: set[str]) -> None:
    files = (path for package in PACKAGES for path in (ROOT / package).rglob("*") if path.is_file())
    ours = {path.relative_to(ROOT).as_posix() for path in files if "__pycache__" not in path.parts}
    assert ours | {FACE} == {name for name in contents if ".dist-info/" not in name}


def test_the_wheel_holds_what_is_no_code(contents: set[str]) -> None:
    kinds = {"tmc/kernel/maps/*.json", "deploy/presets/*.toml", "tmc/record/*.proto"}
    assert {k for k in kinds if any(Path(name).match(k) for name in contents)} == kinds
    assert {f"{package}/py.typed" for package in PACKAGES} <= contents


def test_the_wheel_carries_licence_and_command(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        info = {Path(name).name: name for name in archive.namelist() if ".dist-info/" in name}
        assert "Apache License" in archive.read(info["LICENSE"]).decode()
        assert "overfly = deploy.entry:main" in archive.read(info["entry_points.txt"]).decode()


def test_the_installed_command_runs_from_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    version = overfly(installed, tmp_path, "--version")
    assert version.returncode == 0 and version.stdout.startswith("overfly "), version.stderr
    maps = overfly(installed, tmp_path, "map", "list")
    assert maps.returncode == 0, maps.stderr
    assert "downtown-toronto" in maps.stdout


def test_the_installed_command_flies(installed: Path, tmp_path: Path) -> None:
    run = tmp_path / "R"
    options = ("--actors", "2", "--ticks", "30", "--out", str(run))
    flown = overfly(installed, tmp_path, "fly", "planner:greedy", *options)
    assert flown.returncode == 0, flown.stderr
    assert (run / "tmc.mcap").is_file()


def test_the_installed_module_flies(installed: Path, tmp_path: Path) -> None:
    code = 'import overfly\nprint(overfly.__file__, overfly.fly("planner:greedy", actors=2, ticks=30).moves(1).shape)'
    result = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(installed)},
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert result.stdout == f"{installed / FACE} (31, 2)\n", result.stderr


def test_mypy_sees_the_types_of_the_module(installed: Path, tmp_path: Path) -> None:
    """When it is told to, as docs/guides/python.md says: a single module has no place for py.typed."""
    (tmp_path / "user.py").write_text("import overfly\nreveal_type(overfly.fly('x').moves(1))\noverfly.tarin()\n")
    (tmp_path / "mypy.ini").write_text("[mypy]\nstrict = true\n[mypy-overfly]\nfollow_untyped_imports = true\n")
    result = subprocess.run(
        [sys.executable, "-P", "-m", "mypy", "--cache-dir", os.devnull, "user.py"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(installed)},
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    lines = [line for line in result.stdout.splitlines() if line.startswith("user.py")]
    assert len(lines) == 2 and "ndarray[" in lines[0] and 'has no attribute "tarin"' in lines[1], result.stdout


def test_the_packages_come_from_the_wheel(installed: Path, tmp_path: Path) -> None:
    code = "import actors, learner, tmc, deploy\nfor p in (actors, learner, tmc, deploy): print(p.__path__[0])"
    result = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(installed)},
        capture_output=True, text=True, timeout=PATIENCE_S, check=True,
    )  # fmt: skip
    assert {Path(p).parent for p in result.stdout.splitlines()} == {installed}
