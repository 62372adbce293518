"""Each reader on a tiny sequence of its format: frames, depth and poses are compared with what was written."""

from __future__ import annotations

import builtins
import json
from dataclasses import replace

import numpy as np
import pytest

from tests.sequences import writers
from warpslam.camera import ONE_MOMENT, Intrinsics, SensorTiming
from warpslam.errors import DatasetError, MissingDependencyError
from warpslam.sequences import open_sequence
from warpslam.sequences.calibration import Calibration

TUM_CAMERA = f"20,21,11.5,7.5,{writers.WIDTH},{writers.HEIGHT},1000"
TINY = Intrinsics(20, 21, 11.5, 7.5, writers.WIDTH, writers.HEIGHT)


def check_frame(frame, index, source=None, *, scale=1000.0, pose=True):
    """Compare a frame with the images and the pose of number ``source``."""
    source = index if source is None else source
    assert frame.index == index
    assert frame.rgb.dtype == np.uint8 and frame.depth.dtype == np.float32
    np.testing.assert_array_equal(frame.rgb, writers.make_rgb(source))
    np.testing.assert_array_equal(frame.depth, writers.make_depth(source).astype(np.float32) / np.float32(scale))
    assert frame.depth[0, 0] == 0
    if pose:
        np.testing.assert_allclose(frame.T_world_camera, writers.make_pose(source), rtol=0, atol=1e-12)
    else:
        assert frame.T_world_camera is None


def test_replica(tmp_path):
    """Replica: natural order, poses as stored, times at 30 Hz, camera.yaml before the built-in camera."""
    sequence = open_sequence(writers.write_replica(tmp_path / "room", 3))
    assert (len(sequence), sequence.name, sequence.preset, sequence.intrinsics) == (3, "room", "replica", TINY)
    for index, frame in enumerate(sequence):
        check_frame(frame, index)
        assert frame.timestamp == index / 30
    truth = sequence.ground_truth()
    np.testing.assert_allclose(truth, [writers.make_pose(i) for i in range(3)], rtol=0, atol=1e-12)
    check_frame(sequence[-1], 2)
    with pytest.raises(IndexError):
        sequence[3]


def test_ground_truth_is_a_copy(tmp_path):
    """Changing a returned pose leaves the sequence as it was."""
    sequence = open_sequence(writers.write_replica(tmp_path))
    sequence.ground_truth()[:] = 0
    sequence[1].T_world_camera[:] = 0
    check_frame(sequence[1], 1)


def test_replica_built_in_camera(tmp_path):
    """Replica without camera.yaml or traj.txt: the published camera and depth unit, no poses."""
    writers.write_image(tmp_path / "results" / "frame000000.jpg", np.full((680, 1200, 3), 90, np.uint8))
    depth = np.full((680, 1200), 6554, np.uint16)
    writers.write_image(tmp_path / "results" / "depth000000.png", depth)
    sequence = open_sequence(tmp_path)
    assert sequence.intrinsics == Intrinsics(600, 600, 599.5, 339.5, 1200, 680)
    assert sequence.ground_truth() is None and sequence[0].T_world_camera is None
    assert sequence[0].depth[5, 5] == np.float32(6554) / np.float32(6553.5)


def test_camera_argument_wins(tmp_path):
    """The camera string replaces camera.yaml, its depth unit included."""
    camera = f"30, 31, 12, 8, {writers.WIDTH}, {writers.HEIGHT}, 5e2"
    sequence = open_sequence(writers.write_replica(tmp_path), camera=camera)
    assert sequence.intrinsics == Intrinsics(30, 31, 12, 8, writers.WIDTH, writers.HEIGHT)
    check_frame(sequence[2], 2, scale=500.0)


