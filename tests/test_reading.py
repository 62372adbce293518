"""Files of strangers: what is no regular file is not opened, what is too large not read, what unfolds not unfolded."""

import io
import os
import socket
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from warpslam.errors import DatasetError, brief, printable
from warpslam.reading import YAML_LIMIT, check_regular, load_yaml, read_bytes, read_text


def _fifo(path):
    os.mkfifo(path)


def _socket(path):
    os.chdir(path.parent)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(path.name)


def _device(path):
    path.symlink_to("/dev/zero")


def _loop(path):
    path.symlink_to(path)


def test_a_file_of_the_system_that_waits_is_not_waited_for(tmp_path, monkeypatch):
    """/proc/kmsg says that it is a regular file; whoever reads it waits for the kernel's next message, and without
    waiting gets None.
    """

    class Waiting(io.BytesIO):
        def read(self, size=-1):
            return None

    (tmp_path / "file").touch()
    monkeypatch.setattr(os, "fdopen", lambda descriptor, mode: Waiting())
    with pytest.raises(OSError, match="nothing to be read"):
        read_bytes(tmp_path / "file", 100)


def test_empty_files_are_for_those_who_can_read_them(tmp_path):
    """Text may be empty; what is opened by others must hold something."""
    (tmp_path / "file").touch()
    assert read_text(tmp_path / "file") == ""
    with pytest.raises(OSError, match="is empty"):
        check_regular(tmp_path / "file")


@pytest.mark.parametrize("make", [_fifo, _socket, _device, _loop, lambda path: path.mkdir()])
def test_only_regular_files_are_opened(make, tmp_path, monkeypatch):
    """A pipe, a socket, a device, a link to itself and a folder each raise at once, and name the path."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "file"
    make(path)
    for read in (check_regular, lambda path: read_bytes(path, 100), read_text):
        done, errors = threading.Event(), []

        def work(read=read, done=done, errors=errors):
            try:
                read(path)
            except OSError as error:
                errors.append(error)
            done.set()

        threading.Thread(target=work, daemon=True).start()
        assert done.wait(10), "it hangs"
        assert errors and errors[0].filename == str(path)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_what_is_no_text_is_an_error_of_the_system(tmp_path, encoding):
    """As whoever reads a file expects them: it says where the byte is, and names the file."""
    path = tmp_path / "file"
    path.write_bytes(b"abc\xc5\x28")
    with pytest.raises(OSError, match="no text in UTF-8.*0xc5 at 3") as raised:
        read_text(path, encoding=encoding)
    assert raised.value.filename == str(path)


def test_sizes_are_bounded(tmp_path):
    """A file larger than what is asked for is refused before it is read; one of the very size is read."""
    path = tmp_path / "file"
    path.write_bytes(b"x" * 10)
    assert read_bytes(path, 10) == b"x" * 10
    with pytest.raises(OSError, match="expected at most"):
        read_bytes(path, 9)
    with open(path, "wb") as file:
        file.truncate(1 << 40)  # takes no space
    with pytest.raises(OSError, match="MB"):
        read_text(path)
    with pytest.raises(OSError, match="null"):
        check_regular("a\0b")


@pytest.mark.parametrize(
    "text",
    ["a: &a [1]\nb: *a", "x" * (YAML_LIMIT + 1), "[" * 5000, "!!timestamp x", "!!bool x", "!!float [1]", "{", "\x00"],
)
def test_yaml_of_strangers_raises_one_error(text):
    """Aliases, length, depth, and tags whose constructors let all kinds of errors through."""
    with pytest.raises(ValueError):
        load_yaml(text)


@given(st.text(max_size=300))
def test_any_text_is_yaml_or_a_value_error(text):
    """Nothing else comes out."""
    try:
        load_yaml(text)
    except ValueError:
        pass


@given(st.text(max_size=3000))
def test_messages_quote_little_and_escape_control_characters(text):
    """Whatever a message quotes, it is bounded and printable, in one line each."""
    assert len(brief(text)) <= 260 and "\n" not in brief(text)
    told = str(DatasetError(f"file: {text}"))
    assert len(told) <= 20000 and printable(told) == told
    assert not any(ord(c) < 32 and c not in "\n\t" for c in told) and "\x1b" not in told
    told.encode("utf-8")
