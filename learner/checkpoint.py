"""Checkpoints: all state of a trainer in one safetensors file, written whole or not at all.

A file is written under another name, synced, and then renamed. Its metadata hold the counters, the settings and a
digest of everything. Nothing in it is ever executed, unlike in a pickle.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_safetensors
from torch import Tensor

from learner.trainer import State, Trainer, layout
from tmc.kernel import files
from tmc.kernel.config import flat
from tmc.record.disk import NEW_SUFFIX, write_atomically

FORMAT = 1
"""Version of the file's contents."""
KEEP = 3
"""Checkpoints that are kept."""
KEY, DIGEST = "overfly", "digest"
"""Entries of the file's metadata: all of `Meta` as JSON, and the SHA-256 of that and of the tensors."""
PREFIX, SUFFIX = "checkpoint-", ".safetensors"
NETWORK = (
    "network.channels",
    "network.kernel",
    "network.stride",
    "network.dense",
    "observation.view",
    "observation.near",
)
"""Settings that must be equal in a checkpoint and a mission; the shape of the observation is compared too."""

log = logging.getLogger(__name__)


class CheckpointError(ValueError):
    """A checkpoint that is damaged or does not fit the mission: one sentence with the fix."""


@dataclass(frozen=True)
class Meta:
    """The metadata of a checkpoint. `shape`: of an observation. `config`: all settings, by dotted key."""

    format: int
    updates: int
    version: int
    copied: int
    shape: list[int]
    config: dict[str, Any]


@dataclass(frozen=True)
class Saved:
    """A checkpoint that was read: the name of its file, its metadata, and the trainer's state."""

    name: str
    meta: Meta
    state: State


def save(folder: Path, trainer: Trainer) -> Path:
    """Write `checkpoint-<updates>.safetensors`, delete all but the newest KEEP; return its path. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    state = trainer.state()
    meta = Meta(FORMAT, state.updates, state.version, state.copied, list(trainer.shape), flat(trainer.config))
    text = json.dumps(vars(meta), sort_keys=True)
    path = folder / f"{PREFIX}{state.updates}{SUFFIX}"
    write_atomically(path, to_safetensors(state.tensors, {KEY: text, DIGEST: digest(text, state.tensors)}), sync=True)
    _prune(folder, state.updates)
    return path


def _prune(folder: Path, updates: int) -> None:
    """Delete the partial files of killed writers, and all but the newest KEEP checkpoints up to `updates`.

    Checkpoints of later updates are damaged, or belong to a training that the user went back from, so they stay.
    """
    old = [path for n, path in _numbered(folder) if n <= updates][KEEP:]
    for path in [*old, *folder.glob(f"{PREFIX}*{SUFFIX}{NEW_SUFFIX}")]:
        path.unlink(missing_ok=True)


def _numbered(folder: Path) -> list[tuple[int, Path]]:
    """Return (updates, path) of every checkpoint in the folder, the newest first."""
    names = ((path.name[len(PREFIX) : -len(SUFFIX)], path) for path in folder.glob(f"{PREFIX}*{SUFFIX}"))
    return sorted(((int(n), path) for n, path in names if n.isdecimal()), reverse=True)


def newest(folder: Path, warn: Callable[[str], None] = log.warning) -> Saved | None:
    """Return the readable checkpoint with the most updates, or None; `warn` gets a sentence on each damaged one."""
    for _, path in _numbered(folder):
        try:
            return read(path)
        except CheckpointError as error:
            warn(f"skipped: {error}")
    return None


def read(path: Path) -> Saved:
    """Read a checkpoint. Raises CheckpointError if it is missing, damaged or of another format."""
    damaged = f"the checkpoint {path.name} is damaged or cut short: delete it to resume from an older one"
    try:
        files.check(path)
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors: dict[str, Tensor] = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        text = metadata[KEY]
        version = json.loads(text)["format"]
    except FileNotFoundError:
        raise CheckpointError(f"there is no checkpoint {path}: choose one that is in its folder") from None
    except (SafetensorError, OSError, KeyError, TypeError, ValueError):
        raise CheckpointError(damaged) from None
    if version != FORMAT:
        raise CheckpointError(f"the checkpoint {path.name} has format {version}, this Overfly reads format {FORMAT}")
    if metadata.get(DIGEST) != digest(text, tensors):
        raise CheckpointError(damaged)
    meta = Meta(**json.loads(text))
    return Saved(path.name, meta, State(tensors, meta.updates, meta.version, meta.copied))


def load(saved: Saved, trainer: Trainer) -> None:
    """Load a checkpoint into the trainer. Raises CheckpointError, and leaves the trainer as it was."""
    difference = _difference(saved.meta, trainer)
    if difference:
        raise CheckpointError(f"the checkpoint {saved.name} {difference}: choose the settings it was made with")
    if layout(saved.state.tensors) != layout(trainer.state().tensors):
        raise CheckpointError(f"the checkpoint {saved.name} has other weights than the network: start without it")
    trainer.load(saved.state)


def _difference(meta: Meta, trainer: Trainer) -> str:
    """Return how the checkpoint's network differs from the trainer's, as part of a sentence; "" if it does not."""
    if tuple(meta.shape) != trainer.shape:
        return f"was made for observations of shape {tuple(meta.shape)}, this mission has {trainer.shape}"
    mine = flat(trainer.config)
    for key in NETWORK:
        was = meta.config.get(key)
        if was != mine[key]:
            return f"was made with {key} = {was}, this mission has {mine[key]}"
    return ""


def digest(text: str, tensors: dict[str, Tensor]) -> str:
    """Return the SHA-256 of the metadata and all tensors, in the order of their names."""
    total = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        total.update(name.encode())
        total.update(tensors[name].numpy().tobytes())
    return total.hexdigest()
