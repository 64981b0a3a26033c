"""All statuswords, the way to enabled, modes and emergency codes of CiA 402."""

from collections import Counter

import pytest

from drives.cia402 import (
    EMERGENCY_CLASSES,
    EMERGENCY_CODES,
    ENABLED_MASK,
    ENABLED_VALUE,
    STATUS_FAULT,
    STEP_TOWARDS_ENABLED,
    Controlword,
    Mode,
    PowerState,
    emergency_text,
)

PATTERNS = {  # IEC 61800-7-201, bits 6 5 3 2 1 0 of the statusword (x: any), read right to left
    "NOT_READY_TO_SWITCH_ON": "0x0000",
    "SWITCH_ON_DISABLED": "1x0000",
    "READY_TO_SWITCH_ON": "010001",
    "SWITCHED_ON": "010011",
    "OPERATION_ENABLED": "010111",
    "QUICK_STOP_ACTIVE": "000111",
    "FAULT_REACTION_ACTIVE": "0x1111",
    "FAULT": "0x1000",
}
PATTERN_BITS = (6, 5, 3, 2, 1, 0)


def by_pattern(word: int) -> set[str]:
    return {
        name
        for name, pattern in PATTERNS.items()
        if all(
            p == "x" or word >> b & 1 == int(p) for p, b in zip(pattern, PATTERN_BITS, strict=True)
        )
    }


def test_every_statusword_is_at_most_one_state() -> None:
    found: Counter[str] = Counter()
    for word in range(65536):
        expected = by_pattern(word)
        assert len(expected) <= 1
        matching = [s for s in PowerState if word & s.value[0] == s.value[1]]
        assert {s.name for s in matching} == expected, hex(word)
        if expected:
            assert PowerState.of(word).name in expected
            found.update(expected)
        else:
            with pytest.raises(ValueError, match=f"0x{word:04X} is no CiA 402 state"):
                PowerState.of(word)
    assert set(found) == {s.name for s in PowerState}
    # 10 of the 16 bits never matter; bit 5 does not matter for four of the states
    assert sum(found.values()) == 2**9 * (4 * 2 + 4) * 2


@pytest.mark.parametrize(
    ("word", "state"),
    [
        (0x0000, PowerState.NOT_READY_TO_SWITCH_ON),
        (0x0250, PowerState.SWITCH_ON_DISABLED),
        (0x0231, PowerState.READY_TO_SWITCH_ON),
        (0x0233, PowerState.SWITCHED_ON),
        (0x1237, PowerState.OPERATION_ENABLED),
        (0x0217, PowerState.QUICK_STOP_ACTIVE),
        (0x021F, PowerState.FAULT_REACTION_ACTIVE),
        (0x0218, PowerState.FAULT),
        (0x0238, PowerState.FAULT),
    ],
)
def test_words_as_real_drives_send_them(word: int, state: PowerState) -> None:
    assert PowerState.of(word) is state


def test_bits_of_the_words() -> None:
    for state in PowerState:
        in_fault = state in (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE)
        assert bool(state.value[1] & STATUS_FAULT) == in_fault
    assert PowerState.of(0x27) is PowerState.OPERATION_ENABLED
    assert (ENABLED_MASK, ENABLED_VALUE) == (0x6F, 0x27)
    assert PowerState.SWITCH_ON_DISABLED.words == "switch on disabled"


def test_the_way_to_enabled() -> None:
    """Transitions 2, 3 and 4, each with the controlword bits that the standard gives it."""
    bits = {2: "xxxx0110", 3: "xxxx0111", 4: "xxxx1111"}
    way, state = [], PowerState.SWITCH_ON_DISABLED
    while state in STEP_TOWARDS_ENABLED:
        word, state = STEP_TOWARDS_ENABLED[state]
        way.append((word, state))
    assert [s.name for _, s in way] == ["READY_TO_SWITCH_ON", "SWITCHED_ON", "OPERATION_ENABLED"]
    for (word, _), pattern in zip(way, bits.values(), strict=True):
        text = f"{word:08b}"
        assert all(p in ("x", t) for p, t in zip(pattern, text, strict=True))
    assert not set(STEP_TOWARDS_ENABLED) & {
        PowerState.FAULT,
        PowerState.FAULT_REACTION_ACTIVE,
        PowerState.QUICK_STOP_ACTIVE,
        PowerState.NOT_READY_TO_SWITCH_ON,
        PowerState.OPERATION_ENABLED,
    }


def test_the_words_that_stop() -> None:
    assert Controlword.DISABLE_VOLTAGE & 0b10 == 0  # xxxx xx0x
    assert Controlword.QUICK_STOP & 0b110 == 0b010  # xxxx x01x
    assert Controlword.FAULT_RESET & 0x80
    enabling = {Controlword.SWITCH_ON, Controlword.ENABLE_OPERATION}
    assert all(word & 1 == (word in enabling) for word in Controlword)


def test_modes() -> None:
    assert {m.name: m.value for m in Mode} == {
        "PROFILE_POSITION": 1,
        "CYCLIC_POSITION": 8,
        "CYCLIC_VELOCITY": 9,
        "CYCLIC_TORQUE": 10,
    }
    # 0x6502: bit 0 profile position, bit 7 CSP, bit 8 CSV, bit 9 CST
    assert [m.supported_bit for m in Mode] == [0x001, 0x080, 0x100, 0x200]
    assert Mode.CYCLIC_TORQUE.words == "cyclic torque"


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x8611, "0x8611 (following error)"),
        (0x8130, "0x8130 (life guard or heartbeat error)"),
        (0x2310, "0x2310 (current, device output side)"),
        (0x2410, "0x2410 (current)"),
        (0x0000, "0x0000 (error reset or no error)"),
        (0xFF01, "0xFF01 (device specific)"),
        (0xF412, "0xF412 (additional functions)"),
        (0xA123, "0xA123 (unknown class)"),
    ],
)
def test_emergency_codes_in_words(code: int, text: str) -> None:
    assert emergency_text(code) == text


def test_every_emergency_code_has_words() -> None:
    for code in range(65536):
        text = emergency_text(code)
        assert text.startswith(f"0x{code:04X} (")
        assert len(text) > 10
        known = code in EMERGENCY_CODES or code >> 8 in EMERGENCY_CLASSES
        assert not (known and "unknown" in text)
