"""New parameters through the bus: tried on the machine, kept or taken back, and told."""

import inspect
import json
import os
import re
import signal
import struct
import time
from contextlib import nullcontext

import numpy as np
import pytest
import yaml

from drives.api import Alarm
from drives.canopen_drive.motion import CanopenMotion
from drives.errors import NotVerifiedError, OscillationError
from drives.sim.faults import EncoderStuck, Fault, MotorReversed
from drives.sim.firmware import Parameter
from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.verification import steps
from fieldtool.experiment.verification.oscillation import OscillationWatch
from fieldtool.experiment.verification.steps import Steps
from fieldtool.experiment.verification.watch import TrialWatch
from fieldtool.records.recording import load
from fieldtool.records.session_folder import SessionFolder
from fieldtool.workflow import verifying
from fieldtool.workflow.rescued import rescue
from tests.session.test_stopped_by_user import Pressed
from tests.session.test_trial import Gains
from tests.tunings import GOOD, begun, scale_model, write_tuning
from tests.untried import Stood

TABLE, ARM = 11, 12
VELOCITY_P, VELOCITY_I, POSITION_P = (0x2010, 2), (0x2010, 3), (0x2010, 1)


@pytest.fixture
def session(bench):
    """A session folder with a good tuning and the true model."""
    return begun(bench)


def write(bench, *options):
    return bench.command("write", bench.out, "--yes", *options)


def verification(bench):
    return yaml.safe_load((bench.out / "verification.yaml").read_text())


class AfterWrite:
    """Brings a fault about as soon as the drives were written and read back: behind the tool's back."""

    def __init__(self, bench, monkeypatch, fault):
        from fieldtool.workflow.verifying import Verification

        prove = Verification.prove

        def spoiled(one):
            bench.inject(fault)
            try:
                prove(one)
            finally:
                bench.machine.lift(fault)

        monkeypatch.setattr(Verification, "prove", spoiled)


def test_good_parameters_are_tried_kept_and_compared_on_one_scale(session):
    outcome = write(session)
    assert outcome.code == 0, outcome.err
    assert "The new parameters stand their trial." in " ".join(
        outcome.err.split() + outcome.out.split()
    )
    assert set(session.changed()[TABLE]) <= {"0x2010:01", "0x2010:02", "0x2010:03", "0x2010:04"}
    assert session.powered() == {}
    found = verification(session)
    assert found["format"] == "fieldtool-verification/1"
    assert found["verdict"] == "verified"
    assert found["model"] == "identified"
    for axis in found["axes"]:
        before, predicted, after = (axis[k] for k in ("before", "predicted", "after"))
        assert after["settling_time"] <= 1.05 * before["settling_time"] + 0.003
        assert after["sensitivity_peak"] == pytest.approx(predicted["sensitivity_peak"], rel=0.05)
        assert after["settling_time"] == pytest.approx(
            predicted["settling_time"], rel=0.1, abs=0.005
        )
        assert after["overshoot"] == pytest.approx(
            predicted["overshoot"], rel=0.1, abs=0.02 * axis["move"]["band"]
        )
        assert after["vibration"] == pytest.approx(
            predicted["vibration"], rel=0.2, abs=0.05 * axis["move"]["band"]
        )
        curves = axis["sensitivity"]
        seen, expected = (np.array(curves[k]["response"]) for k in ("after", "predicted"))
        assert np.median(np.abs(seen - expected)) < 0.05
        assert np.median(np.abs(np.array(curves["before"]["response"]) - expected)) > 0.05
        old, new = (axis["step"][k] for k in ("before", "predicted"))
        assert old["position"][0] == pytest.approx(0.0, abs=0.02)
        assert new["position"][-1] == pytest.approx(1.0, abs=0.02)
        assert min(old["rise_time"], new["rise_time"]) > 0
    raw = load(session.out / "verification.h5")
    assert [e.name.split(": ")[0] for e in raw.experiments] == ["before"] * 3 + ["after"] * 3
    assert (session.out / "verification.png").stat().st_size > 10_000


def test_an_axis_that_begins_to_move_before_its_trial_says_that_nothing_was_written(
    session, monkeypatch
):
    asked = []

    def wait(group):
        asked.append(group)
        if len(asked) > 1:
            raise PlanRefusedError("table: moves although its drive is disabled.")

    monkeypatch.setattr(verifying, "wait_for_standstill", wait)
    outcome = write(session)
    assert outcome.code == 3
    assert "table: moves although its drive is disabled." in outcome.err
    assert "That was before the write: nothing was written." in outcome.err
    assert session.changed() == {}
    assert session.powered() == {}


