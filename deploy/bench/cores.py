"""What the cores of this machine are worth together, just now: how much more all of them compute at once than one does.

Two cores of one's own are worth 2. A guest whose host runs both on the halves of one core has a little more than one,
and that changes from minute to minute: a figure of processes that share the work means nothing without it.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time

import numpy as np

from deploy.bench.row import core_count
from deploy.run import helper
from tmc.wire import process

SECONDS, AHEAD = 0.25, 1.0
"""How long is counted, alone and then together; and the time that processes get to start."""
SIDE = 96
"""Of the matrices that are multiplied: both stay in the cache of a core, so that only arithmetic is counted."""


def worth() -> float | None:
    """The products of all cores at once over those of one; None where a process was not there in time."""
    start = time.monotonic() + AHEAD
    env = os.environ | dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    children = [
        helper.start("deploy.bench.cores", start, int(alone), env=env)
        for alone in (True, *(False,) * (core_count() - 1))
    ]
    counts: list[list[int] | None] = [json.loads(helper.output_of(child) or "null") for child in children]
    there = [count for count in counts if count is not None]
    if len(there) < len(counts):
        return None
    return round(sum(together for _, together in there) / max(there[0][0], 1), 2)


def products(until: float) -> int:
    """How many small matrices are multiplied until then, seconds of the monotonic clock."""
    a = np.ones((SIDE, SIDE), np.float32)
    out, count = np.empty_like(a), 0
    while time.monotonic() < until:
        np.matmul(a, a, out=out)
        count += 1
    return count


def main(argv: list[str]) -> int:
    """A process that counts: [products alone, products together] as JSON, null when it came too late."""
    parser = argparse.ArgumentParser("deploy.bench.cores", description=__doc__)
    parser.add_argument("start", type=float, help="seconds of the monotonic clock")
    parser.add_argument("first", type=int, help="1: counts alone first")
    parser.add_argument("--parent", type=int, default=0, help="process to die with")
    a = parser.parse_args(argv)
    process.become_child(a.parent)
    start, first = a.start, a.first == 1
    products(time.monotonic() + 0.05)
    if time.monotonic() > start:
        print("null")
        return 0
    time.sleep(start - time.monotonic() + (0.0 if first else SECONDS))
    alone = products(start + SECONDS) if first else 0
    print(json.dumps([alone, products(start + 2 * SECONDS)]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
