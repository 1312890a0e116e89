"""Finds the class and description of a schema of the log: Overfly's types, and foxglove's, imported when first used.

Overfly's are generated from `overfly.proto` into `overfly_pb2` when the package is built (`hatch_build.py`).
"""

from __future__ import annotations

import importlib
from contextlib import suppress
from functools import cache
from types import ModuleType

from google.protobuf import descriptor_pb2
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.message import Message

from tmc.record import overfly_pb2
from tmc.record.errors import RecordError

PACKAGE = overfly_pb2.DESCRIPTOR.package


@cache
def message_class(schema: str) -> type[Message]:
    """Return the class of a schema such as `overfly.Sync` or `foxglove.Grid`; RecordError when it is not known."""
    package, _, name = schema.partition(".")
    found: type[Message] | None = None
    if package == PACKAGE and name in overfly_pb2.DESCRIPTOR.message_types_by_name:
        found = getattr(overfly_pb2, name)
    elif package == "foxglove" and name.isidentifier():
        with suppress(ImportError, AttributeError):
            found = getattr(foxglove(name), name)
    if found is None:
        raise RecordError(f"schema {schema} is not known here: upgrade overfly and foxglove-schemas-protobuf")
    return found


def foxglove(name: str) -> ModuleType:
    """Import the generated module of one foxglove type. Each import takes milliseconds, so only used ones are."""
    return importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2")


def schema_bytes(schema: str) -> bytes:
    """Return what MCAP stores of a protobuf schema: a FileDescriptorSet with all types that it depends on."""
    files = descriptor_pb2.FileDescriptorSet()
    file: FileDescriptor = message_class(schema).DESCRIPTOR.file  # type: ignore[assignment]  # or its twin in C
    _collect(file, files, set())
    return files.SerializeToString()


def _collect(file: FileDescriptor, files: descriptor_pb2.FileDescriptorSet, done: set[str]) -> None:
    if file.name in done:
        return
    done.add(file.name)
    for dependency in file.dependencies:
        _collect(dependency, files, done)
    file.CopyToProto(files.file.add())
