"""Launchers on two threads at a time: their tapes stay apart, and their slices share workers without a deadlock."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp

from tests.kernels.iteration import Iteration
from tests.kernels.random_scene import random_field, random_rays
from warpslam.runtime.cores import MAX_SLICES
from warpslam.runtime.launching import Launcher
from warpslam.runtime.program import run_slices

WAIT = 60.0  # [s]; a test that hangs fails instead


@pytest.fixture
def two_slices(monkeypatch):
    """As on a machine of two cores, whatever this one has."""
    monkeypatch.setattr("psutil.Process.cpu_affinity", lambda self: [0, 1], raising=False)


def gradients(iteration: Iteration, kind: str) -> list[np.ndarray]:
    """Everything that an iteration computes."""
    gradient = iteration.tracking() if kind == "tracking" else iteration.mapping()
    parts = [gradient.poses, *gradient.rows.values(), *gradient.color_decoder.values()]
    return [np.float64(gradient.loss), *(part for part in parts if part is not None)]


def test_gradients_of_two_threads_equal_those_of_one(two_slices):
    """An iteration of tracking and one of mapping, recorded and run backward at the same time: not a bit differs."""
    kinds = ("tracking", "mapping")
    iterations = [Iteration(random_field(1), random_rays(1)[0], "color", wp.get_device("cpu")) for _ in kinds]
    alone = [gradients(*pair) for pair in zip(iterations, kinds, strict=True)]
    barrier = threading.Barrier(2)

    def repeat(iteration: Iteration, kind: str) -> list[list[np.ndarray]]:
        results = []
        for _ in range(20):
            barrier.wait(WAIT)
            results.append(gradients(iteration, kind))
        return results

    with ThreadPoolExecutor(2) as threads:
        together = list(threads.map(repeat, iterations, kinds))
    for expected, results in zip(alone, together, strict=True):
        assert any(np.any(part) for part in expected[1:])
        for result in results:
            for a, b in zip(expected, result, strict=True):
                np.testing.assert_array_equal(a, b)


@wp.kernel
def square(x: wp.array[float], factor: float, y: wp.array[float]):
    tid = wp.tid()
    wp.atomic_add(y, 0, factor * x[tid] * x[tid])


def test_tape_takes_up_its_own_launcher_only():
    """Launches of other launchers, and those outside the block, leave no adjoint; the gradient of the rest is right."""
    device = wp.get_device("cpu")
    mine, other = Launcher(device), Launcher(device)
    x = wp.array([1.0, 2.0, 3.0], dtype=float, device=device, requires_grad=True)
    y = wp.zeros(1, dtype=float, device=device, requires_grad=True)
    mine.launch_taped(square, 3, [x, 5.0], [y])
    y.zero_()
    with wp.Tape() as process_tape, mine.tape() as tape:
        mine.launch_taped(square, 3, [x, 2.0], [y])
        other.launch_taped(square, 3, [x, 7.0], [wp.zeros(1, dtype=float, device=device, requires_grad=True)])
    assert not process_tape.launches and y.numpy()[0] == 28.0
    tape.backward(y)
    np.testing.assert_array_equal(x.grad.numpy(), [4.0, 8.0, 12.0])


def test_output_without_gradient_is_refused():
    """A backward pass from an output that has no gradient would silently add nothing."""
    with Launcher(wp.get_device("cpu")).tape() as tape, pytest.raises(RuntimeError, match="requires_grad"):
        tape.record_func(lambda: None, [wp.zeros(1, dtype=float, device="cpu")])


def test_two_threads_may_run_slices_at_a_time():
    """As many slices as there can be, from two threads, many times: all run, and none waits for ever."""
    launcher, device = Launcher(wp.get_device("cpu")), "cpu"
    ones = wp.full(1, 1.0, dtype=float, device=device)

    def count(rounds: int) -> float:
        sums = [wp.zeros(1, dtype=float, device=device) for _ in range(MAX_SLICES)]
        commands = [[launcher.command(square, 1, [ones, 1.0, total])] for total in sums]
        for _ in range(rounds):
            run_slices(commands)
        return sum(float(total.numpy()[0]) for total in sums)

    with ThreadPoolExecutor(2) as threads:
        counts = [threads.submit(count, 200) for _ in range(2)]
        assert [done.result(WAIT) for done in counts] == [200.0 * MAX_SLICES] * 2
