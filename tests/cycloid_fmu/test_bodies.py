"""Influence matrices of elastic bodies: closed forms, other computations, an independent solver's drives, bad input."""

import csv
import functools
import json
import math
from pathlib import Path

import ezdxf
import numpy as np
import platformdirs
import pytest
import scipy.sparse as sp

import cycloid_fmu as cy
from cycloid_fmu.bodies import disc as discs
from cycloid_fmu.bodies import matrices, outline
from cycloid_fmu.bodies.beams import Beam, carrier_compliance
from cycloid_fmu.bodies.elastic import PlaneBody
from cycloid_fmu.bodies.given import read_influence, write_influence
from cycloid_fmu.bodies.mesh import Contour, circle, meshed
from cycloid_fmu.bodies.ports import PortMatrix, around, patch
from cycloid_fmu.bodies.ring import annulus_influence
from cycloid_fmu.draw.bodies import plot_disc
from cycloid_fmu.geometry.bodies import Bodies, CarrierBody, DiscBody, Section
from cycloid_fmu.geometry.pair import Material, Pair

CASES = Path(__file__).parents[1] / "data" / "bodies-cases"
STEEL, WIDTH = Material(), 0.01
YOUNG, POISSON = STEEL.youngs_modulus, STEEL.poissons_ratio
SHEAR = 0.5 * YOUNG / (1.0 + POISSON)
SMALL = Pair(
    gear_teeth=9,
    pin_circle_radius="40 mm",
    pin_radius="4 mm",
    eccentricity="2 mm",
    face_width="10 mm",
    supports={"kind": "output_rollers", "count": 4, "circle_radius": "21 mm", "first_angle": "0.2 rad"},
)
SMALL_DISC = DiscBody(bore_radius="10 mm", roller_hole_radius="6 mm")


@functools.cache
def small():
    """A small disc's matrix."""
    return discs.influence_of(SMALL, 0, discs.condensed(SMALL, SMALL_DISC, 0), "the disc")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache folder."""
    monkeypatch.setattr(platformdirs, "user_cache_dir", lambda *words, **options: str(tmp_path / "cache"))
    return tmp_path / "cache"


def opposite(body, contour, radius, half_width):
    """Loads and mean displacement inwards of two opposite patches, each pressed inwards by 1 N."""
    middles = radius * np.array([1.0, -1.0], dtype=complex)
    both = body.both_components(patch(body, contour, middles, 1j * middles / radius, half_width))
    forces = both @ np.array([-1.0, 0.0, 1.0, 0.0])
    moved = both.T @ body.displacement(forces[:, None])[:, 0]
    return -(moved[0] - moved[2])


# --- the mesh and the finite elements ---


def test_a_mesh_fills_its_region_with_well_shaped_triangles():
    fan = outline.windows(
        DiscBody(
            bore_radius="1 mm",
            windows=[
                {
                    "shape": "fan",
                    "inner_radius": "18 mm",
                    "outer_radius": "30 mm",
                    "half_angle": "50 deg",
                    "corner_radius": "2 mm",
                },
                {"shape": "polygon", "x": ["-30 mm", "-10 mm", "-30 mm"], "y": ["-5 mm", "-4 mm", "5 mm"]},
            ],
        )
    )
    mesh = meshed(circle(0.0, 0.04, 300), fan, 0.004)
    a, b, c = mesh.nodes[mesh.triangles].T
    area = 0.5 * (np.conj(b - a) * (c - a)).imag
    sides = abs(b - a) ** 2 + abs(c - b) ** 2 + abs(a - c) ** 2
    assert (area > 0.0).all()
    assert (4.0 * math.sqrt(3.0) * area / sides).min() > 0.25
    # A fan's area: that of the sector, less what each of four fillets rounds off; to a first order in its small angles.
    boundary = [mesh.nodes[chain] for chain in mesh.chains]
    areas = [0.5 * (np.conj(z) * np.roll(z, -1)).imag.sum() for z in boundary]
    assert area.sum() == pytest.approx(areas[0] - sum(areas[1:]), rel=1e-9)
    sector = math.radians(50.0) * (0.03**2 - 0.018**2)
    assert areas[1] == pytest.approx(sector - (4.0 - math.pi) * 0.002**2, rel=3e-3)
    assert areas[2] == pytest.approx(0.5 * 0.02 * 0.01, rel=1e-9)


def test_a_sharp_corner_is_meshed():
    """The division of both sides of a corner of 10 degrees comes to an end."""
    tip = math.radians(10.0)
    corners = 0.01 * np.array([0.0, 1.0, 0.83 * np.exp(1j * tip)])
    pieces = tuple(np.linspace(a, b, 2) for a, b in zip(corners, np.roll(corners, -1), strict=True))
    mesh = meshed(circle(0.0, 0.03, 120), [Contour(pieces, 0.001)], 0.003)
    hole = mesh.nodes[mesh.chains[1]]
    assert 0.5 * (np.conj(hole) * np.roll(hole, -1)).imag.sum() == pytest.approx(0.5 * 0.83e-4 * math.sin(tip))


def test_a_pressed_bore_widens_as_lame_states():
    inner, outer = 0.02, 0.03
    body = PlaneBody(meshed(circle(0.0, outer, 192), [circle(0.0, inner, 192)], 0.0015), STEEL, WIDTH)
    sectors = body.compliance(around(body, 1, 0.0, 48))[2:, 2:]
    pressure = 48.0 / (2.0 * math.pi * inner * WIDTH)  # all sectors' hats together are one pressure
    ratio = (outer**2 + inner**2) / (outer**2 - inner**2)
    assert sectors.sum(axis=1) == pytest.approx(pressure * inner / YOUNG * (ratio + POISSON), rel=5e-4)


@pytest.mark.parametrize(
    ("middle", "height", "within"),
    [pytest.param(0.0475, 0.005, 5e-3, marks=pytest.mark.slow(1)), (0.045, 0.010, 0.015)],
)
def test_a_ring_under_opposite_forces_deforms_as_a_curved_beam(middle, height, within):
    """W. C. Young, R. G. Budynas, Roark's Formulas for Stress and Strain, table 9.2, case 1, for thick rings."""
    outer, inner = middle + 0.5 * height, middle - 0.5 * height
    body = PlaneBody(meshed(circle(0.0, outer, 400), [circle(0.0, inner, 400)], 0.25 * height), STEEL, WIDTH)
    offset = middle - height / math.log(outer / inner)
    alpha, beta = offset / middle, 2.4 * (1.0 + POISSON) * offset / middle
    first, second = 1.0 - alpha + beta, 1.0 - alpha
    bending = 0.25 * math.pi * first - 2.0 * second**2 / math.pi
    theory = middle**2 / (YOUNG * WIDTH * height * offset) * bending
    assert opposite(body, 0, outer, 0.25 * height) == pytest.approx(theory, rel=within)


