"""Overfly from Python: train a team of UAVs, fly it, compare policies, and read back what was flown.

>>> import overfly
>>> run = overfly.fly("planner:greedy", out="demo", lockstep=True, actors=2, ticks=20, quiet=True)
>>> run.moves(1).shape  # a cell for each tick, 0 to 20, and UAV
(21, 2)
>>> print(overfly.open_run("demo").summary.mission.controller)
planner:greedy

The command `overfly` is built on this module. Importing it loads nothing heavy: NumPy, ONNX Runtime, ZeroMQ and torch
come with the first call that needs them. What the command would print as a sentence is raised as an `overfly.Error`.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

from tmc.kernel.errors import OverflyError as Error

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

    from deploy.run.evaluation import MissionResult, Row, Table
    from deploy.run.progress import Progress
    from deploy.run.supervisor import MissionFailed
    from tmc.analysis.run_data import Episode, Learning, RunData
    from tmc.analysis.summary import Summary
    from tmc.kernel.config import Config, ConfigError
    from tmc.kernel.observation import ObservationBuilder
    from tmc.kernel.policy import PolicyCard, PolicyError
    from tmc.kernel.roadmap import MapError, RoadMap
    from tmc.kernel.world import World as KernelWorld
    from tmc.record.errors import RecordError
    from tmc.record.reader import LogMessage

    __version__: str

__all__ = [
    "Config",
    "ConfigError",
    "Error",
    "EvaluationSettings",
    "FlightRecord",
    "LogMessage",
    "Map",
    "MapError",
    "MissionFailed",
    "MissionResult",
    "Policy",
    "PolicyCard",
    "PolicyError",
    "RecordError",
    "Row",
    "Run",
    "Settings",
    "Summary",
    "Table",
    "World",
    "__version__",
    "evaluate",
    "fly",
    "open_run",
    "resume",
    "train",
]

_LAZY = {
    "Config": "tmc.kernel.config",
    "ConfigError": "tmc.kernel.config",
    "LogMessage": "tmc.record.reader",
    "MapError": "tmc.kernel.roadmap",
    "MissionFailed": "deploy.run.supervisor",
    "MissionResult": "deploy.run.evaluation",
    "PolicyCard": "tmc.kernel.policy",
    "PolicyError": "tmc.kernel.policy",
    "RecordError": "tmc.record.errors",
    "Row": "deploy.run.evaluation",
    "Summary": "tmc.analysis.summary",
    "Table": "deploy.run.evaluation",
}
"""Names of this module that are imported when they are first used, and where from."""

StrPath = str | os.PathLike[str]


if not TYPE_CHECKING:  # a type checker that saw it would take any name for one of this module

    def __getattr__(name: str) -> Any:
        """Import a name of `_LAZY`, or look the version up, when it is first asked for."""
        if name == "__version__":
            from importlib.metadata import version  # takes as long as all else at the start of the command

            found: Any = version("overfly")
        elif name in _LAZY:
            found = getattr(importlib.import_module(_LAZY[name]), name)
        else:
            raise AttributeError(f"module 'overfly' has no attribute '{name}'")
        globals()[name] = found
        return found

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})


class EvaluationSettings(TypedDict, total=False):
    """Settings that missions of an evaluation share, by the names of the command's options.

    `scenario`: 1 or 2. `tu`: T_u, ticks between two exchanges. `ticks`: per episode. `map`: a built-in map or a text
    raster. `settings`: any other setting by its dotted key, such as `{"reward.collision": -5}`;
    `overfly doctor --settings` lists them.
    """

    scenario: int
    tu: int
    ticks: int
    map: StrPath
    settings: Mapping[str, Any]


class Settings(EvaluationSettings, total=False):
    """Settings of a mission: those of `EvaluationSettings`, N (`actors`), the number of episodes, and the seed."""

    actors: int
    episodes: int
    seed: int


def train(
    preset: str = "quick",
    *,
    out: StrPath | None = None,
    lockstep: bool = False,
    quiet: bool = False,
    _command: str = "",
    **settings: Unpack[Settings],
) -> Run:
    """Train a team, as `overfly run PRESET` does, and return the run once it has ended.

    `out`: the run folder, new or empty; `runs/<preset>-<time>` by default. `lockstep`: in this process instead of one
    for each UAV, the TMC and the learner. `quiet`: no progress and no remarks on stderr. `settings`: see `Settings`.
    Raises ConfigError and other kinds of Error before anything is written, MissionFailed when a process fails. At
    KeyboardInterrupt all processes end in order, and `resume` goes on with the run.

    >>> small = {"replay.learn_start": 8, "dqn.batch_size": 8}
    >>> run = overfly.train(out="trained", lockstep=True, quiet=True, episodes=2, ticks=20, settings=small)
    >>> run.episodes, run.summary.pace.updates > 20
    ((1, 2), True)
    """
    from deploy import extras
    from deploy import settings as presets
    from deploy.run import mission

    config = presets.config_for(preset, _values("train", settings))
    extras.require(*mission.needs(config, None))
    world = mission.check(config)
    mission.check_training(config, _say(quiet))
    return _fly(
        world,
        _path(out),
        preset,
        lockstep=lockstep,
        quiet=quiet,
        learns=True,
        command=_command or _call("train", preset, settings),
    )


def fly(
    who: StrPath,
    *,
    out: StrPath | None = None,
    lockstep: bool = False,
    quiet: bool = False,
    _command: str = "",
    **settings: Unpack[Settings],
) -> Run:
    """Fly a fixed policy or a planner, as `overfly fly POLICY` does; deterministic.

    `who`: a policy file, a run folder, or `planner:random`, `planner:random-road`, `planner:greedy`. A run folder
    brings its settings along; otherwise those of the paper hold. One episode unless `episodes` says otherwise. All else
    as for `train`.

    >>> run = overfly.fly("planner:random-road", lockstep=True, quiet=True, ticks=20, seed=7)
    >>> run.folder.parent, run.config.training.seed, float(run.uncertainty(1)[0])
    (PosixPath('runs'), 7, 0.0)
    """
    from deploy import extras, policy_spec
    from deploy.run import mission
    from tmc.kernel.config import build

    extras.require()
    pilot = policy_spec.resolve(os.fspath(who), _say(quiet))
    config = build(policy_spec.mission_values(pilot, _values("fly", settings)))
    world = mission.check(config, pilot.policy, pilot.name)
    return _fly(
        world,
        _path(out),
        "fly",
        lockstep=lockstep,
        quiet=quiet,
        learns=False,
        policy=pilot.policy,
        flies=pilot.name,
        command=_command or _call("fly", os.fspath(who), settings),
    )


def resume(run: StrPath, *, quiet: bool = False, _command: str = "") -> Run:
    """Go on with a run or flight that was interrupted, as `overfly run --resume RUN` does, as processes.

    Nothing is flown when the run came to its end. Raises ConfigError when `run` cannot be resumed, and as `train`.

    >>> overfly.resume("demo").episodes
    (1,)
    """
    from deploy import extras
    from deploy.run import mission

    folder = Path(run)
    if mission.finished(folder):
        mission.require_settings(folder)
        return Run(folder)
    world, policy = mission.interrupted(folder, _say(quiet))
    extras.require(*mission.needs(world.config, policy))
    command = _command or _call("resume", str(folder), {})
    mission.Mission(world, folder, command, policy, _progress(world, quiet)).fly(in_one_process=False)
    return Run(folder)


def evaluate(
    whos: StrPath | Iterable[StrPath],
    *,
    seeds: int = 10,
    first_seed: int = 1_000_000,
    actors: int | Sequence[int] | None = None,
    jobs: int | None = None,
    quiet: bool = False,
    **settings: Unpack[EvaluationSettings],
) -> Table:
    """Compare policies and planners, as `overfly evaluate POLICY...` does: `seeds` missions of one episode each.

    `whos`: one or several, each as for `fly`; a run folder brings its world along for all of them. `actors`: a team
    size, or several; by default that of the settings. `jobs`: processes to use, one for each core by default. Raises
    Error before the first mission, or when a policy fails in flight.

    >>> table = overfly.evaluate(["planner:greedy", "planner:random"], seeds=2, actors=[1, 3], ticks=20, jobs=1)
    >>> [(row.who, row.actors, row.seeds) for row in table.rows]  # print(table) shows the numbers
    [('planner:greedy', 1, 2), ('planner:greedy', 3, 2), ('planner:random', 1, 2), ('planner:random', 3, 2)]
    """
    from deploy import extras
    from deploy.run import evaluation
    from tmc.kernel.config import ConfigError

    extras.require()
    jobs = (os.cpu_count() or 1) if jobs is None else jobs
    names = [os.fspath(who) for who in ([whos] if isinstance(whos, str | os.PathLike) else whos)]
    if seeds < 1 or jobs < 1:
        raise ConfigError(f"seeds = {seeds} and jobs = {jobs} must be 1 or more")
    if not names:
        raise ConfigError("there is nothing to evaluate: name a policy file, a run folder or a planner")
    teams = [] if actors is None else [actors] if isinstance(actors, int) else [*dict.fromkeys(actors)]
    chosen, numbers = _values("evaluate", settings), range(first_seed, first_seed + seeds)
    return evaluation.evaluate(names, chosen, teams, numbers, jobs, _say(quiet), _say(quiet, prefix=""))


def open_run(path: StrPath) -> Run:
    """The run in a folder: finished, still being flown, or cut off. Raises RecordError when it holds no logs of a run.

    >>> overfly.open_run("demo")
    Run('demo')
    """
    from tmc.record.run_folder import run_files

    run_files(path)
    return Run(path)


@dataclass(frozen=True, eq=False)
class FlightRecord:
    """What one UAV did between two exchanges, as the TMC accepted it.

    `cells`: (n + 1,), from tick `first` on; `actions` (order: N, S, W, E, NW, NE, SW, SE, stay), `blocks` (0: not
    blocked, 1: edge of the grid, 2: obstacle, 3: UAV) and `rewards` (by the UAV's own map): (n,), of each move. The
    last record of an episode, or one that ends where the next begins, may have as many cells as moves.
    """

    uav: int
    episode: int
    first: int
    cells: NDArray[np.int64]
    actions: NDArray[np.int64]
    blocks: NDArray[np.int64]
    rewards: NDArray[np.float64]


class Run:
    """A run folder. What its logs hold is read once, when it is first asked for; `open_run` again to read it again.

    Arrays of all episodes take about 8 (N + 2) bytes per tick; `records` and `messages` read as they go, whatever the
    length of the log. Raises RecordError where the logs do not hold what is asked for.
    """

    def __init__(self, folder: StrPath) -> None:
        self.folder = Path(folder)

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r})"

    def __fspath__(self) -> str:
        """The folder, so that a run can be given to `fly` and `evaluate`."""
        return str(self.folder)

    @cached_property
    def config(self) -> Config:
        """All settings of the run, such as `run.config.team.size`."""
        from tmc.analysis.run_config import settings_of
        from tmc.center.journal import journal_in

        return settings_of(self.folder, journal_in(self.folder)).config

    @cached_property
    def world(self) -> World:
        """The world that it flew in, with the map as it was."""
        return World._of(self._data.world)

    @cached_property
    def policy(self) -> Policy:
        """The policy that was trained, or that flew. Raises PolicyError or ConfigError where there is none."""
        return Policy.load(self)

    @cached_property
    def _data(self) -> RunData:
        from tmc.analysis.run_data import read

        return read(self.folder)

    def _episode(self, number: int) -> Episode:
        return self._data.episode(number)

    @property
    def episodes(self) -> tuple[int, ...]:
        """Numbers of the episodes that were flown, from 1 on."""
        return tuple(episode.number for episode in self._data.episodes)

    def moves(self, episode: int) -> NDArray[np.int64]:
        """Cells by tick 0..T and UAV, shape (T + 1, N); -1 where the log does not say where the UAV was.

        Cells are numbered row by row from the north-west: `np.unravel_index(cells, run.world.map.shape)`.
        """
        return self._episode(episode).cells

    def uncertainty(self, episode: int) -> NDArray[np.float64]:
        """Uncertainty of the true map by tick 0..T, the sum over cells, shape (T + 1,); NaN where it is not known."""
        return self._episode(episode).uncertainty

    def reward(self, episode: int) -> NDArray[np.float64]:
        """Mean reward per UAV by tick 0..T, shape (T + 1,); NaN where it is not known, as at tick 0."""
        return self._episode(episode).reward

    def events(self, episode: int) -> NDArray[np.int64]:
        """Tick and cell of each event that appeared, shape (E, 2); none in scenario 2."""
        return self._episode(episode).events

    @cached_property
    def summary(self) -> Summary:
        """The numbers that `overfly analyze RUN` prints."""
        from tmc.analysis.metrics import summarize

        return summarize(self._data)

    @cached_property
    def metrics(self) -> dict[str, NDArray[np.float64]]:
        """One array for each number of an episode, a value for each of `episodes`; NaN where the run has none.

        Among them `uncertainty` (eq. (6), the mean over ticks of the sum over cells), `per_cell` (the same per
        monitored cell), `times_bound` (its ratio to the lower bound), `reward` (mean per UAV per tick), `blocked_uav`,
        `coverage`, `epsilon`, `updates`.

        >>> overfly.open_run("trained").metrics["episode"]
        array([1., 2.])
        """
        import numpy as np

        rows = self.summary.episodes
        names = [field.name for field in fields(rows[0])]
        return {name: np.array([getattr(row, name) for row in rows], np.float64) for name in names}

    @property
    def learning(self) -> Learning:
        """Loss and Q values by update: arrays `updates`, `loss`, `q_mean`, `target_mean` of one length."""
        return self._data.learning

    def records(self, episode: int | None = None) -> Iterator[FlightRecord]:
        """Flight records in the order in which the TMC accepted them, each once; of one episode when given.

        >>> {record.uav for record in overfly.open_run("demo").records()}
        {0, 1}
        """
        import numpy as np

        from tmc.record import overfly_pb2
        from tmc.record.queries import messages

        newest: dict[int, int] = {}
        for m in messages(self.folder, overfly_pb2.FlightRecord):
            if m.sequence <= newest.get(m.uav, -1):  # a TMC that was started again may have logged it twice
                continue
            newest[m.uav] = m.sequence
            if episode in (None, m.episode):
                cells, actions, blocks = (np.array(values[:], np.int64) for values in (m.cells, m.actions, m.blocks))
                rewards = np.array(m.rewards[:], np.float64)
                yield FlightRecord(m.uav, m.episode, m.first, cells, actions, blocks, rewards)

    def messages(self, *topics: str) -> Iterator[LogMessage]:
        """Messages of all logs of the run, one log after the other, of these topics only when given.

        docs/reference/log-format.md lists topics and types.

        >>> [m.message.phase for m in overfly.open_run("demo").messages("/tmc/episode")]
        ['begin', 'end']
        """
        from tmc.record.reader import Log
        from tmc.record.run_folder import run_files

        for path in run_files(self.folder).values():
            yield from Log(path).entries(topics or None)


class Map:
    """A map: which cells are road, and which are blocked. Arrays are read-only, shape (rows, cols), north on top.

    >>> toronto = overfly.Map.load("downtown-toronto")
    >>> toronto.shape, int(toronto.road.sum()), int(toronto.blocked.sum())
    ((30, 30), 323, 21)
    """

    def __init__(self, road_map: RoadMap) -> None:
        self._map = road_map

    @staticmethod
    def load(name: StrPath = "downtown-toronto", *, roads: str = "main", obstacles: str = "static") -> Map:
        """A built-in map, or the text raster at that path.

        `roads`: "major", "main", "arterial" or "all" classes of street of a built-in map. `obstacles`: "none",
        "static" or "event-day". Raises MapError.
        """
        from tmc.kernel.roadmap import load_map

        return Map(load_map(os.fspath(name), roads, obstacles))

    @staticmethod
    def names() -> tuple[str, ...]:
        """The built-in maps."""
        from tmc.kernel.roadmap import builtin_maps

        return builtin_maps()

    def __repr__(self) -> str:
        rows, cols = self.shape
        return f"<Map {self.name}, {rows} x {cols} cells of {self.cell_m:g} m>"

    @property
    def name(self) -> str:
        return self._map.name

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self._map.grid.rows, self._map.grid.cols

    @property
    def cell_m(self) -> float:
        """Width of a cell, metres."""
        return self._map.cell_m

    @property
    def road(self) -> NDArray[np.bool_]:
        """True where a cell is road."""
        return self._map.road.reshape(self.shape)

    @property
    def blocked(self) -> NDArray[np.bool_]:
        """True where a cell is a static obstacle or a no-fly cell."""
        return self._map.blocked.reshape(self.shape)

    @property
    def rates(self) -> dict[str, NDArray[np.float64]]:
        """Relative rates of events by name, mean 1 over the road cells; "uniform" is always there."""
        return {name: rate.reshape(self.shape) for name, rate in self._map.rates.items()}

    @property
    def text(self) -> str:
        """The raster that `load` reads: a line for each row, `.` free, `#` road, `X` blocked."""
        return self._map.text()

    def check(self) -> list[str]:
        """What to look at before this map is flown, a sentence each; empty for a map in good order."""
        from tmc.kernel.roadmap import check

        return check(self._map)


class World:
    """The world of a mission: its settings, its map, its rates, and what chance decides. Immutable.

    Made from a preset and `Settings`, or taken from a run (`run.world`). Raises ConfigError or MapError.

    >>> world = overfly.World("quick", actors=2, seed=7)
    >>> world.starts(1).shape, float(world.alpha.max())
    ((2,), 0.01)
    """

    def __init__(self, preset: str = "paper", **settings: Unpack[Settings]) -> None:
        from deploy import settings as presets
        from tmc.kernel.world import World as KernelWorld

        self._world: KernelWorld = KernelWorld(presets.config_for(preset, _values("World", settings)))

    @classmethod
    def _of(cls, world: KernelWorld) -> World:
        made = cls.__new__(cls)
        made._world = world
        return made

    def __repr__(self) -> str:
        config = self.config
        return f"<World {self.map.name}, {config.team.size} UAVs, scenario {config.scenario}, T_u = {config.T_u}>"

    @property
    def config(self) -> Config:
        """All settings."""
        return self._world.config

    @cached_property
    def map(self) -> Map:
        """The map."""
        return Map(self._world.map)

    @property
    def alpha(self) -> NDArray[np.float64]:
        """Events per tick in each cell, shape (rows, cols); 0 where nothing is monitored."""
        return self._world.alpha.reshape(self.map.shape)

    @property
    def lower_bound(self) -> float | None:
        """A mean uncertainty (sum over cells) that no team of this size can beat; None where none is known."""
        from tmc.analysis.metrics import bound_of

        return bound_of(self._world, self.config.training.ticks)

    def starts(self, episode: int) -> NDArray[np.int64]:
        """The distinct cells that the UAVs start an episode on, shape (N,)."""
        import numpy as np

        return np.array(self._world.starts(episode), np.int64)

    @cached_property
    def _observer(self) -> ObservationBuilder:
        from tmc.kernel.observation import ObservationBuilder

        return ObservationBuilder(self._world)

    def observe(
        self, cell: int, peers: Sequence[int] = (), uncertainty: ArrayLike | None = None
    ) -> NDArray[np.float32]:
        """The observation [P, M, U] of a UAV (eq. (12)), shape (3, height, width), float32.

        `cell`: where it stands. `peers`: cells of the UAVs that it senses. `uncertainty`: its own map, shape
        (rows, cols); zero by default. Raises ConfigError for a cell or a map that does not fit.
        """
        import numpy as np

        from tmc.kernel.config import ConfigError

        size, shape = self._world.grid.size, self.map.shape
        u = np.zeros(shape) if uncertainty is None else np.asarray(uncertainty, np.float64)
        if u.shape != shape:
            raise ConfigError(f"the map of uncertainty has the shape {u.shape}, the grid {shape}: give one of the grid")
        cells = [int(k) for k in (cell, *peers)]
        if not all(0 <= k < size for k in cells):
            raise ConfigError(f"a cell of {cells} is not on the grid: give numbers from 0 to {size - 1}")
        return self._observer.observe(cells[0], cells[1:], u.ravel()[self._world.law.cells])


class Policy:
    """A policy file, run by ONNX Runtime on one thread.

    >>> policy = overfly.Policy.load("trained")
    >>> world = overfly.open_run("trained").world
    >>> seen = world.observe(int(world.starts(1)[0]))
    >>> policy.q_values(seen).shape, policy.act(seen) in range(9)
    ((9,), True)
    """

    def __init__(self, model: bytes) -> None:
        """Open the bytes of an ONNX model; raises PolicyError unless it is an Overfly policy."""
        from actors.policy import open_model

        self._session, self._card = open_model(model)

    @staticmethod
    def load(file: StrPath) -> Policy:
        """A policy file, or the policy of a run folder. Raises PolicyError or ConfigError where there is none."""
        from deploy import policy_spec
        from tmc.kernel.policy import PolicyError

        found = policy_spec.resolve(os.fspath(file), _say(quiet=True))
        if found.policy is None:
            raise PolicyError(f"{found.name} flies a planner: give a policy file, or the folder of a training")
        return Policy(found.policy)

    @property
    def card(self) -> PolicyCard:
        """What the file says of itself: shape of the observation, view, scenario, version, updates."""
        return self._card

    def q_values(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Q(o, a) of the nine actions: shape (9,) for an observation (3, height, width), (B, 9) for B of them.

        Raises PolicyError for another shape, or when the model cannot be run.
        """
        import numpy as np

        from actors.policy import run_model
        from tmc.kernel.policy import PolicyError

        o = np.asarray(observation, np.float32)
        shape = (self._card.channels, self._card.height, self._card.width)
        if o.shape[-3:] != shape or o.ndim not in (3, 4):
            raise PolicyError(f"an observation of this policy has the shape {shape}, not {o.shape}")
        q = run_model(self._session, o.reshape(-1, *shape))
        return q[0] if o.ndim == 3 else q

    def act(self, observation: ArrayLike) -> int:
        """The action with the largest Q, as a UAV would choose it: N, S, W, E, NW, NE, SW, SE, stay are 0 to 8.

        A policy that was trained to mask blocked moves chooses among those that the observation shows to be free.
        Raises PolicyError as `q_values`, or when a value is not finite.
        """
        import numpy as np

        from tmc.kernel.observation import allowed_in
        from tmc.kernel.policy import PolicyError

        o = np.asarray(observation, np.float32)
        if o.ndim != 3:
            raise PolicyError(f"an action is chosen for one observation (3, height, width), not for {o.shape}")
        q = self.q_values(o)
        if not np.isfinite(q).all():
            raise PolicyError(f"the policy gave values that are not finite ({q})")
        allowed = allowed_in(o) if self._card.mask_blocked else list(range(q.size))
        return max(allowed, key=q.__getitem__)


def _values(function: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted keys and values of the keyword arguments of `function`; None counts as not given."""
    from deploy.settings import OPTIONS
    from tmc.kernel.config import SETTINGS, ConfigError

    keys, values = {option.removeprefix("--"): key for option, key, _ in OPTIONS}, dict[str, Any]()
    for name, value in options.items():
        if name in keys and value is not None:
            values[keys[name]] = os.fspath(value) if isinstance(value, os.PathLike) else value
        elif name not in keys and name != "settings":
            from difflib import get_close_matches

            near = [f'settings={{"{key}": ...}}' for key in SETTINGS if key.rpartition(".")[2] == name]
            near += get_close_matches(name, [*keys, "settings", "out", "lockstep", "quiet"], 1)
            hint = f"did you mean {near[0]}?" if near else f'write settings={{"KEY": VALUE}}, or {", ".join(keys)}'
            raise ConfigError(f"{function} takes no '{name}': {hint}")
    return values | dict(options.get("settings") or {})


def _call(function: str, first: str, options: Mapping[str, Any]) -> str:
    """The call as `run.json` has it, where the command has its command line."""
    words = [repr(first), *(f"{name}={value!r}" for name, value in options.items())]
    return f"overfly.{function}({', '.join(words)})"


def _path(out: StrPath | None) -> Path | None:
    return None if out is None else Path(out)


def _say(quiet: bool, prefix: str | None = None) -> Any:
    """What takes a line for the user: stderr, or nothing."""
    from tmc.wire import process

    def say(text: str) -> None:
        process.tell(text, process.ERROR if prefix is None else prefix)

    return (lambda _text: None) if quiet else say


def _progress(world: KernelWorld, quiet: bool) -> Progress | None:
    """The progress of a mission; None for the usual one."""
    from deploy.run.mission import bound_of
    from deploy.run.progress import NoProgress

    return NoProgress(world.config, world.law.cells.size, bound_of(world)) if quiet else None


def _fly(
    world: KernelWorld,
    out: Path | None,
    name: str,
    *,
    lockstep: bool,
    quiet: bool,
    learns: bool,
    command: str,
    policy: bytes | None = None,
    flies: str = "",
) -> Run:
    """Fly a mission that was checked, in a new run folder, to its end."""
    from deploy.run import mission, plan

    if not lockstep:
        plan.check_machine(world.config, learns=learns, out=out)
    folder = mission.new_folder(out, name)
    flight = mission.Mission(world, folder, command, policy, _progress(world, quiet), flies)
    flight.fly(in_one_process=lockstep)
    return Run(folder)
