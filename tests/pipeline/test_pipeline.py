"""A run from sequence to folder, with a SLAM object that answers at once."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from PIL import Image

from tests.fakes import COVARIANCE, FakeSequence, FakeSlam, run_sequence, true_pose, wall
from warpslam.camera import SensorTiming
from warpslam.config import Config
from warpslam.errors import ConfigError, DatasetError, InputError, MeshError
from warpslam.evaluation import load_mesh, psnr, ssim
from warpslam.pipeline import finished as revisit
from warpslam.pipeline import run as pipeline
from warpslam.pipeline.observer import Observer
from warpslam.report.plots import top_view_axes
from warpslam.runs.folder import RunFolder
from warpslam.runs.panels import load_panels
from warpslam.runs.request import Source
from warpslam.runtime.stopping import terminable
from warpslam.storage.json_files import read_json, to_json
from warpslam.storage.tum import read_tum


@pytest.fixture
def fake_slam(monkeypatch: pytest.MonkeyPatch) -> type[FakeSlam]:
    """The pipeline's SLAM object replaced by one that can be told to misbehave."""

    class Slam(FakeSlam):
        made: list[FakeSlam] = []
        loaded: list[FakeSlam] = []

    def build(intrinsics, config, device, seed, method, timing):
        Slam.made.append(Slam(intrinsics, config=config, device=device, seed=seed))
        return Slam.made[-1]

    monkeypatch.setattr(pipeline, "build_slam", build)

    def load(folder, device=None):
        Slam.loaded.append(Slam.load(folder.map, device))
        return Slam.loaded[-1]

    monkeypatch.setattr(revisit, "load_slam", load)
    monkeypatch.setattr("warpslam.report.pictures.SUPERSAMPLING", 1)
    return Slam


def metrics_of(path) -> dict:
    return json.loads((path / "metrics.json").read_text())


def test_a_run_writes_everything(fake_slam, tmp_path):
    """Every promised file is there and readable, and the figures are those of the fake's 1 cm errors."""
    result = run_sequence(FakeSequence(8), Config(), tmp_path / "run", seed=3, source=Source("somewhere"))
    folder = result.folder
    assert result.status == "finished"
    assert {file.name for file in folder.path.iterdir()} == {
        "config.yaml", "trajectory.tum", "ground_truth.tum", "mesh.ply", "map.safetensors", "metrics.json",
        "timing.json", "input.json", "log.txt", "trajectory_top_view.png", "error_over_time.png", "panels.png",
        "panels.npz", "frames.csv", "frames.json", "report.html", "manifest.json",
    }  # fmt: skip
    assert yaml.safe_load(folder.config.read_text())["mapping"]["window"] == Config().mapping.window
    metrics = metrics_of(folder.path)
    assert metrics == json.loads(to_json(result.metrics.to_dict()))
    assert metrics["status"] == "finished" and metrics["seed"] == 3
    assert metrics["frames"] == {"selected": 8, "processed": 8, "unreadable": 0, "OK": 8, "LOST": 0, "SKIPPED": 0}
    assert metrics["ate_m"]["unaligned"]["rmse"] == pytest.approx(0.01 / np.sqrt(2))
    assert metrics["ate_m"]["aligned"]["rmse"] < metrics["ate_m"]["unaligned"]["rmse"]
    assert metrics["rpe"]["translation_m"]["rmse"] == pytest.approx(0.01)
    assert metrics["rendering"]["depth_l1_m"] == pytest.approx(0.03, abs=1e-6)
    assert metrics["rendering"]["frames"] == [0, 2, 5, 7]
    assert metrics["mesh"]["faces"] == 2
    assert metrics["seconds"]["kernel_compile"] >= 0.25 and metrics["device"] == "cpu"
    assert metrics["seconds"]["run"] == metrics["seconds"]["total"] - metrics["seconds"]["kernel_compile"]
    assert metrics["seconds"]["frames"] > 0
    assert fake_slam.made[-1].finished
    mesh = trimesh.load(folder.mesh)
    np.testing.assert_array_equal(mesh.visual.vertex_colors[0], [10, 20, 30, 255])
    times, poses = read_tum(folder.trajectory)
    np.testing.assert_array_equal(times, np.arange(8) / 30)
    np.testing.assert_allclose(poses[1][:3, 3], true_pose(1)[:3, 3] + [0.01, 0, 0], atol=1e-9)
    timing = read_json(folder.timing)
    assert timing["stages_seconds"]["finish_refinement"] == 0.5
    assert timing["phases"]["mapping"] == {"seconds": 4.0, "calls": 8, "mean_seconds": 0.5}
    assert timing["frames"][2] == {"index": 2, "tracking": 0.25, "mapping": 0.5}
    frames = read_json(folder.frame_records)
    assert frames["left_out"] == [] and frames["frames"][2] == {
        "index": 2, "timestamp": 2 / 30, "status": "OK", "message": "", "inliers": 0.9, "depth_error": 0.02,
        "losses": {"loss": 1.5}, "correlation": 0.95, "covariance": np.diag(COVARIANCE).tolist(),
    }  # fmt: skip
    table = folder.frames.read_text().splitlines()
    assert table[0] == "frame,timestamp,status,inliers,depth_error_m,correlation,sigma_m,sigma_deg,message"
    assert table[3] == "2,0.066667,OK,0.9000,0.02000,0.9500,0.003000,0.572958," and len(table) == 9
    panels = load_panels(folder.panel_images)
    assert [panel.index for panel in panels] == [0, 2, 5, 7] and panels[1].rgb[0, 0].tolist() == [42, 42, 42]
    assert panels[0].rendered_depth[0, 0] == pytest.approx(2.03, abs=1e-3)
    assert "frame 7: OK" in folder.log.read_text()
    for file in folder.path.glob("*.png"):
        assert np.asarray(Image.open(file).convert("L")).std() > 5, f"{file.name} is blank"


