"""Sweeps: every combination of values, those that make no drive among them, in files, killed and gone on with."""

import csv
import json
import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
import xarray as xr
from common import EXAMPLES, make_pair
from hypothesis import given, settings
from hypothesis import strategies as st

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.draw.sweeps import plot_sweep
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.studies import sweep as sweeps
from cycloid_fmu.studies.sweep_files import table_of
from cycloid_fmu.studies.varied import drive_with, known_names, varied
from cycloid_fmu.surfaces.surface import ErrorSurface

PAIR = EXAMPLES / "drive-39-40.toml"
DRIVE = cy.read_drive(PAIR)
FEW = {"angles": 40, "workers": 1}


def same(one, other):
    """Whether two sweeps have the same figures to the last bit."""
    return all(np.array_equal(one[n].values, other[n].values, equal_nan=True) for n in (*sweeps.LOADED, *sweeps.FREE))


@pytest.mark.parametrize(
    ("name", "text", "changed"),
    [
        ("pin_radius", "3.1 mm", {"pin_radius": 3.1e-3}),
        ("gear_teeth", "35", {"gear_teeth": 35, "pins": 36}),
        ("isometric", "-5 um", {"isometric": -5e-6}),
        ("modification.offset", "-70 um", {"offset": -70e-6}),
        ("errors.pin_radius", "-2 um", {"errors": {"pin_radius": -2e-6}}),
        ("errors.pin_radial.order_3", "4 um", {"errors": {"pin_radial": {3: (4e-6, 0.0)}}}),
        ("temperature", "80 degC", {"temperature": dict.fromkeys(("ring", "discs", "carrier", "crank"), 353.15)}),
        ("material.gear.youngs_modulus", "100 GPa", {"material": {"gear": {"youngs_modulus": 100e9}}}),
    ],
)
def test_figures_are_those_of_the_drive_with_the_value(name, text, changed):
    found = DRIVE.sweep({name: [text]}, ["100 N*m", -50], **FEW).isel({name.removeprefix("modification."): 0})
    data = DRIVE.replace(**changed).analyze([100.0, -50.0], angles=40)
    error = data.transmission_error.values
    assert found.angular_transmission_error.values == pytest.approx(np.ptp(error, axis=1), rel=1e-6)
    assert found.mean_transmission_error.values == pytest.approx(error.mean(axis=1), rel=1e-9)
    assert found.ripple.values == pytest.approx(np.sqrt(((error - error.mean(axis=1)[:, None]) ** 2).mean(axis=1)))
    assert found.max_contact_pressure.values == pytest.approx(data.max_contact_pressure.max("crank_angle").values)
    assert found.torsional_stiffness.values == pytest.approx(data.torsional_stiffness.mean("crank_angle").values)
    carried = data.pin_force.values[:, :, 0]
    share = (carried > 0.01 * carried.max(axis=2)[..., None]).mean(axis=(1, 2))
    assert found.loaded_pins.values == pytest.approx(share)
    assert float(found.backlash) == pytest.approx(data.backlash.values[0].max(), rel=1e-9)
    assert float(found.mean_backlash) == pytest.approx(data.backlash.values[0].mean(), rel=1e-9)
    up, down = solve(
        DriveValue.as_stated(DRIVE.pair.replace(**changed)),
        [5.43, -5.43],
        data.crank_angle.values,
    ).transmission_error
    assert float(found.lost_motion) == pytest.approx((up - down).max(), rel=1e-9)
    assert found.reason.item() == ""


def test_a_bearing_s_clearance_and_two_discs():
    drive = cy.read_drive(EXAMPLES / "drive-39-40-bearings.toml")
    found = drive.sweep({"supports.turning_arm.clearance": "0, 20 um"}, "181 N*m", angles=20, workers=1)
    assert (np.diff(found.lost_motion) > 0.0).all()
    other = drive.pair.supports.replace(turning_arm=drive.pair.supports.turning_arm.replace(clearance=20e-6))
    data = drive.replace(supports=other).analyze("181 N*m", angles=20)
    assert float(found.mean_transmission_error[1, 0]) == pytest.approx(float(data.transmission_error.mean()), rel=1e-6)
    carried = data.pin_force.values[0]  # of both discs
    share = (carried > 0.01 * carried.max(axis=(1, 2))[:, None, None]).mean()
    assert float(found.loaded_pins[1, 0]) == pytest.approx(share)


