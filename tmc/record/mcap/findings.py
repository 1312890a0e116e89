"""What is found in a damaged file: messages, what is lost, and what is said of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

from mcap.records import Attachment, Channel, Metadata, Schema

CUT = "it is cut"
"""Why the end of a file is lost that a kill left behind."""


@dataclass(frozen=True, slots=True)
class Message:
    """A message as it stands in the file, with the channel and the schema that describe it."""

    channel: Channel
    schema: Schema | None
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


@dataclass(frozen=True)
class Lost:
    """A stretch of the file that nothing intact was found in: where, how long, and why."""

    at: int
    bytes: int
    why: str

    def __str__(self) -> str:
        return f"{self.bytes:,} bytes from byte {self.at:,} ({self.why})"


@dataclass
class Findings:
    """What came of reading a file to its end.

    `finished`: it was closed in order. `missing`: messages that are missing, as the numbers of others tell; `nameless`:
    intact ones whose topic nothing intact tells. `notes`: what is wrong without anything being lost.
    """

    profile: str = ""
    finished: bool = False
    messages: int = 0
    missing: int = 0
    nameless: int = 0
    lost: list[Lost] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def whole(self) -> bool:
        """Nothing is lost."""
        return not (self.lost or self.missing or self.nameless)


Item: TypeAlias = list[Message] | Metadata | Attachment

Show = Callable[[str, float], None]
"""Is told what is done, and how much of it: 0 to 1."""


def unseen(_what: str, _share: float) -> None:
    """Shows nothing."""