def test_what_was_written_is_stored_by_the_commands_that_are_named(session):
    """And compared with what was there before, not with itself."""
    said = " ".join(write(session).out.split())
    commands = r"`fieldtool (restore [^`]*)`, then `fieldtool (write [^`]*)`"
    named = re.search(rf"To keep them: {commands}, which tries them once more", said)
    assert named is not None, said
    new, was = session.objects()[TABLE][VELOCITY_P], session.before[TABLE][VELOCITY_P]
    assert new != was
    found = verification(session)
    session.listen()
    itself = write(session, "--store")
    assert itself.code == 3, itself.err
    again = re.search(rf"compare them with themselves.* old ones: {commands}", itself.err)
    assert again is not None, itself.err
    assert again.groups() == named.groups()
    assert not [f for f in session.heard() if f.cob_id == 0x80], "no SYNC: nothing moved"
    assert verification(session) == found
    assert session.command(*named[1].split()).code == 0
    stored = session.command(*named[2].split(), "--yes")
    assert stored.code == 0, stored.err
    assert {one["before"] for one in verification(session)["parameters"]} == {
        one["before"] for one in found["parameters"]
    }
    for node in session.machine.nodes:
        node.power_cycle()
    assert session.objects()[TABLE][VELOCITY_P] == new
    assert session.command("restore", session.out, "--store").code == 0
    assert session.objects()[TABLE][VELOCITY_P] == was


def test_where_what_was_written_swings_the_way_back_is_named(session, monkeypatch):
    """In the trial of the old parameters, which an earlier write has brought."""

    def swings(*_, **__):
        raise OscillationError("table: swings")

    monkeypatch.setattr(verifying.Verification, "_run", swings)
    way_back = f"`fieldtool restore {session.out}` brings that back"
    assert way_back not in " ".join(write(session).err.split())
    assert write(session, "--no-verify").code == 0
    faster = {axis: {**own, "velocity_p": 1.1 * own["velocity_p"]} for axis, own in GOOD.items()}
    write_tuning(session, faster)
    outcome = write(session)
    assert outcome.code == 4, outcome.err
    assert way_back in " ".join(outcome.err.split())


def test_what_a_trial_could_not_see_is_on_the_screen_too(session, monkeypatch):
    from fieldtool.workflow.trial_records import TrialRecords

    note = "table: dry friction holds it in the small excitation."
    monkeypatch.setattr(TrialRecords, "notes", lambda *_: (note,))
    outcome = write(session)
    assert outcome.code == 0, outcome.err
    assert note in verification(session)["notes"]
    _, table, after = outcome.out.partition("sensitivity peak")
    assert table
    assert " ".join(after.split()).count(note) == 1


def test_dry_friction_in_the_model_is_reckoned_with_in_the_trial(make_bench, profile_of_two):
    """It rules settling, and hides the loop from a small excitation: both are predicted."""
    share = 0.05
    for axis, simulated in zip(
        profile_of_two["axes"], profile_of_two["simulation"]["axes"], strict=True
    ):
        torque = share * float(str(axis["limits"]["torque"]).split()[0])
        simulated["effects"] = [
            {"effect": "coulomb_friction", "location": "motor", "torque": torque}
        ]
    bench = begun(make_bench(profile_of_two))
    path = bench.out / "model.yaml"
    model = yaml.safe_load(path.read_text())
    model["effects"] = [one for one in model["effects"] if one["effect"] != "coulomb_friction"] + [
        {"effect": "coulomb_friction", "axis": axis["name"], "location": "motor",
         "parameters": {"torque": simulated["effects"][0]["torque"]}}
        for axis, simulated in zip(
            profile_of_two["axes"], profile_of_two["simulation"]["axes"], strict=True
        )
    ]  # fmt: skip
    path.write_text(yaml.safe_dump(model))
    outcome = write(bench)
    assert outcome.code == 0, outcome.err
    found = verification(bench)
    assert found["verdict"] == "verified"
    for axis in found["axes"]:
        predicted, after = axis["predicted"], axis["after"]
        assert after["sensitivity_peak"] == pytest.approx(predicted["sensitivity_peak"], rel=0.2)
        assert after["settling_time"] == pytest.approx(
            predicted["settling_time"], rel=0.15, abs=3 * found["cycle"] + 0.01
        )
    # without it in the model, the same machine is not what was predicted
    model["effects"] = [one for one in model["effects"] if one["effect"] != "coulomb_friction"]
    path.write_text(yaml.safe_dump(model))
    assert bench.command("restore", bench.out).code == 0
    outcome = write(bench)
    assert outcome.code == 6, outcome.err
    assert "was predicted" in outcome.err or "off the predicted one" in outcome.err


def test_only_what_was_tried_is_stored(session):
    outcome = write(session, "--store", "--no-verify")
    assert outcome.code == 2
    assert "tried on the machine" in outcome.err
    assert session.changed() == {}
    outcome = write(session, "--store")
    assert outcome.code == 0, outcome.err
    for node in session.machine.nodes:
        node.power_cycle()
    assert "0x2010:02" in session.changed()[TABLE], "it survived the power cycle"


def test_untried_parameters_are_said_to_be_so(session):
    outcome = write(session, "--no-verify")
    assert outcome.code == 0, outcome.err
    assert "were not tried" in " ".join((outcome.out + outcome.err).split())
    assert "--store`, which tries them." in " ".join(outcome.out.split())
    assert not (session.out / "verification.yaml").exists()


DISASTERS = {
    "gains 100 times too high in the drive": Gains(TABLE, 100.0),
    "gains 10 times too high in the drive": Gains(TABLE, 10.0),
    "gains 10 times too high in the other drive": Gains(ARM, 10.0),
    "position and integral gain too high": Gains(
        TABLE, 20.0, (Parameter.POSITION_P, Parameter.VELOCITY_I)
    ),
    "wrong sign": MotorReversed(ARM),
    "encoder does not count": EncoderStuck(TABLE),
}