def test_timing_that_was_found_is_told(fake_slam, tmp_path, monkeypatch):
    """In metrics.json, as camera.yaml takes it, in the log and in the report; a run that found none says nothing."""
    plain = run_sequence(FakeSequence(8), Config(), tmp_path / "plain").folder
    assert "found_timing" not in metrics_of(plain.path) and "estimated:" not in plain.report.read_text()
    monkeypatch.setattr(fake_slam, "timed_at", 3)
    sequence = FakeSequence(8, unreadable=(1,))
    sequence.stored_timing = lambda timing: SensorTiming(timing.depth_delay, 2 * timing.readout)
    folder = run_sequence(sequence, Config(), tmp_path / "timed").folder
    assert metrics_of(folder.path)["found_timing"] == {
        "depth_delay": -0.0203, "depth_delay_sigma": 0.002, "readout": 0.0522, "readout_sigma": 0.003, "after_frame": 4,
    }  # fmt: skip
    told = "depth_delay -0.0203 +- 0.0020 s, readout 0.0522 +- 0.0030 s, used after frame 4"
    assert told in folder.log.read_text() and told in folder.report.read_text()


def test_same_input_same_trajectory_bytes(fake_slam, tmp_path):
    """Two runs write the same trajectory, byte for byte."""
    for name in "ab":
        run_sequence(FakeSequence(4), Config(), tmp_path / name)
    assert (tmp_path / "a/trajectory.tum").read_bytes() == (tmp_path / "b/trajectory.tum").read_bytes()


def test_unreadable_frames_are_left_out_and_counted(fake_slam, tmp_path):
    """A truncated image costs its frame only; the log and metrics say so, and panels don't stumble over it."""
    result = run_sequence(FakeSequence(8, unreadable=(0, 3, 7)), Config(), tmp_path)
    assert result.metrics.frames.unreadable == 3 and result.metrics.frames.processed == 5
    assert "frame 3 left out: frame000003.jpg is truncated" in result.folder.log.read_text()
    left_out = read_json(result.folder.frame_records)["left_out"]
    assert left_out[1] == {"index": 3, "message": "frame000003.jpg is truncated"}
    np.testing.assert_array_equal(read_tum(result.folder.trajectory)[0], np.array([1, 2, 4, 5, 6]) / 30)


