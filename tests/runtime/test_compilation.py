"""Compiling kernels beforehand: everything a run needs, once, with progress, for a device or an architecture."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import warp as wp

import warpslam
from tests.fakes import FakeSequence
from tests.test_slam import new_slam
from warpslam import cli
from warpslam.config import Config
from warpslam.errors import ConfigError
from warpslam.pipeline import run as pipeline
from warpslam.profiling import recorder
from warpslam.runtime import compilation, kernel_cache
from warpslam.runtime.compilation import (
    ModuleProgress,
    compile_for_architecture,
    compile_kernels,
    decoder_module,
    find_module,
    module_names,
)
from warpslam.synthetic import SyntheticSequence

CPU = wp.get_device("cpu")
SMALL = ["warpslam.views"]
"""A module that compiles in half a second."""


@pytest.fixture
def empty_cache(monkeypatch, tmp_path):
    """A kernel cache that holds nothing, and a run that needs one small module; afterwards all is as it was."""
    monkeypatch.setattr(compilation, "module_names", lambda target, layouts=(): SMALL)
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "cache"))
    find_module(SMALL[0]).unload()
    yield tmp_path / "cache"
    find_module(SMALL[0]).unload()


@pytest.mark.parametrize(("optimizer", "layout"), [("adam", "dense"), ("direct", "dense"), ("direct", "blocks")])
def test_nothing_is_loaded_after_the_start(monkeypatch, optimizer, layout):
    """A run down to its mesh launches kernels only from modules, and block sizes, that were loaded beforehand."""
    monkeypatch.setattr(recorder, "matrix_peak_gflops", lambda: 1.0)
    room = SyntheticSequence(1, 8, intrinsics=new_slam().intrinsics)
    config = Config.from_preset("default", [f"grid.layout={layout}"])
    for name in [*module_names("cpu"), *room.warp_modules]:
        find_module(name).unload()
    pipeline.load_kernels(room, "cpu", config=config)
    with warpslam.profile() as profile:
        settings = [f"tracking.optimizer={optimizer}", f"grid.layout={layout}", "mapping.first_iterations=12"]
        slam = new_slam(*settings, "direct.sure_correlation=1")  # features are asked, too
        for n in range(3):
            slam.step(room[n].rgb, room[n].depth, T_world_camera=room[n].T_world_camera)
        slam.mesh(voxel=0.2)
    assert slam.keyframes and profile.launches
    assert optimizer != "direct" or slam.direct.counts["searched"] == 2
    assert [module.module for module in profile.report.modules] == []
    other = decoder_module("cpu", "dense" if layout == "blocks" else "blocks")
    assert not find_module(other).execs, "a run needs the decoders of one layout"


def test_a_run_that_names_no_settings_loads_the_kernels_of_the_defaults(empty_cache, monkeypatch):
    """Benchmarks and attacks leave them out."""
    asked = []
    monkeypatch.setattr(compilation, "module_names", lambda target, layouts=(): asked.append(layouts) or SMALL)
    (module,) = pipeline.load_kernels(FakeSequence(), "cpu")
    assert module.name == SMALL[0] and asked == [[Config().grid.layout]]


def test_compiles_once_and_says_so(empty_cache):
    """The first time a module is compiled and is announced as such before; the second time it comes from the cache."""
    seen: list[ModuleProgress] = []
    (first,) = compile_kernels(CPU, seen.append)
    assert seen[0] == ModuleProgress(SMALL[0], 0, 1, compiled=True)
    assert seen[1] is first and first.compiled and first.done == 1 and first.seconds > 0
    (binary,) = empty_cache.rglob("*.o")
    assert find_module(SMALL[0]).get_module_identifier(block_dim=1) == binary.parent.name
    find_module(SMALL[0]).unload()
    (second,) = compile_kernels(CPU, seen.append)
    assert not seen[2].compiled and not second.compiled and second.seconds < first.seconds


def test_modules_load_side_by_side(monkeypatch):
    """With two cores two modules are in work at once, reports come one at a time and count up to the total."""
    monkeypatch.setattr(compilation, "process_cores", lambda: [0, 1])
    together = threading.Barrier(2, timeout=20)
    names, seen, inside = ["warpslam.kernels.losses", "warpslam.kernels.adam"], [], []
    monkeypatch.setattr(compilation, "module_names", lambda target, layouts: names)
    monkeypatch.setattr(wp, "force_load", lambda *args, **kwargs: together.wait())

    def report(progress: ModuleProgress) -> None:
        inside.append(progress)
        assert len(inside) == 1
        seen.append(inside.pop())

    modules = compile_kernels(CPU, report)
    assert {module.name for module in modules} == set(names)
    assert [progress.done for progress in seen if progress.seconds is not None] == [1, 2]
    assert len(seen) == 4 and all(progress.total == 2 for progress in seen)


def test_an_error_of_a_module_comes_through(monkeypatch):
    """What the compiler raises ends the call, on whichever thread it happened."""

    def fail(device, modules, max_workers):
        raise RuntimeError(f"no {modules[0].name}")

    monkeypatch.setattr(wp, "force_load", fail)
    for cores in ([0], [0, 1]):
        monkeypatch.setattr(compilation, "process_cores", lambda cores=cores: cores)
        with pytest.raises(RuntimeError, match="no warpslam"):
            compile_kernels(CPU)


def test_architecture_fills_the_cache_without_a_gpu(empty_cache):
    """PTX and cubin lie where a run on such a GPU looks: under the identity of the module at CUDA's block size."""
    if 80 not in wp.get_cuda_supported_archs():
        pytest.skip("this build of Warp can't compile for sm_80")
    (module,) = compile_for_architecture(80)
    identity = find_module(SMALL[0]).get_module_identifier()
    files = {path.name for path in (empty_cache / identity).iterdir()}
    assert {f"{identity}.sm80.ptx", f"{identity}.sm80.cubin", f"{identity}.meta"} <= files
    assert module.compiled
    (again,) = compile_for_architecture(80)
    assert not again.compiled


