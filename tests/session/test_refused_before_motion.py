"""What is refused before anything is enabled: profiles, nodes, drives, limits, folders, files."""

import io
import re
import socket
import sys
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drives.bus import CyclicLoad, check_cycle
from drives.canopen_drive import connect
from drives.errors import DrivesError, LimitsError
from drives.profile import load_machine
from drives.sim.faults import DriveFault, NodeVanishes, NoTransmitPdos, SdoRefused, SdoSilent
from drives.sim.lockstep_bus import register, unregister
from drives.sim.machine import simulated_machine
from fieldtool.errors import FieldtoolError
from fieldtool.experiment import directions
from fieldtool.experiment.axes import Axes
from fieldtool.experiment.directions import check_directions
from fieldtool.experiment.forecast import forecast
from fieldtool.experiment.stepped.design import chosen_cycle_time, classic_plan
from fieldtool.workflow.models import prior_model
from fieldtool.workflow.preparation import setting_of
from tests.faults.bench import command as run_command
from tests.session.conftest import two_axes

TABLE, ARM = 11, 12
NO_OBJECT = 0x06020000


def nothing_was_done(bench):
    """No drive was enabled, no SYNC was sent, and every object is as it was."""
    assert bench.machine.sync_count == 0
    assert bench.powered() == {}
    assert bench.changed() == {}


# --- profiles ------------------------------------------------------------------------------------


def at(*path):
    def find(profile):
        for key in path[:-1]:
            profile = profile[key]
        return profile, path[-1]

    return find


def put(*path, value):
    def edit(profile):
        part, key = at(*path)(profile)
        part[key] = value

    return edit


def take(*path):
    def edit(profile):
        part, key = at(*path)(profile)
        del part[key]

    return edit


LIMITS = ("axes", 0, "limits")
WRONG_PROFILES = {
    "unknown key": (put(*LIMITS, "velocty", value="1 rad/s"), "velocty is not a known key", "velocty"),
    "misspelled limit": (
        lambda p: p["axes"][0]["limits"].update(velocty=p["axes"][0]["limits"].pop("velocity")),
        "axis table, limits.velocty is not a known key",
        "velocty",
    ),
    "no limits": (take("axes", 0, "limits"), "without this limit nothing may move", "name: table"),
    "no travel": (take(*LIMITS, "travel"), "axis table, limits.travel is missing", "limits:"),
    "no torque": (take(*LIMITS, "torque"), "axis table, limits.torque is missing", "limits:"),
    "bare number": (put(*LIMITS, "torque", value=6), "6 has no unit: write it with one", "torque: 6"),
    "wrong unit": (put(*LIMITS, "velocity", value="10 rad"), "unit 'rad' does not fit", "velocity:"),
    "linear unit": (put(*LIMITS, "torque", value="6 N"), "unit 'N' does not fit", "torque: 6 N"),
    "negative": (put(*LIMITS, "velocity", value="-1 rad/s"), "above 0", "velocity: -1"),
    "zero": (put(*LIMITS, "following_error", value="0 deg"), "above 0", "following_error"),
    "infinite": (put(*LIMITS, "torque", value="1e999 N m"), "too large", "torque: 1e999"),
    "turned travel": (put(*LIMITS, "travel", value=["2 rad", "-2 rad"]), "low to high", "travel:"),
    "one travel": (put(*LIMITS, "travel", value=["2 rad"]), "axis table, limits.travel", "travel:"),
    "kind": (put("axes", 0, "kind", value="round"), "axis table, kind", "kind: round"),
    "node id text": (put("axes", 0, "node_id", value="eleven"), "table, node_id", "node_id: eleven"),
    "node id 200": (put("axes", 0, "node_id", value=200), "axis table, node_id", "node_id: 200"),
    "node id twice": (put("axes", 1, "node_id", value=11), "both have node id 11", None),
    "name twice": (put("axes", 1, "name", value="table"), "two axes are called table", None),
    "no axes": (put("axes", value=[]), "axes", "axes: []"),
    "springs": (put("axes", 0, "prior", "springs", value=[]), "2 masses need 1 springs", "prior:"),
    "text mass": (put("axes", 0, "prior", "masses", value=["a", 1.0]), "masses, number 1", "- a"),
    "yes mass": (put("axes", 0, "prior", "masses", value=[True, 1.0]), "masses, number 1", "- true"),
    "bit rate": (put("bus", "bitrate", value=5), "bus.bitrate", "bitrate: 5"),
    "no bus": (take("bus"), "bus is missing", None),
    "format": (put("format", value="fieldtool-machine/2"), "format", "format:"),
    "coupling": (put("couplings", value=[{"axes": ["table", "leg"], "value": 1.0}]), "leg", "axes:"),
    "drive": (put("axes", 0, "drive", value="missing"), "no such drive profile", None),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG_PROFILES)