@pytest.mark.parametrize("what", DISASTERS)
def test_a_disaster_behind_the_tools_back_is_caught_and_restored(session, monkeypatch, what):
    AfterWrite(session, monkeypatch, DISASTERS[what])
    outcome = write(session, "--store")
    assert outcome.code == 6, outcome.err
    assert "do not stand their trial" in outcome.err
    assert "all parameters were restored and read back" in outcome.err
    assert session.powered() == {}
    assert session.changed() == {}
    assert session.stored() == {TABLE: {}, ARM: {}}, "nothing was stored"
    found = verification(session)
    assert found["verdict"] == "restored"
    assert found["reasons"]


@pytest.mark.parametrize(
    ("fault", "words", "way"),
    [
        (Gains(ARM, 10.0), "what acts in the drive is not what was written", 1.5e-3),
        (Gains(TABLE, 10.0), "what acts in the drive is not what was written", 1.5e-3),
        (Gains(ARM, 0.1), "its feedback is 0.", 0.01),
        (Gains(TABLE, 10.0, (Parameter.INERTIA_FF,)), "do not stand their trial", 1.5e-3),
        (MotorReversed(TABLE), "against its own torque", 1.5e-3),
    ],
)
def test_what_is_not_as_written_is_stopped_at_some_counts(session, monkeypatch, fault, words, way):
    """Before the nudge, which goes ten times as far, or in its beginning: it goes 0.0167 rad."""
    forward = {axis: {**own, "inertia_ff": 0.05} for axis, own in GOOD.items()}
    write_tuning(session, forward)
    AfterWrite(session, monkeypatch, fault)
    ways = Ways(session, monkeypatch)
    outcome = write(session)
    assert outcome.code == 6, outcome.err
    assert words in " ".join(outcome.err.split())
    assert ways.largest() < way
    assert session.changed() == {}


class Ways:
    """Hears how far each drive's position goes while the new parameters are tried, rad."""

    def __init__(self, bench, monkeypatch):
        from fieldtool.workflow.verifying import Verification

        self._heard = {}
        prove = Verification.prove

        def noted(one):
            self._heard.clear()
            prove(one)

        monkeypatch.setattr(Verification, "prove", noted)
        bench.machine.listen(self)

    def __call__(self, _time, cob_id, data):
        if 0x180 < cob_id < 0x200 and len(data) == 8:
            _, position, _ = struct.unpack("<Hih", data)
            self._heard.setdefault(cob_id, []).append(position)

    def largest(self):
        return max(np.ptp(one) for one in self._heard.values()) * 2 * np.pi / 2**20


def test_gains_that_nobody_can_read_are_said_not_to_be_watched(session, monkeypatch):
    from fieldtool.workflow import trial_loops

    monkeypatch.setattr(trial_loops, "_why_not_told", lambda _: "velocity_p can not be read")
    outcome = write(session)
    assert outcome.code == 0, outcome.err
    said = " ".join((outcome.err + outcome.out).split())
    assert "table: whether the controller in its drive is the one that was written can not" in said


@pytest.mark.parametrize(
    ("factor", "names"),
    [(10.0, ("velocity_p",)), (10.0, ("velocity_p", "velocity_i")), (10.0, ("position_p",))],
)
def test_a_tuning_ten_times_too_high_never_stays(session, factor, names):
    wrong = {axis: dict(own) for axis, own in GOOD.items()}
    for name in names:
        wrong["table"][name] *= factor
    write_tuning(session, wrong, GOOD)
    outcome = write(session)
    assert outcome.code in (3, 6), outcome.err
    assert session.changed() == {}
    assert session.powered() == {}


def test_an_encoder_too_coarse_for_its_feed_forward_is_said_before_anything_moves(session):
    write_tuning(session, {**GOOD, "table": {**GOOD["table"], "inertia_ff": 5.0}})
    ways = Heard(session)
    outcome = write(session)
    assert outcome.code == 3, outcome.err
    said = " ".join(outcome.err.split())
    assert "table: with the new parameters one count of its encoder" in said
    assert "Nothing was moved or written" in said
    assert not ways.enabled
    assert session.changed() == {}


class Heard:
    """Hears whether any drive is enabled."""

    def __init__(self, bench):
        self.enabled = False
        bench.machine.listen(self)

    def __call__(self, _time, cob_id, data):
        if 0x180 < cob_id < 0x200 and len(data) == 8:
            self.enabled = self.enabled or struct.unpack("<Hih", data)[0] & 0x6F == 0x27


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_model_wrong_by_two_is_told_by_the_machine(session, factor):
    """What it predicts is not what is measured."""
    scale_model(session.out / "model.yaml", factor)
    outcome = write(session)
    assert outcome.code in (3, 4, 6), outcome.err
    assert session.changed() == {}
    if outcome.code == 6:
        assert "predicted" in outcome.err


