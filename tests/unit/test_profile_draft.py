"""First profiles from EDS files, JSON schemas, and EDS files that are none."""

import json
import re
from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drives.errors import ProfileError
from drives.profile import load_drive, load_machine, packaged
from drives.profile.draft import draft, profile_name
from drives.profile.eds import MAX_EDS_BYTES, read_eds
from drives.profile.schema import json_schema
from fieldtool.cli.main import main
from fieldtool.errors import OutputError
from fieldtool.workflow.design_inputs import timing_of
from fieldtool.workflow.profiling import check_profile, new_profile

FOLDER = Path(load_drive("reference").path).parent
SHIPPED = sorted(p.name for p in FOLDER.iterdir() if p.suffix in (".eds", ".dcf"))
SMALLEST = """[DeviceInfo]
VendorNumber=0x12
[MandatoryObjects]
SupportedObjects=1
1=0x1000
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x20192
"""


@pytest.mark.parametrize("name", SHIPPED)
def test_a_first_profile_can_be_read_and_says_what_is_open(name, tmp_path):
    made = new_profile(FOLDER / name, tmp_path / "new.yaml")
    profile = load_drive(made.path)
    text = made.path.read_text(encoding="utf-8")
    assert set(made.unknown) >= {"torque" if profile.torque == "unknown" else "torque.scale"}
    assert {"gains_via", "store", "recovery", "heartbeat_reaction"} <= set(made.unknown)
    for key in made.unknown:  # every one stands in the file, for a person to find
        assert f"{key.split('.')[-1]}: unknown" in text
    assert all(p.factor == "unknown" for p in profile.parameters.values())
    assert made.obstacles


def test_what_the_file_tells_is_taken_over(tmp_path):
    made = new_profile(FOLDER / "elmo-simpliq.dcf", tmp_path / "mine.yaml")
    profile = load_drive(made.path)
    assert profile.identity.vendor_id == 0x9A
    assert profile.modes == (1, 3, 4, 6, 7)
    assert "can not measure with it" in made.path.read_text(encoding="utf-8")
    assert any("no cyclic position mode" in phrase for phrase in made.obstacles)


NEVER_MOVED = "so it never moves one, whatever else is found out"
FAIL_SAFE = {
    "1016": """[1016]
ParameterName=Consumer heartbeat time
ObjectType=0x8
SubNumber=2
[1016sub0]
ParameterName=Number of entries
ObjectType=0x7
DataType=0x0005
AccessType=ro
[1016sub1]
ParameterName=Consumer heartbeat time
ObjectType=0x7
DataType=0x0007
AccessType=rw
""",
    "6007": """[6007]
ParameterName=Abort connection option code
ObjectType=0x7
DataType=0x0003
AccessType=rw
""",
}


def obstacles_with_reaction(eds: Path, tmp_path: Path) -> list[str]:
    """Of a first profile for which the drive's reaction to a lost host was found out."""
    made = new_profile(eds, tmp_path / "mine.yaml")
    text = made.path.read_text(encoding="utf-8")
    assert "\nheartbeat_reaction: unknown" in text
    made.path.write_text(
        text.replace("\nheartbeat_reaction: unknown", "\nheartbeat_reaction: 3"), encoding="utf-8"
    )
    return list(check_profile(made.path).obstacles)


@pytest.mark.parametrize("has", [(), ("1016",), ("6007",), ("1016", "6007")])
def test_a_drive_that_nothing_stops_is_told_as_one_that_is_never_moved(has, tmp_path):
    eds = tmp_path / "small.eds"
    listed = "".join(f"{k}=0x{index}\n" for k, index in enumerate(has, 1))
    optional = f"[OptionalObjects]\nSupportedObjects={len(has)}\n{listed}"
    eds.write_text(SMALLEST + optional + "".join(FAIL_SAFE[index] for index in has))
    said = [phrase for phrase in obstacles_with_reaction(eds, tmp_path) if NEVER_MOVED in phrase]
    assert len(said) == (len(has) < 2)
    for phrase in said:
        assert ("consumer heartbeat time 0x1016:01" in phrase) == ("1016" not in has)
        assert ("abort connection option code 0x6007" in phrase) == ("6007" not in has)
        assert "it can be scanned, and checked without motion" in phrase


def test_a_real_drive_that_nothing_stops_is_never_moved(tmp_path):
    eds = Path(__file__).parents[3] / "shared" / "eds" / "canopen_example_e35.eds"
    if not eds.is_file():
        pytest.skip(f"{eds.name} is not there: it may not be shipped")
    assert any(
        "no consumer heartbeat time 0x1016:01 and no abort connection option code 0x6007" in phrase
        and NEVER_MOVED in phrase
        for phrase in obstacles_with_reaction(eds, tmp_path)
    )


