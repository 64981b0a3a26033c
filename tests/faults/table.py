"""Every fault at every moment, and what has to come of it.

The faults befall the arm, the second of two axes, or host and bus.  Where a fault is harmless at a
moment by its nature, the table says so and why; then the command has to come to its usual end.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from drives.sim.drive_faults import (
    BrakeClosed,
    CanNotBeEnabled,
    EncoderJumps,
    LimitSwitchHit,
    ModeChanges,
    OperationLost,
    PowerLossWhileStoring,
    SupplySags,
    TorqueScaleWrong,
)
from drives.sim.emergency import ErrorRegister
from drives.sim.faults import (
    DriveFault,
    EmergencyOnly,
    EncoderStuck,
    Fault,
    MotorReversed,
    NodeVanishes,
    PowerLoss,
    SdoRefused,
    SdoSilent,
    StoreFails,
    WriteAltered,
)
from drives.sim.frame_faults import (
    HeartbeatLost,
    NodeDuplicated,
    PdoLate,
    PdoMissing,
    PdoShort,
    PdoTwice,
    SdoAnswerLate,
    SdoAnswerWrong,
    StatuswordFrozen,
    Stranger,
    SyncMissed,
)
from drives.sim.host_faults import BusOff, HostKilled, HostStalls, InterfaceDown, ReceiverDead
from tests.faults.bench import ARM, TABLE, Moment, Result, try_case
from tests.faults.clairvoyant import HELD
from tests.session.conftest import two_axes

CYCLES = 3.0
"""Within which all drives have to have left operation enabled, where nothing else is said."""
HEARTBEAT = 0.2 + 0.05 + 0.002
"""s: a drive stops by itself that misses the host's heartbeat for so long, sent every 0.05 s."""
ASKED = (2 * 2 + 2) * 25 + CYCLES
"""Cycles: two drives are asked for two objects in turn, 25 cycles each, and again for what is wrong."""
LEAST_ROWS = {Moment.STILL: 30, Moment.SWEEP: 50}
"""Rows that were measured when the fault came, and have to be on the disk."""
NODES = {TABLE, ARM}


@dataclass(frozen=True)
class Expected:
    """What has to come of a fault at one moment."""

    codes: tuple[int, ...]
    says: str = ""
    """What is said, among other things: a regular expression."""
    cycles: float = CYCLES
    own: frozenset[int] = frozenset()
    """Nodes that nobody can tell: they stop by themselves, by their heartbeat consumer."""
    left: frozenset[int] = frozenset()
    """Nodes that can not be reached, and whose objects are left as they were set."""
    farthest: float | None = None
    """rad that a motor may go at most from where it was."""
    unseen: float | None = None
    """rad that the motor of the faulty drive may go at most until its power is cut."""
    whole: bool = False
    """The fault shows at the end of a motion only, whose recording is whole then."""
    why: str = ""
    """Why it is harmless, where it is."""


def harmless(why: str, **more: object) -> Expected:
    """Return what has to come where nothing has to."""
    return replace(Expected((0,), why=why), **more)  # type: ignore[arg-type]


def refused(says: str) -> Expected:
    """Nothing moved."""
    return Expected((3,), says)


def stopped(says: str, **more: object) -> Expected:
    """All axes were stopped."""
    return replace(Expected((4,), says), **more)  # type: ignore[arg-type]


def seen_late(says: str, codes: tuple[int, ...] = (4,), **more: object) -> Expected:
    """It shows when it is looked for: at the end of a motion, or in the data."""
    return replace(Expected(codes, says, whole=True), **more)  # type: ignore[arg-type]


def restored(says: str) -> Expected:
    """Every drive holds its old values."""
    return Expected((6,), says)


def mixed(says: str) -> Expected:
    """What drives hold is said; once they can be reached, `restore` brings all old values back."""
    return Expected((7,), says)


@dataclass(frozen=True)
class Row:
    """One fault, and what has to come of it."""

    name: str
    make: Callable[[int], tuple[Fault, ...]]
    connecting: Expected
    still: Expected
    sweep: Expected
    write: Expected
    profile: Callable[[], dict[str, Any]] = two_axes
    """The machine."""
    factor: float | None = None
    """What the fault makes of the torque that the drive tells, where only motion shows it: asked of the
    clairvoyant."""
    writing: tuple[int, int] | None = None
    """The object at whose writing the fault comes; otherwise after some gains."""

    def expected(self, moment: Moment) -> Expected:
        """Return what has to come at a moment."""
        return {
            Moment.CONNECTING: self.connecting,
            Moment.STILL: self.still,
            Moment.SWEEP: self.sweep,
            Moment.WRITE: self.write,
        }[moment]


