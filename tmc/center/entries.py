"""Journal entries: what the station wants logged, as the fields of the log's schemas."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from tmc.center.episode import EpisodeState, Exchange, FinalTicks
from tmc.center.replay import Replay
from tmc.kernel.reward import Block
from tmc.record.channels import uav_topic
from tmc.wire.messages import Record


@dataclass(frozen=True)
class JournalEntry:
    """Hold the topic and the fields of its schema. `sent`: the sender's wall clock (ns); 0 if the TMC is the sender."""

    topic: str
    values: dict[str, Any]
    sent: int = 0


def flight_record(record: Record) -> JournalEntry:
    """Return the entry of a record that was accepted."""
    return JournalEntry(uav_topic(record.uav, "record"), {"record": record}, record.sent)


def exchange(episode: EpisodeState, done: Exchange, policy: int) -> list[JournalEntry]:
    """Return the entries of an exchange: the UAVs answered, and in scenario II the map they got, over all K cells."""
    values = {
        "episode": episode.number, "tick": done.tick, "version": done.version, "policy": policy,
        "uavs": done.uavs, "believed": done.believed,
    }  # fmt: skip
    sync = JournalEntry("/tmc/sync", values)
    if episode.scenario == 1:
        return [sync]
    whole = np.zeros(episode.world.grid.size, np.uint32)
    whole[episode.world.law.cells] = done.last_visit
    return [sync, JournalEntry("/tmc/last_visit", {"last_visit": whole})]


def final_ticks(episode: EpisodeState, fresh: FinalTicks, steps: int, updates: int, policy: int) -> list[JournalEntry]:
    """Return the entries of final ticks: uncertainty and mean reward by tick, and in scenario I the new events."""
    values = {
        "episode": episode.number, "first": fresh.first, "steps": steps, "updates": updates, "policy": policy,
        "uncertainty": fresh.uncertainty, "reward": fresh.reward,
    }  # fmt: skip
    entries = [JournalEntry("/tmc/metrics", values)]
    if fresh.events:
        ticks, cells = zip(*fresh.events, strict=True)
        values = {"episode": episode.number, "ticks": list(ticks), "cells": list(cells)}
        entries.append(JournalEntry("/tmc/events", values))
    return entries


def lost(episode: EpisodeState, uav: int) -> JournalEntry:
    """Return the entry of a UAV that the team goes on without."""
    return JournalEntry("/tmc/lost", {"episode": episode.number, "uav": uav, "tick": episode.lost[uav]})


def state(episode: EpisodeState, replay: Replay) -> JournalEntry:
    """Return the digests of the TMC's state at an episode's end; playing the journal must give the same."""
    values = {"episode": episode.number, "map": episode.digest(), "replay": replay.digest(), "transitions": len(replay)}
    return JournalEntry("/tmc/state", values)


def episode(episode: EpisodeState, phase: str, epsilon: float, steps: int, updates: int) -> JournalEntry:
    """Return the entry of an episode's begin with its starts, or of its end with its sums."""
    mean = episode.total_uncertainty / episode.T
    return JournalEntry("/tmc/episode", {
        "episode": episode.number, "phase": phase, "starts": episode.starts, "ticks": max(episode.done, 0),
        "uncertainty": mean, "uncertainty_per_cell": mean / episode.world.law.cells.size,
        "reward": [*episode.total_reward], "blocked_grid": episode.blocked[Block.GRID],
        "blocked_obstacle": episode.blocked[Block.OBSTACLE], "blocked_uav": episode.blocked[Block.UAV],
        "epsilon": epsilon, "updates": updates, "steps": steps,
    })  # fmt: skip


def policy(version: int, updates: int, loss: float, model: bytes, sent: int, *, last: bool) -> JournalEntry:
    """Return the entry of an accepted policy; only the mission's last one has its model, as there may be thousands."""
    digest = hashlib.sha256(model).hexdigest()
    values = {"version": version, "updates": updates, "sha256": digest, "loss": loss, "model": model if last else b""}
    return JournalEntry("/learner/policy", values, sent)
