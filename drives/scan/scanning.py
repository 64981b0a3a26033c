"""Find out what is on a bus: listen, ask politely, compare with drive profiles."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import can

from drives import objects
from drives.api import DriveIdentity
from drives.canopen_drive.line import SHORTEST_WAIT, Line
from drives.cia402 import MODE_WORDS, PowerState, modes_in
from drives.errors import BusError
from drives.objects import ObjectInfo
from drives.profile import DriveProfile
from drives.profile.match import Presented, best_matches
from drives.scan.asking import IDENTITY, Asked, Reading, node_to_ask, who_answers
from drives.scan.differences import Fit, with_objects
from drives.scan.needs import ASKED, Need, needs_of
from drives.scan.traffic import NodeTraffic, Traffic, sorted_traffic

NODE_IDS = range(1, 128)
LISTEN = 1.5
"""Seconds of listening before anything is asked; most heartbeats come every second or more often."""
LONGEST = 60.0
"""Seconds that all questions may take; nodes that are left then are listed as not asked."""
NMT_STOPPED = "stopped"

OWN_LIMITS = (
    objects.SOFTWARE_LIMIT_LOW,
    objects.SOFTWARE_LIMIT_HIGH,
    objects.MAX_PROFILE_VELOCITY,
    objects.MAX_MOTOR_SPEED,
    objects.MAX_ACCELERATION,
    objects.MAX_TORQUE,
    objects.FOLLOWING_ERROR_WINDOW,
)
"""What a drive itself is set to allow, in its own units: for the person who enters the limits."""

Progress = Callable[[str, float], None]
"""Is told what is done, and the share of the whole scan that is done."""


@dataclass(frozen=True)
class ScannedNode:
    """What is known of one node."""

    node_id: int
    heard: NodeTraffic
    answers: bool
    """Whether it answered by SDO."""
    identity: DriveIdentity | None = None
    modes: tuple[str, ...] | None = None
    """Modes that 0x6502 offers, in words; None if it does not tell."""
    power: str = ""
    """Power state in words; empty if not known."""
    fits: tuple[Fit, ...] = ()
    """Drive profiles that may fit, best first; the best of the others if none does."""
    needs: tuple[Need, ...] = ()
    readings: tuple[Reading, ...] = ()
    """Every object that it was asked for."""
    problem: str = ""
    """What went wrong with it, in a sentence; empty if nothing did."""

    @property
    def fit(self) -> Fit | None:
        """The drive profile that fits best; None if none does."""
        best = next(iter(self.fits), None)
        return best if best is not None and best.fits else None

    @property
    def lacking(self) -> tuple[Need, ...]:
        """What the tool would miss in it."""
        return tuple(need for need in self.needs if need.found == "missing")

    def number(self, info: ObjectInfo) -> int | None:
        """Return an object's value as it was read; None if it was not."""
        found = next((r for r in self.readings if r.info.address == info.address), None)
        return None if found is None else found.number


@dataclass(frozen=True)
class Scan:
    """What is on a bus."""

    traffic: Traffic
    """What was heard before anything was asked."""
    nodes: tuple[ScannedNode, ...]
    """By node id."""
    asked: bool
    """Whether nodes were asked, or only listened to."""
    problems: tuple[str, ...] = ()
    """What a person has to know, a sentence each."""


def scan(
    bus: can.BusABC,
    bitrate: int,
    profiles: Mapping[str, DriveProfile],
    *,
    listen: float = LISTEN,
    ask: bool | None = None,
    progress: Progress = lambda _what, _share: None,
) -> Scan:
    """Find out what is on a bus; nothing is written and no NMT state is changed.

    Parameters
    ----------
    bus
        Open; it stays open.
    bitrate
        Of the bus, bit/s: for the pace of questions.
    profiles
        Drive profiles to compare with, by name.
    listen
        Seconds of listening before anything is asked.
    ask
        Whether nodes are asked.  None: only if no other master is at work and the bus shows no
        errors without frames; True: also beside another master; False: never.
    progress
        Is told how far it is.

    Raises
    ------
    BusError
        If the bus does not take or deliver frames: nobody acknowledges, or it is off.
    """
    line = Line(bus)
    traffic = listened(line, listen, progress)
    problems = list(_judged(traffic))
    may_ask = not traffic.wrong_bit_rate and (not traffic.commanded if ask is None else ask)
    found = {node.node_id: ScannedNode(node.node_id, node, answers=False) for node in traffic.nodes}
    if not may_ask:
        problems += _not_asked(traffic, ask)
        return Scan(traffic, tuple(found.values()), asked=False, problems=tuple(problems))
    try:
        there = who_answers(
            line,
            NODE_IDS,
            bitrate,
            lambda share: progress("asking who is there", 0.25 + 0.25 * share),
        )
        deadline = line.clock.now() + LONGEST
        for k, node_id in enumerate(sorted(there)):
            progress(f"asking node {node_id}", 0.5 + 0.5 * k / len(there))
            heard = traffic.node(node_id)
            if line.clock.now() > deadline:
                found[node_id] = ScannedNode(
                    node_id, heard, True, problem=f"not asked further: {LONGEST:g} s are over"
                )
                continue
            found[node_id] = _ask_node(line, node_id, heard, profiles)
    except BusError as error:
        raise BusError(_not_taken(traffic, bitrate, error)) from error
    finally:
        for node_id in list(line.nodes):
            del line[node_id]
    progress("done", 1.0)
    found |= {k: _silent(node) for k, node in found.items() if k not in there}
    if not found:
        problems.append(_nobody(traffic, bitrate))
    return Scan(traffic, tuple(found[k] for k in sorted(found)), True, tuple(problems))


