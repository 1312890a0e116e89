"""The policies that the TMC holds: the newest, and older ones only while a UAV may still ask for them."""

from __future__ import annotations

from collections.abc import Iterable


class Policies:
    """Hold policy files by version; `newest` is 0 while there is none."""

    def __init__(self) -> None:
        self.newest = 0
        self._models: dict[int, bytes] = {}

    def __len__(self) -> int:
        return len(self._models)

    def held(self) -> dict[int, bytes]:
        """Return the policy files by version."""
        return dict(self._models)

    def take(self, version: int, model: bytes, named: Iterable[int]) -> None:
        """Hold a newer policy; of the others only those that were `named` to a UAV."""
        self.newest = version
        wanted = {version, *named}
        self._models = {v: p for v, p in (self._models | {version: model}).items() if v in wanted and p}

    def find(self, version: int) -> tuple[int, bytes] | None:
        """Return (version, file) of this policy, or of the newest if it was superseded since it was named; or None."""
        found = version if version in self._models else self.newest
        return (found, self._models[found]) if found in self._models else None
