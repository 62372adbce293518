"""The camera of a stored sequence: intrinsics, depth unit, distortion, and how frames are resized and cropped."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from warpslam.camera import ONE_MOMENT, Intrinsics, SensorTiming
from warpslam.errors import ConfigError, DatasetError, InputError, brief
from warpslam.poses import check_transform
from warpslam.reading import YAML_LIMIT, load_yaml, read_bytes
from warpslam.sequences.registration import ColorCamera

CAMERA_FIELDS = ("fx", "fy", "cx", "cy", "width", "height", "depth_scale")
CAMERA_FILE = "camera.yaml"
_MAX_SIZE = 16384  # [pixels], what OpenCV warps without trouble
_OPTIONAL_FIELDS = (
    "distortion", "depth_distorted", "resize", "crop", "published_resize", "published_crop", "depth_delay", "readout",
    "along_ray", "color", "T_color_depth",
)  # fmt: skip
_COLOR_FIELDS = (*CAMERA_FIELDS[:-1], "distortion")
_DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)


@dataclass(frozen=True)
class Calibration:
    """Camera of the images as stored, and what the reader does to them before returning a frame."""

    stored: Intrinsics
    """Intrinsics of the stored depth images (and of the colour images once they have that size)."""
    depth_scale: float
    """Stored depth units per metre."""
    distortion: tuple[float, ...] = ()
    """OpenCV coefficients (k1, k2, p1, p2, k3, ...) of the colour images; empty = none."""
    resize: tuple[int, int] | None = None
    """Size (width, height) to which frames are resized first; None = as stored."""
    crop: int = 0
    """Border [pixels] cut from every side after resizing."""
    depth_distorted: bool = False
    """Whether depth lies in the pixels of the distorted colour image, so that it is undistorted, too."""
    published_resize: tuple[int, int] | None = None
    """Size to which the paper's code resizes the frames; None = as ``resize``."""
    published_crop: int | None = None
    """Border that the paper's code then cuts; None = as ``crop``."""
    stored_timing: SensorTiming = ONE_MOMENT
    """When the pixels of the stored images are taken."""
    source: str = "camera"
    """Where the numbers come from, for messages."""
    along_ray: bool = False
    """Whether depth is stored as the distance along the ray, not along the optical axis."""
    color: ColorCamera | None = None
    """The camera of the colour images, where it is not that of depth."""

    @property
    def registered(self) -> Intrinsics:
        """The one camera into which colour and depth are brought: that of depth, but where colour was taken from
        another place, since depth can be carried to it and colour can't.
        """
        if self.color is None or self.color.shares_centre:
            return self.stored
        return self.color.at_resolution_of(self.stored)

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics of the frames as returned."""
        resized = self.registered if self.resize is None else self.registered.scaled(*self.resize)
        return resized.cropped(self.crop) if self.crop else resized

    @property
    def timing(self) -> SensorTiming:
        """When the pixels of the frames as returned are taken: rows that are cut off are not read by them."""
        rows = self.intrinsics.height
        return replace(self.stored_timing, readout=self.stored_timing.readout * rows / (rows + 2 * self.crop))

    def timing_as_stored(self, timing: SensorTiming) -> SensorTiming:
        """The timing of the images as stored, by that of the frames as returned."""
        rows = self.intrinsics.height
        return replace(timing, readout=timing.readout * (rows + 2 * self.crop) / rows)

    def as_published(self) -> Calibration:
        """With frames resized and cropped as in the paper's code, and depth left as it is stored."""
        return replace(
            self,
            resize=self.published_resize or self.resize,
            crop=self.crop if self.published_crop is None else self.published_crop,
            depth_distorted=False,
        )

    def to_yaml(self) -> str:
        """The text of a ``camera.yaml`` that `from_yaml` reads back; fields at their defaults are left out."""
        import yaml

        fields: dict[str, Any] = {**asdict(self.stored), "depth_scale": self.depth_scale}
        if self.distortion:
            fields["distortion"] = list(self.distortion)
        if self.resize is not None:
            fields["resize"] = list(self.resize)
        if self.crop:
            fields["crop"] = self.crop
        if self.depth_distorted:
            fields["depth_distorted"] = True
        fields |= {name: value for name, value in asdict(self.stored_timing).items() if value}
        if self.along_ray:
            fields["along_ray"] = True
        if self.color is not None:
            fields["color"] = asdict(self.color.intrinsics)
            if self.color.distortion:
                fields["color"]["distortion"] = list(self.color.distortion)
            fields["T_color_depth"] = list(self.color.T_color_depth)
        return yaml.safe_dump(fields, sort_keys=False, default_flow_style=None)

    @classmethod
    def from_fields(cls, fields: dict[str, Any], source: str) -> Calibration:
        """Check and convert a mapping with `CAMERA_FIELDS` and, where wanted, distortion, resize, crop, depth_delay and
        readout [s], along_ray, and the camera of colour as color and T_color_depth.
        """
        unknown = sorted(set(map(str, fields)) - set(CAMERA_FIELDS) - set(_OPTIONAL_FIELDS))
        if unknown:
            known = ", ".join(CAMERA_FIELDS + _OPTIONAL_FIELDS)
            raise DatasetError(f"{source}: unknown field {brief(', '.join(unknown))}; known fields are {known}")
        missing = [name for name in CAMERA_FIELDS if name not in fields]
        if missing:
            raise DatasetError(f"{source}: field {', '.join(missing)} is missing; add it")
        values = {name: _number(fields[name], name, source) for name in CAMERA_FIELDS}
        depth_scale = values.pop("depth_scale")
        if depth_scale <= 0:
            raise DatasetError(
                f"{source}: depth_scale = {depth_scale:g} must be positive: stored depth units per metre, "
                "1000 for millimetres"
            )
        width, height = (_whole(values.pop(name), name, source) for name in ("width", "height"))
        if max(width, height) > _MAX_SIZE:
            raise DatasetError(
                f"{source}: width x height = {width} x {height} must be at most {_MAX_SIZE} pixels each; correct it"
            )
        resize = _size(fields, "resize", source)
        distortion = _numbers(fields.get("distortion") or (), "distortion", source)
        if len(distortion) not in _DISTORTION_LENGTHS:
            raise DatasetError(
                f"{source}: distortion has {len(distortion)} numbers; give OpenCV's k1, k2, p1, p2, k3 or leave it out"
            )
        crop = _whole(_number(fields.get("crop") or 0, "crop", source), "crop", source)
        if crop < 0:
            raise DatasetError(f"{source}: crop = {crop} must be 0 or more pixels")
        depth_distorted, along_ray = (_switch(fields, name, source) for name in ("depth_distorted", "along_ray"))
        published_crop = fields.get("published_crop")
        if published_crop is not None:
            published_crop = _whole(_number(published_crop, "published_crop", source), "published_crop", source)
        seconds = {name: _number(fields.get(name) or 0.0, name, source) for name in ("depth_delay", "readout")}
        try:
            stored = Intrinsics(**values, width=width, height=height)
            calibration = cls(
                stored,
                depth_scale,
                distortion,
                resize,
                crop,
                depth_distorted=depth_distorted,
                published_resize=_size(fields, "published_resize", source),
                published_crop=published_crop,
                stored_timing=SensorTiming(**seconds),
                source=source,
                along_ray=along_ray,
                color=_color_camera(fields, source),
            )
            if calibration.color is not None and distortion:
                raise DatasetError(f"{source}: distortion belongs to colour: move it into color")
            # A crop larger than the image shows here.
            _ = calibration.intrinsics
        except ConfigError as error:
            raise DatasetError(f"{source}: {error}") from error
        return calibration

    @classmethod
    def from_yaml(cls, path: Path) -> Calibration:
        """Read a ``camera.yaml``."""
        try:
            text = read_bytes(path, YAML_LIMIT)
        except OSError as error:
            raise DatasetError(f"{path}: can't be read ({error.strerror}); correct or remove the file") from error
        return cls.from_fields(_load_yaml(text, str(path)), str(path))

    @classmethod
    def from_text(cls, text: str) -> Calibration:
        """Parse "fx,fy,cx,cy,width,height,depth_scale"."""
        parts = [part.strip() for part in text.replace(";", ",").split(",")]
        if len(parts) != len(CAMERA_FIELDS):
            raise DatasetError(
                f"camera = {brief(repr(text))} has {len(parts)} numbers; give {len(CAMERA_FIELDS)}: "
                f"{','.join(CAMERA_FIELDS)}"
            )
        return cls.from_fields(dict(zip(CAMERA_FIELDS, parts, strict=True)), f"camera = {brief(repr(text))}")

    @classmethod
    def of_dataset(cls, name: str) -> Calibration:
        """The camera that comes with the package as ``cameras/<name>.yaml``."""
        file = resources.files("warpslam.sequences") / "cameras" / f"{name}.yaml"
        source = f"built-in camera {name}"
        return cls.from_fields(_load_yaml(file.read_bytes(), source), source)


