"""KISS-ICP with input guards and a health verdict: where the sensor is in the odometry's own frame."""

from __future__ import annotations

import os
from collections import deque
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ..drivers.frame import Frame
from .config import OdometryConfig
from .geometry import column_phase, fraction_of, inverse, rotation_angle_rad, transform

# KISSConfig reads kiss_icp_* from the environment; a stray variable must not change a robot's odometry.
for _name in [name for name in os.environ if name.lower().startswith("kiss_icp_")]:
    del os.environ[_name]

from kiss_icp.config import KISSConfig  # noqa: E402
from kiss_icp.kiss_icp import KissICP  # noqa: E402

MIN_POINTS = 1000  # fewer registrable returns than this say nothing about a pose
# What stands is what tells a place: on flat ground every scan lies on every other. Of two scans a frame apart 84 % and
# more of it agree, of scans of two places 31 % at most (studied on five virtual worlds).
STANDING_M = 0.5  # above the lower quartile of a scan's heights
STANDING_RANGE_M = 30.0
AGREES_M = 0.5
MIN_STANDING = 100  # points; with fewer nothing can be told
STANDING_SAMPLE = 1000
MAX_GAP_FRAMES = 5.0  # 0.5 s at 10 Hz: beyond, the constant-velocity guess is no longer near the truth
SPANS = (1, 3, 5)  # frames over which the motion may be smoothed
FORGET = 0.1  # what the last frame weighs in the choice between them


class Health(str, Enum):
    """Verdict on one frame's pose."""

    GOOD = "good"
    LOST_TOO_FEW_RETURNS = "too few returns"
    LOST_IMPLAUSIBLE_MOTION = "implausible motion"
    LOST_NO_OVERLAP = "another place than a frame ago"
    LOST_GAP = "frames missing"

    @property
    def lost(self) -> bool:
        return self is not Health.GOOD


@dataclass(frozen=True, eq=False)
class Motion:
    """Pose of one frame: T_odom_sensor (4, 4) at the sweep's end, T_start_end (4, 4) the motion during the sweep."""

    T_odom_sensor: np.ndarray
    T_start_end: np.ndarray
    health: Health


class SteadyMotion:
    """The sensor's motion in one frame period, smoothed as far as the smoothing predicts what comes next.

    On a wheeled robot KISS-ICP's steps from frame to frame shake by 7 cm in height and 0.4 degrees in roll and pitch,
    much more than the robot does, and a sweep that is deskewed by such a step bends: there the mean of five steps is
    right. One that is carried by hand does roll, step after step: there the last step is. So for each axis the mean
    of the last one, three or five steps is taken, whichever has been nearest to the step that followed.
    """

    def __init__(self) -> None:
        self._steps: deque[np.ndarray] = deque(maxlen=max(SPANS))
        self._error = np.zeros((len(SPANS), 6))  # squared, of each span's prediction of each axis, running mean

    def add(self, motion: np.ndarray, periods: float) -> None:
        """One more measured motion (4, 4), made in so many frame periods."""
        step = fraction_of(motion, 1.0 / periods)
        measured = np.concatenate([step[:3, 3], Rotation.from_matrix(step[:3, :3]).as_rotvec()])
        if self._steps:
            self._error += FORGET * ((self._means() - measured) ** 2 - self._error)
        self._steps.append(measured)

    def during(self, periods: float) -> np.ndarray:
        """The motion (4, 4) in so many frame periods; none before the first step."""
        if not self._steps:
            return np.eye(4)
        best = self._means()[self._error.argmin(axis=0), np.arange(6)]
        step = np.eye(4)
        step[:3, 3] = best[:3]
        step[:3, :3] = Rotation.from_rotvec(best[3:]).as_matrix()
        return fraction_of(step, periods)

    def _means(self) -> np.ndarray:
        """(spans, 6): the mean of the last one, three, five steps."""
        steps = np.array(self._steps)
        return np.stack([steps[-span:].mean(axis=0) for span in SPANS])


