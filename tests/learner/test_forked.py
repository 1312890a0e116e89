"""A learner forked from a process with all imports done learns as one that was started directly."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.command import PATIENCE_S

ROOT = Path(__file__).parents[2]
CODE = """
import hashlib, os
import numpy as np
from learner import __main__
from learner.trainer import start
from tmc.kernel.config import build
from tmc.kernel.policy import view_shape
from tmc.kernel.world import World
from learner.batching import Batch

config = build({"training.threads": 2})
world = World(config)
shape = (config.dqn.batch_size, *view_shape(config, world.grid))

def minibatch(n):
    rng, b = np.random.Generator(np.random.Philox(n)), shape[0]
    o, o_next, action = rng.random(shape, "f4"), rng.random(shape, "f4"), rng.integers(0, 9, b).astype("u1")
    reward = rng.normal(0, 5, b).astype("f4")
    rest = (np.full(b, 0.9, "f4"), np.ones((b, 9), "u1"), np.arange(b) + n * b)
    return Batch(0, o, lambda rows: o_next[rows], action, reward, *rest)

def learn():
    trainer = start(config, world.grid)
    for n in range(5):
        trainer.update(minibatch(n))
    digest = hashlib.sha256()
    for name, tensor in sorted(trainer.state().tensors.items()):
        digest.update(name.encode() + tensor.numpy().tobytes())
    print(digest.hexdigest(), len(os.listdir("/proc/self/task")) > 1, flush=True)

if (child := os.fork()) == 0:
    learn()
    os._exit(0)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
learn()
"""


def test_a_forked_learner_computes_the_same_bit_for_bit_on_its_threads() -> None:
    """Learn first in the fork, then in the process that it was forked from."""
    env = os.environ | {"OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-P", "-c", CODE], cwd=ROOT, env=env,
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    forked, started = done.stdout.split("\n")[:2]
    assert forked == started and forked.endswith("True")
