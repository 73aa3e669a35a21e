"""The certificate of a drive: decisions by the stated rule, how often they are wrong, and the page."""

import re

import numpy as np
import pytest
from common import EXAMPLES
from scipy.stats import norm
from test_loop_drift import COULOMB, RATED, swung, wound

import fitting
from cycloid_fmu import edge
from cycloid_fmu.studies import limits as asked
from fitting.figures import conformity
from fitting.figures.conformity import Certificate, decide, decisions_of, read_certificate, verdict_of
from fitting.figures.figure import DEFINITIONS
from fitting.reports.certificate import _limit_panels

ARCSEC = np.pi / 648000
TEXT = (EXAMPLES / "certificate.toml").read_text(encoding="utf-8")
LIMITS = TEXT.split("[limits]")[0] + "[limits]\n"


@pytest.fixture(scope="module")
def found():
    torque = swung([1, -1, 1])
    windup = wound(torque, 0.5, COULOMB) * 60.0 * ARCSEC
    angle = windup + np.random.default_rng(0).normal(0.0, 0.3 * ARCSEC, windup.size)
    run = fitting.Run(0.0, angle, torque, time=0.01 * np.arange(torque.size))
    return fitting.metrics(run, ratio=-39.0, rated_torque=RATED, instruments=EXAMPLES / "instruments.toml")


def test_wrong_decisions_are_as_rare_as_the_rule_says():
    """A drive at its limit with a normal error: guard band passes it wrongly 1 in 40 times, simple acceptance half."""
    read = 1.0 + 0.1 * norm.ppf((np.arange(4000) + 0.5) / 4000)
    for rule, wrong in (("guard band", 0.025), ("simple acceptance", 0.5)):
        passed = [decide(value, 1.959964 * 0.1, -np.inf, 1.0, rule) == "pass" for value in read]
        assert np.mean(passed) == pytest.approx(wrong, abs=0.001)
    assert decide(0.5, np.nan, -np.inf, 1.0, "guard band") == "undecided"
    assert decide(np.nan, 0.1, -np.inf, 1.0, "simple acceptance") == "undecided"
    assert decide(2.0, 0.1, 2.5, 3.0, "guard band") == "fail"
    assert decide(2.55, 0.1, 2.5, 3.0, "guard band") == "undecided"
    assert decide(2.5, 0.4, 2.4, 2.6, "guard band") == "undecided"  # U is wider than the limits are apart


def certificate(rule="guard band", **limits):
    device = {"name": "39/40", "serial_number": "7"}
    return Certificate(device=device, decision_rule=rule, limits={n: {"max": v} for n, v in limits.items()})


def test_a_limit_that_is_one_text_is_on_the_figure_s_own_side():
    device = {"name": "39/40", "serial_number": "7"}
    short = {"backlash": "35 arcsec", "torsional_stiffness": "25 N*m/arcmin"}
    whole = {"backlash": {"max": "35 arcsec"}, "torsional_stiffness": {"min": "25 N*m/arcmin"}}
    one, other = (Certificate(device=device, decision_rule="guard band", limits=g) for g in (short, whole))
    assert one == other
    assert set(asked.LOWER) >= set(conformity.LOWER) == set(asked.LOWER) & set(DEFINITIONS)


def test_the_verdict_of_a_drive_is_that_of_its_worst_figure(found):
    """The backlash is 30″, the lost motion 50″, of which the instruments leave U ≈ 0.7″."""
    for limits, verdict in (
        ({"backlash": "35 arcsec", "lost_motion": "52 arcsec"}, "pass"),
        ({"backlash": "35 arcsec", "lost_motion": "50 arcsec"}, "undecided"),
        ({"backlash": "25 arcsec", "lost_motion": "50 arcsec"}, "fail"),
        ({"backlash": "35 arcsec", "starting_torque": "1 N*m"}, "undecided"),
    ):
        decisions = decisions_of(found, certificate(**limits))
        assert verdict_of(decisions) == verdict, decisions
        assert all(
            one.figure not in found.budgets or one.expanded == found.budgets[one.figure].expanded for one in decisions
        )
    assert 0.2 < found.budgets["lost_motion"].expanded / ARCSEC < 2.0


