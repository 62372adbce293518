"""What a machine with a GPU is asked, step by step. `check.sh` starts it; a step alone: check.py STEP --out FOLDER.

Every step prints what it does and returns figures, which the parent collects in figures.json after each step. Steps, in
the order of what they tell:

    info      GPU, driver, versions, memory
    compile   load every module: from the kernel cache that came along, or compiled side by side; seconds of each
    smoke     a launch, a fill, a copy, vector atomics, the tape, a captured graph
    parity    the kernel tests on the GPU: recorded vectors, torch oracle, finite differences
    replica   frames a second and peak memory of the whole system, 1200x680: `REPLICA_RUNS`
    phases    the phases of tools/benchmarks/iterations.py against the same in torch on the same GPU
    slam      tests of the engine with every Slam on the GPU
    kernels   time of each kernel of an iteration alone, at several block sizes; launches and graph replays
    demo      the demo on the GPU and on the CPU: trajectory, mesh, frames a second
    repeat    whether two runs are equal, and by how much they are not
    profile   kernel table of `warpslam profile`
    ncu       hardware counters of the heaviest kernels
    memcheck  a small run under compute-sanitizer
    fresh     seconds to compile the two slowest modules with an empty cache

The file runs where it lies and as a copy elsewhere, with `check_kernels` and `on_cuda` beside it and the checkout as
the working directory. `kernels` and `phases` look into the engine's privates, which have no public counterpart.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

Figures = dict[str, Any]

HERE = Path(__file__).resolve().parent
SITE = Path(os.environ.get("SITE", "/tmp/site"))
# A rehearsal without a GPU: CHECK_SMALL=1 CHECK_DEVICE=cpu, and CHECK_SLOW=5 for limits five times as long.
SMALL, SLOW = bool(os.environ.get("CHECK_SMALL")), float(os.environ.get("CHECK_SLOW", "1"))
WARPSLAM = [sys.executable, "-c", "import sys; from warpslam.cli import entry_point; sys.exit(entry_point())"]
REPLICA_RUNS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("replica", ()),
    ("paper_replica", ()),
    ("replica", ("schedule=overlapped",)),
)
"""Presets, and settings other than theirs, of the step `replica`."""
KERNEL_TESTS = ("tests/kernels", "tests/scene/test_optimizers.py", "tests/scene/test_scene.py")
NOT_ON_A_DEVICE = ("tests/kernels/test_cuda_compile.py", "tests/kernels/test_cuda_source.py")
ENGINE_TESTS = (
    "tests/test_slam.py",
    "tests/test_slam_state.py",
    "tests/mapping/test_mapper.py",
    "tests/mapping/test_refinement.py",
    "tests/tracking/test_localizer.py",
    # Of the schedules' tests only those that need no thread of the mapper's own.
    "tests/mapping/test_scheduler.py::test_waiting_after_every_frame_equals_strict",
    "tests/mapping/test_scheduler.py::test_finish_leaves_no_thread_and_maps_the_last_frame",
)


def say(*what: object) -> None:
    """Print at once."""
    print(*what, flush=True)


def quiet() -> None:
    """Keep Warp's lines about modules out of the log."""
    import warp as wp

    wp.config.log_level = 30


# -- what there is -----------------------------------------------------------------------------------------------------


def info(device: str) -> Figures:
    """GPU, driver, versions, memory."""
    import numpy
    import torch
    import warp as wp

    wp.init()
    d = wp.get_device(device)
    result: Figures = {
        "nvidia_smi": _nvidia_smi(), "python": sys.version.split()[0], "numpy": numpy.__version__,
        "torch": torch.__version__, "warp": wp.config.version, "device": d.name, "cores": len(os.sched_getaffinity(0)),
        "cuda_toolkit_of_warp": wp.get_cuda_toolkit_version(), "cuda_driver": wp.get_cuda_driver_version(),
    }  # fmt: skip
    if d.is_cuda:
        result |= {
            "arch": d.arch, "sm_count": d.sm_count, "mempool": d.is_mempool_enabled, "free_gb": d.free_memory / 1e9,
            "output": d.get_cuda_output_format(), "architectures": list(wp.get_cuda_supported_archs()),
        }  # fmt: skip
        result["torch_sees"] = torch.cuda.get_device_name(torch.zeros(1, device="cuda").device)
    return result


