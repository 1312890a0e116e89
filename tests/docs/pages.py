"""What the tests of the documents share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator

from deploy.cli import COMMANDS


def below(parser: argparse.ArgumentParser, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The words of each command below a parser, at any depth."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for word, sub in action.choices.items():
                yield (*path, word)
                yield from below(sub, (*path, word))


def subcommands(parser_for: Callable[[str | None], argparse.ArgumentParser]) -> set[tuple[str, ...]]:
    """The words of every command: ("log", "check") for `overfly log check`."""
    return {words for command in COMMANDS for words in below(parser_for(command.name)) if words[0] == command.name}