def test_a_wrong_profile_is_refused_with_file_and_line(bench, case):
    edit, sentence, line_with = WRONG_PROFILES[case]
    profile = deepcopy(bench.data)
    edit(profile)
    bench.rewrite(profile)
    outcome = bench.measure()
    assert outcome.code == 2, outcome.err
    assert sentence in outcome.err
    if line_with is not None:
        text = bench.profile.read_text().splitlines()
        lines = [k + 1 for k, line in enumerate(text) if line_with in line]
        assert any(f"{bench.profile}:{line}: " in outcome.err for line in lines), outcome.err
    assert outcome.err.count("\n") == 1, "one sentence"
    nothing_was_done(bench)


BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{','.join([f'*{chr(97 + k)}'] * 9)}]\n" for k in range(12)
)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "is no mapping"),
        (b"- 1\n", "is no mapping"),
        (b"a: [1\nb: 2\n", "is no YAML"),
        (b"a: 1\na: 2\n", "a second time"),
        (b"\xff\xfe\x00", "not UTF-8"),
        (b"a: \x01\n", "is no YAML"),
        (b"a: 2024-99-99\n", "YAML can not build"),
        (b"? [a]\n: 1\n", "is no YAML"),
        (b"a: !!python/object/apply:os.system [ls]\n", "is no YAML"),
        (b"[" * 500, "nested too deep"),
        (BOMB.encode(), "alias"),
        (b"a: &a [*a]\n", "alias"),
        (b"a: " + b"x" * 1_000_001, "too large"),
        (b"1: 2\n3: 4\n", "format is missing"),
    ],
    ids=lambda v: repr(v)[:20],
)
def test_a_file_that_is_no_profile_is_refused(bench, content, sentence):
    bench.profile.write_bytes(content)
    outcome = bench.measure()
    assert outcome.code == 2, outcome.err
    assert sentence in outcome.err
    assert str(bench.profile) in outcome.err


def test_a_byte_order_mark_does_no_harm(bench):
    bench.profile.write_bytes(b"\xef\xbb\xbf" + bench.profile.read_bytes())
    assert load_machine(bench.profile).name == "bench"


@pytest.mark.parametrize("name", ["nothing", "no/such.yaml", "x" * 5000, "."])
def test_a_profile_that_is_not_there_is_refused(bench, name):
    outcome = bench.command("measure", name, "--plan", "classic", "--out", bench.out)
    assert outcome.code == 2
    assert "profile" in outcome.err or "name of a file" in outcome.err


@settings(
    max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)
@given(
    junk=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner),
        max_leaves=5,
    ),
    path=st.sampled_from(
        [
            ("bus",),
            ("axes",),
            ("axes", 0),
            ("axes", 0, "limits"),
            ("axes", 0, "limits", "travel"),
            ("axes", 0, "limits", "torque"),
            ("axes", 0, "node_id"),
            ("axes", 0, "prior"),
            ("axes", 0, "prior", "masses"),
            ("couplings",),
            ("simulation", "axes"),
            ("simulation", "axes", 0, "gains"),
        ]
    ),
)
def test_any_junk_in_a_profile_is_a_profile_error_or_fine(tmp_path, profile_of_two, junk, path):
    profile = deepcopy(profile_of_two)
    put(*path, value=junk)(profile)
    file = tmp_path / "junk.yaml"
    file.write_text(yaml.safe_dump(profile, allow_unicode=True), encoding="utf-8")
    try:
        load_machine(file)
    except DrivesError as error:
        assert str(file) in str(error)  # noqa: PT017


# --- nodes and drives ----------------------------------------------------------------------------

