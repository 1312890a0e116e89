"""Draw the figures of a run as PNG in RUN/report/: map, paths, and curves of training or of uncertainty by tick."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from tmc.analysis import palette
from tmc.analysis.report import style
from tmc.analysis.report.map_figures import map_picture, paths_picture
from tmc.analysis.run_data import Episode, Learning, RunData
from tmc.analysis.summary import Mission, Summary
from tmc.record.run_folder import RunFolder

__all__ = ["curves_picture", "map_picture", "paths_picture", "pictures", "uncertainty_picture"]

MAX_CURVE_POINTS = 2000
"""Curves by update are thinned to about this many points: more cannot be seen."""


def pictures(
    run: RunData, summary: Summary, episode: int | None = None, baselines: Mapping[str, float] | None = None
) -> dict[Path, Callable[[], Path]]:
    """Return {path: function that draws it} of the pictures of a run.

    `episode`: the one whose paths and ticks are drawn; by default the last complete one. `baselines`: dashed lines by
    name, mean uncertainty per road cell.
    """
    folder = RunFolder(run.folder).report
    shown = run.episode(summary.last.episode if episode is None else episode)
    starts = shown.cells[0][shown.cells[0] >= 0].tolist()
    found: dict[str, Callable[[Path], Path]] = {
        "map.png": lambda path: map_picture(run.world.map, path, starts),
        "paths.png": lambda path: paths_picture(run.world, shown, path),
    }
    if summary.mission.learning:
        found["curves.png"] = lambda path: curves_picture(run, summary, path, baselines or {})
    else:
        found["uncertainty.png"] = lambda path: uncertainty_picture(run, summary, shown, path)
    return {folder / name: partial(picture, folder / name) for name, picture in found.items()}


@style.own_settings()
def curves_picture(run: RunData, summary: Summary, path: Path, baselines: Mapping[str, float]) -> Path:
    """Draw uncertainty, reward and blocked moves by episode, and learning by update; return `path`."""
    made = style.figure(11, 7.5)
    ((top, reward), (blocked, learning)) = made.subplots(2, 2)
    _uncertainty_curve(top, summary, baselines)
    _reward_curve(reward, summary)
    _blocked_curve(blocked, summary)
    _learning_curve(learning, run.learning)
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
    _curve(axes, *_by_episode(summary, "per_cell"), palette.BLUE, "the team")
    if summary.lower_bound_per_cell is not None:
        axes.axhline(summary.lower_bound_per_cell, color=palette.BLACK, linewidth=1.2, label="lower bound")
    for (name, value), colour in zip(baselines.items(), _repeat(palette.UAV_COLOURS), strict=False):
        axes.axhline(value, color=colour, linewidth=1.4, linestyle="--", label=style.name(name))
    axes.set_ylim(bottom=0)
    what = "share of cells with an active event" if summary.mission.scenario == 1 else "mean uncertainty"
    axes.set(title="Uncertainty, eq. (6): lower is better", ylabel=f"{what} per road cell")
    axes.legend(frameon=False, fontsize=8)


def _repeat(colours: tuple[str, ...]) -> tuple[str, ...]:
    return colours * 8


def _reward_curve(axes: Any, summary: Summary) -> None:
    _curve(axes, *_by_episode(summary, "reward"), palette.GREEN)
    axes.set(title="Reward, with exploration", ylabel="mean reward per UAV per tick")


def _blocked_curve(axes: Any, summary: Summary) -> None:
    causes = (
        ("another UAV", "blocked_uav", palette.VERMILION),
        ("obstacle or no-fly", "blocked_obstacle", palette.PURPLE),
        ("edge of the grid", "blocked_grid", palette.ORANGE),
    )
    _, moves = _by_episode(summary, "moves")
    for label, name, colour in causes:
        x, count = _by_episode(summary, name)
        _curve(axes, x, 100 * np.array(count) / np.maximum(moves, 1), colour, label)
    axes.set_ylim(bottom=0)
    axes.set(title="Blocked moves by cause, with exploration", ylabel="share of moves (%)")
    axes.legend(frameon=False, fontsize=8)


def _learning_curve(axes: Any, learning: Learning) -> None:
    """Draw the loss on the left axis, logarithmic, and Q values on the right axis."""
    x = _thin(learning.updates)
    axes.set(title="Learning", xlabel="updates of the network", ylabel="minibatch loss")
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    style.plain(axes)
    if not x.size:
        axes.text(0.5, 0.5, "no updates in the logs", transform=axes.transAxes, ha="center", color=style.GREY)
        return
    lines = axes.plot(x, _thin(learning.loss), color=palette.BLUE, linewidth=0.7, label="loss (left)")
    if (learning.loss > 0).any():
        _log_scale(axes)
    over = axes
    if np.isfinite(learning.q_mean).any():
        over = right = axes.twinx()
        right.spines["top"].set_visible(False)
        right.set_ylabel("Q value (rewards as scaled)")
        lines += right.plot(x, _thin(learning.q_mean), color=palette.ORANGE, linewidth=1.2, label="mean Q (right)")
        target = _thin(learning.target_mean)
        lines += right.plot(x, target, color=palette.BLACK, linewidth=0.8, linestyle=":", label="mean target (right)")
    over.legend(handles=lines, frameon=False, fontsize=8)  # placed where it hides no line of these axes


def _log_scale(axes: Any) -> None:
    """Set a logarithmic axis with plain numbers; below two decades, number the ticks between them too."""
    axes.set_yscale("log")
    low, high = np.log10(axes.get_ylim())
    decades = np.floor(high) - np.ceil(low) + 1
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(StrMethodFormatter("{x:g}") if decades < 2 else NullFormatter())


def _thin(values: NDArray[Any]) -> NDArray[Any]:
    return values[:: max(1, values.size // MAX_CURVE_POINTS)]


@style.own_settings()
def uncertainty_picture(run: RunData, summary: Summary, shown: Episode, path: Path) -> Path:
    """Draw the uncertainty of one episode by tick, with its mean and the bound, others in grey; return `path`."""
    made = style.figure(9, 4.8)
    axes, m = made.add_subplot(), summary.mission
    style.plain(axes)
    others = [e for e in run.episodes if e.number != shown.number]
    for i, episode in enumerate(others):
        label = "other episodes" if i == 0 else None
        axes.plot(episode.uncertainty, color="#BBBBBB", linewidth=0.7, label=label)
    axes.plot(shown.uncertainty, color=palette.BLUE, linewidth=1.3, label=f"episode {shown.number}")
    mean = next(facts.uncertainty for facts in summary.episodes if facts.episode == shown.number)
    axes.axhline(mean, color=palette.ORANGE, linestyle="--", linewidth=1.5, label=f"its mean, eq. (6): {mean:.1f}")
    if summary.lower_bound is not None:
        label = f"lower bound of the mean: {summary.lower_bound:.1f}"
        axes.axhline(summary.lower_bound, color=palette.BLACK, linewidth=1.2, label=label)
    axes.set(xlim=(0, m.ticks), xlabel="tick (60 s each)")
    axes.set_ylim(bottom=0)
    axes.set_ylabel("active events" if m.scenario == 1 else f"uncertainty, summed over {m.monitored_cells:,} cells")
    what = "Active events" if m.scenario == 1 else "Uncertainty"
    axes.set_title(f"{what} by tick: {style.name(m.controller)}, {m.uavs} UAVs, scenario {m.scenario}, {_period(m)}")
    axes.legend(loc="lower right", frameon=False, fontsize=9)
    return style.save(made, path)