@pytest.mark.parametrize("half_width", [1e-3, 5e-4])
def test_a_cylinder_between_two_forces_flattens_as_hertz_law_states(half_width):
    """With a patch of half width w: (2/πb) V (ln(4R/w) - 3/4), the mean of Hertz' law of the patch's middle."""
    radius = 0.02
    contour = circle(0.0, radius, round(2.0 * math.pi * radius / (0.4 * half_width)))
    body = PlaneBody(meshed(contour, [], radius / 16.0), STEEL, WIDTH, "strain")
    law = 2.0 / (math.pi * WIDTH) * STEEL.compliance * (math.log(4.0 * radius / half_width) - 0.75)
    assert 0.5 * opposite(body, 0, radius, half_width) == pytest.approx(law, rel=5e-3)


@pytest.mark.slow(2)
def test_a_tooth_s_compliance_and_the_law_s_part_of_a_patch_add_up_to_one_value():
    """Hertz' law holds what is nearer than w; so self terms change by (2/πb) V ln(w/w'), in plane strain."""
    strain = SMALL_DISC.replace(plane="strain")
    body = discs.elastic_disc(SMALL, strain, 0, 2.0)
    place, normal = outline.flank_at(SMALL, 0, np.linspace(0.02, 0.6, 7))
    sums = []
    for half_width in (1e-3, 0.7e-3):
        both = body.both_components(patch(body, 0, place, 1j * normal, half_width))
        along = sp.lil_matrix((14, 7))
        for number, n in enumerate(normal):
            along[2 * number, number], along[2 * number + 1, number] = -n.real, -n.imag
        own = body.compliance((both @ along.tocsr()).tocsc()).diagonal()
        sums.append(own + 2.0 / (math.pi * SMALL.face_width) * STEEL.compliance * math.log(half_width))
    change = np.abs(sums[1] - sums[0]).max()
    assert change < 2e-3 * np.abs(own).max()


@pytest.mark.slow(2)
def test_a_finer_mesh_changes_little():
    compliances = []
    for fineness in (1.0, 1.7):
        body = discs.elastic_disc(SMALL, SMALL_DISC, 0, fineness)
        place, normal = outline.flank_at(SMALL, 0, 0.3 + 2.0 * math.pi * np.arange(10) / 10)
        compliances.append(body.compliance(body.both_components(patch(body, 0, place, 1j * normal, 1e-3))))
    assert np.linalg.norm(compliances[0] - compliances[1], 2) < 5e-3 * np.linalg.norm(compliances[1], 2)