def _nvidia_smi() -> str:
    if not shutil.which("nvidia-smi"):
        return ""
    say(subprocess.run(["nvidia-smi"], capture_output=True, text=True).stdout)
    fields = "name,driver_version,memory.total,memory.used,clocks.sm,clocks.mem,clocks.max.sm,power.limit"
    command = ["nvidia-smi", f"--query-gpu={fields},ecc.mode.current", "--format=csv,noheader"]
    return subprocess.run(command, capture_output=True, text=True).stdout.strip()


# -- kernels: loading, launching, correctness --------------------------------------------------------------------------

_LOAD = """
import json, sys, time
from pathlib import Path
t0 = time.perf_counter()
import warp as wp
wp.config.log_level = 30
from warpslam.runtime.compilation import find_module
name, device = sys.argv[1:]
module, d = find_module(name), wp.get_device(device)
identity = module.get_module_identifier() if d.is_cuda else module.get_module_identifier(block_dim=1)
cached = any(Path(wp.config.kernel_cache_dir, identity).glob("*"))
t1 = time.perf_counter()
wp.force_load(d, [module], max_workers=0)
print("RESULT", json.dumps({"seconds": time.perf_counter() - t1, "import_seconds": t1 - t0, "cached": cached}))
"""


def compile_(device: str) -> Figures:
    """Each module in a process of its own, so that compiling uses all cores."""
    from warpslam.runtime.compilation import module_names
    from warpslam.synthetic import RenderedSequence

    _bring_cache()
    target = "cpu" if device == "cpu" else "cuda"
    baseline = (f"warpslam.imap_{target}", "warpslam.kernels.imap_density")
    names = [*module_names(target), *RenderedSequence.warp_modules, *baseline]

    def one(name: str) -> Figures:
        done = subprocess.run([sys.executable, "-c", _LOAD, name, device], capture_output=True, text=True)
        found = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
        result = json.loads(found[-1][7:]) if found else {"error": (done.stderr or done.stdout)[-1500:]}
        say(name, result)
        return result

    start = time.perf_counter()
    with ThreadPoolExecutor(min(len(names), os.cpu_count() or 1)) as pool:
        modules = dict(zip(names, pool.map(one, names), strict=True))
    return {"modules": modules, "wall_seconds": time.perf_counter() - start}


def _bring_cache() -> None:
    """Kernels that were compiled beforehand, if they came along."""
    carried, cache = SITE / "extra" / "kernel_cache.tar", Path(os.environ["WARP_CACHE_PATH"])
    if carried.is_file() and not cache.exists():
        cache.mkdir(parents=True)
        subprocess.run(["tar", "-xf", str(carried), "-C", str(cache)], check=True)


def smoke(device: str) -> Figures:
    """Whether the simplest things work: "ok" or a figure of each, or how it failed."""
    import numpy as np
    import warp as wp
    from check_kernels import add_rows, scale, total

    from warpslam.kernels.grid import Vec32
    from warpslam.runtime.launching import Launcher

    quiet()
    d = wp.get_device(device)
    n = 100_000
    x = wp.array(np.arange(n, dtype=np.float32), device=d)
    rows = wp.zeros(4, dtype=Vec32, device=d)
    y = wp.zeros(n, dtype=float, device=d, requires_grad=True)
    loss = wp.zeros(1, dtype=float, device=d, requires_grad=True)

    def launch() -> None:
        wp.launch(scale, n, [x, 2.0], [y], device=d)
        assert y.numpy()[-1] == 2.0 * (n - 1)

    def atomics() -> None:
        wp.launch(add_rows, n, [rows], device=d)
        assert (rows.numpy() == n / 4).all(), rows.numpy()

    def tape() -> None:
        launcher = Launcher(d)
        with launcher.tape() as recorded:
            launcher.launch_taped(total, n, [y], [loss])
        recorded.backward(loss)
        assert (y.grad.numpy() == 1.0).all()

    def graph() -> Figures:
        launcher, runs = Launcher(d), 50

        commands = [launcher.command(scale, n, [x, 3.0, y]) for _ in range(20)]

        def iterate() -> None:
            launcher.call(loss.zero_)
            for command in commands:
                launcher.call(command.launch)

        def microseconds_a_node(function: Callable[[], object]) -> float:
            wp.synchronize_device(d)
            start = time.perf_counter()
            for _ in range(runs):
                function()
            wp.synchronize_device(d)
            return 1e6 * (time.perf_counter() - start) / runs / 21

        for _ in range(3):
            launcher.iterate("a", (), iterate)
        in_graph = microseconds_a_node(lambda: launcher.iterate("a", (), iterate))
        launched = microseconds_a_node(iterate)
        assert y.numpy()[-1] == 3.0 * (n - 1)
        return {"us_a_node_in_graph": in_graph, "us_a_launch": launched}

    def readback() -> Figures:
        start = time.perf_counter()
        for _ in range(200):
            loss.numpy()
        return {"us_numpy_of_one_float": 1e6 * (time.perf_counter() - start) / 200}

    def upload() -> Figures:
        image = np.zeros((680, 1200, 3), np.uint8)
        target = wp.zeros((680, 1200, 3), dtype=wp.uint8, device=d)
        wp.synchronize()
        start = time.perf_counter()
        for _ in range(50):
            target.assign(image)
        wp.synchronize()
        return {"ms_upload_of_a_colour_image": 1e3 * (time.perf_counter() - start) / 50}

    result: Figures = {}
    for name, function in (
        ("launch", launch), ("atomics", atomics), ("tape", tape), ("graph", graph), ("readback", readback),
        ("upload", upload),
    ):  # fmt: skip
        try:
            result[name] = function() or "ok"
        except Exception as error:
            result[name] = f"FAILED {type(error).__name__}: {error}"
        say(name, result[name])
    return result