def test_parameters_that_are_slower_than_the_old_ones_by_the_model_are_not_tried(session):
    gentle = {"position_p": 3.0, "velocity_p": 1.2, "velocity_i": 1.0, "velocity_ff": 0.0}
    slow = {axis: {**own, **gentle} for axis, own in GOOD.items()}
    write_tuning(session, slow)
    ways = Heard(session)
    outcome = write(session)
    assert outcome.code == 3, outcome.err
    assert "would settle in" in outcome.err
    assert "with those that are in the drives" in " ".join(outcome.err.split())
    assert not ways.enabled
    assert session.changed() == {}


def test_an_axis_that_oscillates_by_its_model_is_not_moved(make_bench, profile_of_two):
    gains = profile_of_two["simulation"]["axes"][0]["gains"]
    gains["position_p"], gains["velocity_i"] = 300.0, 160.0
    bench = make_bench(profile_of_two)
    bench.out.mkdir()
    (bench.out / "machine.yaml").write_text(bench.profile.read_text())
    write_tuning(bench, GOOD)
    ways = Heard(bench)
    outcome = bench.command("write", bench.out, "--yes")
    assert outcome.code == 3, outcome.err
    assert "in the drives now the machine is not stable" in " ".join(outcome.err.split())
    assert not ways.enabled
    assert bench.changed() == {}


def test_an_axis_that_oscillates_already_is_said_and_nothing_is_written(session, monkeypatch):
    """Its drive does not do what its parameters say: no model knows that."""
    from fieldtool.workflow.verifying import Verification

    present = Verification.before
    fault = Gains(TABLE, 30.0)

    def swinging(one):
        session.inject(fault)
        try:
            present(one)
        finally:
            session.machine.lift(fault)

    monkeypatch.setattr(Verification, "before", swinging)
    outcome = write(session)
    assert outcome.code == 4, outcome.err
    assert "table: oscillates at about" in outcome.err
    assert "in the drives now" in outcome.err
    assert session.changed() == {}
    assert session.powered() == {}


def test_nobody_is_asked_to_move_means_nothing_moves(session):
    session.listen()
    outcome = session.command("write", session.out)
    assert outcome.code == 3
    assert "nobody to ask" in " ".join((outcome.out + outcome.err).split())
    assert not [f for f in session.heard() if f.cob_id == 0x80], "no SYNC: nothing moved"
    assert session.changed() == {}


def test_a_stop_by_the_user_during_the_trial_restores_everything(session, monkeypatch):
    from fieldtool.cli.stop_key import StopKey
    from fieldtool.workflow.verifying import Verification

    begun = []
    prove = Verification.prove

    def noted(one):
        begun.append(True)
        prove(one)

    monkeypatch.setattr(Verification, "prove", noted)
    asked = []

    def pressed(key):
        asked.append(bool(begun))
        return sum(asked) > 1500

    monkeypatch.setattr(StopKey, "__call__", pressed)
    outcome = write(session)
    assert outcome.code == 130, outcome.err
    assert session.changed() == {}
    assert session.powered() == {}
    assert verification(session)["verdict"] == "restored"


def test_a_loaded_axis_moves_away_from_the_end_of_its_travel(session):
    """The move goes where there is room, from where the axis stands."""
    profile = session.data
    profile["axes"][0]["limits"]["travel"] = ["-10 deg", "230 deg"]
    (session.out / "machine.yaml").write_text(yaml.safe_dump(profile))
    outcome = write(session)
    assert outcome.code == 0, outcome.err
    raw = load(session.out / "verification.h5")
    for experiment in raw.experiments:
        assert np.min(experiment.position[:, 0]) > np.radians(-10)


@pytest.mark.usefixtures("quick_plan")
def test_a_whole_run_has_the_verification_in_its_json(small_bench):
    outcome = small_bench.run("--json", "--write", "--yes")
    assert outcome.code == 0, outcome.err
    told = json.loads(outcome.out)
    assert (told["written"], told["stored"]) == (True, False)
    found = told["verification"]
    assert found["verdict"] == "verified"
    assert found["axes"][0]["after"]["sensitivity_peak"] < 2.1


@pytest.mark.parametrize("options", [(), ("--no-verify",)])
def test_a_write_has_the_verification_in_its_json(session, options):
    outcome = write(session, "--json", *options)
    assert outcome.code == 0, outcome.err
    told = json.loads(outcome.out)
    assert told["written"] is True
    assert told["verification"] == (None if options else verification(session))


@pytest.mark.parametrize("moment", ["judging", "after the last trial", "storing the second drive"])
def test_ctrl_c_after_the_last_motion_stores_nothing(session, monkeypatch, moment):
    """No cycle asks for a stop any more: the work in hand has to."""
    from drives.parameters.transaction import Transaction
    from fieldtool.workflow.verifying import Verification

    where, name = {
        "judging": (Verification, "_judge"),
        "after the last trial": (Verification, "_conclude"),
        "storing the second drive": (Transaction, "_store"),
    }[moment]
    happens, calls = getattr(where, name), []

    def pressed(*arguments):
        calls.append(arguments)
        if name != "_store" or len(calls) == 2:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)  # who is afraid presses again
        return happens(*arguments)

    monkeypatch.setattr(where, name, pressed)
    outcome = write(session, "--store")
    assert calls
    assert outcome.code == 130, outcome.err
    assert "All drives hold the old values" in outcome.err
    assert session.changed() == {}
    for node in session.machine.nodes:
        node.power_cycle()
    assert session.changed() == {}, "nothing new was left in non-volatile memory"
    if moment == "judging":
        assert verification(session)["verdict"] == "restored"


