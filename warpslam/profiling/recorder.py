"""Timing of every kernel launch while a profile is active.

On the CPU each launch is timed by the wall clock, around the compiled function itself, in whichever thread it runs.
On CUDA the driver's events time them (`warp.timing_begin`); they are read whenever the phase changes, which waits for
the device, and graphs are replayed launch by launch, so that a profiled run has more overhead than any other. Kernel
times of either are those of an unprofiled run, and so is every result.

Nothing is in the way of a launch otherwise: the functions that launch are replaced when a profile begins and put back
when it ends. Warp has one private function through which all CPU launches go, recorded ones included; a test sees to
it that it is still there.
"""

from __future__ import annotations

import contextvars
import math
import threading
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import warp as wp
import warp._src.context as warp_context

from warpslam.errors import WarpSlamError
from warpslam.profiling.costs import NOTHING, Arguments, Work, work_of
from warpslam.profiling.records import GPU, Interval, Launch, Recording
from warpslam.runtime import launching, phases, program
from warpslam.runtime.phases import Span, clock

_PEAK_SIZE = 2048


class Recorder:
    """Fills a `Recording` with what all threads do from `begin` to `end`; one can be active at a time."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self._inside = threading.local()
        self._patches = ExitStack()
        self._cuda: _CudaTimer | None = None

    @property
    def is_active(self) -> bool:
        """Whether it records at present."""
        return phases.listener is self

    def begin(self) -> None:
        """Replace the functions that launch.

        Raises:
            WarpSlamError: Another recorder is active, or this version of Warp launches in another way.
        """
        if phases.listener is not None:
            raise WarpSlamError("a profile is active already: leave its with block before another one begins")
        self.recording.peak_gflops = matrix_peak_gflops()
        wp.init()
        if wp.is_cuda_available():
            self._cuda = _CudaTimer(self)
        self._patch()
        phases.listener = self
        self._root = phases.enter(phases.OTHER)
        self.recording.start = self._root.start

    def end(self) -> None:
        """Put them back."""
        self.changes()
        phases.leave(self._root)
        self.left(self._root)
        self.recording.wall_seconds = self._root.stop - self._root.start
        phases.listener = None
        self._patches.close()
        if self._cuda is not None:
            self._cuda.end()

    # -- phases --------------------------------------------------------------------------------------------------

    def changes(self) -> None:
        """Whatever the device did until now belongs to the phase that ends."""
        if self._cuda is not None:
            self._cuda.collect()

    def left(self, span: Span) -> None:
        """A stay in a phase is over."""
        self._where()
        self.recording.spans.append(span)

    def _where(self) -> tuple[str, int, bool]:
        """Phase, thread, and whether the phase was entered by it."""
        thread, span = phases.thread_number(), phases.current()
        if thread not in self.recording.threads:
            self.recording.threads[thread] = threading.current_thread().name
        return (phases.OTHER, thread, False) if span is None else (span.path, thread, span.thread == thread)

    # -- hooks ---------------------------------------------------------------------------------------------------

    def _patch(self) -> None:
        invoke = getattr(warp_context, "invoke", None)
        if not callable(invoke):
            raise WarpSlamError(
                f"this version of Warp ({wp.config.version}) launches CPU kernels in another way than 1.19: no profile"
            )
        for owner, name, replacement in (
            (warp_context, "invoke", self._timed_invoke(invoke)),
            (wp, "launch", self._timed_launch(wp.launch)),
            (wp.Launch, "launch", self._timed_command(wp.Launch.launch)),
            (wp.Module, "load", self._timed_load(wp.Module.load)),
            (program, "_pool", self._timed_pool(program._pool)),
            (launching.Launcher, "iterate", _iterate_in_phase(launching.Launcher.iterate)),
            (program.Program, "run", _run_without_graph(program.Program.run)),
        ):
            self._patches.enter_context(_replaced(owner, name, replacement))

    def _add(self, what: str, start: float, seconds: float, name: str = "") -> None:
        self.recording.intervals.append(Interval(what, *self._where(), start, seconds, name))

    def _accounted(self) -> float:
        """Seconds of this thread that launches and loads have already been charged with."""
        return getattr(self._inside, "seconds", 0.0)

    def _account(self, seconds: float) -> None:
        self._inside.seconds = self._accounted() + seconds

    def _timed_invoke(self, original: Callable) -> Callable:
        def invoke(kernel: wp.Kernel, hooks: Any, params: Any, adjoint: bool) -> None:
            entered = clock()
            arguments = Arguments(kernel, params[1 : 1 + len(kernel.adj.args)], readable=True)
            work = work_of(kernel, adjoint, params[0].size, arguments)
            begun = clock()
            timed = _TimedHooks(hooks)
            original(kernel, timed, params, adjoint)
            left = clock()
            path, thread, own = self._where()
            name, dim = _name(kernel, adjoint), _dimensions(params[0])
            launch = Launch(name, path, thread, own, timed.start, timed.stop, work, dim)
            self.recording.launches.append(launch)
            self._add("profiler", entered, begun - entered)
            self._add("launch", begun, left - begun - (timed.stop - timed.start))
            self._account(left - entered)

        return invoke

    def _timed_launch(self, original: Callable) -> Callable:
        def launch(kernel: wp.Kernel, dim: Any, *args: Any, **kwargs: Any) -> Any:
            before, start = self._accounted(), clock()
            result = original(kernel, dim, *args, **kwargs)
            self._charge(start, before)
            if self._cuda is not None and result is None and wp.get_device(kwargs.get("device")).is_cuda:
                dim = tuple(map(int, dim)) if isinstance(dim, tuple | list) else (int(dim),)
                inputs = kwargs.get("inputs", args[0] if args else ())
                outputs = kwargs.get("outputs", args[1] if len(args) > 1 else ())
                values = [*inputs, *outputs]
                self._cuda.launched(kernel, bool(kwargs.get("adjoint")), dim, values)
            return result

        return launch

    def _timed_command(self, original: Callable) -> Callable:
        def launch(command: wp.Launch, stream: Any = None) -> None:
            before, start = self._accounted(), clock()
            original(command, stream)
            self._charge(start, before)
            if self._cuda is not None and command.device.is_cuda:
                dim, values = _dimensions(command.bounds), command.fwd_args or []
                self._cuda.launched(command.kernel, command.adjoint, dim, values)

        return launch

    def _charge(self, start: float, before: float) -> None:
        """What a launch took beyond the kernel, and beyond what has been accounted for meanwhile."""
        seconds = clock() - start - (self._accounted() - before)
        self._add("launch", start, seconds)
        self._account(seconds)

    def _timed_load(self, original: Callable) -> Callable:
        def load(module: wp.Module, *args: Any, **kwargs: Any) -> Any:
            known, start = len(module.execs), clock()
            result = original(module, *args, **kwargs)
            if len(module.execs) != known:
                seconds = clock() - start
                self._add("load", start, seconds, module.name)
                self._account(seconds)
            return result

        return load

    def _timed_pool(self, original: Callable[[], ThreadPoolExecutor]) -> Callable[[], _TimedPool]:
        return lambda: _TimedPool(original(), self)


class _TimedHooks:
    """Entry points of a kernel, with the time they took."""

    __slots__ = ("_hooks", "start", "stop")

    def __init__(self, hooks: Any) -> None:
        self._hooks, self.start, self.stop = hooks, 0.0, 0.0

    def forward(self, *args: Any) -> None:
        self.start = clock()
        self._hooks.forward(*args)
        self.stop = clock()

    def backward(self, *args: Any) -> None:
        self.start = clock()
        self._hooks.backward(*args)
        self.stop = clock()


class _TimedPool:
    """Hands work to the pool in the phase it comes from, and notes how long its result is waited for."""

    def __init__(self, pool: ThreadPoolExecutor, recorder: Recorder) -> None:
        self._pool, self._recorder = pool, recorder

    def submit(self, function: Callable, *args: Any) -> _TimedFuture:
        context = contextvars.copy_context()
        return _TimedFuture(self._pool.submit(context.run, function, *args), self._recorder)


class _TimedFuture:
    def __init__(self, future: Future, recorder: Recorder) -> None:
        self._future, self._recorder = future, recorder

    def result(self) -> Any:
        start = clock()
        try:
            return self._future.result()
        finally:
            self._recorder._add("wait", start, clock() - start)


class _CudaTimer:
    """Kernel times by the driver's events, read at changes of phase."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._pending: dict[str, deque[tuple[Work, tuple[int, ...]]]] = defaultdict(deque)
        recorder.recording.threads[GPU] = "GPU"
        self._begin()

    def _begin(self) -> None:
        self._since = clock()
        wp.timing_begin(cuda_filter=wp.TIMING_KERNEL)

    def launched(self, kernel: wp.Kernel, adjoint: bool, dim: tuple[int, ...], values: list) -> None:
        """Note a launch, whose time comes later."""
        work = work_of(kernel, adjoint, math.prod(dim), Arguments(kernel, values, readable=False))
        self._pending[_name(kernel, adjoint)].append((work, dim))

    def collect(self) -> None:
        """Charge the current phase with all kernels since the last time."""
        self._read()
        self._begin()

    def end(self) -> None:
        """Stop timing."""
        wp.timing_end()

    def _read(self) -> None:
        path = self._recorder._where()[0]
        start = self._since
        for result in wp.timing_end():
            # "forward kernel middle_forward_f40074b3", "backward kernel ...", "builtin kernel ...".
            kind, _, mangled = result.name.rpartition(" ")
            key = mangled.rpartition("_")[0]
            name = f"{key} (adjoint)" if kind.startswith("backward") else key
            waiting = self._pending.get(name)
            name, (work, dim) = (name, waiting.popleft()) if waiting else (mangled, (NOTHING, ()))
            stop = start + 1e-3 * result.elapsed
            self._recorder.recording.launches.append(Launch(name, path, GPU, False, start, stop, work, dim))
            start = stop
        self._pending.clear()


