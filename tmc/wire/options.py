"""The options of every command and child process: whole words only, and one sentence for what is wrong."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any, NoReturn

from tmc.kernel.text import nearest, printable, suggestion
from tmc.wire.process import ERROR, USAGE


class Options(argparse.ArgumentParser):
    """A parser whose errors are one sentence that names the nearest option or name that exists.

    It takes no abbreviation, which the next new option could turn into another; nor do its subcommands.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"allow_abbrev": False, **kwargs})
        self._names: argparse._SubParsersAction[Options] | None = None

    def add_subparsers(self, **kwargs: Any) -> Any:
        """Add the table of subcommands; `dest` is what an error calls them, such as `command` or `bench`."""
        self._names = super().add_subparsers(**kwargs)
        return self._names

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse all arguments; exit with code 2 where one of them is unknown."""
        found, rest = self.parse_known_args(args, namespace)
        if rest:
            *_, parser = self._chosen(found)
            parser.error(parser._unknown(rest[0]))
        return found

    def _chosen(self, found: argparse.Namespace) -> Iterator[Options]:
        """Yield this parser and those of the subcommands that were chosen, outermost first."""
        yield self
        if self._names is not None:
            yield from self._names.choices[getattr(found, self._names.dest)]._chosen(found)

    def _unknown(self, word: str) -> str:
        if not word.startswith("-"):
            return f"'{word}' is one argument too many"
        option = word.partition("=")[0]
        near = nearest(option, self._option_string_actions)
        return f"there is no option {option}" + (f": did you mean {near}?" if near else "")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a value that is not among the choices (called by argparse for each value)."""
        if action.choices is None or value in action.choices:
            return
        known = [str(choice) for choice in action.choices]
        option = "/".join(action.option_strings)
        what = f"{option} {value} is unknown" if option else f"there is no {action.dest} '{value}'"
        self.error(f"{what}: {suggestion(str(value), known)}")

    def error(self, message: str) -> NoReturn:
        """Print what is wrong on one line, with the command that lists the options, and exit with code 2."""
        text = printable(message)
        self.exit(USAGE, f"{ERROR}{text}{'' if text.endswith('?') else ';'} see `{self.prog} --help`\n")