def test_no_readable_frame_is_an_error_with_metrics(fake_slam, tmp_path):
    """When nothing can be read the run fails, and metrics.json says why."""
    with pytest.raises(DatasetError, match="none of the 3"):
        run_sequence(FakeSequence(3, unreadable=(0, 1, 2)), Config(), tmp_path)
    metrics = metrics_of(tmp_path)
    assert metrics["status"] == "failed" and "none of the 3" in metrics["error"]


def test_frames_slice_and_first_pose(fake_slam, tmp_path):
    """A slice selects frames by number, and the first one's true pose anchors the map."""
    result = run_sequence(FakeSequence(10), Config(), tmp_path, frames=(2, 9, 3))
    np.testing.assert_array_equal(read_tum(result.folder.trajectory)[0], np.array([2, 5, 8]) / 30)
    np.testing.assert_array_equal(fake_slam.made[-1].given[0], true_pose(2))


@pytest.mark.parametrize(
    ("frames", "message"), [((20, 30, None), "20:30: selects none of the 8"), ((None, None, -1), "step -1")]
)
def test_frames_that_select_nothing_are_config_errors(fake_slam, tmp_path, frames, message):
    """An empty or backward slice is refused before anything is written."""
    with pytest.raises(ConfigError, match=message):
        run_sequence(FakeSequence(8), Config(), tmp_path / "run", frames=frames)
    assert not (tmp_path / "run").exists()


def test_interrupt_keeps_what_there_is(fake_slam, tmp_path):
    """After ctrl-C in frame 5 the five frames before it are written in full."""
    fake_slam.interrupt_at = 5
    result = run_sequence(FakeSequence(8), Config(), tmp_path)
    assert result.status == metrics_of(tmp_path)["status"] == "interrupted"
    assert len(read_tum(result.folder.trajectory)[0]) == 5
    assert result.ate is not None and result.folder.mesh.exists() and result.folder.panels.exists()


def test_interrupt_before_the_first_frame_is_done(fake_slam, tmp_path):
    """With no frame finished there is still metrics.json."""
    fake_slam.interrupt_at = 0
    assert run_sequence(FakeSequence(8), Config(), tmp_path).status == "interrupted"
    assert metrics_of(tmp_path)["frames"]["processed"] == 0
    assert not (tmp_path / "trajectory.tum").exists()


def test_second_interrupt_ends_the_writing(fake_slam, tmp_path, monkeypatch):
    """Ctrl-C while the mesh is extracted leaves the trajectory and the metrics."""
    monkeypatch.setattr(fake_slam, "mesh", lambda self, voxel=0.02: (_ for _ in ()).throw(KeyboardInterrupt))
    assert run_sequence(FakeSequence(4), Config(), tmp_path).status == "interrupted"
    assert "ate_m" in metrics_of(tmp_path) and (tmp_path / "trajectory.tum").exists()


