"""Commissioning of elastic multi-axis machines: sweep, identify, write parameters back.

From Python::

    import fieldtool
    result = fieldtool.run("paper-3x3", Path("session"))
    result.model.axes[0].masses
"""

from fieldtool.workflow import Options, SessionResult, run

__all__ = ["Options", "SessionResult", "run"]
