"""What is wrong with a profile, said as to a technician: axis by name, list, point, tab."""

import pytest
import yaml

from drives.canopen_drive.group import profile_of
from drives.errors import ProfileError
from drives.profile import load_machine
from drives.profile.plain_words import place_words, problem_words, unit_of
from drives.units import parse_quantity

GOOD = (
    "format: fieldtool-machine/1\nname: m\nbus: {interface: fieldsim, channel: x}\naxes:\n"
    "  - name: table\n    kind: rotary\n    node_id: 11\n    drive: reference\n    limits:\n"
    "      travel: [-120 deg, 120 deg]\n      velocity: 10 rad/s\n      acceleration: 400 rad/s2\n"
    "      torque: 6 N m\n      following_error: 30 deg\n    prior:\n      masses: [0.02, 0.025]\n"
    "      springs: [190]\n"
)
PROGRAMMERS = (
    "valid tuple",
    "valid number",
    "input should",
    "axes.0",
    "token",
    "scalar",
    "mapping",
)


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ("springs: [190]", "springs: 190", 17, "axis table, prior.springs: a list in brackets"),
        ("springs: [190]", "springs: [190,5]", 15, "written with a point, not with a comma"),
        ("[0.02, 0.025]", "['0,02', 0.025]", 16, "number 1: a number is written with a point: 0.02"),
        ("bus: {", "bus: {bitrate: 0,06, ", 3, "with a point, not with a comma: 0.06"),
        ("velocity: 10 rad", "velocity: 10,5 rad", 11, "write the number with a point: 10.5 rad/s"),
        ("    kind: rotary", "\tkind: rotary", 6, "begins with a tab: indent with blanks"),
        ("node_id: 11", "node_id: eleven", 7, "axis table, node_id: a whole number belongs here"),
        ("kind: rotary", "kind: round", 6, "axis table, kind: has to be rotary or linear"),
        ("travel: [-120 deg, ", "travel: [-120 deg, 0 deg, ", 10, "3 values stand here. A comma ends"),
        ("[-120 deg, 120 deg]", "[120 deg, -120 deg]", 10, "low to high, got 2.094 rad to -2.094 rad"),
        ("[-120 deg, 120 deg]", "[1 rev, 1 rev]", 10, "axis table, limits.travel: must go from low"),
        ("[-120 deg, 120 deg]", "120 deg", 10, "position in brackets, such as [-90 deg, 90 deg], got"),
        ("[0.02, 0.025]", "[0,02, 0.025]", 16, "not 0. A comma ends a value: write numbers with a"),
        ("drive: reference", "drive: referenz", 8, "axis table, drive, 'referenz': no such drive pro"),
        ("name: m\n", "name m\n", 3, "a key needs a colon"),
        ("[0.02, 0.025]", "[0.02, -1]", 16, "axis table, prior.masses, number 2: has to be above 0"),
        ("drive: reference", "drive: [1]", 8, "axis table, drive: text belongs here"),
        ("node_id: 11", "node_id: 011", 7, "011 would be read to the base of 8"),
        ("[0.02, 0.025]", "[0.02, 1:30]", 16, "1:30 would be read to the base of 60"),
        ("[0.02, 0.025]", "[0.02, 1:30.5]", 16, "1:30.5 would be read to the base of 60"),
        ("    limits:", "    feed: 500 mm\n    limits:", 9,
         "feed: a number without a unit belongs here, in m per encoder revolution, not '500 mm'"),
        ("springs: [190]", "springs: [190e1]", 17, "190e1 is text to YAML: write 190.0e+1."),
        ("    limits:", "    torque_constant: 1e-3\n    limits:", 9,
         "axis table, torque_constant: 1e-3 is text to YAML: write 1.0e-3."),
        ("bus: {", "bus: {bitrate: 1e6, ", 3, "bus.bitrate: 1e6 is text to YAML: write 1000000."),
        ("bus: {", "bus: {shortest_cycle: 1e-3, ", 3, "1e-3 has no unit: write it with one, as 1e-3 s"),
        ("springs: [190]", "springs: [190 N m/rad]", 17, "without a unit belongs here, in N m/rad, not"),
        ("springs: [190]", "springs: [stiff]", 17, "a number belongs here, in N m/rad, not 'stiff'"),
        ("bus: {", "bus: {bitrate: 500 kbit/s, ", 3, "number without a unit belongs here, in bit/s,"),
        ("name: table", "name: größe", 5, "axis größe, name: is a letter, then up to 31 letters"),
        ("30 deg\n", "30 deg\n      sag: 0.01\n", 15, "axis table, limits.sag: 0.01 has no unit"),
        ("30 deg\n", "30 deg\n      sag: 2 mm\n", 15, "limits.sag: unit 'mm' does not fit: needs"),
        ("30 deg\n", "30 deg\n      sag: 0 mrad\n", 15, "limits.sag: has to be above 0"),
        ("30 deg\n", "30 deg\n      sag: -1 mrad\n", 15, "limits.sag: has to be above 0"),
        ("30 deg\n", "30 deg\n      sag: 42 mrad\n", 15,
         "0.042 rad is more than 0.04189 rad, 1 % of the travel"),
        ("30 deg\n", "2 deg\n      sag: 40 mrad\n", 15,
         "0.04 rad is more than 0.03491 rad, the following error limit"),
        ("    limits:", "    may_float: true\n    limits:\n      sag: 5 mrad", 11,
         "limits.sag: an axis that may float (`may_float: true`) has no weight"),
    ],
)  # fmt: skip
def test_a_fault_is_said_in_plain_words_with_its_line(tmp_path, old, new, line, said):
    assert old in GOOD
    path = tmp_path / "m.yaml"
    path.write_text(GOOD.replace(old, new), encoding="utf-8")
    with pytest.raises(ProfileError) as refused:
        machine = load_machine(path)
        profile_of(machine.axes[0], machine)
    text = str(refused.value)
    assert said in text
    assert text.startswith(f"{path}:{line}: ")
    assert not [word for word in PROGRAMMERS if word in text.removeprefix(str(path))]


