"""Every message of the protocol, and nothing else. Frozen, typed, and valid by construction: one that exists is intact.

`docs/reference/protocol.md` is the text to this table. UAV -> TMC: Hello, Record, Alive, PolicyRequest, Bye. TMC ->
UAV: Welcome, Begin, Map, Lost, Policy, End, Error. Learner -> TMC: Hello, SampleRequest, PolicyPush, Bye. TMC ->
learner: Welcome, Minibatch, Ack, End, Error. Anyone -> TMC: StatusRequest, answered by Status. UAV -> UAV, passed on by
the TMC where the two share no memory: Beacon.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmc.kernel.config import MAX_SIGHTINGS
from tmc.wire import fields as f

PROTOCOL = 2
"""Version of the protocol: a frame of any other version is refused."""

Array = NDArray[Any]


@dataclass(frozen=True)
class Message:
    """Base of all messages; checks every field against its rule."""

    def __post_init__(self) -> None:
        f.check(self)


@dataclass(frozen=True)
class Hello(Message):
    """First word of a client. `uav` is -1 unless the role is "uav"; `incarnation` is new each time a process starts."""

    role: str = f.choice("uav", "learner")
    uav: int = f.integer(-1, 65_535)
    incarnation: int = f.integer(0, 2**63 - 1)
    updates: int = f.integer(0, 2**62, default=0)


@dataclass(frozen=True)
class Welcome(Message):
    """The mission that the TMC runs: all settings, the map's fingerprint, the run, the newest policy it has.

    `tracks`: the table that the UAVs on the TMC's machine share; empty where they tell each other by beacon.
    `sequence`: of the UAV's next record, as the TMC has it: what it has sent from there on, it sends again.
    """

    config: str = f.text(65_536)
    map: str = f.text(64)
    run: str = f.text(64)
    tracks: str = f.text(4096)
    policy: int = f.integer(0, 2**62)
    sequence: int = f.integer(0, 2**62, default=0)


@dataclass(frozen=True)
class Begin(Message):
    """Fly from here: a new episode (`shipped` = -1, tick 0), or the flight of a lost process taken up again.

    `track` (u16) is the UAV's own flight so far, a cell for each of the ticks 0..`tick`; `last_visit` (u16, one a
    monitored cell) is what it knew of the map at `tick`; `lost`: the UAVs that the team goes on without.
    """

    episode: int = f.integer(1, 2**31 - 1)
    tick: int = f.integer(0, 65_535)
    shipped: int = f.integer(-1, 65_535)
    sequence: int = f.integer(0, 2**62)
    version: int = f.integer(0, 2**62)
    policy: int = f.integer(0, 2**62)
    last_visit: Array = f.array("<u2", 65_535)
    track: Array = f.array("<u2", 65_535)
    lost: Array = f.array("<u2", 65_535)


@dataclass(frozen=True)
class Record(Message):
    """A flight record: what UAV `uav` did in ticks `first`..`tick` of an episode.

    `cells` has one entry a tick. `actions`, `blocks` (why a move was blocked, 0: it was not) and `rewards` (as the UAV
    reckons them by its own map) have one entry a move, so one less than `cells` when the record starts at tick 0.
    `seen_tick`, `seen_cell`: peers sensed, one entry a sighting. `version`: the map that the UAV flew by. `values`:
    where a policy flies and `replay.priority_exponent` is not 0, two entries a move, Q(o_t, a_t) and max_a Q(o_t, a)
    over the actions that the UAV may choose; else empty. `sent`: the wall clock of the UAV when it made the record, ns
    since 1970, for the log; 0 where there is no clock.
    """

    uav: int = f.integer(0, 65_535)
    incarnation: int = f.integer(0, 2**63 - 1)
    sequence: int = f.integer(0, 2**62)
    episode: int = f.integer(1, 2**31 - 1)
    first: int = f.integer(0, 65_535)
    tick: int = f.integer(0, 65_535)
    version: int = f.integer(0, 2**62)
    policy: int = f.integer(0, 2**62)
    cells: Array = f.array("<u2", 65_535)
    actions: Array = f.array("u1", 65_535)
    blocks: Array = f.array("u1", 65_535)
    rewards: Array = f.array("<f4", 65_535)
    seen_tick: Array = f.array("<u2", MAX_SIGHTINGS)
    seen_cell: Array = f.array("<u2", MAX_SIGHTINGS)
    values: Array = f.array("<f4", 131_070, empty=True)
    sent: int = f.integer(0, 2**63 - 1, default=0)


@dataclass(frozen=True)
class Map(Message):
    """The TMC's answer to record `sequence`: the global map with every visit due by `tick`.

    `acknowledged`: the UAV's records below this number are in the journal for good; it may forget them. `last_visit`
    (u16 ticks, one a monitored cell) in scenario II; `active` (u16 cells with an event) in scenario I.
    """

    episode: int = f.integer(1, 2**31 - 1)
    tick: int = f.integer(0, 65_535)
    version: int = f.integer(0, 2**62)
    policy: int = f.integer(0, 2**62)
    sequence: int = f.integer(0, 2**62)
    acknowledged: int = f.integer(0, 2**62)
    last_visit: Array = f.array("<u2", 65_535)
    active: Array = f.array("<u2", 65_535)


@dataclass(frozen=True)
class Alive(Message):
    """UAV `uav` is under way at `tick`, record `sequence` will be its next; it waits for the position of UAV `peer`, or
    for none (-1)."""

    uav: int = f.integer(0, 65_535)
    incarnation: int = f.integer(0, 2**63 - 1)
    tick: int = f.integer(0, 65_535)
    peer: int = f.integer(-1, 65_535)
    sequence: int = f.integer(0, 2**62)


@dataclass(frozen=True)
class Lost(Message):
    """UAV `uav` is lost in this episode: its last record ends at `tick` (-1: it has none). Wait for it no more."""

    episode: int = f.integer(1, 2**31 - 1)
    uav: int = f.integer(0, 65_535)
    tick: int = f.integer(-1, 65_535)


@dataclass(frozen=True)
class PolicyRequest(Message):
    """Send me the policy with this version."""

    version: int = f.integer(0, 2**62)


@dataclass(frozen=True)
class Policy(Message):
    """A policy file: `model` is an ONNX model that carries its own description."""

    version: int = f.integer(0, 2**62)
    model: bytes = f.blob(64 * 1024 * 1024)


@dataclass(frozen=True)
class SampleRequest(Message):
    """One minibatch, please. `request` comes back in the answer.

    `index`, `errors`: the transitions of a minibatch that was just learned from, by number, and |Q - y| of each, which
    is their priority from now on; both empty before the first one and where `replay.priority_exponent` is 0.
    `incarnation`: of the learner's process, as in `Hello`; 0 where there is only one.
    """

    request: int = f.integer(0, 2**62)
    index: Array = f.array("<i8", 65_536, empty=True)
    errors: Array = f.array("<f4", 65_536, empty=True)
    incarnation: int = f.integer(0, 2**63 - 1, default=0)


@dataclass(frozen=True)
class Minibatch(Message):
    """`b` transitions (o_t, a_t, o_{t+n}, r), with what their observations are drawn from.

    `cells` (2b,), `peers` (2b, P), `u` (2b, R): the fields of `tmc.kernel.observation.Views`, first those of o_t, then
    those of o_{t+n}. `reward`: the n-step sum, unscaled. `discount`: gamma^n. `allowed`: (b, 9), 0 for the actions that
    a UAV in o_{t+n} would not choose. `episodes`: finished by its tick. `index`: a number of each transition, which no
    other has before the TMC's next `Welcome`. `weight`: of each transition in the loss; empty where all count alike,
    that is where `replay.priority_exponent` is 0.
    """

    request: int = f.integer(0, 2**62)
    episodes: int = f.integer(0, 2**31 - 1)
    ticks: int = f.integer(0, 2**62)
    cells: Array = f.tensor("<u2", 1)
    peers: Array = f.tensor("<u2", 2)
    u: Array = f.tensor("<f4", 2)
    action: Array = f.tensor("u1", 1)
    reward: Array = f.tensor("<f4", 1)
    discount: Array = f.tensor("<f4", 1)
    allowed: Array = f.tensor("u1", 2)
    index: Array = f.tensor("<i8", 1)
    weight: Array = f.tensor("<f4", 1, empty=True)


@dataclass(frozen=True)
class PolicyPush(Message):
    """The learner's policy after `updates` updates; a version that is not newer is refused.

    `sent`: as in `Record`; `incarnation`: as in `SampleRequest`.
    """

    version: int = f.integer(1, 2**62)
    updates: int = f.integer(0, 2**62)
    loss: float = f.real(-1e30, 1e30)
    model: bytes = f.blob(64 * 1024 * 1024)
    sent: int = f.integer(0, 2**63 - 1, default=0)
    incarnation: int = f.integer(0, 2**63 - 1, default=0)


@dataclass(frozen=True)
class Ack(Message):
    """The TMC has it."""

    version: int = f.integer(0, 2**62)


@dataclass(frozen=True)
class Beacon(Message):
    """UAV `uav` stood on `cells` at `tick` and the ticks after it; the TMC passes it on to the UAVs in `to`.

    `ask` >= 0: and please tell me your own track from tick `ask` on. `cells` may be empty then.
    """

    uav: int = f.integer(0, 65_535)
    episode: int = f.integer(1, 2**31 - 1)
    tick: int = f.integer(0, 65_535)
    cells: Array = f.array("<u2", 65_535)
    to: Array = f.array("<u2", 65_535)
    ask: int = f.integer(-1, 65_535, default=-1)


@dataclass(frozen=True)
class StatusRequest(Message):
    """How far is the mission?"""


@dataclass(frozen=True)
class Status(Message):
    """Progress of the mission. `phase`: gathering, flying, learning (the learner catches up) or done."""

    phase: str = f.choice("gathering", "flying", "learning", "done")
    episode: int = f.integer(0, 2**31 - 1)
    tick: int = f.integer(0, 65_535)
    ticks: int = f.integer(0, 2**62)
    updates: int = f.integer(0, 2**62)
    policy: int = f.integer(0, 2**62)
    loss: float = f.real(-1e30, 1e30)
    uncertainty: float = f.real(0.0, 1e9)
    episode_uncertainty: float = f.real(0.0, 1e9)
    blocked: int = f.integer(0, 2**62)
    rejected: int = f.integer(0, 2**62)
    waiting: str = f.text(1024)


@dataclass(frozen=True)
class End(Message):
    """The mission is over; leave. `acknowledged`: as in `Map`."""

    reason: str = f.text(1024)
    acknowledged: int = f.integer(0, 2**62, default=0)


@dataclass(frozen=True)
class Bye(Message):
    """A client leaves in order."""

    role: str = f.choice("uav", "learner")
    uav: int = f.integer(-1, 65_535)
    reason: str = f.text(1024)


@dataclass(frozen=True)
class Error(Message):
    """What was wrong with your frame, and the mend. Nothing was changed by it.

    `incarnation`: of the process that sent the frame, where it told: another one may have its name by now.
    """

    code: str = f.choice("malformed", "version", "unknown", "range", "state", "fenced", "refused")
    text: str = f.text(1024)
    incarnation: int = f.integer(0, 2**63 - 1, default=0)


MESSAGES: tuple[type[Message], ...] = (
    Hello, Welcome, Begin, Record, Map, Alive, Lost, PolicyRequest, Policy, SampleRequest, Minibatch, PolicyPush, Ack,
    Beacon, StatusRequest, Status, End, Bye, Error,
)  # fmt: skip

EMPTY: NDArray[np.uint16] = np.zeros(0, "<u2")

__all__ = [m.__name__ for m in MESSAGES] + ["EMPTY", "MESSAGES", "PROTOCOL", "Array", "Message"]
