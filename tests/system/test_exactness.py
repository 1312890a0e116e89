"""N processes fly what one process flies: for any team, schedule of exchanges, scenario, map and stalls."""

from __future__ import annotations

from itertools import count
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from deploy.verify import exactness
from tmc.kernel.config import Config, build
from tmc.kernel.rastertext import BLOCKED, FREE, ROAD

COUNTER = count()


@st.composite
def rasters(draw: st.DrawFn) -> list[str]:
    """Draw small maps with a street along the top, so that UAVs are often next to each other."""
    cols, rows = draw(st.integers(3, 8)), draw(st.integers(2, 7))
    cells = st.sampled_from(ROAD * 5 + FREE * 3 + BLOCKED)
    return [ROAD * cols] + ["".join(draw(st.lists(cells, min_size=cols, max_size=cols))) for _ in range(rows - 1)]


@st.composite
def missions(draw: st.DrawFn) -> tuple[list[str], dict[str, Any]]:
    """Draw a map, and settings of a mission on it."""
    raster = draw(rasters())
    roads = sum(row.count(ROAD) for row in raster)
    return raster, {
        "scenario": draw(st.sampled_from([1, 2, 2])),
        "team.size": draw(st.integers(1, min(roads, 6))),
        "team.controller": draw(st.sampled_from(["planner:greedy", "planner:random-road", "planner:random"])),
        "team.sensing_range": draw(st.sampled_from([1.0, 1.5, 3.0])),
        "comms.period": draw(st.integers(1, 12)),
        "comms.phase": draw(st.sampled_from(["together", "staggered"])),
        "world.initial_map": draw(st.sampled_from(["visited", "random"])),
        "world.start": draw(st.sampled_from(["free", "road"])),
        "reward.uncertainty": draw(st.sampled_from(["true", "own"])),
        "training.ticks": draw(st.integers(1, 40)),
        "training.episodes": draw(st.integers(1, 2)),
        "training.seed": draw(st.integers(0, 2**32)),
        "trial.stall": draw(st.sampled_from([0.001, 0.003, 0.01])),
        "trial.stall_share": draw(st.sampled_from([0.05, 0.2])),
        "trial.stall_spread": 1.0,
        "trial.stall_uav": draw(st.integers(-1, 1)),
    }


@settings(
    max_examples=10, deadline=None, phases=(Phase.explicit, Phase.generate),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)  # fmt: skip
@given(missions())
def test_processes_fly_what_lock_step_flies(tmp_path: Path, mission: tuple[list[str], dict[str, Any]]) -> None:
    """Every fact of the two logs is the same, observations included."""
    raster, values = mission
    folder = tmp_path / f"{next(COUNTER)}"
    folder.mkdir()
    (folder / "map.txt").write_text("\n".join([*raster, ""]))
    config: Config = build({**values, "world.map": str(folder / "map.txt")})
    outcome = exactness.verify(config, None, folder)
    assert outcome.difference is None, f"{outcome.difference}; {values}; {raster}"
    assert outcome.steps == config.team.size * config.training.ticks * config.training.episodes
    assert not folder.exists()