def test_tum_association(tmp_path):
    """TUM: every colour image with depth within 0.08 s is a frame, whatever its pose; the paper's code takes those with
    a pose within 0.08 s, at least 1/32 s apart.
    """
    folder = writers.write_tum(
        tmp_path,
        times=[10.00, 10.02, 10.10, 10.50, 10.70, 11.00],
        depth_times=[9.97, 10.03, 10.13, 10.71, 11.06],
        pose_times=[10.01, 10.09, 10.50, 10.93],
    )
    sequence = open_sequence(folder, camera=writers.CAMERA)
    # 10.50 has no depth, 10.70 no pose; 11.00 takes depth 11.06 and pose 10.93, both just near enough.
    assert [frame.timestamp for frame in sequence] == [10.00, 10.02, 10.10, 10.70, 11.00]
    expected = [(0, 0, 0), (1, 1, 0), (2, 2, 1), (4, 3, None), (5, 4, 3)]
    for frame, (rgb, depth, pose) in zip(sequence, expected, strict=True):
        np.testing.assert_array_equal(frame.rgb, writers.make_rgb(rgb))
        np.testing.assert_array_equal(frame.depth, writers.make_depth(depth).astype(np.float32) / np.float32(1000))
        if pose is None:
            assert frame.T_world_camera is None
        else:
            np.testing.assert_allclose(frame.T_world_camera, writers.make_pose(pose), atol=1e-12)
    assert np.isnan(sequence.ground_truth()[3]).all()
    published = sequence.as_published()
    assert [frame.timestamp for frame in published] == [10.00, 10.10, 11.00]
    assert [frame.index for frame in published] == [0, 1, 2] and len(sequence) == 5
    assert [frame.depth_timestamp for frame in published] == [9.97, 10.13, 11.06]
    np.testing.assert_allclose(published.ground_truth(), [writers.make_pose(i) for i in (0, 1, 3)], atol=1e-12)
    np.testing.assert_array_equal(published[1].rgb, writers.make_rgb(2))


def test_tum_limit_of_association(tmp_path):
    """TUM: 0.09 s to the nearest pose is too much."""
    folder = writers.write_tum(tmp_path, times=[1.0, 2.0], depth_times=[1.0, 2.0], pose_times=[1.0, 2.09])
    sequence = open_sequence(folder, camera=writers.CAMERA)
    assert [frame.T_world_camera is None for frame in sequence] == [False, True]
    assert [frame.timestamp for frame in sequence.as_published()] == [1.0]


def test_tum_without_poses(tmp_path):
    """TUM: without a pose file depth alone decides; pose.txt stands in for groundtruth.txt."""
    folder = writers.write_tum(tmp_path, times=[1.0, 2.0], depth_times=[1.0, 2.0], pose_times=[1.0])
    (folder / "groundtruth.txt").rename(folder / "pose.txt")
    sequence = open_sequence(folder, camera=writers.CAMERA)
    assert (len(sequence), len(sequence.as_published())) == (2, 1)
    (folder / "pose.txt").unlink()
    sequence = open_sequence(folder, camera=writers.CAMERA)
    assert len(sequence) == len(sequence.as_published()) == 2 and sequence.ground_truth() is None


def test_tum_camera_from_the_name_that_was_typed(tmp_path):
    """TUM: a link's own name tells the camera and names the sequence, before that of the folder it leads to."""
    target = _write_tum_640(tmp_path / "freiburg3_desk")
    (tmp_path / "fr1_desk").symlink_to(target)
    linked = open_sequence(tmp_path / "fr1_desk")
    assert linked.calibration.source == "built-in camera tum_fr1" and linked.name == "fr1_desk"
    (tmp_path / "kitchen").symlink_to(target)
    assert open_sequence(tmp_path / "kitchen").calibration.source == "built-in camera tum_fr3"


def _write_tum_640(folder):
    writers.write_tum(folder, times=[], depth_times=[], pose_times=[1.0])
    for kind, image in (("rgb", np.zeros((480, 640, 3), np.uint8)), ("depth", np.full((480, 640), 5000, np.uint16))):
        writers.write_image(folder / kind / "1.png", image)
        (folder / f"{kind}.txt").write_text(f"1.0 {kind}/1.png\n")
    return folder


@pytest.mark.parametrize(
    ("name", "focal"), [("tum_fr1_xyz", 517.3), ("rgbd_dataset_freiburg2_desk", 520.9), ("fr3_office", 535.4)]
)
def test_tum_camera_from_name(tmp_path, name, focal):
    """TUM: the folder's name tells the camera. Frames lose the border that undistortion blackens; as the paper's code
    takes them they are resized to 512 x 384 and lose 8 pixels on each side.
    """
    sequence = open_sequence(_write_tum_640(tmp_path / name))
    size = (640, 480) if name == "fr3_office" else (620, 460)
    for frames, (width, height), scale in ((sequence, size, 1.0), (sequence.as_published(), (496, 368), 0.8)):
        assert (frames.intrinsics.width, frames.intrinsics.height) == (width, height)
        assert frames.intrinsics.fx == pytest.approx(focal * scale)
        assert frames[0].rgb.shape == (height, width, 3) and frames[0].depth.shape == (height, width)
        assert np.isin(frames[0].depth, [0, 1]).all() and (frames[0].depth == 1).mean() > 0.97