def test_the_same_modification_drawn_and_made_is_the_same_drive():
    """An error of the isometric modification on top of the drawn one is a larger drawn one."""
    drawn = DRIVE.sweep({"isometric": "-10, -5 um"}, 100, **FEW)
    made = DRIVE.sweep({"errors.isometric": "5, 10 um"}, 100, **FEW)
    for name in (*sweeps.LOADED, *sweeps.FREE):
        assert made[name].values == pytest.approx(drawn[name].values, rel=1e-6, abs=1e-15), name


def test_form_of_the_flanks_is_kept():
    """Material taken off everywhere alike is a larger generating pin."""
    worn = ErrorSurface(DRIVE.pair, gear_deviation=np.full((1, 39, 100, 1), -5e-6), origin="worn")
    one = cy.Drive(DRIVE.pair, worn).sweep({"isometric": ["-15 um"]}, 100, **FEW)
    other = DRIVE.sweep({"isometric": ["-10 um"]}, 100, **FEW)
    assert float(one.backlash[0]) == pytest.approx(float(other.backlash[0]), rel=1e-3)


def test_combinations_are_a_grid_and_what_makes_no_drive_has_its_reason():
    vary = {"eccentricity": ["1.3 mm", "1.7 mm"], "offset": "-40:20:3 um"}
    found = DRIVE.sweep(vary, ["100 N*m", "-20 N*m"], **FEW)
    assert found.angular_transmission_error.dims == ("eccentricity", "offset", "torque")
    assert found.backlash.dims == ("eccentricity", "offset")
    assert found.offset.values == pytest.approx([-40e-6, -10e-6, 20e-6], rel=1e-12)
    # e z_p/R_p of 1.7 mm is above 1: no gear, at any offset.
    for name in (*sweeps.LOADED, *sweeps.FREE):
        assert np.isnan(found[name].sel(eccentricity=1.7e-3)).all()
    assert all("it must stay below 1" in reason for reason in found.reason.values[1])
    # An offset > 0 adds material: no position is free, under load all the same something turns.
    assert found.reason.values[0, 0] == ""
    assert found.reason.values[0, 2].startswith("no free position: interference of ")
    assert np.isnan(found.backlash.values[0]).tolist() == [False, True, True]
    assert (found.interference.values[0] > 0.0).tolist() == [False, True, True]
    assert np.isfinite(found.angular_transmission_error.values[0]).all()
    alone = DRIVE.sweep({"eccentricity": ["1.3 mm"], "offset": ["20 um"]}, ["100 N*m", "-20 N*m"], **FEW)
    assert same(alone, found.isel(eccentricity=[0], offset=[2]))


def test_a_load_that_can_t_be_carried_is_missing_alone():
    found = DRIVE.sweep({"pin_radius": ["3 mm"]}, [100.0, 1e9], angles=2, workers=1)
    assert np.isfinite(found.max_contact_pressure.values[0]).tolist() == [True, False]
    assert found.reason.item().startswith("torque = 1e+09 N*m: no contacts of this pair can balance it")


@pytest.mark.slow(5)
def test_workers_change_no_bit():
    vary = {"pin_radius": "2.9, 3 mm", "errors.eccentricity": [0.0, 2e-6]}
    assert same(DRIVE.sweep(vary, 100, angles=40, workers=2), DRIVE.sweep(vary, 100, **FEW))


# Values and their names


@pytest.mark.parametrize("given", ["2.5, 3 mm", "2.5 mm, 3 mm", "2.5mm,3000um", "0.25 cm , 3 mm"])
def test_a_list_has_one_unit_or_one_each(given):
    assert varied("pin_radius", given).values == pytest.approx((2.5e-3, 3e-3), rel=1e-12)


@pytest.mark.parametrize("given", ["2.5 mm, 3", "2.5 mm, 3 deg", "2.5 mm, , 3 mm"])
def test_a_list_with_units_is_of_lengths_throughout(given):
    with pytest.raises(edge.InputError, match='vary = "pin_radius=' + given):
        varied("pin_radius", given)