def test_the_gauge_is_that_of_the_mean_motion():
    body = discs.elastic_disc(SMALL, SMALL_DISC, 0)
    place, normal = outline.flank_at(SMALL, 0, np.array([0.3, 1.1]))
    loads = body.both_components(patch(body, 0, place, 1j * normal, 1e-3))
    moved = body.displacement(loads.toarray())
    whole = body.at_nodes(moved[:, 0])
    size = np.abs(whole).max()
    corners = body.mesh.nodes[body.mesh.triangles]
    area = 0.5 * (np.conj(corners[:, 1] - corners[:, 0]) * (corners[:, 2] - corners[:, 0])).imag
    # Quadratic functions have their integral in the middles of a triangle's sides.
    where = {complex(np.round(z, 12)): n for n, z in enumerate(body.nodes)}
    middles = [0.5 * (corners[:, k] + corners[:, (k + 1) % 3]) for k in range(3)]
    for weight in (lambda z, u: u, lambda z, u: (np.conj(z) * u).imag / 0.04):
        total = 0.0
        for middle in middles:
            nearest = np.array([where.get(complex(np.round(z, 12)), -1) for z in middle])
            assert (nearest >= 0).all()
            total = total + (area / 3.0 * weight(middle, whole[nearest])).sum()
        assert abs(total) < 1e-7 * size * area.sum()


# --- beams, carrier and ring ---


def beam(*sections):
    pieces = tuple(Section(start=a, end=b, diameter=d) for a, b, d in sections)
    return Beam(pieces, STEEL)


def bending_and_shear(diameter):
    factor = 6.0 * (1.0 + POISSON) / (7.0 + 6.0 * POISSON)
    return YOUNG * math.pi * diameter**4 / 64.0, factor * SHEAR * math.pi * diameter**2 / 4.0


def test_beams_bend_as_timoshenko_s_closed_forms():
    length, near = 0.1, 1e-7
    bending, shear = bending_and_shear(0.02)
    shaft, point = beam((0.0, length, 0.02)), [(0.5 * length - near, 0.5 * length + near)]
    for ends, factor in (("supported", 48.0), ("clamped", 192.0)):
        theory = length**3 / factor / bending + length / 4.0 / shear
        assert shaft.compliance(ends, (0.0, length), point)[0, 0] == pytest.approx(theory, rel=1e-5)
    tip = [(length - near, length)]
    assert shaft.compliance("cantilever", (0.0, length), tip)[0, 0] == pytest.approx(
        length**3 / 3.0 / bending + length / shear, rel=1e-5
    )
    # A load over the whole length, mean displacement: L³/120EI supported (elastic energy of 5/384 …), with L/12κGA.
    whole = shaft.compliance("supported", (0.0, length), [(0.0, length)])[0, 0]
    assert whole == pytest.approx(length**3 / 120.0 / bending + length / 12.0 / shear, rel=1e-12)


def test_a_stepped_cantilever_is_softer_by_its_thin_end():
    """Mohr's integral over both sections in closed form: a tip force has the moment L - z."""
    shaft, near = beam((0.0, 0.06, 0.02), (0.06, 0.1, 0.01)), 1e-8
    (thick, thick_shear), (thin, thin_shear) = bending_and_shear(0.02), bending_and_shear(0.01)
    theory = (0.1**3 - 0.04**3) / 3.0 / thick + 0.04**3 / 3.0 / thin + 0.06 / thick_shear + 0.04 / thin_shear
    assert shaft.compliance("cantilever", (0.0, 0.1), [(0.1 - near, 0.1)])[0, 0] == pytest.approx(theory, rel=1e-6)


@pytest.mark.parametrize("ends", ["supported", "clamped", "cantilever"])
def test_beams_seen_from_the_other_end_are_the_same(ends):
    sections, loads = [(-0.03, 0.0, 0.02), (0.0, 0.05, 0.015)], [(-0.02, -0.01), (0.01, 0.04)]
    there = beam(*sections).compliance(ends, (-0.03, 0.05), loads)
    mirrored = beam(*[(-b, -a, d) for a, b, d in sections[::-1]])
    supports = (0.03, -0.05) if ends != "supported" else (-0.05, 0.03)
    back = mirrored.compliance(ends, supports, [(-b, -a) for a, b in loads])
    assert there == pytest.approx(there.T, rel=1e-12)
    assert back == pytest.approx(there, rel=1e-9)


