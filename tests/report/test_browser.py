"""The pages in a real browser: no error on the console, every section in the document, the shared cursor at work."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
import trimesh

from tests.browser import Browser, find_chromium, wait_for
from tests.report.html_checks import Page
from warpslam.report import write_comparison, write_report
from warpslam.report.turntable import MAX_FACES, lightened

SWITCHES = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-3d-apis", "--disable-quic",
    "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--hide-scrollbars",
    # Whatever a page asked for beyond its own file would fail, and say so on the console.
    "--host-resolver-rules=MAP * ~NOTFOUND", "--enable-logging=stderr", "--v=0",
)  # fmt: skip


@pytest.fixture(scope="module")
def browser() -> str:
    """Path of a Chromium."""
    return find_chromium()


def open_page(browser: str, page: Path, profile: Path) -> tuple[Page, list[str]]:
    """The document after its script ran, and what was written to the console."""
    command = [browser, *SWITCHES, f"--user-data-dir={profile}", "--window-size=1200,900", "--dump-dom"]
    done = subprocess.run([*command, page.as_uri()], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return Page(done.stdout), [line for line in done.stderr.splitlines() if "CONSOLE" in line]


# Moves the pointer over the first chart over time and writes what the page then shows into its title; then
# measures how far sections stick out of a narrow page.
POINTER = """<script>
const chart = document.querySelector("svg.timeline"), box = chart.getBoundingClientRect();
chart.dispatchEvent(new PointerEvent("pointermove", {clientX: box.left + box.width / 2, clientY: box.top + 20}));
const seen = document.querySelectorAll(".cursor[visibility=visible]").length;
document.title = `${seen} cursors: ${document.getElementById("readout").textContent}`;
document.body.style.width = "320px";
const overflow = Math.max(...[...document.querySelectorAll("section")].map((s) => s.scrollWidth - s.clientWidth));
document.body.append(Object.assign(document.createElement("p"), {id: "overflow", textContent: `overflow ${overflow}`}));
</script>"""


def test_report_in_a_browser(browser, make_run, tmp_path):
    """All is there, no section is wider than a telephone, and pointing at a chart shows the frame everywhere."""
    folder = make_run(lost_at=3)
    page = tmp_path / "probe.html"
    page.write_text(folder.report.read_text(encoding="utf-8").replace("</body>", POINTER + "</body>"), encoding="utf-8")
    document, console = open_page(browser, page, tmp_path / "profile")
    assert console == [] and document.external == []
    assert list(document.sections) == list(Page(folder.report.read_text(encoding="utf-8")).sections)
    assert re.search(r"6 cursors: frame [34] · 0\.1\d s · (OK|LOST) · \d\.\d\d cm", document.text)
    assert "overflow 0" in document.text


def test_comparison_in_a_browser(browser, make_run, tmp_path):
    """The page of several runs opens without a word on the console."""
    path = write_comparison(tmp_path / "comparison.html", [make_run("a"), make_run("b", mesh_fails=True)])
    document, console = open_page(browser, path, tmp_path / "profile")
    assert console == [] and list(document.sections) == ["table", "bars", "meshes", "runs"]


def test_console_errors_would_be_seen(browser, tmp_path):
    """The check itself: an error in a script and a request to somewhere else both reach the console."""
    page = tmp_path / "bad.html"
    page.write_text('<!doctype html><img src="http://example.invalid/x.png"><script>nothing.there</script>')
    _, console = open_page(browser, page, tmp_path / "profile")
    assert any("nothing is not defined" in line for line in console)


def test_the_mesh_can_be_turned(make_run, tmp_path):
    """With WebGL the mesh is drawn in its colours, turns under the pointer, is cut, and fits a telephone."""
    folder = make_run()
    ball = trimesh.creation.icosphere(subdivisions=4)
    ball.visual.vertex_colors = np.where(ball.vertices[:, :1] > 0, [[250, 30, 30, 255]], [[30, 30, 250, 255]])
    ball.export(folder.mesh)
    write_report(folder)
    with Browser(tmp_path / "profile") as page:
        page.open(folder.report.as_uri())
        wait_for(lambda: page.run("document.readyState") == "complete", 60)
        page.run("document.getElementById('turntable').scrollIntoView({block: 'center', behavior: 'instant'})")
        wait_for(lambda: page.run("document.getElementById('turntable').dataset.ready"), 60)
        box = page.run("(({x, y, width, height}) => [x, y, width, height])(turntable.getBoundingClientRect())")
        x, y, width, height = (round(value) for value in box)

        def canvas() -> np.ndarray:
            return page.picture()[y : y + height, x : x + width].astype(int)

        def red_and_blue(image: np.ndarray) -> tuple[int, int]:
            red = (image[..., 0] > image[..., 2] + 80).sum()
            return int(red), int((image[..., 2] > image[..., 0] + 80).sum())

        wait_for(lambda: sum(red_and_blue(canvas())) > 5000, 30)
        first = canvas()
        left = (x + 100, y + height // 2)
        page.drag(left, (left[0] + round(np.pi * height / 3), left[1]))
        wait_for(lambda: np.abs(canvas() - first).max(axis=2).mean() > 3, 30)
        turned = canvas()
        (red, blue), (red_then, blue_then) = red_and_blue(turned), red_and_blue(first)
        assert np.sign(red - blue) == -np.sign(red_then - blue_then), "half a turn shows the other side"
        cut = "document.getElementById('turntable-cut')"
        page.run(f"{cut}.value = 500; {cut}.dispatchEvent(new Event('input'));")
        wait_for(lambda: sum(red_and_blue(canvas())) < 0.75 * (red + blue), 30)
        page.resize(390, 844)
        sections = "[...document.querySelectorAll('section')]"
        assert page.run(f"Math.max(...{sections}.map((s) => s.scrollWidth - s.clientWidth))") == 0
        shown = "[...document.querySelectorAll('.label.above')].every((e) => getComputedStyle(e).display !== 'none')"
        assert page.run(shown), "units on a telephone"
        assert page.console == []


def test_a_large_mesh_stays_below_8_megabytes(make_run):
    """A mesh of 1.3 million faces is made lighter in the page; the file beside it keeps all of them."""
    folder = make_run()
    ball = trimesh.creation.icosphere(subdivisions=8)
    generator = np.random.default_rng(0)
    vertices = ball.vertices * (1 + 0.002 * generator.standard_normal((len(ball.vertices), 1)))
    colors = generator.integers(0, 255, (len(vertices), 4)).astype(np.uint8)
    trimesh.Trimesh(vertices, ball.faces, vertex_colors=colors, process=False).export(folder.mesh)
    write_report(folder)
    assert len(ball.faces) > 1_000_000 and folder.report.stat().st_size < 8e6
    text = folder.report.read_text(encoding="utf-8")
    facts = json.loads(re.search(r'id="turntable-facts">([^<]*)<', text)[1])
    assert 60_000 < facts["faces"] <= MAX_FACES


def test_a_lighter_mesh_keeps_its_shape():
    """Fewer faces of the same ball: near it everywhere, as much of it, wound as before, colours where they were."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    colors = np.where(ball.vertices[:, :1] > 0, [[255, 0, 0]], [[0, 0, 255]])
    vertices, faces, colors = lightened(ball.vertices, ball.faces, colors, 3000)
    assert 1000 < len(faces) <= 3000
    light = trimesh.Trimesh(vertices, faces, process=False)
    assert np.abs(np.linalg.norm(vertices, axis=1) - 1).max() < 0.05
    assert light.area == pytest.approx(ball.area, rel=0.05) and light.volume == pytest.approx(ball.volume, rel=0.05)
    right = vertices[:, 0] > 0.1
    assert (colors[right, 0] > 200).all() and (colors[vertices[:, 0] < -0.1, 2] > 200).all()


def test_links_lead_to_files(make_run, tmp_path):
    """From beside the run and from elsewhere, each link leads to a file that is there."""
    folder = make_run()
    (tmp_path / "other").mkdir()
    for path in (folder.report, write_report(folder, tmp_path / "other" / "r.html")):
        links = Page(path.read_text(encoding="utf-8")).links
        assert {"mesh.ply", "trajectory.tum", "config.yaml"} <= {Path(link).name for link in links}
        assert all((path.parent / unquote(link)).is_file() for link in links)
