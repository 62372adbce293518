"""Profiles: what ran, what it computed, that the figures add up, and that nothing is left behind."""

from __future__ import annotations

import json
import re
import threading
from collections import Counter, namedtuple
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp
import warp._src.context as warp_context

import warpslam
from tests.test_slam import CAMERA, new_slam
from warpslam import cli
from warpslam.camera import Intrinsics
from warpslam.errors import WarpSlamError
from warpslam.field import passes
from warpslam.field.arrays import Gradients, Thresholds
from warpslam.field.passes import render
from warpslam.kernels import adam, compositing, gauss_newton, images
from warpslam.kernels import grid as grid_kernels
from warpslam.kernels.decoder.build import decoders_for
from warpslam.kernels.samples import Span
from warpslam.profiling import costs, recorder
from warpslam.runtime import launching, phases, program
from warpslam.runtime.phases import phase
from warpslam.synthetic import SyntheticSequence, demo

SETTINGS = ("tracking.optimizer=adam", "mapping.first_iterations=12", "mapping.iterations=6")
KERNELS = {
    "mark_seen", "drop_unseen",
    "fill_grid", "project_vertices", "select_vertices", "clear_moments", "draw_pixels", "cast_rays", "bound_rays",
    "probe_pixels", "accumulate_errors", "place_samples",
    "start_rays", "coarse_forward", "coarse_backward", "middle_forward", "fine_forward",
    "color_forward", "geometry_backward", "color_backward", "composite", "composite_color", "ray_variance",
    "list_weighty", "list_steep", "composite_backward", "collect_ray_gradients", "mapping_loss",
    "mapping_loss (adjoint)", "tracking_loss",
    "tracking_loss (adjoint)", "cast_rays (adjoint)", "tracking_residuals", "choose_inliers", "lower_median",
    "adam_rows", "adam_poses", "advance_step", "note_pose", "take_pose", "note_rays",
    "transpose_color_weights", "classify_points", "find_facing", "to_metres",
}  # fmt: skip
HOOKED = (
    (warp_context, "invoke"), (wp, "launch"), (wp.Launch, "launch"), (wp.Module, "load"), (program, "_pool"),
    (launching.Launcher, "iterate"), (program.Program, "run"),
)  # fmt: skip


@pytest.fixture(scope="module")
def frames():
    """Three frames of a furnished room."""
    sequence = SyntheticSequence(1, 8, intrinsics=CAMERA)
    return [sequence[n] for n in range(3)]


@pytest.fixture(autouse=True)
def quick_peak(monkeypatch):
    """The matrix product takes half a second, and its result is not looked at here."""
    monkeypatch.setattr(recorder, "matrix_peak_gflops", lambda: 100.0)


def steps(slam, frames):
    return [slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera) for frame in frames]


