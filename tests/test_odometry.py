"""Odometry: true poses from packets, and a verdict instead of an abort or a silent drift."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from revisitd.daemon.config import Config
from revisitd.daemon.odometry import Health, Odometry, SteadyMotion
from revisitd.drivers.ouster import open_source

virtual = pytest.importorskip("revisitd.drivers.virtual", reason="the virtual sensor needs the extra [sim]")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Frames of the first six seconds of a small patrol, and the sensor's true pose at the end of each."""
    capture = virtual.simulate(tmp_path_factory.mktemp("drive"), scenario="tiny", seed=1, beams=32, max_s=6.0)
    with open_source(str(capture.pcap)) as source:
        frames = list(source)
    return frames, np.loadtxt(capture.truth / "poses.txt")[: len(frames), 1:4]


def odometry():
    return Odometry(Config().odometry)


def run(frames):
    known = odometry()
    return [known.register(frame) for frame in frames]


def test_the_pose_is_the_sensors_at_the_end_of_each_sweep(drive):
    frames, truth = drive
    motions = run(frames)
    assert all(motion.health is Health.GOOD for motion in motions)
    ours = np.array([motion.T_odom_sensor[:3, 3] for motion in motions])
    assert np.linalg.norm(truth[-1] - truth[0]) > 4.0
    assert np.linalg.norm(ours[-1] - truth[-1]) < 0.25


def test_the_sweeps_motion_is_that_between_two_ends(drive):
    frames, truth = drive
    last = run(frames)[-1]
    assert np.linalg.norm(last.T_start_end[:3, 3]) == pytest.approx(np.linalg.norm(truth[-1] - truth[-2]), abs=0.08)


def test_the_same_frames_give_the_same_poses_to_the_bit(drive):
    first, second = run(drive[0][:20]), run(drive[0][:20])
    assert all((a.T_odom_sensor == b.T_odom_sensor).all() for a, b in zip(first, second, strict=True))


def test_a_frame_of_one_column_is_too_little_and_does_not_abort(drive):
    known, frame = odometry(), drive[0][0]
    one = np.zeros_like(frame.column_valid)
    one[100] = True
    assert known.register(replace(frame, column_valid=one)).health is Health.LOST_TOO_FEW_RETURNS


def test_a_blinded_sensor_is_lost_and_not_standing_still(drive):
    known = odometry()
    known.register(drive[0][0])
    blind = replace(drive[0][1], range_mm=np.zeros_like(drive[0][1].range_mm))
    assert known.register(blind).health.lost


def test_a_scan_of_another_place_does_not_lie_on_the_map(drive):
    known, frames = odometry(), drive[0]
    for frame in frames[:4]:
        known.register(frame)
    rng = np.random.default_rng(0)
    elsewhere = replace(frames[4], range_mm=rng.integers(2_000, 60_000, frames[4].range_mm.shape).astype(np.uint32))
    assert known.register(elsewhere).health.lost


def test_a_long_gap_is_lost_and_a_short_one_is_not(drive):
    frames = drive[0]
    known = odometry()
    known.register(frames[10])
    assert known.register(frames[13]).health is Health.GOOD
    assert known.register(frames[25]).health is Health.LOST_GAP


def step_of(xyz, rotvec):
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    step[:3, 3] = xyz
    return step


def test_the_motion_of_a_sweep_is_not_shaken_by_single_steps():
    rng, steady = np.random.default_rng(0), SteadyMotion()
    assert np.array_equal(steady.during(1.0), np.eye(4))
    off = []
    height, tilt = 0.0, np.zeros(2)
    for _ in range(60):  # a pose that shakes: its steps go to and fro
        above, tilted = rng.normal(0, 0.05), rng.normal(0, np.radians(0.3), 2)
        steady.add(step_of([0.2, 0.0, above - height], [*(tilted - tilt), np.radians(1.0)]), 1.0)
        height, tilt = above, tilted
        motion = steady.during(1.0)
        off.append([motion[2, 3], *Rotation.from_matrix(motion[:3, :3]).as_rotvec(degrees=True)[:2]])
    assert np.abs(np.array(off[20:])).mean(axis=0).max() < 0.15 and np.std(np.array(off[20:])[:, 0]) < 0.03
    assert motion[0, 3] == pytest.approx(0.2, abs=0.01)
    half = steady.during(0.5)
    np.testing.assert_allclose(half @ half, motion, atol=1e-2)


def test_a_sensor_that_is_carried_by_hand_is_followed_step_by_step():
    steady, worst = SteadyMotion(), 0.0
    for i in range(80):  # rolls three degrees to either side, one and a half times a second
        rolled = [np.radians(3) * np.sin(2 * np.pi * 1.5 * t) for t in (0.1 * i, 0.1 * (i - 1))]
        truth = rolled[0] - rolled[1]
        steady.add(step_of([0.1, 0.0, 0.0], [truth, 0.0, 0.0]), 1.0)
        got = Rotation.from_matrix(steady.during(1.0)[:3, :3]).as_rotvec()[0]
        worst = max(worst, abs(got - truth)) if i > 20 else 0.0
    assert np.degrees(worst) < 0.1


def test_a_motion_over_missing_frames_counts_as_that_of_one():
    steady = SteadyMotion()
    step = np.eye(4)
    step[0, 3] = 0.6
    steady.add(step, 3.0)
    assert steady.during(1.0)[0, 3] == pytest.approx(0.2)
