"""The page in the browser: a scene that can be turned, images and figures beside it (viser)."""

from __future__ import annotations

import io
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import ConfigError, MissingDependencyError
from warpslam.frames import FrameStatus
from warpslam.poses import vector_from_pose
from warpslam.viewer.glb import glb
from warpslam.viewer.loops import LOOP_COLOR

log = logging.getLogger(__name__)

DEFAULT_HOST, DEFAULT_PORT = "localhost", 8080
STATUS_COLORS = {FrameStatus.OK: (46, 134, 222), FrameStatus.LOST: (214, 48, 49), FrameStatus.SKIPPED: (225, 160, 20)}
PATH_COLOR, KEYFRAME_COLOR = (46, 134, 222), (90, 160, 90)
_IMAGE_WIDTH = 320  # [px]
_FOLLOW_BACK, _FOLLOW_UP = 0.9, 0.35  # [m], of the eye from the camera that is followed
_PATH_PART = 100  # segments; a longer path is sent in several parts, of which the last alone is sent again


@dataclass(frozen=True)
class Address:
    """Where the page is served."""

    host: str = DEFAULT_HOST
    """Name or number of a network interface; "0.0.0.0" is all of them."""
    port: int = DEFAULT_PORT
    """0 for any that is free; where one is taken, the next free one is used."""

    @classmethod
    def parse(cls, text: str) -> Address:
        """From HOST:PORT, HOST, or :PORT.

        Raises:
            ConfigError: The port is no number below 65536.
        """
        host, colon, port = text.rpartition(":") if ":" in text else (text, "", "")
        if colon and not (port.isdecimal() and int(port) < 65536):
            raise ConfigError(f"{text!r} is no address: give HOST:PORT, such as 0.0.0.0:8080")
        return cls(host or DEFAULT_HOST, int(port) if colon else DEFAULT_PORT)


