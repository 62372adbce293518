"""Damaged and hostile dataset folders of every format: frames, or a typed error."""

from __future__ import annotations

import os
import shutil
import socket
import tempfile
import zlib
from pathlib import Path

import cv2
import numpy as np

from tests.sequences.mutations import damage
from tests.sequences.test_fuzz import FORMATS, OWN_CAMERA, check_frame
from tests.sequences.writers import CAMERA
from tools.attacks.isolation import Attempt
from warpslam.errors import DatasetError
from warpslam.sequences import open_sequence
from warpslam.sequences.checking import check_folder

__all__ = ["FORMATS", "prepare"]


def prepare(name: str) -> Attempt:
    """``name`` is "folders" and one of `FORMATS`."""
    dataset = name.split()[-1]
    home = Path(tempfile.mkdtemp(prefix="warpslam-attacks-"))
    FORMATS[dataset](home / "whole")
    camera = None if dataset in OWN_CAMERA else CAMERA

    def attempt(rng: np.random.Generator) -> str:
        folder = home / "damaged"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(home / "whole", folder)
        damage(folder, rng)
        if rng.random() < 0.4:
            _poison(folder, rng)
        try:
            sequence = open_sequence(folder, dataset, camera)
            bad = 0
            for index in range(len(sequence)):
                try:
                    frame = sequence[index]
                except DatasetError:
                    bad += 1
                    continue
                check_frame(frame, sequence, dataset, is_exact=False)
        finally:
            check_folder(folder, dataset, camera)
        return "some frames" if bad else "all frames"

    return attempt


def _poison(folder: Path, rng: np.random.Generator) -> None:
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    if not files:
        return
    path = files[rng.integers(0, len(files))]
    kind = rng.integers(0, 9)
    path.unlink()
    if kind == 0:
        os.mkfifo(path)
    elif kind == 1:
        path.symlink_to(str(rng.choice(["/dev/zero", "/dev/urandom", "/dev/tty", "/proc/kmsg"])))
    elif kind == 2:
        path.symlink_to(path.name)
    elif kind == 3:
        _socket(path)
    elif kind == 4:
        path.write_bytes(large_png(int(rng.integers(3000, 16000))))
    elif kind == 5:
        with open(path, "wb") as file:
            file.truncate(int(rng.choice([1 << 20, 1 << 30, 1 << 36])))
    elif kind == 6:
        path.write_bytes(b"a: &a [1,1,1,1]\n" + b"".join(b"b%d: &b%d [*a,*a]\n" % (n, n) for n in range(300)))
    elif kind == 7:
        path.write_bytes(
            rng.choice([b"[" * 100000, b"x" * 300 + b" y\n", b"1.0 " + b"n" * 5000 + b"\n", b"9" * 1000000])
        )
    else:
        path.write_bytes(b"x")
        path.chmod(0)


def large_png(size: int) -> bytes:
    """A PNG of ``size`` x ``size`` pixels of 16 bits in little space."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    header = size.to_bytes(4, "big") * 2 + bytes([16, 0, 0, 0, 0])
    packer = zlib.compressobj(1)
    row = bytes(2 * size + 1)
    rows = b"".join(packer.compress(row) for _ in range(min(size, 400))) + packer.flush()
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def _socket(path: Path) -> None:
    before = os.getcwd()
    os.chdir(path.parent)  # the path of a socket is short
    try:
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(path.name)
    finally:
        os.chdir(before)


_ = cv2  # its threads must not outlive a fork: it is loaded before the tries begin