def test_what_can_not_be_measured_is_refused_before_anything_moves(session, monkeypatch):
    from fieldtool.errors import PlanRefusedError
    from fieldtool.workflow import trial_plan

    def refused(*_):
        raise PlanRefusedError("no lines fit.")

    monkeypatch.setattr(trial_plan, "sensitivity_plan", refused)
    ways = Heard(session)
    outcome = write(session, "--store")
    assert outcome.code == 3, outcome.err
    said = " ".join(outcome.err.split())
    assert "the peak of sensitivity could not be measured: no lines fit." in said
    assert "Nothing was moved or written" in said
    assert not ways.enabled
    assert session.changed() == {}


def test_limits_that_leave_an_excitation_of_less_than_a_step_are_named(session):
    machine = session.out / "machine.yaml"
    machine.write_text(machine.read_text().replace("30 deg", "0.01 deg"))
    ways = Heard(session)
    outcome = write(session)
    assert outcome.code == 3, outcome.err
    said = " ".join(outcome.err.split())
    assert "could not be measured" in said
    assert "its drive takes it in steps of" in said
    assert "following_error" in said
    assert not ways.enabled
    assert session.changed() == {}


@pytest.mark.parametrize("where", ["picture", "conclusion", "storing"])
def test_verified_is_on_the_disk_only_if_the_drives_hold_the_new_values(
    session, monkeypatch, where
):
    from drives.parameters.transaction import Transaction
    from fieldtool.cli.screen import TerminalScreen
    from fieldtool.workflow import verifying

    def broken(*_):
        raise ValueError("broken on purpose")

    places = {
        "picture": (verifying, "draw_verification"),
        "conclusion": (TerminalScreen, "verified"),
        "storing": (Transaction, "_store"),
    }
    monkeypatch.setattr(*places[where], broken)
    outcome = None
    with nullcontext() if where == "picture" else pytest.raises(AssertionError, match="defect"):
        outcome = write(session, "--store")  # the bench lets no defect pass
    verdict = verification(session)["verdict"]
    if where == "picture":
        assert outcome.code == 0, outcome.err
        assert "broken on purpose" in " ".join((outcome.out + outcome.err).split())
        assert verdict == "verified"
        assert "0x2010:02" in session.changed()[TABLE]
    else:
        # What is broken in storing is so on the way back, too.
        assert verdict == ("mixed" if where == "storing" else "restored")
        assert session.changed() == {}
        page = session.command("report", session.out)
        assert page.code == 0, page.err
        text = (session.out / "report.html").read_text()
        assert "stood their trial" not in text


def test_ctrl_c_when_the_write_has_ended_leaves_its_verdict(session, monkeypatch):
    """The drives hold the new values, stored: that is what the file says."""
    from drives.parameters.transaction import Transaction

    happens, calls = Transaction._heed_stop, []

    def pressed(transaction):
        calls.append(transaction.journal.state.value)
        if calls[-1] == "new":
            signal.raise_signal(signal.SIGINT)
        happens(transaction)

    monkeypatch.setattr(Transaction, "_heed_stop", pressed)
    outcome = write(session, "--store")
    assert calls[-1] == "new"
    assert outcome.code == 130, outcome.err
    assert "all drives hold the new values" in outcome.err
    assert "0x2010:02" in session.changed()[TABLE]
    assert verification(session)["verdict"] == "verified"


def test_ctrl_c_while_the_verdict_is_kept_loses_nothing(session, monkeypatch):
    """It ends the command all the same, which says where the new values are and what takes them back."""
    monkeypatch.setattr("fieldtool.cli.stop_key.ASKED_WITHIN", -1.0)
    write_yaml = verifying.write_yaml

    def pressed(*arguments):
        signal.raise_signal(signal.SIGINT)
        write_yaml(*arguments)

    monkeypatch.setattr(verifying, "write_yaml", pressed)
    outcome = write(session, "--store")
    assert outcome.code == 130, outcome.err
    said = " ".join(outcome.err.split())
    assert "The new parameters are in the drives and stored" in said
    assert f"`fieldtool restore {session.out} --store` takes them back" in said
    assert verification(session)["verdict"] == "verified"
    assert (session.out / "verification.png").stat().st_size > 0
    assert session.command("restore", session.out, "--store").code == 0
    assert session.changed() == {}


def test_ctrl_c_in_the_trial_of_the_old_parameters_says_that_nothing_was_written(session):
    session.inject(Pressed(TABLE), 500)
    outcome = write(session)
    assert outcome.code == 130
    assert "nothing was written" in " ".join(outcome.err.split())
    assert session.changed() == {}
    assert session.powered() == {}


class Interrupted(Stood):
    """The user presses Ctrl-C while the verdict is being kept."""

    kept = None

    def ended(self, error, held):
        signal.raise_signal(signal.SIGINT)
        Interrupted.kept = type(error).__name__, held.value


