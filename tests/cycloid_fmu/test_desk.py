"""The desk: its figures are those of the saved file's analysis, wrong values are sentences, and who may ask it."""

import json
import re
import shutil
import socket
import urllib.error
import urllib.request

import numpy as np
import pytest
from common import EXAMPLES
from hypothesis import given, settings
from hypothesis import strategies as st

import cycloid_fmu as cy
from cycloid_fmu.desk.server import DeskServer, save
from cycloid_fmu.desk.view import FIELDS, look, open_desk, pair_of
from cycloid_fmu.draw.drive_picture import PRESSURES
from cycloid_fmu.draw.drive_svg import drive_svg, pressure_colour
from cycloid_fmu.studies.friction import FIGURES
from cycloid_fmu.studies.limits import read_requirements

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
MADE = EXAMPLES / "drive-39-40-as-made.toml"
CHANGED = {"modification.offset": "-55 um", "pair.face_width": "12 mm", "torque": "150 N*m", "crank_angle": "40 deg"}


@pytest.fixture(scope="module")
def desk():
    return open_desk(MADE)


def test_what_is_shown_is_what_the_saved_file_gives(desk, tmp_path):
    values = {**desk.values, **CHANGED}
    view = look(desk, values)
    assert view.problems == {}
    assert save(desk, values, tmp_path, "new.toml") is None
    drive = cy.read_drive(tmp_path / "new.toml")
    assert drive.pair == view.pair
    assert drive.pair.errors == cy.read_drive(MADE).pair.errors
    data = drive.analyze("150 N*m", crank_angle=view.crank_angle)
    assert view.transmission_error == pytest.approx(data.transmission_error.values[0], abs=1e-12)
    assert view.backlash == pytest.approx(data.backlash.values[0], abs=1e-12)
    assert view.pressure == pytest.approx(data.max_contact_pressure.values[0], rel=1e-9)


def test_the_values_of_a_file_are_its_pair(desk):
    assert pair_of(desk, desk.values) == cy.read_drive(MADE).pair
    again = pair_of(desk, {**desk.values, "pair.gear_teeth": "29", "pair.eccentricity": "1.6 mm"})
    assert (again.pins, again.ratio) == (30, -29.0)


def test_a_law_for_comparison_with_papers_has_no_field_and_stays_in_the_file(tmp_path):
    desk = open_desk(EXAMPLES / "wear-39-40.toml")
    assert "pair.contact_law" not in FIELDS
    assert desk.kept[0] == "contact_law"
    assert save(desk, {**desk.values, "pair.face_width": "12 mm"}, tmp_path, "new.toml") is None
    assert cy.read_drive(tmp_path / "new.toml").pair.contact_law == "as_printed"


def test_verdicts_are_those_of_judge(tmp_path):
    limits = tmp_path / "limits.toml"
    limits.write_text(
        'format = "cycloid-requirements/1"\n[limits]\nangular_transmission_error = "10 arcsec"\n'
        'max_contact_pressure = "2500 MPa"\nlost_motion = "9 arcmin"\nwear_depth = "5 um"\n'
    )
    desk = open_desk(MADE, limits)
    view = look(desk, {**desk.values, **CHANGED})
    judged = cy.Drive(view.pair).judge(read_requirements(limits), ["150 N*m"])
    assert [one.numbers() for one in view.verdicts] == [one.numbers() for one in judged.verdicts]
    assert {one.met for one in view.verdicts} == {True, False}
    assert view.not_judged == ("wear_depth",)


def test_limits_on_bearings_are_not_judged_without_their_capacity():
    desk = open_desk(MADE, EXAMPLES / "requirements.toml")
    view = look(desk, desk.values)
    assert view.not_judged == (*FIGURES, "bearing_life", "friction_power_density", "wear_depth", "temperature")
    assert {one.figure for one in view.verdicts} == set(desk.requirements.limits.stated()) - {*view.not_judged}


@pytest.mark.slow(2)
def test_friction_is_shown_from_rest():
    desk = open_desk(EXAMPLES / "drive-39-40-bearings.toml")
    view = look(desk, {**desk.values, "torque": "181 N*m"})
    alone = cy.Drive(view.pair).losses("181 N*m", workers=1)
    assert view.figures["efficiency from rest, driving"] == f"{alone.cases[0].efficiency:.1%}"
    assert view.figures["starting torque"] == f"{alone.starting_torque:.4g} N·m"
    assert view.figures["back-driving torque"] == f"{alone.back_driving_torque:.4g} N·m"


