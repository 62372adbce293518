"""The documentation as a site, and its notebook."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY
from tests.report.html_checks import Page
from warpslam.config.description import settings

PAGES = ("index", "recordings", "usage", "settings", "api", "ARCHITECTURE")


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site, built as `.ci/run` does."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "-d", str(folder)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


def test_every_page_is_there(site):
    """All of the navigation, and every link within the site leads to a page and a heading of it."""
    texts = {name: (site / f"{name}.html").read_text(encoding="utf-8") for name in PAGES}
    for name, text in texts.items():
        for href in re.findall(r'href="([^"#:]*?)(?:#([^"]*))?"', text):
            target, anchor = href
            path = (site / name).parent / target if target else site / f"{name}.html"
            assert path.exists(), f"{name}: {target}"
            if anchor and path.suffix == ".html":
                assert f'id="{anchor}"' in path.read_text(encoding="utf-8"), f"{name}: {target}#{anchor}"


def test_every_setting_is_explained(site):
    """The page of settings has each of them."""
    text = (site / "settings.html").read_text(encoding="utf-8")
    assert all(f"<code>{one.name}</code>" in text for one in settings())


def test_python_has_its_docstrings(site):
    """The public names, their arguments and what they raise."""
    text = (site / "api.html").read_text(encoding="utf-8")
    for name in ("Slam", "step", "run", "Observer", "RgbdSequence", "Intrinsics", "from_matrix", "FrameResult", "ate"):
        assert re.search(rf'id="warpslam[\w.]*\.{name}"', text), name
    assert "z-depth (H, W): float in metres" in text and "MapSizeError" in text


def test_nothing_is_fetched(site):
    """No page needs anything from elsewhere to be read."""
    for name in PAGES:
        text = (site / f"{name}.html").read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|link)[^>]+(?:src|href)="(https?:[^"]+)"', text)
        assert [one for one in loaded if 'rel="canonical"' not in one] == [], name


def test_notebook(tmp_path):
    """The notebook runs from its first cell to its last."""
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    notebook = nbformat.read(REPOSITORY / "docs" / "first_run.ipynb", as_version=4)
    nbformat.validate(notebook)
    nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3").execute(cwd=str(tmp_path))
    said = "".join(
        output.get("text", "") or str(output.get("data", {}).get("text/plain", ""))
        for cell in notebook.cells
        for output in cell.get("outputs", [])
    )
    error = re.search(r"ATE RMSE ([\d.]+) cm over 12 frames", said)
    assert error and float(error[1]) < 5 and re.search(r"\d{3,} vertices", said)


def test_the_check_of_links_would_see_one():
    """A link to nowhere is a problem of a page."""
    assert Page('<a href="#nowhere">x</a>').problems
