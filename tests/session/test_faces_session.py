"""Whole sessions on machines with makers' drives: what is found is what is there.

Two kinds of drives stand on one bus.  Masses and springs have to be those of the machine behind;
gains that are written have to arrive in the firmware, which converts by the makers' own formulas.
"""

from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest
import yaml

from drives.api import FloatArray
from drives.canopen_drive import connect
from drives.errors import DrivesError, NotSupportedError
from drives.parameters import back_up, planned_changes, save_backup
from drives.profile import MachineProfile
from drives.sim.faces.others import PASSWORD
from drives.sim.machine import simulated_machine
from drives.sim.servo_kernel import Parameter
from fieldtool import workflow
from fieldtool.design.tuning import AxisTuning, Tuning
from fieldtool.records.model import MachineModel
from fieldtool.workflow import Options, SessionResult
from fieldtool.workflow.twin import twin
from fieldtool.writeback.transaction import changes_for
from tests.faces import machine_of, simulated

pytestmark = pytest.mark.timeout(900)  # a busy computer plans and fits slowly
PAIRS = {
    "epos4": ("epos4", "copley+"),
    "novanta": ("novanta*", "epos4-dual-loop"),
    "own": ("own", "nanotec+"),
    "elmo": ("elmo-gold", "cia402*"),
}
"""Kinds of drives as ``tests.faces`` has them.  How each compares with the reference drive: benchmark
``faces``."""
WRITTEN = ("epos4", "novanta", "own")
CLOSE = {"epos4": 1e-3}
"""Relative; a PID with D on the error feeds the reference's velocity forward in steps, and how they are
sampled is not known but found from the data.  Else 3e-4: rounding and noise."""
ROUNDED = 5e-5
"""Rad.  At 3 Hz the axes lag by up to 0.15; half a unit of the coarsest gain is 2e-4 of its value, and
an encoder's count 6e-6."""
GAINS = ("position_p", "velocity_p", "velocity_i", "viscous_ff", "inertia_ff")


def numbers(model: MachineModel) -> dict[str, float]:
    """Masses, springs and couplings by name."""
    found = {}
    for axis in model.axes:
        found |= {f"{axis.name} mass {k}": m.value for k, m in enumerate(axis.masses)}
        found |= {f"{axis.name} spring {k}": s.value for k, s in enumerate(axis.springs)}
    found |= {"-".join(c.axes): c.value for c in model.couplings}
    return found


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """Each pair's session once, with what its firmware holds before and after a power cycle, and how
    the machine moves then."""
    done = {}

    def session(pair: str):
        if pair not in done:
            folder = tmp_path_factory.mktemp(pair)
            machine = machine_of(PAIRS[pair], folder)
            options = Options(write=pair in WRITTEN, store=pair in WRITTEN)
            with simulated(machine) as running:
                result = workflow.run(machine, folder / "one", options, confirm=lambda _: True)
                held = [settings(running, k) for k in range(2)]
                for node in running.nodes:
                    node.power_cycle()
                again = [settings(running, k) for k in range(2)]
                path = moved(machine) if pair in WRITTEN else None
            done[pair] = result, held, again, path, machine
        return done[pair]

    return session


def settings(running, axis: int) -> dict[str, float]:
    return {name: running.axes.get(axis, Parameter[name.upper()]) for name in GAINS}


def moved(machine: MachineProfile) -> FloatArray:
    """Return how far both axes have gone while they follow one path, (n, 2), rad."""
    with connect(machine) as group, group.motion(0.002) as motion:
        t = 0.002 * np.arange(1, 501)[:, None]
        start = motion.position
        blocks = iter([start + 0.1 * (1 - np.cos(2 * np.pi * np.array([2.0, 3.0]) * t))])
        return motion.stream(lambda _: next(blocks, None)).position - start


