"""The scratch folder: in memory if there is room, elsewhere if there is not, or an error of one sentence."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from actors import tracks
from deploy.run import scratch
from tests.command import LINE
from tmc.kernel.config import ConfigError, build
from tmc.wire.endpoints import LEARNER_SUFFIX, MAX_PATH_BYTES

CONFIG = build({"team.size": 3, "training.ticks": 1000})
SIZE = tracks.table_bytes(3, 1000)


@pytest.fixture
def places(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Path, Path]]:
    """Return two folders with short paths that replace the places for scratch folders."""
    with scratch.made(CONFIG) as shared:
        memory, temporary = shared.folder / "m", shared.folder / "t"
        memory.mkdir()
        temporary.mkdir()
        monkeypatch.setattr(scratch, "MEMORY", memory)
        monkeypatch.setattr(scratch, "ELSEWHERE", ())
        monkeypatch.setattr(tempfile, "tempdir", str(temporary))
        yield memory, temporary


def test_it_lies_in_memory_with_room_for_every_tick(places: tuple[Path, Path]) -> None:
    with scratch.made(CONFIG) as made:
        assert made.folder.parent == places[0]
        assert made.tracks.stat().st_size == SIZE
        assert {path.name for path in made.folder.iterdir()} == {"held", "tracks"}
    assert not [*places[0].iterdir()]


def test_without_a_table_none_is_made(places: tuple[Path, Path]) -> None:
    made = scratch.make(CONFIG, table=False)
    assert not made.tracks.exists()
    made.close()


def test_a_folder_that_is_not_there_or_is_none_is_passed_over(places: tuple[Path, Path]) -> None:
    memory, temporary = places
    memory.rmdir()
    for _ in range(2):
        with scratch.made(CONFIG) as made:
            assert made.folder.parent == temporary
        memory.write_text("a file") if not memory.exists() else None


def test_a_path_that_is_too_long_for_a_socket_is_passed_over(
    places: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = set()
    for length in range(1, MAX_PATH_BYTES):
        deep = places[0] / ("x" * length)
        deep.mkdir()
        monkeypatch.setattr(scratch, "MEMORY", deep)
        with scratch.made(CONFIG) as made:
            fits = len(os.fsencode(deep / made.folder.name / f"sync{LEARNER_SUFFIX}")) <= MAX_PATH_BYTES
            assert made.folder.parent == (deep if fits else places[1])
            found.add(fits)
        deep.rmdir()  # so nothing was left in it
    assert found == {True, False}


def test_a_path_that_is_not_utf8_is_passed_over(places: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """A message could not carry such a path to the UAVs."""
    odd = places[0] / os.fsdecode(b"\xff")
    try:
        odd.mkdir()
    except OSError:
        pytest.skip("no such name can be given here")
    monkeypatch.setattr(scratch, "MEMORY", odd)
    with scratch.made(CONFIG) as made:
        assert made.folder.parent == places[1]
    assert not [*odd.iterdir()]


def test_where_no_folder_has_room_each_is_named(places: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(ConfigError) as caught:
        scratch.make(CONFIG)
    sentence = str(caught.value)
    assert f"{SIZE:,} bytes for the track table of 3 UAVs" in sentence
    for place in places:
        assert f"{place}: No space left on device" in sentence
        assert not [*place.iterdir()]
    assert "bytes free" in sentence
    assert "set TMPDIR to a folder that has it" in sentence


def test_a_system_that_reserves_no_room_gets_zeros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object) -> None:
        raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))

    monkeypatch.setattr(os, "posix_fallocate", unknown)
    tracks.create_table(tmp_path / "tracks", 200, 1000)
    content = (tmp_path / "tracks").read_bytes()
    assert len(content) == tracks.table_bytes(200, 1000) > tracks._CHUNK_BYTES
    assert not any(content)


def test_space_is_reserved_at_once(tmp_path: Path) -> None:
    """A sparse file would cause SIGBUS later. With a limit on the size of files, the table is refused at once."""
    code = f"""
import resource
from pathlib import Path
from actors.tracks import create_table
resource.setrlimit(resource.RLIMIT_FSIZE, ({SIZE - 1}, {SIZE - 1}))
try:
    create_table(Path("tracks"), 3, 1000)
except OSError as error:
    print(error.errno)
"""
    line = [sys.executable, "-c", code]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.split() == [str(errno.EFBIG)]


MOUNTED = """
set -e
mount -t tmpfs -o size=64k tmpfs /dev/shm
"$@" --out small
mount -t tmpfs -o ro tmpfs /dev/shm
TMPDIR=/nowhere "$@" --out unwritable
TMPDIR=$PWD "$@" --out long
"""


def test_missions_fly_where_memory_is_small_unwritable_or_gone(tmp_path: Path) -> None:
    """A container has 64 MB of /dev/shm by default."""
    namespace = ["unshare", "--mount", "sh", "-c"]
    if (
        shutil.which("unshare") is None
        or subprocess.run([*namespace, "mount -t tmpfs tmpfs /dev/shm"], capture_output=True, check=False).returncode
    ):
        pytest.skip("no file system can be mounted here")
    folder = tmp_path / ("x" * 100)
    folder.mkdir()
    flight = [*LINE, "fly", "planner:greedy", "--actors", "3", "--ticks", "4000", "--no-pictures"]
    flight += ["--set", "world.start=road"]
    done = subprocess.run(
        [*namespace, MOUNTED, "sh", *flight], cwd=folder, capture_output=True, text=True, check=False, timeout=170
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "SIGBUS" not in done.stderr
    assert done.stdout.count("all 4 ended in order, none was restarted") == 3
