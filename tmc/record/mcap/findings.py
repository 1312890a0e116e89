"""What a scan of a damaged file found: messages, lost spans, and notes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

from mcap.records import Attachment, Metadata

from tmc.record.mcap.parser import Message


@dataclass(frozen=True)
class LostSpan:
    """A span of the file in which nothing is intact: offset and length in bytes, and the reason."""

    at: int
    bytes: int
    why: str

    def __str__(self) -> str:
        return f"{self.bytes:,} bytes from byte {self.at:,} ({self.why})"


@dataclass
class Findings:
    """The result of reading a file to its end.

    `finished`: it was closed in order. `messages`: intact ones. `missing`: messages that are missing, by the gaps in
    the sequence numbers of the others. `nameless`: intact messages whose topic no intact record describes. `notes`:
    damage by which nothing is lost.
    """

    profile: str = ""
    finished: bool = False
    messages: int = 0
    missing: int = 0
    nameless: int = 0
    lost: list[LostSpan] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def whole(self) -> bool:
        """True when nothing is lost."""
        return not (self.lost or self.missing or self.nameless)


Item: TypeAlias = list[Message] | Metadata | Attachment

Show = Callable[[str, float], None]
"""Show progress: gets the words for the work, and the share that is done, 0 to 1."""


def unseen(_what: str, _share: float) -> None:
    """Show nothing."""
