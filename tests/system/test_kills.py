"""A UAV process is killed repeatedly in flight: the mission's digest is that of the mission without kills."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.command import PATIENCE_S, line_of_trial
from tmc.record.queries import digest


@pytest.mark.parametrize("options", [(), ("--scenario", "1"), ("--set", "comms.phase=staggered")], ids=str)
def test_a_uav_killed_at_up_to_ten_random_ticks_flies_the_same(
    here: Callable[..., subprocess.CompletedProcess[str]],
    running: Callable[[str], list[int]],
    tmp_path: Path,
    options: tuple[str, ...],
) -> None:
    out, draw, kills = tmp_path / "R", random.Random(3), 0
    # Every UAV stalls a little, so that the mission lasts longer than ten pauses before a kill, unless looking for the
    # process takes as long as on a machine with thousands of them.
    mission = ["fly", "planner:greedy", "--no-pictures", "--actors", "3", "--ticks", "600", "--seed", "7", *options]
    command = [*line_of_trial(stall=0.01), *mission, "--out", str(out)]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as run:
        while run.poll() is None and kills < 10:
            found = [p for p in running("actors --id 1 --connect ipc:///") if p in running(str(out))]
            if found and (out / "uav-001.mcap.active").exists():
                time.sleep(draw.uniform(0.05, 0.4))
                try:
                    os.kill(found[0], signal.SIGKILL)
                    kills += 1
                except ProcessLookupError:
                    continue
                while found[0] in running("actors --id 1 --connect ipc:///"):
                    time.sleep(0.01)
            time.sleep(0.01)
        _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, errors
    assert 0 < kills - 1 <= errors.count("uav-001 was killed by SIGKILL; it is started again") <= kills
    assert here(*mission, "--lockstep", "--out", tmp_path / "reference").returncode == 0
    assert digest(out) == digest(tmp_path / "reference")
