"""What makes drives stop by themselves is asked for first, and seen to be there last."""

import pytest
import yaml

from drives.canopen_drive.fail_safe import host_watched
from drives.canopen_drive.setup import HOST_LOST_AFTER
from drives.errors import NotSupportedError
from drives.sim.faults import SdoRefused

TABLE, ARM = 11, 12
NO_OBJECT = 0x06020000
DOWNLOAD = 1
"""Command specifier of an SDO download, in the upper three bits."""


@pytest.mark.parametrize(
    ("index", "sub", "words"),
    [
        (0x1016, 1, "arm: the drive has no heartbeat consumer 0x1016, so nothing would stop it"),
        (0x6007, 0, "arm: the drive has no abort connection option 0x6007, so what it does"),
    ],
)
@pytest.mark.parametrize("plan", ["fast", "classic"])
def test_a_drive_that_would_not_stop_is_refused_before_anything_is_written(
    bench, index, sub, words, plan
):
    bench.inject(SdoRefused(ARM, index, sub, NO_OBJECT))
    bench.listen()
    outcome = bench.measure("--yes", plan=plan)
    heard = bench.heard()
    assert outcome.code == 3, outcome.err
    assert words in outcome.err
    assert "It may not be moved by this tool." in outcome.err
    written = [f for f in heard if f.cob_id in (0x60B, 0x60C) and f.data[0] >> 5 == DOWNLOAD]
    assert written == []
    assert 0x080 not in {f.cob_id for f in heard}


def test_node_guarding_is_no_substitute(bench, monkeypatch):
    from drives.canopen_drive import CanopenDrive

    read = CanopenDrive.read_optional

    def with_guarding(self, info):
        return 100 if info.address.index == 0x100C else read(self, info)

    monkeypatch.setattr(CanopenDrive, "read_optional", with_guarding)
    bench.inject(SdoRefused(ARM, 0x1016, 1, NO_OBJECT))
    outcome = bench.measure("--yes")
    assert outcome.code == 3
    assert "Its node guarding (0x100C) is no substitute." in outcome.err


@pytest.mark.parametrize(("key", "value"), [((0x1016, 1), 0), ((0x6007, 0), 0), ((0x1029, 1), 0)])
def test_a_drive_that_forgets_it_on_going_operational_is_not_enabled(bench, key, value):
    (node,) = (n for n in bench.machine.nodes if n.node_id == ARM)
    powered: list[int] = []

    def forget(state):
        if state.value == 5:
            node.dictionary.write(*key, value)

    node.nmt.state_callbacks.add(forget)
    with bench.connected() as group:
        group.line.subscribe(0x180 + ARM, lambda *_: powered.extend(bench.powered()))
        with (
            pytest.raises(NotSupportedError, match=r"arm, object 0x.* and is 0 now"),
            group.motion(0.002),
        ):
            pytest.fail("it was enabled")
    assert powered == []
    assert bench.powered() == {}


def test_it_is_armed_in_motion_and_put_back_after(bench):
    for node in bench.machine.nodes:
        node.dictionary.write(0x6007, 0, 1)
        node.dictionary.write(0x1029, 1, 2)
        node.dictionary.write(0x1016, 1, 5 << 16 | 1000)
        node.dictionary.write(0x605A, 0, 0)
    before = bench.objects()
    with bench.connected() as group:
        with group.motion(0.002):
            for node in bench.machine.nodes:
                read = node.dictionary.read
                assert read(0x1016, 1) == host_watched(HOST_LOST_AFTER)
                assert (read(0x6007, 0), read(0x1029, 1), read(0x605A, 0)) == (3, 1, 2)
        assert bench.objects() == before


def test_a_drive_whose_reaction_is_not_known_is_refused(bench, tmp_path):
    from importlib.resources import files

    folder = files("profiles").joinpath("drives")
    profile = yaml.safe_load(folder.joinpath("reference.yaml").read_text(encoding="utf-8"))
    profile["heartbeat_reaction"] = "unknown"
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(profile), encoding="utf-8")
    eds = folder.joinpath("reference.eds").read_text(encoding="utf-8")
    (tmp_path / "reference.eds").write_text(eds, encoding="utf-8")
    bench.data["axes"][1]["drive"] = "mine.yaml"
    bench.rewrite(bench.data)
    bench.listen()
    outcome = bench.measure("--yes")
    assert outcome.code == 3, outcome.err
    assert "does not know which value of 0x6007" in outcome.err
    assert 0x080 not in {f.cob_id for f in bench.heard()}
