"""The site as a reader sees it, in Chromium."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CHROMIUM = shutil.which("chromium")
PHONE = 420  # px
# The theme lets an article scroll as a whole, so the page's own width is not enough.
NEEDED = """() => Math.max(document.documentElement.scrollWidth, ...[...document.querySelectorAll("article *")]
    .filter(e => {
        if (e.closest("mjx-assistive-mml, [hidden]")) return false;
        for (let p = e.parentElement; p && p.tagName != "ARTICLE"; p = p.parentElement)
            if (["auto", "scroll"].includes(getComputedStyle(p).overflowX)) return false;
        return true;
    }).map(e => Math.floor(e.getBoundingClientRect().right)))"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build from a copy, because the build writes beside its sources; the gallery's examples are not run."""
    pytest.importorskip("sphinx_gallery")
    copy = tmp_path_factory.mktemp("site")
    for name in ("docs", "examples", "benchmarks", "drivers", "tests", "studies"):  # the last four are linked
        shutil.copytree(
            ROOT / name,
            copy / name,
            ignore=shutil.ignore_patterns("_build", "generated", "gallery", "*_out", "__pycache__"),
        )
    for page in ROOT.glob("*.md"):
        shutil.copy(page, copy)
    built = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-W", "-D", "plot_gallery=0", copy / "docs", copy / "html"],
        capture_output=True,
        text=True,
        timeout=1800,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert built.returncode == 0, built.stderr[-3000:]
    return copy / "html"


def page_width(page, path):
    """Width in px that a page needs, in a window of a phone's width."""
    page.goto(path.as_uri())
    return page.evaluate(NEEDED)


@pytest.mark.slow(130)
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_no_page_is_wider_than_a_phone(site):
    """Wide tables and commands scroll by themselves, and not the page."""
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page(viewport={"width": PHONE, "height": 900})
        pages = [path for path in site.rglob("*.html") if "_static" not in path.parts]
        widths = {str(path.relative_to(site)): page_width(page, path) for path in pages}
        page.evaluate("document.querySelector('article p').style.whiteSpace = 'nowrap'")
        assert page.evaluate(NEEDED) > PHONE, "a line that does not break is found"
        browser.close()
    assert {name: width for name, width in widths.items() if width > PHONE} == {}