def find_calibration(folder: Path, camera: str | None, default: str | None, remedy: str = "") -> Calibration:
    """Camera of the sequence in ``folder``: the argument, else the folder's camera.yaml, else the built-in ``default``.

    Raises:
        DatasetError: If the numbers can't be used, or there is none of the three (then ``remedy`` ends the message).
    """
    if camera is not None:
        return Calibration.from_text(camera)
    if has_own_camera(folder):
        return Calibration.from_yaml(folder / CAMERA_FILE)
    if default is None:
        raise DatasetError(
            f"{folder}: camera unknown. {remedy}Write a camera.yaml with {', '.join(CAMERA_FIELDS)} into the folder "
            f"or give the camera as {','.join(CAMERA_FIELDS)}"
        )
    return Calibration.of_dataset(default)


def has_own_camera(folder: Path) -> bool:
    """Whether the sequence in ``folder`` brings its camera.yaml."""
    return (folder / CAMERA_FILE).is_file()


def _load_yaml(text: bytes, source: str) -> dict[str, Any]:
    try:
        fields = load_yaml(text)
    except ValueError as error:
        raise DatasetError(f"{source}: not valid YAML ({brief(error)}); write one 'name: number' a line") from error
    if not isinstance(fields, dict):
        raise DatasetError(f"{source}: holds no fields; write one 'name: number' a line for {', '.join(CAMERA_FIELDS)}")
    return fields


