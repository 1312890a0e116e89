"""Parse the options of commands and child processes: no abbreviations, and printable errors."""

from __future__ import annotations

import argparse
from typing import Any, NoReturn

from tmc.kernel.text import printable


class Options(argparse.ArgumentParser):
    """A parser without abbreviations, since a new option could change their meaning."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"allow_abbrev": False, **kwargs})

    def error(self, message: str) -> NoReturn:
        """Print the error on one line, and exit with code 2."""
        super().error(printable(message))