@settings(max_examples=40)
@given(st.floats(-50, 50), st.floats(0.1, 50), st.integers(2, 30), st.sampled_from(["um", "mm", "nm"]))
def test_a_range_has_both_ends_and_even_steps(first, width, count, unit):
    last = first + width
    one = varied("offset", f"{first:.6f}:{last:.6f}:{count} {unit}")
    wanted = np.linspace(round(first, 6), round(last, 6), count) * edge.unit_scale(unit, "m")
    assert one.values == pytest.approx(wanted, rel=1e-11, abs=1e-11 * edge.unit_scale(unit, "m"))
    assert one.unit == unit
    assert [edge.parse_quantity(text, "m") for text in one.texts] == list(one.values)
    assert varied("offset", ", ".join(text.split()[0] for text in one.texts) + f" {unit}") == one


def test_every_number_of_a_pair_file_can_be_varied():
    """Each one is stated in a pair file and read back from the pair; where others are missing the sentence names it."""
    drive = cy.read_drive(EXAMPLES / "drive-39-40-bearings.toml")
    rollers = {"kind": "output_rollers", "count": 6, "circle_radius": "36 mm", "output_roller": {"stiffness": 1e8}}
    on_rollers = cy.Drive(make_pair().replace(supports=rollers))
    examples = {
        "m": "2 um",
        "rad": "1 mrad",
        "1": "6",
        "K": "30 degC",
        "1/K": "2e-5 1/K",
        "N": "5 kN",
        "N/m": "90 N/um",
        "N*m": "90 N*m",
        "Pa": "3 GPa",
        "N*m/rad": "5 N*m/arcmin",
        "N*m*s/rad": "1e-3 N*m*s/rad",
        "m/s": "0.1 m/s",
        "m^2/s": "50 mm^2/s",
        "K/W": "0.3 K/W",
        "J/K": "5 kJ/K",
        "W/(m^2*K)": "30 W/(m^2*K)",
        "m^2": "0.2 m^2",
    }
    large = {
        "pin_circle_radius": "66 mm",
        "pin_radius": "2.8 mm",
        "eccentricity": "1.2 mm",
        "face_width": "11 mm",
        "supports.circle_radius": "30 mm",
        "discs": "3",
        "gear_teeth": "38",
        "material.gear.poissons_ratio": "0.25",
        "material.pin.poissons_ratio": "0.25",
        "losses.lubricant.viscosity_40": "200 mm^2/s",
        "losses.lubricant.viscosity_100": "20 mm^2/s",
    }
    set_ = []
    refused = {}
    for name, (si, _) in known_names().items():
        if name == "temperature":
            continue
        text = large.get(name) or (
            "0.1"
            if name.startswith("losses") and si == "1"
            else "20 mm"
            if name.endswith(("diameter", "length", "radius")) and "supports" in name
            else examples[si]
        )
        base = on_rollers if "output_roller" in name else drive
        try:
            pair = drive_with(DriveValue(base.pair.nominal, base.surface), {name: text}).pair
        except edge.InputError as problem:
            refused[name] = str(problem)
            continue
        value = pair
        for part in (f"modification.{name}" if name in ("isometric", "offset") else name).split("."):
            value = getattr(value, part)
        assert value == (edge.parse_quantity(text, si) if si != "1" else float(text)), name
        set_.append(name)
    assert all(name.split(".")[1] in said or "misalignment" in name for name, said in refused.items()), refused
    # This drive has no [bodies]; each of their numbers is refused with the table that is missing.
    assert len(set_) > 0.7 * sum(not name.startswith("bodies.") for name in known_names())


@pytest.mark.parametrize(
    ("vary", "said"),
    [
        ("pin_radus=2:3:4 mm", '--vary = "pin_radus": not a number of a pair file; did you mean pin_radius'),
        ("pins=40,41", '--vary = "pins": pins are one more than gear_teeth; vary these.'),
        ("pin_radius", '--vary = "pin_radius": write NAME=VALUES'),
        ("pin_radius=2:3 mm", '--vary = "pin_radius=2:3 mm": write a range with its number of values'),
        ("pin_radius=2:3:4", '--vary = "pin_radius=2:3:4": write a range with its number of values'),
        ("pin_radius=2:3:1 mm", '--vary = "pin_radius=2:3:1 mm": a range has between 2 and 100000 values.'),
        ("pin_radius=2:3:4 deg", '--vary = "pin_radius=2:3:4 deg": the unit "deg" measures something else'),
        ("pin_radius=3,3 mm", '--vary = "pin_radius=3 mm, 3 mm": the values must be different.'),
        ("gear_teeth=20:30:4", '--vary = "gear_teeth=20:30:4": this takes whole numbers.'),
        ("gear_teeth=20,30 mm", '--vary = "gear_teeth=20,30 mm": this is a number without a unit.'),
        (
            "eccentricity=1.7,1.8 mm",
            '--vary = "eccentricity 1.7 mm … 1.8 mm": none of these values is a valid drive; '
            'the first one: [pair] eccentricity = "1.7 mm"',
        ),
        (
            "supports.count=3,4",
            '--vary = "supports.count 3 … 4": none of these values is a valid drive; the first one: '
            "[supports] kind is missing.",
        ),
    ],
)
def test_bad_values_are_one_sentence(command, vary, said):
    done = command("cycloid-fmu", "sweep", PAIR, "--vary", vary)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(said)
    assert done.stderr.count("\n") == 1


