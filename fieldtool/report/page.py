"""A report as one HTML file that needs nothing else: no network, no other file.

Everything that comes from files is escaped by the template or, for the figures, as JSON inside a
block that no browser runs.  A content security policy lets the browser run the two scripts of the
page and nothing else, and load nothing.
"""

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from fieldtool.records.files import write_atomic
from fieldtool.report.section import Plot, Plots, Section

DRAW = """
"use strict";
(function () {
  var plots = document.querySelectorAll("[data-figure]");
  var options = {responsive: true, displaylogo: false, displayModeBar: false,
                 showTips: false, showSources: false};
  function draw(place) {
    if (place.dataset.drawn) { return; }
    place.dataset.drawn = "1";
    var figure = JSON.parse(document.getElementById(place.dataset.figure).textContent);
    Plotly.newPlot(place, figure.data, figure.layout, options);
  }
  function near(entries, watch) {
    entries.forEach(function (e) {
      if (e.isIntersecting) { watch.unobserve(e.target); draw(e.target); }
    });
  }
  var watch = new IntersectionObserver(near, {rootMargin: "600px"});
  plots.forEach(function (place) { watch.observe(place); });
  function all() {
    document.querySelectorAll("details").forEach(function (d) { d.open = true; });
    plots.forEach(function (place) { draw(place); Plotly.Plots.resize(place); });
  }
  window.addEventListener("beforeprint", all);
  document.documentElement.dataset.ready = "1";
})();
"""
"""Draws a plot when it comes near the screen, and all of them before the page is printed."""


@dataclass(frozen=True)
class Page:
    """What stands on the page."""

    title: str
    subtitle: str
    verdict: str
    """One plain sentence."""
    tone: str
    """``good``, ``mixed`` or ``open``: colour of the verdict."""
    facts: tuple[tuple[str, str], ...]
    """What was done, in short: name and value."""
    simulated: bool
    sections: tuple[Section, ...]


def html_of(page: Page) -> str:
    """Return the page as one HTML text."""
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(
        files("fieldtool.report").joinpath("page.html.j2").read_text(encoding="utf-8")
    )
    library = get_plotlyjs()
    return template.render(
        page=page,
        version=version("fieldtool"),
        policy=_policy(library, DRAW),
        library=Markup(library),
        draw=Markup(DRAW),
        figures=[(f"figure-{k}", _json(p.figure)) for k, p in enumerate(_plots(page.sections))],
        names=_Names(),
        numeric=_numeric,
    )


def write_page(page: Page, path: Path) -> None:
    """Write the page, in one step.

    Raises
    ------
    OutputError
        If the file can not be written.
    """
    write_atomic(path, html_of(page).encode("utf-8"))


def _policy(*scripts: str) -> str:
    hashes = " ".join(
        "'sha256-" + base64.b64encode(hashlib.sha256(s.encode("utf-8")).digest()).decode() + "'"
        for s in scripts
    )
    return (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data: blob:; "
        "base-uri 'none'; form-action 'none'"
    )


def _plots(sections: Sequence[Section]) -> list[Plot]:
    """All plots in the order in which the page shows them."""
    out: list[Plot] = []
    for section in sections:
        for block in section.blocks:
            if isinstance(block, Plot):
                out.append(block)
            elif isinstance(block, Plots):
                out += block.plots
    return out


class _Names:
    """Names of the figures, in the order in which the page asks for them."""

    def __init__(self) -> None:
        self._count = 0

    def next(self) -> str:
        """Return the next one."""
        self._count += 1
        return f"figure-{self._count - 1}"


def _json(figure: Any) -> Markup:
    """JSON that can not end the block that it stands in."""
    text = json.dumps(figure, allow_nan=False, separators=(",", ":"))
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)


def _numeric(cell: str) -> bool:
    """Whether a cell begins with a number."""
    head = cell.strip().lstrip("±+-−").split(" ", 1)[0]
    return bool(head) and head[0].isdigit()
