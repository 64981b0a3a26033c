"""Check a machine before its first motion: still first, then, if asked for, by tiny moves."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drives.bus import MAX_CYCLIC_LOAD, Bus, CyclicLoad, close_bus, open_bus, shortest_cycle
from drives.bus.clock import Clock, WallClock
from drives.canopen_drive import CanopenDrive
from drives.canopen_drive.group import profile_of
from drives.canopen_drive.line import Line
from drives.errors import BusError
from drives.profile import AxisProfile, MachineProfile
from drives.scan import Traffic, listened
from drives.trace import trace_problem, traced
from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.checks.finding import Finding, Findings, Status, worst
from fieldtool.experiment.directions import CHECK_MOVE
from fieldtool.experiment.multisine.design import fast_cycle_times
from fieldtool.workflow.check_moves import MOVE_CHECKS, MoveChecks
from fieldtool.workflow.check_still import check_still
from fieldtool.workflow.models import prior_model
from fieldtool.writeback.alone import alone_on

PACE_TIME = 1.0
"""Seconds for which it is tried whether this computer keeps the cycle."""
LATE_SHARE = 0.25
"""Share of a cycle by which the host may be late; as in motion."""
LATE_ALLOWED = 0.01
"""Share of cycles that may be late before it is a warning."""


@dataclass(frozen=True)
class CheckResult:
    """What was found, in the order in which it was checked."""

    machine: str
    findings: tuple[Finding, ...]
    moved: bool
    """Whether axes were enabled and moved."""
    stopped: bool = False
    """Whether a safety stop ended the moves, or a drive may still be enabled after them."""
    not_put_back: tuple[str, ...] = ()
    """Axes whose drives still hold what was set for the moves."""

    @property
    def verdict(self) -> Status:
        """The worst of all; what was not tried counts as a warning."""
        found = worst(self.findings)
        return "warn" if found == "not tried" else found

    @property
    def sentence(self) -> str:
        """The summary."""
        count = dict.fromkeys(("pass", "warn", "fail", "not tried"), 0)
        for one in self.findings:
            count[one.status] += 1
        parts = [f"{count['pass']} passed"]
        parts += [
            f"{count[s]} {w}" for s, w in (("warn", "warnings"), ("fail", "failed")) if count[s]
        ]
        if count["not tried"]:
            parts.append(f"{count['not tried']} not tried")
        return f"{self.machine}: {', '.join(parts)}."

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``--json`` prints them."""
        return {
            "machine": self.machine,
            "verdict": self.verdict,
            "moved": self.moved,
            "not_put_back": list(self.not_put_back),
            "findings": [one.as_dict() for one in self.findings],
        }


