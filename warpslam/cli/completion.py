"""``warpslam completion``: a script that has the shell complete commands, options and files."""

from __future__ import annotations

import argparse
import importlib
from typing import Any

from warpslam.cli.common import add_command

SHELLS = ("bash", "zsh", "fish")


def add(commands: Any) -> None:
    """Add the command."""
    completion = add_command(commands, "completion", _completion, "a script that completes commands in your shell")
    completion.add_argument("shell", choices=SHELLS, metavar="SHELL", help=", ".join(SHELLS))


def _completion(options: argparse.Namespace) -> int:
    table = command_table()
    print(_fish(table) if options.shell == "fish" else _bash(table, zsh=options.shell == "zsh"))
    return 0


def command_table() -> dict[str, tuple[str, dict[str, str], list[str]]]:
    """By command: what it does, its options with theirs, and the words that it takes first, where those are fixed."""
    from warpslam.cli import COMMANDS
    from warpslam.cli.parsing import Parser

    parser = Parser(prog="warpslam", add_help=False)
    commands = parser.add_subparsers()
    for module in dict.fromkeys(module for module, _ in COMMANDS.values()):
        importlib.import_module(f"warpslam.cli.{module}").add(commands)
    table = {}
    for name, (_, text) in COMMANDS.items():
        options: dict[str, str] = {}
        words: list[str] = []
        for one in [commands.choices[name], *_parts(commands.choices[name])]:
            for action in one._actions:
                if isinstance(action, argparse._SubParsersAction):
                    words += list(action.choices)
                elif not action.option_strings and action.choices:
                    words += [str(choice) for choice in action.choices]
                for option in action.option_strings:
                    if option.startswith("--") and action.help != argparse.SUPPRESS:
                        options.setdefault(option, (action.help or "").replace("%%", "%"))
        table[name] = (text, options, words)
    return table


def _parts(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    found = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    return [part for action in found for part in action.choices.values()]


def _bash(table: dict[str, tuple[str, dict[str, str], list[str]]], *, zsh: bool) -> str:
    cases = [f"    {name}) words='{' '.join([*words, *options])}' ;;" for name, (_, options, words) in table.items()]
    lines = [
        '# warpslam completion: put  eval "$(warpslam completion bash)"  into ~/.bashrc (zsh into ~/.zshrc)',
        *(["autoload -U +X compinit && compinit", "autoload -U +X bashcompinit && bashcompinit"] if zsh else []),
        "_warpslam() {",
        '  local current="${COMP_WORDS[COMP_CWORD]}" words=""',
        "  COMPREPLY=()",
        '  if [ "$COMP_CWORD" -eq 1 ]; then',
        f"    COMPREPLY=($(compgen -W '{' '.join([*table, '--help', '--version'])}' -- \"$current\"))",
        "    return",
        "  fi",
        '  case "${COMP_WORDS[1]}" in',
        *cases,
        "  esac",
        '  COMPREPLY=($(compgen -W "$words" -- "$current"))',
        "}",
        "complete -o default -F _warpslam warpslam",
    ]
    return "\n".join(lines)


def _fish(table: dict[str, tuple[str, dict[str, str], list[str]]]) -> str:
    lines = ["# warpslam completion: warpslam completion fish > ~/.config/fish/completions/warpslam.fish"]
    for name, (text, options, words) in table.items():
        lines.append(f"complete -c warpslam -n __fish_use_subcommand -f -a {name} -d {_quoted(text)}")
        seen = f"-n '__fish_seen_subcommand_from {name}'"
        lines += [f"complete -c warpslam {seen} -a {word}" for word in words]
        lines += [f"complete -c warpslam {seen} -l {key[2:]} -d {_quoted(what)}" for key, what in options.items()]
    return "\n".join(lines)


def _quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
