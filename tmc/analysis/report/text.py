"""Write the summary as text: at most 24 lines of 80 columns, numbers with their units, then the paths."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path

from tmc.analysis.summary import EpisodeFacts, Summary
from tmc.kernel.text import printable

WIDTH_CHARS, HEIGHT_LINES = 80, 24
_LABEL_CHARS = 11


def text(s: Summary, reserve: int = 0, *, kept: bool = True) -> str:
    """Return the report, without a newline at its end.

    `reserve`: lines of the screen to leave for text after it. `kept`: the summary is in the run folder too.
    """
    paths = list(_paths(s, kept=kept))
    lines = [*_mission(s), "", *_uncertainty(s), "", *_facts(s)]
    notes = _notes(s, HEIGHT_LINES - len(lines) - len(paths) - reserve)
    return "\n".join(map(printable, [*lines, *notes, *paths]))


def pictures(paths: Sequence[Path]) -> str:
    """Return the line with the paths of the pictures, all of one folder."""
    return printable(f"{'Pictures':<{_LABEL_CHARS}}{paths[0].parent}/{{{','.join(sorted(p.name for p in paths))}}}")


def _row(label: str, words: str) -> str:
    """Return a label and its text, cut at the width of the screen."""
    return f"{label:<{_LABEL_CHARS}}" + textwrap.shorten(words, WIDTH_CHARS - _LABEL_CHARS, placeholder=" ...")


def _mission(s: Summary) -> Iterator[str]:
    m = s.mission
    controller = " in training" if m.learning else f", {m.controller}"
    yield _row("Team", f"{_count(m.uavs, 'UAV')}{controller}; scenario {m.scenario}, T_u = {_count(m.T_u, 'tick')}")
    yield _row("Map", f"{m.map} ({m.roads}, {m.obstacles}): {m.road_cells:,} road cells of {m.cell_m:g} m")
    yield _row(
        "Episodes", f"{m.episodes_flown:,} of {m.episodes_planned:,}, of {m.ticks:,} ticks of 60 s; seed {m.seed}"
    )


def _uncertainty(s: Summary) -> Iterator[str]:
    """Yield a table: eq. (6) of some episodes, and of the bound."""
    cell = "road cell" if s.mission.monitored_cells == s.mission.road_cells else "cell"
    what = "Active events" if s.mission.scenario == 1 else "Uncertainty"
    yield f"{what + ', mean over ticks':<34}{'per ' + cell:>14}{'all cells':>14}{'x bound':>12}"
    for label, f in _chosen(s):
        yield _table_row(label, f.per_cell, f.uncertainty, f.times_bound)
    if s.mean.episodes > 1:
        label = (
            f"mean of the last {s.mean.episodes} episodes"
            if s.mission.learning
            else f"mean of {s.mean.episodes} episodes"
        )
        yield _table_row(label, s.mean.per_cell, s.mean.uncertainty, s.mean.times_bound)
    if s.lower_bound is not None and s.lower_bound_per_cell is not None:
        yield _table_row("lower bound: no team can beat it", s.lower_bound_per_cell, s.lower_bound, 1.0)


def _chosen(s: Summary) -> list[tuple[str, EpisodeFacts]]:
    """Return first, best and last episode, each once."""
    if s.first == s.last:
        return [(f"episode {s.first.episode}", s.first)]
    rows = [("first", s.first), ("best", s.best), ("last", s.last)]
    if s.best in (s.first, s.last):
        rows = [("first, best" if s.best == s.first else "first", s.first),
                ("last, best" if s.best == s.last else "last", s.last)]  # fmt: skip
    return [(f"{name}: episode {f.episode}", f) for name, f in rows]


def _table_row(label: str, per_cell: float, total: float, times_bound: float | None) -> str:
    times = "-" if times_bound is None else f"{times_bound:.3f}"
    return f"  {label:<32}{per_cell:>14.4f}{total:>14.1f}{times:>12}"


def _facts(s: Summary) -> Iterator[str]:
    last, p, h = s.last, s.pace, s.health
    which = f"episode {last.episode}"
    earlier = "" if s.first == last else f", {s.first.reward:.3f} in episode {s.first.episode}"
    yield _row("Reward", f"{last.reward:.3f} per UAV per tick in {which}{earlier}")
    causes = f"UAVs {s.blocked_uav:,}, obstacles {s.blocked_obstacle:,}, edge {s.blocked_grid:,}"
    yield _row("Blocked", f"{s.blocked_share:.2%} of {s.moves:,} moves: {causes}")
    roads = f"{last.on_road:.1%} of ticks over road, {last.coverage:.1%} of road cells visited"
    yield _row("Roads", f"{roads} in {which}")
    if last.events_appeared is not None:
        yield _row("Events", f"{_events(last)} in {which}")
    took = f" in {_clock(p.seconds)}, {p.ticks_per_second:,.0f} per second" if p.seconds else ""
    yield _row("Pace", f"{p.ticks:,} ticks{took}")
    if s.mission.learning:
        loss = "" if p.loss is None else f"; last loss {p.loss:.3g}"
        yield _row("Learning", f"{p.updates:,} updates, {p.updates_per_second:,.0f} per second{loss}")
    yield _row("Processes", _processes(s))
    yield _row("Log", f"{_size(h.log_bytes)} in {_count(len(h.log_files), 'file')}" + ("" if h.notes else ", intact"))


def _events(f: EpisodeFacts) -> str:
    wait = "" if f.mean_wait is None else f", {f.mean_wait:.1f} ticks waited"
    return f"{f.events_appeared:,} appeared, {f.events_cleared:,} cleared{wait}"


def _processes(s: Summary) -> str:
    codes, restarts = s.health.exit_codes, s.health.restarts
    if codes == {"lockstep": 0}:
        return "one, in lock step"
    if not codes:
        return "no exit codes: one process, or still flying, or killed"
    bad = [f"{name} ended with {'no exit code' if code is None else code}" for name, code in codes.items() if code != 0]
    again = [f"{name} restarted {_count(n, 'time')}" for name, n in restarts.items()]
    return ", ".join(bad + again) or f"all {len(codes)} ended in order, none was restarted"


def _notes(s: Summary, room: int) -> list[str]:
    """Return what is wrong, on at most `room` lines; the rest of a long list is in summary.json."""
    cut = [f"episode {f.episode} breaks off at tick {f.ticks:,}" for f in s.episodes if not f.complete]
    indent = " " * _LABEL_CHARS
    first = f"{'Note':<{_LABEL_CHARS}}"
    notes = (
        textwrap.wrap(n, WIDTH_CHARS, initial_indent=first, subsequent_indent=indent) for n in (*cut, *s.health.notes)
    )
    lines = [line for note in notes for line in note]
    return lines if len(lines) <= room else [*lines[: max(room - 1, 0)], f"{indent}and more: see summary.json"]


def _paths(s: Summary, *, kept: bool) -> Iterator[str]:
    """Paths stay whole, so that they can be copied, even where they are long."""
    yield f"{'Logs':<{_LABEL_CHARS}}{s.run}/*.mcap*"
    if kept:
        yield f"{'Summary':<{_LABEL_CHARS}}{s.run}/summary.json"


def _count(n: int, thing: str) -> str:
    return f"{n:,} {thing}" + ("" if n == 1 else "s")


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if seconds < 60:
        return f"{seconds:.1f} s"
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


def _size(size: int) -> str:
    return f"{size / 1e6:,.1f} MB" if size >= 1e6 else f"{size / 1e3:,.0f} kB"