REFUSED = {
    "silent node": (NodeVanishes(ARM), "arm: node 12 does not answer"),
    "another device": (None, "arm: node 12 is another device than profile reference says: device type"),
    "no CiA 402 drive": (None, "arm: node 12 is no CiA 402 drive"),
    "in fault": (DriveFault(ARM, 0x3210), "arm: the drive is in fault; its last error is 0x3210"),
    "SDO abort": (SdoRefused(ARM, 0x6076, 0, 0x08000022), "arm, object 0x6076:00: the drive refused"),
    "SDO silent": (SdoSilent(ARM, 0x6041), "arm, object 0x6041:00: node 12 did not answer within 0.5"),
    "no mapping": (SdoRefused(ARM, 0x1A00, 1, 0x06040041), "arm, object 0x1A00:01"),
    "no heartbeat consumer": (SdoRefused(ARM, 0x1016, 1, NO_OBJECT), "arm: the drive has no heartbeat"),
    "no abort connection": (SdoRefused(ARM, 0x6007, 0, NO_OBJECT), "arm: the drive has no abort conn"),
    "no PDO": (NoTransmitPdos(ARM), "arm: node 12 sends no PDO after SYNC"),
}  # fmt: skip
OTHER_OBJECTS = {
    "another device": {(0x1000, 0): 0x00010192},
    "no CiA 402 drive": {(0x1000, 0): 0x000F0191},
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_node_that_is_not_right_is_refused(make_bench, case):
    fault, sentence = REFUSED[case]
    bench = make_bench(objects={ARM: OTHER_OBJECTS.get(case, {})})
    if fault is not None:
        bench.inject(fault)
    outcome = bench.measure()
    assert outcome.code == 3, outcome.err
    assert sentence in outcome.err
    assert outcome.err.rstrip().endswith("."), outcome.err
    assert bench.powered() == {}
    assert bench.changed() == {}
    assert not (bench.out / "recording.h5").exists() or bench.recording().experiments == ()


@pytest.mark.parametrize(
    ("objects", "sentence"),
    [
        ({(0x6076, 0): 0}, "arm: motor rated torque 0x6076 is zero, so torques have no scale"),
        ({(0x608F, 1): 0}, "arm: position has no scale"),
        ({(0x6502, 0): 0b1000000001}, "arm: the drive has no mode cyclic position (8); 0x6502 is"),
        ({(0x6502, 0): 0b0010000001}, "arm: the drive has no mode cyclic torque (10); 0x6502 is"),
    ],
)
def test_a_drive_that_lacks_what_the_tool_needs_is_refused(make_bench, objects, sentence):
    bench = make_bench(objects={ARM: objects})
    outcome = bench.measure()
    assert outcome.code == 3, outcome.err
    assert sentence in outcome.err
    nothing_was_done(bench)


def test_a_drive_with_another_serial_number_is_refused(make_bench, profile_of_two):
    bench = make_bench(profile_of_two)
    profile_of_two["axes"][1]["serial_number"] = 77
    bench.rewrite(profile_of_two)
    outcome = bench.measure()
    assert outcome.code == 3
    assert "serial number 0x1018:04 is 0x000003F4, expected 0x0000004D" in outcome.err
    nothing_was_done(bench)


def test_a_node_that_is_not_on_the_bus_is_refused(make_bench, profile_of_two):
    bench = make_bench(profile_of_two)
    profile_of_two["axes"][1]["node_id"] = 13
    bench.rewrite(profile_of_two)
    outcome = bench.measure()
    assert outcome.code == 3
    assert "arm: node 13 does not answer. Check its supply, its cable, its node id" in outcome.err
    nothing_was_done(bench)


def test_the_hosts_own_node_id_is_refused(make_bench, profile_of_two):
    bench = make_bench(profile_of_two)
    profile_of_two["axes"][1]["node_id"] = 127
    bench.rewrite(profile_of_two)
    outcome = bench.measure()
    assert outcome.code == 3
    assert "node id 127 is the host's own" in outcome.err


def test_a_drive_that_somebody_else_has_enabled_is_left_alone(bench):
    node = bench.machine.node(ARM)
    for word in (0x06, 0x07, 0x0F):
        node.motion.write_controlword(word)
    outcome = bench.measure()
    assert outcome.code == 3
    assert "arm: the drive is already enabled (operation enabled)" in outcome.err
    assert "Stop the other controller first" in outcome.err
    assert bench.powered() == {ARM: "OPERATION_ENABLED"}, "it is not ours to switch off"
    assert bench.machine.sync_count == 0


def test_a_node_that_was_stopped_is_woken_up(bench):
    bench.machine.receive(0, bytes((0x02, ARM)))
    with bench.connected() as group:
        assert group.drives[1].identity.serial_number == 1012


def test_an_answer_that_is_too_short_is_an_error_with_its_object(bench, monkeypatch):
    node = bench.machine.node(ARM)

    def cut(cob_id, data, port_send=node.network.send):
        port_send(cob_id, bytes(data)[:0] if cob_id == 0x580 + ARM else data)

    monkeypatch.setattr(node.network, "send", cut)
    with pytest.raises(DrivesError, match="arm"), bench.connected():
        pytest.fail("never connected")


# --- limits and plans ----------------------------------------------------------------------------


def limits_changed(make_bench, profile, changes, axis=0):
    profile["axes"][axis]["limits"].update(changes)
    return make_bench(profile)


def test_a_sweep_that_would_leave_the_travel_is_refused(bench, monkeypatch):
    """The plan's choice of amplitudes is wrong on purpose: the forecast is what refuses."""
    monkeypatch.setattr("fieldtool.experiment.stepped.design.SHARE_OF_LIMITS", 30.0)
    outcome = bench.measure()
    assert outcome.code == 3, outcome.err
    assert "sweep table direct, others free: " in outcome.err
    assert "its limit is" in outcome.err
    assert "Nothing of it was moved" in outcome.err
    nothing_was_done(bench)


def test_an_axis_outside_its_travel_is_not_moved(make_bench, profile_of_two):
    bench = limits_changed(make_bench, profile_of_two, {"travel": ["10 deg", "90 deg"]}, axis=1)
    outcome = bench.measure()
    assert outcome.code == 3
    assert "arm: stands at 0 rad, outside its travel 0.174533 to 1.5708 rad" in outcome.err
    nothing_was_done(bench)


def test_an_axis_that_may_not_float_is_not_let_float(make_bench, profile_of_two):
    profile_of_two["axes"][1]["may_float"] = False
    bench = make_bench(profile_of_two)
    outcome = bench.measure()
    assert outcome.code == 3
    assert "arm may not" in outcome.err
    nothing_was_done(bench)
    with bench.connected() as group, pytest.raises(LimitsError, match="arm: may not float"):
        group.motion(0.01, ("arm",)).__enter__()
    nothing_was_done(bench)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"travel": ["-1e9 rad", "1e9 rad"]}, "is more than the drive's position can show"),
        ({"travel": ["0 rad", "1e300 rad"]}, "is more than the drive's position can show"),
        ({"torque": "1 mN m"}, "torque limit 0.001 N m is less than the drive's resolution"),
        ({"following_error": "1e-9 rad"}, "following error limit 1e-09 rad is less than"),
    ],
)
def test_a_limit_that_the_drive_can_not_express_is_refused(
    make_bench, profile_of_two, changes, sentence
):
    bench = limits_changed(make_bench, profile_of_two, changes)
    outcome = bench.measure()
    assert outcome.code == 3, outcome.err
    assert "table: " in outcome.err
    assert sentence in outcome.err
    nothing_was_done(bench)


