"""Journal entries: what the station wants logged, as the fields of the log's schemas (docs/log-format.md)."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from tmc.center.episode import Exchange, Flight, Truth
from tmc.center.replay import Replay
from tmc.kernel.reward import Block
from tmc.record.channels import uav_topic
from tmc.wire.messages import Record


@dataclass(frozen=True)
class Entry:
    """A journal entry: the topic, and the fields of its schema. `sent`: the wall clock of whoever sent it, in ns; 0
    where that is the TMC."""

    topic: str
    values: dict[str, Any]
    sent: int = 0


def flight_record(record: Record) -> Entry:
    """A record that was accepted."""
    return Entry(uav_topic(record.uav, "record"), {"record": record}, record.sent)


def exchange(flight: Flight, done: Exchange, policy: int) -> list[Entry]:
    """An exchange: who was answered, and in scenario II the map that they got, over all K cells."""
    values = {
        "episode": flight.episode, "tick": done.tick, "version": done.version, "policy": policy,
        "uavs": done.uavs, "believed": done.believed,
    }  # fmt: skip
    sync = Entry("/tmc/sync", values)
    if flight.scenario == 1:
        return [sync]
    whole = np.zeros(flight.world.grid.size, np.uint32)
    whole[flight.world.law.cells] = done.last_visit
    return [sync, Entry("/tmc/last_visit", {"last_visit": whole})]


def truth(flight: Flight, fresh: Truth, steps: int, updates: int, policy: int) -> list[Entry]:
    """What became final: uncertainty and mean reward by tick, and in scenario I the new events."""
    values = {
        "episode": flight.episode, "first": fresh.first, "steps": steps, "updates": updates, "policy": policy,
        "uncertainty": fresh.uncertainty, "reward": fresh.reward,
    }  # fmt: skip
    entries = [Entry("/tmc/metrics", values)]
    if fresh.events:
        ticks, cells = zip(*fresh.events, strict=True)
        values = {"episode": flight.episode, "ticks": list(ticks), "cells": list(cells)}
        entries.append(Entry("/tmc/events", values))
    return entries


def lost(flight: Flight, uav: int) -> Entry:
    """A UAV that the team goes on without."""
    return Entry("/tmc/lost", {"episode": flight.episode, "uav": uav, "tick": flight.lost[uav]})


def state(flight: Flight, replay: Replay) -> Entry:
    """What the TMC holds at the end of an episode: digests that whoever plays the journal must get as well."""
    values = {"episode": flight.episode, "map": flight.digest(), "replay": replay.digest(), "transitions": len(replay)}
    return Entry("/tmc/state", values)


def episode(flight: Flight, phase: str, epsilon: float, steps: int, updates: int) -> Entry:
    """The begin of an episode with its starts, or its end with its sums."""
    mean = flight.total_uncertainty / flight.T
    return Entry("/tmc/episode", {
        "episode": flight.episode, "phase": phase, "starts": flight.starts, "ticks": max(flight.done, 0),
        "uncertainty": mean, "uncertainty_per_cell": mean / flight.world.law.cells.size,
        "reward": [*flight.total_reward], "blocked_grid": flight.blocked[Block.GRID],
        "blocked_obstacle": flight.blocked[Block.OBSTACLE], "blocked_uav": flight.blocked[Block.UAV],
        "epsilon": epsilon, "updates": updates, "steps": steps,
    })  # fmt: skip


def policy(version: int, updates: int, loss: float, model: bytes, sent: int, *, last: bool) -> Entry:
    """A policy that was accepted; only the mission's last one with its model, since thousands of them may come."""
    digest = hashlib.sha256(model).hexdigest()
    values = {"version": version, "updates": updates, "sha256": digest, "loss": loss, "model": model if last else b""}
    return Entry("/learner/policy", values, sent)
