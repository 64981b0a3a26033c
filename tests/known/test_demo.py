"""The whole job over the virtual CAN on a machine that nobody has seen before.

The packaged turntable with an arm on it, but with a noise of a new seed and true masses drawn
anew within 20 %; the profile's prior model and the drives' gains stay what they are.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drives.profile import MachineProfile, load_machine
from drives.sim.lockstep_bus import register, unregister
from drives.sim.machine import simulated_machine
from fieldtool import workflow
from fieldtool.workflow import Options, SessionResult
from tests.seeds import fresh_seed

CHANNEL = "turntable-arm-drawn-anew"


def drawn_anew(seed: int) -> MachineProfile:
    """The profile with another truth behind another channel."""
    rng = np.random.default_rng(seed)
    machine = load_machine("turntable-arm")
    simulation = machine.simulation
    assert simulation is not None
    axes = tuple(
        axis.model_copy(
            update={"masses": tuple(float(m * rng.uniform(0.8, 1.2)) for m in axis.masses)}
        )
        for axis in simulation.axes
    )
    simulation = simulation.model_copy(update={"seed": seed, "axes": axes})
    bus = machine.bus.model_copy(update={"channel": CHANNEL})
    return machine.model_copy(update={"simulation": simulation, "bus": bus})


@pytest.fixture(scope="module", params=["classic", "fast"])
def result(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[SessionResult]:
    seed = fresh_seed()
    machine = drawn_anew(seed)
    register(CHANNEL, simulated_machine(machine))
    try:
        options = Options(plan=request.param, write=True)
        folder = tmp_path_factory.mktemp("session")
        yield workflow.run(machine, folder / "one", options, confirm=lambda _: True)
    finally:
        unregister(CHANNEL)


def test_masses_and_springs_within_2_percent_couplings_within_5(result: SessionResult) -> None:
    truth, model = result.truth, result.model
    assert truth is not None
    print("truth", truth.as_dict())
    print("found", model.as_dict())
    assert model.names == truth.names == ("table", "arm")
    for found, true in zip(model.axes, truth.axes, strict=True):
        assert len(found.masses) == len(true.masses)
        pairs = [*zip(found.masses, true.masses, strict=True)]
        pairs += [*zip(found.springs, true.springs, strict=True)]
        for value, wanted in pairs:
            assert value.value == pytest.approx(wanted.value, rel=0.02)
    (found_coupling,), (true_coupling,) = model.couplings, truth.couplings
    assert set(found_coupling.axes) == set(true_coupling.axes)
    assert found_coupling.value == pytest.approx(true_coupling.value, rel=0.05)


def test_errors_are_what_they_are_said_to_be(result: SessionResult) -> None:
    """Within 6 standard errors or, where those are tiny, what delay and interpolation leave."""
    truth = result.truth
    assert truth is not None
    for found, true in zip(result.model.axes, truth.axes, strict=True):
        for value, wanted in zip(found.masses, true.masses, strict=True):
            assert value.std > 0
            assert abs(value.value - wanted.value) <= 6 * value.std + 0.01 * wanted.value


def test_the_drives_hold_what_was_designed(result: SessionResult) -> None:
    write_back = result.write_back
    assert write_back is not None
    assert write_back.in_memory
    assert not write_back.stored
    wanted = {(t.axis, name): v for t in result.tuning.axes for name, v in t.parameters.items()}
    read = {(w.change.axis, w.change.name): w.read_back for w in write_back.written}
    assert read
    for key, value in read.items():
        assert value == pytest.approx(wanted[key], rel=1e-3, abs=1e-3)


def test_the_session_folder_is_complete(result: SessionResult) -> None:
    names = {path.name for path in Path(result.folder).iterdir()}
    assert names >= {
        "machine.yaml", "parameters-before.yaml", "recording.h5", "frequency-response.h5",
        "model.yaml", "tuning.yaml", "write-journal.yaml", "events.jsonl",
    }  # fmt: skip
    assert result.machine_time > 0
    assert any("simulated" in warning.lower() for warning in result.warnings)