@pytest.mark.parametrize(
    ("values", "field", "words"),
    [
        ({"pair.eccentricity": "1,3 mm"}, "pair.eccentricity", 'eccentricity = "1,3 mm": write one number'),
        ({"pair.eccentricity": "1.7 mm"}, "pair.eccentricity", "the eccentricity below"),
        ({"pair.gear_teeth": "39.5"}, "pair.gear_teeth", "valid integer"),
        ({"pair.pin_radius": ""}, "pair.pin_radius", "pin_radius is missing."),
        ({"modification.offset": "3"}, "modification.offset", 'offset = "3": write one number'),
        ({"pair.output": "crank"}, "pair.output", "'gear' or 'ring'"),
        ({"torque": "150"}, "torque", 'torque = "150": write one number'),
        ({"torque": "1e12 N*m"}, "torque", "no contacts of this pair can balance it"),
        ({"torque": "", "pair.rated_torque": ""}, "torque", "torque is missing"),
        ({"crank_angle": "30"}, "crank_angle", 'crank_angle = "30": write one number'),
    ],
)
def test_a_wrong_value_is_a_sentence_at_its_field(desk, values, field, words):
    view = look(desk, {**desk.values, **CHANGED, **values})
    assert list(view.problems) == [field]
    assert words in view.problems[field]
    assert desk.source not in view.problems[field]
    assert view.pair is None


def test_a_limit_that_lacks_a_value_says_so_at_its_field(tmp_path):
    limits = tmp_path / "limits.toml"
    limits.write_text('format = "cycloid-requirements/1"\n[limits]\nlost_motion = "9 arcmin"\n')
    desk = open_desk(MADE, limits)
    problems = look(desk, {**desk.values, "torque": "9 N*m", "pair.rated_torque": ""}).problems
    assert list(problems) == ["pair.rated_torque"]
    assert "lost_motion" in problems["pair.rated_torque"]


def test_a_wrong_error_of_the_file_has_no_field(tmp_path):
    """Eight teeth more need eight pins more than the file's list has."""
    path = tmp_path / "pair.toml"
    path.write_text(MADE.read_text().split("[errors]")[0] + "[errors]\npin_radial = [" + '"1 um", ' * 40 + "]\n")
    desk = open_desk(path)
    problems = look(desk, {**desk.values, "pair.gear_teeth": "47", "pair.eccentricity": "1 mm"}).problems
    assert list(problems) == [""]
    assert "pin_radial has 40 values; it needs one for each pin, 48" in problems[""]


def test_every_wrong_value_is_told(desk):
    wrong = {"torque": "x", "crank_angle": "y", "pair.discs": "9", "modification.isometric": "z"}
    assert set(look(desk, {**desk.values, **wrong}).problems) == set(wrong)


@pytest.mark.slow(2)
@settings(max_examples=25)
@given(st.dictionaries(st.sampled_from([*FIELDS, "torque", "crank_angle"]), st.text(max_size=12), min_size=1))
def test_any_text_is_shown_or_told(values):
    """There is no text in the fields on which the desk fails."""
    desk = open_desk(MADE)
    view = look(desk, {**desk.values, "torque": "150 N*m", **values})
    assert view.problems or view.pair is not None
    json.dumps(view.numbers()["problems"])


def test_the_picture_has_the_outline_of_the_motion():
    drive = cy.read_drive(MADE)
    motion = drive.motion("181 N*m", "40 deg")
    picture = drive_svg(motion)
    path = re.search(r'id="disc-0" d="M([^"]*)Z"', picture)[1]
    x, y = np.array([pair.split() for pair in path.split("L")], dtype=float).T
    assert np.abs(x + 1j * y - motion.outline(0, 0, 0) * 1e3).max() < 1e-3  # mm
    assert picture.count('class="pin"') == 40
    force = motion.force[0, 0]
    assert picture.count('class="force"') == np.count_nonzero(force > 0.01 * force.max())
    assert (pressure_colour(0.0), pressure_colour(1.0)) == (PRESSURES[0], PRESSURES[-1])


@pytest.mark.parametrize(
    "name", ["../x.toml", "a/b.toml", "..\\x.toml", "c:x.toml", ".x.toml", "", "x.nc", "x\n.toml", "link.toml"]
)
def test_nothing_is_saved_elsewhere(desk, tmp_path, name):
    folder = tmp_path / "desk"
    folder.mkdir()
    (tmp_path / "outside.toml").write_text("kept")
    (folder / "link.toml").symlink_to(tmp_path / "outside.toml")
    with pytest.raises(cy.InputError, match="file name"):
        save(desk, desk.values, folder, name, overwrite=True)
    assert sorted(one.name for one in tmp_path.rglob("*")) == ["desk", "link.toml", "outside.toml"]
    assert (tmp_path / "outside.toml").read_text() == "kept"


def test_a_file_is_overwritten_after_a_question(desk, tmp_path):
    target = tmp_path / "pair.toml"
    target.write_text("before")
    assert "Overwrite it?" in save(desk, desk.values, tmp_path, "pair.toml")
    assert target.read_text() == "before"
    assert save(desk, desk.values, tmp_path, "pair.toml", overwrite=True) is None
    assert cy.read_drive(target) == cy.read_drive(MADE)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    path = tmp_path_factory.mktemp("desk") / "drive.toml"
    shutil.copy(MADE, path)
    with DeskServer(path) as running:
        yield running


def asked(server, path, data=None, token=None, **headers):
    """Status and text of an answer."""
    host, port = server.server_address
    url = f"http://{host}:{port}/{path}?token={server.token if token is None else token}"
    try:
        with urllib.request.urlopen(urllib.request.Request(url, data, headers), timeout=30) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as problem:
        return problem.code, ""