def by_reference_drives(kinds, tuning: Tuning, folder: Path, *, old: bool = False) -> FloatArray:
    """Return the same of reference drives with a tuning's gains, or those from before it."""
    gains = {
        axis.axis: {"velocity_ff": float(kind.startswith("epos4") and "dual" not in kind)}
        | ({} if old else axis.parameters)
        for axis, kind in zip(tuning.axes, kinds, strict=True)
    }
    place = folder / f"reference{old}"
    place.mkdir()
    against = [of.pop("viscous_ff", 0.0) for of in gains.values()]  # no object of theirs holds it
    machine = machine_of(("reference", "reference"), place, gains)
    with simulated(machine) as running:
        for axis, value in enumerate(against):
            running.axes.set(axis, Parameter.VISCOUS_FF, value)
        return moved(machine)


@pytest.mark.parametrize("pair", PAIRS)
def test_what_is_found_is_what_is_there(sessions, pair):
    result: SessionResult = sessions(pair)[0]
    assert result.truth is not None
    found, truth = numbers(result.model), numbers(result.truth)
    print({k: f"{found[k] / truth[k] - 1:+.2e}" for k in truth})
    assert found == pytest.approx(truth, rel=CLOSE.get(pair, 3e-4))


@pytest.mark.parametrize("pair", WRITTEN)
def test_what_is_written_acts_as_it_was_designed(sessions, pair):
    result, held, again, *_ = sessions(pair)
    for axis, firmware in zip(result.tuning.axes, held, strict=True):
        designed = {n: v for n, v in axis.parameters.items() if n in GAINS}
        assert set(designed) >= {"position_p", "velocity_p", "velocity_i"}
        assert {n: firmware[n] for n in designed} == pytest.approx(designed, rel=1e-3)
    assert result.write_back.stored
    for one, other in zip(held, again, strict=True):
        assert other == pytest.approx(one, rel=1e-12)  # it survived the power cycle


@pytest.mark.parametrize("pair", WRITTEN)
def test_what_is_read_back_is_what_acts(sessions, pair):
    """To the last digit of what a drive can hold; a PID's gains are under other names."""
    result, held, *_ = sessions(pair)
    by_axis = {"table": held[0], "arm": held[1]}
    checked = 0
    for written in result.write_back.written:
        firmware = by_axis[written.change.axis]
        if written.change.name in firmware:
            checked += 1
            assert firmware[written.change.name] == pytest.approx(written.read_back, rel=1e-6)
    assert checked >= 3


@pytest.mark.parametrize("pair", WRITTEN)
def test_the_machine_then_moves_as_with_reference_drives(sessions, pair, tmp_path):
    """The designed gains in two reference drives: the same path but for what a gain is rounded by."""
    result, _, _, path, _ = sessions(pair)
    kinds = PAIRS[pair]
    paths = [by_reference_drives(kinds, result.tuning, tmp_path, old=old) for old in (False, True)]
    apart, before = (np.abs(path - other).max(axis=0) for other in paths)
    print(pair, apart, before)
    assert (apart < ROUNDED).all()
    assert (before > 100 * ROUNDED).all()


def test_the_machine_of_a_session_simulated_again_has_the_same_drives(sessions, tmp_path):
    """Their files and gains; without an object for it, as much of the velocity is fed forward."""
    again = twin(sessions("own")[0].folder, tmp_path / "twin.yaml").profile
    one, other = simulated_machine(again), simulated_machine(sessions("own")[4])
    assert [d.face.name for d in one.drives] == ["own", "nanotec"]
    for drive, first in zip(one.drives, other.drives, strict=True):
        names = ("position_p", "velocity_p", "velocity_i", "velocity_ff", "velocity_filter")
        wanted = {name: first.gains[name] for name in names}
        assert {name: drive.gains[name] for name in names} == pytest.approx(wanted, rel=1e-4)


def test_gains_that_no_object_holds_are_designed_but_not_written(sessions):
    result, held, *_ = sessions("elmo")
    assert set(result.tuning.axes[0].parameters) == {"position_p", "velocity_p", "velocity_i"}
    assert not result.write_back.written
    assert any("only through its own language" in w for w in result.warnings)
    assert [one["position_p"] for one in held] == [15, 15]


