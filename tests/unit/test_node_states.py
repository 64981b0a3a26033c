"""CiA 402 power states of the simulated drive, every state against every command."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drives.sim.state_machine import TRANSITIONS, Command, State, command_of

DISABLED, READY, ON, ENABLED, STOPPING, FAULT = 0x40, 0x21, 0x23, 0x27, 0x07, 0x08
PATHS = {
    DISABLED: (),
    READY: (0x06,),
    ON: (0x06, 0x07),
    ENABLED: (0x06, 0x07, 0x0F),
}
EXPECTED = {  # IEC 61800-7-201, table of transitions: state, controlword, next state
    DISABLED: {0x00: DISABLED, 0x02: DISABLED, 0x06: READY, 0x07: DISABLED, 0x0F: DISABLED},
    READY: {0x00: DISABLED, 0x02: DISABLED, 0x06: READY, 0x07: ON, 0x0F: ENABLED},
    ON: {0x00: DISABLED, 0x02: DISABLED, 0x06: READY, 0x07: ON, 0x0F: ENABLED},
    ENABLED: {0x00: DISABLED, 0x02: STOPPING, 0x06: READY, 0x07: ON, 0x0F: ENABLED},
}


@pytest.mark.parametrize("start", EXPECTED)
@pytest.mark.parametrize("word", [0x00, 0x02, 0x06, 0x07, 0x0F])
def test_transitions(rig, start, word):
    rig.write("h", 0x605A, 0, 6)
    rig.write("h", 0x605C, 0, 0)
    for step in PATHS[start]:
        rig.control(step)
    assert rig.state() == start
    rig.control(word)
    assert rig.state() == EXPECTED[start][word]


@pytest.mark.parametrize("start", [READY, ON, ENABLED])
def test_a_fault_is_reset_by_the_rising_edge_only(rig, start):
    rig.write("h", 0x605E, 0, 0)
    for step in PATHS[start]:
        rig.control(step)
    rig.machine.node(1).motion.fault(0x2310, 2)
    assert rig.state() == FAULT
    assert rig.emergencies() == [0x2310]
    for word in (0x00, 0x06, 0x0F):
        rig.control(word)
        assert rig.state() == FAULT
    rig.control(0x80)
    assert rig.state() == DISABLED
    assert rig.emergencies() == [0x0000]
    rig.machine.node(1).motion.fault(0x2310, 2)
    rig.control(0x86)
    assert rig.state() == FAULT, "bit 7 was set before: no edge"
    rig.control(0x00)
    rig.control(0x80)
    assert rig.state() == DISABLED


def test_every_word_shows_one_state_at_most():
    masks = {s: 0x4F if s.value & 0x4F in (0, 0x40, 0x0F, 0x08) else 0x6F for s in State}
    for word in range(1 << 16):
        shown = [s for s in State if word & masks[s] == s.value & masks[s]]
        assert len(shown) <= 1
    assert len({s.value for s in State}) == 8


@given(word=st.integers(0, 0xFFFF), before=st.integers(0, 0xFFFF))
def test_command_follows_the_table(word, before):
    rising = bool(word & 0x80) and not before & 0x80
    command = command_of(word, before)
    assert (command is Command.FAULT_RESET) == rising
    if not rising:
        pattern = {  # bits 3..0; None: either
            Command.SHUTDOWN: (None, 1, 1, 0),
            Command.SWITCH_ON: (0, 1, 1, 1),
            Command.ENABLE_OPERATION: (1, 1, 1, 1),
            Command.DISABLE_VOLTAGE: (None, None, 0, None),
            Command.QUICK_STOP: (None, 0, 1, None),
        }[command]
        bits = [(word >> k) & 1 for k in (3, 2, 1, 0)]
        assert all(p is None or p == b for p, b in zip(pattern, bits, strict=True))


def test_no_way_leads_around_the_fault_reset():
    assert {c for (s, c) in TRANSITIONS if s is State.FAULT} == {Command.FAULT_RESET}
    assert not any(s is State.FAULT_REACTION_ACTIVE for s, _ in TRANSITIONS)


class TestStatuswordBits:
    def test_voltage_and_remote(self, rig):
        assert rig.statusword() == 0x0240
        rig.control(0x06)
        assert rig.statusword() == 0x0231

    def test_quick_stop_bit_is_low_while_stopping(self, rig):
        rig.write("h", 0x605A, 0, 6)
        rig.enable()
        assert rig.statusword() & 0x20
        rig.control(0x02)
        assert not rig.statusword() & 0x20

    def test_quick_stop_active_is_left_by_a_new_command(self, rig):
        rig.write("h", 0x605A, 0, 6)
        rig.enable()
        rig.control(0x02)
        rig.run(1.0)
        assert rig.state() == STOPPING
        rig.control(0x0F)
        assert rig.state() == ENABLED

    def test_internal_quick_stop_is_not_undone_by_the_old_controlword(self, rig):
        rig.write("h", 0x605A, 0, 6)
        rig.enable()
        rig.machine.node(1).motion.quick_stop()
        rig.control(0x0F)
        assert rig.state() == STOPPING


WORDS = st.lists(st.sampled_from([0, 2, 6, 7, 0xF, 0x80, 0x1F, 0x10F]), max_size=25)


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(words=WORDS)
def test_any_sequence_keeps_to_the_table(rig_of, words):
    """With all ramps switched off the drive does what the table says, and nothing else."""
    rig = rig_of(1)
    for index in (0x605A, 0x605B, 0x605C):
        rig.write("h", index, 0, 0)
    state, before = State.SWITCH_ON_DISABLED, 0
    for word in words:
        rig.control(word)
        if word != before:
            state = TRANSITIONS.get((state, command_of(word, before)), state)
            if state is State.QUICK_STOP_ACTIVE:  # option 0: straight through
                state = State.SWITCH_ON_DISABLED
        before = word
        assert rig.state() == state.value