def _dimensions(bounds: Any) -> tuple[int, ...]:
    """Of a launch."""
    return tuple(bounds.shape)


def _name(kernel: wp.Kernel, adjoint: bool) -> str:
    return f"{kernel.key} (adjoint)" if adjoint else kernel.key


def _iterate_in_phase(original: Callable) -> Callable:
    def iterate(launcher: Any, kind: str, *args: Any) -> None:
        with phases.phase(kind):
            original(launcher, kind, *args)

    return iterate


def _run_without_graph(original: Callable) -> Callable:
    """Launch by launch on CUDA: Warp times no kernel of a graph."""

    def run(recorded: program.Program) -> None:
        if not recorded.device.is_cuda:
            original(recorded)
            return
        for step in recorded._steps:
            command = getattr(step, "__self__", None)
            # A method bound before the profile began would be the one that is not timed.
            (command.launch if isinstance(command, wp.Launch) else step)()

    return run


@contextmanager
def _replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    original = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, original)


def matrix_peak_gflops(size: int = _PEAK_SIZE, repeats: int = 3) -> float:
    """Best rate of NumPy's single-precision matrix product on all cores [GFLOP/s]."""
    a = np.random.default_rng(0).standard_normal((size, size), np.float32)
    out = a @ a
    best = math.inf
    for _ in range(repeats):
        start = clock()
        np.matmul(a, a, out=out)
        best = min(best, clock() - start)
    return 2 * size**3 / best / 1e9
