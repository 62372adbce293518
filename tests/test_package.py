"""The package as a whole: import cost, public names, files that have to ship."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import warpslam

PACKAGE = Path(warpslam.__file__).parent


def test_import_is_light():
    """Importing loads none of the heavy packages, and takes under a second."""
    code = (
        "import time; t = time.perf_counter(); import warpslam; t = time.perf_counter() - t; import sys; "
        "heavy = {'torch', 'warp', 'open3d', 'cv2', 'matplotlib', 'scipy', 'trimesh', 'numpy'} & set(sys.modules); "
        "assert not heavy, heavy; assert t < 1, t"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=PACKAGE.parent)


def test_command_line_help_is_light():
    """``warpslam --help`` needs neither torch nor Warp."""
    code = (
        "import sys, contextlib\n"
        "from warpslam import cli\n"
        "with contextlib.suppress(SystemExit): cli.main(['--help'])\n"
        "assert not {'torch', 'warp', 'open3d', 'cv2'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=PACKAGE.parent, stdout=subprocess.DEVNULL)


@pytest.mark.parametrize("name", [name for name in warpslam.__all__ if name != "__version__"])
def test_public_names_resolve(name: str):
    """Every name in the public namespace leads somewhere and is documented."""
    value = getattr(warpslam, name)
    assert name == "PRESETS" or value.__doc__


def test_unknown_name_is_an_attribute_error():
    """A misspelt name fails as in any module."""
    with pytest.raises(AttributeError, match="Slamm"):
        warpslam.Slamm  # noqa: B018


def test_importing_one_name_loads_no_more_than_it_needs():
    """Readers and metrics work without torch and Warp."""
    code = (
        "import sys; from warpslam import Intrinsics, ate, open_sequence, DatasetError; "
        "assert not {'torch', 'warp', 'open3d'} & set(sys.modules), sorted(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=PACKAGE.parent)


def test_shipped_files():
    """Type marker, pretrained decoders and dataset cameras are in the package."""
    assert (PACKAGE / "py.typed").is_file()
    assert (PACKAGE / "data" / "decoders.safetensors").stat().st_size > 100_000
    assert list((PACKAGE / "sequences" / "cameras").glob("*.yaml"))


def test_constraints_cover_the_requirements():
    """Each direct requirement is pinned in constraints.txt to a version that its range allows."""
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    tomllib = pytest.importorskip("tomllib", reason="tomllib comes with Python 3.11")
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    pins = {}
    for line in (PACKAGE.parent / "constraints.txt").read_text().splitlines():
        if line and not line.startswith("#"):
            pin = Requirement(line)
            pins[canonicalize_name(pin.name)] = next(iter(pin.specifier)).version
    for text in [*project["dependencies"], *(t for extra in project["optional-dependencies"].values() for t in extra)]:
        requirement = Requirement(text)
        assert pins[canonicalize_name(requirement.name)] in requirement.specifier, text