BOTH, ONE = frozenset(NODES), frozenset({ARM})
NOT_IN_USE = harmless("PDOs, motion and their watch are not in use while parameters are written")
NOT_YET = harmless("it is over before anything of it is used")
ONCE = harmless("once does not matter: what it spoils is measured again")
PASSED_OVER = harmless("a whole answer that does not belong to a request is passed over")
SEPARATE = harmless("nothing asks for that object at this moment")
MEASURED = harmless("measuring writes and stores no parameters")
MASTERS = "Two masters must not"
NO_PDO = r"arm: node 12 sent no PDO for \d+ cycles"
FAR = 0.5
DEAD = "arm: stands dead .*encoder does not count.*brake"
PUSHED = "arm: stands under a torque of .*encoder does not count.*brake"


def _one(make: Callable[[int], Fault]) -> Callable[[int], tuple[Fault, ...]]:
    return lambda node: (make(node),)


def _emergency(code: int, register: ErrorRegister, name: str, said: str) -> Row:
    text = rf"arm: node 12 reports emergency 0x{code:04X} \({said}"
    return Row(
        f"EMCY, {name}",
        _one(lambda n: EmergencyOnly(n, code, int(register))),
        harmless("a warning of a drive that is disabled, and that works"),
        stopped(text),
        stopped(text),
        harmless("a warning: the drive goes on, and what was written is read back"),
    )


def _drive_fault(code: int, register: ErrorRegister, name: str, said: str) -> Row:
    return replace(
        _emergency(code, register, name, said),
        make=_one(lambda n: DriveFault(n, code, int(register))),
        connecting=refused(rf"arm: the drive is in fault; its last error is 0x{code:04X}"),
        write=harmless("parameters may be written in fault, and are read back"),
    )


def _wrong_answer(how: str, said: str, **changes: Expected) -> Row:
    row = Row(
        f"SDO answer: {how}",
        _one(lambda n: SdoAnswerWrong(n, 1, how)),  # type: ignore[arg-type]
        refused(rf"arm, object 0x1018:02: .*{said}"),
        ONCE,
        ONCE,
        restored(rf"arm, .*object 0x2010:03: .*{said}"),
    )
    return replace(row, **changes)  # type: ignore[arg-type]


def _stranger(name: str, make: Callable[[int], Stranger], said: str, **changes: Expected) -> Row:
    row = Row(
        f"stranger: {name}",
        _one(make),
        refused(rf"somebody else sends {said} on this bus"),
        stopped(rf"somebody else sends {said} on this bus; all axes were stopped. {MASTERS}"),
        stopped(rf"somebody else sends {said} on this bus; all axes were stopped. {MASTERS}"),
        NOT_IN_USE,
    )
    return replace(row, **changes)  # type: ignore[arg-type]


def _host(name: str, fault: Fault, said: str, mid: str, **more: object) -> Row:
    return Row(
        f"host: {name}",
        lambda _: (fault,),
        refused(said),
        stopped(mid, own=BOTH, left=BOTH, **more),
        stopped(mid, own=BOTH, left=BOTH, **more),
        mixed("(arm|table)"),
    )


def with_friction() -> dict[str, Any]:
    """Return a machine with dry friction of a fifth of the torque limit, and loops that overcome it."""
    profile = two_axes()
    arm = profile["simulation"]["axes"][1]
    arm["effects"] = [{"effect": "coulomb_friction", "location": "motor", "torque": 1.2}]
    arm["gains"] |= {"position_p": 20, "velocity_p": 2.5, "velocity_i": 25}
    return profile


def with_coarse_encoder() -> dict[str, Any]:
    """Return a machine whose arm has an encoder of 2000 lines."""
    profile = two_axes()
    profile["simulation"]["axes"][1]["encoder_counts_per_rev"] = 8000
    return profile