def test_scannet(tmp_path):
    """ScanNet: numeric order, colour brought to the size of depth, a pose of -inf is unknown."""
    sequence = open_sequence(writers.write_scannet(tmp_path), camera=writers.CAMERA)
    assert (len(sequence), sequence.preset, sequence.intrinsics) == (3, "scannet", TINY)
    for index, frame in enumerate(sequence):
        stored = writers.make_depth(index).astype(np.float32) / np.float32(1000)
        np.testing.assert_array_equal(frame.depth, stored)
        assert frame.rgb.shape == (writers.HEIGHT, writers.WIDTH, 3)
        assert abs(int(frame.rgb[8, 8, 0]) - 200) < 8 and abs(int(frame.rgb[8, 8, 1]) - 10 * index) < 8
    assert sequence[1].T_world_camera is None
    truth = sequence.ground_truth()
    assert np.isnan(truth[1]).all()
    np.testing.assert_allclose(truth[[0, 2]], [writers.make_pose(0), writers.make_pose(2)], atol=1e-12)


def test_scannet_crop(tmp_path):
    """ScanNet's own camera cuts 10 pixels from every side, and the principal point moves along."""
    depth = np.arange(480 * 640, dtype=np.uint32).reshape(480, 640).astype(np.uint16)
    writers.write_image(tmp_path / "frames" / "depth" / "0.png", depth)
    writers.write_image(tmp_path / "frames" / "color" / "0.jpg", np.zeros((968, 1296, 3), np.uint8))
    sequence = open_sequence(tmp_path)
    assert sequence.intrinsics == Intrinsics(577.590698, 578.729797, 308.905426, 232.683609, 620, 460)
    np.testing.assert_array_equal(sequence[0].depth, depth[10:-10, 10:-10].astype(np.float32) / np.float32(1000))
    assert sequence[0].rgb.shape == (460, 620, 3)


def test_seven_scenes(tmp_path):
    """7-Scenes: 0 and 65535 are missing depth."""
    sequence = open_sequence(writers.write_seven_scenes(tmp_path), camera=writers.CAMERA)
    assert (len(sequence), sequence.preset) == (3, "seven_scenes")
    for index, frame in enumerate(sequence):
        expected = writers.make_depth(index).astype(np.float32) / np.float32(1000)
        expected[0, 1] = 0
        np.testing.assert_array_equal(frame.depth, expected)
        np.testing.assert_array_equal(frame.rgb, writers.make_rgb(index))
        np.testing.assert_allclose(frame.T_world_camera, writers.make_pose(index), atol=1e-12)


def test_cofusion(tmp_path):
    """Co-Fusion: metres from EXR; what is too far, infinite or not a number is missing; no poses."""
    pytest.importorskip("OpenEXR", reason="the package openexr is not installed")
    camera = writers.CAMERA.replace(",1000", ",1")
    sequence = open_sequence(writers.write_cofusion(tmp_path), camera=camera)
    assert (len(sequence), sequence.preset, sequence.ground_truth()) == (2, "cofusion", None)
    for index, frame in enumerate(sequence):
        expected = writers.make_depth(index).astype(np.float32) / 1000
        expected[0, 1:4] = 0
        assert frame.depth.dtype == np.float32
        np.testing.assert_array_equal(frame.depth, expected)
        np.testing.assert_array_equal(frame.rgb, writers.make_rgb(index))


def test_cofusion_without_openexr(tmp_path, monkeypatch):
    """Co-Fusion without the optional package says what to install."""
    original = builtins.__import__

    def without_openexr(name, *args, **kwargs):
        if name == "OpenEXR":
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_openexr)
    with pytest.raises(MissingDependencyError, match="pip install openexr"):
        open_sequence(writers.write_cofusion(tmp_path), camera=writers.CAMERA)


