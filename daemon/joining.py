"""Joins a session to an earlier map: asks where its key scans are until two answers agree."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from ..storage.scans import Scan
from .config import AlignmentConfig
from .detection_process import JobFailed
from .geometry import inverse
from .relocalization import Answer, Question, same_pose

logger = logging.getLogger(__name__)

EVERY_M = 5.0  # of travel between two questions; each takes the child about a second
PATIENT, SELDOM_M = 10, 25.0  # after so many in vain the robot is somewhere else: it is asked less often
AGREE_M, AGREE_DEG = 0.3, 2.0  # between two answers, some metres of odometry apart

Locate = Callable[[Question], "Future[Answer]"]


@dataclass(frozen=True, eq=False)
class Join:
    """An earlier map, and T_map_odom (4, 4): where in it the session's odometry began."""

    map_id: int
    T_map_odom: np.ndarray


class Joiner:
    """Watches the key scans of one session. maps: the earlier ones, the preferred one first.

    locate: answers a question some time later, elsewhere. wait: for each answer (replay: the same result each time),
    or look for it at each key scan (a live robot).
    """

    def __init__(self, locate: Locate, maps: list[int], alignment: AlignmentConfig, wait: bool):
        self._locate, self._maps, self._alignment, self._wait = locate, maps, alignment, wait
        self._position: np.ndarray | None = None
        self._due_m = 0.0  # travel until the next question
        self._n_asked = 0
        self._asked: tuple[Future[Answer], np.ndarray] | None = None  # and T_odom_sensor of the scan asked about
        self._known: Join | None = None  # by one answer: not yet believed

    def update(self, scan: Scan) -> Join | None:
        """Take the next key scan; the join when a second answer has confirmed the first."""
        self._travel(scan.T_odom_sensor[:3, 3])
        if self._asked is None and self._due_m <= 0.0:
            question = Question(scan.session, scan.scan_id, self._maps, self._alignment)
            self._asked = self._locate(question), scan.T_odom_sensor
            self._n_asked += 1
            self._due_m = EVERY_M if self._n_asked < PATIENT or self._known else SELDOM_M
        if self._asked is None or not (self._wait or self._asked[0].done()):
            return None
        (future, T_odom_sensor), self._asked = self._asked, None
        try:
            answer = future.result()
        except JobFailed as why:
            logger.warning("session %d could not be located: %s", scan.session, why)
            return None
        return self._confirm(answer, T_odom_sensor, scan.session)

    def _travel(self, position: np.ndarray) -> None:
        if self._position is not None:
            self._due_m -= float(np.linalg.norm(position - self._position))
        self._position = position

    def _confirm(self, answer: Answer, T_odom_sensor: np.ndarray, session: int) -> Join | None:
        if answer.reason:
            logger.info("session %d is not located in an earlier map: %s", session, answer.reason)
            return None
        before, self._known = self._known, Join(answer.map_id, answer.T_map_sensor @ inverse(T_odom_sensor))
        if before is None or before.map_id != answer.map_id:
            return None
        # Compared where the sensor is: far from the odometry's origin a small turn would be metres there.
        expected = before.T_map_odom @ T_odom_sensor
        if not same_pose(expected, answer.T_map_sensor, AGREE_M, AGREE_DEG):
            logger.info("session %d: two poses in map %d do not agree", session, answer.map_id)
            return None
        return self._known