def with_epos4(kind: str = "epos4") -> dict[str, Any]:
    """Return the machine with an EPOS4 at its arm, which has its maker's objects, units and ways."""
    profile = two_axes()
    profile["axes"][1]["drive"] = kind
    arm = profile["simulation"]["axes"][1]
    arm["torque_constant"] = 0.1
    arm["gains"]["velocity_ff"] = 1 if kind == "epos4" else 0
    return profile


def _still(
    name: str,
    fault: Callable[[int], Fault],
    sweep: Expected,
    unseen: float,
    profile: Callable[[], dict[str, Any]] = two_axes,
    asked_within: float = 200,
) -> Row:
    """Return a fault that shows only when the motor must have moved: the position stands still."""
    said = "arm: does not move by its encoder: .*brake"
    asked = stopped(said, unseen=unseen, cycles=asked_within)
    return Row(name, _one(fault), asked, asked, sweep, NOT_IN_USE, profile, HELD)


ROWS: tuple[Row, ...] = (
    Row(
        "node lost",
        _one(NodeVanishes),
        refused("arm, object 0x1018:02: node 12 did not answer within 0.5 s"),
        stopped(NO_PDO, own=ONE, left=ONE),
        stopped(NO_PDO, own=ONE, left=ONE),
        mixed(r"arm \(node 12\).*0x2010"),
    ),
    Row(
        "heartbeat lost",
        _one(HeartbeatLost),
        stopped("arm: node 12 sent no heartbeat for 0.35 s"),
        stopped("arm: node 12 sent no heartbeat for 0.35 s", cycles=230),
        stopped("arm: node 12 sent no heartbeat for 0.35 s", cycles=230),
        NOT_IN_USE,
    ),
    Row(
        "drive reboots",
        _one(PowerLoss),
        harmless("it has booted again before it is used"),
        stopped(r"arm: node 12 left NMT operational \(it rebooted\)"),
        stopped(r"arm: node 12 left NMT operational \(it rebooted\)"),
        restored("arm: node 12 has restarted since its parameters were backed up"),
    ),
    _emergency(0x1000, ErrorRegister.GENERIC, "generic", "generic error"),
    _emergency(0x2310, ErrorRegister.CURRENT, "current", "current, device output side"),
    _emergency(0x3210, ErrorRegister.VOLTAGE, "voltage", "voltage inside the device"),
    _emergency(0x4310, ErrorRegister.TEMPERATURE, "temperature", "temperature"),
    _emergency(0x8120, ErrorRegister.COMMUNICATION, "communication", "CAN in error passive mode"),
    _emergency(0x7305, ErrorRegister.DEVICE_PROFILE, "device profile", "sensor"),
    _emergency(0xFF01, ErrorRegister.MANUFACTURER, "manufacturer", "device specific"),
    _drive_fault(0x2310, ErrorRegister.CURRENT, "over-current, fault", "current, device"),
    _drive_fault(0x8611, ErrorRegister.DEVICE_PROFILE, "following error, fault", "following"),
    Row(
        "supply sags",
        _one(SupplySags),
        refused("arm: the drive is in fault; its last error is 0x3220"),
        stopped("arm: node 12 reports emergency 0x3220", cycles=CYCLES + 2.5),
        stopped("arm: node 12 reports emergency 0x3220", cycles=CYCLES + 2.5),
        harmless("parameters may be written in fault, and are read back"),
    ),
    Row(
        "SDO abort",
        lambda n: (SdoRefused(n, 0x6076), SdoRefused(n, 0x6007), SdoRefused(n, 0x2010, 2)),
        refused("arm, object 0x6076:00: the drive refused to read it"),
        seen_late("arm, object 0x6007:00: the drive refused.*Axes had moved", left=ONE),
        seen_late("arm, object 0x6007:00: the drive refused.*Axes had moved", left=ONE),
        mixed(r"arm.*0x2010:02"),
    ),
    Row(
        "SDO time-out",
        lambda n: (SdoSilent(n, 0x6076), SdoSilent(n, 0x6007), SdoSilent(n, 0x2010, 2)),
        refused("arm, object 0x6076:00: node 12 did not answer within 0.5 s"),
        seen_late("arm, object 0x6007:00: node 12 did not answer.*Axes had moved", left=ONE),
        seen_late("arm, object 0x6007:00: node 12 did not answer.*Axes had moved", left=ONE),
        mixed(r"arm.*0x2010:02"),
    ),
    Row(
        "SDO answers late, twice",
        _one(lambda n: SdoAnswerLate(n, 2)),
        refused("arm, object 0x1018:02: node 12 did not answer"),
        ONCE,
        ONCE,
        restored("arm, .*object 0x2010:03: node 12 did not answer"),
    ),
    _wrong_answer("other index", r"it is about 0x1019:02", write=restored("it is about 0x2011:03")),
    _wrong_answer("other sub-index", "it is about 0x1018:03", write=restored("0x2010:03")),
    _wrong_answer(
        "other value size",
        "the drive sent 2",
        write=restored(r"arm, .*object 0x2010:0\d: .*the drive sent 2"),
    ),
    _wrong_answer(
        "toggle bit",
        "",
        connecting=refused("arm, object 0x1008:00: .*toggle bit does not alternate"),
        write=harmless("no parameter is longer than four bytes, so none comes in segments"),
    ),
    _wrong_answer("truncated", "it has 3 bytes in place of 8", write=restored("3 bytes")),
    _wrong_answer("empty", "it has 0 bytes in place of 8", write=restored("0 bytes")),
    _wrong_answer("other specifier", "its command specifier is 3", write=restored("specifier is")),
    _wrong_answer("no specifier", "its command specifier is 7", write=restored("specifier is 7")),
    Row(
        "SDO answer: twice, once",
        _one(lambda n: SdoAnswerWrong(n, 1, "twice")),
        PASSED_OVER,
        PASSED_OVER,
        PASSED_OVER,
        PASSED_OVER,
    ),
    Row("PDO missing once", _one(lambda n: PdoMissing(n, 1)), ONCE, ONCE, ONCE, NOT_IN_USE),
    Row(
        "PDO missing for good",
        _one(PdoMissing),
        refused("arm: node 12 sends no PDO after SYNC"),
        stopped(NO_PDO),
        stopped(NO_PDO),
        NOT_IN_USE,
    ),
    Row("PDO late once", _one(lambda n: PdoLate(n, 1)), ONCE, ONCE, ONCE, NOT_IN_USE),
    Row(
        "PDO late for good",
        _one(PdoLate),
        refused("arm: node 12 answers a SYNC later than 0.9 of the cycle"),
        seen_late("arm: node 12 answers a SYNC later than 0.9 of the cycle"),
        seen_late("arm: node 12 answers a SYNC later than 0.9 of the cycle"),
        NOT_IN_USE,
    ),
    Row(  # a watch that is behind by the one cycle that nobody can see is behind by no more
        "PDO late for good, operation lost",
        lambda n: (PdoLate(n), OperationLost(n)),
        refused("arm: node 12 answers a SYNC later than 0.9 of the cycle"),
        stopped(r"arm: the drive left operation enabled: statusword 0x0240"),
        stopped(r"arm: the drive left operation enabled: statusword 0x0240"),
        NOT_IN_USE,
    ),
    Row(
        "PDO late for good, two cycles",
        _one(lambda n: PdoLate(n, cycles=2.3)),
        refused("arm: node 12 answers a SYNC later than 0.9 of the cycle"),
        stopped(NO_PDO),
        stopped(NO_PDO),
        NOT_IN_USE,
    ),
    Row("PDO twice, once", _one(lambda n: PdoTwice(n, 1)), ONCE, ONCE, ONCE, NOT_IN_USE),
    Row(
        "PDO twice for good",
        _one(PdoTwice),
        stopped("arm: PDOs of node 12 come that no SYNC of this host asked for"),
        stopped("arm: PDOs of node 12 come that no SYNC of this host asked for", cycles=5),
        stopped("arm: PDOs of node 12 come that no SYNC of this host asked for", cycles=5),
        NOT_IN_USE,
    ),
    Row("PDO too short once", _one(lambda n: PdoShort(n, 1)), ONCE, ONCE, ONCE, NOT_IN_USE),
    Row(
        "PDO too short for good",
        _one(PdoShort),
        refused("arm: node 12 sends no PDO after SYNC"),
        stopped(NO_PDO),
        stopped(NO_PDO),
        NOT_IN_USE,
    ),
    Row("SYNC missed once", _one(SyncMissed), ONCE, ONCE, ONCE, NOT_IN_USE),
    Row(
        "SYNC missed for good",
        _one(lambda n: SyncMissed(n, float("inf"))),
        refused("arm: node 12 sends no PDO after SYNC"),
        stopped(NO_PDO),
        stopped(NO_PDO),
        NOT_IN_USE,
    ),
    Row(
        "statusword frozen",
        _one(StatuswordFrozen),
        refused("arm: the drive stays in switch on disabled and can not be enabled"),
        seen_late("arm: the PDOs of node 12 show statusword .*object 0x6041:00"),
        seen_late("arm: the PDOs of node 12 show statusword .*object 0x6041:00"),
        NOT_IN_USE,
    ),
    Row(
        "statusword frozen, operation lost",
        lambda n: (StatuswordFrozen(n), OperationLost(n)),
        refused("arm: the drive stays in switch on disabled and can not be enabled"),
        stopped("arm: the PDOs of node 12 show .*object 0x6041:00.* shows 0x0240", cycles=ASKED),
        stopped("arm: the PDOs of node 12 show .*object 0x6041:00.* shows 0x0240", cycles=ASKED),
        NOT_IN_USE,
    ),
    Row(
        "node id twice",
        _one(NodeDuplicated),
        refused("arm: node 12 answers more often than it is asked: two drives have this node id"),
        stopped("arm: (PDOs of node 12 come|its position jumped|the drive left)", cycles=5),
        stopped("arm: (PDOs of node 12 come|its position jumped|the drive left)", cycles=5),
        mixed(r"arm, object 0x\w+:0\d: .*two drives have this node id.*0x1000:00: .*two answers"),
    ),
    _stranger("SYNC", lambda n: Stranger(n, 0x80), "a SYNC"),
    _stranger(
        "targets",
        lambda n: Stranger(n, 0x200 + n, bytes((0x0F, 0, 0, 0, 1, 0, 0, 0))),
        r"targets \(a PDO\) for arm",
    ),
    _stranger(
        "the host's heartbeat", lambda n: Stranger(n, 0x77F, b"\5"), "the host's own heartbeat"
    ),
    _stranger(
        "NMT stop",
        lambda n: Stranger(n, 0, b"\2\0", times=1),
        r"the NMT command stop \(0x02\) to all nodes",
        connecting=refused(r"table, object 0x6\d+:00: node 11 did not answer"),
        write=Expected((6, 7), "(table|arm).*node 1[12]"),
    ),
    _stranger(
        "NMT pre-operational",
        lambda n: Stranger(n, 0, bytes((0x80, n)), times=1),
        r"the NMT command pre-operational \(0x80\) to arm",
        connecting=harmless("the node is pre-operational then in any case"),
    ),
    _stranger(
        "NMT reset",
        lambda n: Stranger(n, 0, bytes((0x81, n)), times=1),
        r"the NMT command reset \(0x81\) to arm",
        connecting=harmless("it has booted again before it is used"),
        write=Expected((6, 7), "arm"),
    ),
    _stranger(
        "controlword by SDO",
        lambda n: Stranger(n, 0x600 + n, bytes.fromhex("2B40600000000000"), times=1),
        "a write to object 0x6040:00 of arm",
        connecting=refused("arm: node 12 answers more often than it is asked"),
    ),
    _host("bus off", BusOff(), "bus off", "bus off.*heartbeat"),
    _host("interface down", InterfaceDown(), "Network is down", "Network is down.*heartbeat"),
    replace(
        _host("receiver dead", ReceiverDead(), "arm.*did not answer", "sent no PDO"),
        still=stopped("sent no PDO for 2 cycles", left=BOTH),
        sweep=stopped("sent no PDO for 2 cycles", left=BOTH),
    ),
    _host("killed", HostKilled(), "arm.*did not answer", "sent no PDO"),
    replace(
        _host("stalled 0.5 s", HostStalls(), "", "(stood still|emergency 0x8130)"),
        connecting=harmless("nothing moves, and drives wait for the host"),
        still=stopped("(stood still|emergency 0x8130)", own=BOTH),
        sweep=stopped("(stood still|emergency 0x8130)", own=BOTH),
        write=harmless("nothing moves, and drives wait for the host"),
    ),
    _still("encoder stuck", EncoderStuck, stopped(DEAD, unseen=0.004), 0.004),
    _still(  # friction holds the motor in the weak pilot; it moves in what comes after it
        "encoder stuck, friction 20 %",
        EncoderStuck,
        seen_late(PUSHED, unseen=0.02),
        0.001,
        with_friction,
    ),
    _still(
        "encoder stuck, 8000 counts",
        EncoderStuck,
        stopped(PUSHED, unseen=0.07, cycles=60),
        0.03,
        with_coarse_encoder,
        asked_within=400,
    ),
    Row(
        "encoder jumps",
        _one(EncoderJumps),
        harmless("positions are relative, and it is referenced where it stands"),
        stopped("arm: its position jumped by .*encoder lost count", farthest=FAR),
        stopped("arm: its position jumped by .*encoder lost count", farthest=FAR),
        NOT_IN_USE,
    ),
    Row(
        "motor reversed",
        _one(MotorReversed),
        stopped("arm: .*the wrong way", farthest=FAR),
        stopped("arm: .*the wrong way", cycles=300, farthest=FAR),
        stopped("arm: .*its motor turns against its torque", cycles=60, unseen=0.12, farthest=10.0),
        NOT_IN_USE,
        factor=-1.0,
    ),
    Row(
        "torque scale times ten",
        _one(TorqueScaleWrong),
        seen_late("arm: by its torque .*a factor of .*0x6076", farthest=FAR),
        seen_late("arm: by its torque .*a factor of .*0x6076", farthest=FAR),
        stopped("arm: torque .* is above the limit 6 N m", cycles=80, farthest=FAR),
        NOT_IN_USE,
        factor=0.1,
    ),
    Row(
        "torque scale by ten",
        _one(lambda n: TorqueScaleWrong(n, factor=0.1)),
        seen_late("arm: .*torque .*0x6076", (4, 5), farthest=FAR),
        seen_late("arm: .*torque .*0x6076", (4, 5), farthest=FAR),
        seen_late("arm: .*torque .*0x6076", (4, 5), farthest=FAR),
        NOT_IN_USE,
        factor=10.0,
    ),
    _still("brake closed", BrakeClosed, stopped(DEAD, unseen=1e-6), 1e-6),
    Row(
        "limit switch hit",
        _one(LimitSwitchHit),
        harmless("the drive is off; the switch lets it go the other way"),
        stopped("arm: the drive left operation enabled: .*quick stop active"),
        stopped("arm: the drive left operation enabled: .*quick stop active"),
        NOT_IN_USE,
    ),
    Row(
        "operation lost",
        _one(OperationLost),
        harmless("the drive is off"),
        stopped(r"arm: the drive left operation enabled: statusword 0x0240"),
        stopped(r"arm: the drive left operation enabled: statusword 0x0240"),
        NOT_IN_USE,
    ),
    Row(
        "can not be enabled",
        _one(CanNotBeEnabled),
        refused("arm: the drive stays in switched on and can not be enabled"),
        stopped("arm: the drive left operation enabled"),
        stopped("arm: the drive left operation enabled"),
        NOT_IN_USE,
    ),
    Row(
        "mode changes, to profile position",
        _one(ModeChanges),
        harmless("the tool sets the mode before it enables the drive"),
        stopped("arm: .*object 0x6061:00 shows 1 ", cycles=ASKED, farthest=FAR),
        stopped("arm: .*object 0x6061:00 shows 1 ", cycles=ASKED, farthest=FAR),
        NOT_IN_USE,
    ),
    Row(
        "mode changes, to cyclic torque",
        _one(lambda n: ModeChanges(n, 10)),
        harmless("the tool sets the mode before it enables the drive"),
        stopped("arm: .*object 0x6061:00 shows 10 ", cycles=ASKED, farthest=FAR),
        stopped("arm: .*object 0x6061:00 shows 10 ", cycles=ASKED, farthest=FAR),
        harmless("the mode is set anew before any motion", left=ONE),
    ),
    Row(
        "store fails",
        _one(StoreFails),
        MEASURED,
        MEASURED,
        MEASURED,
        mixed("arm.*0x1010:01"),
    ),
    Row(
        "value refused",
        _one(lambda n: SdoRefused(n, 0x2010, 3, 0x06090031)),
        refused("arm, object 0x2010:03: the drive refused"),
        SEPARATE,
        SEPARATE,
        mixed("arm.*0x2010:03"),
    ),
    Row(
        "value clipped",
        _one(lambda n: WriteAltered(n, 0x2010, 3, 9000)),
        MEASURED,
        MEASURED,
        MEASURED,
        mixed("arm, velocity_i, object 0x2010:03: wrote 16000, the drive holds 9000"),
    ),
    Row(
        "power cut while writing",
        lambda n: (NodeVanishes(n), PowerLoss(n)),
        refused("arm, object 0x1018:02: node 12 did not answer"),
        stopped(NO_PDO, left=ONE),
        stopped(NO_PDO, left=ONE),
        mixed(r"arm.*0x2010"),
    ),
    Row(
        "power cut while storing",
        _one(PowerLossWhileStoring),
        MEASURED,
        MEASURED,
        MEASURED,
        restored("arm, object 0x1010:01"),
    ),
)


