"""What a training comes to, by its settings alone: when learning starts, and how many updates are made."""

from __future__ import annotations

from collections.abc import Iterator

from tmc.kernel.config import Config


def learning_starts(config: Config) -> int:
    """Return the tick, counted from the first episode's start, at which `replay.learn_start` transitions are in.

    A transition is known n ticks later, or at the episode's end, and is in once all UAVs have reported that tick. The
    result is the earliest such tick where UAVs report in turn: their order depends on their speed. It may lie after
    the mission's end.
    """
    ticks = config.training.ticks
    whole, rest = divmod(-(-config.replay.learn_start // config.team.size) - 1, ticks)
    known = min(rest + config.dqn.n_step, ticks)
    return whole * ticks + min(config.next_due(i, known) for i in range(config.team.size))


def updates(config: Config) -> int:
    """Return the number of updates that a training makes: an upper bound where UAVs exchange in turn."""
    left = config.training.episodes * config.training.ticks - learning_starts(config)
    return max(0, int(left * config.replay.updates_per_tick))


def idle(config: Config) -> str | None:
    """Return why nothing would be learned with these settings, with the fix; None when something would be."""
    episodes, replay = config.training.episodes, config.replay
    total = episodes * config.training.ticks
    if not replay.updates_per_tick:
        return "replay.updates_per_tick = 0, so nothing would be learned: raise it, or fly without learning"
    if not updates(config):
        made = f"the mission makes {total * config.team.size:,} transitions in {total:,} ticks"
        start = f"replay.learn_start = {replay.learn_start:,} of them would be in at tick {learning_starts(config):,}"
        fix = "lower learn_start, raise replay.updates_per_tick, or fly more episodes or ticks"
        return f"nothing would be learned: {made}, and {start}: {fix}"
    if config.dqn.target_episodes > episodes and not config.dqn.target_updates:
        above = f"dqn.target_episodes = {config.dqn.target_episodes:,} is above training.episodes = {episodes:,}"
        return f"{above}, so the target would never follow: choose {episodes:,} or less, or set dqn.target_updates"
    return None


def remarks(config: Config) -> Iterator[str]:
    """Yield what a training with these settings will not do, though something is learned; a sentence each."""
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
