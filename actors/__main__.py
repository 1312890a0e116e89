"""`python -m actors`: the process of one UAV. `overfly actor` starts the same."""

from __future__ import annotations

import os
import sys
from pathlib import Path

# One thread for the arithmetic of a UAV; must be set before NumPy is imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from actors.service import FlightEnded, Service
from tmc.kernel.config import ConfigError
from tmc.kernel.policy import PolicyError
from tmc.kernel.roadmap import MapError
from tmc.kernel.text import printable
from tmc.record.errors import RecordError
from tmc.wire import process
from tmc.wire.fields import FieldError
from tmc.wire.options import Options
from tmc.wire.sockets import EndpointError

MISTAKES = (ConfigError, MapError, PolicyError, RecordError, EndpointError, FieldError, MemoryError)


def fly(uav: int, endpoint: str, out: Path) -> int:
    """Fly UAV `uav` until its TMC ends the mission; return the exit code. Raises MISTAKES."""
    stop = process.Stop()
    service = Service(uav, endpoint, out)
    try:
        service.fly(stop)
    except FlightEnded as end:
        service.leave(printable(end))
        if end.code not in {process.DONE, process.STOPPED}:
            process.tell(f"UAV {uav}: {end}")
        return stop.code if end.code == process.STOPPED else end.code
    except PolicyError as error:
        service.leave(str(error))
        raise
    finally:
        service.close()


def main(argv: list[str] | None = None) -> int:
    """Parse the options of a child process, fly, and return the exit code."""
    parser = Options("actors", description=__doc__)
    parser.add_argument("--id", type=int, required=True, help="number of the UAV, from 0")
    parser.add_argument("--connect", required=True, help="the TMC's endpoint for UAVs")
    parser.add_argument("--out", type=Path, required=True, help="folder for the UAV's log")
    parser.add_argument("--parent", type=int, default=0, help="end with this process")
    a = parser.parse_args(argv)
    process.become_child(a.parent)
    return process.run_child(lambda: fly(a.id, a.connect, a.out), MISTAKES)


if __name__ == "__main__":
    sys.exit(main())