def _with_epos4(name: str, kind: str = "epos4", **changes: Any) -> Row:
    """Return a row of the table above for an EPOS4 in the faulty arm."""
    row = next(row for row in ROWS if row.name == name)
    return replace(row, name=f"{kind}: {name}", profile=partial(with_epos4, kind), **changes)


def _dual(name: str, make: Callable[[int], tuple[Fault, ...]], write: Expected, **more: Any) -> Row:
    """Return a fault of an EPOS4 with two loops while it is written to."""
    profile = partial(with_epos4, "epos4-dual-loop")
    kind = f"epos4-dual-loop: {name}"
    return Row(kind, make, MEASURED, MEASURED, MEASURED, write, profile, **more)


MOVING, ANY_TIME = (Moment.STILL, Moment.SWEEP), (Moment.STILL, Moment.SWEEP, Moment.WRITE)
ON_WRITING = (Moment.WRITE,)
LATCH, STORE = (0x30AE, 0x40), (0x1010, 1)
EPOS4_CASES: tuple[tuple[Row, tuple[Moment, ...]], ...] = (
    # its own heartbeat consumer's stop is a fault, and its fault reset waits for an NMT reset
    (_with_epos4("host: bus off"), ANY_TIME),
    (_with_epos4("host: killed"), ANY_TIME),
    (_with_epos4("host: stalled 0.5 s"), MOVING),
    (_with_epos4("drive reboots"), ANY_TIME),
    (_with_epos4("node lost", write=mixed(r"arm \(node 12\).*pid_p 0x30A1:01")), ANY_TIME),
    (_with_epos4("EMCY, over-current, fault"), (Moment.STILL, Moment.WRITE)),
    (_with_epos4("store fails"), ON_WRITING),
    (_with_epos4("power cut while storing"), ON_WRITING),
    (_with_epos4("power cut while writing", write=mixed("arm.*pid_p 0x30A1:01")), ON_WRITING),
    (
        _with_epos4(
            "value refused",
            make=_one(lambda n: SdoRefused(n, 0x30A1, 2, 0x06090031)),
            write=mixed("arm.*pid_i, object 0x30A1:02.*refused"),
        ),
        ON_WRITING,
    ),
    (
        _with_epos4(
            "value clipped",
            make=_one(lambda n: WriteAltered(n, 0x30A1, 2, 1_000_000)),
            write=mixed("arm, pid_i, object 0x30A1:02: wrote 3200000000, the drive holds 1000000 "),
        ),
        ON_WRITING,
    ),
    (
        _dual(
            "second position gain refused",
            _one(lambda n: SdoRefused(n, 0x30AE, 2, 0x06090031)),
            mixed("arm, position_p_high, object 0x30AE:02: .*refused to take 20000"),
        ),
        ON_WRITING,
    ),
    (
        _dual(
            "second position gain clipped",
            _one(lambda n: WriteAltered(n, 0x30AE, 2, 9000)),
            mixed("arm, position_p_high, object 0x30AE:02: wrote 20000, the drive holds 9000"),
        ),
        ON_WRITING,
    ),
    (
        _dual(
            "coefficient",
            lambda _: (),
            harmless("no fault: the coefficient acts, because its latch is set after it"),
        ),
        ON_WRITING,
    ),
    (
        _dual(
            "latch refused",
            _one(lambda n: SdoRefused(n, *LATCH)),
            mixed("arm, object 0x30AE:40: the drive refused.*main_filter_a 0x30AE:10"),
        ),
        ON_WRITING,
    ),
    (
        _dual(
            "lost at its latch",
            _one(NodeVanishes),
            mixed("arm.*0x30AE:40: node 12 did not answer"),
            writing=LATCH,
        ),
        ON_WRITING,
    ),
    (
        _dual(
            "lost before it stores",
            _one(NodeVanishes),
            mixed("arm.*0x1010:01: node 12 did not answer"),
            writing=STORE,
        ),
        ON_WRITING,
    ),
    *(
        (
            _dual(
                f"power cut while storing, memory {bank}",
                _one(partial(PowerLossWhileStoring, bank=bank)),
                restored("arm, object 0x1010:01"),
            ),
            ON_WRITING,
        )
        for bank in ("old", "new", "corrupted")
    ),
)
"""What an EPOS4 does in its own way, and when it is tried."""


