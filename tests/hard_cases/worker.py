"""A child process for work that may hang, eat all memory or crash in native code: only the child is lost then."""

import multiprocessing
import resource
import signal
import traceback
import warnings
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from sdfsim.base.errors import SdfsimError

MEMORY = 12 * 2**30  # bytes of address space: libraries reserve some without using them


class Worker:
    """Calls `function(argument)` in a child that is started anew when a call has killed it.

    Args:
        function: at the top level of a module; SdfsimErrors that it raises are ordinary answers.
        seconds: of processor time for one call; a call that takes more kills the child, wherever it hangs.
    """

    def __init__(self, function: Callable[[Any], Any], seconds: float) -> None:
        self.function, self.seconds = function, seconds
        self._child: Any = None

    def __call__(self, argument: Any) -> Any:
        """The result, or the SdfsimError that it raised.

        Raises:
            AssertionError: any other error with its traceback, a warning, a hang or a crash.
        """
        if self._child is None:
            self._pipe, far = multiprocessing.Pipe()
            context = multiprocessing.get_context("spawn")
            self._child = context.Process(target=_serve, args=(far, self.function, self.seconds), daemon=True)
            self._child.start()
            far.close()
        try:
            self._pipe.send(argument)
            error, result = self._pipe.recv()
        except (EOFError, ConnectionError):
            self._child.join()
            code, self._child = self._child.exitcode, None
            why = f"took more than {self.seconds} s" if code == -signal.SIGPROF else f"ended the process with {code}"
            raise AssertionError(why) from None
        if error:
            raise AssertionError(error)
        return result

    def close(self) -> None:
        """End the child."""
        if self._child is not None:
            self._child.kill()
            self._child.join()


def _serve(pipe: Connection, function: Callable[[Any], Any], seconds: float) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    warnings.simplefilter("error", RuntimeWarning)
    while True:
        argument = pipe.recv()
        signal.setitimer(signal.ITIMER_PROF, seconds)  # nobody handles it, so the system ends the process
        try:
            answer = None, function(argument)
        except SdfsimError as error:
            answer = None, error
        except BaseException:
            answer = traceback.format_exc(), None
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        pipe.send(answer)
