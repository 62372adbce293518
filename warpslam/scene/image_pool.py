"""RGB-D images of the frames in play: compact in host memory, in slots on the device."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpslam.camera import NO_MOTION, FrameMotion, Intrinsics
from warpslam.errors import MapSizeError
from warpslam.kernels import images as image_kernels
from warpslam.runtime.environment import check_memory
from warpslam.scene.rectification import Rectifier

_Image = tuple[np.ndarray, np.ndarray, float]


class ImagePool:
    """RGB-D images: all of them compact and lossless in host memory, those in use on the device.

    On the device an image lies in a slot: colour as uint8, depth as uint16 times a scale of its own, which keeps depth
    to 1/131070 of the image's largest depth (0.04 mm at 5 m). Slot 0 is the current frame; the others are a cache of
    the images that `bring` was asked for last. Which slot an image is in changes no result.

    Images are kept as they were taken. A slot holds the image as it was taken, or rectified by how the camera moved
    meanwhile: slot 0 from `rectify_current` on, until the next `set`, and the others if `bring` was told of a motion.

    Args:
        camera: Its image size.
        device: Where the slots are.
        max_gigabytes: The slots take no more than this [GB]; they start few and grow.
    """

    def __init__(self, camera: Intrinsics, device: wp.Device, max_gigabytes: float = np.inf, capacity: int = 8) -> None:
        self.camera, self.device = camera, device
        image_bytes = 5 * camera.height * camera.width
        self.max_slots = int(min(max_gigabytes * 1e9 / image_bytes, 1 << 30))
        self._kept: list[CompactImage | Future[CompactImage]] = []
        self._slot_of: dict[int, int] = {}  # by image, the one used longest ago first
        self._motion_of: dict[int, FrameMotion] = {}  # by image that has a slot: what it was rectified by
        self._rectifier = Rectifier(camera, device)
        # What slot 0 held before it was rectified, and where other images are before they are; allocated when needed.
        self._raw_current: tuple[wp.array, wp.array, wp.array] | None = None
        self._raw: tuple[wp.array, wp.array, wp.array] | None = None
        self.motion = NO_MOTION
        self._allocate(max(min(capacity, self.max_slots), 1))
        size = (camera.height, camera.width)
        self._metres = wp.zeros(size, dtype=float, device=device)
        # What slot 0 holds, so that nothing that is here already comes back from the device; None if only that has it.
        self._current: _Image | None = (np.zeros((*size, 3), np.uint8), np.zeros(size, np.uint16), 0.0)
        self._upload = _Upload(camera, device) if device.is_cuda else None
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="warpslam-images") if device.is_cuda else None

    def _allocate(self, capacity: int) -> None:
        shape = (capacity, self.camera.height, self.camera.width)
        size = f"{self.camera.width} x {self.camera.height}"
        check_memory(self.device, 5 * np.prod(shape, dtype=float), f"{capacity} images of {size}: use smaller ones")
        self.rgb = wp.zeros((*shape, 3), dtype=wp.uint8, device=self.device)
        self.depth = wp.zeros(shape, dtype=wp.uint16, device=self.device)
        self.scale = wp.zeros(capacity, dtype=float, device=self.device)

    @property
    def arrays(self) -> tuple[wp.array, wp.array, wp.array]:
        """Colour (slots, H, W, 3), depth (slots, H, W) and its scale (slots,) as the kernels read them."""
        return self.rgb, self.depth, self.scale

    def fork(self) -> ImagePool:
        """A pool with slots of its own that shares the kept images, also those added later: for another thread."""
        other = ImagePool(self.camera, self.device, capacity=self.rgb.shape[0])
        other.max_slots, other._kept = self.max_slots, self._kept
        return other

    def copy_current(self, other: ImagePool) -> None:
        """Put into slot 0 what the other pool holds there."""
        for target, source in zip(self.arrays, other.arrays, strict=True):
            wp.copy(target, source, count=source.size // source.shape[0])
        self._current, self.motion = other._current, other.motion
        if other._raw_current is not None:
            self._raw_current = self._raw_current or self._rectifier.new_image()
            for target, source in zip(self._raw_current, other._raw_current, strict=True):
                wp.copy(target, source)

    def set(self, slot: int, rgb: np.ndarray, depth: np.ndarray) -> None:
        """Store an image: uint8 (H, W, 3) and float32 (H, W) [m]."""
        if slot == 0:
            self.motion = NO_MOTION
        if self._upload is None:
            self._write(slot, rgb, *_quantized(depth))
            return
        self.scale[slot : slot + 1].assign(np.array([_scale(depth)], np.float32))
        metres = self._upload.start(rgb, depth, self.rgb[slot])
        inputs = [metres, self.scale[slot : slot + 1], self.depth[slot]]
        wp.launch(image_kernels.to_units, metres.shape, inputs, device=self.device, record_tape=False)
        if slot == 0:
            self._current = None

    def rectify_current(self, motion: FrameMotion) -> None:
        """Have slot 0 hold the current image as a camera would have taken it that moved so, but took all at once at the
        middle row of colour; from the image as it was taken, however often it is called.
        """
        if motion == self.motion or (motion.is_none and self.motion.is_none):
            self.motion = motion
            return
        self._raw_current = self._raw_current or self._rectifier.new_image()
        if self.motion.is_none:
            for raw, array in zip(self._raw_current, self.arrays, strict=True):
                wp.copy(raw, array, count=raw.size)
        if motion.is_none:
            for raw, array in zip(self._raw_current, self.arrays, strict=True):
                wp.copy(array, raw, count=raw.size)
        else:
            self._rectifier.rectify(self._raw_current, motion, self.arrays)
        self.motion = motion

    def show(self, image: int, motion: FrameMotion) -> None:
        """A kept image into slot 0, rectified by how the camera moved."""
        self.put_back(self.kept(image).unpack(self.camera), motion)

    def put_back(self, current: _Image, motion: FrameMotion) -> None:
        """Have slot 0 hold what `current` and `motion` were."""
        self.motion = NO_MOTION
        self._write(0, *current)
        self.rectify_current(motion)

    def add(self, rgb: np.ndarray, depth: np.ndarray) -> int:
        """Keep an image for `bring`; returns its number."""
        self._kept.append(CompactImage.of(rgb, *_quantized(depth)))
        return len(self._kept) - 1

    def add_kept(self, rgb: np.ndarray, units: np.ndarray, scale: float) -> int:
        """Keep an image as `current` returned it for `bring`; returns its number."""
        self._kept.append(CompactImage.of(rgb, units, scale))
        return len(self._kept) - 1

    def keep_current(self) -> int:
        """Keep the image of slot 0 for `bring`; returns its number."""
        current = self.current()
        self._kept.append(self._worker.submit(CompactImage.of, *current) if self._worker else CompactImage.of(*current))
        image = len(self._kept) - 1
        if 1 + len(self._slot_of) < self.rgb.shape[0]:
            # The next window will want it: a copy now spares unpacking it then.
            slot = self._slot_of[image] = self._free_slot([])
            self._motion_of[image] = self.motion
            for array in self.arrays:
                wp.copy(array[slot : slot + 1], array[:1])
        return image

    def kept(self, image: int) -> CompactImage:
        """An image that is kept, by its number."""
        found = self._kept[image]
        if isinstance(found, Future):
            found = self._kept[image] = found.result()
        return found

    def bring(self, images: Sequence[int], motions: Sequence[FrameMotion] = ()) -> list[int]:
        """Slots of some images, which are on the device until the next call.

        Args:
            images: Their numbers.
            motions: What each is rectified by; without any, images are as they were taken.

        Raises:
            MapSizeError: They do not fit into the memory set for them.
        """
        motion_of = dict(zip(images, motions, strict=True)) if motions else dict.fromkeys(images, NO_MOTION)
        wanted = list(motion_of)
        if 1 + len(wanted) > self.max_slots:
            raise MapSizeError(_too_many_images(self.camera, 1 + len(wanted), self.max_slots))
        while 1 + len(self._slot_of.keys() | set(wanted)) > self.rgb.shape[0] < self.max_slots:
            old = self.arrays
            self._allocate(min(2 * self.rgb.shape[0], self.max_slots))
            for source, target in zip(old, self.arrays, strict=True):
                wp.copy(target, source, count=source.size)
        for image in wanted:
            slot, motion = self._slot_of.pop(image, None), motion_of[image]
            if slot is None or not _same(motion, self._motion_of[image]):
                slot = self._free_slot(wanted) if slot is None else slot
                self._write(slot, *self.kept(image).unpack(self.camera))
                self._rectify(slot, motion)
            self._slot_of[image], self._motion_of[image] = slot, motion
        return [self._slot_of[image] for image in images]

    def _free_slot(self, wanted: list[int]) -> int:
        if 1 + len(self._slot_of) < self.rgb.shape[0]:
            return 1 + len(self._slot_of)
        return self._slot_of.pop(next(image for image in self._slot_of if image not in wanted))

    def _rectify(self, slot: int, motion: FrameMotion) -> None:
        if motion.is_none:
            return
        self._raw = self._raw or self._rectifier.new_image()
        target = self.rgb[slot : slot + 1], self.depth[slot : slot + 1], self.scale[slot : slot + 1]
        for raw, array in zip(self._raw, target, strict=True):
            wp.copy(raw, array)
        self._rectifier.rectify(self._raw, motion, target)

    def _write(self, slot: int, rgb: np.ndarray, depth: np.ndarray, scale: float) -> None:
        self.rgb[slot].assign(np.ascontiguousarray(rgb))
        self.depth[slot].assign(depth)
        self.scale[slot : slot + 1].assign(np.array([scale], np.float32))
        if slot == 0:
            # The caller's array may be filled with the next frame.
            self._current = rgb.copy(), depth, float(np.float32(scale))

    def metres(self) -> wp.array:
        """Depth of slot 0 on the device [m], float32 (H, W); good until the next call."""
        inputs = [self.depth[0], self.scale, self._metres]
        wp.launch(image_kernels.to_metres, self._metres.shape, inputs, device=self.device, record_tape=False)
        return self._metres

    def current(self) -> tuple[np.ndarray, np.ndarray, float]:
        """The current image as it was taken: colour, uint16 depth, and its scale."""
        if self._current is None:
            arrays = self.arrays
            if not self.motion.is_none:
                assert self._raw_current is not None
                arrays = self._raw_current
            rgb, depth, scale = (array[:1].numpy()[0] for array in arrays)
            self._current = rgb, depth, float(scale)
        return self._current

    def current_depth(self) -> np.ndarray:
        """Depth of slot 0 as the kernels read it [m], float32 (H, W)."""
        if self.motion.is_none:
            _, depth, scale = self.current()
        else:
            depth, scale = self.depth[0].numpy(), self.scale[:1].numpy()[0]
        return depth.astype(np.float32) * np.float32(scale)

    def restore(
        self, current: tuple[np.ndarray, np.ndarray, float], motion: FrameMotion, images: list[CompactImage]
    ) -> None:
        """Put back what `current`, `motion` and the kept images were."""
        self.put_back(current, motion)
        self._kept, self._slot_of = list(images), {}

    @property
    def device_bytes(self) -> int:
        """Memory of the slots, and of images before they are rectified."""
        arrays = (*self.arrays, *(self._raw_current or ()), *(self._raw or ()))
        return sum(array.capacity for array in arrays)

    @property
    def compact_bytes(self) -> int:
        """Memory of the compact images."""
        return sum(len(image.rgb) + len(image.depth) for image in map(self.kept, range(len(self._kept))))


class _Upload:
    """Carries images to a GPU from memory that the device reads by itself."""

    def __init__(self, camera: Intrinsics, device: wp.Device) -> None:
        size = (camera.height, camera.width)
        self._rgb = wp.empty((*size, 3), dtype=wp.uint8, device="cpu", pinned=True)
        self._depth = wp.empty(size, dtype=float, device="cpu", pinned=True)
        self._metres = wp.empty(size, dtype=float, device=device)
        self._done = wp.Event(device)
        self._is_under_way = False

    def start(self, rgb: np.ndarray, depth: np.ndarray, target: wp.array) -> wp.array:
        """Copy colour to ``target``, and depth to the array that is returned [m], without waiting."""
        if self._is_under_way:
            wp.synchronize_event(self._done)
        np.copyto(self._rgb.numpy(), rgb)
        np.copyto(self._depth.numpy(), depth)
        wp.copy(target, self._rgb)
        wp.copy(self._metres, self._depth)
        wp.get_stream(self._metres.device).record_event(self._done)
        self._is_under_way = True
        return self._metres


def _same(a: FrameMotion, b: FrameMotion) -> bool:
    return a == b or (a.is_none and b.is_none)


def check_window_fits(camera: Intrinsics, max_gigabytes: float, window: int) -> None:
    """Raise `MapSizeError` if images of two windows and the current frame do not fit into ``max_gigabytes``."""
    slots = int(min(max_gigabytes * 1e9 / (5 * camera.height * camera.width), 1 << 30))
    if slots < 1 + 2 * window:
        raise MapSizeError(_too_many_images(camera, 1 + 2 * window, slots))


def _too_many_images(camera: Intrinsics, needed: int, slots: int) -> str:
    gigabytes = 5 * camera.height * camera.width / 1e9
    return (
        f"mapping needs {needed} images of {camera.width} x {camera.height} at a time, {needed * gigabytes:.4f} GB, "
        f"and keyframes.max_gigabytes has room for {slots}: raise it, or lower mapping.window"
    )


@dataclass(frozen=True)
class CompactImage:
    """An image of the pool, compressed without loss: each value as the difference to its left neighbour, by zlib.

    PNG would be slower, and larger for depth.
    """

    rgb: bytes
    """Compressed differences."""
    depth: bytes
    """Compressed differences, the low bytes of all pixels first."""
    scale: float
    """Metres per unit of depth."""

    @classmethod
    def of(cls, rgb: np.ndarray, depth: np.ndarray, scale: float) -> CompactImage:
        """From uint8 (H, W, 3) and uint16 (H, W)."""
        differences = np.diff(depth, axis=1, prepend=np.uint16(0)).astype("<u2", copy=False)
        planes = np.stack([differences & 0xFF, differences >> 8]).astype(np.uint8)
        return cls(_deflated(np.diff(rgb, axis=1, prepend=np.uint8(0))), _deflated(planes), scale)

    def unpack(self, camera: Intrinsics) -> tuple[np.ndarray, np.ndarray, float]:
        """Colour uint8 (H, W, 3), depth uint16 (H, W), and scale, as they were."""
        height, width = camera.height, camera.width
        rgb = np.cumsum(_inflated(self.rgb, (height, width, 3)), axis=1, dtype=np.uint8)
        low, high = _inflated(self.depth, (2, height, width)).astype(np.uint16)
        return rgb, np.cumsum(low | high << 8, axis=1, dtype=np.uint16), self.scale


def _deflated(array: np.ndarray) -> bytes:
    return zlib.compress(array.tobytes(), 1)


def _inflated(data: bytes, shape: tuple[int, ...]) -> np.ndarray:
    size = int(np.prod(shape))
    inflater = zlib.decompressobj()
    # No more than the image needs, whatever the data say.
    content = inflater.decompress(data, size)
    if len(content) != size or inflater.decompress(inflater.unconsumed_tail, 1):
        raise ValueError(f"a compressed image does not hold the {size} bytes of {shape}")
    return np.frombuffer(content, np.uint8).reshape(shape)


def _scale(depth: np.ndarray) -> float:
    """Metres per unit at which the largest depth just fits."""
    return float(depth.max()) / 65535.0 or 1.0


def _quantized(depth: np.ndarray) -> tuple[np.ndarray, float]:
    scale = _scale(depth)
    return np.rint(depth / scale).astype(np.uint16), scale