def try_row(row: Row, moment: Moment) -> Result:
    """Bring one fault about at one moment."""
    return try_case(
        moment,
        row.make,
        profile=row.profile(),
        factor=row.factor,
        writing=row.writing,
    )


def problems(result: Result, expected: Expected, moment: Moment) -> list[str]:
    """Return what is not as it has to be, one sentence each; none if all is well."""
    found = []
    if result.code not in expected.codes:
        found.append(f"exit code {result.code}, expected {expected.codes}")
    if result.code and not re.search(expected.says, result.said):
        found.append(f"does not say {expected.says!r}")
    if "Traceback" in result.said or "defect of fieldtool" in result.said:
        found.append("an unhandled exception")
    if result.still_on:
        found.append(f"nodes {result.still_on} are under power at the end")
    if result.code and result.enabled_again and not expected.whole:
        found.append("a drive was enabled again after all had reacted")
    found += _reaction(result, expected, moment)
    left = {node: what for node, what in result.changed.items() if node not in expected.left}
    if left:
        found.append(f"not put back: {left}")
    if moment is Moment.WRITE:
        found += _written(result)
    else:
        if result.restored:
            found.append(result.restored)
        if set(result.gains.values()) != {"old"}:
            found.append(f"gains were changed: {result.gains}")
        found += _kept(result, expected, moment)
    return found


