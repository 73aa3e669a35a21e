"""Hysteresis loops in the data: play separate from friction, and effects that transmission errors can't separate."""

import dataclasses
import json

import numpy as np
import pytest
from clockworks import kinematic_drive

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.surfaces.structured import structured_value, with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.identify import identify
from fitting.estimation.plan import plan
from fitting.model.loops import branches_of, is_locked, on_the_curves_zero, play_of
from fitting.model.observations import State, left_of, linearise, observations, spread_of
from fitting.readers.recording import Recording
from fitting.transmission_error.survey import survey

ARCSEC = np.pi / 648000
RATED, CRANK = 181.0, 7.3


def wound_up(pair, *, friction, crank=CRANK, sides=(1, -1), samples=800, noise=0.5 * ARCSEC, common_zero=False):
    """Recording of the drive that a system model steps, the crank locked, its torque to the rated one and back.

    The mesh alone is so stiff that friction's usual presliding would take half a branch; here it has next to none.
    """
    drive = kinematic_drive(DriveValue.as_stated(pair))
    drive.set_friction(1, coulomb=friction, presliding_angle=1e-8)
    drive.crank_angle = crank
    way = np.concatenate([np.linspace(0.0, RATED, samples), np.linspace(RATED, 0.0, samples)])
    torque = np.concatenate([side * way for side in sides])
    output = []
    for one in torque:
        drive.torque = float(one)
        drive.advance()
        output.append(crank / pair.ratio + drive.transmission_error)
    output += 3e-4 + np.random.default_rng(0).normal(0.0, noise, torque.size)
    return Recording(
        np.arange(torque.size) * 0.01,
        np.full(torque.size, crank),
        np.array(output),
        torque,
        np.zeros(torque.size, np.uint8),
        common_zero=common_zero,
        known_index=True,
        ratio=pair.ratio,
        source="loop.csv",
        checksum="0",
    )


def rubbing_more_with_load(pair, *, without_load, growth, noise=0.5 * ARCSEC):
    """Recording of the exact contacts wound up by M, where the bench reads M ± (F_0 + mu |M|)."""
    top, samples = (RATED - without_load) / (1.0 + growth), 800
    spring = np.concatenate([np.linspace(a, b, samples) for a, b in ((0, top), (top, 0), (0, -top), (-top, 0))])
    way = np.repeat([1.0, -1.0, -1.0, 1.0], samples)
    torque = spring + way * (without_load + growth * np.abs(spring))
    (winding,) = solve(DriveValue.as_stated(pair), spring[:, None], CRANK).transmission_error.T
    output = CRANK / pair.ratio + winding + 3e-4 + np.random.default_rng(0).normal(0.0, noise, torque.size)
    return Recording(
        np.arange(torque.size) * 0.01,
        np.full(torque.size, CRANK),
        output,
        torque,
        np.zeros(torque.size, np.uint8),
        common_zero=False,
        known_index=True,
        ratio=pair.ratio,
        source="loop.csv",
        checksum="0",
    )


def branches(pair, **how):
    return branches_of(survey(wound_up(pair, **how), pair.ratio, RATED), pair.ratio)


@pytest.fixture(scope="module")
def loop(made):
    return branches(made, friction=2.0)


def test_branches_of_the_model_s_drive_are_what_the_fit_calls_the_same_friction(made):
    """Friction opposes the motion on each branch; the play needs no parameter of its own."""
    observed = observations(branches(made, friction=5.0, noise=0.0), made)

    def left(friction):
        nothing = np.zeros(spread_of(made, {}).size), np.zeros(observed.bench.shape[1])
        state = State(surface_of_pair(made), *nothing, loop_friction=friction)
        return left_of(observed, linearise(made, observed, state), state) - 3e-4

    assert np.abs(left(5.0)).max() < 0.05 * ARCSEC
    assert np.abs(left(0.0)).min() > 0.15 * ARCSEC


