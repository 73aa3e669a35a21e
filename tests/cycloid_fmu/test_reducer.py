"""The RV reducer: the paper's tables, and its closed forms against the contact model (docs/theory/reducer.md)."""

import dataclasses
import json

import numpy as np
import pytest
from common import EXAMPLES
from hypothesis import given
from hypothesis import strategies as st

from cycloid_fmu import edge
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import ARCMIN
from cycloid_fmu.reducer.description import contradictions, parse_reducer, read_reducer, surface_of_reducer, values_of
from cycloid_fmu.reducer.lost_motion import (
    STAGES,
    TERMS,
    budget,
    contact_play,
    play_alone,
    remarks,
    runout_error,
    shaft_tilt,
    standard,
    summed,
)
from cycloid_fmu.reducer.stack import stack

RV = read_reducer(EXAMPLES / "rv-20e.toml")
TEXT = (EXAMPLES / "rv-20e.toml").read_text()
# The RV paper's table 5: input torque N·m, output torque N·m, β_output °, Y_output mm, β_input °, Y_input mm.
TABLE_5 = np.loadtxt(EXAMPLES / "rv-20e-tilt.csv", delimiter=",", skiprows=1)


@pytest.fixture(scope="module")
def found():
    return budget(RV)


@pytest.mark.parametrize(
    ("variant", "part", "arcmin"),
    [
        ("standard", "involute", 0.026330),
        ("standard", "cycloid", 1.692562),
        ("standard", "bearings", 0.250018),
        ("standard", "total", 1.968910),
        ("as_printed", "total", 0.548811),
    ],
)
def test_the_paper_s_tables_give_what_was_checked(found, variant, part, arcmin):
    assert found[variant][part] * ARCMIN == pytest.approx(arcmin, abs=1e-6)


def test_the_headline_is_the_typesetting_s(found):
    """0.5467′ published: the correct formula is far from it, the one as typeset within half a per cent."""
    assert found["as_printed"]["total"] * ARCMIN == pytest.approx(0.5467, rel=5e-3)
    assert found["standard"]["total"] * ARCMIN > 3 * 0.5467


def test_terms_add_up_in_every_variant(found):
    for variant in found.values():
        terms = sum(variant[n] for n in TERMS) + variant.get("interaction", 0.0)
        assert terms == pytest.approx(variant["total"], abs=1e-12)
        assert sum(variant[s] for s in STAGES) == pytest.approx(variant["total"], abs=1e-15)


def test_printed_k_n_moves_the_sum_to_what_was_checked(found):
    """1.969309′ with the K_n of equation 17, whose second bracket adds 1/m³ to 1/m, in millimetres."""
    without = found["standard"]["total"] - found["standard"]["eccentricity"]
    printed = found["as_printed"]["eccentricity"] * ARCMIN  # bare radians, added to arcminutes there
    assert (without + printed) * ARCMIN == pytest.approx(1.969309, abs=1e-6)


def test_ratio_is_the_paper_s():
    assert RV.ratio == 141.0
    assert RV.sun_locked == pytest.approx(0.968085, abs=5e-7)


def test_tilts_are_those_of_table_5():
    assert len(TABLE_5) == 20
    output, driven = (np.degrees(shaft_tilt(TABLE_5[:, c] * 1e-3, length)) for c, length in ((3, 0.160), (5, 0.120)))
    assert np.abs(output - TABLE_5[:, 2]).max() < 1e-5
    assert np.abs(driven - TABLE_5[:, 4]).max() < 1e-7


def test_tilt_does_not_explain_table_10():
    """The paper's 0.5462′ to 0.6063′; its tilts change the closed form by no digit that it prints."""
    tilted = RV.model_copy(
        update={"involute": RV.involute.replace(shaft_tilt=np.radians(3.44e-5))},
    )
    change = summed(standard(tilted, values_of(tilted)))["total"] - summed(standard(RV, values_of(RV)))["total"]
    assert abs(change) * ARCMIN < 1e-9


@pytest.mark.parametrize("radius", ["50 mm", "52 mm"])
@pytest.mark.parametrize(
    ("name", "amount"),
    [
        ("isometric_modification", 20e-6),
        ("offset_modification", -20e-6),
        ("isometric", 10e-6),
        ("offset", -10e-6),
        ("pin_circle_radius", 20e-6),
        ("pin_radius", -20e-6),
        ("pin_hole_clearance", 20e-6),
    ],
)
def test_five_terms_hold_in_the_contact_model(radius, name, amount):
    """With the shortening that the pin circle radius really means, within 0.5 %."""
    made = parse_reducer(TEXT.replace('"52 mm"', f'"{radius}"').replace("shortening = 0.72", ""), "rv.toml")
    amounts = dict.fromkeys(TERMS, 0.0) | {name: amount}
    play = contact_play(made, surface_of_reducer(made, amounts), 391)
    assert play.interference.max() == 0.0
    closed = float(standard(made, amounts)[name])
    assert play.backlash.mean() == pytest.approx(closed, rel=5e-3)


