"""``warpslam info``."""

from __future__ import annotations

import argparse
from typing import Any

from warpslam.cli.common import add_command, quiet_warp


def add(commands: Any) -> None:
    """Add the command."""
    info = add_command(commands, "info", _info, "versions, devices, decoders, dataset formats and presets")
    info.add_argument("--decoders", metavar="FILE", help="decoder checkpoint (default: the package's own)")


def _info(options: argparse.Namespace) -> int:
    import platform

    from warpslam import __version__
    from warpslam.config import PRESETS
    from warpslam.field.complexity import field_flops, flops_per_point
    from warpslam.field.decoder_files import DEFAULT_PATH, load_decoders
    from warpslam.runtime.environment import package_versions
    from warpslam.sequences import DATASETS

    print(f"warpslam    {__version__}, Python {platform.python_version()}, {platform.platform()}")
    for package, version in package_versions().items():
        print(f"{package:11} {version or 'not installed'}")
    print(f"devices     {', '.join(_device_names())}")
    widths = {weights.level: weights.hidden for weights in load_decoders(options.decoders)}
    print(f"decoders    {options.decoders or DEFAULT_PATH}, hidden width {widths}")
    flops = ", ".join(f"{level} {count:,}" for level, count in field_flops(widths).items())
    print(f"FLOP/point  {flops} (middle + fine + colour); iMAP* {flops_per_point('imap'):,}")
    print(f"datasets    {', '.join(DATASETS)}")
    print(f"presets     {', '.join(PRESETS)}")
    return 0


def _device_names() -> list[str]:
    import warp as wp

    quiet_warp()
    return [f"{device} ({device.name})" for device in wp.get_devices()]
