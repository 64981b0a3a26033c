"""Commissioning of elastic multi-axis machines: sweep, identify, write parameters back.

From Python::

    import fieldtool
    result = fieldtool.run("paper-3x3", Path("session"))
    result.model.axes[0].masses
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fieldtool.workflow import Options, SessionResult, run

__all__ = ["Options", "SessionResult", "run"]


def __getattr__(name: str) -> Any:
    """Load the tool when it is first asked for: Ctrl-C while it loads is the command line's to tell."""
    if name not in __all__:
        raise AttributeError(f"module 'fieldtool' has no attribute {name!r}")
    from fieldtool import workflow

    return getattr(workflow, name)