@pytest.mark.parametrize("log", ["scene/trajectory.log", "trajectory.log", "slam.log"])
def test_azure(tmp_path, log):
    """Own recording: poses from any of the places of a Redwood log; a frame that it leaves out has none."""
    folder = writers.write_color_depth(tmp_path, "color")
    assert open_sequence(folder, camera=writers.CAMERA).ground_truth() is None
    writers.write_log(folder / log, {0: writers.make_pose(0), 2: writers.make_pose(2)})
    sequence = open_sequence(folder, camera=writers.CAMERA)
    assert (len(sequence), sequence.preset) == (3, "apartment")
    for index in range(3):
        check_frame(sequence[index], index, pose=index != 1)


def test_azure_recorder_camera(tmp_path):
    """Own recording: the camera of Open3D's intrinsic.json (column-major), which camera.yaml replaces."""
    folder = writers.write_color_depth(tmp_path, "color")
    matrix = [20.0, 0, 0, 0, 21.0, 0, 11.5, 7.5, 1]
    fields = {"width": writers.WIDTH, "height": writers.HEIGHT, "intrinsic_matrix": matrix}
    (folder / "intrinsic.json").write_text(json.dumps(fields))
    assert open_sequence(folder).intrinsics == TINY
    (folder / "camera.yaml").write_text(writers.CAMERA_YAML.replace("fx: 20", "fx: 33"))
    assert open_sequence(folder).intrinsics.fx == 33


def test_redwood(tmp_path):
    """Redwood: the optimised trajectory comes before the first one."""
    folder = writers.write_color_depth(tmp_path, "image")
    others = {i: writers.make_pose(i + 5) for i in range(3)}
    writers.write_log(folder / "test_scene/trajectory.log", others)
    truth = open_sequence(folder, camera=writers.CAMERA).ground_truth()
    np.testing.assert_array_equal(truth, np.stack(list(others.values())))
    poses = {i: writers.make_pose(i) for i in range(3)}
    writers.write_log(folder / "test_slac/0.050/optimized_trajectory_slac.log", poses)
    sequence = open_sequence(folder, camera=writers.CAMERA)
    assert sequence.preset == "icl"
    for index, frame in enumerate(sequence):
        check_frame(frame, index)


def test_natural_order(tmp_path):
    """Frame 10 comes after frame 9, though it sorts before as text."""
    for i in range(11):
        writers.write_image(tmp_path / "color" / f"{i}.png", writers.make_rgb(i))
        writers.write_image(tmp_path / "depth" / f"{i}.png", writers.make_depth(i))
    sequence = open_sequence(tmp_path, camera=writers.CAMERA)
    for index in (2, 9, 10):
        check_frame(sequence[index], index, pose=False)


def test_resize_and_crop(tmp_path):
    """A world point keeps its ray when a camera.yaml asks for resizing and cropping."""
    width, height = 80, 60
    fx, fy, cx, cy = 70.0, 72.0, 41.0, 28.0
    v, u = np.mgrid[:height, :width]
    # Depth of a plane that is tilted, so that a shift by a part of a pixel shows.
    normal = np.array([0.3, -0.2, 1.0])
    depth = 2.0 / (normal[0] * (u - cx) / fx + normal[1] * (v - cy) / fy + normal[2])
    rgb = np.stack([3 * u, 4 * v, 0 * u], axis=-1).astype(np.uint8)
    writers.write_image(tmp_path / "results/frame0.png", rgb)
    writers.write_image(tmp_path / "results/depth0.png", np.rint(depth * 10000).astype(np.uint16))
    text = f"fx: {fx}\nfy: {fy}\ncx: {cx}\ncy: {cy}\nwidth: {width}\nheight: {height}\ndepth_scale: 1e4\n"
    (tmp_path / "camera.yaml").write_text(text + "resize: [40, 20]\ncrop: 3\n")
    sequence = open_sequence(tmp_path)
    K, frame = sequence.intrinsics, sequence[0]
    assert (K.fx, K.fy, K.cx, K.width, K.height) == (35.0, 24.0, 17.5, 34, 14)
    assert K.cy == pytest.approx(28 / 3 - 3)
    rows, columns = np.mgrid[: K.height, : K.width]
    rays = normal[0] * (columns - K.cx) / K.fx + normal[1] * (rows - K.cy) / K.fy + normal[2]
    np.testing.assert_allclose(frame.depth, 2.0 / rays, atol=1e-4)
    np.testing.assert_allclose(frame.rgb[..., 0], 3 * 2 * (columns + 3), atol=1)
    np.testing.assert_allclose(frame.rgb[..., 1], 4 * 3 * (rows + 3), atol=1)


