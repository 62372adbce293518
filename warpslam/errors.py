"""Typed errors. Every message names the file or field at fault and says what to do."""


class WarpSlamError(Exception):
    """Base of every error that warpslam raises on purpose."""


class ConfigError(WarpSlamError, ValueError):
    """A setting that can't work: names the field, the value and the accepted range."""


class DatasetError(WarpSlamError):
    """A sequence folder or one of its files can't be used."""


class CheckpointError(WarpSlamError):
    """A decoder or map file is missing, damaged, or does not fit."""


class MapSizeError(WarpSlamError):
    """The map or its keyframes need more memory than the settings or the machine have."""


class InputError(WarpSlamError, ValueError):
    """An argument of the Python API has the wrong shape, type or range."""


class FrameError(InputError):
    """One frame can't be used; a run leaves it out and goes on."""


class OutputError(WarpSlamError):
    """A result can't be written: the disk is full, or the folder can't be written to."""


class MemoryBudgetError(WarpSlamError):
    """A run takes more memory than it was allowed to."""


class MeshError(WarpSlamError):
    """There is no surface to extract, or a mesh file can't be used."""


class MissingDependencyError(WarpSlamError, ImportError):
    """An optional package or a system library it needs can't be loaded."""