def test_a_carrier_is_as_soft_as_its_columns():
    """Columns so long that shear vanishes: each is a clamped-clamped beam, 12EI/L³; half the load on the far plate."""
    body = CarrierBody(columns=4, circle_radius=0.03, length=1.0, radial_width=0.01, tangential_width=0.01, share=0.5)
    stiffness = 12.0 * YOUNG * 0.01**4 / 12.0
    translation, rotation = carrier_compliance(body)
    assert translation == pytest.approx(0.25 / (4.0 * stiffness), rel=1e-3)
    assert rotation == pytest.approx(0.25 / (4.0 * 0.03**2 * stiffness), rel=1e-3)


def test_the_ring_s_series_is_what_finite_elements_of_a_held_annulus_give():
    import skfem
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    inner, outer, half_width, count = 0.04, 0.052, 0.004, 6
    series = annulus_influence(inner, outer, WIDTH, STEEL, half_width, count)
    body = PlaneBody(meshed(circle(0.0, outer, 150), [circle(0.0, inner, 360)], 0.0015), STEEL, WIDTH)
    middles = inner * np.exp(2j * np.pi * np.arange(count) / count)
    loads = body.both_components(patch(body, 1, middles, 1j * middles / inner, half_width))
    first, shear = lame_parameters(YOUNG, POISSON)
    triangles = skfem.MeshTri(np.array([body.mesh.nodes.real, body.mesh.nodes.imag]), body.mesh.triangles.T.copy())
    basis = skfem.Basis(triangles, skfem.ElementVector(skfem.ElementTriP2()))
    stiffness = WIDTH * linear_elasticity(2.0 * first * shear / (first + 2.0 * shear), shear).assemble(basis)
    rim = triangles.facets_satisfying(lambda x: np.hypot(*x) > 0.5 * (inner + outer), boundaries_only=True)
    held = basis.get_dofs(rim).all()
    free = np.setdiff1d(np.arange(basis.N), held)
    moved = sp.linalg.spsolve(stiffness[free][:, free].tocsc(), loads[free].toarray())
    elements = loads[free].T @ moved
    assert np.linalg.norm(series - elements, 2) < 4e-3 * np.linalg.norm(elements, 2)


def test_a_ring_under_even_pressure_widens_as_lame_states():
    """So many patches that they cover the circle: the sum of all is the pressure, the outer surface held."""
    inner, outer, count = 0.05, 0.07, 400
    whole = annulus_influence(inner, outer, WIDTH, STEEL, 2.0 * math.pi * inner / count, count)
    angle = 2.0 * np.pi * np.arange(count) / count
    outwards = np.column_stack([np.cos(angle), np.sin(angle)]).ravel()
    radial = (whole @ outwards)[0]
    pressure = count / (2.0 * math.pi * inner * WIDTH)
    # u = A r + B/r, zero at the outer radius; radial stress -p at the inner one.
    e = YOUNG / (1.0 - POISSON**2)
    slope = -pressure / (e * ((1.0 + POISSON) + (1.0 - POISSON) * outer**2 / inner**2))
    assert radial == pytest.approx(slope * inner - slope * outer**2 / inner, rel=1e-4)


# --- the disc's ports ---


def test_a_disc_s_matrix_is_symmetric_and_positive():
    whole = small().at(0.7, "sector")
    assert (whole == whole.T).all()
    values = np.linalg.eigvalsh(whole)
    assert values[0] > -1e-9 * values[-1]


@pytest.mark.slow(1)
@pytest.mark.parametrize("crank_angle", [0.0, 0.37, 2.9, -1.2])
def test_interpolation_is_what_loads_at_the_places_themselves_give(crank_angle):
    body = discs.elastic_disc(SMALL, SMALL_DISC, 0)
    alpha = (2.0 * math.pi * np.arange(10) / 10 + crank_angle / 9.0) % (2.0 * math.pi)
    place, normal = outline.flank_at(SMALL, 0, alpha)
    towards = [crank_angle * (1.0 + 1.0 / 9.0) + math.pi] * 4
    outwards = np.exp(1j * np.array(towards))
    columns = [body.both_components(patch(body, 0, place, 1j * normal, 1e-3))]
    for number, middle in enumerate(outline.places(SMALL)):
        at = np.array([middle + 0.006 * outwards[number]])
        columns.append(body.both_components(patch(body, 2 + number, at, 1j * outwards[:1], 0.0015)))
    forces = np.concatenate([-normal, outwards])
    along = sp.lil_matrix((28, 14))
    for number, force in enumerate(forces):
        along[2 * number, number], along[2 * number + 1, number] = force.real, force.imag
    direct = body.compliance((sp.hstack(columns) @ along.tocsr()).tocsc())
    interpolated = small().at(crank_angle)
    ports = np.r_[0:10, 12:16]
    moved = interpolated[np.ix_(ports, ports)]
    assert np.linalg.norm(moved - direct, 2) < 3e-3 * np.linalg.norm(direct, 2)