def test_friction_that_grows_with_load_is_an_unknown_of_the_loop(made):
    """Its exact value leaves nothing, and the derivatives by both unknowns are those of the model."""
    recording = rubbing_more_with_load(made, without_load=2.5, growth=0.4, noise=0.0)
    observed = observations(branches_of(survey(recording, made.ratio, RATED), made.ratio), made)
    nothing = np.zeros(spread_of(made, {}).size), np.zeros(observed.bench.shape[1])

    def at(without_load, growth):
        state = State(surface_of_pair(made), *nothing, loop_friction=without_load, loop_friction_per_load=growth)
        return linearise(made, observed, state)

    exact = at(2.5, 0.4)
    assert np.abs(observed.measured - exact.model - 3e-4).max() < 0.05 * ARCSEC
    assert np.abs(observed.measured - at(2.5, 0.0).model - 3e-4).max() > 2.0 * ARCSEC
    for by, moved in ((exact.by_friction, at(2.51, 0.4)), (exact.by_friction_per_load * 0.1, at(2.5, 0.401))):
        assert by == pytest.approx((moved.model - exact.model) / 0.01, rel=1e-2)


def test_the_play_and_its_derivatives_are_those_of_the_contact_model(made):
    surface = surface_of_pair(made)
    names = ["pin_radius", "pin_circle_radius", "isometric", "offset", "eccentricity", "centre_distance_x"]
    play, slopes, _ = play_of(DriveValue(made, surface), CRANK, names)
    assert play == solve(DriveValue(made, surface), 1.0, CRANK).backlash[0]
    for name, slope in zip(names, slopes, strict=True):
        ends = [
            solve(
                DriveValue(made, with_structured(surface, {name: structured_value(surface, name) + way * 1e-8})),
                1.0,
                CRANK,
            ).backlash[0]
            for way in (-1.0, 1.0)
        ]
        assert slope == pytest.approx((ends[1] - ends[0]) / 2e-8, rel=1e-3, abs=1e-3)


@pytest.mark.slow(1)
def test_a_loop_whose_friction_grows_with_load_tells_the_play(measured, nominal, made):
    """Constant friction would put the growth into errors; the interval would be as small, and false."""
    curves = measured(1, each=12, zeros=(3e-4, -2e-4, 1e-4, 5e-5), common_zero=False)
    recording = rubbing_more_with_load(made, without_load=2.5, growth=0.4)
    loop = branches_of(survey(recording, made.ratio, RATED), made.ratio)
    found = identify([*curves, *loop], Drive(nominal), form=0.0)
    truth = surface_of_pair(made)
    far = [
        abs(p.value - structured_value(truth, p.name)) / p.standard_error for p in found.parameters if p.held is None
    ]
    assert max(far) < 4.0
    assert found.bench["loop_friction_torque"] == pytest.approx(2.5, abs=0.3)
    assert found.bench["loop_friction_per_load"] == pytest.approx(0.4, abs=0.01)
    (fitted,) = found.loops
    assert abs(fitted.play - solve(DriveValue(made, truth), 1.0, CRANK).backlash[0]) < 4.0 * fitted.standard_error


@pytest.mark.slow(5)
def test_a_loop_tells_what_transmission_errors_alone_do_not(measured, nominal, made, loop):
    """Without a common zero nothing relates the two sides of the teeth, but the play does."""
    curves = measured(1, each=12, zeros=(3e-4, -2e-4, 1e-4, 5e-5), common_zero=False)
    alone = {p.name: p for p in identify(curves, Drive(nominal), held_out=False, form=0.0).parameters}
    found = identify([*curves, *loop], Drive(nominal), form=0.0)
    with_loop = {p.name: p for p in found.parameters}
    assert alone["pin_circle_radius"].held is not None
    assert with_loop["pin_circle_radius"].held is None
    assert with_loop["pin_radius"].standard_error < 0.7 * alone["pin_radius"].standard_error
    truth = surface_of_pair(made)
    far = [
        abs(p.value - structured_value(truth, p.name)) / p.standard_error for p in found.parameters if p.held is None
    ]
    assert max(far) < 4.0
    assert found.bench["loop_friction_torque"] == pytest.approx(2.0, abs=0.3)
    (one,) = found.loops
    assert abs(one.play - solve(DriveValue(made, truth), 1.0, CRANK).backlash[0]) < 4.0 * one.standard_error
    assert one.standard_error < 0.1 * ARCSEC
    assert found.held_out.residual < 1.2 * found.held_out.noise