def test_other_bad_input_is_one_sentence(command):
    vary = ["--vary", "pin_radius=2.9,3 mm"]
    for words, said in (
        ([*vary, *vary], '--vary = "pin_radius=2.9,3 mm": it is varied twice.'),
        ([*vary, "--torque", "0 N*m"], '--torque = "0 N*m": a sweep\'s loads must not be zero'),
        (
            [*vary, "--crank-speed", "-3 rpm"],
            '--crank-speed = "-3 rpm": it must not be below zero; both directions are solved.',
        ),
        ([*vary, "-o", "a.txt"], "--output = a.txt: the name must end in .csv or .parquet or .nc."),
        (["--vary", "isometric=0:1:99999 um", *vary, "--vary", "offset=0:1:6 um"], "--vary makes 1199988 drives"),
    ):
        done = command("cycloid-fmu", "sweep", PAIR, *words)
        assert done.returncode == 2
        assert done.stderr.startswith(said), done.stderr
        assert done.stderr.count("\n") == 1
    with pytest.raises(edge.InputError, match=r"torque is missing; give it, or state \[pair\] rated_torque"):
        cy.Drive(make_pair()).sweep({"pin_radius": ["3 mm"]})
    listed = cy.Drive(make_pair()).replace(errors={"pin_radial": [1e-6] * 40})
    with pytest.raises(edge.InputError, match="the drive states single values of pin_radial, not its orders"):
        listed.sweep({"errors.pin_radial.order_2": ["1 um"]}, 100)


# Files, kills and pictures


def test_tables_say_what_the_dataset_says(tmp_path):
    vary = {"eccentricity": "1.3, 1.7 mm", "temperature": "20, 60 degC", "gear_teeth": "38, 39"}
    for ending in ("csv", "parquet", "nc"):
        found = DRIVE.sweep(vary, [100.0, -20.0], tmp_path / f"t.{ending}", angles=20, workers=1)
        assert [p.name for p in tmp_path.iterdir()] == [f"t.{ending}"]  # no checkpoint is left
        if ending == "nc":
            kept = xr.load_dataset(tmp_path / "t.nc")
            assert kept.attrs["format"] == "cycloid-sweep/1"
            assert same(kept, found)
            assert (kept.reason.values == found.reason.values).all()
        elif ending == "csv":
            read = list(csv.DictReader((tmp_path / "t.csv").open(encoding="utf-8")))
            assert len(read) == 16
            head = edge.unit_columns(
                list(read[0]),
                {"eccentricity": "m", "backlash": "rad", "torque": "N*m", "max_contact_pressure": "Pa"},
                "t.csv",
            )
            column = {name: [list(row.values())[place] for row in read] for name, (place, _) in head.items()}
            assert [float(t) for t in column["torque"]] == [100.0, -20.0] * 8
            assert [float(e) for e in column["eccentricity"]] == [1.3] * 8 + [1.7] * 8
            assert [row["temperature [degC]"] for row in read[::4]] == ["20.0", "60.0"] * 2
            assert column["backlash"][8:] == [""] * 8
            pressure = [float(p) * head["max_contact_pressure"][1] for p in column["max_contact_pressure"][:8]]
            assert pressure == pytest.approx(found.max_contact_pressure.values[0].ravel())
            backlash = np.array([float(b) for b in column["backlash"][:8:2]]) * head["backlash"][1]
            assert backlash == pytest.approx(found.backlash.values[0].ravel())
            assert all("must stay below 1" in row["reason"] for row in read[8:])
        else:
            table = pyarrow.parquet.read_table(tmp_path / "t.parquet")
            assert table.column_names == list(table_of(found))
            assert table["torque [N*m]"].to_pylist() == [100.0, -20.0] * 8
            assert math.isnan(table["lost_motion [arcsec]"][15].as_py())
        (tmp_path / f"t.{ending}").unlink()


