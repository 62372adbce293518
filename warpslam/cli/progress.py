"""What the commands show while they work: bars on a terminal, lines anywhere else; nothing of what takes no time."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from warpslam.frames import FrameStatus
from warpslam.pipeline.observer import Observer
from warpslam.report.text import duration

if TYPE_CHECKING:
    from warpslam.runs.record import Progress
    from warpslam.runtime.compilation import ModuleProgress

_PLAIN_LINES = 20
_QUIET_SECONDS = 2.0  # what takes no longer says nothing
_BAR_WIDTH = 10
_NAME_WIDTH = 14  # with bar, counts, figures and the time left it fits into 80 columns
_REFRESH = 0.2  # [s], at least between two that are asked for
_UPDATES = 10  # lines of a long piece of work, where there is no terminal

Advance = Callable[[int, int], None]


@contextmanager
def run_display() -> Iterator[Observer]:
    """What shows a run: a progress bar on a terminal, about twenty lines anywhere else."""
    if not sys.stdout.isatty():
        yield Lines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, TextColumn
    from rich.progress import Progress as Bar
    from rich.text import Text

    class TimeLeft(ProgressColumn):
        """Counts down what was forecast after the last frame."""

        def render(self, task: Any) -> Text:
            end = task.fields["end"]
            return Text("" if end is None else f"{duration(max(end - time.monotonic(), 0.0))} left")

    columns = (
        TextColumn("{task.description}"), BarColumn(_BAR_WIDTH), MofNCompleteColumn(),
        TextColumn("{task.fields[figures]}"), TimeLeft(),
    )  # fmt: skip
    # rich redirects stdout and stderr while the bar is up, so warnings appear above it.
    # rich's own console goes by what standard output was when it was first asked for.
    with Bar(*columns, console=Console()) as bar:
        yield RunBar(bar)


class Lines(Observer):
    """About twenty lines of text, and one for each stage after the last frame."""

    def begin(self, name: str) -> None:
        """See `Observer`."""
        print(f"{name}: loading kernels, then mapping the first frame", flush=True)

    def module(self, progress: ModuleProgress) -> None:
        """See `Observer`."""
        if progress.compiled and progress.seconds is None:
            print(
                f"compiling {progress.name} (once a machine), {progress.done} of {progress.total} modules ready",
                flush=True,
            )

    def frame(self, progress: Progress) -> None:
        """See `Observer`."""
        every = max(1, progress.total // _PLAIN_LINES)
        if progress.done % every == 0 or progress.done in (1, progress.total):
            left = f"  {duration(progress.seconds_left)} left" if progress.seconds_left else ""
            print(f"frame {progress.done}/{progress.total}  {_figures(progress)}{left}", flush=True)

    def stage(self, name: str) -> None:
        """See `Observer`."""
        print(name, flush=True)


class RunBar(Observer):
    """A progress bar of rich."""

    def __init__(self, bar: Any) -> None:
        self._bar = bar
        self._task: Any = None
        self._refreshed = 0.0

    def begin(self, name: str) -> None:
        """See `Observer`."""
        short = name if len(name) <= _NAME_WIDTH else name[: _NAME_WIDTH - 1] + "…"
        self._task = self._bar.add_task(short, total=None, figures="loading kernels", end=None)

    def module(self, progress: ModuleProgress) -> None:
        """See `Observer`."""
        figures = f"compiling {progress.name[-20:]}, once" if progress.compiled else "loading kernels"
        if progress.done == progress.total:
            figures = "mapping the first frame"
        self._bar.update(self._task, total=progress.total, completed=progress.done, figures=figures)

    def frame(self, progress: Progress) -> None:
        """See `Observer`."""
        now = time.monotonic()
        end = now + progress.seconds_left if progress.seconds_left else None
        self._show(total=progress.total, completed=progress.done, figures=_figures(progress), end=end)
        if progress.done == progress.total and now - self._refreshed > _REFRESH:
            self._refreshed = now
            self._bar.refresh()  # before the stages that follow take its place

    def stage(self, name: str) -> None:
        """See `Observer`."""
        if self._task is not None:
            self._show(figures=name)
            self._bar.refresh()

    def _show(self, **fields: Any) -> None:
        self._bar.update(self._task, **fields)


def _figures(progress: Progress) -> str:
    result = progress.result
    parts = [f"{progress.fps:.2f} fps"]
    if progress.ate_rmse is not None:
        parts.append(f"ATE {100 * progress.ate_rmse:.2f} cm")
    if result.status != FrameStatus.OK:
        parts.append(result.status)
    return "  ".join(parts)


@contextmanager
def working(what: str) -> Iterator[Advance]:
    """Show on standard error that something is going on, once it takes longer than two seconds.

    Args:
        what: Such as "rendering".

    Returns:
        What may be called with (done, total); the time left follows from it.
    """
    state = _Work(what)
    timer = threading.Timer(_QUIET_SECONDS, state.show)
    timer.daemon = True
    timer.start()
    try:
        yield state.advance
    finally:
        timer.cancel()
        state.end()


class _Work:
    """A piece of work, shown by one line: rewritten on a terminal, printed now and then elsewhere."""

    def __init__(self, what: str) -> None:
        self._what, self._start = what, time.monotonic()
        self._lock = threading.Lock()
        self._is_shown, self._is_over = False, False
        self._done, self._total = 0, 0
        self._last_part = -1
        self._is_terminal = sys.stderr.isatty()

    def advance(self, done: int, total: int) -> None:
        """So much is done."""
        with self._lock:
            self._done, self._total = done, total
            part = _UPDATES * done // max(total, 1)
            if self._is_shown and (self._is_terminal or part > self._last_part):
                self._last_part = part
                self._print()

    def show(self) -> None:
        """From now on it is seen."""
        with self._lock:
            if not self._is_over:
                self._is_shown = True
                self._print()

    def end(self) -> None:
        """It is done: the line on a terminal goes."""
        with self._lock:
            self._is_over = True
            if self._is_shown and self._is_terminal:
                print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    def _print(self) -> None:
        text = self._what
        if self._done:
            seconds = (time.monotonic() - self._start) * (self._total - self._done) / self._done
            text += f" {self._done}/{self._total}, {duration(seconds)} left"
        else:
            text += " ..."
        line = f"\r{text[:79]}\x1b[K" if self._is_terminal else f"{text}\n"
        print(line, end="", file=sys.stderr, flush=True)