def test_unknown_architecture_is_a_config_error():
    """The error lists what there is."""
    with pytest.raises(ConfigError, match=r"sm_33.*sm_80|no CUDA"):
        compile_for_architecture(33)


def test_warmup_prints_a_line_a_module(empty_cache, monkeypatch, capsys):
    """Name, whether it was compiled and seconds; then the total and where the cache is; a wrong device is an error."""
    assert cli.main(["warmup", "--device", "cpu"]) == 0
    out = capsys.readouterr().out
    assert f"/2  {SMALL[0]}" in out and "compiled" in out and " s\n" in out
    assert "warpslam.kernels.raycast" in out and str(empty_cache) in out
    assert cli.main(["warmup", "--device", "sm_33"]) == 2
    assert cli.main(["warmup", "--device", "cuda:77"]) == 2
    assert "cuda:77" in capsys.readouterr().err


def test_run_shows_and_records_what_it_compiles(empty_cache, monkeypatch, tmp_path, capsys):
    """Without a terminal a line before each module that must be compiled; metrics and timing name them."""
    from tests.fakes import FakeSlam
    from warpslam.storage.json_files import read_json

    monkeypatch.setattr(
        pipeline, "build_slam", lambda intrinsics, config, device, seed, method, timing: FakeSlam(intrinsics)
    )
    monkeypatch.setattr(pipeline, "draw_plots", lambda *arguments: None)
    monkeypatch.setattr(pipeline, "draw_panels", lambda *arguments: None)
    monkeypatch.setattr(pipeline, "open_source", lambda source: FakeSequence(3))
    for name, compiled in (("first", SMALL), ("second", [])):
        assert cli.main(["run", "seq", "--device", "cpu", "-o", str(tmp_path / name)]) == 0
        out = capsys.readouterr().out
        assert (f"compiling {SMALL[0]} (once a machine), 0 of 1 modules ready" in out) == bool(compiled)
        assert read_json(Path(tmp_path / name / "metrics.json"))["compiled_kernels"] == compiled
        modules = read_json(Path(tmp_path / name / "timing.json"))["kernel_modules"]
        assert modules[SMALL[0]]["compiled"] == bool(compiled) and modules[SMALL[0]]["seconds"] > 0
        find_module(SMALL[0]).unload()


def test_a_full_kernel_cache_is_told_before_the_compiler_meets_it(monkeypatch, tmp_path):
    """LLVM ends the process when it can't write; so the room is looked at before a module is built."""
    usage = SimpleNamespace(free=1000)
    monkeypatch.setattr(kernel_cache.shutil, "disk_usage", lambda folder: usage)
    monkeypatch.setattr(compilation, "_binaries", lambda module, target: iter(()))
    built = []
    with pytest.raises(ConfigError, match="WARP_CACHE_PATH"):
        compilation._each(["warpslam.kernels.grid"], "cpu", built.append, None, 1)
    assert not built