def test_a_plan_with_a_loop_foretells_what_it_adds(nominal):
    runs = {"turns": 1.0, "samples": 12, "noise": 0.5 * ARCSEC, "scatter": 0.3e-6}
    one_way, wound, both, all_of_it = plan(Drive(nominal), [200.0], loop=RATED, **runs)
    assert wound.runs == "200 N·m forward and a loop to 181 N·m"
    assert "pin_radius" not in one_way.standard_error
    assert "pin_radius" in wound.standard_error
    for name, error in both.standard_error.items():
        assert all_of_it.standard_error.get(name, 0.0) < 1.01 * error


def test_the_crank_s_turn_is_found_by_an_absolute_output(made, measured):
    """An input encoder that is absolute within one turn reads 7.3 - 2π; the teeth in contact are those at 7.3."""
    recording = wound_up(made, friction=0.5, common_zero=True)
    short = dataclasses.replace(recording, input_angle=recording.input_angle - 2.0 * np.pi)
    curves = measured(1, each=12, zeros=(3e-4,) * 4)
    seen, wanted = (
        on_the_curves_zero(branches_of(survey(r, made.ratio, RATED), made.ratio), curves) for r in (short, recording)
    )
    for one, other in zip(seen, wanted, strict=True):
        assert one.input_angle == pytest.approx(np.full(24, CRANK), abs=1e-9)
        assert one.transmission_error == pytest.approx(other.transmission_error, abs=1e-12)


@pytest.mark.parametrize(
    ("how", "said"),
    [({"sides": (1,)}, "loop.csv: the loop loads one side only"), ({"samples": 60}, "at least 96")],
)
def test_a_loop_that_tells_no_play_is_refused(made, how, said):
    with pytest.raises(edge.InputError, match=said):
        branches(made, friction=0.5, **how)


@pytest.mark.filterwarnings("error")
def test_friction_that_hides_the_play_is_named(made):
    """The branches of a loop to 181 N·m begin and end where the friction of 110 N·m holds them."""
    with pytest.raises(edge.InputError, match="friction hides the positive loading branch of the loop"):
        branches(made, friction=110.0)


def test_a_loop_at_an_unknown_crank_angle_is_refused(made):
    """Its figures need no crank angle, but the model does."""
    unknown = dataclasses.replace(wound_up(made, friction=2.0, crank=0.0), has_input_angle=False)
    surveyed = survey(unknown, made.ratio, RATED)
    assert surveyed.loops is not None
    with pytest.raises(edge.InputError, match="no input angle is mapped; a fit needs the crank angle"):
        branches_of(surveyed, made.ratio)


def test_loops_alone_are_refused(nominal, loop):
    with pytest.raises(edge.InputError, match="one crank angle only"):
        identify(loop, Drive(nominal))


@pytest.mark.slow(2)
def test_loops_among_recordings_on_the_command_line(command, made, measured, tmp_path, nominal):
    (tmp_path / "pair.toml").write_text(nominal.text)
    header = "time [s],input_angle [rad],output_angle [rad],torque [N*m]"

    def write(name, table):
        rows = [",".join(f"{v:.12g}" for v in row) for row in np.column_stack(table)]
        (tmp_path / name).write_text("\n".join([header, *rows]) + "\n")

    r = wound_up(made, friction=2.0)
    assert is_locked(r, -39.0)
    write("loop.csv", (r.time, r.input_angle, r.output_angle, r.torque))
    for number, c in enumerate(measured(1, each=12)[2:]):
        way = slice(None, None, c.direction)
        angle = c.input_angle[way]
        write(
            f"{number}.csv",
            (
                np.arange(angle.size) * 0.01,
                angle,
                angle / c.ratio + c.transmission_error[way],
                np.full(angle.size, c.torque),
            ),
        )
    run = command(
        "cycloid-fit",
        "identify",
        "loop.csv",
        *(f"{n}.csv" for n in range(2)),
        "--pair",
        "pair.toml",
        "-o",
        "fit.json",
        "--report",
        "fit.html",
        "--plot",
        "fit.png",
    )
    assert run.returncode == 0, run.stderr
    assert "loop.csv: play at the crank angle 418.3°" in run.stdout
    content = json.loads((tmp_path / "fit.json").read_text())
    assert content["loops"]["loop.csv"]["play"] == pytest.approx(
        solve(DriveValue.as_stated(made), 1.0, CRANK).backlash[0], abs=0.5 * ARCSEC
    )
    assert "loop.csv" in content["data"]
    assert "Hysteresis loop: loop.csv" in (tmp_path / "fit.html").read_text()
