"""``fieldtool check``: what is found before the first motion, and that nothing is left behind."""

import json
import math

import can
import pytest

from drives.errors import MAY_BE_ENABLED, DriveFaultError
from drives.sim.faults import (
    DriveFault,
    EncoderStuck,
    MotorReversed,
    NodeVanishes,
    SdoRefused,
    SdoSilent,
)
from fieldtool.workflow import check_moves

NO_OBJECT = 0x06020000
REVOLUTION = 2**20
"""Position units."""


def findings(outcome) -> dict[tuple[str | None, str], dict]:
    return {(f["axis"], f["check"]): f for f in json.loads(outcome.out)["findings"]}


def not_passed(outcome) -> dict[tuple[str | None, str], str]:
    return {
        key: f["status"]
        for key, f in findings(outcome).items()
        if f["status"] not in ("pass", "not tried")
    }


def test_a_sound_machine_passes_and_is_left_as_it_was(bench) -> None:
    outcome = bench.command("check", bench.profile, "--move", "--json")
    assert outcome.code == 0
    assert not_passed(outcome) == {}
    found = findings(outcome)
    for axis in ("table", "arm"):
        for check in ("direction", "brake and friction", "load at rest", "room for the sweeps"):
            assert found[axis, check]["status"] == "pass"
    assert json.loads(outcome.out)["verdict"] == "pass"
    assert bench.machine.sync_count > 1000
    assert bench.powered() == {}
    assert bench.changed() == {}


def test_without_move_nothing_is_written_nor_moved(bench) -> None:
    bench.listen()
    outcome = bench.command("check", bench.profile, "--no-move", "--json")
    assert outcome.code == 0
    assert {k[1] for k, f in findings(outcome).items() if f["status"] == "not tried"} == {
        "room for the sweeps",
        "direction",
        "brake and friction",
        "load at rest",
    }
    sent = [f for f in bench.heard() if not 0x580 < f.cob_id < 0x600]
    assert sent
    assert all(0x600 < f.cob_id < 0x680 for f in sent)
    assert all(f.data[0] & 0xE0 in (0x40, 0x60) for f in sent), "a question, never a write"
    assert bench.machine.sync_count == 0


def test_with_nobody_to_ask_nothing_moves(small_bench) -> None:
    outcome = small_bench.command("check", small_bench.profile, "--json")
    assert outcome.code == 0
    assert json.loads(outcome.out)["moved"] is False
    assert small_bench.machine.sync_count == 0


