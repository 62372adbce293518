"""What may go wrong with the input of a tracker, done to a sequence whose truth is known.

Each function takes a sequence and returns another one, whose frames are made when they are asked for; all but
`drop_frames` and `stand_still` keep the number of frames. Random choices depend on the seed and the frame's number
only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from warpslam.errors import ConfigError, InputError
from warpslam.sequences.base import Frame, RgbdSequence
from warpslam.synthetic.noise import sensor_noise
from warpslam.synthetic.textures import value_noise

Change = Callable[[int, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Frame number, rgb uint8 (H, W, 3) and depth [m] float32 (H, W) to changed rgb and depth; may write into them."""

Base = TypeVar("Base", bound=RgbdSequence)

SKIN = (0.55, 0.35, 0.28)
HAND_DISTANCE = 0.25  # [m]


class AlteredSequence(RgbdSequence):
    """A sequence seen through a change of its frames.

    mesh: The surface that ``base`` shows, if it is known.
    warp_modules: Modules of kernels that rendering needs, as `RenderedSequence` has them.
    """

    def __init__(
        self,
        base: RgbdSequence,
        name: str,
        *,
        images: Sequence[int] | np.ndarray | None = None,
        places: Sequence[int] | np.ndarray | None = None,
        times: np.ndarray | None = None,
        change: Change | None = None,
    ) -> None:
        """Lay out the frames.

        Args:
            base: Sequence that the frames are of.
            name: What is done to it; goes behind its name.
            images: Frame of ``base`` that each frame shows; its own number if None.
            places: Frame of ``base`` whose pose and time is each frame's truth; as ``images`` if None.
            times: Times [s], shape (N,); those of ``places`` if None.
            change: What is done to rgb and depth.
        """
        self.base = base
        self.name = f"{base.name}+{name}"
        self.intrinsics = base.intrinsics
        self.preset = base.preset
        self.timing = base.timing
        self.can_read_ahead = base.can_read_ahead
        self.mesh = getattr(base, "mesh", None)
        self.warp_modules = getattr(base, "warp_modules", ())
        self.images = np.arange(len(base)) if images is None else np.asarray(images)
        self.places = self.images if places is None else np.asarray(places)
        self._times = times
        self._change = change

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> Frame:
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.name}: frame {index} of {len(self)}")
        index %= len(self)
        shown, place = int(self.images[index]), int(self.places[index])
        frame = self.base[shown]
        rgb, depth, pose = frame.rgb.copy(), frame.depth.copy(), frame.T_world_camera
        if place != shown:
            truth = self.base.ground_truth()
            pose = None if truth is None else truth[place].copy()
        if self._change is not None:
            rgb, depth = self._change(index, rgb, depth)
        time, own = self.timestamp(index), frame.depth_timestamp
        depth_time = None if own is None else time + own - frame.timestamp
        return Frame(index, time, rgb, depth.astype(np.float32, copy=False), pose, depth_time)

    def timestamp(self, index: int) -> float:
        """Time of a frame [s]."""
        if self._times is not None:
            return float(self._times[index])
        place = int(self.places[index])
        if hasattr(self.base, "timestamp"):
            return float(self.base.timestamp(place))
        known = getattr(self.base, "timestamps", None)  # of files
        return self.base[place].timestamp if known is None else float(known[place])

    def ground_truth(self) -> np.ndarray | None:
        """All poses, float64, shape (N, 4, 4), NaN where one is unknown; None if there are none."""
        truth = self.base.ground_truth()
        return None if truth is None else truth[self.places]


