"""Runs what is heavy in a child process, one job at a time, and survives its death."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from .comparison import Comparison, Job
from .memory import return_freed
from .relocalization import Answer, Question, Relocator

logger = logging.getLogger(__name__)

KEEP_PLACES_S = 60.0  # after the last question: the session has joined, and its places take 90 MB
NICENESS = 5  # the frame loop goes first on two cores


class JobFailed(Exception):
    """The child could not do its job, or died; the message says why."""


class Stopped(Exception):
    """The program ends: the job was given up, and nothing is known against it."""


class DetectionProcess:
    """A child that compares and locates. Started at once, so that its imports are done when a job comes.

    timeout_s: a job that takes longer is ended, and its child replaced.
    Thread rule: any thread may call compare and locate; each waits until the child is free.
    """

    def __init__(self, data: Path, timeout_s: float):
        self._data = data
        self._timeout_s = timeout_s
        self._free = threading.Lock()
        self._stopped = False
        self._start()

    def compare(self, job: Job) -> Comparison:
        """Run a comparison and wait for it, without holding the interpreter's lock. Raises JobFailed, Stopped."""
        return self._run(job)

    def locate(self, question: Question) -> Answer:
        """Look for a key scan in the earlier maps, and wait for it likewise. Raises JobFailed, Stopped."""
        return self._run(question)

    def _run(self, job: Job | Question) -> Any:
        with self._free:
            return self._run_alone(job)

    def _run_alone(self, job: Job | Question) -> Any:
        try:
            self._connection.send(job)
            if not self._connection.poll(self._timeout_s):
                self._process.kill()
                raise JobFailed(f"not done after {self._timeout_s:g} s: the detection process was ended and replaced")
            result = self._connection.recv()
        except (EOFError, OSError, JobFailed) as error:
            self._process.join(1.0)
            code = self._process.exitcode
            if self._stopped:
                raise Stopped from error
            self._start()
            if isinstance(error, JobFailed):
                raise
            raise JobFailed(f"the detection process died (exit code {code}); another was started") from error
        if isinstance(result, Exception):
            raise JobFailed(f"{type(result).__name__}: {result}") from result
        return result

    @property
    def pid(self) -> int:
        """Of the child; another one after it died."""
        return self._process.pid

    def kill(self) -> None:
        """End the child at once, whatever it does; what it was asked raises Stopped, as does all that comes."""
        self._stopped = True
        self._process.kill()

    def close(self) -> None:
        """End the child, after the job at hand."""
        self._connection.close()
        self._process.join()

    def _start(self) -> None:
        # spawn: a forked copy of a process with threads may hang on a lock that one of them held.
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, self._data), name="revisitd-detection", daemon=True
        )
        self._process.start()
        theirs.close()  # the child alone holds its end: when either dies the other sees the end of the pipe
        logger.debug("detection process pid=%d", self._process.pid)


def _serve(connection: Connection, data: Path) -> None:
    """The child: answers jobs until the parent closes the pipe or dies."""
    for stop in (signal.SIGINT, signal.SIGTERM):  # for the parent, which ends us in order
        signal.signal(stop, signal.SIG_IGN)
    os.nice(NICENESS)
    if not os.access(Path(__file__).parent, os.W_OK):
        # Beside an installed package that belongs to root, numba has nowhere to keep what it compiled.
        os.environ.setdefault("NUMBA_CACHE_DIR", str(data / "cache"))
    from .comparer import Comparer

    comparer: Comparer | None = None
    relocator: Relocator | None = None
    asked_s = 0.0  # when it was asked last
    while True:
        try:
            job = connection.recv()
        except EOFError:
            return
        try:
            if isinstance(job, Question):
                relocator = relocator or Relocator(data, job.alignment)
                asked_s = time.monotonic()
                answer = relocator.locate(job)
            else:
                if relocator is not None and time.monotonic() - asked_s > KEEP_PLACES_S:
                    relocator.close()
                    relocator = None
                comparer = comparer or Comparer(data)
                answer = comparer.compare(job)
        except Exception as error:  # whatever went wrong is the parent's to judge
            answer = error
        connection.send(answer)
        del job, answer
        return_freed()