def test_gains_are_listed_with_their_types(tmp_path):
    made = new_profile(FOLDER / "epos4.eds", tmp_path / "mine.yaml")
    found = load_drive(made.path).parameters["position_controller_p_gain"]
    assert str(found.object) == "0x30A1:01"
    assert found.type == "UNSIGNED32"


def test_gains_that_are_called_by_their_letter_are_listed(tmp_path):
    made = new_profile(FOLDER / "reference.eds", tmp_path / "mine.yaml")
    found = {str(p.object) for p in load_drive(made.path).parameters.values()}
    assert found >= {f"0x2010:0{k}" for k in range(1, 7)}
    text = made.path.read_text(encoding="utf-8")
    assert "add those that are missing" in text
    assert load_drive(made.path).torque_lag == 0
    assert "\ntorque_lag: unknown\n" in text
    made.path.write_text(
        text.replace("torque_lag: unknown", "torque_lag: 0.22 ms"), encoding="utf-8"
    )
    assert load_drive(made.path).torque_lag == pytest.approx(0.22e-3)


def test_a_lag_that_is_unknown_is_as_good_as_none_and_is_told_as_an_open_fact(tmp_path):
    text = (FOLDER / "reference.yaml").read_text(encoding="utf-8")
    text = text.replace("eds: ", f"eds: {FOLDER}/")
    told = "torque_lag: 0.22 ms"
    assert told in text
    path, found = tmp_path / "mine.yaml", {}
    for line in ("torque_lag: unknown", "", told):
        path.write_text(text.replace(told, line), encoding="utf-8")
        assert ("torque_lag" in check_profile(path).unknown) == ("unknown" in line)
        found[line] = load_drive(path)
    said, absent, known = found.values()
    assert said == absent
    assert timing_of(said) == timing_of(absent)
    assert timing_of(said).lag > timing_of(known).lag
    path.write_text(text.replace(told, "torque_lag: perhaps"), encoding="utf-8")
    with pytest.raises(
        ProfileError, match="torque_lag: needs a number with one of the units s, ms"
    ):
        load_drive(path)
    forms = json_schema("drive")["properties"]["torque_lag"]["anyOf"]
    assert {"const": "unknown", "type": "string"} in forms
    assert any(re.search(one["pattern"], "0.22 ms") for one in forms if "pattern" in one)


def test_the_proposed_store_line_can_be_taken_over(tmp_path):
    made = new_profile(FOLDER / "reference.eds", tmp_path / "mine.yaml")
    text = made.path.read_text(encoding="utf-8").replace("#   store:", "store:")
    text = text.replace("#           duration:", "        duration:")
    made.path.write_text(text.replace("\nstore: unknown", ""), encoding="utf-8")
    assert load_drive(made.path).store.duration == "unknown"