def test_a_limit_that_makes_every_move_last_for_hours_is_refused(make_bench, profile_of_two):
    bench = limits_changed(make_bench, profile_of_two, {"velocity": "1e-6 rad/s"})
    outcome = bench.measure()
    assert outcome.code == 3
    assert "table: with a velocity limit of 1e-06/s" in outcome.err
    assert "at most 600 s are allowed" in outcome.err
    nothing_was_done(bench)


@pytest.mark.parametrize(
    "changes", [{"travel": ["-1e-5 deg", "1e-5 deg"]}, {"acceleration": "1e-5 rad/s2"}]
)
def test_limits_that_leave_less_than_the_encoder_counts_are_refused(
    make_bench, profile_of_two, changes
):
    bench = limits_changed(make_bench, profile_of_two, changes)
    outcome = bench.measure("--time", "10", plan="fast")
    assert outcome.code == 3, outcome.err
    assert "table: within its limits the excitation can be " in outcome.err
    assert "counts tell nothing" in outcome.err
    nothing_was_done(bench)


_RANDOM = st.tuples(
    st.floats(-3, 9),  # travel, decades of rad
    st.floats(-1, 1),  # where its middle is, in halves of it
    *(st.floats(-12, 12) for _ in range(4)),
)


@settings(
    max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)