def parity(device: str, out: Path) -> Figures:
    """The kernel tests, for the device alone."""
    return _pytest(
        [*KERNEL_TESTS, *(f"--ignore={path}" for path in NOT_ON_A_DEVICE), "-k", device], device, out, "parity"
    )


def slam(device: str, out: Path) -> Figures:
    """The engine's tests; those that ask for equal bytes fail while sums are formed by atomics."""
    return _pytest(["-p", "on_cuda", *ENGINE_TESTS], device, out, "slam")


def _pytest(arguments: Sequence[str], device: str, out: Path, name: str) -> Figures:
    """Run pytest; counts and, of every test that failed, the last line of its error."""
    report = out / f"{name}.xml"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--tb=short", "-ra"]
    command.append(f"--junitxml={report}")
    if importlib.util.find_spec("pytest_timeout") is not None:
        command.append("--timeout=30")
    golden = SITE / "extra" / "reference_vectors.npz"
    environment = {**os.environ, "CHECK_DEVICE": device}
    if golden.exists():
        environment["WARPSLAM_GOLDEN"] = str(golden)
    start = time.perf_counter()
    last = ""
    with subprocess.Popen(
        [*command, *arguments], env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            last = line.rstrip()
            say(last)
    failed: dict[str, str] = {}
    if report.exists():
        for case in ElementTree.parse(report).getroot().iter("testcase"):
            for fault in (case.find("failure"), case.find("error")):
                if fault is not None:
                    failed[f"{case.get('classname')}::{case.get('name')}"] = (fault.get("message") or "")[:300]
        report.unlink()
    return {"seconds": time.perf_counter() - start, "summary": last, "failed": failed}


# -- the whole system --------------------------------------------------------------------------------------------------


def _room(count: int, width: int, device: str, *, seed: int = 1, path: int | None = None) -> tuple[Any, list[Any]]:
    """The camera of Replica, ``width`` pixels wide, and frames of a rendered room."""
    from warpslam.camera import Intrinsics
    from warpslam.synthetic import SyntheticSequence

    s = width / 1200
    camera = Intrinsics(600 * s, 600 * s, 599.5 * s, 339.5 * s, width, round(680 * s))
    sequence = SyntheticSequence(seed, path or 10 * count, intrinsics=camera, device=device)
    return camera, [sequence[n] for n in range(count)]


def _slam_over(camera: Any, frames: list[Any], preset: str, overrides: Sequence[str], device: str) -> Any:
    """An engine that has made its way over the frames, the first of them with its true pose."""
    from warpslam.config import Config
    from warpslam.slam import Slam

    engine = Slam(camera, Config.from_preset(preset, list(overrides)), device)
    for n, frame in enumerate(frames):
        engine.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera if n == 0 else None)
    return engine


