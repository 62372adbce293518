"""Wheel and sdist: what is in them, and a run from an environment that has nothing else of ours."""

from __future__ import annotations

import email
import os
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

DATA = (
    "py.typed", "data/decoders.safetensors", "bench/published.yaml", "bench/suites/quick.yaml", "report/report.css",
    "report/report.js", "report/turntable.js", "sequences/cameras/replica.yaml",
)  # fmt: skip


@pytest.fixture(scope="module")
def distributions(tmp_path_factory) -> tuple[Path, Path]:
    """A wheel built from an sdist, and that sdist, of a copy of the sources."""
    pytest.importorskip("build")
    source = tmp_path_factory.mktemp("packaging") / "source"
    source.mkdir()
    for name in ("warpslam", "pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md"):
        path = REPOSITORY / name
        shutil.copytree(path, source / name) if path.is_dir() else shutil.copy(path, source)
    out = source.parent / "out"
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(source)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    (wheel,), (sdist,) = out.glob("*.whl"), out.glob("*.tar.gz")
    return wheel, sdist


def test_what_is_in_them(distributions):
    """Every module and every file of data; nothing of the tests in the wheel; the licence and the readme."""
    wheel, sdist = distributions
    names = set(zipfile.ZipFile(wheel).namelist())
    modules = {str(path.relative_to(REPOSITORY)) for path in (REPOSITORY / "warpslam").rglob("*.py")}
    assert modules <= names and {f"warpslam/{name}" for name in DATA} <= names
    assert not [name for name in names if name.startswith(("tests/", "tools/"))]
    with tarfile.open(sdist) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    assert {"LICENSE", "README.md", "pyproject.toml", *modules} <= inside


def test_metadata(distributions):
    """Name, summary, licence, Python, addresses, extras: what an index shows."""
    wheel, _ = distributions
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("METADATA"))
        metadata = email.message_from_bytes(archive.read(name))
    for field in ("Name", "Version", "Summary", "License-Expression", "Requires-Python", "Description-Content-Type"):
        assert metadata[field], field
    assert len(metadata.get_all("Project-URL")) >= 2 and len(metadata.get_all("Classifier")) >= 8
    extras = set(metadata.get_all("Provides-Extra"))
    assert {"bags", "cluster", "exr", "mesh", "open3d", "record", "record3d", "view"} <= extras


def test_demo_from_the_wheel(distributions, tmp_path):
    """In a virtual environment with the wheel, beside it only what it depends on: a run of two frames, with its report,
    from the installed files.
    """
    wheel, _ = distributions
    venv.create(tmp_path / "venv", with_pip=False)
    python = tmp_path / "venv" / "bin" / "python"
    (site,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "--no-deps", "--no-index", str(wheel)]
    subprocess.run(install, check=True, capture_output=True)
    # Dependencies are those of this environment; a path in a .pth file brings no editable installs along.
    others = [path for path in sys.path if path.endswith("site-packages")]
    (site / "dependencies.pth").write_text("\n".join(others) + "\n")
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    few = ["mapping.first_iterations=2", "mapping.iterations=2", "mapping.refinement_rounds=1", "meshing.voxel=0.1"]
    code = (
        "import sys, warpslam, warpslam.synthetic.demo as demo; print(warpslam.__file__); demo.FRAME_COUNT = 2; "
        "from warpslam.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    command = [str(python), "-c", code, "demo", "--device", "cpu", "-o", str(tmp_path / "run"), "--set", *few]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert done.stdout.startswith(str(site))
    assert (tmp_path / "run" / "report.html").is_file() and (tmp_path / "run" / "trajectory.tum").is_file()


@pytest.mark.slow
def test_demo_in_an_empty_environment(distributions, tmp_path):
    """As a stranger installs it: a new environment, the wheel and all it asks for from an index, and the demo."""
    wheel, _ = distributions
    venv.create(tmp_path / "venv", with_pip=True)
    bin_ = tmp_path / "venv" / "bin"
    constraints = REPOSITORY / "constraints.txt"
    subprocess.run([bin_ / "pip", "install", "-q", "-c", constraints, str(wheel)], check=True)
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [bin_ / "warpslam", "demo", "--device", "cpu", "-o", tmp_path / "run"], cwd=tmp_path, env=environment
    )
    assert done.returncode == 0 and (tmp_path / "run" / "mesh.ply").is_file()