@pytest.mark.parametrize(
    ("drive", "why"),
    [
        (
            "elmo-simpliq",
            "drive profile elmo-simpliq does not know how the drive's gains are written",
        ),
        ("cia402*", "drive profile cia402 knows no gains of this drive"),
        (
            "copley*",
            "velocity_p, object 0x60F9:01: drive profile copley does not know in which state",
        ),
        ("nanotec*", "drive profile nanotec has no parameter position_p, velocity_i, velocity_p"),
        ("prbt", "drive profile prbt has no parameter position_p, velocity_i, velocity_p"),
        ("schunk", "drive profile prbt has no parameter position_p, velocity_i, velocity_p"),
    ],
)
def test_gains_of_a_drive_whose_profile_does_not_tell_are_not_written(tmp_path, drive, why):
    machine = machine_of((drive, "reference"), tmp_path)
    gains = {"position_p": 10.0, "velocity_p": 1.0, "velocity_i": 5.0}
    tuning = Tuning((AxisTuning("table", gains, 1.5, ""),))
    with simulated(machine) as running:
        node = running.nodes[0]
        before = settings(running, 0), node.dictionary.parameters()
        with connect(machine, to_move=False) as group, pytest.raises(NotSupportedError) as refused:
            changes_for(group.drives, tuning)
        assert (settings(running, 0), node.dictionary.parameters()) == before
    print(refused.value)
    assert why in str(refused.value)


def test_writing_them_is_refused_and_touches_no_drive(tmp_path):
    machine = machine_of(("elmo-gold", "epos4-dual-loop"), tmp_path)
    gains = {"position_p": 10.0, "velocity_p": 1.0, "velocity_i": 5.0}
    tuning = Tuning(tuple(AxisTuning(n, gains, 1.5, "") for n in ("table", "arm")))
    with simulated(machine) as running:
        before = [settings(running, k) for k in range(2)]
        with connect(machine) as group, pytest.raises(NotSupportedError) as refused:
            changes_for(group.drives, tuning)
        assert [settings(running, k) for k in range(2)] == before
    assert str(refused.value) == (
        "table: the drive's gains are reached only through its own language, not through objects "
        "(drive profile elmo-gold). Enter position_p, velocity_p, velocity_i with the maker's "
        "software. Nothing was written."
    )


@pytest.mark.parametrize(
    ("drive", "sentence"),
    [
        (
            "prbt",
            "table: the drive has no mode cyclic position (8); 0x6502 is 0x00000043: profile position, "
            "velocity, interpolated position. This tool can not measure with it; nothing was moved.",
        ),
        (
            "schunk",
            "table: the drive has no mode cyclic position (8); 0x6502 is 0x00000043: profile position, "
            "velocity, interpolated position. This tool can not measure with it; nothing was moved.",
        ),
        (
            "elmo-simpliq",
            "table: the drive has no mode cyclic position (8); 0x6502 is 0x0000006D: profile position, "
            "profile velocity, profile torque, homing, interpolated position. This tool can not measure "
            "with it; nothing was moved.",
        ),
    ],
)
def test_a_drive_without_cyclic_modes_is_refused_before_motion(tmp_path, drive, sentence):
    machine = machine_of((drive, "reference"), tmp_path)
    with simulated(machine) as running, pytest.raises(DrivesError) as refused:
        workflow.run(machine, tmp_path / "one")
    assert str(refused.value) == sentence
    assert running.sync_count == 0


@pytest.mark.parametrize(
    ("drive", "change", "said"),
    [
        ("novanta", {}, "does not know what the drive's torque units are worth (`torque`)"),
        ("cia402*", {"eds": None}, "ships no EDS file. Give the drive's own EDS with `eds:`"),
        ("cia402*", {"loop": None}, "give them as `loop` at the axis in the machine profile"),
        ("nanotec*", {"torque_constant": None}, "Give the motor's `torque_constant` (N m/A)"),
        (
            "elmo-gold",
            {"encoder_counts_per_rev": None},
            "give `encoder_counts_per_rev` at the axis",
        ),
    ],
)
def test_what_is_not_known_is_asked_for_in_one_sentence(tmp_path, drive, change, said):
    machine = machine_of((drive, "reference"), tmp_path, table=change)
    with simulated(machine) as running, pytest.raises(DrivesError) as refused:
        workflow.run(machine, tmp_path / "one")
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)
    assert running.sync_count == 0


