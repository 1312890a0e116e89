"""The options of every command and child process: whole words only, and errors that cannot move the cursor."""

from __future__ import annotations

import argparse
from typing import Any, NoReturn

from tmc.kernel.text import printable


class Options(argparse.ArgumentParser):
    """A parser that takes no abbreviation, which the next new option could turn into another; nor do its commands."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"allow_abbrev": False, **kwargs})

    def error(self, message: str) -> NoReturn:
        """Say what is wrong on one line, and exit with code 2."""
        super().error(printable(message))