def test_a_file_that_is_there_is_not_overwritten(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("precious")
    with pytest.raises(OutputError, match="is there already and is not overwritten"):
        new_profile(FOLDER / "epos4.eds", path)
    assert path.read_text() == "precious"


@pytest.mark.parametrize(
    ("stem", "name"),
    [("EPOS4", "EPOS4"), ("4711 a.b", "drive-4711-a-b"), ("ä", "drive"), ("x" * 50, "x" * 32)],
)
def test_names(stem, name):
    assert profile_name(Path(f"{stem}.eds")) == name


@pytest.mark.parametrize("name", packaged("drives"))
def test_packaged_drive_profiles_fit_the_schema(name):
    schema = json_schema("drive")
    data = yaml.safe_load((FOLDER / f"{name}.yaml").read_text(encoding="utf-8"))
    assert set(data) <= set(schema["properties"])
    assert set(schema["required"]) <= set(data)
    assert schema["additionalProperties"] is False
    for parameter in data.get("parameters", {}).values():
        assert set(parameter) <= set(schema["$defs"]["ParameterInfo"]["properties"])


def test_schemas_are_json_and_show_limits_as_they_are_written():
    schema = json.loads(json.dumps(json_schema("machine")))
    limits = schema["$defs"]["Limits"]
    assert limits["properties"]["velocity"]["type"] == "string"
    assert limits["properties"]["sag"]["type"] == "string"
    assert set(limits["required"]) == {
        "travel",
        "velocity",
        "acceleration",
        "torque",
        "following_error",
    }
    for name in packaged("machines"):
        data = yaml.safe_load(Path(load_machine(name).path).read_text(encoding="utf-8"))
        assert set(data) <= set(schema["properties"])


def test_checking_tells_kind_and_open_facts(tmp_path):
    assert check_profile(FOLDER / "reference.yaml").kind == "drive"
    machine = Path(load_machine("paper-3x3").path)
    assert check_profile(machine).name == "paper-3x3"
    wrong = tmp_path / "x.yaml"
    wrong.write_text("format: fieldtool-model/1\n")
    with pytest.raises(
        ProfileError, match="format must be fieldtool-drive/1 or fieldtool-machine/1"
    ):
        check_profile(wrong)


def machine_of(tmp_path: Path, *drives: str) -> Path:
    """Return paper-3x3 with these drive profiles, axis by axis."""
    text = Path(load_machine("paper-3x3").path).read_text(encoding="utf-8")
    for drive in drives:
        text = text.replace("drive: reference\n", f"drive: {drive}\n", 1)
    path = tmp_path / "machine.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_machine_is_checked_with_its_drive_profiles_each_once_with_its_axes(tmp_path):
    found = check_profile(machine_of(tmp_path, "prbt", "nanotec", "prbt"))
    assert [axes for _, axes in found.drives] == [("axis1", "axis3"), ("axis2",)]
    for drive, name in zip((d for d, _ in found.drives), ("prbt", "nanotec"), strict=True):
        assert drive == check_profile(FOLDER / f"{name}.yaml")
        assert drive.unknown
        assert drive.obstacles


def test_an_axis_is_checked_with_its_own_eds(tmp_path):
    (tmp_path / "small.eds").write_text(SMALLEST)
    path = machine_of(tmp_path, "cia402\n    eds: small.eds", "cia402", "cia402")
    (small, first), (none, others) = check_profile(path).drives
    assert (first, others) == (("axis1",), ("axis2", "axis3"))
    assert any(NEVER_MOVED in phrase for phrase in small.obstacles)
    assert not any(NEVER_MOVED in phrase for phrase in none.obstacles)


@pytest.mark.parametrize(
    ("kind", "name"),
    [("drive", n) for n in packaged("drives")] + [("machine", n) for n in packaged("machines")],
)
def test_a_packaged_profile_is_checked_by_its_name(kind, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = check_profile(Path(name))
    assert (found.kind, found.name) == (kind, name)
    assert found == check_profile(found.path)


def test_a_type_that_the_eds_does_not_have_is_named(tmp_path):
    text = (FOLDER / "reference.yaml").read_text(encoding="utf-8")
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace('"0x2010:02", type: UNSIGNED32', '"0x2010:02", type: REAL32'))
    (tmp_path / "reference.eds").write_bytes((FOLDER / "reference.eds").read_bytes())
    with pytest.raises(ProfileError) as refused:
        check_profile(path)
    assert "parameters.velocity_p: object 0x2010:02 is REAL32 here and UNSIGNED32 in" in str(
        refused.value
    )


# --- files that are no EDS -----------------------------------------------------------------------


def eds_of(tmp_path: Path, content: bytes | str) -> Path:
    path = tmp_path / "drive.eds"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "is no EDS: it has none of the sections"),
        ("nonsense without any section\n", "is no EDS: it has none of the sections"),
        (SMALLEST.encode("utf-16"), "is not plain text (UTF-16 or binary?)"),
        (b"\x00\x01\x02" * 50, "is not plain text"),
        ("[MandatoryObjects]\nSupportedObjects=1\n1=0x1000\n", "is no EDS"),
        ("[MandatoryObjects]\nSupportedObjects=lots\n", "is no EDS that can be read"),
        (SMALLEST.replace("DataType=0x0007", "DataType=what"), "is no EDS that can be read"),
        (SMALLEST + "CompactSubObj=4000000000\n", "says that an object has 4000000000 sub-indices"),
        (SMALLEST + "[[[[\n=\n", "is no EDS that can be read"),
    ],
)
def test_what_is_no_eds_is_refused_in_one_sentence(tmp_path, content, said):
    path = eds_of(tmp_path, content)
    with pytest.raises(ProfileError) as refused:
        read_eds(path)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_large_and_missing_files_are_refused(tmp_path):
    with pytest.raises(ProfileError, match="can not be read"):
        read_eds(tmp_path / "nothing.eds")
    with pytest.raises(ProfileError, match="can not be read"):
        read_eds(tmp_path)
    path = eds_of(tmp_path, SMALLEST + ";" * MAX_EDS_BYTES)
    with pytest.raises(ProfileError, match="is too large for an EDS"):
        read_eds(path)