def test_eccentricity_takes_play_away_whatever_its_sign():
    """Second order: at the paper's modifications and clearances both signs take play, the closed form's would give."""
    amounts = values_of(RV) | {"gear_runout": 0.0, "tooth_cumulative_pitch": 0.0}

    def mean(error):
        surface = surface_of_reducer(RV, amounts | {"eccentricity": error})
        return contact_play(RV, surface, 391).backlash.mean() * ARCMIN

    longer, shorter = mean(5e-6) - mean(0.0), mean(-5e-6) - mean(0.0)
    assert longer == pytest.approx(-0.104, abs=1e-3)
    assert shorter == pytest.approx(-0.080, abs=1e-3)
    assert standard(RV, amounts | {"eccentricity": -5e-6})["eccentricity"] > 0.0


def test_pin_positions_take_play_where_the_closed_form_gives_it():
    closed = float(standard(RV, dict.fromkeys(TERMS, 0.0) | {"pin_tangential": 5e-6})["pin_tangential"])
    assert closed > 0.0
    assert play_alone(RV, "pin_tangential", 5e-6) == pytest.approx(-closed, rel=0.1)


def test_runout_is_a_transmission_error():
    """An eccentric gear turns with the carrier: TE of ΔF_r/(e z_c) peak to peak, and hardly any play."""
    swing = runout_error(RV, 15e-6)
    g = RV.stage
    assert swing == pytest.approx(15e-6 / (g.eccentricity * g.gear_teeth), rel=5e-3)
    assert swing * ARCMIN == pytest.approx(1.465, rel=6e-3)
    closed = float(standard(RV, values_of(RV))["gear_runout"])
    assert -0.2 * closed < play_alone(RV, "gear_runout", 15e-6) < 0.0 < closed


def test_cumulative_pitch_is_bounded_by_the_closed_form():
    amounts = dict.fromkeys(TERMS, 0.0) | {"pin_radius": -20e-6}
    free = contact_play(RV, surface_of_reducer(RV, amounts), 391).backlash
    pitched = contact_play(RV, surface_of_reducer(RV, amounts | {"tooth_cumulative_pitch": 19e-6}), 391).backlash
    bound = float(standard(RV, amounts | {"tooth_cumulative_pitch": 19e-6})["tooth_cumulative_pitch"])
    assert bound < (pitched - free.mean()).min() < 0.5 * bound
    assert abs(pitched.mean() - free.mean()) < 0.2 * abs(bound)


def test_the_sun_locked_leaves_a_share_of_the_play(found):
    crank, sun = found["geometric"], found["geometric_sun_locked"]
    assert sun["cycloid"] == pytest.approx(0.9680851 * crank["cycloid"], rel=1e-6)
    assert crank["involute"] == 0.0
    assert sun["involute"] == pytest.approx(
        13.7e-6 / (0.5 * 1.5e-3 * 12 * np.cos(np.radians(20.0)) * 141.0)
    )  # the common normal is tangent to the base circle


def test_the_cranks_roll_on_the_locked_sun():
    """Kinematics by wheel angles: sun 0, output φ; the gear's play is its rotation minus that from the crank's."""
    z1, z2, teeth = 12, 42, 39
    output = 1e-3
    planet = output + output * z1 / z2  # in the carrier's frame the sun turns by -output
    deviation = output + planet / teeth
    assert output / deviation == pytest.approx(RV.sun_locked)


@pytest.mark.slow(2)
def test_two_unlucky_discs_have_less_play():
    both = parse_reducer(TEXT.replace("discs = 1 ", "discs = 2 "), "rv.toml")
    assert budget(both)["geometric"]["cycloid"] < budget(RV)["geometric"]["cycloid"]


def test_interference_is_reported_as_such():
    tight = parse_reducer(TEXT.replace('pin_radius = "-4 um"', 'pin_radius = "6 um"'), "rv.toml")
    exact = budget(tight)["geometric"]
    assert exact["interference"] > 1e-6
    assert 0.0 < exact["interfering"] <= 1.0
    assert exact["cycloid_smallest"] == 0.0
    assert exact["cycloid"] >= 0.0


@pytest.fixture(scope="module")
def scattered():
    return stack(RV, 400, 3)