@pytest.fixture(scope="module")
def run(frames):
    """A run with two slices on any machine, profiled from the first frame to the mesh."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorder, "matrix_peak_gflops", lambda: 100.0)
        patch.setattr("warpslam.runtime.cores._core_count", lambda: 2)
        slam = new_slam(*SETTINGS, preset="rendering")
        with warpslam.profile() as profile:
            timings = [result.timings for result in steps(slam, frames)]
            timings.append(slam.finish())
            slam.mesh(voxel=0.1)
    return profile, timings, slam


def test_every_kernel_that_ran_appears(run):
    """Recorded, replayed, taped and direct launches are all there, generated adjoints under a name of their own."""
    profile, _, slam = run
    report = json.loads(profile.to_json())
    assert {row["kernel"] for row in report["kernels"]} == KERNELS
    calls = Counter()
    for row in report["kernels"]:
        calls[row["kernel"], row["phase"]] += row["calls"]
    tracking = slam.config.tracking.iterations * 2
    assert calls["note_pose", "tracking / optimize"] == tracking
    assert calls["geometry_backward", "tracking / optimize"] == 2 * 2 * tracking
    assert report["launches"] == sum(calls.values())
    phases_seen = {row["phase"] for row in report["phases"]}
    assert {
        f"mapping / {p}" for p in ("coarse", "middle", "fine", "color", "growth", "frustum selection")
    } < phases_seen
    assert {"mapping / keyframe selection", "tracking / judge", "refinement / color", "meshing"} < phases_seen


def test_phases_agree_with_the_clock(run):
    """Walls add up to the whole; the parts of each fit into it; tracking is what the frames say it took."""
    profile, timings, _ = run
    rows = profile.report.phases
    assert sum(row.wall for row in rows) == pytest.approx(profile.wall_seconds, rel=1e-6)
    for row in rows:
        parts = (row.kernels, row.launch, row.wait, row.load, row.profiler)
        assert min(parts) >= 0 and row.python > -1e-4 and sum(parts) + row.python == pytest.approx(row.wall)
    for name in ("tracking", "mapping", "refinement"):
        measured = sum(times.get(name, 0.0) for times in timings)
        profiled = sum(row.wall for row in rows if row.phase.split(" / ")[0] == name)
        assert profiled == pytest.approx(measured, rel=0.02, abs=0.005)
    kernels = sum(row.seconds for row in profile.report.kernels)
    assert kernels == pytest.approx(sum(row.kernels + row.elsewhere for row in rows))
    assert sum(row.share for row in profile.report.kernels) == pytest.approx(1.0)
    # Most of such a run is kernels; a hook that missed some would show here.
    busy = sum(row.kernels + row.launch + row.wait for row in rows)
    assert 0.4 * profile.wall_seconds < busy <= profile.wall_seconds


def test_rates_follow_from_points_and_time(run):
    """Decoder kernels have operations and a share of the peak, Adam has bytes, others neither."""
    rows = {(row.kernel, row.phase): row for row in run[0].report.kernels}
    fine = rows["fine_forward", "mapping / fine"]
    assert fine.counted and fine.points > 0
    assert fine.gflop == pytest.approx(fine.points * 40_961e-9)
    assert fine.gflops == pytest.approx(fine.gflop / fine.wall) and fine.peak_share == pytest.approx(fine.gflops / 100)
    assert 0.5 * fine.seconds <= fine.wall <= fine.seconds
    times = [1e3 * (x.stop - x.start) for x in run[0].launches if (x.kernel, x.path) == (fine.kernel, fine.phase)]
    assert fine.mean_ms == pytest.approx(np.mean(times)) and fine.p95_ms == pytest.approx(np.percentile(times, 95))
    adam = rows["adam_rows", "mapping / middle"]
    assert adam.gflop is None and adam.gigabytes_per_second == pytest.approx(adam.gigabytes / adam.wall)
    loss = rows["mapping_loss", "mapping / middle"]
    assert loss.points is None and loss.gflop is None and loss.gigabytes is None


def test_trace_shows_both_threads(run, tmp_path):
    """The trace is JSON of complete events with every field; kernels of a thread follow one another inside phases."""
    profile = run[0]
    profile.write_trace(tmp_path / "trace.json")
    trace = json.loads((tmp_path / "trace.json").read_text())
    events = [event for event in trace["traceEvents"] if event["ph"] == "X"]
    names = {event["tid"]: event["args"]["name"] for event in trace["traceEvents"] if event["ph"] == "M"}
    assert names[0] == "MainThread" and names[1].startswith("warpslam")
    for event in events:
        assert {"name", "cat", "ph", "pid", "tid", "ts", "dur"} <= event.keys()
        assert 0 <= event["ts"] and event["ts"] + event["dur"] <= 1e6 * profile.wall_seconds + 1
    kernels = [event for event in events if event["cat"] == "kernel"]
    assert len(kernels) == profile.report.launch_count
    assert all(min(event["args"]["dim"]) >= 0 for event in kernels)
    # The second slice may run on any thread of the pool.
    forward = [event["tid"] for event in kernels if event["name"] == "middle_forward"]
    assert forward.count(0) > 10 and len(forward) - forward.count(0) > 10
    for thread in names:
        own = [event for event in kernels if event["tid"] == thread]
        for before, after in zip(own, own[1:], strict=False):
            assert after["ts"] >= before["ts"] + before["dur"] - 0.01
    tracking = [event for event in events if event["cat"] == "phase" and event["name"] == "tracking"]
    optimize = next(event for event in events if event["name"] == "optimize")
    assert tracking[0]["ts"] <= optimize["ts"] < tracking[0]["ts"] + tracking[0]["dur"]


def test_trace_names_threads_and_dimensions(tmp_path):
    """A thread that gets the system's identity of one that has ended keeps its own name and row."""
    units, scale = wp.zeros((4, 6), dtype=wp.uint16, device="cpu"), wp.ones(1, dtype=float, device="cpu")
    metres = wp.zeros((4, 6), dtype=float, device="cpu")

    def work():
        wp.launch(images.to_metres, (4, 6), [units, scale, metres], device="cpu")

    with warpslam.profile() as profile:
        for name in ("compiling", "working"):
            thread = threading.Thread(target=work, name=name)
            thread.start()
            thread.join()
    profile.write_trace(tmp_path / "trace.json")
    events = json.loads((tmp_path / "trace.json").read_text())["traceEvents"]
    names = {event["tid"]: event["args"]["name"] for event in events if event["ph"] == "M"}
    launches = [event for event in events if event.get("cat") == "kernel"]
    assert [names[event["tid"]] for event in launches] == ["compiling", "working"]
    assert [event["args"]["dim"] for event in launches] == [[4, 6], [4, 6]]


