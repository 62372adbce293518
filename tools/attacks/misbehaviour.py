"""A program with every fault that the attacks look for: for the test of `tools.attacks.isolation`."""

from __future__ import annotations

import ctypes
import os
import signal
import time

import numpy as np

from tools.attacks.isolation import Attempt, Lost, number_of
from warpslam.errors import InputError

WAYS = ("fine", "crash", "untyped", "wrong", "hang", "typed", "kill", "fine", "interrupt", "long", "lost", "end")


def prepare(name: str) -> Attempt:
    """One way after the other, whatever the random numbers are."""

    def attempt(rng: np.random.Generator) -> str:
        way = WAYS[number_of(rng)]
        if way == "crash":
            ctypes.string_at(0)
        if way == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if way == "hang":
            time.sleep(60)
        if way == "untyped":
            raise ValueError("untyped")
        if way == "interrupt":
            raise SystemExit(3)
        if way == "typed":
            raise InputError("typed")
        if way == "lost":
            raise Lost("half of it")
        if way == "end":
            raise StopIteration
        assert way != "wrong", "wrong"
        assert way != "long", "also wrong"
        return f"{way}; remarkable"

    return attempt
