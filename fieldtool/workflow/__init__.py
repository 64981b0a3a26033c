"""The composition root: one function a session, stages in order.

This is the only place that knows all stages, and, with criticism, the only one that knows that a
simulation may stand behind the bus.
"""

from fieldtool.workflow.checking import CheckResult, check
from fieldtool.workflow.criticising import criticise_source as criticise
from fieldtool.workflow.designing import redesign
from fieldtool.workflow.distinguishing import Distinguished, distinguish
from fieldtool.workflow.fast_measuring import plan
from fieldtool.workflow.models import prior_model, simulated_words, truth_model
from fieldtool.workflow.next_plan import next_plan
from fieldtool.workflow.recordings import compare, export_folder, import_folder, simulate
from fieldtool.workflow.reporting import report
from fieldtool.workflow.session import (
    Options,
    Quiet,
    Screen,
    SessionResult,
    parameter_table,
)
from fieldtool.workflow.stages import draw, identify, measure, restore, run, write
from fieldtool.workflow.tools import compare_tools, keep_tool, switch_tool, tools_of
from fieldtool.workflow.twin import Twin, twin

__all__ = [
    "CheckResult",
    "Distinguished",
    "Options",
    "Quiet",
    "Screen",
    "SessionResult",
    "Twin",
    "check",
    "compare",
    "compare_tools",
    "criticise",
    "distinguish",
    "draw",
    "export_folder",
    "identify",
    "import_folder",
    "keep_tool",
    "measure",
    "next_plan",
    "parameter_table",
    "plan",
    "prior_model",
    "redesign",
    "report",
    "restore",
    "run",
    "simulate",
    "simulated_words",
    "switch_tool",
    "tools_of",
    "truth_model",
    "twin",
    "write",
]
