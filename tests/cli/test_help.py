"""Help, completion, and what is said to a slip of the hand."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from warpslam import cli
from warpslam.cli import COMMANDS
from warpslam.cli.completion import command_table
from warpslam.cli.examples import EXAMPLES

PARTS = {"render-room": ("sequence", "sheet")}


def test_every_command_has_examples():
    """Of each command and each part of one, and of nothing else."""
    expected = {part for name in COMMANDS for part in PARTS.get(name, (name,))}
    assert set(EXAMPLES) == expected


@pytest.mark.parametrize("line", [line for name, lines in EXAMPLES.items() if name != "completion" for line in lines])
def test_examples_can_be_typed(line):
    """Each is a command line that the parser takes."""
    program, *arguments = shlex.split(line)
    assert program == "warpslam"
    assert callable(cli._parser(arguments).parse_args(arguments).command)


@pytest.mark.parametrize("name", COMMANDS)
def test_helps_show_them(name, capsys):
    """At the end of the help, as they are, and no line is wider than the widest terminal that one takes for granted."""
    for arguments in [[name, part] for part in PARTS.get(name, ())] or [[name]]:
        with pytest.raises(SystemExit) as end:
            cli.main([*arguments, "--help"])
        text = capsys.readouterr().out
        assert end.value.code == 0
        assert all(line in text for line in EXAMPLES[arguments[-1]]) and "examples:" in text


def test_a_command_that_is_misspelt(capsys):
    """The nearest one is named; where none is near, how to list all."""
    for word, said in (("rnu", "did you mean run?"), ("calibrate_time", "did you mean calibrate-time?"),
                       ("xyzzy", "warpslam --help")):  # fmt: skip
        with pytest.raises(SystemExit) as end:
            cli.main([word, "folder"])
        err = capsys.readouterr().err
        assert end.value.code == 2 and said in err and len(err.splitlines()) == 1


def test_an_option_that_is_misspelt(capsys):
    """The nearest one is named, under the usage of the command that was asked for."""
    with pytest.raises(SystemExit) as end:
        cli.main(["run", "folder", "--checkpoint-evry", "50"])
    err = capsys.readouterr().err
    assert end.value.code == 2 and "did you mean --checkpoint-every?" in err and "usage: warpslam run" in err
    with pytest.raises(SystemExit):
        cli.main(["demo", "--frames", "0:5"])
    err = capsys.readouterr().err
    assert "usage: warpslam demo" in err and "warpslam demo: error: unrecognized arguments: --frames" in err


def test_completion_knows_every_option():
    """Those of the parsers, of each command."""
    table = command_table()
    assert list(table) == list(COMMANDS)
    assert {"--frames", "--set", "--view", "--poses"} <= set(table["run"][1])
    assert {"sequence", "sheet"} <= set(table["render-room"][2]) and "--kind" in table["render-room"][1]
    assert "realsense" in table["live"][2] and "euroc" in table["export"][2]


def test_completion_in_bash(tmp_path: Path):
    """A real bash completes a command, and an option of it."""
    bash = shutil.which("bash")
    assert bash
    script = subprocess.run(
        [sys.executable, "-m", "warpslam", "completion", "bash"], capture_output=True, text=True, check=True
    ).stdout
    (tmp_path / "completion").write_text(script)

    def complete(*words: str) -> list[str]:
        line = (
            f"source {tmp_path}/completion; COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}; _warpslam; "
            'echo "${COMPREPLY[@]}"'
        )
        return subprocess.run([bash, "-c", line], capture_output=True, text=True, check=True).stdout.split()

    assert complete("warpslam", "re") == ["report", "render", "render-room"]
    assert complete("warpslam", "run", "--check") == ["--checkpoint-every"]
    assert complete("warpslam", "export", "eu") == ["euroc"]


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_completion_for_other_shells(shell, capsys):
    """A script that names each command; read by the shell itself where it is installed."""
    assert cli.main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert all(name in script for name in COMMANDS)
    program = shutil.which(shell)
    if program:
        assert subprocess.run([program, "-n"], input=script, text=True, capture_output=True).returncode == 0