def test_profiles_of_the_simulated_machine_stand_beside_it(tmp_path):
    machine = machine_of(("novanta*", "reference"), tmp_path)
    assert Path(machine.axes[0].drive).parent == tmp_path


@pytest.mark.parametrize("drive", ["own", "copley+", "nanotec+"])
def test_a_backup_is_brought_back_and_stored(tmp_path, drive):
    machine = machine_of((drive, "reference"), tmp_path)
    path = tmp_path / "parameters-before.yaml"
    with simulated(machine) as running:
        node = running.nodes[0]
        first = settings(running, 0)
        with connect(machine, to_move=False) as group:
            group.drives[0].read_scaling()
            profile = group.drives[0].profile
            save_backup(back_up(machine.name, group.drives), path)
            gains = {name: 0.8 * first[name] for name in ("position_p", "velocity_p", "velocity_i")}
            for change in planned_changes(group.drives[0], gains):
                node.dictionary.write(*astuple(change.info.address), change.after_raw)
        for latch in profile.latches:
            node.dictionary.write(*astuple(latch.object), latch.set_bits)
        node.memory.save(node.dictionary)
        node.power_cycle()
        assert settings(running, 0) == pytest.approx(first | gains, rel=2e-3)
        workflow.restore(machine.path, path, store=True)
        assert settings(running, 0) == first
        node.power_cycle()
        assert settings(running, 0) == first
    backup = yaml.safe_load(path.read_text())["drives"][0]["objects"]
    addresses = {held["object"] for held in backup}
    assert {str(one.object) for one in profile.parameters.values()} <= addresses
    assert not addresses & {str(profile.store.object), str(profile.store.status)}


@pytest.mark.parametrize(
    ("drive", "name"),
    [
        ("elmo-gold", "elmo-gold"),
        ("elmo-simpliq", "elmo-simpliq"),
        ("prbt", "prbt"),
        ("schunk", "prbt"),
        ("cia402*", "cia402"),
        ("nanotec*", "nanotec"),
    ],
)
def test_a_drive_that_stores_in_no_known_way_is_not_told_to(tmp_path, drive, name):
    machine = machine_of((drive, "reference"), tmp_path)
    path = tmp_path / "parameters-before.yaml"
    with simulated(machine) as running:
        with connect(machine, to_move=False) as group:
            save_backup(back_up(machine.name, group.drives), path)
        with pytest.raises(NotSupportedError) as refused:
            workflow.restore(machine.path, path, store=True)
        assert not any(node.memory.stored for node in running.nodes)
    assert str(refused.value) == (
        f"table: profile {name} does not say how this drive stores its parameters; nothing was written."
    )


def test_gains_behind_a_password_are_backed_up_and_restored(tmp_path):
    """Their units are not known, and need not be: what a drive held comes back as it was."""
    machine = machine_of(("prbt", "reference"), tmp_path, table={"password": PASSWORD.decode()})
    path = tmp_path / "parameters-before.yaml"
    with simulated(machine) as running:
        node = running.nodes[0]
        node.dictionary.force(0x2030, 0, 2.5)
        with connect(machine, to_move=False) as group:
            save_backup(back_up(machine.name, group.drives), path)
        node.dictionary.force(0x2030, 0, 7.0)
        workflow.restore(machine.path, path)
        assert node.dictionary.read(0x2030, 0) == 2.5
    assert PASSWORD.decode() not in path.read_text()


def test_without_the_password_nothing_is_restored_and_it_is_said(tmp_path):
    machine = machine_of(("prbt", "reference"), tmp_path)
    path = tmp_path / "parameters-before.yaml"
    with simulated(machine) as running:
        node = running.nodes[0]
        with connect(machine, to_move=False) as group:
            save_backup(back_up(machine.name, group.drives), path)
        node.dictionary.force(0x2030, 0, 7.0)
        with pytest.raises(DrivesError, match=r"no password is known.*`--machine FILE`"):
            workflow.restore(machine.path, path)
        assert node.dictionary.read(0x2030, 0) == 7.0
