"""The report: whole, inert whatever the names are, and true to what it is made from."""

import base64
import hashlib
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from drives.objects import ObjectAddress, ObjectInfo
from drives.parameters import DriveRecord, Journal, JournalEntry, Storing
from drives.parameters.journal import State
from fieldtool.cli.main import main
from fieldtool.criticise.criticise import criticise
from fieldtool.criticise.criticism_file import read_criticism
from fieldtool.criticise.pictured import pictures_of
from fieldtool.criticise.pictures_file import NOISE_ONLY, Series, load_pictures, save_pictures
from fieldtool.design.tuning import AxisTuning, Tuning
from fieldtool.errors import FileFormatError
from fieldtool.records.model import Estimate
from fieldtool.records.model_file import write_model
from fieldtool.records.recording import save
from fieldtool.records.session_folder import SessionFolder
from fieldtool.records.yaml_file import write_yaml
from fieldtool.report.contents import page_of
from fieldtool.report.figures import log_ticks
from fieldtool.report.material import Material
from fieldtool.report.page import Page, html_of
from fieldtool.report.part_done import facts, missing
from fieldtool.report.part_parameters import parameters
from fieldtool.report.part_verification import verification
from fieldtool.report.part_wrong import wrong
from fieldtool.report.section import Plot, Section, Table, Words
from fieldtool.report.trial_file import AxisTrial, Figures, TrialFile
from fieldtool.report.verdict import verdict
from fieldtool.workflow.reporting import material_of, report
from tests.fuzzed import changed, places
from tests.unit.late_axis import FINE, MODEL, STEP, recorded

HOSTILE = "</script><script>alert(1)</script> \"'><img src=x onerror=alert(2)> {{7*7}} & \u2028"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((path for name in BROWSERS if (path := shutil.which(name))), None)


class Elements(HTMLParser):
    """Start tags with their attributes, and the texts of scripts."""

    def __init__(self):
        super().__init__()
        self.tags, self.scripts, self._inside = [], [], None

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag == "script":
            self._inside = [dict(attrs).get("type", ""), ""]

    def handle_data(self, data):
        if self._inside is not None:
            self._inside[1] += data

    def handle_endtag(self, tag):
        if tag == "script" and self._inside is not None:
            self.scripts.append(tuple(self._inside))
            self._inside = None


def elements(html):
    parser = Elements()
    parser.feed(html)
    parser.close()
    return parser


def page(text):
    figure = {"data": [{"type": "scatter", "x": [1, 2], "y": [1, 2], "name": text}], "layout": {}}
    return Page(
        text, text, text, "good", ((text, text),), True,
        (
            Section(text, text, (Words((text,)), Table((text,), ((text,),)), Plot(figure, text))),
            Section(text, text, (Words((text,), "list"), Words((text,), "command")), folded=True),
        ),
    )  # fmt: skip


def assert_inert(html, text):
    found = elements(html)
    kinds = [kind for kind, _ in found.scripts]
    assert kinds.count("") == 2  # the library, and what draws
    assert kinds.count("application/json") == len(kinds) - 2
    allowed = {"html", "head", "meta", "title", "style", "body", "main", "header", "h1", "h2", "p",
               "dl", "dt", "dd", "nav", "a", "noscript", "section", "figure", "figcaption", "div",
               "table", "caption", "thead", "tbody", "tr", "th", "td", "ul", "li", "pre", "details",
               "summary", "footer", "script"}  # fmt: skip
    assert {tag for tag, _ in found.tags} <= allowed
    for tag, attributes in found.tags:
        assert not {name for name in attributes if name.startswith("on")}
        assert attributes.get("href", "#").startswith("#"), tag
        assert "src" not in attributes
    figures = [json.loads(body) for kind, body in found.scripts if kind]
    assert all(f["data"][0]["name"] == text for f in figures)


@given(text=st.text(max_size=60) | st.just(HOSTILE))
@settings(max_examples=12, deadline=None)
def test_no_text_becomes_anything_but_text(text):
    text = text.replace("\x00", "").replace("\r", "")
    assert_inert(html_of(page(text)), text)