def test_undistortion_straightens_colour_only(tmp_path):
    """A distorted colour image is sampled where OpenCV's model puts the pixel; depth is left alone."""
    width, height = 80, 60
    f, cx, cy, k1, p1 = 60.0, 39.5, 29.5, 0.2, 0.01
    v, u = np.mgrid[:height, :width]
    depth = (u + 100 * v).astype(np.uint16)
    writers.write_image(tmp_path / "results/frame0.png", np.stack([3 * u, 4 * v, 0 * u], axis=-1).astype(np.uint8))
    writers.write_image(tmp_path / "results/depth0.png", depth)
    text = f"fx: {f}\nfy: {f}\ncx: {cx}\ncy: {cy}\nwidth: {width}\nheight: {height}\ndepth_scale: 1000\n"
    (tmp_path / "camera.yaml").write_text(text + f"distortion: [{k1}, 0, {p1}, 0]\n")
    frame = open_sequence(tmp_path)[0]
    np.testing.assert_array_equal(frame.depth, depth.astype(np.float32) / np.float32(1000))
    x, y = (u - cx) / f, (v - cy) / f
    r2 = x * x + y * y
    distorted_u = (x * (1 + k1 * r2) + 2 * p1 * x * y) * f + cx
    distorted_v = (y * (1 + k1 * r2) + p1 * (r2 + 2 * y * y)) * f + cy
    inside = (distorted_u > 0) & (distorted_u < width - 1) & (distorted_v > 0) & (distorted_v < height - 1)
    assert np.abs(distorted_u - u)[inside].max() > 2
    assert np.abs(frame.rgb[..., 0] - 3 * distorted_u)[inside].max() <= 1
    assert np.abs(frame.rgb[..., 1] - 4 * distorted_v)[inside].max() <= 1


def test_tum_frames_carry_the_stamps_of_their_depth(tmp_path):
    """Each frame has the time of the depth image that was paired with it; other formats have none."""
    folder = writers.write_tum(tmp_path / "tum", [1.0, 1.1, 1.2], [0.99, 1.13, 1.18], [1.0, 1.1, 1.2])
    sequence = open_sequence(folder, camera=TUM_CAMERA)
    assert [frame.depth_timestamp for frame in sequence] == [0.99, 1.13, 1.18]
    assert sequence.timing == ONE_MOMENT
    assert open_sequence(writers.write_replica(tmp_path / "replica"))[0].depth_timestamp is None


def test_timing_comes_with_the_camera(tmp_path):
    """camera.yaml may hold delay and readout, the latter of all stored rows; freiburg1's camera does; text has none."""
    folder = writers.write_replica(tmp_path)
    with (folder / "camera.yaml").open("a") as file:
        file.write("crop: 2\ndepth_delay: -0.01\nreadout: 0.02\n")
    sequence = open_sequence(folder)
    share = (writers.HEIGHT - 4) / writers.HEIGHT
    assert sequence.timing.depth_delay == -0.01 and sequence.timing.readout == pytest.approx(0.02 * share)
    assert Calibration.of_dataset("tum_fr1").stored_timing == SensorTiming(-0.020, 0.026)
    assert Calibration.of_dataset("tum_fr2").timing == ONE_MOMENT == Calibration.from_text(TUM_CAMERA).timing


@pytest.mark.parametrize("line", ["readout: -1", "depth_delay: 3", "readout: soon"])
def test_timing_that_no_camera_has(tmp_path, line):
    """The file and the field are named."""
    folder = writers.write_replica(tmp_path)
    with (folder / "camera.yaml").open("a") as file:
        file.write(f"{line}\n")
    with pytest.raises(DatasetError, match=rf"camera\.yaml.*{line.split(':')[0]}"):
        open_sequence(folder)


def test_camera_written_as_yaml_is_read_back(tmp_path):
    """Every field survives, timing included."""
    fields = {"distortion": [0.1, -0.2, 0, 0, 0.3], "resize": [12, 8], "crop": 1, "depth_delay": -0.02, "readout": 0.03}
    camera = Calibration.from_fields({**vars(TINY), "depth_scale": 5000, **fields}, "test")
    (tmp_path / "camera.yaml").write_text(camera.to_yaml())
    assert replace(Calibration.from_yaml(tmp_path / "camera.yaml"), source="test") == camera