def test_who_may_ask(server):
    values = json.dumps({"values": server.desk.values}).encode()
    assert server.server_address[0] == "127.0.0.1"
    assert asked(server, "")[0] == asked(server, "start")[0] == asked(server, "look", values)[0] == 200
    for path, data in (("", None), ("start", None), ("look", values), ("save", values)):
        assert asked(server, path, data, token="guess")[0] == 403
        assert asked(server, path, data, token="")[0] == 403
        assert asked(server, path, data, Host="evil.example")[0] == 403
    assert asked(server, "nothing")[0] == asked(server, "nothing", values)[0] == 404


@pytest.mark.parametrize(
    ("head", "body", "status"),
    [
        ("Content-Length: 65537", b"", 413),
        ("Content-Length: " + "9" * 400, b"", 413),
        ("X: y", b"", 411),
        ("Content-Length: -1", b"", 411),
        ("Content-Length: 2", b"{}", 400),
        ("Content-Length: 4", b"\xff\xfe[]", 400),
        ("Content-Length: 16", b'{"values": "12"}', 400),
        ("Content-Length: 20", b'{"values": {"a": 1}}', 400),
        ("Content-Length: 60000", b"[" * 60000, 400),
    ],
)
def test_a_body_that_is_too_large_or_odd_is_refused(server, capfd, head, body, status):
    request = f"POST /look?token={server.token} HTTP/1.1\r\nHost: localhost\r\n{head}\r\n\r\n".encode() + body
    with socket.create_connection(server.server_address, timeout=5) as client:
        client.sendall(request)
        client.shutdown(socket.SHUT_WR)
        answer = b"".join(iter(lambda: client.recv(1 << 16), b""))
    assert answer.startswith(f"HTTP/1.0 {status}".encode())
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["missing.toml"], "missing.toml: "),
        ([EXAMPLES / "rv-20e.toml"], "a gear pair (cycloid-pair/1) is needed here"),
        ([MADE, "--limits", MADE], "a requirements file (cycloid-requirements/1) is needed here"),
    ],
)
def test_bad_files_are_a_sentence(command, words, sentence):
    done = command("cycloid-fmu", "desk", *words)
    assert done.returncode == 2
    assert sentence in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.system
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_a_designer_works_at_it(server):
    playwright = pytest.importorskip("playwright.sync_api")
    folder = server.path.parent
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1340, "height": 1000})
        said, urls = [], []
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda problem: said.append(str(problem)))
        page.on("request", lambda request: urls.append(request.url))
        page.goto(server.url)
        page.wait_for_selector("#disc-0")
        assert page.locator('[id="pair.eccentricity"]').input_value() == "1.3 mm"
        curves = ("transmission_error", "backlash", "pressure")

        def drawn():
            return [page.locator(f"#{name} path.line").get_attribute("d") for name in curves]

        before, outline = drawn(), page.locator("#disc-0").get_attribute("d")
        page.locator('[id="modification.offset"]').fill("-55 um")
        page.wait_for_selector("#time:not(:empty)")
        assert all(one != other for one, other in zip(before, drawn(), strict=True))
        assert page.locator("#disc-0").get_attribute("d") != outline
        shown = look(server.desk, {**server.desk.values, "modification.offset": "-55 um"})
        assert shown.figures["TE, mean"] in page.locator("#figures").inner_text()

        page.locator('[id="pair.pin_radius"]').fill("30 mm")
        sentence = page.locator('label:has([id="pair.pin_radius"]) .said')
        sentence.get_by_text("the flank is undercut").wait_for()
        assert page.locator("#results.old").count() == 1
        page.locator("#save").click()
        page.locator("#saved").get_by_text("the flank is undercut").wait_for()
        page.locator('[id="pair.pin_radius"]').fill("3 mm")
        page.wait_for_selector("#results:not(.old)")
        assert sentence.inner_text() == ""

        page.locator("#turn").fill("90")
        assert page.locator("#crank_angle").input_value() == "90 deg"
        page.locator("#name").fill("<b>new</b>.toml")
        page.locator("#save").click()
        page.locator("#saved").get_by_text("write a name without folders").wait_for()
        page.locator("#name").fill("new.toml")
        page.locator("#save").click()
        page.locator("#saved").get_by_text("new.toml is saved.").wait_for()
        assert cy.read_drive(folder / "new.toml").pair == cy.read_drive(MADE).pair.replace(offset="-55 um")

        page.locator("#name").fill("drive.toml")
        questions = []
        page.once("dialog", lambda dialog: (questions.append(dialog.message), dialog.dismiss()))
        page.locator("#save").click()
        page.locator("#saved").get_by_text("Not saved.").wait_for()
        assert "Overwrite it?" in questions[0]
        assert (folder / "drive.toml").read_bytes() == MADE.read_bytes()
        page.once("dialog", lambda dialog: dialog.accept())
        page.locator("#save").click()
        page.locator("#saved").get_by_text("drive.toml is saved.").wait_for()
        assert cy.read_drive(folder / "drive.toml") == cy.read_drive(folder / "new.toml")
        browser.close()
    assert said == []
    assert all(url.startswith(server.url.split("?")[0]) for url in urls)