@given(values=_RANDOM)
def test_any_limit_leads_to_a_clean_refusal_or_a_clean_start(
    tmp_path, profile_of_two, monkeypatch, values
):
    """Never a traceback, never a drive left on, never a drive changed."""
    travel, middle, velocity, acceleration, torque, error = values
    monkeypatch.setattr(directions, "LONGEST_MOVE", 5.0)
    half = 10.0**travel
    profile = deepcopy(profile_of_two)
    profile["axes"][0]["limits"] = {
        "travel": [f"{half * (middle - 1)!r} rad", f"{half * (middle + 1)!r} rad"],
        "velocity": f"{10.0**velocity!r} rad/s",
        "acceleration": f"{10.0**acceleration!r} rad/s2",
        "torque": f"{10.0**torque!r} N m",
        "following_error": f"{10.0**error!r} rad",
    }
    profile["bus"]["channel"] = "random-limits"
    file = tmp_path / "random.yaml"
    file.write_text(yaml.safe_dump(profile))
    machine = load_machine(file)
    running = register("random-limits", simulated_machine(machine))
    try:
        begun = False
        try:
            with connect(machine) as group, group.without_feed_forward():
                setting = setting_of(machine, group, prior_model(machine))
                cycle = chosen_cycle_time(setting.model, group.shortest_cycle)
                forecast(classic_plan(setting, group.axes, cycle), setting)
                begun = True
                axes = Axes(group.axes, setting.limits, setting.centre)
                check_directions(group, axes, cycle, lambda _: None)
        except (DrivesError, FieldtoolError) as refused:
            assert len(str(refused)) > 20  # noqa: PT017
            assert begun or running.sync_count == 0
        assert not any(node.motion.powered for node in running.nodes)
    finally:
        unregister("random-limits")


# --- bus and cycle -------------------------------------------------------------------------------


def test_a_cycle_that_does_not_fit_the_bus_is_refused_with_the_numbers(make_bench, profile_of_two):
    profile_of_two["bus"]["bitrate"] = 125_000
    bench = make_bench(profile_of_two)
    outcome = bench.measure()
    assert outcome.code == 3
    assert "the fastest mode needs a cycle of 1.9 ms or less" in " ".join(outcome.err.split())
    assert "the bus allows 6 ms or more" in outcome.err
    assert "higher bit rate" in outcome.err
    nothing_was_done(bench)
    with bench.connected() as group, pytest.raises(LimitsError) as refused:
        group.motion(0.002).__enter__()
    said = str(refused.value)
    for number in ("2 axes", "2 ms", "595 bits", "238 %", "125000 bit/s", "90 %", "6 ms"):
        assert number in said, said
    nothing_was_done(bench)


def test_the_shortest_cycle_named_does_fit():
    for axes in range(1, 33):
        for bitrate in (125_000, 250_000, 500_000, 1_000_000):
            with pytest.raises(LimitsError) as refused:
                check_cycle(CyclicLoad(axes, 1e-5, bitrate))
            shortest = float(str(refused.value).split()[-2]) / 1000
            check_cycle(CyclicLoad(axes, shortest, bitrate))
            with pytest.raises(LimitsError):
                check_cycle(CyclicLoad(axes, shortest - 0.001 + 1e-6, bitrate))


@pytest.mark.parametrize(
    ("bus", "what"),
    [
        ({"interface": "nothing", "channel": "x"}, "python-can knows no interface 'nothing'"),
        (
            {"interface": "fieldsim", "channel": "no-such-machine"},
            "bus fieldsim no-such-machine: can not be opened",
        ),
        ({"interface": "socketcan", "channel": "no_such_can0"}, "no_such_can0 does not exist"),
        (
            {"interface": "virtual", "channel": "x", "options": {"rx_que_size": 5}},
            "rx_que_size: python-can's interface virtual has no such option; it has .*rx_queue_size",
        ),
        (
            {"interface": "virtual", "channel": "x", "options": {"rx_queue_size": "5"}},
            "rx_queue_size: needs a value of type int, got '5'",
        ),
        (
            {"interface": "virtual", "channel": "x", "options": {"receive_own_messages": True}},
            "receive_own_messages: can not be given, the tool sets it itself",
        ),
        ({"interface": "ics", "channel": "x"}, "knows no interface 'ics'"),
    ],
)
def test_a_bus_that_can_not_be_opened_is_refused(bench, bus, what):
    if bus["interface"] == "socketcan" and not hasattr(socket, "AF_NETLINK"):
        pytest.skip("only Linux can be asked for its interfaces")
    bench.rewrite({**bench.data, "bus": {**bus, "bitrate": 500_000}})
    outcome = bench.measure()
    assert outcome.code == 3, outcome.err
    assert re.search(what, outcome.err), outcome.err