@pytest.mark.system
def test_killed_in_mid_run_and_started_again(command, tmp_path):
    (tmp_path / "pair.toml").write_text(PAIR.read_text())
    words = ["sweep", "pair.toml", "--vary", "eccentricity=1.2:1.7:40 mm", "--vary", "isometric=-20, -10 um"]
    words += ["--angles", "40", "--workers", "1", "-o", "t.nc"]
    checkpoint = tmp_path / "t.nc.checkpoint"
    program = str(Path(sys.executable).with_name("cycloid-fmu"))
    with subprocess.Popen([program, *words], cwd=tmp_path, stderr=subprocess.DEVNULL) as process:
        while not (checkpoint.exists() and any(checkpoint.read_bytes().partition(b"\n")[2])):
            assert process.poll() is None, "it ended before it was killed"
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert not (tmp_path / "t.nc").exists()
    other = command("cycloid-fmu", *words[:-4], "--workers", "1", "--turns", "2", "-o", "t.nc")
    assert (other.returncode, "its turns differs: 1 there, 2 here" in other.stderr) == (2, True)
    told = []
    solved, figures_of = [], sweeps.figures_of
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweeps, "figures_of", lambda sweep, number: solved.append(number) or figures_of(sweep, number))
        drive = cy.read_drive(tmp_path / "pair.toml")
        vary = {"eccentricity": "1.2:1.7:40 mm", "isometric": "-20, -10 um"}
        again = drive.sweep(vary, None, tmp_path / "t.nc", progress=told.append, **FEW)
    assert 0 < told[0] < 80
    assert len(solved) == 80 - told[0]  # those that were done are not solved again
    assert sum(told) == 80
    assert not checkpoint.exists()
    assert same(again, drive.sweep(vary, **FEW))
    kept = xr.load_dataset(tmp_path / "t.nc")
    assert same(kept, again)
    assert (kept.reason.values == again.reason.values).all()
    assert (again.reason.values != "").any()


def test_interrupted_it_says_what_is_kept(tmp_path):
    def stop(drives):
        raise KeyboardInterrupt

    with pytest.raises(
        KeyboardInterrupt, match=r"1 of 3 drives are done; .*t.csv.checkpoint keeps them; the same study"
    ):
        DRIVE.sweep({"pin_radius": "2.9:3.1:3 mm"}, 100, tmp_path / "t.csv", progress=stop, **FEW)
    with pytest.raises(KeyboardInterrupt, match="nothing is kept without an output"):
        DRIVE.sweep({"pin_radius": "2.9:3.1:3 mm"}, 100, progress=stop, **FEW)


def test_the_command_prints_draws_and_says_what_is_missing(command, tmp_path):
    words = ["cycloid-fmu", "sweep", PAIR, "--angles", "20", "--workers", "1"]
    one = command(
        *words, "--vary", "offset=-40,-10 um", "--torque", "100 N*m", "--torque", "-20 N*m", "--plot", "1.png"
    )
    assert one.returncode == 0, one.stderr
    assert "1 of 2 drives are not shown or incomplete: no free position: interference of" in one.stderr
    assert "offset -40 um" in one.stdout
    assert "share of loaded pins" in one.stdout  # a share of 1, not a number of pins
    two = command(*words, "--vary", "offset=-40,-30 um", "--vary", "pin_radius=2.9,3 mm", "--json")
    found = json.loads(two.stdout)
    assert np.shape(found["backlash"]) == (2, 2)
    assert found["reason"] == [["", ""], ["", ""]]
    assert (tmp_path / "1.png").stat().st_size > 20000
    three = DRIVE.sweep({"offset": ["-40 um"], "pin_radius": "2.9, 3 mm", "isometric": "-15, -10 um"}, 100, **FEW)
    assert "offset = -40" in plot_sweep(three).get_suptitle()
    assert cy.plot(three).axes