def test_worst_case_holds_every_sample_and_root_sum_square_most(scattered):
    total = scattered.samples["standard"]
    low, high = scattered.worst_case
    assert low < total.min()
    assert total.max() < high
    low, high = scattered.root_sum_square
    assert 0.98 < np.mean((total > low) & (total < high)) <= 1.0


def test_scatter_is_that_of_the_sum_of_variances(scattered):
    """Each normal deviation, cut off at three of its deviations, has 0.98658 of it; the closed form is linear."""
    low, high = scattered.root_sum_square
    assert scattered.samples["standard"].std() == pytest.approx(0.98658 * (high - low) / 6.0, rel=0.12)


@pytest.mark.slow(3)
def test_samples_depend_on_the_seed_alone(scattered):
    again, other = stack(RV, 400, 3), stack(RV, 400, 4)
    assert (again.samples["geometric"] == scattered.samples["geometric"]).all()
    assert not (other.samples["geometric"] == scattered.samples["geometric"]).any()


def test_interference_within_the_tolerances_is_counted():
    """Amounts that leave as much play as the tolerance takes: about half of the reducers interfere."""
    text = TEXT.split("[deviations]")[0].replace('"-10 um"', '"0 um"').replace('"-12 um"', '"0 um"')
    tight = parse_reducer(text + '[deviations]\npin_radius = { value = "0 um", tolerance = "3 um" }\n', "rv.toml")
    found = stack(tight, 400, 1)
    for variant in ("standard", "geometric"):
        low, high = found.interval[variant]
        assert low < 0.5 < high
        assert low < found.interfering[variant] < high


def test_nothing_scatters_without_tolerances():
    plain = TEXT.split("[deviations]")[0]
    assert stack(parse_reducer(plain, "rv.toml"), 100, 1) is None


def test_contradicting_numbers_are_named_with_the_one_that_is_used():
    said = contradictions(RV, "rv.toml")
    assert len(said) == 3
    for sentence, parts in zip(
        said,
        (("shortening = 0.72", '"52 mm"', '"50 mm"'), ('"13.5 mm"', '"9 mm"'), ('"27.5 mm"', '"40.5 mm"')),
        strict=True,
    ):
        assert sentence.startswith("rv.toml: ")
        assert "use" in sentence
        for part in parts:
            assert part in sentence
    consistent = TEXT.replace("0.72", "0.6923").replace('"13.5 mm"', '"9 mm"').replace('"27.5 mm"', '"40.5 mm"')
    assert contradictions(parse_reducer(consistent, "rv.toml"), "rv.toml") == []


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('pin_radius = "-4 um"', "pin_radius = -4", ("[deviations] pin_radius", "a space and a unit")),
        ('{ value = "0 um", tolerance = "1 um" }', '{ value = "0 um", tolerance = "0 um" }', ("isometric", "width")),
        ('{ lower = "-30.9 um", upper', '{ lower = "4 um", upper', ("base_tangent_length", "lower must be below")),
        ('{ lower = "-30.9 um", upper = "3.5 um" }', '{ lower = "1 um" }', ("base_tangent_length", "write")),
        ('runout = "15 um"', 'runout = "15 mm"', ("gear_runout", "between -1 mm and 1 mm")),
        ("sun_teeth = 12", "sun_teeth = 2", ("[involute] sun_teeth = 2", "6")),
        ("shortening = 0.72", "shortening = 1.2", ("[stated] shortening = 1.2", "less than 1")),
        ("[stated]", "[stated]\ncolour = 3", ("[stated] colour", "not a known key")),
        ("pins = 40", "pins = 42", ("pins = 42", "40")),
        ("discs = 1", 'output = "ring"\ndiscs = 1', ("output", "fixed")),
        ("reducer/1", "reducer/7", ("format", "cycloid-reducer/1")),
        ("[deviations]", '[errors]\npin_radius = "1 um"\n[deviations]', ("[errors]", "[deviations]")),
    ],
)
def test_bad_reducers_are_one_sentence(old, new, said):
    assert old in TEXT
    with pytest.raises(edge.InputError) as caught:
        parse_reducer(TEXT.replace(old, new), "rv.toml")
    assert str(caught.value).startswith("rv.toml: ")
    assert str(caught.value).count("\n") == 0
    for part in said:
        assert part in str(caught.value)


@given(
    value=st.floats(-4e-4, 4e-4), tolerance=st.floats(1e-9, 4e-4), distribution=st.sampled_from(("normal", "uniform"))
)
def test_limits_and_value_with_tolerance_say_the_same(value, tolerance, distribution):
    def read(text):
        made = TEXT.split("[deviations]")[0] + f"[deviations]\npin_radius = {{ {text} }}\n"
        return parse_reducer(made, "rv.toml").deviations.pin_radius

    tail = f'distribution = "{distribution}"'
    one = read(f'value = "{value!r} m", tolerance = "{tolerance!r} m", {tail}')
    two = read(f'lower = "{value - tolerance!r} m", upper = "{value + tolerance!r} m", {tail}')
    assert two.value == pytest.approx(one.value, abs=1e-15)
    assert two.tolerance == pytest.approx(one.tolerance, abs=1e-15)
    assert one.distribution == two.distribution == distribution


