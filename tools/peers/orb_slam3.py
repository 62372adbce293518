"""ORB-SLAM3 (Campos et al. 2021), RGB-D, from the wheel `pyorbslam3`; the mesh is TSDF fusion at the poses found.

It needs a vocabulary. PYORBSLAM3_VOCAB names a file; else the wheel's own is used if it was downloaded before (139 MB,
``python -c "import pyorbslam3; pyorbslam3.vocabulary_path()"``), and failing that a small one is made of the sequence's
own images (see `tools.peers.orb_vocabulary`), which the table says.
"""

from __future__ import annotations

import numpy as np

from tools.peers.orb_vocabulary import make_vocabulary
from tools.peers.recording import Account, Recording, fuse
from warpslam.storage.tum import associate, read_tum

FEATURES = 1000

_SETTINGS = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {fx:.6f}
Camera1.fy: {fy:.6f}
Camera1.cx: {cx:.6f}
Camera1.cy: {cy:.6f}
Camera1.k1: 0.0
Camera1.k2: 0.0
Camera1.p1: 0.0
Camera1.p2: 0.0
Camera.width: {width}
Camera.height: {height}
Camera.fps: 30
Camera.RGB: 1
Stereo.ThDepth: 40.0
Stereo.b: 0.07732
RGBD.DepthMapFactor: 1.0
ORBextractor.nFeatures: {features}
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""


def orb_slam3(recording: Recording, account: Account, mesh: bool) -> None:
    """Run it as fast as it goes; poses are those after its last bundle adjustment."""
    import pyorbslam3

    k = recording.intrinsics
    settings = account.out / "settings.yaml"
    settings.write_text(
        _SETTINGS.format(fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy, width=k.width, height=k.height, features=FEATURES)
    )
    try:
        vocabulary = pyorbslam3.vocabulary_path(download=False)
    except FileNotFoundError:
        vocabulary = str(account.out / "vocabulary.txt")
        with account.timed("setup"):
            count = make_vocabulary(account.out / "vocabulary.txt", recording)
        account.remarks.append(f"vocabulary of {count} words made of these images")
    slam = pyorbslam3.Slam(
        vocab_file=vocabulary, settings_file=str(settings), sensor=pyorbslam3.Sensor.RGBD, use_viewer=False
    )
    # Times since the first frame: it writes them with six digits behind the point, and reads them as doubles.
    times = recording.times - recording.times[0]
    lost = []
    with account.timed("tracking"):
        for number in range(len(recording)):
            frame = recording[number]
            found = slam.track_rgbd(frame.rgb, np.ascontiguousarray(frame.depth, np.float32), float(times[number]))
            if not found.pose_valid:
                lost.append(number)
        slam.shutdown()
    slam.save_trajectory_tum(str(account.out / "orb.txt"))
    found_times, found_poses = read_tum(account.out / "orb.txt")
    partner = associate(times, found_times, 1e-4)
    T = np.eye(4)
    for number, index in enumerate(partner):
        # A frame without a pose stays where the one before it was.
        T = T if index < 0 else found_poses[index]
        account.add(T, number not in lost)
    if mesh:
        with account.timed("mesh"):
            poses = account.world_poses()
            poses[lost] = np.nan
            fuse(recording, poses, account.out / "mesh.ply")