@pytest.mark.parametrize("late", [False, True])
def test_ctrl_c_as_the_write_has_ended_waits_for_the_folder(session, monkeypatch, late):
    """``late``: so long after the last question for it that nothing asks any more."""
    if late:
        monkeypatch.setattr("fieldtool.cli.stop_key.ASKED_WITHIN", -1.0)
    monkeypatch.setattr("fieldtool.workflow.writing.Verification", Interrupted)
    outcome = write(session)
    assert outcome.code == 130, outcome.err
    assert Interrupted.kept == ("NoneType", "new")
    said = " ".join(outcome.err.split())
    assert "working memory only" in said
    assert f"`fieldtool restore {session.out}` takes them back" in said
    assert '"written": true' in (session.out / "events.jsonl").read_text()
    assert "0x2010:02" in session.changed()[TABLE]


def test_ctrl_c_after_a_failed_trial_does_not_hide_why_it_failed(session, monkeypatch):
    def failing(_one):
        raise NotVerifiedError("broken on purpose")

    monkeypatch.setattr("fieldtool.cli.stop_key.ASKED_WITHIN", -1.0)
    monkeypatch.setattr(Interrupted, "prove", failing)
    monkeypatch.setattr("fieldtool.workflow.writing.Verification", Interrupted)
    outcome = write(session)
    assert outcome.code == 6, outcome.err
    assert Interrupted.kept == ("WriteBackError", "old")
    assert "broken on purpose" in outcome.err
    assert "takes them back" not in outcome.err
    assert session.changed() == {}


def test_a_verdict_is_not_of_values_that_were_written_later_without_a_trial(session):
    assert write(session).code == 0
    assert verification(session)["verdict"] == "verified"
    softer = {axis: {**own, "position_p": 10.0} for axis, own in GOOD.items()}
    write_tuning(session, softer)
    assert write(session, "--no-verify").code == 0
    assert not (session.out / "verification.yaml").exists()


def test_an_axis_that_creeps_after_the_write_takes_it_back(session, monkeypatch):
    """Refused before its trial moves anything, but after the write: exit code 6, not 3."""
    wait = verifying.wait_for_standstill

    def creeping(group):
        if "prove" in {frame.function for frame in inspect.stack()}:
            raise PlanRefusedError("table: moves although its drive is disabled.")
        wait(group)

    monkeypatch.setattr(verifying, "wait_for_standstill", creeping)
    outcome = write(session)
    assert outcome.code == 6, outcome.err
    assert "moves although its drive is disabled" in outcome.err
    assert session.changed() == {}
    assert session.powered() == {}
    assert verification(session)["verdict"] == "restored"


class Killed(Fault):
    """Ends this whole program, as a power cut of its computer does."""

    def set(self, machine, *, present):
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a process that can be killed")
def test_what_axes_did_in_a_trial_outlives_a_kill(session):
    """It is rescued into the trial's own file, and not into the measurement."""
    session.inject(Killed(TABLE), sync=session.machine.sync_count + 5200)
    child = os.fork()
    if child == 0:
        try:
            write(session)
        finally:
            os._exit(1)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status)
    assert os.WTERMSIG(status) == signal.SIGKILL
    path, rows = session.out / "verification.h5", session.out / "verification-cut-off.rows"
    assert load(path).experiments == ()
    deadline, size = time.monotonic() + 10.0, -1
    while rows.stat().st_size != size:  # another process copies what the killed one left
        size = rows.stat().st_size
        assert time.monotonic() < deadline
        time.sleep(0.3)
    said = []
    rescue(SessionFolder(session.out), said.append)
    assert len(said) == 1
    assert "verification.h5" in said[0]
    found = load(path).experiments
    assert sum(one.samples for one in found) > 4000
    assert not any(one.complete for one in found)
    assert np.ptp(found[-1].position_reference[:, 0]) > 0.3, "it was killed in the table's move"
    assert not rows.exists()
    assert not (session.out / "recording.h5").exists()


def with_bound(session, bound):
    path = session.out / "tuning.yaml"
    path.write_text(path.read_text() + f"bound: {bound}\n")


@pytest.mark.parametrize("bound", [3.01, 1000, 1e300])
def test_a_bound_that_leaves_no_margin_is_refused(session, bound):
    with_bound(session, bound)
    outcome = write(session)
    assert outcome.code == 2
    assert "bound" in outcome.err
    assert "3" in outcome.err
    assert session.changed() == {}


def test_a_bound_above_the_usual_one_is_said_and_never_stored(session):
    with_bound(session, 2.5)
    session.listen()
    outcome = write(session, "--store")
    assert outcome.code == 3, outcome.err
    assert "2.5, above 2" in outcome.err
    told = session.command("write", session.out)  # nobody answers: nothing is tried
    assert "CAREFUL" in " ".join((told.out + told.err).split())
    assert not [f for f in session.heard() if f.cob_id == 0x80], "no SYNC: nothing moved"
    assert session.changed() == {}
    untried = write(session, "--no-verify")
    assert untried.code == 0, untried.err
    assert "working memory only" in " ".join(untried.out.split())
    assert "--store" not in untried.out


