"""Measures how much more all cores of this machine compute at once than one core does, at this moment.

Two exclusive cores give 2. A virtual machine whose host runs both cores on one physical core has little more than 1,
and that changes from minute to minute. Without this number, a figure of parallel processes means nothing.
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

COUNT_S, STARTUP_S = 0.25, 1.0
"""Time (s) of the count, alone and then together; and the time that the processes get to start."""
SIDE = 96
"""Rows of the matrices that are multiplied: both stay in a core's cache, so that only arithmetic is counted."""


def worth() -> float | None:
    """Return the products of all cores at once over those of one; None if a process started too late."""
    start = time.monotonic() + STARTUP_S
    env = os.environ | dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    children = [
        helper.start("deploy.bench.cores", start, int(alone), env=env)
        for alone in (True, *(False,) * (core_count() - 1))
    ]
    counts: list[list[int] | None] = [json.loads(helper.output_of(child) or "null") for child in children]
    found = [count for count in counts if count is not None]
    if len(found) < len(counts):
        return None
    return round(sum(together for _, together in found) / max(found[0][0], 1), 2)


def products(until: float) -> int:
    """Multiply small matrices until a time (s of the monotonic clock); return how many."""
    a = np.ones((SIDE, SIDE), np.float32)
    out, count = np.empty_like(a), 0
    while time.monotonic() < until:
        np.matmul(a, a, out=out)
        count += 1
    return count


def main(argv: list[str]) -> int:
    """Count in one process; print [products alone, products together] as JSON, or null if it started too late."""
    parser = argparse.ArgumentParser("deploy.bench.cores", description=__doc__)
    parser.add_argument("start", type=float, help="seconds of the monotonic clock")
    parser.add_argument("first", type=int, help="1: counts alone first")
    parser.add_argument("--parent", type=int, default=0, help="end with this process")
    a = parser.parse_args(argv)
    process.become_child(a.parent)
    start, first = a.start, a.first == 1
    products(time.monotonic() + 0.05)
    if time.monotonic() > start:
        print("null")
        return 0
    time.sleep(start - time.monotonic() + (0.0 if first else COUNT_S))
    alone = products(start + COUNT_S) if first else 0
    print(json.dumps([alone, products(start + 2 * COUNT_S)]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