def test_table_names_phases_and_kernels(run):
    """The text has a line for each, and upper bounds are marked."""
    text = run[0].table()
    assert "mapping / color" in text and "transpose_color_weights" in text and "<= " in text
    assert text.count("middle_forward") == len({row.phase for row in run[0].report.kernels if "middle_f" in row.kernel})


def test_results_are_byte_identical(frames):
    """A profiled run estimates and maps what any other does."""
    plain, profiled = new_slam(*SETTINGS), new_slam(*SETTINGS)
    steps(plain, frames[:2])
    with warpslam.profile():
        steps(profiled, frames[:2])
    np.testing.assert_array_equal(plain.trajectory.poses, profiled.trajectory.poses)
    for level, grid in plain.scene.grids.items():
        np.testing.assert_array_equal(grid.state().features, profiled.scene.grids[level].state().features)


def test_what_was_recorded_earlier_is_seen(frames):
    """Iterations recorded before the profile began are timed when they are replayed in it."""
    slam = new_slam(*SETTINGS)
    steps(slam, frames[:2])
    with warpslam.profile() as profile:
        steps(slam, frames[2:3])
    calls = Counter(launch.kernel for launch in profile.launches if launch.path == "tracking / optimize")
    assert calls["advance_step"] == 2 * slam.config.tracking.iterations
    assert calls["middle_forward"] > 0


def test_nothing_is_wrapped_while_off():
    """Without a profile, Warp's and the package's functions are their own; also after an error in one."""
    before = [getattr(owner, name) for owner, name in HOOKED]
    assert all(function.__module__ != recorder.__name__ for function in before)
    with pytest.raises(ZeroDivisionError), warpslam.profile():
        assert all(getattr(owner, name) is not old for (owner, name), old in zip(HOOKED, before, strict=True))
        1 / 0  # noqa: B018
    assert [getattr(owner, name) for owner, name in HOOKED] == before
    with phase("anything"):
        assert phases.current() is None


def test_one_profile_at_a_time():
    """A second one inside is refused and the first goes on; figures wait for the end."""
    with warpslam.profile() as profile:
        with pytest.raises(WarpSlamError, match="active already"), warpslam.profile():
            pass
        with pytest.raises(WarpSlamError, match="still active"):
            profile.table()
        with phase("after"):
            pass
    assert {row.phase for row in profile.report.phases} == {"other", "after"}


def test_phases_nest_and_follow_the_thread():
    """A phase within another carries both names, as a decorator too, and its time is not counted twice."""

    @phase("inner")
    def inner(depth: int) -> str:
        return inner(depth - 1) if depth else phases.current().path

    with warpslam.profile() as profile, phase("outer"):
        assert inner(1) == "outer / inner / inner"
        assert program._pool().submit(lambda: phases.current().path).result() == "outer"
    rows = {row.phase: row for row in profile.report.phases}
    assert rows["outer / inner"].calls == rows["outer / inner / inner"].calls == 1
    assert rows["outer"].wait > 0


