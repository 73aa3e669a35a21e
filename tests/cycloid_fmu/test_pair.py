import pytest
from common import CASES, PAIR, make_pair

from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import parse_pair, read_pair

BAD = {
    "unit missing": ('"64 mm"', '"64"', "pin_circle_radius"),
    "no text": ('"64 mm"', "64", "pin_circle_radius"),
    "decimal comma": ('"64 mm"', '"64,0 mm"', "64,0 mm"),
    "nan": ('"64 mm"', '"nan mm"', "nan mm"),
    "product": ('"64 mm"', '"2*32 mm"', "2*32 mm"),
    "wrong kind": ('"64 mm"', '"64 kg"', "kg"),
    "negative radius": ('"3 mm"', '"-3 mm"', "pin_radius"),
    "metres": ('"64 mm"', '"64 m"', r'pin_circle_radius = "64 m": it must be between 1 mm and 5 m'),
    "micrometres": ('"10 mm"', '"10 um"', r'face_width = "10 um": it must be between 0.1 mm and 2 m'),
    "supports' metres": (
        "[pair]",
        '[supports]\nkind = "cranks"\ncount = 3\ncircle_radius = "36 m"\n[pair]',
        r'\[supports\] circle_radius = "36 m": it must be between 1 mm and 5 m',
    ),
    "roller's metres": (
        "[pair]",
        '[supports]\nkind = "cranks"\ncount = 3\ncircle_radius = "36 mm"\n'
        'main = { rollers = 30, roller_length = "9 m" }\n[pair]',
        r'\[supports.main\] roller_length = "9 m": it must be between 0.1 mm and 2 m',
    ),
    "pins": ("pins = 40", "pins = 42", "41|40"),
    "fractional teeth": ("gear_teeth = 39", "gear_teeth = 39.5", "gear_teeth"),
    "too many teeth": (
        "gear_teeth = 39\npins = 40",
        "gear_teeth = 301\npins = 302",
        "gear_teeth = 301: it must be at most 300",
    ),
    "one tooth": ("gear_teeth = 39\npins = 40", "gear_teeth = 1\npins = 2", "no pin has a lever arm"),
    "two pins more": ("pins = 40", "pins = 41", "one pin more, 40; with more pins, flanks of neighbouring teeth cross"),
    "hypocycloid": ("pins = 40", "pins = 38", r"one pin more, 40; .*\(hypocycloid\) the flanks lie around the pins"),
    "K above 1": ('"1.3 mm"', '"1.7 mm"', "eccentricity"),
    "K of 1": ('"1.3 mm"', '"1.6 mm"', "eccentricity"),
    "undercut": ('"3 mm"', '"4.7 mm"', "undercut"),
    "unknown key": ("[pair]", '[pair]\ncolour = "red"', "colour"),
    "unknown table": ("[pair]", "[gears]\na = 1\n[pair]", "gears"),
    "version": ("pair/1", "pair/9", "cycloid-pair/9"),
    "no format": ('format = "cycloid-pair/1"', "", "format"),
    "not TOML": (PAIR, "= =", "TOML"),
    "empty": (PAIR, "", "format"),
    "missing": ('eccentricity = "1.3 mm"\n', "", "eccentricity is missing"),
    "large error": ("[pair]", '[errors]\npin_radius = "5 mm"\n[pair]', "pin_radius"),
    "list too short": ("[pair]", '[errors]\npin_radial = ["1 um"]\n[pair]', "pin_radial has 1 values"),
    "bad order": ("[pair]", '[errors]\npin_radial = { order_0 = ["1 um", "0 deg"] }\n[pair]', "order_0"),
    "order without phase": ("[pair]", '[errors]\npin_radial = { order_1 = "1 um" }\n[pair]', "amplitude and a phase"),
    "value in a list": ("[pair]", '[errors]\npin_radial = ["1,5 um"]\n[pair]', "1,5 um"),
    "material": ("[pair]", "[material.pin]\npoissons_ratio = 0.6\n[pair]", "poissons_ratio"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_sentence_that_names_field_value_and_file(name):
    before, after, said = BAD[name]
    assert before in PAIR
    with pytest.raises(edge.InputError, match=said) as refused:
        parse_pair(PAIR.replace(before, after), "bad.toml")
    message = str(refused.value)
    assert message.startswith("bad.toml: ")
    assert message.endswith(".")
    assert message.count("\n") == 0


def test_every_problem_is_reported():
    with pytest.raises(edge.InputError) as refused:
        parse_pair(PAIR.replace('"64 mm"', "64").replace('"3 mm"', '"3 kg"'), "bad.toml")
    assert str(refused.value).count("bad.toml: ") == 2


def test_not_a_file(tmp_path):
    with pytest.raises(edge.InputError, match="No such file"):
        read_pair(tmp_path / "none.toml")
    (tmp_path / "latin.toml").write_bytes(b"a = '\xff'")
    with pytest.raises(edge.InputError, match="UTF-8"):
        read_pair(tmp_path / "latin.toml")


@pytest.mark.parametrize("case", sorted(p.stem for p in CASES.glob("*.toml")))
def test_the_canonical_text_reads_back_as_the_same_pair(case):
    pair = read_pair(CASES / f"{case}.toml")
    again = parse_pair(pair.text, "again")
    assert (again, again.text, again.hash, hash(again)) == (pair, pair.text, pair.hash, hash(pair))


def test_signed_ratio():
    assert make_pair().ratio == -39.0
    assert make_pair(output="ring").ratio == 40.0
