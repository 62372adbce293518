"""``python -m warpslam``, the same as the ``warpslam`` command."""

from warpslam.cli import entry_point

entry_point()