@pytest.mark.parametrize("sag", ["41 mrad", "2 deg", None])
def test_how_far_an_axis_may_sag_is_a_limit_that_may_be_left_out(tmp_path, sag):
    path = tmp_path / "m.yaml"
    more = f"      sag: {sag}\n" if sag else ""
    path.write_text(GOOD.replace("30 deg\n", f"30 deg\n{more}"), encoding="utf-8")
    found = load_machine(path).axes[0].limits.watched.sag
    assert found == (None if sag is None else pytest.approx(parse_quantity(sag, "angle")))


@pytest.mark.parametrize("text", ["1e-3", "1.5e3", "-.5E2", "2.e+1", "7e-10", " 3E0 "])
def test_what_is_to_be_written_for_a_power_of_ten_is_that_number_to_yaml(text):
    assert isinstance(yaml.safe_load(f"[{text}]")[0], str) or "+" in text
    said = problem_words({"type": "float_type", "input": text, "loc": ()})
    found = yaml.safe_load(said.split(" write ")[1])
    assert isinstance(found, float)
    assert found == float(text)


def test_a_bare_number_of_a_linear_axis_is_said_in_its_units():
    axes = [{"kind": "rotary"}, {"kind": "linear"}]
    for *place, unit in (
        ("axes", 1, "prior", "masses", 0, "kg"),
        ("axes", 1, "typical_move", "acceleration", "m/s2"),
        ("axes", 1, "torque_constant", "N/A"),
        ("axes", 1, "loop", "velocity_p", "N s/m"),
        ("axes", 0, "loop", "velocity_p", "N m s/rad"),
        ("simulation", "axes", 1, "rated_torque", "N"),
        ("axes", 1, "feed", "m per encoder revolution"),
        ("axes", 1, "name", ""),
        ("axes", 7, "loop", "velocity_p", "N m s/rad"),
    ):
        assert unit_of(tuple(place), {"axes": axes}) == unit
    assert unit_of(("axes", 0, "feed"), {"axes": 3}) == "m per encoder revolution"
    assert unit_of((), None) == ""


def test_places_are_named_as_people_name_them():
    data = {
        "axes": [{"name": "x"}, {"name": "y", "prior": {"masses": [1, 2]}}],
        "simulation": {"axes": [{}, {"effects": [{}]}]},
    }
    assert place_words(("axes", 1, "prior", "masses", 1), data) == "axis y, prior.masses, number 2"
    assert place_words(("simulation", "axes", 1, "effects", 0, "torque"), data) == (
        "axis y, effects, number 1, torque"
    )
    assert place_words(("bus", "bitrate"), data) == "bus.bitrate"
    assert place_words(("axes", 0, "name"), {"axes": [{}]}) == "axis number 1, name"
    assert place_words((), data) == ""