def replica(device: str) -> Figures:
    """Time, error and memory of `REPLICA_RUNS` on a rendered room of Replica's image size."""
    quiet()
    start = time.perf_counter()
    count = 9 if SMALL else 41
    camera, frames = _room(count, 300 if SMALL else 1200, device, path=400)
    result: Figures = {"render_s": time.perf_counter() - start, "frames": count, "size": [camera.width, camera.height]}
    small = ("tracking.ignore_edge_u=10", "tracking.ignore_edge_v=10", "mapping.first_iterations=40") if SMALL else ()
    for preset, overrides in REPLICA_RUNS:
        name = " ".join([preset, *overrides])
        result[name] = _timed_run(camera, frames, preset, (*overrides, *small), device)
        say(name, {key: value for key, value in result[name].items() if key != "frame_ms"})
        say(f"{name}: peak device memory {result[name].get('peak_device_mb', 'unknown (no GPU)')} MB")
        _keep(result)
    return result


def _timed_run(camera: Any, frames: list[Any], preset: str, overrides: Sequence[str], device: str) -> Figures:
    import numpy as np
    import warp as wp

    from warpslam.config import Config
    from warpslam.evaluation import ate
    from warpslam.slam import Slam

    engine = Slam(camera, Config.from_preset(preset, list(overrides)), device)
    seconds, results, used = [], [], [0]
    for n, frame in enumerate(frames):
        start = time.perf_counter()
        results.append(engine.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera if n == 0 else None))
        wp.synchronize_device(engine.device)
        seconds.append(time.perf_counter() - start)
        if engine.device.is_cuda:
            used.append(wp.get_mempool_used_mem_current(engine.device))
    start = time.perf_counter()
    engine.finish()
    finish = time.perf_counter() - start
    phases: dict[str, list[float]] = defaultdict(list)
    for result in results[1:]:
        for phase, value in result.timings.items():
            phases[phase].append(value)
    every = engine.config.mapping.every
    tracked = [s for n, s in enumerate(seconds) if n > 1 and n % every]
    mapped = [s for n, s in enumerate(seconds) if n > 1 and n % every == 0]
    truth = np.array([frame.T_world_camera for frame in frames])
    figures: Figures = {
        "first_frame_s": seconds[0],
        "frames_a_second": (len(frames) - 1) / sum(seconds[1:]),
        "tracked_frame_ms": 1e3 * float(np.median(tracked)) if tracked else None,
        "mapped_frame_ms": 1e3 * float(np.median(mapped)) if mapped else None,
        "phase_ms": {phase: 1e3 * float(np.median(values)) for phase, values in phases.items()},
        "finish_s": finish,
        "not_ok": sum(str(result.status) != "OK" for result in results),
        "ate_cm": 100 * ate(engine.trajectory.poses, truth).rmse,
        "depth_error_mm": 1e3 * float(np.median([result.depth_error for result in results[1:]])),
        "frame_ms": [round(1e3 * s, 2) for s in seconds],
    }
    if engine.device.is_cuda:
        # The pool's own mark is the highest of the process, so of an earlier run too; between frames it is this run's.
        figures["peak_device_mb"] = wp.get_mempool_used_mem_high(engine.device) / 1e6
        figures["peak_device_mb_between_frames"] = max(used) / 1e6
        figures["used_on_card_mb"] = (engine.device.total_memory - engine.device.free_memory) / 1e6
    return figures


def phases(device: str, repeats: int = 3) -> Figures:
    """tools/benchmarks/iterations.py with torch on the same device; the share of launching is left out."""
    import numpy as np
    import torch
    import warp as wp

    quiet()
    on_gpu = device != "cpu"
    if on_gpu:
        torch.set_default_device("cuda")
        from_numpy = torch.from_numpy
        torch.from_numpy = lambda array: from_numpy(array).cuda()
    from tools.benchmarks import iterations
    from warpslam.synthetic import SyntheticSequence

    wp.set_device(device)
    ours = iterations.Ours(SyntheticSequence(1_000_000, 40, intrinsics=iterations.CAMERA), [])

    def finish() -> None:
        if on_gpu:
            torch.cuda.synchronize()
            wp.synchronize()

    def milliseconds(function: Callable[[], object], count: int) -> float | str:
        """Median of a call after one that is not counted, or how it failed."""
        try:
            function()
            finish()
            times = []
            for _ in range(repeats):
                start = time.perf_counter()
                function()
                finish()
                times.append(time.perf_counter() - start)
            return 1e3 * float(np.median(times)) / count
        except Exception as error:
            return f"FAILED {type(error).__name__}: {error}"

    result: Figures = {}
    for name, phase in iterations.phases_of(ours).items():
        result[name] = {
            "warpslam_ms": milliseconds(phase.ours, phase.count),
            "torch_ms": milliseconds(phase.theirs, phase.count),
        }
        say(name, result[name])
        _keep(result)
    return result