def test_sectors_together_are_the_cosine_port():
    """Pressures of sectors in proportion to cos ψ make the cosine traction, to a chord of a sector's angle squared."""
    matrix = small().matrix
    sectors, bore = matrix.of("sector"), matrix.of("bore")
    weight = np.real(matrix.direction[sectors]) * 2.0 / sectors.size
    both = matrix.compliance[np.ix_(sectors, sectors)]
    assert weight @ both @ weight == pytest.approx(matrix.compliance[bore[0], bore[0]], rel=4e-3)


def test_turning_a_whole_tooth_turns_the_pins():
    """After one turn of the crank each pin stands on the place of the next tooth; the holes are as before."""
    first, turned = small().at(0.2), small().at(0.2 + 2.0 * math.pi)
    pins = np.arange(10)
    direct = first[:10, :10]
    assert np.linalg.norm(turned[:10, :10] - direct) > 1e-3 * np.linalg.norm(direct)  # the holes stand otherwise
    again = small().at(0.2 + 2.0 * math.pi * 9.0)
    assert again[np.ix_(pins, pins)] == pytest.approx(direct, rel=1e-6, abs=1e-6 * direct.max())


@pytest.mark.slow(4)
def test_a_disc_with_windows_is_softer_and_a_stiffer_material_is_stiffer():
    windows = [{"shape": "round", "count": 4, "first_angle": "1 rad", "circle_radius": "21 mm", "radius": "5 mm"}]
    open_disc = discs.condensed(SMALL, SMALL_DISC.replace(windows=windows), 0)
    whole = small().matrix.compliance
    teeth = small().matrix.of("flank")
    softer = np.linalg.eigvalsh((open_disc.compliance - whole)[np.ix_(teeth, teeth)])
    assert softer[-1] > 0.1 * np.linalg.eigvalsh(whole)[-1]
    stiff = discs.condensed(SMALL, SMALL_DISC.replace(youngs_modulus="412 GPa"), 0)
    assert stiff.compliance == pytest.approx(0.5 * whole, rel=1e-6, abs=1e-9 * whole.max())


# --- the independent solver's drives ---


def norm_error(computed, expected):
    return np.linalg.norm(np.asarray(computed) - np.asarray(expected), 2) / np.linalg.norm(expected, 2)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("rollers-one-disc", marks=pytest.mark.slow(5)),
        pytest.param("rv-all-bodies", marks=pytest.mark.slow(5)),
        pytest.param("rv-fan-windows", marks=pytest.mark.slow(5)),
    ],
)
def test_influence_is_that_of_the_independent_solver(tmp_path, name):
    """Blocks within 1 % in spectral norm. Of two discs the first alone is computed here."""
    drawn = tmp_path / "drive.toml"
    drawn.write_text((CASES / f"{name}.toml").read_text())
    pair = cy.read_drive(drawn).pair
    bodies = pair.bodies
    expected = json.loads((CASES / f"{name}.json").read_text())["influence"]
    rest = matrices.matrices_of(pair, bodies.replace(disc=None))
    first = discs.influence_of(pair, 0, discs.condensed(pair, bodies.disc, 0), "the disc")
    computed = matrices.influence(
        matrices.BodyMatrices((first,), **{k: v for k, v in vars(rest).items() if k != "discs"})
    )
    assert expected.keys() <= computed.keys()
    for block in ("teeth", "bores"):
        assert norm_error(computed["disc"][block], expected["disc"][block]) < 0.01, block
    assert computed["disc"]["self"] == pytest.approx(expected["disc"]["self"], rel=0.01)
    assert computed["disc"]["spectral"] == pytest.approx(expected["disc"]["spectral"], rel=0.01)
    for body in {"pin", "output_pin", "crank"} & expected.keys():
        assert norm_error(computed[body], expected[body]) < 0.01, body
    for body in {"ring", "carrier"} & expected.keys():
        for figure, value in expected[body].items():
            assert computed[body][figure] == pytest.approx(value, rel=0.01), (body, figure)


# --- matrices from elsewhere ---


def as_csv(matrix, path, corner=""):
    names = [
        ":".join([str(k), str(i), *(repr(float(v)) for v in (p.real, p.imag, d.real, d.imag))])
        for k, i, p, d in zip(matrix.kind, matrix.index, matrix.place, matrix.direction, strict=True)
    ]
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow([corner, *names])
        rows.writerows([name, *map(repr, row)] for name, row in zip(names, matrix.compliance.tolist(), strict=True))


