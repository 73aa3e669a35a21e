"""The design report: what it says is what was computed, in both formats, and what is missing has its reason."""

import re

import numpy as np
import pytest
from common import EXAMPLES, make_pair

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.draw.design_report import comments_of, report_of, write_design_report
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.studies.sized_figures import figures_head, figures_of
from cycloid_fmu.surfaces.sampling import read_tolerances
from cycloid_fmu.surfaces.surface import surface_of_pair

PAIR = make_pair(rated_torque="181 N*m").replace(
    material={"gear": {"name": "7075-T6"}, "pin": {"name": "bearing steel"}}
)


@pytest.fixture(scope="module")
def report():
    text = "# Assumed <here>.\n" + PAIR.text
    drive = cy.Drive(PAIR)
    return report_of(drive, drive.motion("181 N*m", 0.0), "drive.toml", text, *figures_of(drive))


@pytest.mark.parametrize(
    "name",
    [
        "drive-39-40-as-made.toml",
        "rv-20e.toml",
        pytest.param("drive-39-40-bearings.toml", marks=pytest.mark.slow(15)),
    ],
)
@pytest.mark.filterwarnings("ignore::cycloid_fmu.edge.InputWarning")  # of the paper's numbers, which contradict
def test_figures_are_those_of_the_analysis(name):
    """With the drive's errors, on its bearings, and of a reducer with the sun locked."""
    drive = cy.read_drive(EXAMPLES / name)
    figures = {each.name: each.values[0] for each in figures_of(drive)[0]}
    turn = np.linspace(0.0, 2.0 * np.pi, 91, endpoint=False)
    solved = solve(drive, [drive.pair.rated_torque], turn, with_play=True)
    assert figures["backlash"] == pytest.approx(np.nanmax(solved.backlash), rel=1e-6)
    assert figures["angular transmission error"] == pytest.approx(np.ptp(solved.transmission_error), rel=1e-6)
    assert figures["contact pressure"] == pytest.approx(solved.max_contact_pressure.max(), rel=1e-6)
    assert figures_head(drive)[1] == "with its errors"
    assert figures_head(cy.Drive(drive.pair.nominal))[1] == "as drawn"


def test_a_range_of_drives_without_the_drive_s_errors_says_so():
    tolerances = read_tolerances(EXAMPLES / "tolerances-of-places.toml")
    drive = cy.Drive(PAIR.replace(errors={"pin_radius": "-1 um"}))
    for each, said in ((drive, True), (cy.Drive(PAIR), False)):
        rows = {row.name: row.basis for row in figures_of(each, tolerances)[0]}
        for name in ("backlash", "contact pressure"):
            assert ("without these errors" in rows[name]) == said


def test_comments_at_the_head_are_what_is_assumed():
    assert comments_of("# One.\n#\n# Two.\nformat = 1\n# three\n") == ["One.", "Two."]


def test_the_page_has_the_figures_and_why_others_are_missing(report, tmp_path):
    write_design_report(report, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    turn = np.linspace(0.0, 2.0 * np.pi, 91, endpoint=False)
    found = solve(DriveValue(PAIR, surface_of_pair(PAIR)), [181.0], turn, with_play=False)
    assert f"{found.max_contact_pressure.max() * 1e-6:.3g}" in page
    assert f">{found.torsional_stiffness.mean() * np.pi / 10800:.3g}<" in page  # N·m/arcmin
    assert "Assumed &lt;here&gt;." in page
    assert "without [supports] the load of output pins is not known" in page
    assert "not computed: state [bodies.disc]" in page
    assert len(re.findall(r'class="pin"', page)) == PAIR.pins


def test_the_pdf_is_one_and_another_ending_is_refused(report, tmp_path):
    write_design_report(report, tmp_path / "report.pdf")
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")
    with pytest.raises(edge.InputError, match=r"\.html"):
        write_design_report(report, tmp_path / "report.docx")


def test_the_command_judges_limits_and_leaves_with_their_code(command, tmp_path):
    (tmp_path / "pair.toml").write_text(PAIR.text)
    done = command("cycloid-fmu", "report", "pair.toml", "-o", "report.html")
    assert done.returncode == 0, done.stderr
    (tmp_path / "asked.toml").write_text('format = "cycloid-requirements/1"\n[limits]\npin_safety = 1e9\n')
    done = command("cycloid-fmu", "report", "pair.toml", "--limits", "asked.toml", "-o", "report.html")
    assert done.returncode == 4
    assert "not met" in (tmp_path / "report.html").read_text(encoding="utf-8")