class Page:
    """What is shown. Methods may be called from one thread at a time.

    Args:
        title: Name of the sequence.
        camera: Whose frustum is drawn.
        address: Where it is served.

    Raises:
        MissingDependencyError: viser is not installed.
        ConfigError: The address can't be used.
    """

    def __init__(self, title: str, camera: Intrinsics, address: Address) -> None:
        viser = _viser()
        try:
            with _silence():
                self._server = viser.ViserServer(host=address.host, port=address.port, label=title, verbose=False)
        except Exception as error:
            raise ConfigError(f"no page can be served at {address.host}:{address.port} ({error})") from error
        self.address = Address(address.host, self._server.get_port())
        self._camera = camera
        self._path = np.zeros((0, 3))
        self._pose = np.eye(4)
        self._up = np.array([0.0, -1.0, 0.0])
        self._has_eye = False
        self._keyframes = np.zeros((0, 4, 4))
        self._loops = np.zeros((0, 2, 3), np.float32)
        self._build(title)

    def _build(self, title: str) -> None:
        server, camera = self._server, self._camera
        server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        server.gui.main_panel.dock_right()
        server.scene.set_background_image(np.full((2, 2, 3), 24, np.uint8), format="png")
        angle = 2 * float(np.arctan(camera.height / (2 * camera.fy)))
        self._frustum = server.scene.add_camera_frustum(
            "/camera", angle, camera.width / camera.height, scale=0.25, thickness=2.0, thickness_units="screen",
            color=STATUS_COLORS[FrameStatus.OK],
        )  # fmt: skip
        gui = server.gui
        self._text = gui.add_markdown(f"**{title}**")
        blank = np.full((24, 32, 3), 40, np.uint8)
        self._input = gui.add_image(blank, label="input", format="jpeg", jpeg_quality=80)
        self._rendering = gui.add_image(blank, label="rendering", format="jpeg", jpeg_quality=80, visible=False)
        self._follow = gui.add_checkbox("follow the camera", False)
        self._follow.on_update(lambda _: self._follow_camera())
        for label, name in (("mesh", "/map"), ("path", "/path"), ("keyframes", "/keyframes"), ("loops", "/loops")):
            self._add_switch(label, name)

    def _add_switch(self, label: str, name: str) -> None:
        frame = self._server.scene.add_frame(name, show_axes=False)
        box = self._server.gui.add_checkbox(label, True)
        box.on_update(lambda _: setattr(frame, "visible", box.value))

    @property
    def url(self) -> str:
        """Where a browser finds the page."""
        host = "localhost" if self.address.host in ("0.0.0.0", "::", "") else self.address.host
        return f"http://{host}:{self.address.port}"

    @property
    def is_watched(self) -> bool:
        """Whether a browser has the page open."""
        return bool(self._server.get_clients())

    def add_slider(self, count: int, changed: Callable[[int], None]) -> Callable[[int], None]:
        """A slider over frames and a button that plays them; returns what moves it."""
        gui = self._server.gui
        slider = gui.add_slider("frame", 0, max(count - 1, 1), 1, 0, order=-1)
        playing = gui.add_checkbox("play", False, order=-0.5)
        self._playing = playing
        slider.on_update(lambda _: changed(int(slider.value)))

        def move(value: int) -> None:
            slider.value = value

        return move

    @property
    def is_playing(self) -> bool:
        """Whether the frames are played one after the other."""
        return bool(self._playing.value)

    def say(self, text: str) -> None:
        """Show a text (Markdown)."""
        self._text.content = text

    def place_camera(self, T_world_camera: np.ndarray, status: FrameStatus) -> None:
        """Move the frustum to a pose (4, 4), in the colour of a status."""
        vector = vector_from_pose(T_world_camera)
        self._pose = np.array(T_world_camera)
        if not self._has_eye:
            self._first_eye()
        with self._server.atomic():
            self._frustum.wxyz, self._frustum.position = vector[:4], vector[4:]
            self._frustum.color = STATUS_COLORS.get(status, PATH_COLOR)
        if self._follow.value:
            self._follow_camera()

    def show_path(self, positions: np.ndarray) -> None:
        """Draw the camera's path through positions (N, 3); only the part that is new or has moved is sent."""
        before, self._path = self._path, np.asarray(positions, np.float32)
        parts = range(0, max(len(self._path) - 1, 0), _PATH_PART)
        for number, start in enumerate(parts):
            part = self._path[start : start + _PATH_PART + 1]
            old = before[start : start + _PATH_PART + 1]
            if len(part) != len(old) or not np.allclose(part, old, atol=1e-4):
                segments = np.stack([part[:-1], part[1:]], axis=1)
                self._server.scene.add_line_segments(
                    f"/path/{number}", segments, PATH_COLOR, thickness=2.0, thickness_units="screen"
                )
        for number in range(len(parts), -(-max(len(before) - 1, 0) // _PATH_PART)):
            self._server.scene.remove_by_name(f"/path/{number}")

    def show_keyframes(self, poses: np.ndarray) -> None:
        """Draw keyframes at poses (K, 4, 4); those that are new or have moved are sent."""
        camera = self._camera
        angle = 2 * float(np.arctan(camera.height / (2 * camera.fy)))
        before, self._keyframes = self._keyframes, np.array(poses).reshape(-1, 4, 4)
        for number, pose in enumerate(self._keyframes):
            if number < len(before) and np.allclose(before[number], pose, atol=1e-3):
                continue
            vector = vector_from_pose(pose)
            self._server.scene.add_camera_frustum(
                f"/keyframes/{number}", angle, camera.width / camera.height, scale=0.08, thickness=1.0,
                thickness_units="screen", color=KEYFRAME_COLOR, wxyz=vector[:4], position=vector[4:],
            )  # fmt: skip
        for number in range(len(poses), len(before)):
            self._server.scene.remove_by_name(f"/keyframes/{number}")

    def show_loops(self, lines: np.ndarray) -> None:
        """Draw a line (L, 2, 3) between the two keyframes of each loop; sent where one is new or has moved."""
        before, self._loops = self._loops, np.asarray(lines, np.float32).reshape(-1, 2, 3)
        if len(before) == len(self._loops) and np.allclose(before, self._loops, atol=1e-3):
            return
        if not len(self._loops):
            self._server.scene.remove_by_name("/loops/lines")
            return
        self._server.scene.add_line_segments(
            "/loops/lines", self._loops, LOOP_COLOR, thickness=3.0, thickness_units="screen"
        )

    def show_input(self, rgb: np.ndarray) -> None:
        """Show what the camera sees, uint8 (H, W, 3)."""
        self._input.image = _small(rgb, enlarge=True)

    def show_rendering(self, rgb: np.ndarray) -> None:
        """Show what the map renders, uint8 (H, W, 3), scaled up to the input's size."""
        self._rendering.visible = True
        self._rendering.image = _small(rgb, enlarge=True)

    def show_surface(self, name: str, mesh: Any | None) -> None:
        """Show a part of the mesh (``vertices``, ``faces``, ``colors``) in place of the one of that name; None removes
        it.
        """
        if mesh is None:
            self._server.scene.remove_by_name(f"/map/{name}")
            return
        self._server.scene.add_glb(f"/map/{name}", glb(mesh.vertices, mesh.faces, mesh.colors))

    def close(self) -> None:
        """Serve no more."""
        with _silence():
            self._server.stop()

    def wait_while_watched(self) -> None:
        """Until no browser has the page open."""
        while self.is_watched:
            time.sleep(0.2)

    def _first_eye(self) -> None:
        """Where one looks from at first: from behind and above the camera."""
        self._has_eye = True
        T = self._pose
        # People hold cameras upright: up is the axis of the world nearest to the image's.
        up = -T[:3, 1]
        axis = int(np.argmax(np.abs(up)))
        self._up = np.eye(3)[axis] * np.sign(up[axis])
        self._server.scene.set_up_direction(tuple(self._up))
        eye, target = self._eye(3.0)
        self._server.initial_camera.position = tuple(eye)
        self._server.initial_camera.look_at = tuple(target)
        self._server.initial_camera.up = tuple(self._up)

    def _eye(self, distance: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        T = self._pose
        target = T[:3, 3] + T[:3, 2]
        return T[:3, 3] + distance * (_FOLLOW_UP * self._up - _FOLLOW_BACK * T[:3, 2]), target

    def _follow_camera(self) -> None:
        if not self._follow.value:
            return
        eye, target = self._eye()
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.up_direction = self._up
                client.camera.position = eye
                client.camera.look_at = target


@contextmanager
def _silence() -> Iterator[None]:
    """Without what viser prints: where the page is, is said by whoever opens it."""
    with redirect_stdout(io.StringIO()):
        yield


def require_viser() -> None:
    """Before a run, not after its set-up.

    Raises:
        MissingDependencyError: viser is not installed.
    """
    _viser()


def _viser() -> Any:
    try:
        import viser
    except ImportError as error:
        message = "looking on in a browser needs the package viser; type: pip install viser"
        raise MissingDependencyError(message) from error
    logging.getLogger("websockets").setLevel(logging.ERROR)
    return viser


def _small(rgb: np.ndarray, *, enlarge: bool = False) -> np.ndarray:
    import cv2

    height, width = rgb.shape[:2]
    if width <= _IMAGE_WIDTH and not enlarge:
        return rgb
    size = (_IMAGE_WIDTH, max(1, round(height * _IMAGE_WIDTH / width)))
    return cv2.resize(rgb, size, interpolation=cv2.INTER_LINEAR if width < _IMAGE_WIDTH else cv2.INTER_AREA)