@pytest.mark.parametrize("ending", [".nc", ".csv"])
def test_a_disc_s_matrix_from_a_file_is_as_good_as_its_own(tmp_path, ending):
    """Its ports in another order, and its components along other axes."""
    own, mixed = small().matrix, np.random.default_rng(1).permutation(small().matrix.kind.size // 2)
    order = np.column_stack([2 * mixed, 2 * mixed + 1]).ravel()
    turned = np.eye(own.kind.size)
    flank = own.of("flank")
    for first in flank[::2]:  # components along (1, 1)/√2 and (0, 1)
        turned[first, first : first + 2] = math.sqrt(0.5)
    direction = np.where(np.isin(np.arange(own.kind.size), flank[::2]), np.exp(0.25j * np.pi), own.direction)
    compliance = (turned @ own.compliance @ turned.T)[np.ix_(order, order)]
    given = PortMatrix(
        own.kind[order], own.index[order], own.place[order], direction[order], compliance, "free", own.patch_half_width
    )
    path = tmp_path / f"disc{ending}"
    write_influence(given, path) if ending == ".nc" else as_csv(given, path, "free:0.001")
    body = DiscBody(matrix=str(path))
    (influence,) = matrices.matrices_of(SMALL, Bodies(disc=body)).discs
    expected = small().at(0.4)
    assert influence.at(0.4) == pytest.approx(expected, rel=1e-9, abs=1e-9 * expected.max())
    assert influence.matrix.patch_half_width == 1e-3


def test_beams_ring_and_carrier_are_read_by_the_index_of_their_ports(tmp_path):
    crank = np.array([[3.0, 1.0], [1.0, 2.0]]) * 1e-9
    as_csv(
        PortMatrix(np.array(["plane"] * 2), np.array([1, 0]), np.zeros(2, complex), np.ones(2, complex), crank, "held"),
        tmp_path / "crank.csv",
        "held",
    )
    pair = SMALL.replace(discs=2)
    (tmp_path / "drive.toml").write_text(pair.text + '[bodies.crank]\nmatrix = "crank.csv"\n')
    assert cy.read_drive(tmp_path / "drive.toml").influence()["crank"].tolist() == crank[::-1, ::-1].tolist()


def wrong_matrix(**changes):
    ports = {
        "kind": np.array(["seat", "seat"]),
        "index": np.array([0, 0]),
        "place": np.array([0.05, 0.05], dtype=complex),
        "direction": np.array([1.0, 1j]),
        "compliance": np.array([[2.0, 0.5], [0.5, 1.0]]) * 1e-9,
        "gauge": "held",
    }
    return PortMatrix(**{**ports, **changes})


@pytest.mark.parametrize("ending", [".nc", ".csv"])
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"compliance": np.array([[2.0, 0.5], [0.6, 1.0]]) * 1e-9}, "not symmetric"),
        ({"compliance": np.array([[1.0, 2.0], [2.0, 1.0]]) * 1e-9}, "not positive"),
        ({"compliance": np.array([[1.0, np.nan], [np.nan, 1.0]])}, "finite"),
        ({"direction": np.array([1.0, 2j])}, "unit vectors"),
        ({"kind": np.array(["seat", "tooth"])}, "flank, bore"),
        ({"gauge": "loose"}, '"free" or "held"'),
    ],
)
def test_a_wrong_matrix_is_refused_in_a_sentence(tmp_path, ending, changes, said):
    path = tmp_path / f"ring{ending}"
    matrix = wrong_matrix(**changes)
    write_influence(matrix, path) if ending == ".nc" else as_csv(matrix, path, f"{matrix.gauge}:0")
    with pytest.raises(cy.InputError, match=said) as refused:
        read_influence(path, 1e-3)
    assert str(refused.value).startswith(str(path))
    assert "\n" not in str(refused.value)


def test_a_free_body_s_rigid_motions_may_have_any_compliance(tmp_path):
    """Supports of another kind add rigid motions, of any sign; what is held may not."""
    own = small().matrix
    rigid = np.column_stack([own.direction.real, own.direction.imag, (np.conj(own.place) * own.direction).imag])
    other = own.compliance - rigid @ np.diag([1e-9, 2e-9, 1e-6]) @ rigid.T
    for gauge in ("free", "held"):
        given = PortMatrix(own.kind, own.index, own.place, own.direction, other, gauge, own.patch_half_width)
        write_influence(given, tmp_path / "disc.nc")
        if gauge == "free":
            assert read_influence(tmp_path / "disc.nc", 1.0).compliance == pytest.approx(other)
        else:
            with pytest.raises(cy.InputError, match="not positive"):
                read_influence(tmp_path / "disc.nc", 1.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda m, flank: (m.place * np.where(flank, 1.02, 1.0), slice(None)), "off the unmodified flank"),
        (lambda m, flank: (m.place, ~np.isin(np.arange(flank.size), m.of("flank")[:2])), "equal arcs"),
        (lambda m, flank: (m.place, m.kind != "bore"), "bore 0 needs two ports"),
        (lambda m, flank: (m.place, np.arange(flank.size) != m.of("flank")[0]), "both components"),
        (lambda m, flank: (m.place, m.kind != "roller_hole"), "hole of output roller 0"),
    ],
)
def test_a_disc_s_matrix_with_other_places_is_refused(tmp_path, change, said):
    own = small().matrix
    place, ports = change(own, own.kind == "flank")
    ports = np.arange(own.kind.size)[ports]
    compliance = own.compliance[np.ix_(ports, ports)]
    given = PortMatrix(own.kind[ports], own.index[ports], place[ports], own.direction[ports], compliance, "free", 1e-3)
    write_influence(given, tmp_path / "disc.nc")
    with pytest.raises(cy.InputError, match=said):
        matrices.matrices_of(SMALL, Bodies(disc={"matrix": str(tmp_path / "disc.nc")}))


