"""The observation, eq. (12): its values, and that a UAV and the replay build the same bits and allow the same moves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tmc.kernel.grid import ACTIONS, OFF_GRID, STAY
from tmc.kernel.observation import EGO, PEER, ObservationBuilder, Views
from tmc.kernel.world import World

Worlds = Callable[..., World]
VIEWS: dict[str, dict[str, Any]] = {
    "whole": {},
    "ego-1": {"observation.view": "ego", "observation.radius": 1},
    "ego-2": {"observation.view": "ego", "observation.radius": 2},
    "ego-9": {"observation.view": "ego", "observation.radius": 9},
}
TEAM = 5


@pytest.fixture(params=VIEWS)
def view(request: pytest.FixtureRequest) -> dict[str, Any]:
    return VIEWS[request.param]


def states(world: World, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[Any]]:
    """Random states: cells (B,), team (B, N), uav (B,), u (B, R); every open cell is an ego cell at least once."""
    rng = np.random.default_rng(seed)
    open_cells = np.flatnonzero(~world.map.blocked)
    B = 8 * open_cells.size
    uav = rng.integers(0, TEAM, B)
    team = np.stack([rng.permutation(open_cells)[:TEAM] for _ in range(B)])
    for b, wanted in enumerate(np.tile(open_cells, 8)):
        hits = np.flatnonzero(team[b] == wanted)
        if hits.size:
            team[b, hits[0]] = team[b, uav[b]]
        team[b, uav[b]] = wanted
    return team[np.arange(B), uav], team, uav, rng.random((B, world.law.cells.size))


def peers_of(observer: ObservationBuilder, cell: int, team: list[int], me: int) -> list[int]:
    """N_i(t) by hand."""
    return [
        k
        for j, k in enumerate(team)
        if j != me and (np.isinf(observer.sensing) or observer.grid.within(cell, k, observer.sensing))
    ]


def test_an_image_drawn_over_in_place_has_the_same_bits(view: dict[str, Any], world_of: Worlds) -> None:
    """Whatever was on it before."""
    world = world_of({"team.size": TEAM, **view})
    observer = ObservationBuilder(world)
    canvas, image = observer.canvas(), observer.canvas().image
    for cell, team, me, u in zip(*states(world, seed=7), strict=True):
        peers = peers_of(observer, int(cell), team.tolist(), int(me))
        canvas.draw(int(cell), peers, u)
        assert canvas.image.tobytes() == observer.observe(int(cell), peers, u).tobytes()
    assert not image.any()  # no other UAV's


@pytest.mark.parametrize("scenario", [1, 2])
@pytest.mark.parametrize("settings", [{}, {"world.alpha_offroad": 0.001}, {"team.sensing_range": 3.0}])
def test_single_and_batch_agree_bit_for_bit(
    scenario: int, settings: dict[str, Any], view: dict[str, Any], world_of: Worlds
) -> None:
    world = world_of({"team.size": TEAM, "scenario": scenario, **settings, **view})
    observer = ObservationBuilder(world)
    cells, team, uav, u = states(world, seed=scenario)
    sensed = observer.sensed(cells, team, uav)
    views = observer.views(cells, team, uav, u.astype("<f4"))
    batch = observer.observe_batch(views)
    allowed = observer.allowed_batch(views)
    _, height, width = observer.shape
    used = np.full((cells.size, height, width, 3), 7.0, np.float32).transpose(0, 3, 1, 2)  # channels last, drawn over
    assert observer.observe_batch(views, used) is used and (used == batch).all()
    assert (observer.observe_batch(views.rows(slice(3, 5))) == batch[3:5]).all()
    assert batch.shape == (cells.size, *observer.shape)
    assert batch.dtype == np.float32
    assert allowed.dtype == np.uint8
    for b, cell in enumerate(cells.tolist()):
        peers = peers_of(observer, cell, team[b].tolist(), int(uav[b]))
        assert team[b][sensed[b]].tolist() == peers
        assert observer.observe(cell, peers, u[b]).tobytes() == batch[b].tobytes()
        assert np.flatnonzero(allowed[b]).tolist() == observer.allowed(cell, peers)


def test_observation_of_the_whole_grid(world_of: Worlds) -> None:
    world = world_of()
    observer = ObservationBuilder(world)
    u = np.linspace(0.1, 0.9, world.law.cells.size)
    position, terrain, uncertainty = observer.observe(7, [8, 14], u).reshape(3, -1)
    assert {k: v for k, v in enumerate(position.tolist()) if v} == {7: EGO, 8: PEER, 14: PEER}
    assert (terrain == np.where(world.map.blocked, -1, world.map.road)).all()
    assert (uncertainty[world.law.cells] == u.astype(np.float32)).all()
    assert (uncertainty[world.law.index < 0] == 0).all()


def test_channel_values() -> None:
    assert (EGO, PEER) == (1.0, 0.5)


def test_egocentric_view_is_the_whole_view_cut_out(world_of: Worlds) -> None:
    """Shifted so that the UAV stands in the middle; terrain -1 and nothing else beyond the edge."""
    radius = 2
    whole = ObservationBuilder(world_of())
    ego = ObservationBuilder(world_of({"observation.view": "ego", "observation.radius": radius}))
    u = np.linspace(0.1, 0.9, 17)
    padding = [(0, 0), (radius, radius), (radius, radius)]
    for cell in np.flatnonzero(~world_of().map.blocked).tolist():
        peers = [k for k in (0, 8, 23, 31) if k != cell]
        padded = np.pad(whole.observe(cell, peers, u), padding)
        inside = np.pad(np.ones((1, 5, 7)), padding)
        padded[1] = np.where(inside[0] == 1, padded[1], -1.0)
        row, col = divmod(cell, 7)
        assert (ego.observe(cell, peers, u) == padded[:, row : row + 5, col : col + 5]).all()


def test_beyond_the_edge_is_terrain_like_an_obstacle(world_of: Worlds) -> None:
    observer = ObservationBuilder(world_of({"observation.view": "ego", "observation.radius": 1}))
    position, terrain, uncertainty = observer.observe(0, [], np.ones(17))
    assert terrain.tolist() == [[-1, -1, -1], [-1, 0, 1], [-1, 1, 1]]
    assert uncertainty.tolist() == [[0, 0, 0], [0, 0, 1], [0, 1, 1]]
    assert position.tolist() == [[0, 0, 0], [0, 1, 0], [0, 0, 0]]


def test_peers_outside_the_view_are_not_wrapped_into_it(world_of: Worlds) -> None:
    observer = ObservationBuilder(world_of({"observation.view": "ego", "observation.radius": 1, "scenario": 1}))
    everywhere = [k for k in range(35) if k != 14]
    position = observer.observe(14, everywhere, np.zeros(17))[0]
    assert position.tolist() == [[0, 0.5, 0.5], [0, 1, 0.5], [0, 0.5, 0.5]]


def test_observation_is_written_into_the_buffer(world_of: Worlds, view: dict[str, Any]) -> None:
    """Nothing of an earlier observation stays."""
    observer = ObservationBuilder(world_of(view))
    buffer = np.full(observer.shape, 7.0, np.float32)
    fresh = observer.observe(9, [2], np.full(17, 0.25))
    observer.observe(9, [2], np.full(17, 0.25), buffer)
    assert (buffer == fresh).all()


def test_observing_changes_nothing(world_of: Worlds, view: dict[str, Any]) -> None:
    observer = ObservationBuilder(world_of(view))
    u = np.linspace(0, 1, 17)
    first = observer.observe(9, [2], u).copy()
    observer.observe(30, [8], u[::-1].copy())[...] = 3.0
    assert (observer.observe(9, [2], u) == first).all()


@pytest.mark.parametrize(("radius", "seen"), [(0.0, 0), (1.0, 4), (1.5, 8), (2.0, 12)])
def test_sensed_is_euclidean(radius: float, seen: int, world_of: Worlds) -> None:
    observer = ObservationBuilder(world_of({"team.sensing_range": radius}))
    centre = 2 * 7 + 3
    team = np.arange(35)[None, :]
    assert observer.sensed(np.array([centre]), team, np.array([centre])).sum() == seen


def test_a_uav_does_not_sense_itself_and_in_scenario_i_senses_all(world_of: Worlds) -> None:
    observer = ObservationBuilder(world_of({"scenario": 1, "team.sensing_range": 0.0}))
    assert (
        observer.sensed(np.array([5, 5]), np.array([[5, 0, 34]] * 2), np.array([0, 0])).tolist()
        == [[False, True, True]] * 2
    )


def test_allowed_moves_leave_out_edges_obstacles_and_sensed_peers(world_of: Worlds) -> None:
    world = world_of()
    observer = ObservationBuilder(world)
    for cell in np.flatnonzero(~world.map.blocked).tolist():
        free = [a for a, k in enumerate(world.grid.target_lists[cell]) if k != OFF_GRID and not world.map.blocked[k]]
        assert observer.allowed(cell, []) == free
        assert np.flatnonzero(observer.free[cell]).tolist() == free
        peers = [world.grid.target_lists[cell][a] for a in free[:2] if a != STAY]
        assert observer.allowed(cell, peers) == [a for a in free if world.grid.target_lists[cell][a] not in peers]


def test_staying_is_allowed_to_a_uav_that_is_walled_in(world_of: Worlds) -> None:
    """Obstacles on three sides and UAVs in the open cells: there is always one action left."""
    world = world_of({"team.size": 1}, "#X#\nXX.\n##.\n")
    observer = ObservationBuilder(world)
    assert [ACTIONS[a][0] for a in observer.allowed(0, [])] == ["stay"]
    assert observer.allowed(5, [2, 7, 8]) == [STAY]
    walled_in = Views(np.array([5], "<u2"), np.array([[2, 7, 8]], "<u2"), np.zeros((1, 0), "<f4"))
    assert observer.allowed_batch(walled_in).tolist() == [[0] * 8 + [1]]