def listened(
    line: Line, seconds: float = LISTEN, progress: Progress = lambda _what, _share: None
) -> Traffic:
    """Listen to a bus, and return what was heard, sorted; nothing is sent."""
    frames: list[can.Message] = []
    began = line.clock.now()
    while (gone := line.clock.now() - began) < seconds:
        progress("listening", 0.25 * gone / seconds)
        message = line.pump(max(SHORTEST_WAIT, min(0.1, seconds - gone)))
        if message is not None:
            frames.append(message)
    return sorted_traffic(frames, line.clock.now() - began)


def _judged(traffic: Traffic) -> list[str]:
    found = []
    if traffic.wrong_bit_rate:
        found.append(
            f"{traffic.errors} error frames and not one good frame in {traffic.seconds:.1f} s: the "
            "bus has another bit rate than was given here, or cable or terminators are bad. Nothing "
            "was sent, because a node with the wrong bit rate disturbs all others."
        )
    elif traffic.errors:
        found.append(
            f"{traffic.errors} error frames among {traffic.frames} good ones in "
            f"{traffic.seconds:.1f} s: look at cable, shield and terminators (60 ohm between CAN_H "
            "and CAN_L with the supply off)."
        )
    if traffic.extended:
        found.append(
            f"{traffic.extended} frames have 29-bit identifiers, which CANopen does not use: another "
            "protocol shares this bus."
        )
    return found


def _not_asked(traffic: Traffic, ask: bool | None) -> list[str]:
    if traffic.wrong_bit_rate or ask is False:
        return []
    return [
        f"another master is at work: {', '.join(traffic.commands)} heard in "
        f"{traffic.seconds:.1f} s. Nothing was sent, so that it is not disturbed; only what was heard "
        "is shown. Stop the other controller, or ask all the same with --ask."
    ]


def _not_taken(traffic: Traffic, bitrate: int, error: BusError) -> str:
    heard = f"{traffic.frames} frames were heard" if traffic.frames else "nothing was heard"
    return (
        f"{error} Before, {heard} in {traffic.seconds:.1f} s at {bitrate} bit/s. If nobody acknowledges "
        "frames, no other node is on the bus with this bit rate: are the drives switched on, the cable "
        "plugged in, both ends terminated, and the bit rate theirs?"
    )


def _nobody(traffic: Traffic, bitrate: int) -> str:
    return (
        f"nothing was heard in {traffic.seconds:.1f} s, and none of the 127 node ids answered at "
        f"{bitrate} bit/s. Are the drives switched on, the cable plugged in, both ends terminated, and "
        "is it the drives' bit rate?"
    )


def _silent(node: ScannedNode) -> ScannedNode:
    if node.heard.state == NMT_STOPPED:
        return replace(
            node, problem="NMT state stopped: it answers no questions until somebody starts it"
        )
    return replace(node, problem="was heard, but does not answer when it is asked (SDO)")


def _ask_node(
    line: Line, node_id: int, heard: NodeTraffic, profiles: Mapping[str, DriveProfile]
) -> ScannedNode:
    asked = Asked(node_to_ask(line, node_id))
    who = asked.read_all(IDENTITY)
    asked.read_all((*ASKED, *OWN_LIMITS))
    identity, answers = _identity(who), asked.answers
    modes = answers[objects.SUPPORTED_MODES.address].number
    presented = Presented(who[0].number, who[1].number, who[2].number, modes)
    fits = _fits(asked, presented, profiles)
    is_drive = identity.device_type & 0xFFFF == 402
    state = answers[objects.STATUSWORD.address].number
    return ScannedNode(
        node_id,
        heard,
        answers=True,
        identity=identity,
        modes=None if modes is None else tuple(MODE_WORDS[m] for m in sorted(modes_in(modes))),
        power=_power(state) if is_drive else "",
        fits=fits,
        needs=needs_of(answers, fits[0].match.profile if fits and fits[0].fits else None),
        readings=tuple(answers.values()),
        problem="it stopped to answer in the middle" if asked.silent else "",
    )


def _identity(readings: tuple[Reading, ...]) -> DriveIdentity:
    device, vendor, product, revision, serial = (r.number or 0 for r in readings[:5])
    name, firmware = (r.text for r in readings[5:])
    return DriveIdentity(device, vendor, product, revision, serial, name, firmware)


def _power(statusword: int | None) -> str:
    if statusword is None:
        return ""
    try:
        return PowerState.of(statusword).words
    except ValueError:
        return f"statusword 0x{statusword:04X}"


def _fits(
    asked: Asked, presented: Presented, profiles: Mapping[str, DriveProfile]
) -> tuple[Fit, ...]:
    """Compare identities with all profiles, and objects with those that may fit; best first."""
    matches = best_matches(presented, profiles.values())
    possible = [with_objects(one, asked.read) for one in matches if one.fits]
    if not possible:
        return tuple(Fit(one) for one in matches[:1])
    return tuple(sorted(possible, key=lambda fit: fit.rank, reverse=True))