def test_another_bus_than_the_profile_s_is_used_and_kept(bench):
    """--interface, --channel, --bitrate: the session's profile is that of the bus that was used."""
    out = bench.folder / "elsewhere"
    options = ("--interface", "virtual", "--channel", "x", "--bitrate", "250000")
    outcome = bench.command("measure", bench.profile, *options, "--yes", "--out", out)
    assert outcome.code == 3
    assert "table: node 11 does not answer" in outcome.err
    used = yaml.safe_load((out / "machine.yaml").read_text())["bus"]
    assert used == {"interface": "virtual", "channel": "x", "bitrate": 250_000}
    assert bench.command("measure", bench.profile, "--interface", "a b").code == 2


# --- folders and disks ---------------------------------------------------------------------------


def test_a_session_folder_that_is_a_file_is_refused(bench):
    bench.out.write_text("a file")
    outcome = bench.measure()
    assert outcome.code == 3
    assert "results can not be written here" in outcome.err
    assert "--out" in outcome.err
    nothing_was_done(bench)


def test_a_session_folder_below_a_file_is_refused(bench):
    bench.out.write_text("a file")
    outcome = bench.command("run", bench.profile, "--plan", "classic", "--out", bench.out / "below")
    assert outcome.code == 3
    assert "results can not be written here" in outcome.err
    nothing_was_done(bench)


def test_a_session_that_is_there_is_not_overwritten(bench):
    bench.out.mkdir()
    (bench.out / "recording.h5").write_text("measured yesterday")
    outcome = bench.measure()
    assert outcome.code == 3
    assert "not overwritten" in outcome.err
    assert (bench.out / "recording.h5").read_text() == "measured yesterday"
    nothing_was_done(bench)


@pytest.mark.parametrize("name", ["parameters-before.yaml.part", "machine.yaml"])
def test_a_file_that_can_not_be_written_is_found_before_anything_moves(bench, name):
    (bench.out / name).mkdir(parents=True)
    outcome = bench.measure()
    assert outcome.code == 3, outcome.err
    assert name.removesuffix(".part") in outcome.err
    nothing_was_done(bench)


def test_a_disk_that_fills_up_while_measuring_keeps_what_is_there(bench, monkeypatch):
    import errno
    import os

    fsync, calls = os.fsync, []

    def full(handle):
        if "recording" in os.readlink(f"/proc/self/fd/{handle}"):
            calls.append(handle)
            if len(calls) > 2:
                raise OSError(errno.ENOSPC, "No space left on device")
        fsync(handle)

    monkeypatch.setattr("fieldtool.records.files.os.fsync", full)
    outcome = bench.measure()
    assert outcome.code == 3, outcome.err
    assert "no room" in outcome.err
    assert bench.powered() == {}
    assert bench.changed() == {}
    bench.recording()


def test_everything_of_a_machine_is_what_the_bench_says(bench):
    """The bench itself: what `changed` sees, so that the tests above can fail."""
    bench.machine.node(ARM).dictionary.write(0x6065, 0, 5)
    assert bench.changed() == {ARM: {"0x6065:00": (104_858, 5)}}
    assert np.all([node.motion.powered is False for node in bench.machine.nodes])
    assert replace(bench.machine.description, seed=1).seed == 1


def test_nothing_moves_where_nobody_can_be_asked(bench) -> None:
    """No terminal, or none at all: without --yes it is refused, and no axis is enabled."""
    for stream in (io.StringIO(""), None):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "stdin", stream)
            out = bench.folder / f"asked-{stream is None}"
            outcome = bench.command("run", bench.profile, "--write", "--time", 12, "--out", out)
        assert outcome.code == 3
        assert "nobody to ask" in outcome.err
        assert "--yes" in outcome.err
        assert bench.powered() == {}


@pytest.mark.parametrize("words", [("measure", "--yes"), ("check", "--yes"), ("scan",)])
def test_a_machine_that_can_not_be_simulated_is_a_fault_of_its_profile(tmp_path, words):
    """Exit code 2, as for any other fault in it, though it shows as the bus is opened."""
    profile, path = two_axes(), tmp_path / "machine.yaml"
    profile["simulation"]["axes"][0]["peak_torque"] = 1e9
    profile["bus"]["channel"] = str(path)
    path.write_text(yaml.safe_dump(profile), encoding="utf-8")
    command, *options = words
    out = ("--out", tmp_path / "session") if command == "measure" else ()
    code, said = run_command(command, path, *options, *out)
    assert code == 2
    assert "machine.yaml: simulation: " in said
    assert "peak torque" in said
