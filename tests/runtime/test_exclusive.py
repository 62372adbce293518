"""One user of an object at a time: threads wait for one another, a forked process works or is told."""

import multiprocessing
import os
import signal
import threading
import time

import numpy as np
import pytest
import warp as wp

from warpslam import cli
from warpslam.errors import InputError
from warpslam.runtime.exclusive import ObjectLock, exclusive
from warpslam.runtime.program import run_slices
from warpslam.runtime.stopping import Deferral, Terminated, terminable, was_terminated


class Counter:
    def __init__(self) -> None:
        self.lock, self.inside, self.worst = ObjectLock(), 0, 0

    @exclusive
    def use(self, again: bool = True) -> None:
        self.inside += 1
        self.worst = max(self.worst, self.inside - (not again))
        time.sleep(0.001)
        if again:
            self.use(False)
        self.inside -= 1


def test_threads_wait_for_one_another():
    """Never two threads inside, however many there are; a method may call another one."""
    counter = Counter()
    threads = [threading.Thread(target=lambda: [counter.use() for _ in range(5)]) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
        assert not thread.is_alive()
    assert counter.worst == 1 and counter.inside == 0


def _in_child(work):
    queue = multiprocessing.get_context("fork").Queue()

    def run():
        try:
            queue.put(work())
        except Exception as error:
            queue.put(error)

    process = multiprocessing.get_context("fork").Process(target=run)
    process.start()
    result = queue.get(timeout=60)
    process.join(10)
    return result


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system knows no fork")
def test_a_forked_process_works_or_is_told():
    """An idle object may be used; one that was in use, or whose GPU stayed behind, raises."""
    assert _in_child(lambda: Counter().use()) is None
    counter = Counter()
    assert _in_child(lambda: counter.use()) is None
    with counter.lock:
        assert isinstance(_in_child(lambda: counter.use()), InputError)
    counter.lock.outlives_fork = False
    assert isinstance(_in_child(lambda: counter.use()), InputError)


@wp.kernel(enable_backward=False)
def fill(values: wp.array[float], value: float):
    values[wp.tid()] = value


def _filled(values: wp.array) -> float:
    commands = [[wp.launch(fill, 100, [values, float(n)], device="cpu", record_cmd=True)] for n in range(2)]
    for _ in range(50):
        run_slices(commands)
    return float(np.max(values.numpy()))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system knows no fork")
def test_slices_run_in_a_forked_process():
    """The threads of the parent are gone there; new ones take their place."""
    values = wp.zeros(100, dtype=float, device="cpu")
    _filled(values)
    assert 0.0 <= _in_child(lambda: _filled(values)) <= 1.0


def test_sigterm_is_an_interrupt_with_its_own_exit_code(monkeypatch, capsys):
    """It raises where ctrl-C would, and the command ends with 143 in place of 130; the handler before comes back."""
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt) as caught, terminable():
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)
    assert caught.type is Terminated and was_terminated() and signal.getsignal(signal.SIGTERM) is before

    def stopped(options) -> int:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)
        return 0

    class Parser:
        def parse_args(self, arguments):
            return type("Options", (), {"command": staticmethod(stopped), "debug": False})()

    monkeypatch.setattr(cli, "_parser", lambda arguments: Parser())
    assert cli.main([]) == 143
    assert "terminated" in capsys.readouterr().err


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_while_a_command_is_imported_is_a_line(ctrl_c, monkeypatch, capsys, number, code):
    """Importing a command takes seconds; to be stopped then is no traceback either."""

    def importing(arguments):
        os.kill(os.getpid(), number)
        time.sleep(5)

    monkeypatch.setattr(cli, "_parser", importing)
    assert cli.main([]) == code
    assert capsys.readouterr().err.count("\n") == 1


def test_the_first_signal_is_kept_back_and_the_second_is_not(ctrl_c):
    """Of both kinds, from `defer` on; afterwards the handlers are what they were."""
    with terminable():
        before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
        for number, error in ((signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)):
            with Deferral() as stopping:
                stopping.defer()
                assert not stopping.has_come
                os.kill(os.getpid(), number)
                time.sleep(0.01)
                assert stopping.has_come and was_terminated() == (number == signal.SIGTERM)
                stopping.defer()  # no more than one
                with pytest.raises(error):
                    os.kill(os.getpid(), number)
                    time.sleep(5)
            with pytest.raises(error), Deferral():
                os.kill(os.getpid(), number)  # it was never asked to
                time.sleep(5)
            assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
    work = threading.Thread(target=Deferral().defer)  # elsewhere no handler can be set
    work.start()
    work.join()


@pytest.mark.parametrize(
    "error", [RuntimeError("a\x1b[31m\nb"), MemoryError(), TypeError("x" * 5000), OSError(28, "No space")]
)
def test_no_traceback_at_the_command_line(error, monkeypatch, capsys):
    """Any error is one line of bounded length without control characters; --debug raises it."""

    def failing(options) -> int:
        raise error

    class Parser:
        debug = False

        def parse_args(self, arguments):
            return type("Options", (), {"command": staticmethod(failing), "debug": self.debug})()

    monkeypatch.setattr(cli, "_parser", lambda arguments: Parser())
    assert cli.main([]) in (2, 70)
    said = capsys.readouterr().err
    assert said.startswith("warpslam: ") and said.count("\n") == 1 and len(said) < 500 and "\x1b" not in said
    monkeypatch.setattr(Parser, "debug", True)
    with pytest.raises(type(error)):
        cli.main([])