def test_the_page_holds_all_that_a_certificate_states(found, tmp_path):
    fitting.report(found, tmp_path / "c.html", certificate=EXAMPLES / "certificate.toml")
    page = (tmp_path / "c.html").read_text(encoding="utf-8")
    shown = re.sub(r"<script>.*?</script>|<[^>]+>", " ", page, flags=re.S)
    for words in (
        "Verdict: undecided",
        "0007",
        "Test laboratory",
        "E-0815",
        "2026-02-10",
        "not stated",
        "(20 ± 1) °C",
        "167 N·m",
        "Guard band of the expanded uncertainty",
        "Lost motion",
        "Torsional stiffness",
        "torque sensor, class 0.1",
        "expanded, k = 1.96",
        "missing",
    ):
        assert words in shown, words
    assert "http" not in re.sub(r"<script>.*?</script>", "", page, flags=re.S)
    rows = re.findall(r"<tr>(.*?)</tr>", page.split('id="results"')[1].split("</table>")[0], flags=re.S)[1:]
    cells = [[re.sub("<[^>]+>", "", c).strip() for c in re.findall(r"<td.*?</td>", row, flags=re.S)] for row in rows]
    assert [(c[0], c[-1]) for c in cells] == [
        ("Lost motion", "pass"),
        ("Backlash", "pass"),
        ("Torsional stiffness", "pass"),
        ("Angular transmission error", "undecided"),
        ("Hysteresis loss", ""),
    ]
    assert float(cells[0][1]) == pytest.approx(found.figures["lost_motion"].value / ARCSEC, abs=0.01)


def test_a_small_margin_to_a_limit_looks_small(found):
    """The picture's bars begin at zero percent of the limit."""
    (panel,) = _limit_panels(decisions_of(found, read_certificate(EXAMPLES / "certificate.toml")))
    bars = [t for t in panel.traces if t.style == "thin"]
    assert len(bars) == len(panel.y_names)
    assert all(bar.x[0] == 0.0 for bar in bars)


def test_a_certificate_needs_instruments_and_html(found, tmp_path):
    bare = fitting.metrics(fitting.Run(0.0, swung([1, -1]) * 1e-6, swung([1, -1])), ratio=-39.0)
    with pytest.raises(edge.InputError, match="needs the instruments"):
        fitting.report(bare, tmp_path / "c.html", certificate=certificate())
    with pytest.raises(edge.InputError, match=r"must end in \.html"):
        fitting.report(found, tmp_path / "c.pdf", certificate=certificate())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('lost_motion = "1 arcmin"', "lost_motion = {}", "state min, max or both"),
        ('lost_motion = "1 arcmin"', 'lost_motion = {max = "1 mm"}', "lost_motion"),
        ('lost_motion = "1 arcmin"', 'lost = {max = "1 arcmin"}', "lost is not a figure"),
        ('lost_motion = "1 arcmin"', 'lost_motion = {min = "2 arcmin", max = "1 arcmin"}', "min is above max"),
        ('"guard band" ', '"shared risk" ', "decision_rule"),
        ('serial_number = "0007"', "", "[device] serial_number is missing"),
    ],
)
def test_bad_certificates_are_one_sentence(tmp_path, old, new, said):
    assert old in TEXT
    (tmp_path / "c.toml").write_text(TEXT.replace(old, new), encoding="utf-8")
    with pytest.raises(edge.InputError) as caught:
        read_certificate(tmp_path / "c.toml")
    assert said in str(caught.value)
    assert "c.toml" in str(caught.value)


def test_the_certificate_from_the_command_line(command, tmp_path):
    torque = swung([1, -1, 1])
    windup = wound(torque, 0.5, COULOMB) * 60.0
    rows = "\n".join(f"{0.01 * n:.2f},0,{w:.6f},{t:.6f}" for n, (w, t) in enumerate(zip(windup, torque, strict=True)))
    (tmp_path / "loop.csv").write_text(f"time [s],input_angle [deg],output_angle [arcsec],torque [N*m]\n{rows}\n")
    (tmp_path / "drive.toml").write_text(LIMITS + 'backlash = {max = "35 arcsec"}\n', encoding="utf-8")
    words = ("cycloid-fit", "report", "loop.csv", "--rated-torque", "167 N*m", "--certificate", "drive.toml", "-o")
    run = command(*words, "c.html", "--instruments", EXAMPLES / "instruments.toml")
    assert run.returncode == 0, run.stderr
    assert "Verdict: pass" in (tmp_path / "c.html").read_text(encoding="utf-8")
    run = command(*words, "d.html")
    assert run.returncode == 2
    assert "needs the instruments" in run.stderr
    assert not (tmp_path / "d.html").exists()
