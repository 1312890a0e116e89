"""The layout of a run folder: every path in it, and the files that hold its logs."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from tmc.kernel.roadmap import MAP_COPY
from tmc.record.channels import ACTIVE
from tmc.record.errors import NoLogError, RecordError

_LOG_NAME = re.compile(rf"(tmc|learner|uav-\d+)\.mcap({re.escape(ACTIVE)})?")


@dataclass(frozen=True)
class RunFolder:
    """The paths in the run folder `path`. No file is opened, and no folder is made."""

    path: Path

    @property
    def config(self) -> Path:
        """The settings of the run, flat JSON."""
        return self.path / "config.json"

    @property
    def map_copy(self) -> Path:
        """The copy of a user's own map."""
        return self.path / MAP_COPY

    @property
    def outcome(self) -> Path:
        """What was run, with which versions, and how each process ended; JSON."""
        return self.path / "run.json"

    @property
    def summary(self) -> Path:
        """The metrics that `overfly analyze` computed; JSON."""
        return self.path / "summary.json"

    @property
    def report(self) -> Path:
        """The folder of the figures."""
        return self.path / "report"

    @property
    def replay(self) -> Path:
        """The folder of the replay files for viewers."""
        return self.path / "replay"

    @property
    def outputs(self) -> Path:
        """The folder of what the processes print."""
        return self.path / "logs"

    @property
    def acks(self) -> Path:
        """The folder in which trials note what was acknowledged."""
        return self.path / "acks"

    @property
    def checkpoints(self) -> Path:
        """The folder of the learner's checkpoints."""
        return self.path / "checkpoints"

    @property
    def policies(self) -> Path:
        """The folder of the policies."""
        return self.path / "policies"

    @property
    def final_policy(self) -> Path:
        """The policy at the end of a training."""
        return self.policies / "final.onnx"

    @property
    def fixed_policy(self) -> Path:
        """The policy of a run that flies a fixed one."""
        return self.policies / "flown.onnx"

    @property
    def journal(self) -> Path:
        """The finished log of the TMC; see `existing_journal` for one that is still written."""
        return self.log("tmc")

    @property
    def active_journal(self) -> Path:
        """The log of the TMC while it is written."""
        return active_name(self.journal)

    def log(self, process: str) -> Path:
        """The finished log of a process, such as `tmc` or `uav-003`."""
        return self.path / f"{process}.mcap"

    def policy(self, version: int) -> Path:
        """The policy of this version, while a UAV may ask for it."""
        return self.policies / f"policy-{version}.onnx"

    def policy_versions(self) -> list[int]:
        """The versions of the policies that are in the folder."""
        names = (path.stem.removeprefix("policy-") for path in self.policies.glob("policy-*.onnx"))
        return [int(name) for name in names if name.isdecimal()]

    def output(self, process: str) -> Path:
        """What a process prints."""
        return self.outputs / f"{process}.txt"

    def acks_of(self, process: str) -> Path:
        """What a process noted of acknowledgements in a trial."""
        return self.acks / f"{process}.txt"

    def existing_journal(self) -> Path | None:
        """The log of the TMC, finished or not; None when there is none, or an empty file."""
        paths = (self.active_journal, self.journal)
        return next((path for path in paths if path.is_file() and path.stat().st_size), None)


def active_name(path: Path) -> Path:
    """Return the name of a log while it is written."""
    return path.with_name(path.name + ACTIVE)


def finished_name(path: Path) -> Path:
    """Return the name of a log once it is finished."""
    return path.with_name(path.name.removesuffix(ACTIVE))


def run_files(folder: str | os.PathLike[str]) -> dict[str, Path]:
    """Return {process: its log} of a run, `tmc` and `learner` first; NoLogError when the folder holds none.

    Where both names of a log exist, a resumed log is about to replace the finished one. It holds all of it, unless it
    is empty.
    """
    folder = Path(folder)
    paths, why = list[Path](), "tmc.mcap and others"
    try:
        paths = sorted(p for p in folder.iterdir() if _LOG_NAME.fullmatch(p.name) and p.is_file())
    except OSError as error:
        why = str(error.strerror)
    if not paths:
        raise NoLogError(f"{folder} holds no logs of a run ({why}): give the folder of a run")
    found: dict[str, Path] = {}
    for path in paths:
        name = path.name.partition(".")[0]
        if name not in found or path.stat().st_size or not found[name].stat().st_size:
            found[name] = path
    return dict(sorted(found.items(), key=lambda item: (item[0].startswith("uav"), item[0] != "tmc", item[0])))


def tmc_log(folder: str | os.PathLike[str]) -> Path:
    """Return the log of the TMC in a run folder; RecordError when there is none."""
    files = run_files(folder)
    if "tmc" not in files:
        raise RecordError(f"{folder} holds no tmc.mcap: give the folder of the run on the host where the TMC ran")
    return files["tmc"]


def logs_in(path: str | os.PathLike[str]) -> dict[str, Path]:
    """Return {process: its log} of a run folder, or of a single log."""
    path = Path(path)
    return run_files(path) if os.path.isdir(path) else {path.name.partition(".")[0]: path}  # noqa: PTH112  never raises
