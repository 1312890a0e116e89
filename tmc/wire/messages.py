"""Every message of the protocol, and nothing else. Messages are frozen, typed, and valid by construction.

`docs/reference/protocol.md` describes them. Senders and receivers: UAV -> TMC: Hello, Record, Alive, PolicyRequest,
Bye. TMC -> UAV: Welcome, Begin, Map, Lost, Policy, End, Error. Learner -> TMC: Hello, SampleRequest, PolicyPush, Bye.
TMC -> learner: Welcome, Minibatch, Ack, End, Error. Any client -> TMC: StatusRequest, answered by Status.
UAV -> UAV, forwarded by the TMC where the two share no memory: Beacon.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmc.kernel.config import MAX_SIGHTINGS
from tmc.wire import fields as f

PROTOCOL = 2
"""Version of the protocol. Frames of any other version are refused."""

Array = NDArray[Any]


@dataclass(frozen=True)
class Message:
    """Base of all messages; checks every field against its rule."""

    def __post_init__(self) -> None:
        f.check(self)


@dataclass(frozen=True)
class Hello(Message):
    """A client introduces itself. `uav`: -1 for the learner. `incarnation`: new each time that a process starts."""

    role: str = f.choice("uav", "learner")
    uav: int = f.integer(-1, 65_535)
    incarnation: int = f.integer(0, 2**63 - 1)
    updates: int = f.integer(0, 2**62, default=0)


@dataclass(frozen=True)
class Welcome(Message):
    """The TMC's mission: all settings, the map's fingerprint, the run, and the newest policy version.

    `tracks`: path of the table that the UAVs on the TMC's machine share; empty where they use beacons.
    `sequence`: of the next record that the TMC expects of the UAV. The UAV resends its records from there on.
    """

    config: str = f.text(65_536)
    map: str = f.text(64)
    run: str = f.text(64)
    tracks: str = f.text(4096)
    policy: int = f.integer(0, 2**62)
    sequence: int = f.integer(0, 2**62, default=0)


@dataclass(frozen=True)
class Begin(Message):
    """Start of a flight: a new episode (`shipped` = -1, tick 0), or the resumed flight of a process that ended.

    `track` (u16): the UAV's own cells at ticks 0..`tick`. `last_visit` (u16 ticks, one per monitored cell): its own map
    at `tick`. `lost`: the UAVs that are lost in this episode.
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

    `cells`: one entry per tick.
    `actions`, `blocks` (why a move was blocked, 0: not blocked), `rewards` (by the UAV's own map): one entry per move,
    so one less than `cells` when the record starts at tick 0.
    `seen_tick`, `seen_cell`: one entry per sighting of a peer.
    `version`, `policy`: of the map and the policy with which the UAV flew.
    `values`: two entries per move, Q(o_t, a_t) and max_a Q(o_t, a) over the allowed actions; empty unless a policy
    flies and `replay.priority_exponent` is not 0.
    `sent`: wall clock of the UAV when it made the record, ns since 1970, for the log; 0 without a clock.
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

    `acknowledged`: the UAV's records below this number are durable in the journal, so it may drop them. `last_visit`
    (u16 ticks, one per monitored cell) in scenario II; `active` (u16 cells with an event) in scenario I.
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
    """UAV `uav` flies at `tick`. `sequence`: of its next record. `peer`: the UAV for which it waits, -1 for none."""

    uav: int = f.integer(0, 65_535)
    incarnation: int = f.integer(0, 2**63 - 1)
    tick: int = f.integer(0, 65_535)
    peer: int = f.integer(-1, 65_535)
    sequence: int = f.integer(0, 2**62)


@dataclass(frozen=True)
class Lost(Message):
    """UAV `uav` is lost in this episode. `tick`: end of its last record, -1 without one. Peers stop waiting for it."""

    episode: int = f.integer(1, 2**31 - 1)
    uav: int = f.integer(0, 65_535)
    tick: int = f.integer(-1, 65_535)


@dataclass(frozen=True)
class PolicyRequest(Message):
    """A UAV asks for the policy with this version."""

    version: int = f.integer(0, 2**62)


@dataclass(frozen=True)
class Policy(Message):
    """A policy file: `model` is an ONNX model that carries its own description."""

    version: int = f.integer(0, 2**62)
    model: bytes = f.blob(64 * 1024 * 1024)


@dataclass(frozen=True)
class SampleRequest(Message):
    """The learner asks for a minibatch. `request` is repeated in the answer.

    `index`, `errors`: numbers and TD errors |Q - y| of the transitions that the learner has just used, which become
    their priorities; empty before the first minibatch, and where `replay.priority_exponent` is 0.
    `incarnation`: of the learner's process, as in `Hello`; 0 where there is only one.
    """

    request: int = f.integer(0, 2**62)
    index: Array = f.array("<i8", 65_536, empty=True)
    errors: Array = f.array("<f4", 65_536, empty=True)
    incarnation: int = f.integer(0, 2**63 - 1, default=0)


@dataclass(frozen=True)
class Minibatch(Message):
    """`b` transitions (o_t, a_t, o_{t+n}, r), with the content of their observations.

    `cells` (2b,), `peers` (2b, P), `u` (2b, R): the fields of `tmc.kernel.observation.Views`, first those of o_t, then
    those of o_{t+n}. `reward`: the n-step sum, unscaled. `discount`: gamma^n. `allowed`: (b, 9), 0 for the actions that
    a UAV in o_{t+n} would not choose. `episodes`: number of those that were finished at its tick. `index`: numbers of
    the transitions, unique until the TMC's next `Welcome`. `weight`: of each transition in the loss; empty for equal
    weights, where `replay.priority_exponent` is 0.
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
    """The learner's policy after `updates` updates. A version that is not newer is refused.

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
    """The TMC has accepted the policy with this version."""

    version: int = f.integer(0, 2**62)


@dataclass(frozen=True)
class Beacon(Message):
    """UAV `uav` was on `cells` at `tick` and the ticks after it. The TMC forwards it to the UAVs in `to`.

    `ask` >= 0: a request for the receivers' own tracks from tick `ask` on; `cells` may be empty then.
    """

    uav: int = f.integer(0, 65_535)
    episode: int = f.integer(1, 2**31 - 1)
    tick: int = f.integer(0, 65_535)
    cells: Array = f.array("<u2", 65_535)
    to: Array = f.array("<u2", 65_535)
    ask: int = f.integer(-1, 65_535, default=-1)


@dataclass(frozen=True)
class StatusRequest(Message):
    """A client asks for the progress of the mission."""


@dataclass(frozen=True)
class Status(Message):
    """Progress of the mission. `phase`: gathering, flying, learning (the learner finishes its updates) or done."""

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
    """The mission is over: clients leave. `acknowledged`: as in `Map`."""

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
    """A frame was refused, and changed nothing. `text`: the cause and the fix.

    `incarnation`: of the process that sent the frame, where the frame had one; a later one may have the same name.
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
