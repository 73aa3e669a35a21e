"""The report, looked at in a real browser, and its PDF in a real reader, where the machine has them."""

import dataclasses
import shutil
import subprocess

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_metrics import ARCMIN, ARCSEC, KNOWN, loop, recording, run_with

from cycloid_fmu.geometry.pair import read_pair
from fitting.figures.metrics import figures_of
from fitting.reports.figures_report import title_of
from fitting.reports.page import html_page
from fitting.reports.panels import Panel, Trace, names_above, order_name, panels_of
from fitting.reports.report import report
from fitting.transmission_error.survey import survey

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def found():
    torque, angle = loop(167.0, 49 / ARCMIN, 0.6 * ARCMIN, 2.0, loops=2)
    angle = angle + np.random.default_rng(0).normal(0, 0.3 * ARCSEC, angle.size)
    locked = recording(np.arange(torque.size) * 1e-2, 0.0, angle, torque)
    turning = run_with(KNOWN, turns=2, each=9000, noise=1 * ARCSEC, seed=0)
    one_sided = recording(np.arange(torque.size) * 1e-2, 0.0, angle, np.abs(torque))
    return figures_of([survey(r, -39.0, 167.0) for r in (locked, turning, one_sided)], -39.0, 167.0)


def test_the_orders_are_named_by_what_makes_them(nominal):
    ring = nominal.replace(output="ring")
    for pair in (nominal, ring):
        names = {k: order_name(k, pair.ratio, pair) for k in (1, 39, 40, 41, 78, 120, 1560)}
        assert names == {1: "rig", 39: "pin", 40: "tooth", 41: "", 78: "pin", 120: "tooth", 1560: "mesh"}
    assert order_name(39, -39.0, None) == order_name(78, -39.0, None) == "input turn"
    assert order_name(40, -39.0, None) == ""


def test_headings_differ_and_none_denies_itself(found):
    titles = [title_of(name) for name in found.shown]
    assert len(set(titles)) == len(titles)
    assert {"Friction torque", "Torsional stiffness", "Torsional stiffness without friction"} <= set(titles)


@pytest.fixture(scope="module")
def page(found, tmp_path_factory):
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no chromium on this machine")
    from common import EXAMPLES

    path = tmp_path_factory.mktemp("report") / "a report.html"
    report(dataclasses.replace(found, pair=read_pair(EXAMPLES / "drive-39-40.toml")), path)
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        opened = browser.new_page(viewport={"width": 1000, "height": 900})
        opened.said, opened.asked = [], []
        opened.on("console", lambda m: opened.said.append(m.text))
        opened.on("pageerror", lambda e: opened.said.append(str(e)))
        opened.on("request", lambda r: opened.asked.append(r.url))
        opened.goto(path.as_uri())
        opened.wait_for_selector(".panel >> nth=-1 >> .main-svg >> nth=0")
        yield opened
        browser.close()


@pytest.mark.system
def test_a_name_is_no_link(page, tmp_path):
    """Plotly makes links and bold words of tags in names."""
    name = '<a href="https://example.org/">run</a> <b>1</b> & co'
    line = Trace(name, np.arange(3.0), np.arange(3.0), "points", texts=(name, "", ""))
    rows = Panel(name, name, name, (Trace("", np.arange(2.0), -np.arange(2.0)),), name, y_names=(name, "b"))
    (tmp_path / "a.html").write_text(html_page(name, name, [Panel(name, name, name, (line,), name), rows]))
    opened = page.context.browser.new_page()
    opened.goto((tmp_path / "a.html").as_uri())
    opened.wait_for_selector(".panel >> nth=-1 >> .main-svg >> nth=0")
    assert opened.locator("a[href*=example]").count() == 0
    assert opened.locator("svg a").count() == 0
    assert opened.locator("svg text", has_text=name).count() >= 6
    opened.close()


@pytest.mark.system
def test_a_browser_shows_every_panel_and_asks_for_nothing_else(page, found):
    assert page.said == []
    assert len(page.asked) == 1  # the file itself
    assert page.locator(".panel").count() == len(panels_of(found)) == 10
    for number in range(8):
        assert page.locator(f"#panel-{number} .scatterlayer .trace").count() >= 1
    labels = page.locator("#panel-1 .annotation-text").all_text_contents()
    assert {"39 pin", "40 tooth", "78 pin", "1560 mesh"} <= set(labels)


@pytest.mark.system
def test_the_page_holds_every_figure_and_every_note(page, found):
    rows = page.locator("#figures tbody tr:not(.part)")
    assert rows.count() == len(found.shown) == 12
    text = page.locator("#figures").inner_text()
    assert "Lost motion" in text
    assert "GB/T 40731" in text
    assert page.locator("#notes li").all_inner_texts() == list(found.notes)
    assert any("torque is always positive" in note for note in found.notes)