@pytest.mark.parametrize("min_transmittance", [0.0, 0.3])
def test_counted_points_are_those_computed(frames, min_transmittance, monkeypatch):
    """The points counted beforehand are the ones whose outputs a kernel then writes."""
    slam = new_slam("mapping.first_iterations=60", "mapping.coarse=false", preset="rendering")
    steps(slam, frames[:1])
    batch, arrays = slam.mapper._batch, slam.scene.arrays()
    thresholds = Thresholds(min_weight=0.02, min_transmittance=min_transmittance)
    for bits in {id(array): array for array in batch.bits.values()}.values():
        bits.fill_(0xFFFFFFFF)
    with warpslam.profile() as profile:
        render(batch, arrays, "color", thresholds=thresholds)
    counted = Counter()
    for launch in profile.launches:
        assert launch.work.counted or not launch.kernel.endswith("_forward")
        counted[launch.kernel] += launch.work.points or 0
    total = batch.count * batch.sample_count
    for level in ("middle", "fine", "color"):
        written = (batch.bits[level].numpy()[:total] != 0xFFFFFFFF).any(axis=1).sum()
        assert counted[f"{level}_forward"] == written
    assert 0 < counted["color_forward"] < counted["fine_forward"] <= total
    assert (counted["fine_forward"] < total) == (min_transmittance > 0)

    # Adjoints: points with a gradient above the threshold get a derivative by their position.
    gradient = np.zeros(batch.logit_grad.shape[0], np.float32)
    gradient[:total:3] = np.linspace(-1, 1, len(gradient[:total:3]))
    batch.logit_grad.assign(gradient)
    batch.point_grad.zero_()
    batch.steep_count.zero_()
    batch.launcher.launch(*passes.steep_samples(batch, 0, batch.count, 0, 0.25))
    (step,) = passes.geometry_adjoint(batch, arrays, "middle", Gradients(points=True), 0, batch.count, 0)
    with warpslam.profile() as profile:
        batch.launcher.launch(*step)
    (launch,) = profile.launches
    assert launch.work.points == (np.abs(gradient) > 0.25).sum()
    assert launch.work.flop == launch.work.points * costs.backward_flops("middle", points=True, weights=False)
    computed = (batch.point_grad.numpy() != 0).any(axis=1).sum()
    assert 0.98 * launch.work.points <= computed <= launch.work.points


def test_operations_of_the_adjoints():
    """By hand: 5 V and 4 W of 32 x 32 and the output; twice 32 x 93 for the embedding; all weights once for theirs."""
    middle = 5 * 1024 + 4 * 1024 + 32
    assert costs.backward_flops("middle", points=False, weights=False) == 2 * middle
    assert costs.backward_flops("fine", points=False, weights=False) == 2 * middle
    assert costs.backward_flops("middle", points=True, weights=False) == 2 * (middle + 2 * 32 * 93)
    assert costs.backward_flops("color", points=False, weights=True) == 2 * (middle + 3 * 32 + 15_296)
    assert costs.backward_flops("coarse", points=False, weights=False) == 2 * (6 * 1024 + 32)


def test_what_cannot_be_counted_is_a_bound(frames):
    """Arrays that lie on another device leave the number of points of the launch, and say so."""
    slam = new_slam()
    names = [argument.label for argument in decoders_for(slam.device).middle_forward.adj.args]
    span = Span()
    span.point_count, span.width, span.first_ray = 800, 8, 0
    values = [span if name == "span" else None for name in names]
    kernel = decoders_for(slam.device).middle_forward
    work = costs.work_of(kernel, False, 200, costs.Arguments(kernel, values, readable=False))
    assert (work.points, work.counted) == (800, False)


@pytest.mark.parametrize("target", ["cpu", "cuda"])
def test_every_model_finds_the_arguments_of_its_kernel(target):
    """What a kernel with a model is launched with has the names that the model asks for, on CUDA as on the CPU."""
    built = vars(decoders_for(SimpleNamespace(is_cuda=target == "cuda"))).values()
    decoders = {kernel.key: kernel for kernel in built if isinstance(kernel, wp.Kernel)}
    stages = (adam, compositing, gauss_newton, grid_kernels)
    others = {name: kernel for stage in stages for name, kernel in vars(stage).items() if isinstance(kernel, wp.Kernel)}
    known = {**others, **decoders}
    modelled = [name for name in costs._MODELS if name in known]
    assert len(modelled) > 12
    for name in modelled:
        values = [_stand_in(argument.type) for argument in known[name].adj.args]
        work = costs.work_of(known[name], False, 64, costs.Arguments(known[name], values, readable=False))
        assert work.points or work.bytes, name


