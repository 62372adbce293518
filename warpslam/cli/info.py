"""``warpslam info``."""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

from warpslam.cli.common import add_command, quiet_warp

_NARROW = 80


def add(commands: Any) -> None:
    """Add the command."""
    info = add_command(commands, "info", _info, "versions, devices, decoders, dataset formats, presets and settings")
    info.add_argument("--decoders", metavar="FILE", help="decoder checkpoint (default: the package's own)")
    what = info.add_mutually_exclusive_group()
    what.add_argument("--preset", metavar="NAME", help="print the settings of a preset as yaml, as --config takes them")
    what.add_argument("--settings", action="store_true", help="explain every setting: meaning, unit, range, default")
    info.add_argument("--json", action="store_true", help="print JSON")


def _info(options: argparse.Namespace) -> int:
    from warpslam.storage.json_files import to_json

    if options.preset is not None:
        from warpslam.config import Config

        config = Config.from_preset(options.preset)
        text = to_json(config.model_dump()) if options.json else f"# preset {options.preset}\n{config.to_yaml()}"
        print(text.rstrip())
    elif options.settings:
        if options.json:
            from warpslam.config.description import settings

            print(to_json([dataclasses.asdict(setting) for setting in settings()]))
        else:
            _print_settings()
    else:
        facts = _facts(options.decoders)
        print(to_json(facts) if options.json else _as_text(facts))
    return 0


def _facts(decoders: str | None) -> dict[str, Any]:
    import platform

    from warpslam import __version__
    from warpslam.config import PRESETS
    from warpslam.field.complexity import field_flops, flops_per_point
    from warpslam.field.decoder_files import DEFAULT_PATH, load_decoders
    from warpslam.runtime.environment import package_versions, torch_build
    from warpslam.sequences import DATASETS

    build = torch_build()
    widths = {weights.level: weights.hidden for weights in load_decoders(decoders)}
    return {
        "warpslam": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": package_versions(),
        "torch_build": None if build is None else dataclasses.asdict(build),
        "devices": _device_names(),
        "decoders": {"file": str(decoders or DEFAULT_PATH), "hidden_width": widths},
        "flop_per_point": {**field_flops(widths), "imap": flops_per_point("imap")},
        "datasets": list(DATASETS),
        "presets": list(PRESETS),
    }


def _as_text(facts: dict[str, Any]) -> str:
    lines = [("warpslam", f"{facts['warpslam']}, Python {facts['python']}, {facts['platform']}")]
    for package, version in facts["packages"].items():
        build = facts["torch_build"] if package == "torch" else None
        detail = f", built for {build['target']}, {build['bytes'] / 1e9:.1f} GB on disk" if build and version else ""
        lines.append((package, f"{version or 'not installed'}{detail}"))
    decoders, flops = facts["decoders"], dict(facts["flop_per_point"])
    imap = flops.pop("imap")
    counts = ", ".join(f"{level} {count:,}" for level, count in flops.items())
    lines += [
        ("devices", ", ".join(facts["devices"])),
        ("decoders", f"{decoders['file']}, hidden width {_widths(decoders['hidden_width'])}"),
        ("FLOP/point", f"{counts} (middle + fine + colour); iMAP* {imap:,}"),
        ("datasets", ", ".join(facts["datasets"])),
        ("presets", ", ".join(facts["presets"])),
    ]
    return "\n".join(f"{name:11} {text}" for name, text in lines)


def _widths(widths: dict[str, int]) -> str:
    """One number where all levels have the same."""
    if len(set(widths.values())) == 1:
        return str(next(iter(widths.values())))
    return ", ".join(f"{level} {width}" for level, width in widths.items())


def _print_settings() -> None:
    """A table a group; what a setting may be stands below what it means."""
    import shutil

    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from warpslam.config.description import groups, settings

    console = Console(width=min(max(shutil.get_terminal_size((_NARROW, 24)).columns, _NARROW), 120), highlight=False)
    known = settings()
    for group, about in groups().items():
        members = [setting for setting in known if setting.name.rpartition(".")[0] == group]
        title = Text.assemble((group, "bold"), "  " if group else "", " ".join(about.split()))
        table = Table(title=title, title_justify="left", title_style="", box=None, pad_edge=False, expand=True)
        table.add_column("setting", no_wrap=True)
        table.add_column("default", overflow="fold", max_width=12)
        table.add_column("meaning", ratio=1)
        for setting in members:
            meaning = Text(setting.meaning)
            if setting.accepted:
                meaning.append(f" ({setting.accepted})".replace(" to ", "\N{NO-BREAK SPACE}to\N{NO-BREAK SPACE}"))
            table.add_row(setting.name.rpartition(".")[2], _as_typed(setting.default), meaning)
        console.print(table)
        console.print()


def _as_typed(value: Any) -> str:
    """A value as it stands in yaml; nothing for None."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def _device_names() -> list[str]:
    import warp as wp

    quiet_warp()
    return [f"{device} ({device.name})" for device in wp.get_devices()]