@pytest.mark.system
def test_hovering_tells_a_point_and_dragging_zooms(page):
    page.locator("#panel-0").scroll_into_view_if_needed()
    box = page.locator("#panel-0 .nsewdrag").bounding_box()

    width = "(([low, high]) => high - low)(document.getElementById('panel-0').layout.xaxis.range)"
    before = page.evaluate(width)
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.5 * box["height"])
    page.wait_for_selector("#panel-0 .hoverlayer .hovertext")
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 0.5 * box["height"], steps=4)
    page.mouse.up()
    page.wait_for_function(f"{width} < {0.5 * before}")
    assert page.evaluate(width) == pytest.approx(0.3 * before, rel=0.1)


@pytest.mark.system
def test_on_a_narrow_screen_nothing_is_cut_off(page):
    page.set_viewport_size({"width": 420, "height": 800})
    page.wait_for_function("document.querySelector('#panel-0 .main-svg').getBoundingClientRect().width < 420")
    assert page.evaluate("document.querySelector('.panel').getBoundingClientRect().right") <= 420
    page.set_viewport_size({"width": 1000, "height": 900})


@pytest.mark.slow(4)
def test_the_pdf_holds_the_same(found, tmp_path):
    if shutil.which("pdftotext") is None:
        pytest.skip("no pdftotext on this machine")
    report(found, tmp_path / "r.pdf")
    text = subprocess.run(["pdftotext", "-layout", tmp_path / "r.pdf", "-"], capture_output=True, text=True).stdout
    for word in (
        "Lost motion",
        "Backlash",
        "GB/T 40731",
        "torque is always positive",
        "Orders of the output",
        "SHA-256",
    ):
        assert word in text, word
    assert text.count("\f") in (1 + 5, 2 + 5)  # tables on one page or two, ten panels two a page


def test_orders_above_the_noise_are_stems_and_no_line_joins_two_orders():
    """Of known orders: each has a line of its own, from the noise floor to its amplitude."""
    made = run_with(KNOWN, turns=2, each=9000, noise=1 * ARCSEC, seed=0)
    found = figures_of([survey(made, -39.0, 167.0)], -39.0, 167.0)
    (panel,) = (p for p in panels_of(found) if p.title == "Orders of the output")
    lines = [t for t in panel.traces if t.style == "line"]
    assert lines
    for line in lines:
        x, y = line.x.reshape(-1, 3), line.y.reshape(-1, 3)
        assert (x[:, 0] == x[:, 1]).all()
        assert np.isnan(y[:, 2]).all()
        assert (y[:, 0] < y[:, 1]).all()
        tops = dict(zip(x[:, 0], y[:, 1], strict=True))
        assert {k: tops[k] for k in KNOWN} == pytest.approx({k: a / ARCSEC for k, (a, _) in KNOWN.items()}, rel=0.05)
        assert len(tops) < len(KNOWN) + 3
    assert not any(t.style == "thin" for t in panel.traces)


def test_report_from_the_command_line(command, tmp_path):
    from common import BENCH

    run = command("cycloid-fit", "report", BENCH / "30Nm-forward.csv", "--pair", BENCH / "pair.toml", "-o", "r.html")
    assert run.returncode == 0, run.stderr
    assert "Angular transmission error" in (tmp_path / "r.html").read_text(encoding="utf-8")
    run = command("cycloid-fit", "report", BENCH / "30Nm-forward.csv", "--ratio", "39", "-o", "wrong.html")
    assert run.returncode == 3
    assert "sign" in (tmp_path / "wrong.html").read_text(encoding="utf-8")
    run = command("cycloid-fit", "report", BENCH / "30Nm-forward.csv", "--ratio", "39", "-o", "r.docx")
    assert run.returncode == 2
    assert "must end in .html or .pdf" in run.stderr


@settings(max_examples=50)
@given(st.lists(st.integers(1, 2000), min_size=1, max_size=14, unique=True))
def test_names_of_orders_stand_in_their_order_and_never_on_each_other(orders):
    x = np.array(orders, float)
    curve = Trace("", np.arange(1.0, 2001.0), np.ones(2000))
    named = Trace("", x, np.ones(x.size), "points", -1, tuple(map(str, orders)))
    found = names_above(Panel("", "", "", (curve, named), "", log_x=True))
    places = np.array([place for _, _, place, _ in found])
    assert [text for *_, text in found] == [str(order) for order in sorted(orders)]
    assert (np.diff(places) > 0.0449).all()
    assert places.min() >= -1e-12
    assert places.max() <= 1.0 + 1e-12
