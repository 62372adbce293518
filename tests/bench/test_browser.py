"""The page of a bench in a real browser."""

from __future__ import annotations

from tests.report import test_browser as report_browser
from warpslam.bench.runner import run_bench
from warpslam.bench.suite import read_suite

browser = report_browser.browser

# No section may be wider than a telephone.
NARROW = """<script>
document.body.style.width = "320px";
const overflow = Math.max(...[...document.querySelectorAll("section")].map((s) => s.scrollWidth - s.clientWidth));
document.body.append(Object.assign(document.createElement("p"), {id: "width", textContent: `overflow ${overflow}`}));
</script>"""


def test_bench_in_a_browser(browser, write_suite, fake_runs, tmp_path):
    """It opens without a word on the console, and tables scroll where they are too wide."""
    bench = run_bench(read_suite(str(write_suite())), tmp_path / "out", workers=2)
    page = bench.folder / "probe.html"
    text = (bench.folder / "report.html").read_text(encoding="utf-8")
    page.write_text(text.replace("</body>", NARROW + "</body>"), encoding="utf-8")
    document, console = report_browser.open_page(browser, page, tmp_path / "profile")
    assert console == [] and "overflow 0" in document.text
    assert list(document.sections) == ["overview", "tracking", "color", "made"]
