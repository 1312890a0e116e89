"""Checks the packages that Overfly needs: installed, new enough, importable; and gives the line that installs them.

The packages, their extras and their least versions are those of pyproject.toml, by the installed metadata.
"""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import sys
from collections.abc import Container
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import Distribution, PackageNotFoundError, distribution, requires, version
from pathlib import Path
from urllib.parse import unquote, urlsplit

CORE, LEARNER, FIGURES = "", "learner", "figures"
"""The packages that every command needs, and the extras that a command may need."""
USERS = {CORE: "Overfly", LEARNER: "a learner", FIGURES: "a picture"}
PURPOSES = {
    "numpy": "arithmetic of the world",
    "pyzmq": "sockets",
    "msgpack": "messages",
    "mcap": "logs",
    "protobuf": "logs",
    "foxglove-schemas-protobuf": "logs that viewers know",
    "setproctitle": "names of the UAV processes in ps",
    "onnxruntime": "policies in the UAVs",
    "torch": "training",
    "onnx": "policy files",
    "safetensors": "checkpoints",
    "matplotlib": "pictures",
}
"""What each package is for, in the order in which `doctor` lists them."""
MODULES = {"pyzmq": "zmq", "protobuf": "google.protobuf", "foxglove-schemas-protobuf": "foxglove_schemas_protobuf"}
"""The module to import, where its name is not the package's."""
MISSING = "not installed"
OURS = {"actors", "deploy", "learner", "overfly", "tmc", "__main__"}
_REQUIREMENT = re.compile(r"([\w.-]+?) *>= *([\d.]+) *(?:; *extra *== *['\"]([\w-]+)['\"])?")


@dataclass(frozen=True)
class Package:
    """A package that every command needs or, with an `extra`, some. `least`: the oldest version that works."""

    name: str
    least: str
    extra: str

    @property
    def module(self) -> str:
        """The module to import."""
        return MODULES.get(self.name, self.name)

    def problem(self) -> str:
        """Return what is wrong with its installation, a phrase; "" if it is installed and new enough."""
        if not _is_there(self.module):
            return MISSING
        try:
            found = version(self.name)
        except PackageNotFoundError:  # installed by other means, with an unknown version
            return ""
        return f"{found} is older than {self.least}" if found and _release(found) < _release(self.least) else ""


def _is_there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):  # a part of its name is missing, or was removed from sys.modules
        return False


def _release(text: str) -> list[int]:
    """Return the numbers of a version, for comparison: 2.13.0+cpu is [2, 13]."""
    numbers = [int(part) for part in re.findall(r"\d+", (re.match(r"[\d.]+", text) or [""])[0])]
    while numbers and not numbers[-1]:
        del numbers[-1]
    return numbers


@cache
def packages() -> tuple[Package, ...]:
    """Return every needed package, in the order of PURPOSES; none if Overfly itself is not installed."""
    found, lines = {}, list[str]()
    with suppress(PackageNotFoundError):
        lines = requires("overfly") or lines
    for line in lines:
        match = _REQUIREMENT.fullmatch(line.strip())
        if match and (match[3] or CORE) in USERS:
            found[match[1]] = Package(match[1], match[2], match[3] or CORE)
    return tuple(found[name] for name in PURPOSES if name in found)


def lacking(extra: str) -> str:
    """Return a sentence on missing or old packages of an extra, with the fix; "" if all are installed."""
    wrong = {p.name: p.problem() for p in packages() if p.extra == extra}
    listed = _enumerated([f"{name} ({problem})" for name, problem in wrong.items() if problem])
    return f"{USERS[extra]} needs {listed}: run {install(extra)}" if listed else ""


def require(*extras: str) -> None:
    """Raise ConfigError unless the packages of every command and of these extras are installed."""
    from tmc.kernel.config import ConfigError  # noqa: PLC0415  this module must import without any package

    if not packages():
        root = Path(__file__).resolve().parent.parent
        raise ConfigError(f"Overfly is not installed for {sys.executable}: run {_pip()} -e {shlex.quote(str(root))}")
    for extra in (CORE, *extras):
        if sentence := lacking(extra):
            raise ConfigError(sentence)


def _enumerated(items: list[str]) -> str:
    return " and ".join(filter(None, [", ".join(items[:-1]), *items[-1:]]))


def install(extra: str) -> str:
    """Return the line that installs an extra: from where this Overfly was installed, or else only the packages."""
    wanted = f"[{extra}]" if extra else ""
    url, editable = _origin(distribution("overfly"))
    path = unquote(urlsplit(url).path)
    if not url.startswith("file:") or not Path(path).exists():
        return " ".join([_pip(), *(shlex.quote(f"{p.name}>={p.least}") for p in packages() if p.extra == extra)])
    if editable:
        return f"{_pip()} -e {shlex.quote(path + wanted)}"
    return f"{_pip()} {shlex.quote(f'overfly{wanted} @ {url}')}"


def _pip() -> str:
    return f"{shlex.quote(sys.executable)} -m pip install"


def _origin(overfly: Distribution) -> tuple[str, bool]:
    """Return (URL that it was installed from, whether it is editable); ("", False) if pip did not note it."""
    try:
        origin = json.loads(overfly.read_text("direct_url.json") or "{}")
        return str(origin.get("url", "")), bool(origin.get("dir_info", {}).get("editable"))
    except (ValueError, AttributeError):
        return "", False


def broken(error: BaseException) -> str:
    """Return a sentence on an error of a package that cannot be imported, with the fix; "" for any other error."""
    known = {package.module.partition(".")[0]: package for package in packages()}
    missing = (error.name or "") if isinstance(error, ModuleNotFoundError) else ""
    package = known.get(missing.partition(".")[0]) or known.get(_imported(error, known))
    if package is None:
        return ""
    if missing and f"{package.module}.".startswith(f"{missing}."):
        return f"{USERS[package.extra]} needs {package.name} ({MISSING}): run {install(package.extra)}"
    while error.__cause__ is not None:
        error = error.__cause__
    reason = " ".join(str(error).split())[:300] or type(error).__name__
    return f"{package.name} cannot be imported ({reason}): run {_pip()} --force-reinstall {package.name}"


def _imported(error: BaseException, known: Container[str]) -> str:
    """Return the innermost of the known packages that was being imported at the error; "" if none was."""
    trace, found = error.__traceback__, ""
    while trace is not None:
        name, code = str(trace.tb_frame.f_globals.get("__name__", "")).partition(".")[0], trace.tb_frame.f_code.co_name
        if name in OURS:
            found = ""
        elif name in known and code == "<module>":
            found = name
        trace = trace.tb_next
    return found