class Odometry:
    """Registers frames one after another; the odometry's frame is the sensor's pose at the first frame's end."""

    def __init__(self, config: OdometryConfig):
        self._config = config
        kiss = KISSConfig()
        kiss.data.max_range = config.max_range_m
        kiss.data.min_range = config.min_range_m
        kiss.mapping.voxel_size = config.voxel_size_m
        kiss.registration.max_num_threads = 1  # bitwise repeatable, and leaves a core to the detection
        kiss.registration.max_num_iterations = 50
        kiss.registration.convergence_criterion = 1e-3
        self._kiss = KissICP(kiss)
        self._steady = SteadyMotion()
        self._standing = np.empty((0, 3))  # of the last frame, in the odometry's frame
        self._stamp_ns: int | None = None
        self._frames = 0

    def register(self, frame: Frame) -> Motion:
        """The frame's pose. A lost verdict means: start anew with another Odometry."""
        points, times = self._registrable(frame)
        previous = self._kiss.last_pose.copy()
        if len(points) < MIN_POINTS or not times.max() > times.min():
            return Motion(previous, np.eye(4), Health.LOST_TOO_FEW_RETURNS)
        gap_frames = self._gap_frames(frame)
        if gap_frames > MAX_GAP_FRAMES:
            return Motion(previous, np.eye(4), Health.LOST_GAP)
        # KISS-ICP's constant-velocity guess is its last step, and assumes one period between frames.
        self._kiss.last_delta = self._steady.during(gap_frames)
        self._kiss.register_frame(points, times)
        T_odom_sensor = self._kiss.last_pose.copy()
        motion = inverse(previous) @ T_odom_sensor if self._frames else np.eye(4)
        if self._frames:
            self._steady.add(motion, gap_frames)
        health = self._verdict(motion, gap_frames * frame.sensor.frame_period_ns * 1e-9)
        # Against the last scan, and each time: in KISS-ICP's map the first scan of another place would be already.
        agreement = self._agreement(transform(T_odom_sensor, _standing(points)))
        if health is Health.GOOD and agreement < self._config.min_overlap:
            health = Health.LOST_NO_OVERLAP
        self._stamp_ns = frame.stamp_ns
        self._frames += 1
        times = frame.column_ns[frame.column_valid]
        sweep_periods = min(float(times.max() - times.min()) / frame.sensor.frame_period_ns, 1.0)
        return Motion(T_odom_sensor, self._steady.during(sweep_periods), health)

    def _registrable(self, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        """Returns (N, 3) float64 points and (N,) phases on a regular sub-grid of the image."""
        rows, cols = self._strides(frame.sensor.shape)
        valid = (frame.range_mm[::rows, ::cols] > 0) & frame.column_valid[None, ::cols]
        points = frame.sensor.points(frame.range_mm)[::rows, ::cols][valid].astype(np.float64)
        phase = column_phase(frame.column_ns, frame.column_valid)[::cols]
        return points, np.broadcast_to(phase, valid.shape)[valid]

    def _strides(self, shape: tuple[int, int]) -> tuple[int, int]:
        """Strides of rows and columns that leave at most max_points; columns, the denser ones, are thinned first."""
        strides = [1, 1]
        while shape[0] * shape[1] > self._config.max_points * strides[0] * strides[1]:
            strides[0 if strides[0] < strides[1] else 1] += 1
        return strides[0], strides[1]

    def _gap_frames(self, frame: Frame) -> float:
        if self._stamp_ns is None:
            return 1.0
        return (frame.stamp_ns - self._stamp_ns) / frame.sensor.frame_period_ns

    def _verdict(self, motion: np.ndarray, seconds: float) -> Health:
        if self._frames == 0:
            return Health.GOOD
        speed = np.linalg.norm(motion[:3, 3]) / seconds
        turn = np.degrees(rotation_angle_rad(motion)) / seconds
        if speed > self._config.max_speed_mps or turn > self._config.max_turn_dps:
            return Health.LOST_IMPLAUSIBLE_MOTION
        return Health.GOOD

    def _agreement(self, standing: np.ndarray) -> float:
        """Share of what stands that stood in the last scan too; 1 where too little stands to tell."""
        before, self._standing = self._standing, standing
        if min(len(before), len(standing)) < MIN_STANDING:
            return 1.0
        sample = standing[:: max(1, len(standing) // STANDING_SAMPLE)]
        distance, _ = cKDTree(before).query(sample, distance_upper_bound=AGREES_M)
        return float(np.isfinite(distance).mean())


def _standing(points: np.ndarray) -> np.ndarray:
    """Those of (N, 3) points in the sensor's frame that stand above the ground nearby."""
    near = points[(points**2).sum(axis=1) < STANDING_RANGE_M**2]
    if not len(near):
        return near
    return near[near[:, 2] > np.quantile(near[:, 2], 0.25) + STANDING_M]
