"""The pictures of a run, each a PNG in RUN/report/: map, paths, and curves of training or uncertainty by tick."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from tmc.analysis.report import style
from tmc.analysis.report.map_figures import map_picture, paths_picture
from tmc.analysis.run_data import Episode, Learning, RunData
from tmc.analysis.summary import Mission, Summary

__all__ = ["curves_picture", "map_picture", "paths_picture", "pictures", "uncertainty_picture"]

POINTS = 2000
"""Points that a curve by updates is thinned to: more cannot be seen."""


def pictures(
    flown: RunData, summary: Summary, episode: int | None = None, baselines: Mapping[str, float] | None = None
) -> dict[Path, Callable[[], Path]]:
    """The pictures of a run: each one's path, and what makes it.

    `episode` for paths and ticks, by default the last one that is complete. `baselines`: dashed lines by name,
    uncertainty a road cell.
    """
    folder = flown.folder / "report"
    shown = flown.episode(summary.last.episode if episode is None else episode)
    starts = shown.cells[0][shown.cells[0] >= 0].tolist()
    found: dict[str, Callable[[Path], Path]] = {
        "map.png": lambda path: map_picture(flown.world.map, path, starts),
        "paths.png": lambda path: paths_picture(flown.world, shown, path),
    }
    if summary.mission.learning:
        found["curves.png"] = lambda path: curves_picture(flown, summary, path, baselines or {})
    else:
        found["uncertainty.png"] = lambda path: uncertainty_picture(flown, summary, shown, path)
    return {folder / name: partial(picture, folder / name) for name, picture in found.items()}


@style.own_settings()
def curves_picture(flown: RunData, summary: Summary, path: Path, baselines: Mapping[str, float]) -> Path:
    """Four curves of training: three by episode, one by updates."""
    made = style.figure(11, 7.5)
    ((top, reward), (blocked, learning)) = made.subplots(2, 2)
    _uncertainty_curve(top, summary, baselines)
    _reward_curve(reward, summary)
    _blocked_curve(blocked, summary)
    _learning_curve(learning, flown.learning)
    for axes in (top, reward, blocked):
        axes.set_xlabel(f"episode (of {summary.mission.ticks:,} ticks)")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    m = summary.mission
    made.suptitle(
        f"Training of {m.uavs} UAVs on {style.name(m.map)}, scenario {m.scenario}, {_period(m)}, seed {m.seed}"
    )
    return style.save(made, path)


def _period(m: Mission) -> str:
    return f"T_u = {m.T_u} tick" + ("" if m.T_u == 1 else "s")


def _by_episode(summary: Summary, name: str) -> tuple[list[int], list[float]]:
    facts = [f for f in summary.episodes if f.complete] or list(summary.episodes)
    return [f.episode for f in facts], [float(getattr(f, name)) for f in facts]


def _curve(axes: Any, x: Any, y: Any, colour: str, label: str = "") -> None:
    style.plain(axes)
    axes.plot(x, y, color=colour, linewidth=1.6, marker="o" if len(x) <= 50 else "", markersize=4, label=label)


def _uncertainty_curve(axes: Any, summary: Summary, baselines: Mapping[str, float]) -> None:
    _curve(axes, *_by_episode(summary, "per_cell"), style.BLUE, "the team")
    if summary.lower_bound_per_cell is not None:
        axes.axhline(summary.lower_bound_per_cell, color=style.BLACK, linewidth=1.2, label="lower bound")
    for (name, value), colour in zip(baselines.items(), _repeat(style.UAV_COLOURS), strict=False):
        axes.axhline(value, color=colour, linewidth=1.4, linestyle="--", label=style.name(name))
    axes.set_ylim(bottom=0)
    what = "share of cells with an active event" if summary.mission.scenario == 1 else "mean uncertainty"
    axes.set(title="Uncertainty, eq. (6): lower is better", ylabel=f"{what} a road cell")
    axes.legend(frameon=False, fontsize=8)


def _repeat(colours: tuple[str, ...]) -> tuple[str, ...]:
    return colours * 8


def _reward_curve(axes: Any, summary: Summary) -> None:
    _curve(axes, *_by_episode(summary, "reward"), style.GREEN)
    axes.set(title="Reward, with exploration", ylabel="reward a UAV a tick")


def _blocked_curve(axes: Any, summary: Summary) -> None:
    causes = (("another UAV", "blocked_uav", style.VERMILION), ("obstacle or no-fly", "blocked_obstacle", style.PURPLE),
              ("edge of the grid", "blocked_grid", style.ORANGE))  # fmt: skip
    _, moves = _by_episode(summary, "moves")
    for label, name, colour in causes:
        x, count = _by_episode(summary, name)
        _curve(axes, x, 100 * np.array(count) / np.maximum(moves, 1), colour, label)
    axes.set_ylim(bottom=0)
    axes.set(title="Blocked moves by cause, with exploration", ylabel="share of moves (%)")
    axes.legend(frameon=False, fontsize=8)


def _learning_curve(axes: Any, learning: Learning) -> None:
    """Loss on the left, logarithmic, and Q values on the right."""
    x = _thin(learning.updates)
    axes.set(title="Learning", xlabel="updates of the network", ylabel="loss of a minibatch")
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    style.plain(axes)
    if not x.size:
        axes.text(0.5, 0.5, "no updates in the logs", transform=axes.transAxes, ha="center", color=style.GREY)
        return
    lines = axes.plot(x, _thin(learning.loss), color=style.BLUE, linewidth=0.7, label="loss (left)")
    if (learning.loss > 0).any():
        _log_scale(axes)
    over = axes
    if np.isfinite(learning.q_mean).any():
        over = right = axes.twinx()
        right.spines["top"].set_visible(False)
        right.set_ylabel("Q value (rewards as scaled)")
        lines += right.plot(x, _thin(learning.q_mean), color=style.ORANGE, linewidth=1.2, label="mean Q (right)")
        target = _thin(learning.target_mean)
        lines += right.plot(x, target, color=style.BLACK, linewidth=0.8, linestyle=":", label="mean target (right)")
    over.legend(handles=lines, frameon=False, fontsize=8)  # it keeps clear of the lines of its own axes


def _log_scale(axes: Any) -> None:
    """A logarithmic axis with plain numbers, between the decades too where there are fewer than two of these."""
    axes.set_yscale("log")
    low, high = np.log10(axes.get_ylim())
    decades = np.floor(high) - np.ceil(low) + 1
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(StrMethodFormatter("{x:g}") if decades < 2 else NullFormatter())


def _thin(values: NDArray[Any]) -> NDArray[Any]:
    return values[:: max(1, values.size // POINTS)]


@style.own_settings()
def uncertainty_picture(flown: RunData, summary: Summary, shown: Episode, path: Path) -> Path:
    """The sum over cells by tick of one episode, other episodes in grey, with its mean and the bound."""
    made = style.figure(9, 4.8)
    axes, m = made.add_subplot(), summary.mission
    style.plain(axes)
    others = [e for e in flown.episodes if e.number != shown.number]
    for i, episode in enumerate(others):
        label = "other episodes" if i == 0 else None
        axes.plot(episode.uncertainty, color="#BBBBBB", linewidth=0.7, label=label)
    axes.plot(shown.uncertainty, color=style.BLUE, linewidth=1.3, label=f"episode {shown.number}")
    mean = next(facts.uncertainty for facts in summary.episodes if facts.episode == shown.number)
    axes.axhline(mean, color=style.ORANGE, linestyle="--", linewidth=1.5, label=f"its mean, eq. (6): {mean:.1f}")
    if summary.lower_bound is not None:
        label = f"lower bound of the mean: {summary.lower_bound:.1f}"
        axes.axhline(summary.lower_bound, color=style.BLACK, linewidth=1.2, label=label)
    axes.set(xlim=(0, m.ticks), xlabel="tick (60 s each)")
    axes.set_ylim(bottom=0)
    axes.set_ylabel("active events" if m.scenario == 1 else f"uncertainty, sum over {m.monitored_cells:,} cells")
    what = "Active events" if m.scenario == 1 else "Uncertainty"
    axes.set_title(f"{what} by tick: {style.name(m.who)}, {m.uavs} UAVs, scenario {m.scenario}, {_period(m)}")
    axes.legend(loc="lower right", frameon=False, fontsize=9)
    return style.save(made, path)