def test_another_machines_model_foretells_nothing(session):
    path = session.out / "model.yaml"
    model = yaml.safe_load(path.read_text())
    model["axes"].reverse()
    path.write_text(yaml.safe_dump(model))
    session.listen()
    outcome = write(session)
    assert outcome.code == 2, outcome.err
    assert "model.yaml: has the axes arm (rotary), table (rotary), the machine" in outcome.err
    assert not [f for f in session.heard() if f.cob_id == 0x80], "no SYNC: nothing moved"
    assert session.changed() == {}


def test_without_an_identified_model_nothing_is_stored(session):
    (session.out / "model.yaml").unlink()
    session.listen()
    outcome = write(session, "--store")
    assert outcome.code == 3, outcome.err
    assert "no identified model" in outcome.err
    assert not [f for f in session.heard() if f.cob_id == 0x80], "no SYNC: nothing moved"
    assert session.changed() == {}
    assert session.stored() == {TABLE: {}, ARM: {}}


MIDDLE = 8
"""Slice of a move at which its axis is quick."""


class StandsStill:
    """The host stands still in the middle of the first moves of so many trials, after some others."""

    def __init__(self, bench, monkeypatch, seconds, trials, after, at=MIDDLE, what="move"):
        self.left, self.begun = trials, 0
        stream, cut = Steps._stream, steps.slices

        def noted(one, path, k, name, **more):
            self.clock = one._motion._line.clock
            self.now = f"{what} of table" in name
            self.begun += self.now
            return stream(one, path, k, name, **more)

        def cut_and_wait(targets, cycle_time, turns=()):
            source, asked = cut(targets, cycle_time, turns), iter(range(len(targets)))

            def late(before):
                if self.now and self.left and self.begun > after and next(asked) == at:
                    self.left -= 1
                    self.clock.wait_until(self.clock.now() + seconds)
                return source(before)

            return late

        monkeypatch.setattr(Steps, "_stream", noted)
        monkeypatch.setattr(steps, "slices", cut_and_wait)


@pytest.fixture
def patient(make_bench, profile_of_two):
    """A session on a machine whose drives may miss the host for longer."""
    profile_of_two["bus"]["host_lost_after"] = "800 ms"
    return begun(make_bench(profile_of_two))


def test_a_trial_that_a_late_host_spoiled_is_begun_again(patient, monkeypatch):
    late = StandsStill(patient, monkeypatch, 0.14, 1, 0)
    outcome = write(patient)
    assert outcome.code == 0, outcome.err
    said = " ".join(outcome.out.split())
    assert "this computer stood still for 140 ms; a cycle may begin 10 ms late at most" in said
    assert "the trial is begun again, 2 times at most" in said
    assert late.begun == 3
    assert verification(patient)["verdict"] == "verified"
    raw = load(patient.out / "verification.h5")
    cut = [e for e in raw.experiments if not e.complete]
    assert [e.name for e in cut] == ["before: move of table"]
    assert np.ptp(cut[0].position[:, 0]) > 0.1, "it was cut in motion"
    assert sum(e.name.startswith("before, begun again (1): ") for e in raw.experiments) == 3
    assert patient.powered() == {}


def test_a_host_that_is_late_again_and_again_ends_the_trial(patient, monkeypatch):
    late = StandsStill(patient, monkeypatch, 0.14, 9, 0)
    outcome = write(patient)
    assert outcome.code == 4, outcome.err
    assert "stood still for 140 ms" in outcome.err
    assert late.begun == 3
    assert patient.powered() == {}
    assert patient.changed() == {}


def test_new_parameters_are_not_tried_from_another_place(patient, monkeypatch):
    """Torques at rest are known where the old trial began: elsewhere a weight would be a wrong motor."""
    late = StandsStill(patient, monkeypatch, 0.14, 1, 1)
    outcome = write(patient)
    assert outcome.code == 6, outcome.err
    said = " ".join(outcome.err.split())
    assert "stood still for 140 ms" in said
    assert re.search(r"could not be begun again: \S*table\S* .*is not where it began", said), said
    assert late.begun == 2
    assert verification(patient)["verdict"] == "restored"
    assert patient.powered() == {}
    assert patient.changed() == {}


@pytest.fixture
def swings_when_late(monkeypatch):
    """An axis that swings soon after the host was late: the watch for it says so."""
    take, watched = OscillationWatch.take, TrialWatch.take
    since = [np.inf]

    def looked(one, *sample, late, **more):
        since[0] = 0 if late > 0.005 else since[0] + 1
        return watched(one, *sample, late=late, **more)

    def swung(one, *sample):
        alarm = take(one, *sample)
        return Alarm("table: swings.", "table", frozenset({"table"})) if since[0] == 5 else alarm

    monkeypatch.setattr(TrialWatch, "take", looked)
    monkeypatch.setattr(OscillationWatch, "take", swung)


def test_a_swing_after_a_late_cycle_is_no_word_on_the_old_loops(
    patient, monkeypatch, swings_when_late
):
    late = StandsStill(patient, monkeypatch, 0.008, 1, 0, at=1)
    outcome = write(patient)
    assert outcome.code == 0, outcome.err
    said = " ".join(outcome.out.split())
    assert "table: swings. Shortly before, this computer was 8 ms late in the move: that" in said
    assert "alone may have done it, and the trial is begun again." in said
    assert late.begun == 3
    assert verification(patient)["verdict"] == "verified"


