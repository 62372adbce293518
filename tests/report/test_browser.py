"""The pages in a real browser: no error on the console, every section in the document, the shared cursor at work."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.report.html_checks import Page
from warpslam.report import write_comparison

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
SWITCHES = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--hide-scrollbars",
    # Whatever a page asked for beyond its own file would fail, and say so on the console.
    "--host-resolver-rules=MAP * ~NOTFOUND", "--enable-logging=stderr", "--v=0",
)  # fmt: skip


@pytest.fixture(scope="module")
def browser() -> str:
    """Path of a Chromium, from WARPSLAM_CHROMIUM or the search path."""
    found = os.environ.get("WARPSLAM_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip("no Chromium found: install one, or set WARPSLAM_CHROMIUM to its path")
    return found


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