# --- files, cache and bad input ---


def described(tmp_path, bodies, pair=SMALL):
    path = tmp_path / "drive.toml"
    path.write_text(pair.text + bodies)
    return path


DISC = '[bodies.disc]\nbore_radius = "10 mm"\nroller_hole_radius = "6 mm"\n'
CRANKS = SMALL.replace(supports={"kind": "cranks", "count": 3, "circle_radius": "20 mm"})
FAR = SMALL.replace(supports=SMALL.supports.replace(circle_radius="22 mm", count=3))
BEARINGS = (
    '[bodies.crank]\nbearings = ["-9 mm", "9 mm"]\nsections = [{ from = "-9 mm", to = "8 mm", diameter = "9 mm" }]'
)
FAN = (
    '[[bodies.disc.windows]]\nshape = "fan"\ncount = 2\ninner_radius = "18 mm"\nouter_radius = "25 mm"\n'
    'half_angle = "12 deg"\n'
)


@pytest.mark.parametrize(
    ("bodies", "pair", "said"),
    [
        (DISC, SMALL.replace(supports=None), "needs [supports]"),
        (DISC.replace('"10 mm"', '"16 mm"'), SMALL, "cut each other, or almost: bore_radius and roller_hole_radius"),
        (
            DISC.replace('"6 mm"', '"12 mm"').replace('"10 mm"', '"5 mm"'),
            FAR,
            "the root circle of its teeth has a radius of 34 mm",
        ),
        (DISC + FAN, SMALL, "cut each other, or almost: roller_hole_radius and windows[0]"),
        (DISC + FAN.replace("25 mm", "17 mm"), SMALL, "the outer must be larger"),
        (DISC + FAN.replace("12 deg", "95 deg"), SMALL, "2 windows side by side leave less than 90 deg"),
        (DISC + FAN.replace("fan", "round"), SMALL, "inner_radius belongs to shape"),
        (DISC + FAN + 'corner_radius = "4 mm"\n', SMALL, "corner_radius is 4 mm; it must be below 3.5 mm"),
        (DISC + '[[bodies.disc.windows]]\nshape = "polygon"\nx = ["1 mm", "2 mm", "3 mm"]\n', SMALL, "y is missing"),
        (DISC, CRANKS, 'roller_hole_radius belongs to kind = "output_rollers"'),
        ('[bodies.disc]\nbore_radius = "10 mm"\n', SMALL, "roller_hole_radius is missing"),
        ("[bodies.disc]\n", SMALL, "bore_radius is missing; state it, or the file of a matrix"),
        ('[bodies.disc]\nbore_radius = "1 mm"\nmatrix = "d.nc"\n', SMALL, "it is stated by matrix and bore_radius"),
        ('[bodies.disc]\nmatrix = "d.nc"\n', SMALL.replace(discs=2), "matrix has 1 files; each of 2 discs"),
        ('[bodies.pin]\nends = "supported"\nspan = "9 mm"\n', SMALL, "span is 9 mm; discs and bearings need it"),
        ('[bodies.pin]\nends = "free"\nspan = "9 mm"\n', SMALL, "it should be 'supported' or 'clamped'"),
        (
            BEARINGS.replace('["-9 mm", "9 mm"]', '["9 mm", "-9 mm"]'),
            SMALL,
            "the second must be further along +z",
        ),
        (
            BEARINGS,
            SMALL,
            "sections reach from -9 mm to 8 mm; discs and bearings need it from -9 mm to 9 mm",
        ),
        ('[bodies.carrier]\nmatrix = "c.nc"\n', SMALL, '[bodies.carrier] belongs to kind = "cranks"'),
        ('[bodies.ring]\nouter_radius = "41 mm"\nwidth = "9 mm"\n', SMALL, "around the pins it must be at least 42 mm"),
        (f'[bodies]\ndisc_spacing = "9 mm"\n{DISC}', SMALL, "disc_spacing is 9 mm; discs 10 mm wide need as much"),
        ('[bodies.disk]\nbore_radius = "1 mm"\n', SMALL, "is not a known key; did you mean disc?"),
    ],
)
def test_bodies_that_cannot_be_are_refused_in_a_sentence(tmp_path, bodies, pair, said):
    path = described(tmp_path, bodies, pair)
    with pytest.raises(cy.InputError) as refused:
        cy.read_drive(path)
    assert said in str(refused.value)
    assert str(refused.value).startswith(str(path))
    assert len(str(refused.value).splitlines()) == 1


