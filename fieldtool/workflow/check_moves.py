"""Check a machine by tiny moves; whatever happens, all axes are off afterwards, and all is put back."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from drives.bus import Bus, clock_of
from drives.bus.clock import WallClock
from drives.canopen_drive import CanopenGroup, connect
from drives.errors import DrivesError, SafetyStopError, UserStopError, may_be_enabled
from drives.profile import MachineProfile
from fieldtool.errors import FieldtoolError, PlanRefusedError
from fieldtool.experiment.axes import Axes
from fieldtool.experiment.checks.finding import Findings
from fieldtool.experiment.checks.motion import judged_moves
from fieldtool.experiment.directions import check_directions
from fieldtool.experiment.forecast import Setting
from fieldtool.records.recording import Experiment
from fieldtool.records.session_folder import SessionFolder
from fieldtool.records.yaml_file import write_yaml
from fieldtool.workflow.fast_measuring import planned_before
from fieldtool.workflow.models import prior_model
from fieldtool.workflow.planning import timing, usual_seconds
from fieldtool.workflow.preparation import axes_of, setting_of
from fieldtool.workflow.session import resolved
from fieldtool.writeback.temporary import backed_up, left_axes
from fieldtool.writeback.unfinished import JOURNAL, refuse_unfinished

SESSIONS = Path("sessions")
"""Where a folder is made for as long as drives may hold other values; it stays if the tool is killed."""
ROOM = "room for the sweeps"
MOVE_CHECKS = (ROOM, "direction", "brake and friction", "load at rest")
"""Names of what is checked by moving."""


class MoveChecks:
    """The tiny moves of one machine.

    Parameters
    ----------
    machine
        Its profile.
    findings
        Where what is found goes.
    cycle_time
        Seconds from SYNC to SYNC.
    say
        Is told what is done.
    """

    def __init__(
        self,
        machine: MachineProfile,
        findings: Findings,
        cycle_time: float,
        say: Callable[[str], None],
    ) -> None:
        self._machine, self._findings = machine, findings
        self._cycle_time, self._say = cycle_time, say
        self.moved = False
        """Whether axes were enabled."""
        self.stopped = False
        """Whether a safety stop ended it, or a drive may still be enabled."""
        self.left: list[str] = []
        """Axes whose drives still hold what was set for the moves."""

    def run(self, bus: Bus, stop_requested: Callable[[], bool]) -> None:
        """Plan, move, judge; what goes wrong is a finding.

        Raises
        ------
        UserStopError
            If the user asked to stop; all axes are disabled.
        """
        try:
            with connect(self._machine, bus, stop_requested) as group:
                for text in group.recovered:
                    self._findings.note("fault reset", "pass", text)
                folder = (
                    SESSIONS / f"check-{self._machine.path.stem}-{datetime.now():%Y%m%d-%H%M%S}"
                )
                refuse_unfinished(self._machine.name, group.drives, folder)
                try:
                    with self._noted(group, folder):
                        self._plan_and_move(group)
                finally:
                    self.left = left_axes(group.drives)
                    changed = f"{', '.join(self.left)}: not everything is as it was before"
                    for text in group.warnings or ([changed] if self.left else []):
                        todo = f"Once all drives can be reached again: fieldtool restore {folder}"
                        self._findings.note("put back", "fail", text, todo=todo)
                    self._pace(group, bus)
        except UserStopError:
            raise
        except SafetyStopError as error:
            self.stopped = True
            self._ended(error, error.axis or "")
        except (DrivesError, FieldtoolError) as error:
            self._ended(error, "")

    @contextmanager
    def _noted(self, group: CanopenGroup, path: Path) -> Iterator[None]:
        """Keep what ``fieldtool restore`` needs for as long as drives may hold other values."""
        alone = not path.parent.exists()
        folder = SessionFolder.create(path)
        write_yaml(folder.machine, resolved(self._machine))
        try:
            with backed_up(self._machine.name, group.drives, folder.parameters_before):
                yield
        finally:
            if not (path / JOURNAL).exists():  # else something is left to be restored
                with suppress(OSError):  # what else is in it stays
                    lock = (path / JOURNAL).with_suffix(".lock")
                    for left in (folder.parameters_before, folder.machine, lock):
                        left.unlink(missing_ok=True)
                    path.rmdir()
                    if alone:
                        path.parent.rmdir()

    def _plan_and_move(self, group: CanopenGroup) -> None:
        kept: list[Experiment] = []
        with group.without_feed_forward():
            setting = setting_of(self._machine, group, prior_model(self._machine))
            axes: Axes = axes_of(group, setting)
            self._say("Plan a measurement")
            self._room(group, setting)
            self._say("Move every axis a little, and back")
            self.moved = True
            check_directions(group, axes, self._cycle_time, kept.append)
        units = [drive.position_unit for drive in group.drives]
        torque_units = [drive.torque_unit for drive in group.drives]
        self._findings.add(judged_moves(kept, axes.names, axes.limits, units, torque_units))
        if not group.warnings:
            found = "all axes are disabled, every object is what it was"
            self._findings.note("put back", "pass", found)

    def _room(self, group: CanopenGroup, setting: Setting) -> None:
        """Plan the measurement that would follow, and show how much of the travel it needs."""
        times = timing(setting, usual_seconds(setting.model))
        try:
            planned, _ = planned_before(group, setting, self._cycle_time, times)
        except PlanRefusedError as error:
            self._findings.note(ROOM, "warn", f"no measurement can be planned: {error}")
            return
        for drive, way in zip(group.drives, planned.moves, strict=True):
            low, high = drive.limits.travel
            self._findings.note(
                ROOM,
                "pass",
                f"a measurement moves it by ±{way.excursion:.3g} {drive.position_unit} around "
                f"{(low + high) / 2:.3g}; the travel is ±{(high - low) / 2:.3g}",
                drive.axis,
            )

    def _ended(self, error: Exception, axis: str) -> None:
        self.stopped = self.stopped or may_be_enabled(error)
        text = str(error).removeprefix(f"{axis}: ") if axis else str(error)
        notes = " ".join(getattr(error, "__notes__", ()))
        check = "direction" if axis else "moves"
        self._findings.note(check, "fail", f"{text} {notes}".strip(), axis)
        for other in self._machine.axes:
            if other.name != axis:
                why = "the moves ended before"
                self._findings.note("direction", "not tried", why, other.name)

    def _pace(self, group: CanopenGroup, bus: Bus) -> None:
        if not isinstance(clock_of(bus), WallClock):
            return
        punctual = group.punctuality
        self._findings.note(
            "cycle time",
            "warn" if punctual.late or punctual.overruns else "pass",
            f"while the axes moved: {punctual.sentence}",
            todo=punctual.advice,
        )