def check(
    machine: MachineProfile,
    *,
    may_move: Callable[[], bool] = lambda: False,
    stop_requested: Callable[[], bool] = lambda: False,
    trace: Path | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> CheckResult:
    """Check a machine before its first motion.

    Whatever happens, on leaving the axes are disabled and the drives' objects are what they were.

    Parameters
    ----------
    machine
        Its profile.
    may_move
        Asked once, when nothing speaks against moving: whether the axes may make their tiny moves.
    stop_requested
        Asked in every cycle of a motion.
    trace
        File that every frame is noted in.
    say
        Is told what is checked now.

    Raises
    ------
    ProfileError
        If a drive profile is wrong.
    UserStopError
        If the user asked to stop; all axes are disabled.
    """
    return _Check(machine, may_move, stop_requested, say).run(trace)


class _Check:
    """One check of one machine; what its steps share."""

    def __init__(
        self,
        machine: MachineProfile,
        may_move: Callable[[], bool],
        stop_requested: Callable[[], bool],
        say: Callable[[str], None],
    ) -> None:
        self._machine, self._may_move = machine, may_move
        self._stop_requested, self._say = stop_requested, say
        self._profiles = [profile_of(axis, machine) for axis in machine.axes]
        self._findings = Findings()
        self._moves: MoveChecks | None = None

    def run(self, trace: Path | None) -> CheckResult:
        """Check what can be checked, in order; return all findings."""
        with alone_on(self._machine.bus):
            return self._checked(trace)

    def _checked(self, trace: Path | None) -> CheckResult:
        findings = self._findings
        try:
            opened = open_bus(self._machine.bus)
        except BusError as error:
            findings.note("bus", "fail", str(error))
            return self._result()
        try:
            with traced(opened, trace) as used:
                self._on_bus(used)
                if problem := trace_problem(used):
                    findings.note("trace", "warn", problem)
        except BusError as error:
            findings.note("bus", "fail", str(error))
        finally:
            close_bus(opened)
        return self._result()

    def _result(self) -> CheckResult:
        moves = self._moves
        return CheckResult(
            self._machine.name,
            tuple(self._findings.all),
            moved=moves is not None and moves.moved,
            stopped=moves is not None and moves.stopped,
            not_put_back=() if moves is None else tuple(moves.left),
        )

    def _on_bus(self, bus: Bus) -> None:
        findings, line = self._findings, Line(bus)
        self._say("Listen to the bus")
        if not self._quiet(listened(line)):
            return
        cycle_time = self._cycle_time()
        if cycle_time is not None:
            self._cycle(line.clock, cycle_time)
        self._still(line)
        if cycle_time is None or findings.failed:
            self._not_tried("something above failed, or is not known")
        elif not self._may_move():
            self._not_tried("the axes were not to be moved (--move moves them a little)")
        else:
            self._moves = MoveChecks(self._machine, findings, cycle_time, self._say)
            self._moves.run(bus, self._stop_requested)

    def _quiet(self, traffic: Traffic) -> bool:
        """Judge what was heard; return whether drives may be asked."""
        bus = self._machine.bus
        where = f"{bus.interface} {'' if bus.channel is None else bus.channel}".strip()
        heard = (
            f"{where}, {bus.bitrate} bit/s: {traffic.frames} frames in {traffic.seconds:.1f} s of "
            f"listening, {traffic.errors} error frames"
        )
        if traffic.wrong_bit_rate:
            todo = "Another bit rate than the profile's, or a bad cable or terminator."
            self._findings.note("bus", "fail", heard, todo=todo)
            return False
        if traffic.commanded:
            self._findings.note(
                "one master",
                "fail",
                f"{heard}; somebody else sends {', '.join(traffic.commands)}",
                todo="Two masters must not command one machine: stop the other controller first.",
            )
            return False
        self._findings.note(
            "bus",
            "warn" if traffic.errors else "pass",
            f"{heard}, no other master",
            todo="Look at cable, shield and terminators." if traffic.errors else "",
        )
        return True

    def _cycle_time(self) -> float | None:
        """Return the cycle that a fast measurement begins with; None if none fits."""
        bus = self._machine.bus
        shortest = max(shortest_cycle(len(self._machine.axes), bus.bitrate), bus.shortest_cycle)
        try:
            return fast_cycle_times(prior_model(self._machine), shortest)[0]
        except PlanRefusedError as error:
            self._findings.note("cycle time", "fail", str(error))
            return None

    def _cycle(self, clock: Clock, cycle_time: float) -> None:
        load = CyclicLoad(len(self._machine.axes), cycle_time, self._machine.bus.bitrate)
        self._findings.note(
            "bus load",
            "pass",
            f"{100 * load.share:.0f} % of {load.bitrate} bit/s in the worst case, {load.axes} axes "
            f"every {cycle_time * 1000:g} ms; at most {100 * MAX_CYCLIC_LOAD:.0f} % are used",
        )
        if not isinstance(clock, WallClock):
            return
        self._say("Try whether this computer keeps the cycle")
        late, cycles, latest = keeps_pace(clock, cycle_time)
        bad = late > LATE_ALLOWED * cycles
        self._findings.note(
            "cycle time",
            "warn" if bad else "pass",
            f"{late} of {cycles} cycles of {cycle_time * 1000:g} ms began late, the worst "
            f"{latest * 1000:.2f} ms (without the bus)",
            todo="Close other programs; a longer cycle is tried by itself if needed."
            if bad
            else "",
        )

    def _still(self, line: Line) -> None:
        try:
            for axis, profile in zip(self._machine.axes, self._profiles, strict=True):
                self._say(f"Read {axis.name}")
                check_still(CanopenDrive(line, axis, profile), self._findings)
        finally:
            for node_id in list(line.nodes):
                del line[node_id]

    def _not_tried(self, why: str) -> None:
        for axis in self._machine.axes:
            for name in MOVE_CHECKS:
                self._findings.note(name, "not tried", why, axis.name)


def way_of(axis: AxisProfile) -> float:
    """Return how far an axis moves when it is checked, rad or m."""
    return CHECK_MOVE * (axis.limits.travel[1] - axis.limits.travel[0])


def unit_of(axis: AxisProfile) -> str:
    """Return the unit of an axis' positions."""
    return "rad" if axis.kind == "rotary" else "m"


def keeps_pace(clock: Clock, cycle_time: float) -> tuple[int, int, float]:
    """Wait cycle after cycle for a while; return late cycles, all cycles, and the worst lateness, s."""
    begin, late, worst_lateness = clock.now(), 0, 0.0
    cycles = max(10, round(PACE_TIME / cycle_time))
    for k in range(1, cycles + 1):
        moment = begin + k * cycle_time
        clock.wait_until(moment)
        lateness = clock.now() - moment
        worst_lateness = max(worst_lateness, lateness)
        late += lateness > LATE_SHARE * cycle_time
    return late, cycles, worst_lateness
