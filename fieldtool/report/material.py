"""Everything that a report is made from, as far as it is there."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from drives.parameters import Journal
from drives.profile import MachineProfile
from fieldtool.criticise.criticism import Criticism
from fieldtool.criticise.pictures_file import Picture
from fieldtool.design.tuning import Tuning
from fieldtool.frf.response import FrequencyResponse, ModelBand
from fieldtool.records.model import MachineModel
from fieldtool.records.recording import Recording
from fieldtool.report.trial_file import TrialFile

Event = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Material:
    """What a session folder, or a recording, holds; None or empty where it does not."""

    name: str
    """Of the folder or file."""
    machine: MachineProfile | None = None
    simulated: bool = False
    prior: MachineModel | None = None
    """The machine as last accepted."""
    truth: MachineModel | None = None
    """What a simulated machine really is."""
    recording: Recording | None = None
    trial_seconds: float = 0.0
    """Seconds in which new parameters were tried, old ones beside them; not in the recording."""
    trial_experiments: tuple[str, ...] = ()
    """Their names, which begin with ``before`` (old parameters) or ``after`` (new ones)."""
    responses: Mapping[str, FrequencyResponse] = field(default_factory=dict)
    band: ModelBand | None = None
    """How well the identified model's response is known."""
    model: MachineModel | None = None
    criticism: Criticism | None = None
    pictures: tuple[Picture, ...] = ()
    tuning: Tuning | None = None
    trial: TrialFile | None = None
    """What the trial of new parameters showed."""
    journal: Journal | None = None
    """Of the last write into the drives."""
    events: tuple[Event, ...] = ()
    missing: tuple[str, ...] = ()
    """One sentence for each thing that is not there, or can not be read."""

    @property
    def torque_units(self) -> tuple[str, ...]:
        """One an axis; empty where no recording says."""
        return tuple(a.torque_unit for a in self.recording.axes) if self.recording else ()

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes."""
        for holder in (self.recording, self.model):
            if holder is not None:
                return holder.names
        return tuple(a.name for a in self.machine.axes) if self.machine else ()

    def events_of(self, kind: str) -> tuple[Event, ...]:
        """Return the events of one kind, in order."""
        return tuple(e for e in self.events if e.get("event") == kind)

    @property
    def ended(self) -> Event | None:
        """How the last command ended, where that was not as it should; None otherwise."""
        begun = [k for k, event in enumerate(self.events) if event.get("event") == "session"]
        last = self.events[begun[-1] :] if begun else self.events
        ends = [event for event in last if event.get("event") == "ended" and event.get("text")]
        return ends[-1] if ends else None

    @property
    def begun(self) -> datetime | None:
        """When the first session of the folder began, in local time."""
        for event in self.events:
            try:
                return datetime.fromisoformat(str(event.get("time"))).astimezone()
            except (ValueError, OverflowError, OSError):
                continue
        return None
