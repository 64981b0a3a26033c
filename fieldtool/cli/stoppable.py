"""A session's screen that ends the session when a stop was asked for."""

from collections.abc import Callable
from typing import ParamSpec

from fieldtool import workflow
from fieldtool.cli.stop_key import StopKey

P = ParamSpec("P")


class StoppableScreen:
    """A screen at which a session ends, if the user asked for it, before anything else is shown.

    Sentences are shown all the same: they may be what a motion that was stopped has to say.
    """

    def __init__(self, screen: workflow.Screen, key: StopKey) -> None:
        self._screen, self._key = screen, key
        self.say, self.progress, self.ready = screen.say, screen.progress, screen.ready
        self.stage = self._unless_stopped(screen.stage)
        self.doing = self._unless_stopped(screen.doing)
        self.plan = self._unless_stopped(screen.plan)
        self.fast_plan = self._unless_stopped(screen.fast_plan)
        self.found = self._unless_stopped(screen.found)
        self.designed = self._unless_stopped(screen.designed)
        self.verified, self.not_put_back = screen.verified, screen.not_put_back

    def _unless_stopped(self, show: Callable[P, None]) -> Callable[P, None]:
        def shown(*arguments: P.args, **named: P.kwargs) -> None:
            self._key.check()
            show(*arguments, **named)

        return shown