def _stand_in(kind: Any) -> Any:
    """An argument of a kernel: a struct of its own, an array of one, or a number."""
    if isinstance(kind, wp._src.codegen.Struct):
        span = kind()
        for field in ("point_count", "width", "sample_count"):
            if field in kind.vars:
                setattr(span, field, 8)
        return span
    if hasattr(kind, "ndim"):
        return SimpleNamespace(shape=(1,) * kind.ndim)
    return 8


def test_device_times_go_to_the_phase_they_belong_to(monkeypatch):
    """On CUDA the driver's times are read when the phase changes and matched with the launches noted since."""
    Timing = namedtuple("Timing", "name elapsed")
    kernel = decoders_for(wp.get_device("cpu")).transpose_color_weights
    pending: list[Timing] = []
    monkeypatch.setattr(wp, "is_cuda_available", lambda: True)
    monkeypatch.setattr(wp, "timing_begin", lambda cuda_filter: pending.clear())
    monkeypatch.setattr(wp, "timing_end", lambda: list(pending))
    with warpslam.profile() as profile:
        with phase("mapping"):
            profile._recorder._cuda.launched(kernel, False, (48, 10), [])
            profile._recorder._cuda.launched(kernel, True, (480,), [])
            pending.append(Timing(f"backward kernel {kernel.key}_0123abcd", 4.0))
            pending.append(Timing(f"forward kernel {kernel.key}_0123abcd", 2.0))
            with phase("color"):
                pending.append(Timing("builtin kernel fill", 1.0))
    rows = {row.kernel: row for row in profile.report.kernels}
    assert rows["transpose_color_weights"].phase == "mapping" and rows["fill"].phase == "mapping / color"
    assert rows["transpose_color_weights"].seconds == pytest.approx(2e-3)
    assert rows["transpose_color_weights (adjoint)"].seconds == pytest.approx(4e-3)
    assert rows["transpose_color_weights"].gigabytes == pytest.approx(480 * 256e-9)
    assert {row.phase: row.elsewhere for row in profile.report.phases}["mapping"] == pytest.approx(6e-3)
    assert [launch.dim for launch in profile.launches] == [(480,), (48, 10), ()]


def test_command_line(monkeypatch, tmp_path, capsys):
    """The command profiles a run to the mesh, prints both tables and writes what it is asked for."""
    room = SyntheticSequence(1, 8, intrinsics=Intrinsics(60.0, 60.0, 39.5, 29.5, 80, 60))
    monkeypatch.setattr(demo, "demo_sequence", lambda: room)
    small = ["mapping.first_iterations=3", "mapping.iterations=2", "mapping.refinement_rounds=1"]
    small += ["mapping.coarse_iterations=1", "mapping.pixels=60", "meshing.voxel=0.2", "tracking.pixels=60"]
    arguments = ["profile", "demo", "--frames", "0:2", "--device", "cpu", "--set", *small]
    files = [str(tmp_path / "p.json"), str(tmp_path / "t.json")]
    assert cli.main([*arguments, "--json", files[0], "--trace", files[1]]) == 0
    out = capsys.readouterr().out
    assert "tracking" in out and "middle_forward" in out and files[1] in out
    report = json.loads((tmp_path / "p.json").read_text())
    assert {"setup", "reading", "tracking", "meshing"} <= {row["phase"] for row in report["phases"]}
    kernels = {(row["kernel"], row["phase"]) for row in report["kernels"]}
    assert {("register", "tracking"), ("register_jointly", "tracking")} <= kernels
    assert json.loads((tmp_path / "t.json").read_text())["traceEvents"]


def test_narrow_terminal_keeps_names(run, monkeypatch, capsys):
    """In a terminal of 80 columns figures go, and every name is there."""
    from warpslam.cli import profile as command

    profile = run[0]
    monkeypatch.setattr(command, "_input", lambda options: (SyntheticSequence(1, 2, intrinsics=CAMERA), None))
    monkeypatch.setattr(command, "_run", lambda *_: profile)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("FORCE_COLOR", "1")  # a terminal, for rich
    assert cli.main(["profile", "demo", "--all"]) == 0
    out = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert max(map(len, out.splitlines())) <= 80 and "more columns on a wider terminal" in out
    cells = [[cell.strip() for cell in line.split("│")[1:3]] for line in out.splitlines() if "│" in line]
    assert all(any(row) for row in cells)
    whole = "".join(cell for row in cells for cell in row).replace(" ", "")
    assert "mark_seen" in whole and "mapping/color" in whole