def test_after_a_swing_new_loops_are_not_tried_again_however_late_the_host_was(
    patient, monkeypatch, swings_when_late
):
    late = StandsStill(patient, monkeypatch, 0.008, 1, 1)
    outcome = write(patient)
    assert outcome.code == 6, outcome.err
    said = " ".join(outcome.err.split())
    assert re.search(r"table: (swings|its torque went)", said)
    assert "Shortly before, this computer was 8 ms late in the move: that alone may" in said
    assert "Close other programs, and write again." in said
    assert late.begun == 2
    assert patient.powered() == {}
    assert patient.changed() == {}


def test_new_parameters_are_tried_again_within_a_nudge_of_where_they_began(patient, monkeypatch):
    late = StandsStill(patient, monkeypatch, 0.14, 1, 1, at=3, what="nudge")
    outcome = write(patient)
    assert outcome.code == 0, outcome.err
    assert "the trial is begun again, 2 times at most" in " ".join(outcome.out.split())
    assert late.begun == 3
    cut = [e for e in load(patient.out / "verification.h5").experiments if not e.complete]
    assert [e.name for e in cut] == ["after: nudge of table"]
    assert verification(patient)["verdict"] == "verified"


def planned_again(monkeypatch, again):
    """Give what plans a trial; the second one is planned by ``again``.  Return what was planned."""
    plans, plan = [], verifying.plan_trial

    def planned(group, *given):
        plans.append((again if plans else plan)(group, *given))
        return plans[-1]

    monkeypatch.setattr(verifying, "plan_trial", planned)
    return plans


def test_a_trial_without_room_is_begun_again_by_other_moves(patient, monkeypatch):
    """The old parameters' trial: where its move was cut off, the way is planned from there."""
    texts = iter(["table stands at 2 rad."])
    monkeypatch.setattr(verifying, "no_room", lambda *_: next(texts, ""))
    plans = planned_again(monkeypatch, verifying.plan_trial)
    late = StandsStill(patient, monkeypatch, 0.14, 1, 0)
    outcome = write(patient)
    assert outcome.code == 0, outcome.err
    assert late.begun == 3
    first, second = ([move.start for move in plan.moves] for plan in plans)
    assert first[0] != pytest.approx(second[0], abs=0.05), "from where it stands"
    raw = load(patient.out / "verification.h5")
    moved = [e for e in raw.experiments if "move of table" in e.name and e.complete]
    assert len(moved) == 2
    for one in moved:
        assert one.position_reference[0, 0] == pytest.approx(second[0], abs=0.02)
    assert verification(patient)["verdict"] == "verified"


def test_a_trial_without_any_room_is_not_begun_again(patient, monkeypatch):
    def refused(*_):
        raise PlanRefusedError("table has no room to move.")

    monkeypatch.setattr(verifying, "no_room", lambda *_: "table stands at 2 rad.")
    planned_again(monkeypatch, refused)
    late = StandsStill(patient, monkeypatch, 0.14, 1, 0)
    outcome = write(patient)
    assert outcome.code == 4
    assert "could not be begun again: table stands at 2 rad." in " ".join(outcome.err.split())
    assert late.begun == 1
    assert patient.changed() == {}


def test_a_stop_while_axes_are_stopped_for_a_late_host_begins_nothing_again(patient, monkeypatch):
    """Ctrl-C in the quick stop acts afterwards, though an error is on its way."""
    late = StandsStill(patient, monkeypatch, 0.14, 1, 0)
    quick_stop = CanopenMotion._quick_stop

    def pressed(motion, cut):
        quick_stop(motion, cut)
        if not late.left:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(CanopenMotion, "_quick_stop", pressed)
    outcome = write(patient)
    assert outcome.code == 130
    assert "stopped by the user" in outcome.err
    assert late.begun == 1
    assert patient.powered() == {}
    assert patient.changed() == {}


def test_a_stop_while_axes_are_waited_for_begins_nothing_again(patient, monkeypatch):
    late = StandsStill(patient, monkeypatch, 0.14, 1, 0)
    wait = verifying.wait_for_standstill

    def pressed(group):
        if late.begun and not late.left:
            signal.raise_signal(signal.SIGINT)
        wait(group)

    monkeypatch.setattr(verifying, "wait_for_standstill", pressed)
    outcome = write(patient)
    assert outcome.code == 130, outcome.err
    assert "stopped by the user" in outcome.err
    assert late.begun == 1
    assert patient.powered() == {}
    assert patient.changed() == {}


def test_a_move_with_a_late_cycle_while_axes_rest_is_made_once_more(patient, monkeypatch):
    late = StandsStill(patient, monkeypatch, 0.04, 1, 0)
    monkeypatch.setattr(f"{__name__}.MIDDLE", 80)
    outcome = write(patient)
    assert outcome.code == 0, outcome.err
    assert late.left == 0
    assert late.begun == 3
    names = [e.name for e in load(patient.out / "verification.h5").experiments if not e.complete]
    assert names == ["before: move of table"], "made once more"