def test_a_file_in_the_makers_code_page_is_read(tmp_path):
    path = eds_of(tmp_path, SMALLEST.replace("Device type", "Gerätetyp").encode("latin-1"))
    assert len(read_eds(path)) == 1


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_spoilt_files_are_read_or_refused_never_anything_else(tmp_path, data):
    good = (FOLDER / "prbt.dcf").read_bytes()[:20_000]
    content = bytearray(data.draw(st.sampled_from([good, SMALLEST.encode()])))
    for _ in range(data.draw(st.integers(1, 6))):
        place = data.draw(st.integers(0, len(content) - 1))
        piece = data.draw(
            st.binary(max_size=12) | st.sampled_from([b"[", b"=", b"\n", b"0x", b"$NODEID"])
        )
        content[place : place + data.draw(st.integers(0, 30))] = piece
    path = eds_of(tmp_path, bytes(content))
    try:
        dictionary = read_eds(path)
        text = draft(dictionary, "spoilt", path.name)
        (tmp_path / "spoilt.yaml").write_text(text, encoding="utf-8")
        load_drive(tmp_path / "spoilt.yaml")
    except ProfileError as refused:
        said = str(refused)
    else:
        said = ""
    assert "\n" not in said


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_spoilt_drive_profiles_are_read_or_refused_never_anything_else(tmp_path, data):
    name = data.draw(st.sampled_from(packaged("drives")))
    tree = yaml.safe_load((FOLDER / f"{name}.yaml").read_text(encoding="utf-8"))
    junk = st.one_of(
        st.none(),
        st.booleans(),
        st.integers(-(2**40), 2**40),
        st.floats(),
        st.sampled_from(["unknown", "own", "0x1", "1 ms", "x: y", "", "\u0000", "N m", "nan"]),
        st.lists(st.integers(), max_size=3),
        st.dictionaries(st.sampled_from(["object", "scale", "x"]), st.integers(), max_size=2),
    )
    for _ in range(data.draw(st.integers(1, 3))):
        place = tree
        while True:
            keys = list(place) if isinstance(place, dict) else list(range(len(place)))
            if not keys:
                break
            key = data.draw(st.sampled_from(keys))
            if isinstance(place[key], dict | list) and data.draw(st.booleans()):
                place = place[key]
                continue
            place[key] = data.draw(junk)
            break
    path = tmp_path / "spoilt.yaml"
    path.write_text(yaml.safe_dump(tree, allow_unicode=True), encoding="utf-8")
    try:
        profile = load_drive(path)
    except ProfileError as refused:
        said = str(refused)
    else:
        said = ""
        assert isinstance(profile.unknown, tuple)
        assert isinstance(profile.tunable, frozenset)
    assert "\n" not in said


# --- the commands --------------------------------------------------------------------------------


def command(capsys, *arguments: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    out, err = capsys.readouterr()
    return ended.value.code or 0, out, err


def test_the_command_makes_a_profile_once(tmp_path, capsys):
    eds = tmp_path / "my-drive.eds"
    eds.write_bytes((FOLDER / "epos4.eds").read_bytes())
    code, out, _ = command(capsys, "profile", "new", "--eds", str(eds), "--json")
    made = json.loads(out)
    assert code == 0
    assert made["name"] == load_drive(tmp_path / "my-drive.yaml").name == "my-drive"
    assert load_drive(tmp_path / "my-drive.yaml").eds == "my-drive.eds"
    assert "torque.scale" in made["unknown"]
    code, _, err = command(capsys, "profile", "new", "--eds", str(eds))
    assert code == 3
    assert "is there already and is not overwritten" in err


def test_the_command_tells_file_and_line(tmp_path, capsys):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "format: fieldtool-drive/1\nname: mine\neds: own\nidentity: {}\ntorqe: unknown\n"
    )
    code, _, err = command(capsys, "profile", "check", str(path))
    assert code == 2
    assert err == (
        f"fieldtool: {path}:5: torqe is not a known key. Check its spelling or take it out.\n"
    )
    code, _, err = command(capsys, "profile", "new", "--eds", str(path))
    assert code == 2
    assert "is no EDS" in err


def test_the_command_says_of_a_machine_what_it_says_of_its_drive_profiles(tmp_path, capsys):
    path = machine_of(tmp_path, "prbt", "prbt", "reference")
    code, out, _ = command(capsys, "profile", "check", str(path))
    assert code == 0
    said = " ".join(out.split())
    for axes, name in (("axis1, axis2", "prbt"), ("axis3", "reference")):
        _, out, _ = command(capsys, "profile", "check", name)
        alone = " ".join(out.split()).split("it can be read. ")[1]
        assert f"{axes}: {FOLDER / name}.yaml, a drive profile, {name}. {alone}" in said
    code, out, _ = command(capsys, "profile", "check", str(path), "--json")
    assert code == 0
    assert [d["axes"] for d in json.loads(out)["drives"]] == [["axis1", "axis2"], ["axis3"]]
    assert "it has no cyclic position mode" in out


def test_the_command_prints_schemas(capsys):
    for kind in ("drive", "machine"):
        code, out, _ = command(capsys, "profile", "schema", kind)
        assert code == 0
        assert json.loads(out)["title"] == f"fieldtool {kind} profile"
    assert command(capsys, "profile", "schema", "robot")[0] == 2