def stand_still(sequence: RgbdSequence, *, at: int = 0, count: int = 300, seed: int = 0) -> AlteredSequence:
    """The camera stands at frame ``at`` for ``count`` frames, with new noise each, in colour of 2 grey values."""

    def change(index: int, rgb: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng([seed, index])
        noisy = rgb + rng.normal(scale=2.0, size=rgb.shape)
        return _to_bytes(noisy), sensor_noise(depth, rng, sequence.intrinsics)

    _check_range(sequence, at, 1)
    times = sequence[at].timestamp + np.arange(count) / 30.0
    return AlteredSequence(sequence, "still", images=np.full(count, at), times=times, change=change)


def switch_light(sequence: RgbdSequence, *, at: int | None = None, off: int = 20) -> AlteredSequence:
    """A lamp goes out at frame ``at`` (the middle one) and comes on again ``off`` frames later.

    What is left is 45 % of the light, warmer, and comes from the left of the image.
    """
    at = len(sequence) // 2 if at is None else at
    _check_range(sequence, at, 1)
    side = np.linspace(1.25, 0.75, sequence.intrinsics.width)[None, :, None] * np.array([0.47, 0.45, 0.40])

    def change(index: int, rgb: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (_to_bytes(rgb * side) if at <= index < at + off else rgb), depth

    return AlteredSequence(sequence, "light", change=change)


def auto_exposure(sequence: RgbdSequence, *, seed: int = 0, strength: float = 0.5) -> AlteredSequence:
    """Gain between 1 and 1 - ``strength``, and bias of up to 15 grey values, drift over about ten frames."""

    def change(index: int, rgb: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        place = np.array([[index / 10.0, 17.0 * seed, 0.5], [index / 10.0, 17.0 * seed, 50.5]])
        gain, bias = value_noise(place)
        return _to_bytes(rgb * (1.0 - strength * gain) + 15.0 * bias), depth

    return AlteredSequence(sequence, "exposure", change=change)


def cover_lens(sequence: RgbdSequence, *, at: int | None = None, count: int = 10, seed: int = 0) -> AlteredSequence:
    """A hand comes before the lens at frame ``at`` (the middle one) for ``count`` frames, and moves there.

    It covers nine tenths of the image, 25 cm away, and is seen by both cameras.
    """
    at = len(sequence) // 2 if at is None else at
    _check_range(sequence, at, count)
    k = sequence.intrinsics
    v, u = np.mgrid[: k.height, : k.width]

    def change(index: int, rgb: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if not at <= index < at + count:
            return rgb, depth
        shift = np.random.default_rng([seed, index]).normal(scale=0.01 * k.width, size=2)
        x, y = (u - shift[0]) / k.width, (v - shift[1]) / k.height
        hand = x + 0.08 * np.sin(9.0 * y + index) < 0.9
        lines = value_noise(np.column_stack([6.0 * x[hand], 40.0 * y[hand], np.full(hand.sum(), 0.5)]))
        rgb[hand] = _to_bytes(255.0 * np.array(SKIN) * (0.85 + 0.15 * lines[:, None]))
        depth[hand] = HAND_DISTANCE + 0.03 * np.cos(5.0 * x[hand])
        return rgb, depth

    return AlteredSequence(sequence, "hand", change=change)


def freeze(sequence: RgbdSequence, *, at: int | None = None, count: int = 15) -> AlteredSequence:
    """From frame ``at`` (the middle one) on the same image comes ``count`` times while the camera moves on."""
    at = len(sequence) // 2 if at is None else at
    _check_range(sequence, at, count)
    frames = np.arange(len(sequence))
    shown = np.where((frames > at) & (frames < at + count), at, frames)
    return AlteredSequence(sequence, "frozen", images=shown, places=frames)


def drop_frames(sequence: RgbdSequence, *, at: int | None = None, count: int = 100) -> AlteredSequence:
    """``count`` frames from ``at`` on (the middle ones) never arrive; times tell."""
    at = (len(sequence) - count) // 2 if at is None else at
    _check_range(sequence, at, count)
    frames = np.arange(len(sequence))
    return AlteredSequence(sequence, "dropped", images=frames[(frames < at) | (frames >= at + count)])


def black_out(sequence: RgbdSequence, *, at: int | None = None, count: int = 10) -> AlteredSequence:
    """``count`` frames from ``at`` (the middle one) on are black; their depth is as it was."""
    at = len(sequence) // 2 if at is None else at
    _check_range(sequence, at, count)

    def change(index: int, rgb: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (np.zeros_like(rgb) if at <= index < at + count else rgb), depth

    return AlteredSequence(sequence, "black", change=change)


def kinect_noise(sequence: RgbdSequence, *, seed: int = 0) -> AlteredSequence:
    """Depth of a Kinect: `sensor_noise`, up to 5 m; colour with noise of 1.5 grey values."""

    def change(index: int, rgb: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng([seed, index])
        depth = sensor_noise(depth, rng, sequence.intrinsics, max_depth=5.0)
        return _to_bytes(rgb + rng.normal(scale=1.5, size=rgb.shape)), depth

    return AlteredSequence(sequence, "kinect", change=change)


def half_depth(sequence: RgbdSequence, *, seed: int = 0, share: float = 0.5) -> AlteredSequence:
    """``share`` of the depth is missing: the farthest of it, and patches that hang on places of the image and drift."""
    k = sequence.intrinsics
    v, u = np.mgrid[: k.height, : k.width]
    cells = 0.11 * k.width  # [px], size of a patch

    def change(index: int, rgb: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        known = depth > 0
        if not known.any():
            return rgb, depth
        places = np.column_stack([u.ravel() / cells + 0.2 * index, v.ravel() / cells, np.full(u.size, 3.3 + seed)])
        patches = value_noise(places).reshape(depth.shape)
        # What is far goes first: rank of the distance and noise of the patches, of equal weight.
        worth = patches - (np.searchsorted(np.sort(depth[known]), depth) / known.sum())
        limit = np.quantile(worth[known], share)
        return rgb, np.where(worth >= limit, depth, 0.0)

    return AlteredSequence(sequence, "half", change=change)


def carry_lamp(
    sequence: RgbdSequence, *, share: float = 0.5, reach: float = 1.0, spot: float = 25.0
) -> AlteredSequence:
    """``share`` of the light comes from a lamp on the camera: shading goes along with the camera, not with the surface.

    It falls off with the distance as 1 / (1 + (d / ``reach``)^2) [m], and from the middle as a bell of ``spot``
    degrees; where depth is missing as at 5 m. The brightest place is as bright as before.
    """
    k = sequence.intrinsics
    v, u = np.mgrid[: k.height, : k.width]
    x, y = (u - k.cx) / k.fx, (v - k.cy) / k.fy
    ray = np.sqrt(1.0 + x**2 + y**2)
    bell = np.exp(-0.5 * (np.degrees(np.arccos(1.0 / ray)) / spot) ** 2)

    def change(index: int, rgb: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distance = np.where(depth > 0, depth, 5.0) * ray
        light = bell / (1.0 + (distance / reach) ** 2)
        light = (1.0 - share) + share * light / light.max()
        return _to_bytes(rgb * light[..., None]), depth

    return AlteredSequence(sequence, "lamp", change=change)


ALTERATIONS: dict[str, Callable[[RgbdSequence], AlteredSequence]] = {
    "kinect": kinect_noise,
    "half": half_depth,
    "still": stand_still,
    "light": switch_light,
    "exposure": auto_exposure,
    "hand": cover_lens,
    "frozen": freeze,
    "dropped": drop_frames,
    "black": black_out,
    "lamp": carry_lamp,
}
"""What can be done to a sequence, by name, with its defaults."""


def altered(sequence: Base, names: Sequence[str]) -> Base | AlteredSequence:
    """``sequence`` with `ALTERATIONS` applied one after another.

    Raises:
        ConfigError: One of the names is unknown.
        InputError: The sequence is too short for one of them.
    """
    result: Base | AlteredSequence = sequence
    for name in names:
        if name not in ALTERATIONS:
            raise ConfigError(f"alteration {name!r} is unknown; choose from {', '.join(ALTERATIONS)}")
        result = ALTERATIONS[name](result)
    return result


def _check_range(sequence: RgbdSequence, at: int, count: int) -> None:
    if at < 0 or count < 1 or at + count > len(sequence):
        raise InputError(f"{sequence.name} has {len(sequence)} frames: none for {count} from frame {at} on")


def _to_bytes(rgb: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(rgb, 0.0, 255.0)).astype(np.uint8)