def _reaction(result: Result, expected: Expected, moment: Moment) -> list[str]:
    found, watch = [], result.watch
    if moment in (Moment.STILL, Moment.SWEEP) and result.code and not expected.whole:
        if watch.powered_then != NODES:
            found.append(f"only {watch.powered_then} were under power when the fault came")
        told, own = (
            result.cycles(*expected.own),
            max((watch.off.get(node, float("inf")) for node in expected.own), default=0.0),
        )
        if told > expected.cycles + 0.501:  # a look each half cycle
            found.append(
                f"operation enabled for {told:.1f} cycles, {expected.cycles:g} are allowed"
            )
        if own > HEARTBEAT + 0.05:
            found.append(f"under power for {own:.3f} s without its host")
    unseen = watch.unseen.get(ARM, watch.farthest[ARM])
    if expected.unseen is not None and result.code and unseen > expected.unseen:
        found.append(f"its motor went {unseen:.4f} rad unseen, {expected.unseen:g} are allowed")
    farthest = max(watch.farthest.values(), default=0.0)
    if expected.farthest is not None and result.code and farthest > expected.farthest:
        found.append(f"a motor went {farthest:.2f} rad, {expected.farthest:g} rad are allowed")
    return found


def _kept(result: Result, expected: Expected, moment: Moment) -> list[str]:
    if moment is Moment.CONNECTING:
        return []
    if not result.rows:
        return ["nothing was kept"]
    if result.code == 0 or expected.whole:
        return []
    least = LEAST_ROWS[moment]
    if result.rows[-1] < least or result.complete[-1]:
        return [f"the last experiment has {result.rows[-1]} rows of at least {least}"]
    return []


def _written(result: Result) -> list[str]:
    if result.not_acting and result.code in (0, 6):
        return [f"held but not in use, as (in use, held): {result.not_acting}"]
    memory, stored = set(result.gains.values()), set(result.stored.values())
    if result.code == 0 and (memory, stored) != ({"new"}, {"new"}):
        return [f"not all new: working memory {result.gains}, stored {result.stored}"]
    if result.code == 6 and (memory, stored) != ({"old"}, {"old"}):
        return [f"not all old: working memory {result.gains}, stored {result.stored}"]
    return [result.restored] if result.restored else []