# -- each kernel alone -------------------------------------------------------------------------------------------------


class Stopwatch:
    """Microseconds of a call: between two events on a GPU, by the wall clock elsewhere."""

    def __init__(self, device: Any) -> None:
        import warp as wp

        self._events = [wp.Event(device, enable_timing=True) for _ in range(2)] if device.is_cuda else []

    def __call__(self, function: Callable[[], object]) -> float:
        """Run the function once."""
        import warp as wp

        if not self._events:
            start = time.perf_counter()
            function()
            return 1e6 * (time.perf_counter() - start)
        wp.record_event(self._events[0])
        function()
        wp.record_event(self._events[1])
        wp.synchronize_event(self._events[1])
        return 1e3 * wp.get_event_elapsed_time(*self._events)


def kernels(device: str, repeats: int = 10) -> Figures:
    """Each launch of an iteration between events; the decoders' also at other block sizes; whole graphs."""
    import numpy as np
    import warp as wp

    quiet()
    camera, frames = _room(8, 150 if SMALL else 600, device, path=80)
    settings = ["mapping.every=1", "keyframes.every=2", "mapping.first_iterations=200"]
    if SMALL:
        settings += ["tracking.ignore_edge_u=5", "tracking.ignore_edge_v=5"]
    by_rendering = [*settings, "tracking.optimizer=gauss_newton"]
    engine = _slam_over(camera, frames, "rendering", by_rendering, device)
    tracker, mapper = engine.tracker, engine.mapper
    direct = _slam_over(camera, frames[:4], "default", settings, device)
    result: Figures = {}
    for name, part, kind in (
        ("tracking iteration", tracker, "optimize"),
        ("judging a pose", tracker, "judge"),
        *((f"mapping iteration, {stage}", mapper, stage) for stage in ("middle", "fine", "color", "coarse")),
        ("mapping iteration, direct loss", direct.mapper, "direct"),
    ):
        if kind not in part._launcher._kinds:
            result[name] = f"no record of {kind}"
            continue
        program = part._launcher._kinds[kind][1]
        result[name] = figures = examine(program, part._batch, repeats)
        say(name, {key: value for key, value in figures.items() if key != "rows"})
        for row in sorted(figures["rows"], key=lambda row: -row["us"])[:12]:
            say("   ", row)
        _keep(result)
    for label, (function, count) in engine_calls(engine, 7, frames[7]).items():
        times = []
        for _ in range(count):
            start = time.perf_counter()
            function()
            wp.synchronize_device(engine.device)
            times.append(time.perf_counter() - start)
        result[label] = 1e3 * float(np.median(times))
        say(label, result[label])
    return result


def engine_calls(engine: Any, index: int, frame: Any) -> dict[str, tuple[Callable[[], object], int]]:
    """Calls of the engine's parts on its last frame, and how often to time each."""

    images, pose = engine.images, engine.history.pose(index)
    return {
        "mapping call ms": (lambda: engine.mapper.start_frame(images, index, pose, engine.keyframes)(), 3),
        "track ms": (lambda: engine.tracker.track(engine.scene.arrays(), images, index, frame.T_world_camera), 10),
        "set image ms": (lambda: images.set(0, frame.rgb, frame.depth), 10),
        "keyframe image ms": (images.keep_current, 3),
    }


