"""The limits of the settings: the range of each number, and what does not go together."""

from __future__ import annotations

from collections.abc import Iterator
from operator import attrgetter
from typing import TYPE_CHECKING

from tmc.kernel.files import plain

if TYPE_CHECKING:
    from tmc.kernel.config import Config

SIGHTINGS = 1_000_000
"""Most sightings of a flight record; the rule of `tmc.wire.messages.Record` is made of it."""

# (key, lowest, highest): ranges that hold whatever the rest says.
RANGES: tuple[tuple[str, float, float], ...] = (
    ("scenario", 1, 2),
    ("world.alpha", 1e-9, 10.0),
    ("world.alpha_offroad", 0.0, 10.0),
    ("team.size", 1, 1000),
    ("team.sensing_range", 0.0, 1000.0),
    ("comms.period", 1, 60_000),
    ("comms.silence_warning", 0.1, 1e6),
    ("comms.lost_after", 1.0, 1e6),
    ("reward.collision", -1e6, 1e6),
    ("reward.new_cell", -1e6, 1e6),
    ("reward.weight", -1e6, 1e6),
    ("exploration.start", 0.0, 1.0),
    ("exploration.end", 0.0, 1.0),
    ("exploration.fraction", 0.0, 1.0),
    ("observation.radius", 1, 100),
    ("observation.near", 0, 100),
    ("network.kernel", 1, 64),
    ("network.stride", 1, 64),
    ("network.dense", 1, 65_536),
    ("dqn.learning_rate", 1e-12, 10.0),
    ("dqn.batch_size", 1, 65_536),
    ("dqn.gamma", 0.0, 1.0),
    ("dqn.n_step", 1, 1000),
    ("dqn.reward_scale", 1e-9, 1e9),
    ("dqn.target_episodes", 0, 1_000_000),
    ("dqn.target_updates", 0, 1_000_000_000),
    ("replay.capacity", 1, 1_000_000_000),
    ("replay.learn_start", 1, 1_000_000_000),
    ("replay.updates_per_tick", 0.0, 1000.0),
    ("replay.priority_exponent", 0.0, 1.0),
    ("replay.importance_exponent", 0.0, 1.0),
    ("replay.error_buffer", 1, 1_000_000),
    ("training.episodes", 1, 10_000_000),
    ("training.ticks", 1, 60_000),
    ("training.seed", 0, 2**63 - 1),
    ("training.publish_every", 1, 1_000_000_000),
    ("training.checkpoint_every", 1, 1_000_000_000),
    ("training.threads", 1, 1024),
    ("journal.flush_interval", 0.01, 60.0),
    ("journal.commit_interval", 0.0, 60.0),
    ("journal.chunk", 1024, 64 * 1024 * 1024),
    ("trial.stall", 0.0, 60.0),
    ("trial.stall_share", 0.0, 1.0),
    ("trial.stall_spread", 0.0, 1.0),
    ("trial.stall_uav", -1, 65_535),
)


def broken(config: Config) -> str | None:
    """What is impossible about these settings: the reason and the mend, in one sentence; None when nothing is."""
    return next(_complaints(config), None)


def _complaints(config: Config) -> Iterator[str]:
    for key, low, high in RANGES:
        value = attrgetter(key)(config)
        if not low <= value <= high:
            yield f"{key} = {plain(value, 60)} is out of range: choose {low:,.10g} to {high:,.10g}"
    near = min(config.team.size, int(2 * config.team.sensing_range + 1) ** 2) - 1
    if near * (min(config.T_u, config.training.ticks) + 1) > SIGHTINGS:
        yield f"a record could hold more than {SIGHTINGS:,} sightings: lower team.sensing_range, or comms.period"
    if not config.network.channels or any(not 1 <= c <= 4096 for c in config.network.channels):
        yield "network.channels must list 1 to 4096 filters for at least one convolution"
    if config.replay.learn_start > config.replay.capacity:
        yield "replay.learn_start is larger than replay.capacity, so learning would never start"
    if config.dqn.target_episodes == 0 and config.dqn.target_updates == 0:
        yield "dqn.target_episodes and dqn.target_updates are both 0, so the target would never follow"
    if config.observation.view == "ego" and config.observation.near > config.observation.radius:
        yield "observation.near is larger than observation.radius"
    if config.observation.view == "whole" and config.observation.near:
        yield "observation.near needs observation.view = ego"


def learning_starts(config: Config) -> int:
    """The team's clock, in ticks from the first episode's start on, by which `replay.learn_start` transitions are in.

    A transition is known n ticks later, or at the episode's end, and is in once all UAVs have reported that tick. Where
    they do so in turn, the clock may be later, since who is ahead depends on who is faster. It may lie after the
    mission's end.
    """
    ticks, team = config.training.ticks, range(config.team.size)
    whole, rest = divmod(-(-config.replay.learn_start // config.team.size) - 1, ticks)
    known = min(rest + config.dqn.n_step, ticks)
    all_in = max(config.next_due(i, known) for i in team)
    reported = (all_in if all_in == ticks else all_in - (all_in - config.phase(i)) % config.T_u for i in team)
    return whole * ticks + min(reported)


def updates(config: Config) -> int:
    """The updates that a training makes, as its settings have it; at most, where UAVs exchange in turn."""
    left = config.training.episodes * config.training.ticks - learning_starts(config)
    return max(0, int(left * config.replay.updates_per_tick))


def idle(config: Config) -> str | None:
    """Why nothing would be learned in a training with these settings: the reason and the fix; None when it would be."""
    episodes, replay = config.training.episodes, config.replay
    total = episodes * config.training.ticks
    if not replay.updates_per_tick:
        return "replay.updates_per_tick = 0, so nothing would be learned: raise it, or fly without learning"
    if not updates(config):
        made = f"the mission makes {total * config.team.size:,} transitions in {total:,} ticks"
        start = f"replay.learn_start = {replay.learn_start:,} of them would be in at tick {learning_starts(config):,}"
        mend = "lower learn_start, raise replay.updates_per_tick, or fly more episodes or ticks"
        return f"nothing would be learned: {made}, and {start}: {mend}"
    if config.dqn.target_episodes > episodes and not config.dqn.target_updates:
        above = f"dqn.target_episodes = {config.dqn.target_episodes:,} is above training.episodes = {episodes:,}"
        return f"{above}, so the target would never follow: choose {episodes:,} or less, or set dqn.target_updates"
    return None


def remarks(config: Config) -> Iterator[str]:
    """What a training with these settings will not do, though something is learned; a sentence each."""
    made, every, target = updates(config), config.training.publish_every, config.dqn.target_updates
    if every > made:
        yield (
            f"the training makes {made:,} updates and training.publish_every = {every:,}: "
            "UAVs fly the initial policy to the end, and what is learned is in policies/final.onnx alone"
        )
    if target > made and not 0 < config.dqn.target_episodes <= config.training.episodes:
        yield (
            f"the training makes {made:,} updates and dqn.target_updates = {target:,}: "
            "the target network stays as it is at the start"
        )