@pytest.mark.parametrize("step", ["write_trajectory", "write_map", "extract_and_write_mesh", "draw_panels"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_first_signal_while_results_are_written_waits_for_them(fake_slam, ctrl_c, tmp_path, monkeypatch, step, number):
    """Nothing was asked to stop before, so everything is written; the run says that it was interrupted."""
    function = getattr(pipeline, step)

    def interrupted(*arguments):
        os.kill(os.getpid(), number)
        time.sleep(0.01)
        return function(*arguments)

    monkeypatch.setattr(pipeline, step, interrupted)
    with terminable():
        before = signal.getsignal(number)
        result = run_sequence(FakeSequence(4), Config(), tmp_path)
        assert signal.getsignal(number) is before
    folder = result.folder
    assert result.status == metrics_of(tmp_path)["status"] == "interrupted"
    assert all(path.is_file() for path in (folder.trajectory, folder.map, folder.mesh, folder.panels, folder.report))


def test_a_signal_that_was_swallowed_ends_the_run_at_the_next_frame(fake_slam, tmp_path, monkeypatch):
    """As imports do that catch everything. What is done by then is written, and the next run knows nothing of it."""
    function, count = fake_slam.step, iter(range(9))

    def deaf(self, *arguments, **keywords):
        if next(count) == 1:
            with contextlib.suppress(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(5)
        return function(self, *arguments, **keywords)

    monkeypatch.setattr(fake_slam, "step", deaf)
    with terminable():
        result = run_sequence(FakeSequence(4), Config(), tmp_path / "stopped")
    assert result.status == "interrupted" and metrics_of(tmp_path / "stopped")["frames"]["processed"] == 2
    assert run_sequence(FakeSequence(4), Config(), tmp_path / "next").status == "finished"


def test_second_signal_ends_the_writing(fake_slam, ctrl_c, tmp_path, monkeypatch):
    """It is not kept back."""

    def impatient(*arguments):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5)

    monkeypatch.setattr(pipeline, "write_map", impatient)
    result = run_sequence(FakeSequence(4), Config(), tmp_path)
    assert result.status == metrics_of(tmp_path)["status"] == "interrupted"
    assert result.folder.trajectory.is_file() and not result.folder.mesh.exists()


def test_every_result_has_its_name_when_it_is_whole(fake_slam, tmp_path, monkeypatch):
    """A kill in the middle of a write leaves no half of a file under the name of a whole one."""
    moved, move = set(), os.replace

    def recorded(source, target, **keywords):
        moved.add(Path(target).name)
        move(source, target, **keywords)

    monkeypatch.setattr(os, "replace", recorded)
    run_sequence(FakeSequence(4), Config(), tmp_path, source=Source("somewhere"))
    written = {path.name for path in tmp_path.iterdir()}
    # Settings come first and are written again by a run that is resumed; this map is the fake's.
    assert written - moved == {"config.yaml", "log.txt", "map.safetensors"} and len(moved) > 10


def test_failure_writes_metrics_and_passes_on(fake_slam, tmp_path):
    """An unexpected exception reaches the caller; metrics.json and log.txt hold it."""
    fake_slam.fail_at = 2
    with pytest.raises(RuntimeError, match="out of memory"):
        run_sequence(FakeSequence(4), Config(), tmp_path)
    metrics = metrics_of(tmp_path)
    assert metrics["status"] == "failed" and metrics["error"] == "RuntimeError: out of memory"
    assert metrics["frames"]["processed"] == 2
    assert len(read_tum(tmp_path / "trajectory.tum")[0]) == 2
    assert "Traceback" in (tmp_path / "log.txt").read_text()


def test_no_mesh_is_reported_not_fatal(fake_slam, tmp_path):
    """A map without a surface ends in an entry in metrics.json; the rest is written."""
    fake_slam.mesh_fails = True
    result = run_sequence(FakeSequence(4), Config(), tmp_path, truth_mesh=wall())
    assert result.status == "finished" and metrics_of(tmp_path)["mesh"] == {"error": "the map has no surface"}
    assert not result.folder.mesh.exists() and result.folder.panels.exists()


def test_without_mapping_there_is_a_trajectory_alone(fake_slam, tmp_path):
    """No mesh and no panels are tried, and the figures say why; frames.csv has what is known of each pose."""
    config = Config.from_dict({"mapping": {"enabled": False}})
    folder = run_sequence(FakeSequence(4), config, tmp_path / "run").folder
    assert not folder.mesh.exists() and not folder.panels.exists() and folder.trajectory.exists()
    assert metrics_of(folder.path)["mesh"] == {"error": "mapping.enabled is off"}
    header = folder.frames.read_text().splitlines()[0]
    assert header == "frame,timestamp,status,inliers,depth_error_m,correlation,sigma_m,sigma_deg,message"


def test_without_ground_truth(fake_slam, tmp_path):
    """No truth: no ATE, no truth file, and the plots are still drawn."""
    result = run_sequence(FakeSequence(4, no_truth=tuple(range(4))), Config(), tmp_path)
    assert result.ate is None and "ate_m" not in metrics_of(tmp_path) and not result.metrics.has("ate_m")
    assert not result.folder.ground_truth.exists()
    assert result.folder.error_plot.exists() and result.folder.top_view.exists()
    assert fake_slam.made[-1].given == [None] * 4


def test_partial_ground_truth_and_lost_frames(fake_slam, tmp_path):
    """Frames without truth are skipped in the ATE and counted; a lost frame is counted and drawn."""
    fake_slam.lost_at = 3
    result = run_sequence(FakeSequence(8, no_truth=(2,)), Config(), tmp_path)
    assert result.metrics.ate_m.frames_without_truth == 1
    assert result.metrics.frames.LOST == 1 and result.metrics.frames.OK == 7
    assert len(read_tum(result.folder.ground_truth)[0]) == 7


def test_reconstruction_against_a_truth_mesh(fake_slam, small_evaluation, tmp_path):
    """The fake's mesh is the true wall: all of what was seen is covered, and the protocol is named."""
    result = run_sequence(FakeSequence(2), Config(), tmp_path, truth_mesh=wall())
    figures = metrics_of(tmp_path)["reconstruction"]
    assert figures["protocol"] == result.reconstruction.protocol == "frustum+occlusion"
    assert figures["completion_ratio_5cm"] == figures["f_score_5cm"] == 1.0
    assert figures["accuracy_m"] < 0.02 and figures["completion_m"] < 0.02
    # So small an image shows hardly a whole virtual view; where there is one, it is exact.
    assert 2 <= figures["virtual_views"]["drawn"] <= 40
    assert figures["virtual_views"]["used"] == 0 or figures["depth_l1_m"] == pytest.approx(0, abs=1e-6)


def test_evaluate_run_has_the_figures_of_the_run(fake_slam, small_evaluation, tmp_path, monkeypatch):
    """What metrics.json says of the surface, the files of the run say as well, although its own poses are 1 cm off."""
    monkeypatch.setattr(revisit, "open_source", lambda source: FakeSequence(3))
    wall().export(tmp_path / "wall.ply")
    result = run_sequence(FakeSequence(3), Config(), tmp_path / "run", truth_mesh=wall(), source=Source("x"), seed=5)
    again = revisit.evaluate_run(result.folder, truth_mesh=tmp_path / "wall.ply")["reconstruction"]
    written = metrics_of(tmp_path / "run")["reconstruction"]
    for name in ("accuracy_m", "completion_m", "completion_ratio_5cm", "f_score_5cm"):
        assert again[name] == pytest.approx(written[name], abs=1e-6), name
    assert again["virtual_views"] == pytest.approx(written["virtual_views"], abs=1e-6)


def test_evaluate_run_under_every_protocol(fake_slam, small_evaluation, tmp_path, monkeypatch):
    """The first protocol is the one in its usual place; each set of figures says which it is."""
    monkeypatch.setattr(revisit, "open_source", lambda source: FakeSequence(2))
    wall().export(tmp_path / "wall.ply")
    result = run_sequence(FakeSequence(2), Config(), tmp_path / "run", source=Source("x"))
    metrics = revisit.evaluate_run(
        result.folder, truth_mesh=tmp_path / "wall.ply", protocols=["frustum+occlusion+virtual", "frustum"]
    )
    by_protocol = metrics["reconstruction_by_protocol"]
    assert list(by_protocol) == ["frustum+occlusion+virtual", "frustum"]
    assert all(figures["protocol"] == name for name, figures in by_protocol.items())
    assert metrics["reconstruction"] == by_protocol["frustum+occlusion+virtual"]


def test_evaluate_run_renders_input_views(fake_slam, tmp_path, monkeypatch):
    """PSNR, SSIM and depth L1 of the frames that were asked for, by the fake's flat grey rendering."""
    sequence = FakeSequence(8)
    monkeypatch.setattr(revisit, "open_source", lambda source: sequence)
    result = run_sequence(sequence, Config(), tmp_path, source=Source("x"))
    rendering = revisit.evaluate_run(result.folder, rendered_views=2)["rendering"]
    assert rendering["frames"] == [0, 7] and rendering["depth_l1_m"] == pytest.approx(0.03, abs=1e-6)
    grey = np.full((24, 32, 3), 0.2)
    for name, metric in (("psnr_db", psnr), ("ssim", ssim)):
        assert rendering[name] == pytest.approx(np.mean([metric(grey, sequence[n].rgb) for n in (0, 7)]), abs=1e-5)


def test_extract_mesh_options(fake_slam, tmp_path):
    """A forecast has a file of its own, the suffix decides, refinement runs first, and a wrong suffix costs no work."""
    folder = run_sequence(FakeSequence(2), Config(), tmp_path).folder
    before = folder.mesh.read_bytes()
    mesh, path = revisit.extract_mesh(folder, forecast=True)
    assert path == folder.forecast_mesh and mesh.metadata["forecast_faces"] == 1
    assert folder.mesh.read_bytes() == before
    _, path = revisit.extract_mesh(folder, output=tmp_path / "m.glb", refinement_rounds=3)
    assert path.read_bytes()[:4] == b"glTF" and fake_slam.loaded[-1].refined == 3
    count = len(fake_slam.loaded)
    with pytest.raises(MeshError, match="m.xyz"):
        revisit.extract_mesh(folder, output=tmp_path / "m.xyz")
    assert len(fake_slam.loaded) == count


def test_progress_reports_each_frame(fake_slam, tmp_path):
    """The observer sees every frame, the ATE so far, and unreadable frames as done; then what it came to."""
    seen, told = [], []

    class Watcher(Observer):
        def begin(self, name):
            told.append(name)

        def frame(self, progress):
            seen.append(progress)

        def done(self, result):
            told.append(result.folder.report.exists())

    run_sequence(FakeSequence(6, unreadable=(1,)), Config(), tmp_path, observer=Watcher())
    assert told == ["fake sequence", True]
    assert [p.done for p in seen] == [1, 3, 4, 5, 6] and {p.total for p in seen} == {6}
    assert seen[0].ate_rmse == pytest.approx(0, abs=1e-12) and seen[-1].ate_rmse > 0.001
    assert all(p.fps > 0 for p in seen)


def test_log_handler_is_removed(fake_slam, tmp_path):
    """A run leaves the logger of the process as it was."""
    before = list(logging.getLogger("warpslam").handlers)
    run_sequence(FakeSequence(2), Config(), tmp_path)
    assert logging.getLogger("warpslam").handlers == before


def test_default_folder_and_latest_link(tmp_path):
    """Runs go to runs/<name>/<time>, never into one another, and latest leads to the newest."""
    first = RunFolder.create(None, "fake sequence/1", root=tmp_path)
    second = RunFolder.create(None, "fake sequence/1", root=tmp_path)
    assert first.path != second.path and first.path.parent == tmp_path / "fake_sequence_1"
    assert (first.path.parent / "latest").resolve() == second.path.resolve()


def test_reused_folder_loses_stale_results_only(tmp_path):
    """A new run removes what one that came to nothing wrote, and nothing else."""
    for name in ("metrics.json", "report.html", "notes.txt"):
        (tmp_path / name).write_text("old")
    RunFolder.create(tmp_path, "x")
    assert [file.name for file in tmp_path.iterdir()] == ["notes.txt"]


def test_unusable_output_folder_is_a_config_error(tmp_path):
    """A file in the place of the output folder is named."""
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="file"):
        RunFolder.create(tmp_path / "file", "x")


def test_json_knows_no_nan(tmp_path):
    """NaN, NumPy values and arrays become plain JSON."""
    text = to_json({"a": np.float32("nan"), "b": np.arange(2), "c": (np.int64(3), float("inf")), "d": tmp_path})
    assert json.loads(text) == {"a": None, "b": [0, 1], "c": [3, None], "d": str(tmp_path)}


def test_top_view_drops_the_upright_axis():
    """Upright cameras in a z-up world show x and y, in a y-down world x and z."""
    z_up = np.eye(4)
    z_up[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    assert top_view_axes(z_up[None]) == (0, 1)
    assert top_view_axes(np.eye(4)[None]) == (0, 2)


def test_evaluate_run_reproduces_the_metrics(fake_slam, tmp_path):
    """The figures computed from the files are those that the run wrote, to the nanometre of the file."""
    result = run_sequence(FakeSequence(8, no_truth=(2,)), Config(), tmp_path)
    metrics = revisit.evaluate_run(result.folder)
    assert metrics["frames"] == {"estimated": 8, "compared": 7}
    for how in ("aligned", "unaligned"):
        for name, value in metrics_of(tmp_path)["ate_m"][how].items():
            assert metrics["ate_m"][how][name] == pytest.approx(value, abs=5e-9)


def test_evaluate_run_against_another_trajectory(fake_slam, tmp_path):
    """An external truth is paired by time; one from another day has no partner."""
    result = run_sequence(FakeSequence(8), Config(), tmp_path / "run")
    (tmp_path / "far.tum").write_text("1e9 0 0 0 0 0 0 1\n")
    with pytest.raises(DatasetError, match="same sequence"):
        revisit.evaluate_run(result.folder, tmp_path / "far.tum")
    assert revisit.evaluate_run(result.folder, result.folder.trajectory)["ate_m"]["unaligned"]["max"] == 0


def test_render_frame_of_a_run(fake_slam, tmp_path, monkeypatch):
    """A frame that was used is drawn; one that was not, or isn't in the sequence, is an InputError."""
    monkeypatch.setattr(revisit, "open_source", lambda source: FakeSequence(8))
    result = run_sequence(FakeSequence(8), Config(), tmp_path, frames=(0, 8, 2), source=Source("x"))
    path = revisit.render_frame(result.folder, 4)
    assert path.name == "render_000004.png" and Image.open(path).size[0] > 1000
    with pytest.raises(InputError, match="was not used"):
        revisit.render_frame(result.folder, 3)
    with pytest.raises(InputError, match="frames 0 to 7"):
        revisit.render_frame(result.folder, 8)


def test_missing_pieces_of_a_run_are_named(tmp_path):
    """No run, no map, damaged JSON, and a file that is no mesh are typed errors with a remedy."""
    with pytest.raises(DatasetError, match="no run folder"):
        RunFolder.open(tmp_path)
    (tmp_path / "metrics.json").write_text("{")
    folder = RunFolder.open(tmp_path)
    with pytest.raises(DatasetError, match="metrics.json"):
        read_json(folder.metrics)
    with pytest.raises(DatasetError, match="no map.safetensors"):
        folder.require(folder.map, "the run stopped before it had a map")
    with pytest.raises(MeshError, match="metrics.json"):
        load_mesh(folder.metrics)


def test_given_poses_replace_those_of_the_sequence(fake_slam, tmp_path):
    """The method is given the file's poses, nearest in time; frames without one are left out; truth stays truth."""
    from warpslam.storage.tum import write_tum

    given = np.tile(np.eye(4), (3, 1, 1))
    given[:, 2, 3] = [1.0, 2.0, 3.0]
    write_tum(tmp_path / "given.tum", np.array([0, 1, 3]) / 30 + 0.001, given)
    result = run_sequence(FakeSequence(4), Config(), tmp_path / "run", poses=str(tmp_path / "given.tum"))
    np.testing.assert_allclose([T[2, 3] for T in fake_slam.made[-1].given], [1.0, 2.0, 3.0])
    assert result.metrics.frames.unreadable == 1
    assert "frame 2 left out" in result.folder.log.read_text()
    np.testing.assert_allclose(read_tum(result.folder.ground_truth)[1][2], true_pose(3), atol=1e-8)
    with pytest.raises(DatasetError, match="none.tum"):
        run_sequence(FakeSequence(4), Config(), tmp_path / "run", poses=str(tmp_path / "none.tum"))


def test_metrics_name_the_method_and_its_map(fake_slam, tmp_path):
    """Memory and cost of the map are in metrics.json, with the method that made it."""
    metrics = run_sequence(FakeSequence(3), Config(), tmp_path).metrics.to_dict()
    assert metrics["method"] == "nice-slam" and metrics["poses"] is None
    assert metrics["map"] == {"bytes": 2_500_000, "flops_per_point": 102_598}


def test_unknown_method(tmp_path):
    """The message lists the methods."""
    with pytest.raises(ConfigError, match="nice-slam, imap, tsdf"):
        run_sequence(FakeSequence(3), Config(), tmp_path, method="orb")
