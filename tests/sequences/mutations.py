"""Random damage to the files of a sequence: what disks, downloads and editors do, and worse."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

GARBAGE = (
    b"", b"\x00" * 40, b"\xff\xfe\xfd garbage \x80\x81", b"nan nan nan nan\n", b"1e999 -inf 0 0\n", b"<html>404</html>",
    b"[1, 2", b"{", b"a: &a [*a]\n", b"- 1\n- 2\n", b"0 0 0 0\n" * 5, b"1,2,3,4,5,6,7,8\n", b"# only a comment\n",
    b"../../../etc/passwd 1\n", b"1.0 \n", b"-5 rgb/x.png\n", b"1 1 1 1 1 1 1 1 1 1 1 1 1 1 1 1\n",
    "\ufeff１ ２\n".encode(), b"fx: 1e400\nfy: .inf\n", b"width: 99999999999999\n",
    b"!!python/object/apply:os.abort []\n", b"9" * 5000 + b"\n",
)  # fmt: skip

Mutation = Callable[[Path, np.random.Generator], None]


def truncate(file: Path, rng: np.random.Generator) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: rng.integers(0, max(len(data), 1))])


def flip_bytes(file: Path, rng: np.random.Generator) -> None:
    data = bytearray(file.read_bytes())
    for _ in range(int(rng.integers(1, 6))):
        if data:
            data[rng.integers(0, len(data))] ^= int(rng.integers(1, 256))
    file.write_bytes(data)


def zero_block(file: Path, rng: np.random.Generator) -> None:
    """A sector that was never written."""
    data = bytearray(file.read_bytes())
    start = int(rng.integers(0, max(len(data), 1)))
    data[start : start + 64] = bytes(len(data[start : start + 64]))
    file.write_bytes(data)


def remove(file: Path, rng: np.random.Generator) -> None:
    file.unlink()


def replace_by_garbage(file: Path, rng: np.random.Generator) -> None:
    file.write_bytes(GARBAGE[rng.integers(0, len(GARBAGE))])


def insert_garbage(file: Path, rng: np.random.Generator) -> None:
    data = file.read_bytes()
    at = int(rng.integers(0, len(data) + 1))
    file.write_bytes(data[:at] + GARBAGE[rng.integers(0, len(GARBAGE))] + data[at:])


def swap_lines(file: Path, rng: np.random.Generator) -> None:
    lines = file.read_bytes().split(b"\n")
    rng.shuffle(lines)
    file.write_bytes(b"\n".join(lines))


def repeat_line(file: Path, rng: np.random.Generator) -> None:
    lines = file.read_bytes().split(b"\n")
    lines.insert(int(rng.integers(0, len(lines))), lines[rng.integers(0, len(lines))])
    file.write_bytes(b"\n".join(lines))


def become_a_folder(file: Path, rng: np.random.Generator) -> None:
    file.unlink()
    file.mkdir()


def become_a_dangling_link(file: Path, rng: np.random.Generator) -> None:
    file.unlink()
    file.symlink_to("nowhere")


def take_another_files_place(file: Path, rng: np.random.Generator) -> None:
    """Something of another kind, of the same folder."""
    others = sorted(other for other in file.parent.iterdir() if other.is_file() and other != file)
    if others:
        shutil.copyfile(others[rng.integers(0, len(others))], file)


MUTATIONS: tuple[Mutation, ...] = (
    truncate, flip_bytes, flip_bytes, zero_block, remove, replace_by_garbage, insert_garbage, swap_lines, repeat_line,
    become_a_folder, become_a_dangling_link, take_another_files_place,
)  # fmt: skip


def damage(folder: Path, rng: np.random.Generator) -> list[tuple[str, Path]]:
    """Damage one to three files; returns what was done to which."""
    done = []
    for _ in range(int(rng.integers(1, 4))):
        files = sorted(file for file in folder.rglob("*") if file.is_file())
        # Lists, poses and cameras are few beside the images, and have more ways to be wrong.
        texts = [file for file in files if file.suffix in (".txt", ".log", ".yaml", ".json")]
        if texts and rng.random() < 0.5:
            files = texts
        file = files[rng.integers(0, len(files))]
        mutation = MUTATIONS[rng.integers(0, len(MUTATIONS))]
        mutation(file, rng)
        done.append((mutation.__name__, file))
    return done