def test_a_disc_is_computed_once_for_all_that_does_not_concern_it(cache, monkeypatch):
    computed = []
    monkeypatch.setattr(discs, "condensed", lambda *given: computed.append(given[1]) or small().matrix)
    drive, bodies = cy.Drive(SMALL), Bodies(disc=SMALL_DISC)
    first = drive.influence(bodies=bodies)["disc"]["compliance"]
    other = drive.replace(isometric="-10 um", errors={"pin_radius": "1 um"}, rated_torque="9 N*m")
    assert (other.influence(bodies=bodies)["disc"]["compliance"] == first).all()
    assert len(computed) == 1
    for changed in ({"plane": "strain"}, {"bore_radius": "9 mm"}, {"poissons_ratio": 0.28}):
        drive.influence(bodies=Bodies(disc=SMALL_DISC.replace(**changed)))
    drive.replace(face_width="9 mm").influence(bodies=bodies)
    assert len(computed) == 5
    assert len(list((cache / "influence").glob("*.influence"))) == 5


@pytest.mark.slow(1)
def test_progress_counts_the_unit_loads(cache):
    seen, totals = [], []
    cy.Drive(SMALL).influence(bodies=Bodies(disc=SMALL_DISC), total=totals.append, progress=seen.append)
    assert sum(seen) == totals[0] == discs.loads_of(SMALL)
    assert len(seen) > 1


def test_without_scikit_fem_the_error_names_the_extra_and_beams_work(cache, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "skfem", None)
    bodies = Bodies(disc=SMALL_DISC, pin={"ends": "clamped", "span": "12 mm"})
    with pytest.raises(cy.InputError, match=r"skfem.*cycloid-fmu\[bodies\]"):
        cy.Drive(SMALL).influence(bodies=bodies)
    influence = cy.Drive(SMALL).influence(bodies=bodies.replace(disc=None))
    assert influence["pin"].shape == (1, 1)


def test_a_disc_out_of_range_is_refused(cache):
    with pytest.raises(cy.InputError, match="from 0 to 0"):
        cy.Drive(SMALL).influence(disc=1, bodies=Bodies())


def test_a_window_from_a_dxf_file_is_that_of_its_lines_and_arcs(tmp_path):
    document = ezdxf.new(units=ezdxf.units.MM)
    space = document.modelspace()
    space.add_line((20.0, -3.0), (28.0, -3.0))
    space.add_line((28.0, 3.0), (20.0, 3.0))
    space.add_arc((28.0, 0.0), 3.0, -90.0, 90.0)
    space.add_line((20.0, 3.0), (20.0, -3.0))
    document.saveas(tmp_path / "slot.dxf")
    path = described(
        tmp_path, DISC + '[[bodies.disc.windows]]\nshape = "polygon"\ndxf = "slot.dxf"\nfirst_angle = "1 rad"\n'
    )
    bodies = cy.read_drive(path).pair.bodies
    (slot,) = outline.windows(bodies.disc)
    points = slot.points
    area = 0.5 * (np.conj(points) * np.roll(points, -1)).imag.sum()
    assert area == pytest.approx(8e-3 * 6e-3 + 0.5 * math.pi * 9e-6, rel=1e-3)
    assert np.angle(points.mean()) == pytest.approx(1.0, abs=0.02)
    space.add_line((0.0, 0.0), (1.0, 1.0))
    document.saveas(tmp_path / "slot.dxf")
    with pytest.raises(cy.InputError, match="one closed outline"):
        cy.read_drive(path)


@pytest.mark.slow(1)
def test_the_picture_of_a_disc_has_its_mesh_and_the_pressed_place_s_displacement():
    """The largest displacement in the picture is at least the mean one under the pin's patch, and there."""
    figure = plot_disc(SMALL, SMALL_DISC, pin=3)
    mesh, colours = figure.axes[0], figure.axes[1].collections[0]
    assert "unknowns" in mesh.get_title()
    size = colours.get_array()
    assert size.max() * 1e-9 > 0.9 * small().at(0.0)[3, 3]
