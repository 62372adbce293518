"""A parser that says what was meant, and names the command at fault."""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Iterable
from typing import Any, NoReturn


class Parser(argparse.ArgumentParser):
    """Tells the nearest option or command where there is none of that name."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        keywords.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(*arguments, **keywords)

    def parse_args(self, args: Iterable[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Options of the command that is asked for; words that are too many are told with its usage, not with this
        parser's.
        """
        options, left = self.parse_known_args(None if args is None else list(args), namespace)
        if left:
            parser = getattr(options, "parser", self)
            parser.error(f"unrecognized arguments: {' '.join(left)}{_hint(left[0], parser)}")
        return options

    def error(self, message: str) -> NoReturn:
        """As argparse has it, with where to look for more."""
        self.print_usage(_stderr())
        self.exit(2, f"{self.prog}: error: {message}\n(all options: {self.prog} --help)\n")


def nearest(word: str, names: Iterable[str]) -> str | None:
    """The name that is most like a word; None where none is."""
    found = difflib.get_close_matches(word, list(names), n=1, cutoff=0.6)
    return found[0] if found else None


def _hint(word: str, parser: argparse.ArgumentParser) -> str:
    name = word.partition("=")[0]
    if not name.startswith("-"):
        return ""
    options = [option for action in parser._actions for option in action.option_strings if option.startswith("--")]
    meant = nearest(name, options)
    return f"; did you mean {meant}?" if meant else ""


def _stderr() -> Any:
    import sys

    return sys.stderr