def examine(program: Any, batch: Any, repeats: int) -> Figures:
    """Time the launches of a recorded iteration, each alone and on CUDA as one graph.

    Args:
        program: The record, a `warpslam.runtime.program.Program`.
        batch: Rays it works on, a `warpslam.field.ray_batch.RayBatch`.
        repeats: Times are medians of so many.
    """
    import numpy as np
    import warp as wp

    device = program.device
    stopwatch, original = Stopwatch(device), wp.Launch.launch
    commands: list[Any] = []
    times: list[list[float]] = []

    def note(command: Any, stream: Any = None) -> None:
        times[-1].append(stopwatch(lambda: original(command, stream)))
        if len(times) == 1:
            commands.append(command)

    # In their order, because lists and counters must be as an iteration leaves them; and always the same iteration.
    # The adjoints of the loss and of casting rays are bound to the original method, and left out.
    wp.Launch.launch = note
    try:
        for _ in range(repeats + 1):
            batch.iteration.zero_()
            times.append([])
            for step in program._steps:
                owner = getattr(step, "__self__", None)
                owner.launch() if isinstance(owner, wp.Launch) else step()
    finally:
        wp.Launch.launch = original
    medians = np.median(np.array(times[1:]), axis=0)
    rows = []
    for command, us in zip(commands, medians, strict=True):
        label = command.kernel.key + (" (adjoint)" if command.adjoint else "")
        rows.append({"kernel": label, "threads": int(command.bounds.size), "us": round(float(us), 2)})
    figures: Figures = {
        "launches": len(commands),
        "steps": len(program._steps),
        "sum_us": round(float(medians.sum()), 1),
    }
    if device.is_cuda:
        with wp.ScopedCapture(device) as capture:
            batch.iteration.zero_()
            program._replay()
        wp.capture_launch(capture.graph)
        us = [stopwatch(partial(wp.capture_launch, capture.graph)) for _ in range(repeats)]
        figures["graph_us"] = round(float(np.median(us)), 1)
    return {**figures, "rows": rows}


# -- commands and other tools ------------------------------------------------------------------------------------------