def _switch(fields: dict[str, Any], name: str, source: str) -> bool:
    value = fields.get(name, False)
    if not isinstance(value, bool):
        raise DatasetError(f"{source}: {name} = {brief(repr(value))} must be true or false")
    return value


def _color_camera(fields: dict[str, Any], source: str) -> ColorCamera | None:
    """The camera in the field color, and its place in T_color_depth; None without."""
    given = fields.get("color")
    if given is None:
        if fields.get("T_color_depth") is not None:
            raise DatasetError(f"{source}: T_color_depth needs the camera of colour: add color with {_COLOR_FIELDS}")
        return None
    if not isinstance(given, dict) or set(map(str, given)) - set(_COLOR_FIELDS):
        raise DatasetError(f"{source}: color must have the fields {', '.join(_COLOR_FIELDS)}, and no others")
    camera = Calibration.from_fields({**given, "depth_scale": 1}, f"{source}: color")
    transform = _numbers(fields.get("T_color_depth") or np.eye(4).ravel().tolist(), "T_color_depth", source)
    if len(transform) != 16:
        raise DatasetError(f"{source}: T_color_depth has {len(transform)} numbers; give the 16 of a 4x4 matrix by rows")
    try:
        check_transform(np.array(transform).reshape(4, 4), "T_color_depth")
    except InputError as error:
        raise DatasetError(f"{source}: {error}") from error
    return ColorCamera(camera.stored, camera.distortion, transform)


def _number(value: Any, name: str, source: str) -> float:
    # YAML 1.1 reads 1e3 as a string, so strings are converted too.
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise DatasetError(f"{source}: {name} = {brief(repr(value))} must be a finite number")
    return number


def _numbers(value: Any, name: str, source: str) -> tuple[float, ...]:
    if not isinstance(value, (list, tuple)):
        raise DatasetError(f"{source}: {name} = {brief(repr(value))} must be a list of numbers")
    return tuple(_number(item, name, source) for item in value)


def _whole(value: float, name: str, source: str) -> int:
    if value != int(value):
        raise DatasetError(f"{source}: {name} = {value:g} must be a whole number of pixels")
    return int(value)


def _size(fields: dict[str, Any], name: str, source: str) -> tuple[int, int] | None:
    """Width and height [pixels] in a field; None where it is missing."""
    size = fields.get(name)
    if size is None:
        return None
    pair = _numbers(size, name, source)
    if len(pair) != 2 or min(pair) < 1 or max(pair) > _MAX_SIZE:
        raise DatasetError(
            f"{source}: {name} = {brief(repr(size))} must be [width, height] in pixels, 1 to {_MAX_SIZE} each"
        )
    return _whole(pair[0], name, source), _whole(pair[1], name, source)
