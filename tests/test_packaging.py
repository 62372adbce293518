"""Wheel and sdist: what is in them, and a run from an environment that has nothing else of ours."""

from __future__ import annotations

import email
import itertools
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
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
    assert metadata["Author"] and metadata["Keywords"] and metadata["License-File"] == "LICENSE"
    assert len(metadata.get_all("Project-URL")) >= 2 and len(metadata.get_all("Classifier")) >= 8
    extras = set(metadata.get_all("Provides-Extra"))
    assert {"bags", "cluster", "exr", "log", "mesh", "open3d", "record", "record3d", "slurm", "view", "wandb"} <= extras
    assert metadata.get_payload().startswith("# warpslam")


def test_errors_name_what_pip_can_install():
    """Packages of other people, by the names and bounds of our extras: none of ours, which is on no index."""
    with open(REPOSITORY / "pyproject.toml", "rb") as file:
        project = tomllib.load(file)["project"]
    wanted = [*project["dependencies"], *itertools.chain.from_iterable(project["optional-dependencies"].values())]
    bounds = {re.split("[<>=[]", one)[0]: one for one in wanted}
    named = {}
    for path in (REPOSITORY / "warpslam").rglob("*.py"):
        for found in re.findall(r"pip install ([^\s,;)\"]+)", path.read_text().replace('"\n', "")):
            named[found.strip("'.")] = path.name
    assert len(named) > 12
    for requirement, file in named.items():
        name = re.split("[<>=[]", requirement)[0]
        assert name in bounds, f"{file}: pip install {requirement}"
        assert requirement in (name, bounds[name]), f"{file}: pip install {requirement}, but {bounds[name]}"


def test_dockerfile_installs_what_there_is():
    """Its extras are ours, its files are in the sources and not kept out, and its Python is one that we take."""
    text = (REPOSITORY / "Dockerfile").read_text()
    with open(REPOSITORY / "pyproject.toml", "rb") as file:
        project = tomllib.load(file)["project"]
    (extras,) = re.findall(r'"/src\[(.*)\]"', text)
    assert set(extras.split(",")) <= set(project["optional-dependencies"])
    ignored = (REPOSITORY / ".dockerignore").read_text().split()
    for name in [*re.findall(r"/src/(\S+)", text), "pyproject.toml", "README.md", "LICENSE", "warpslam"]:
        assert (REPOSITORY / name).exists() and name not in ignored, name
    (version,) = re.findall(r"FROM python:([\d.]+)-slim", text)
    assert f"Programming Language :: Python :: {version}" in project["classifiers"]
    assert 'ENTRYPOINT ["warpslam"]' in text and "warpslam" in project["scripts"]


@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_demo_from_what_was_built(distributions, tmp_path, kind):
    """In a virtual environment with the wheel, or the sdist, beside it only what it depends on: a run of two frames,
    with its report, from the installed files.
    """
    built = distributions[kind == "sdist"]
    venv.create(tmp_path / "venv", with_pip=False)
    python = tmp_path / "venv" / "bin" / "python"
    (site,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    # Dependencies, and what builds an sdist, are those of this environment; a path in a .pth file brings no editable
    # installs along.
    others = [path for path in sys.path if path.endswith("site-packages")]
    (site / "dependencies.pth").write_text("\n".join(others) + "\n")
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "--no-deps", "--no-index"]
    install += ["--no-build-isolation", "--ignore-installed", str(built)]
    subprocess.run(install, check=True, capture_output=True)
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
@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_demo_in_an_empty_environment(distributions, tmp_path, kind):
    """As a stranger installs it: a new environment, the wheel or the sdist, all it asks for from an index, the demo."""
    built = distributions[kind == "sdist"]
    venv.create(tmp_path / "venv", with_pip=True)
    bin_ = tmp_path / "venv" / "bin"
    constraints = REPOSITORY / "constraints.txt"
    subprocess.run([bin_ / "pip", "install", "-q", "-c", constraints, str(built)], check=True)
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [bin_ / "warpslam", "demo", "--device", "cpu", "-o", tmp_path / "run"], cwd=tmp_path, env=environment
    )
    assert done.returncode == 0 and (tmp_path / "run" / "mesh.ply").is_file()