def test_the_policy_names_the_two_scripts_and_nothing_else():
    html = html_of(page("plain"))
    found = elements(html)
    policy = next(a["content"] for t, a in found.tags if t == "meta" and "http-equiv" in a)
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    hashes = set(re.findall(r"'sha256-([^']+)'", policy))
    code = [body for kind, body in found.scripts if not kind]
    assert hashes == {base64.b64encode(hashlib.sha256(c.encode()).digest()).decode() for c in code}
    assert "unsafe-eval" not in policy
    assert "http" not in policy


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A folder with a recording, a model, and a criticism that names a delay."""
    folder = SessionFolder.create(tmp_path_factory.mktemp("session") / "s")
    recording = recorded(
        np.random.default_rng(5), 12 * STEP / FINE, " <b>", HOSTILE.replace("\u2028", "")
    )
    save(recording, folder.recording)
    found = criticise(recording, MODEL, MODEL)
    write_model(found.criticism.model, folder.model)
    write_yaml(folder.criticism, found.criticism.as_dict())
    save_pictures(pictures_of(found.found), folder.views)
    folder.note("session", machine=HOSTILE, command="measure", options={"plan": "fast"})
    folder.note("warning", text=HOSTILE)
    return folder, found


def test_a_criticism_is_read_as_it_was_written(session):
    folder, found = session
    again = read_criticism(folder.criticism, found.criticism.model)
    assert again.as_dict() == found.criticism.as_dict()
    assert again.causes[0].effect == "measurement_delay"


def test_a_criticism_with_a_wrong_key_is_refused_with_its_line(session, tmp_path):
    folder, found = session
    data = yaml.safe_load(folder.criticism.read_text())
    data["causes"][0]["gain"] = "much"
    path = tmp_path / "criticism.yaml"
    write_yaml(path, data)
    with pytest.raises(FileFormatError, match=r"criticism.yaml:\d+: 'causes, number 1, gain'"):
        read_criticism(path, found.criticism.model)


def test_pictures_survive_their_file_and_speak_of_the_cause(session):
    folder, found = session
    seen = load_pictures(folder.views)
    made = pictures_of(found.found)
    assert [(p.axis, p.kind, p.sentence) for p in seen] == [
        (p.axis, p.kind, p.sentence) for p in made
    ]
    for one, other in zip(seen, made, strict=True):
        for a, b in zip(one.series, other.series, strict=True):
            assert np.array_equal(a.y, b.y, equal_nan=True)
    by = {(p.axis, p.kind): p for p in seen}
    # A delay is linear, of the axis' own motion, and leaves nothing between the lines.
    assert "own motion" in by["b", "follows"].sentence
    assert "own motion" in by["b", "axes"].sentence
    assert "below 1 % of the torque" in by["b", "lines"].sentence
    assert "one size" in by["b", "amplitude"].sentence
    assert "no drift" in by["b", "session"].sentence
    before, after = by["b", "session"].series
    assert np.median(after.y) < 0.5 * np.median(before.y)


def test_a_report_says_cause_numbers_and_gain_in_words(session, tmp_path):
    folder, found = session
    html = report(folder.path, tmp_path / "r.html").read_text(encoding="utf-8")
    text = re.sub(r"<[^>]+>", " ", html.split('<script type="application/json"')[0])
    assert "a position that is measured late of b (motor)" in text
    held = found.criticism.held_out
    assert f"{100 * held.error_before['b'].torque:.2g} %" in text
    assert "What was rejected, and why" in text
    assert "no controller was designed" in text  # this session has not come so far
    assert "What is missing" in text


def test_a_recordings_own_words_are_inert_in_its_report(session, tmp_path):
    folder, _ = session
    html = report(folder.path, tmp_path / "r.html").read_text(encoding="utf-8")
    found = elements(html)
    assert [kind for kind, _ in found.scripts].count("") == 2
    assert not [1 for tag, _ in found.tags if tag == "img"]
    assert "alert(1)" in html  # it is there, as text


@pytest.mark.parametrize(
    "left", [("recording.h5",), ("recording.h5", "model.yaml"), ("events.jsonl",)]
)
def test_part_of_a_folder_has_a_report_that_says_what_is_missing(session, tmp_path, left):
    folder, _ = session
    part = tmp_path / "part"
    part.mkdir()
    for name in left:
        shutil.copy(folder.path / name, part / name)
    html = report(part).read_text(encoding="utf-8")
    assert "What is missing" in html
    lacking = "not identified" if "model.yaml" not in left else "not criticised"
    assert lacking in html


def test_a_damaged_file_is_named_and_the_rest_is_shown(session, tmp_path):
    folder, _ = session
    part = tmp_path / "part"
    shutil.copytree(folder.path, part)
    (part / "criticism.yaml").write_text("format: [\n")
    (part / "criticism-views.h5").write_bytes(b"nothing")
    material = material_of(SessionFolder(part))
    assert material.model is not None
    assert material.criticism is None
    assert any("criticism.yaml can not be read" in sentence for sentence in material.missing)
    assert report(part).is_file()


TRIAL = """format: fieldtool-verification/1
sentence: The new parameters stood their trial on the machine.
axes:
- axis: table
  unit: rad
  before: {overshoot: 0.02, settling_time: null}
  after: {overshoot: 0.01}
  sensitivity: {after: {frequency: [1.0, 2.0], size: [0.5, .nan]}}
  curves: {time: [0.0, 0.1], after: [0.0, 1.0]}