@pytest.mark.parametrize(
    ("objects", "check", "status", "words"),
    [
        ({(0x6072, 0): 800}, "torque limit", "warn", "3.2 N m (0x6072)"),
        ({(0x6065, 0): REVOLUTION // 100}, "following error limit", "warn", "0.06283 rad (0x6065)"),
        ({(0x607F, 0): REVOLUTION}, "velocity limit", "warn", "6.283 rad/s (0x607F)"),
        (
            {(0x607D, 1): -REVOLUTION // 4, (0x607D, 2): REVOLUTION},
            "travel limits",
            "fail",
            "-1.571 to 6.283 rad (0x607D)",
        ),
        ({(0x6076, 0): 400}, "torque unit", "fail", "15 times"),
        ({(0x608F, 1): 512}, "position unit", "fail", "one position unit is 0.01227 rad"),
        ({(0x605A, 0): 0}, "stops by itself", "pass", "would let it coast"),
    ],
)
def test_settings_against_the_profile(
    make_bench, profile_of_one, objects, check: str, status: str, words: str
) -> None:
    bench = make_bench(profile_of_one, objects={11: objects})
    outcome = bench.command("check", bench.profile, "--no-move", "--json")
    found = findings(outcome)["table", check]
    assert found["status"] == status, found
    assert words in found["found"]
    assert bool(found["todo"]) == (status != "pass")
    assert outcome.code == (3 if status == "fail" else 0)


def test_every_fault_of_every_axis_is_in_one_table(bench) -> None:
    """A check does not end at the first thing: a technician wants all of them at once."""
    bench.inject(NodeVanishes(11))
    bench.inject(DriveFault(12))
    outcome = bench.command("check", bench.profile, "--move", "--json")
    assert outcome.code == 3
    assert not_passed(outcome) == {("table", "identity"): "fail", ("arm", "power state"): "fail"}
    found = findings(outcome)
    assert "node 11 does not answer" in found["table", "identity"]["found"]
    assert "0x2310" in found["arm", "power state"]["found"]
    assert found["arm", "direction"]["status"] == "not tried"
    assert bench.machine.sync_count == 0


@pytest.mark.parametrize(
    ("index", "sub", "word"),
    [
        (0x1016, 1, "no heartbeat consumer (0x1016)"),
        (0x6007, 0, "no abort connection option (0x6007)"),
    ],
)
def test_a_drive_that_would_not_stop_by_itself(
    small_bench, index: int, sub: int, word: str
) -> None:
    small_bench.inject(SdoRefused(11, index, sub, NO_OBJECT))
    outcome = small_bench.command("check", small_bench.profile, "--move", "--json")
    assert outcome.code == 3
    found = findings(outcome)["table", "stops by itself"]
    assert (found["status"], word in found["found"]) == ("fail", True)
    assert small_bench.machine.sync_count == 0


def test_what_is_kept_while_axes_move_is_gone_afterwards(
    small_bench, monkeypatch, tmp_path
) -> None:
    """Backup and note are there in motion, for whoever has to put things right after a kill."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    seen = []
    check = check_moves.check_directions

    def looked(*arguments: object) -> None:
        seen.extend(path.name for path in folder.glob("sessions/*/*"))
        check(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(check_moves, "check_directions", looked)
    assert small_bench.command("check", small_bench.profile, "--move").code == 0
    assert {"machine.yaml", "parameters-before.yaml", "write-journal.yaml"} <= set(seen)
    assert list(folder.iterdir()) == []


def test_another_drive_than_the_profile_says(small_bench) -> None:
    small_bench.data["axes"][0]["serial_number"] = 99
    small_bench.rewrite(small_bench.data)
    outcome = small_bench.command("check", small_bench.profile, "--move", "--json")
    assert outcome.code == 3
    assert "serial number" in findings(outcome)["table", "identity"]["found"]


def test_an_axis_outside_its_travel(small_bench) -> None:
    small_bench.data["axes"][0]["limits"]["travel"] = ["10 deg", "120 deg"]
    small_bench.rewrite(small_bench.data)
    outcome = small_bench.command("check", small_bench.profile, "--move", "--json")
    assert outcome.code == 3
    found = findings(outcome)["table", "position"]
    assert (found["status"], "stands at 0 rad" in found["found"]) == ("fail", True)
    assert small_bench.machine.sync_count == 0


def test_an_axis_near_the_end_of_its_travel_is_a_warning(small_bench) -> None:
    small_bench.data["axes"][0]["limits"]["travel"] = ["-1 deg", "120 deg"]
    small_bench.rewrite(small_bench.data)
    outcome = small_bench.command("check", small_bench.profile, "--no-move", "--json")
    assert not_passed(outcome) == {("table", "position"): "warn"}
    assert outcome.code == 0


def test_an_axis_that_goes_the_wrong_way_is_stopped_and_named(bench) -> None:
    bench.inject(MotorReversed(12))
    outcome = bench.command("check", bench.profile, "--move", "--json")
    assert outcome.code == 4
    found = findings(outcome)
    assert found["arm", "direction"]["status"] == "fail"
    assert "wrong way" in found["arm", "direction"]["found"]
    assert found["table", "direction"]["status"] == "not tried"
    assert bench.powered() == {}
    assert bench.changed() == {}


def test_an_encoder_that_stands_still_is_found(small_bench) -> None:
    small_bench.inject(EncoderStuck(11))
    outcome = small_bench.command("check", small_bench.profile, "--move", "--json")
    assert outcome.code == 4
    found = findings(outcome)["table", "direction"]
    assert (found["status"], "does not move" in found["found"]) == ("fail", True)
    assert small_bench.powered() == {}
    assert small_bench.changed() == {}


def test_another_master_ends_the_check_before_a_question(small_bench) -> None:
    other = can.Bus(interface="fieldsim", channel=small_bench.channel)
    other.send_periodic(can.Message(arbitration_id=0x80, is_extended_id=False), 0.05)
    outcome = small_bench.command("check", small_bench.profile, "--move", "--json")
    heard = []
    while (message := other.recv(0.0)) is not None:
        heard.append(message.arbitration_id)
    other.shutdown()
    assert outcome.code == 3
    assert not_passed(outcome) == {(None, "one master"): "fail"}
    assert heard == []


def test_a_bus_that_can_not_be_opened(small_bench) -> None:
    outcome = small_bench.command("check", small_bench.profile, "--channel", "nowhere", "--json")
    assert outcome.code == 3
    assert not_passed(outcome) == {(None, "bus"): "fail"}


def test_the_users_stop_is_130_and_safe(small_bench, monkeypatch) -> None:
    from fieldtool.cli.stop_key import StopKey

    calls = 0

    def pressed(_self: StopKey) -> bool:
        nonlocal calls
        calls += 1
        return calls > 300

    monkeypatch.setattr(StopKey, "__call__", pressed)
    outcome = small_bench.command("check", small_bench.profile, "--move")
    assert outcome.code == 130
    assert small_bench.powered() == {}
    assert small_bench.changed() == {}


def test_the_users_stop_is_4_where_a_drive_does_not_switch_off(
    small_bench, tmp_path, monkeypatch
) -> None:
    from fieldtool.cli.stop_key import StopKey

    monkeypatch.chdir(tmp_path)  # what is left to be restored is noted there
    calls = 0

    def pressed(_self: StopKey) -> bool:
        nonlocal calls
        calls += 1
        if calls == 300:
            small_bench.inject(SdoSilent(11, 0x6040))
            small_bench.machine.receive(0x000, bytes([0x80, 11]))  # NMT: its PDOs are dead then
        return calls >= 300

    monkeypatch.setattr(StopKey, "__call__", pressed)
    outcome = small_bench.command("check", small_bench.profile, "--move")
    assert "table: node 11 does not answer after it was told to switch off" in outcome.err
    assert MAY_BE_ENABLED in outcome.err
    assert "fieldtool restore sessions" in outcome.err
    assert outcome.code == 4


@pytest.mark.parametrize("enabled", [False, True])
def test_a_drive_that_does_not_enable_while_another_stays_enabled_is_4(
    small_bench, monkeypatch, enabled
) -> None:
    def fails(*_arguments: object) -> None:
        error = DriveFaultError("table: does not follow the controlword")
        if enabled:
            error.add_note(f"table: it {MAY_BE_ENABLED}")
        raise error

    monkeypatch.setattr(check_moves, "check_directions", fails)
    outcome = small_bench.command("check", small_bench.profile, "--move", "--json")
    assert outcome.code == (4 if enabled else 3)
    assert (MAY_BE_ENABLED in outcome.out) == enabled


def test_ctrl_c_while_a_drive_is_read_is_no_finding(small_bench, monkeypatch) -> None:
    import signal

    from drives.canopen_drive import CanopenDrive

    check_mode = CanopenDrive.check_mode

    def pressing(drive, mode) -> None:
        signal.raise_signal(signal.SIGINT)
        check_mode(drive, mode)

    monkeypatch.setattr(CanopenDrive, "check_mode", pressing)
    outcome = small_bench.command("check", small_bench.profile)
    assert outcome.code == 130, outcome.out
    assert "stopped by the user" in outcome.err


def test_a_check_can_be_traced(small_bench) -> None:
    trace = small_bench.folder / "check.asc"
    outcome = small_bench.command("check", small_bench.profile, "--move", "--trace-file", trace)
    assert outcome.code == 0
    syncs = sum(m.arbitration_id == 0x80 for m in can.LogReader(trace))
    assert syncs == small_bench.machine.sync_count > 500


def test_what_the_table_says_in_words(small_bench) -> None:
    outcome = small_bench.command("check", small_bench.profile, "--move")
    assert outcome.code == 0
    assert "bench: 23 passed." in " ".join(outcome.out.split())
    travel = math.radians(240)
    assert f"{0.02 * travel:.3g} rad commanded" in " ".join(outcome.out.split())