def demo(device: str) -> Figures:
    """The demo on the GPU, and beside it on half of the cores."""
    runs: Figures = {}

    def one(where: str) -> None:
        with tempfile.TemporaryDirectory() as folder:
            command = [*WARPSLAM, "demo", "--device", where, "-o", folder]
            if where == "cpu" and device != "cpu" and shutil.which("taskset") and (os.cpu_count() or 1) >= 16:
                command = ["taskset", "-c", "8-15", *command]
            start = time.perf_counter()
            done = subprocess.run(command, capture_output=True, text=True)
            figures: Figures = {"wall_s": time.perf_counter() - start, "exit": done.returncode}
            for metrics in sorted(Path(folder).rglob("metrics.json"))[:1]:
                figures["metrics"] = json.loads(metrics.read_text())
        if done.returncode:
            figures["error"] = (done.stderr or done.stdout)[-1500:]
        runs[where] = figures
        say(where, json.dumps(figures)[:1500])

    threads = [threading.Thread(target=one, args=(where,)) for where in dict.fromkeys((device, "cpu"))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return runs


def repeat(device: str) -> Figures:
    """Largest differences between two runs on the same frames."""
    import numpy as np

    quiet()
    camera, frames = _room(8, 300, device, path=80)
    overrides = [
        "mapping.first_iterations=100",
        "mapping.every=2",
        "tracking.ignore_edge_u=10",
        "tracking.ignore_edge_v=10",
    ]
    a, b = (_slam_over(camera, frames, "default", overrides, device) for _ in range(2))
    difference: Figures = {"poses": float(np.abs(a.trajectory.poses - b.trajectory.poses).max())}
    for level in a.scene.grids:
        x, y = (run.scene.grids[level].state().features for run in (a, b))
        difference[level] = float(np.abs(x - y).max()) if x.shape == y.shape else f"shapes {x.shape} {y.shape}"
    return {**difference, "equal": all(value == 0.0 for value in difference.values())}


def profile(device: str, out: Path) -> Figures:
    """`warpslam profile`; its figures are left in profile.json."""
    command = [*WARPSLAM, "profile", "demo", "--frames", "0:11", "--no-mesh", "--device", device]
    done = subprocess.run([*command, "--json", str(out / "profile.json")], capture_output=True, text=True)
    say(done.stdout[-9000:], done.stderr[-2000:])
    return {"exit": done.returncode}


_NCU_METRICS = (
    "gpu__time_duration.sum", "launch__registers_per_thread", "launch__block_size", "launch__grid_size",
    "sm__warps_active.avg.pct_of_peak_sustained_active", "sm__inst_executed.sum",
    "sm__throughput.avg.pct_of_peak_sustained_elapsed", "sm__sass_thread_inst_executed_op_ffma_pred_on.sum",
    "l1tex__throughput.avg.pct_of_peak_sustained_elapsed", "lts__throughput.avg.pct_of_peak_sustained_elapsed",
    "dram__bytes.sum", "smsp__inst_executed_op_global_ld.sum", "smsp__inst_executed_op_local_ld.sum",
    "smsp__issue_active.avg.pct_of_peak_sustained_active",
)  # fmt: skip
_NCU_KERNELS = (
    "middle_forward", "fine_forward", "geometry_backward", "color_forward", "color_backward", "color_weights",
    "composite", "gauss_newton",
)  # fmt: skip


def ncu(device: str, out: Path) -> Figures:
    """Hardware counters by Nsight Compute, left in ncu.csv."""
    tool = shutil.which("ncu")
    if tool is None:
        return {"skipped": "no ncu on the PATH"}
    command = [tool, "--clock-control", "none", "--target-processes", "all", "-c", "60", "--csv"]
    command += ["-k", f"regex:^({'|'.join(_NCU_KERNELS)})", "--metrics", ",".join(_NCU_METRICS)]
    done = subprocess.run([*command, *_step("_small", device, out)], capture_output=True, text=True)
    (out / "ncu.csv").write_text(done.stdout)
    say(done.stderr[-1500:])
    say("\n".join(done.stdout.splitlines()[-40:]))
    return {"exit": done.returncode, "lines": len(done.stdout.splitlines())}


def memcheck(device: str, out: Path) -> Figures:
    """What compute-sanitizer finds."""
    tool = shutil.which("compute-sanitizer")
    if tool is None:
        return {"skipped": "no compute-sanitizer on the PATH"}
    result: Figures = {}
    for kind in ("memcheck", "racecheck", "initcheck"):
        command = [tool, "--tool", kind, "--print-limit", "20", *_step("_small", device, out)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        except subprocess.TimeoutExpired:
            result[kind] = "60 s were not enough"
            break
        lines = [line for line in (done.stdout + done.stderr).splitlines() if line.startswith("=========")]
        say("\n".join(lines[:60]))
        result[kind] = lines[-1] if lines else f"exit {done.returncode}: {done.stderr[-300:]}"
        _keep(result)
    return result


def small(device: str) -> Figures:
    """A few iterations of everything, for tools that make a program slow."""
    quiet()
    camera, frames = _room(3, 300, device, path=80)
    overrides = [
        "mapping.first_iterations=4", "mapping.iterations=4", "mapping.coarse_iterations=2", "mapping.every=1",
        "tracking.iterations=2", "keyframes.every=1", "mapping.bundle_adjustment_keyframes=2",
        "tracking.ignore_edge_u=10", "tracking.ignore_edge_v=10", "tracking.relocalization=false",
    ]  # fmt: skip
    for optimizer in ("gauss_newton", "adam"):
        _slam_over(camera, frames, "default", [*overrides, f"tracking.optimizer={optimizer}"], device)
    return {"ok": True}


def fresh(device: str) -> Figures:
    """Seconds to compile from nothing what takes longest."""
    import warp as wp

    from warpslam.runtime.compilation import find_module, module_names

    quiet()
    result: Figures = {}
    with tempfile.TemporaryDirectory() as cache:
        wp.config.kernel_cache_dir = cache
        for name in module_names("cpu" if device == "cpu" else "cuda")[:2]:
            start = time.perf_counter()
            wp.force_load(wp.get_device(device), [find_module(name)], max_workers=0)
            result[name] = time.perf_counter() - start
            say(name, result[name])
            _keep(result)
    return result


# -- running them ------------------------------------------------------------------------------------------------------


class Step(NamedTuple):
    """A step of the check."""

    run: Callable[..., Figures]
    """Called with the device and, with ``has_files``, the folder of the results."""
    limit: int
    """What it may take [s]."""
    has_files: bool = False
    """Whether it leaves files besides its figures, or needs a place for them."""


STEPS = {
    "info": Step(info, 30),
    "compile": Step(compile_, 120),
    "smoke": Step(smoke, 60),
    "parity": Step(parity, 90, has_files=True),
    "replica": Step(replica, 100),
    "phases": Step(phases, 90),
    "slam": Step(slam, 90, has_files=True),
    "kernels": Step(kernels, 60),
    "demo": Step(demo, 90),
    "repeat": Step(repeat, 40),
    "profile": Step(profile, 60, has_files=True),
    "ncu": Step(ncu, 80, has_files=True),
    "memcheck": Step(memcheck, 80, has_files=True),
    "fresh": Step(fresh, 90),
}
"""In the order in which they run, the most telling first."""
_PARTS = {**STEPS, "_small": Step(small, 60)}

_partial: Path | None = None


def _keep(figures: Figures) -> None:
    """Leave figures of a step that is not over yet, in case it does not end."""
    if _partial is not None:
        _partial.write_text(json.dumps(figures, default=str))


def run_all(out: Path, device: str, budget: float, wanted: Sequence[str]) -> int:
    """Run the steps that are wanted (all, if none is named) while there is time.

    Args:
        out: Folder of figures.json and log.txt.
        device: Warp device.
        budget: What all may take together [s].
        wanted: Names of steps.
    """
    begun = time.monotonic()
    figures: Figures = {}
    with (out / "log.txt").open("a", buffering=1) as log:

        def tell(text: str) -> None:
            say(text)
            log.write(text + "\n")

        for name in wanted or STEPS:
            left = budget - (time.monotonic() - begun)
            if left < 10:
                figures[name] = {"skipped": "no time left"}
                tell(f"== {name}: skipped, {left:.0f} s left")
                continue
            limit = min(SLOW * STEPS[name].limit, left - 2)
            tell(f"== {name} (at {time.monotonic() - begun:.0f} s, limit {limit:.0f} s)")
            figures[name] = _run_step(name, device, out, limit, log.write)
            (out / "figures.json").write_text(json.dumps(figures, indent=1))
            tell(f"== {name}: exit {figures[name]['exit']}, {figures[name]['step_seconds']} s")
        (out / "figures.json").write_text(json.dumps(figures, indent=1))
        tell("== summary")
        for name, result in figures.items():
            tell(f"{name}: {json.dumps(_short(result))[:700]}")
    return 0


def _run_step(name: str, device: str, out: Path, limit: float, write: Callable[[str], object]) -> Figures:
    """One step in a process group of its own, which is ended at the limit."""
    partial = out / f".{name}.json"
    partial.unlink(missing_ok=True)
    start = time.monotonic()
    process = subprocess.Popen(
        _step(name, device, out), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    timer = threading.Timer(limit, os.killpg, (process.pid, signal.SIGKILL))
    timer.start()
    assert process.stdout is not None
    for line in process.stdout:
        write(line)
        if len(line) < 400 and not re.match(r"\s*$", line):
            say("  ", line.rstrip())
    code = process.wait()
    timer.cancel()
    result = json.loads(partial.read_text()) if partial.exists() else {}
    partial.unlink(missing_ok=True)
    return {"exit": code, "step_seconds": round(time.monotonic() - start, 1), **result}


def _step(name: str, device: str, out: Path) -> list[str]:
    return [sys.executable, str(HERE / "check.py"), name, "--device", device, "--out", str(out)]


def _short(result: Figures) -> Figures:
    """What fits a line: no long lists."""
    return {
        key: (_short(value) if isinstance(value, dict) else value)
        for key, value in result.items()
        if not (isinstance(value, list) and len(value) > 4)
    }


def main() -> int:
    """Parse the command line and run a step, or all."""
    global _partial
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=["all", *_PARTS])
    parser.add_argument("steps", nargs="*", metavar="STEP", help="with all: only these")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--budget", type=float, default=330.0, help="seconds in all")
    parser.add_argument("--device", default=os.environ.get("CHECK_DEVICE", "cuda:0"))
    options = parser.parse_args()
    unknown = [name for name in options.steps if name not in STEPS]
    if unknown:
        parser.error(f"no step {', '.join(unknown)}: choose from {', '.join(STEPS)}")
    options.out.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("WARP_CACHE_PATH", "/tmp/warp-cache")
    if options.step == "all":
        return run_all(options.out, options.device, options.budget, options.steps)
    _partial = options.out / f".{options.step}.json"
    step = _PARTS[options.step]
    _keep(step.run(options.device, options.out) if step.has_files else step.run(options.device))
    return 0


if __name__ == "__main__":
    sys.exit(main())
