"""`python -m learner`: the learner process. `overfly learner` starts the same."""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle threads must not spin on cores that UAVs need

from learner.batching import TrainingError
from learner.checkpoint import CheckpointError
from learner.service import ReplacedError, Service
from tmc.kernel.config import ConfigError
from tmc.kernel.roadmap import MapError
from tmc.record.errors import RecordError
from tmc.wire import process
from tmc.wire.fields import FieldError
from tmc.wire.options import Options
from tmc.wire.sockets import EndpointError

MISTAKES = (CheckpointError, ConfigError, MapError, RecordError, EndpointError, TrainingError, FieldError, MemoryError)


def learn(endpoint: str, out: Path) -> int:
    """Learn until the TMC ends the mission; return the exit code. Raises MISTAKES."""
    stop = process.Stop()
    service = Service(endpoint, out)
    try:
        return process.DONE if service.learn(stop) else stop.code
    except ReplacedError as error:
        process.tell(str(error))
        return process.FENCED
    finally:
        service.close()


def main(argv: list[str] | None = None) -> int:
    """Parse the options of a child process, learn, and return the exit code."""
    parser = Options("learner", description=__doc__)
    parser.add_argument("--connect", required=True, help="the TMC's endpoint for UAVs; the learner's lies beside it")
    parser.add_argument("--out", type=Path, required=True, help="run folder")
    parser.add_argument("--parent", type=int, default=0, help="end with this process")
    a = parser.parse_args(argv)
    process.become_child(a.parent)
    return process.run_child(lambda: learn(a.connect, a.out), MISTAKES)


if __name__ == "__main__":
    sys.exit(main())