notes: []
"""


def with_trial(session, tmp_path, text):
    part = tmp_path / "part"
    shutil.copytree(session[0].path, part)
    (part / "verification.yaml").write_text(text, encoding="utf-8")
    return part


def test_a_trial_is_shown_and_what_is_no_number_is_a_gap(session, tmp_path):
    part = with_trial(session, tmp_path, TRIAL)
    html = report(part).read_text(encoding="utf-8")
    assert "The new parameters stood their trial on the machine." in html
    assert '"y":[0.5,null]' in html
    assert "verification.yaml" not in html


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("x: 2020-13-45", "", "YAML can not build"),
        ("x: !!int abc", "", "YAML can not build"),
        ("x: !!timestamp 1", "", "YAML can not build"),
        ("x: " + "[" * 5000, ":1", "nested too deeply"),
        ("a: &a [*a]", ":1", "uses a YAML alias"),
        (TRIAL.replace("- axis: table\n  unit", "- unit"), ":4", "the key 'axis number 1, axis'"),
        (TRIAL.replace("axes:", "axes: [a]\nrest:"), ":3", "keys with values belong here"),
        (TRIAL.replace("overshoot: 0.01", "overshoot: much"), ":7", "a number belongs here"),
        (TRIAL.replace("overshoot: 0.01", "overshoot: .inf"), ":7", "finite"),
        (TRIAL.replace("time: [0.0,", "time: [2020-01-01,"), ":9", "a number belongs here"),
        (TRIAL.replace("time: [0.0,", "time: ["), ":9", "not of one length"),
        (TRIAL.replace("size: [0.5,", "size: ["), ":8", "not of one length"),
        (TRIAL.replace("cation/1", "cation/2"), ":1", "has to be fieldtool-verification/1"),
        ("[1, 2]", ":1", "keys with values belong here"),
        ("", "", "is empty"),
    ],
)
def test_a_damaged_trial_is_named_with_its_line_and_the_rest_is_shown(
    session, tmp_path, capsys, text, line, said
):
    part = with_trial(session, tmp_path, text)
    (refused,) = [s for s in material_of(SessionFolder(part)).missing if "verification" in s]
    assert refused.startswith("verification.yaml can not be read: ")
    assert f"verification.yaml{line}: " in refused
    assert said in refused
    with pytest.raises(SystemExit) as ended:
        main(["report", str(part)])
    assert ended.value.code == 0, capsys.readouterr().err
    html = (part / "report.html").read_text(encoding="utf-8")
    assert "verification.yaml can not be read" in html
    assert "Measured and modelled responses" in html


@pytest.mark.parametrize("content", [b"nothing", b""])
def test_a_damaged_recording_of_a_trial_is_named(session, tmp_path, content):
    part = tmp_path / "part"
    shutil.copytree(session[0].path, part)
    shutil.copy(part / "recording.h5", part / "verification.h5")
    seconds = material_of(SessionFolder(part)).trial_seconds
    assert seconds > 0
    (part / "verification-2.h5").write_bytes(content)
    material = material_of(SessionFolder(part))
    assert material.trial_seconds == seconds
    assert material.trial_experiments == tuple(e.name for e in material.recording.experiments)
    assert any("verification-2.h5 can not be read" in sentence for sentence in material.missing)
    assert report(part).is_file()


def test_pictures_with_a_value_of_another_type_are_named(session, tmp_path):
    part = tmp_path / "part"
    shutil.copytree(session[0].path, part)
    with h5py.File(part / "criticism-views.h5", "r+") as file:
        file["pictures/0000"].attrs["logarithmic"] = 1j
    material = material_of(SessionFolder(part))
    assert material.pictures == ()
    assert any("criticism-views.h5 can not be read" in s for s in material.missing)


@pytest.mark.parametrize("x", [[3.0, 99.0], [np.nan], [-1.0], [0.5]])
def test_pictures_of_places_that_are_not_there_are_named(session, tmp_path, x):
    one = replace(
        load_pictures(session[0].views)[0],
        series=(Series("error", np.array(x), np.zeros(len(x))),),
        categories=("a", "b", "c", "d"),
    )
    part = tmp_path / "part"
    shutil.copytree(session[0].path, part)
    save_pictures((one,), part / "criticism-views.h5")
    material = material_of(SessionFolder(part))
    assert material.pictures == ()
    assert any("no place among 4 categories" in s for s in material.missing)


@pytest.mark.parametrize(
    "value",
    [[1], {"a": 1}, None, 1e999, True, 10**200, 10**3000, json.loads("[" * 300 + "]" * 300), "\u2028",
     "0001-01-01T00:00:00+23:59", "9999-12-31T23:59:59-23:59", -1],
    ids=lambda value: str(value)[:8],
)  # fmt: skip
def test_events_with_any_values_are_shown_or_counted(session, tmp_path, value):
    """Each value of each kind of event, one after the other."""
    part = tmp_path / "part"
    shutil.copytree(session[0].path, part)
    tuning = Tuning((AxisTuning("table", {"velocity_p": 4.2}, 1.5, "why"),))
    whole = {
        "session": {"command": "run", "options": {"plan": "fast"}},
        "drive": {"axis": "table", "name": "epos4"},
        "parameters": {"rows": [{"axis": "table", "name": "velocity_p", "before": 1, "after": 3}]},
        "write": {"written": True, "stored": False},
        "warning": {"text": "none"},
        "ended": {"error": "X", "text": "stopped"},
    }
    lines = []
    for kind, held in whole.items():
        event = {"time": "2026-11-27T09:00:00+00:00", "event": kind, **held}
        ways = [where for where in places(event) if where]
        lines += [json.dumps(changed(event, way, value, "replace")) for way in ways]
    (part / "events.jsonl").write_text("\n".join(lines) + "\n")
    material = replace(material_of(SessionFolder(part)), tuning=tuning)
    counted = sum("lines that are no events" in sentence for sentence in material.missing)
    assert len(material.events) == len(lines) or counted
    assert "<html" in html_of(page_of(material))


def test_a_stopped_session_says_how_it_ended(session, tmp_path):
    folder, _ = session
    part = tmp_path / "part"
    part.mkdir()
    shutil.copy(folder.recording, part)
    SessionFolder(part).note("ended", error="UserStopError", text="stopped by the user")
    html = report(part).read_text(encoding="utf-8")
    assert "did not come to its end" in html
    assert "The machine was measured; it was not identified." in html


def test_how_the_last_command_ended_is_said_of_it_alone():
    first = {"event": "session", "command": "run"}
    second = {"event": "session", "command": "write"}
    stopped = {"event": "ended", "error": "UserStopError", "text": "stopped by the user"}
    failed = {"event": "ended", "error": "WriteBackError", "text": "do not stand their trial"}

    def part(*events):
        return missing(Material("s", events=events))

    assert part(first, stopped).lead == "This session did not come to its end."
    again = part(first, stopped, second, stopped)
    assert again.title == "How it ended", "nothing is missing"
    assert again.lead.startswith("The session's last command, write of ")
    assert again.lead.endswith(", did not come to its end."), "whose data are shown is not known"
    back = part(first, stopped, second, failed)
    assert back.lead.endswith(", took the new parameters back.")
    assert back.blocks[0].sentences == ("do not stand their trial",)
    assert "ended early" not in verdict(Material("s", events=(first, failed)))[0]
    assert part(first, stopped, second, {"event": "ended"}) is None


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("before: nudge of a", "before, begun again (1): move of a"), "old parameters, 3 s"),
        (("before: move of a", "after: nudge of a"), "old and new parameters, 3 s"),
        (("before: move of a", "cut off while the axes moved"), "parameters, 3 s"),
    ],
)
def test_what_was_tried_is_what_moved_the_axes(names, said):
    shown = dict(facts(Material("s", trial_seconds=3.0, trial_experiments=names)))
    assert shown["Tried"] == f"{said} of machine time"


@pytest.mark.parametrize("kind", ["none", "empty", "file"])
def test_what_is_no_session_is_refused_in_one_sentence(tmp_path, capsys, kind):
    path = tmp_path / "x"
    if kind == "empty":
        path.mkdir()
    elif kind == "file":
        path.write_text("text")
    with pytest.raises(SystemExit) as ended:
        main(["report", str(path)])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert {"none": "does not exist", "empty": "no session folder", "file": "is a file"}[
        kind
    ] in said


def test_json_says_where_the_report_is(session, tmp_path, capsys):
    folder, _ = session
    out = tmp_path / "r.html"
    with pytest.raises(SystemExit) as ended:
        main(["report", str(folder.path), "--out", str(out), "--json"])
    assert ended.value.code == 0
    said = json.loads(capsys.readouterr().out)
    assert said == {"report": str(out), "bytes": out.stat().st_size}
    assert 1e6 < said["bytes"] < 8e6


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on this computer")
def test_a_browser_draws_all_of_it_asks_for_nothing_and_complains_of_nothing(session, tmp_path):
    browsers = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    folder, _ = session
    path = report(folder.path, tmp_path / "r.html")
    complaints, asked, dialogs = [], [], []
    with browsers.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        try:
            tab = browser.new_page(viewport={"width": 1200, "height": 900})
            tab.on("console", lambda message: complaints.append(message.text))
            tab.on("pageerror", lambda error: complaints.append(str(error)))
            tab.on("request", lambda request: asked.append(request.url))
            tab.on("dialog", lambda dialog: (dialogs.append(dialog.message), dialog.dismiss()))
            tab.goto(path.as_uri())
            tab.evaluate("window.dispatchEvent(new Event('beforeprint'))")
            wanted = tab.evaluate("document.querySelectorAll('[data-figure]').length")
            tab.wait_for_function(
                "n => document.querySelectorAll('[data-figure] svg.main-svg').length >= n",
                arg=wanted,
            )
            wide = tab.evaluate("document.documentElement.scrollWidth")
            printed = tab.pdf()
        finally:
            browser.close()
    assert wanted > 20
    assert complaints == []
    assert dialogs == []
    assert asked == [path.as_uri()]
    assert wide <= 1200
    assert printed.startswith(b"%PDF")


def test_numbers_of_unknown_error_are_said_to_be_unknown(session, tmp_path):
    folder, found = session
    part = tmp_path / "part"
    shutil.copytree(folder.path, part)
    axes = tuple(
        replace(a, masses=tuple(Estimate(m.value) for m in a.masses))
        for a in found.criticism.model.axes
    )
    write_model(replace(found.criticism.model, axes=axes), Path(part / "model.yaml"))
    assert "± not known" in report(part).read_text(encoding="utf-8")


def test_what_was_written_is_told_from_what_was_designed_or_tried_later():
    tuning = Tuning((AxisTuning("table", {"velocity_p": 4.2}, 1.5, "the design of today."),))
    written = {"axis": "table", "name": "velocity_p", "before": 1.0, "after": 3.1, "unit": "1"}
    later = [
        {"event": "session", "command": "run"},
        {"event": "parameters", "rows": [written]},
        {"event": "write", "written": True},
        {"event": "session", "command": "write"},
        {"event": "parameters", "rows": [{**written, "after": 4.2}]},
        {"event": "write", "written": False},
    ]
    section = parameters(Material("x", tuning=tuning, events=tuple(later)))
    table, warning, _ = section.blocks
    assert table.rows[0][3] == "3.1"
    assert "were not written" in warning.sentences[0]
    assert section.lead.startswith("Written into the drives")
    back = [*later, {"event": "restored", "without": ["arm"]}]
    section = parameters(Material("x", tuning=tuning, events=tuple(back)))
    assert section.lead.endswith("old ones were brought back (`fieldtool restore`), but for arm.")
    back[-1]["without"] = 7  # a log that was edited costs a name, and no report
    section = parameters(Material("x", tuning=tuning, events=tuple(back)))
    assert section.lead.endswith("brought back (`fieldtool restore`).")
    section = parameters(Material("x", tuning=tuning, events=(*back, later[2])))
    assert "not stored" in section.lead, "written once more"
    told = replace(tuning, notes=("table: gives up stiffness.",))
    section = parameters(Material("x", tuning=told, events=tuple(later)))
    assert section.blocks[-1].sentences == told.notes
    section = parameters(Material("x", tuning=tuning, events=tuple(later[3:])))
    table, _ = section.blocks
    assert table.rows[0][3] == "4.2"
    assert "nothing was written" in section.lead


def journal(state, begun="2026-01-02T03:04:05+00:00"):
    info = ObjectInfo(ObjectAddress(0x2010, 2), "UNSIGNED32", "gain")
    entries = (JournalEntry(info, 1, 2),)
    drive = DriveRecord("table", 11, 0, 0, 0, 0, entries)
    return Journal("m", begun, "parameters-before.yaml", Storing.NONE, (drive,), state=state)


WROTE = {"event": "write", "written": True, "stored": True}
RESTORED = {"event": "restored", "stored": True, "time": "2026-01-02T03:04:09.123+00:00"}
TAKEN_BACK = "Written into the drives and taken back: the drives hold what they held before."


@pytest.mark.parametrize(
    ("events", "held", "said"),
    [
        ([], None, "Designed; nothing was written into the drives."),
        (["restored"], None, TAKEN_BACK),
        ([], State.OLD, TAKEN_BACK),
        ([WROTE, "restored"], State.OLD, "What was written later was taken back."),
        ([WROTE, RESTORED, "restored"], State.OLD, "What was written later was taken back."),
        (["mixed"], None, "what they hold is not known"),
        (["mixed", RESTORED], State.OLD, "afterwards the old ones were brought back"),
        ([WROTE], State.OPEN, "what they hold is not known"),
        ([WROTE, RESTORED], State.OPEN, "afterwards the old ones were brought back"),
        ([RESTORED], State.OLD, "Written into the drives in whole or in part; afterwards"),
        ([], State.NEW, "does not say whether they are stored"),
        (["verified", WROTE], State.NEW, "stored in their non-volatile memory."),
    ],
)
def test_what_was_written_and_taken_back_is_never_called_not_written(events, held, said):
    verdicts = [
        {"event": "verified", "verdict": one} if isinstance(one, str) else one for one in events
    ]
    tuning = Tuning((AxisTuning("table", {"velocity_p": 4.2}, 1.5, "why"),))
    material = Material(
        "x",
        tuning=tuning,
        events=({"event": "session"}, *verdicts),
        journal=None if held is None else journal(held),
    )
    assert said in parameters(material).lead


def test_a_write_that_was_cut_off_after_a_restore_is_not_called_brought_back():
    events = ({"event": "session"}, WROTE, RESTORED)
    tuning = Tuning((AxisTuning("table", {"velocity_p": 4.2}, 1.5, "why"),))
    since = journal(State.OPEN, "2026-01-02T03:05:00+00:00")
    material = Material("x", tuning=tuning, events=events, journal=since)
    assert "what they hold is not known" in parameters(material).lead


def test_a_trial_that_was_stood_is_said_to_be_taken_back_since():
    sentence = "The new parameters stood their trial on the machine."
    trial = TrialFile(format="fieldtool-verification/1", sentence=sentence, axes=[])
    stood = [{"event": "verified", "verdict": "verified"}, {"event": "write", "written": True}]
    back = {"event": "restored", "stored": False, "backup": "parameters-before.yaml"}

    def lead(*events):
        return verification(Material("s", trial=trial, events=events)).lead

    assert lead(*stood) == lead(back, *stood) == lead() == sentence
    assert lead(*stood, back) == (
        f"{sentence} Since then the old ones were brought back (`fieldtool restore`)."
    )
    failed = {"event": "verified", "verdict": "restored"}
    assert lead(failed, back) == sentence, "which says it"


@pytest.mark.parametrize("log", [b"\xff\x00 no log\n", b"[1]\n", b"{\n" * 9, None])
def test_a_log_that_tells_nothing_is_said_and_nothing_is_claimed_from_it(session, tmp_path, log):
    folder, _ = session
    part = tmp_path / "part"
    shutil.copytree(folder.path, part)
    (part / "events.jsonl").unlink(missing_ok=True)
    if log is not None:
        (part / "events.jsonl").write_bytes(log)
    material = material_of(SessionFolder(part))
    assert [sentence for sentence in material.missing if "events.jsonl" in sentence]
    tuning = Tuning((AxisTuning("table", {"velocity_p": 4.2}, 1.5, "why"),))
    assert "not known" in parameters(replace(material, tuning=tuning)).lead


def test_an_event_that_was_cut_off_costs_no_other(session, tmp_path):
    folder, _ = session
    part = tmp_path / "part"
    shutil.copytree(folder.path, part)
    (part / "events.jsonl").write_text(
        '{"event": "session"}\n{"event": "wri{"event"}\n{"event": "x"}\n'
    )
    material = material_of(SessionFolder(part))
    assert [event["event"] for event in material.events] == ["session", "x"]
    assert [
        one for one in material.missing if one.startswith("events.jsonl: lines that are no events")
    ]


@given(
    st.floats(-9, 9).flatmap(lambda low: st.tuples(st.just(low), st.floats(low + 0.05, low + 12)))
)
@settings(deadline=None)
def test_a_logarithmic_axis_has_labels_that_are_numbers_of_their_own(span):
    low, high = span
    axis = {}
    log_ticks(axis, 10 ** np.array([low, high]))
    labels = [text.replace("<sup>", "e").replace("</sup>", "") for text in axis["ticktext"]]
    read = [float(text.replace("·10e", "e").replace("10e", "1e")) for text in labels]
    assert read == pytest.approx(axis["tickvals"])
    seen = sum(low - 1e-9 <= np.log10(v) <= high + 1e-9 for v in axis["tickvals"])
    assert seen <= 18
    assert seen >= 2 or high - low < 0.35


@pytest.mark.parametrize("odd", [5e-324, 1e-305, 1.7e308, np.inf, np.nan, 0.0, -1.0])
def test_numbers_at_the_end_of_all_numbers_have_no_labels(odd):
    axis, alone = {}, {}
    log_ticks(axis, np.array([odd, 1.0, 30.0]))
    assert (
        axis["ticktext"]
        == ["1", "2", "5", "10", "20", "50", "100", "200", "500"][: len(axis["tickvals"])]
    )
    log_ticks(alone, np.array([odd]))
    assert alone == {}


def test_before_and_after_have_units_and_a_move_that_ends_in_its_band_settles_at_once():
    figures = {"settling_time": 0.0, "overshoot": 0.012, "peak_torque": 3.5}
    part = verification(
        Material(
            "s",
            trial=TrialFile(
                format="fieldtool-verification/1",
                sentence="",
                axes=[AxisTrial(axis="slide", unit="m", after=Figures(**figures))],
            ),
        )
    )
    table = next(block for block in part.blocks if block.is_a == "table")
    rows = {row[1]: row for row in table.rows}
    assert rows["settles after the move in"][-2:] == ("at once", "")
    assert rows["overshoot"][-2:] == ("0.012", "m")
    assert rows["torque"][-2:] == ("3.5", "N")


@pytest.mark.parametrize("verdict", ["adequate", "unexplained"])
def test_pictures_of_noise_stand_under_no_heading_of_what_is_wrong(session, verdict):
    found = material_of(session[0])
    quiet = [replace(p, sentence=NOISE_ONLY) for p in found.pictures]
    criticism = replace(found.criticism, verdict=verdict, causes=())
    part = wrong(replace(found, criticism=criticism, pictures=tuple(quiet)))
    assert part.folded == (verdict == "adequate")
    assert ("wrong" in part.title) == (verdict != "adequate")
    assert any(block.is_a == "plots" for block in part.blocks) == (verdict == "adequate")
    if verdict != "adequate":
        assert any(NOISE_ONLY in str(block) for block in part.blocks)