def test_the_cycloid_stage_alone_is_a_pair_file(tmp_path):
    """Code that accepts only pairs gets the reducer's pair from its text."""
    from cycloid_fmu.geometry.pair import parse_pair

    assert parse_pair(RV.stage.text, "inner") == RV.stage


SUPPORTS = '[supports]\nkind = "cranks"\ncount = 3\ncircle_radius = "27.5 mm"\n'


def test_supports_of_a_reducer_are_its_stage_s(found):
    """They hold the discs; the terms of the mesh stay the mesh's."""
    held = parse_reducer(TEXT.replace("[involute]", SUPPORTS + "[involute]"), "rv.toml")
    assert held.stage.supports.count == 3
    assert contact_play(held, surface_of_reducer(held), 29).backlash.mean() == pytest.approx(
        contact_play(RV, surface_of_reducer(RV), 29).backlash.mean(), rel=1e-12
    )


@pytest.mark.parametrize(("cranks", "more"), [(2, 1.16), (3, 1.03)])
def test_bearings_give_more_play_than_the_closed_form(cranks, more):
    """Their clearance lets the discs shift as well as turn: of two cranks by a sixth, of three within the limit."""
    text = TEXT.replace("[involute]", SUPPORTS.replace("count = 3", f"count = {cranks}") + "[involute]")
    held = parse_reducer(text, "rv.toml")
    budgeted = budget(held)
    closed, exact = (budgeted[v]["crank_bearing_clearance"] for v in ("standard", "geometric"))
    assert exact == pytest.approx(more * closed, rel=0.01)
    assert budgeted["geometric"]["total"] == pytest.approx(budgeted["geometric"]["cycloid"] + exact)
    assert ("crank_bearing_clearance" in remarks(held, budgeted)) == (cranks == 2)
    assert contradictions(held, "rv.toml") == contradictions(RV, "rv.toml")
    other = (
        'circle_radius = "29 mm"\n[supports.turning_arm]\nrollers = 15\nroller_length = "7 mm"\nclearance = "8 um"\n'
    )
    said = contradictions(parse_reducer(text.replace('circle_radius = "27.5 mm"\n', other), "rv.toml"), "rv.toml")
    assert 'circle_radius = "29 mm", but [involute] puts the cranks at "27.5 mm"' in said[-2]
    assert 'clearance = "8 um", but [deviations] crank_bearing_clearance = "2 um"' in said[-1]


@pytest.mark.slow(2)
def test_budget_from_the_command_line(command, tmp_path):
    (tmp_path / "rv-20e.toml").write_text(TEXT)
    run = command("cycloid-fmu", "budget", "rv-20e.toml", "--samples", 100, "--plot", "b.png")
    assert run.returncode == 0, run.stderr
    assert run.stderr.count("rv-20e.toml: ") == 3  # the contradictions
    assert "transmission error, 1.473′ peak to peak" in run.stdout
    assert (tmp_path / "b.png").stat().st_size > 20000
    run = command("cycloid-fmu", "budget", "rv-20e.toml", "--samples", 100, "--json")
    content = json.loads(run.stdout)
    assert content["standard"]["total"] * ARCMIN == pytest.approx(1.968910, abs=1e-6)
    assert set(content["remarks"]) >= {"gear_runout", "tooth_cumulative_pitch", "eccentricity"}
    assert content["stack"]["samples"] == 100
    (tmp_path / "bad.toml").write_text(TEXT.replace('"27.5 mm"', "27.5"))
    run = command("cycloid-fmu", "budget", "bad.toml", "--json")
    assert (run.returncode, run.stdout) == (2, "")
    assert "bad.toml: [involute] centre_distance = 27.5" in run.stderr


def test_play_is_that_of_the_analysis(found):
    """The same surface through the labelled dataset of an analysis, other crank angles: the same play on average."""
    from cycloid_fmu.analysis import solve

    surface = dataclasses.replace(surface_of_reducer(RV))
    angles = np.linspace(0.0, 2 * np.pi * 39, 601, endpoint=False)
    analysed = solve(DriveValue(RV.stage, surface), 0.0, angles).backlash
    assert analysed.mean() == pytest.approx(found["geometric"]["cycloid"], rel=2e-3)
