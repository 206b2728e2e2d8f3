"""Scene identification (CDSD Algorithm 1) and visits."""

import numpy as np
import pytest

from revisitd.daemon.config import SceneConfig
from revisitd.daemon.hull import convex_hull, distance_m, grown_area_m2
from revisitd.daemon.scenes import SceneTracker

SAME = np.eye(1, 256)[0]
OTHER = -SAME


class Walk:
    """Feeds a tracker with key scans every half metre, 0.25 s apart."""

    def __init__(self, beta=1.2, **settings):
        self.tracker = SceneTracker(SceneConfig(**settings), beta, [], 1)
        self.scan_id = 0
        self.scenes, self.ended = [], []

    def to(self, *corners, descriptor=SAME):
        for start, end in zip(corners[:-1], corners[1:], strict=True):
            start, end = np.array(start, float), np.array(end, float)
            for s in np.arange(0, 1, 0.5 / np.linalg.norm(end - start)):
                self.take(start + s * (end - start), descriptor)
        return self

    def take(self, xy, descriptor=SAME):
        self.scan_id += 1
        update = self.tracker.update(self.scan_id, int(self.scan_id * 25e7), np.asarray(xy, float), descriptor)
        self._note(update)

    def finish(self):
        self._note(self.tracker.finish())
        return self

    def _note(self, update):
        if update.new_scene:
            self.scenes.append(update.new_scene)
        self.ended += update.ended_visits


def test_a_straight_path_makes_scenes_of_at_most_alpha():
    walk = Walk(alpha_m2=120, margin_m=2.5).to((0, 0), (100, 0)).finish()
    assert len(walk.scenes) >= 4
    areas = [grown_area_m2(scene.hull, 2.5) for scene in walk.scenes]
    assert max(areas) <= 120
    assert min(areas[:-1]) > 110  # closed because full, the last because the session ended


def test_every_scan_belongs_to_a_scene():
    walk = Walk().to((0, 0), (60, 0), (60, 30), (0, 30), (0, 0), (60, 0)).finish()
    seen = {scan for visit in walk.ended for scan in visit.scan_ids}
    assert seen == set(range(1, walk.scan_id + 1))


def test_a_second_lap_visits_the_same_scenes_and_makes_none():
    lap = [(0, 0), (40, 0), (40, 40), (0, 40), (0, 0)]
    walk = Walk().to(*lap)
    walk.to((0, 0), (10, 0))
    made = len(walk.scenes)
    walk.to((10, 0), (40, 0), (40, 40), (0, 40), (0, 0)).finish()
    assert len(walk.scenes) == made
    second = [visit for visit in walk.ended if visit.number == 2]
    assert {visit.scene_id for visit in second} == {scene.scene_id for scene in walk.scenes}


def test_a_lane_two_metres_aside_is_a_visit_in_either_direction():
    walk = Walk().to((0, 0), (60, 0)).to((60, 10), (60, 2), (0, 2)).finish()
    assert {v.scene_id for v in walk.ended if v.number >= 2} >= {s.scene_id for s in walk.scenes[:3]}


def test_entry_and_exit_times_enclose_the_visits_scans():
    walk = Walk().to((0, 0), (50, 0)).to((50, 0), (0, 0)).finish()
    for visit in walk.ended:
        assert visit.t_in_ns == int(visit.scan_ids[0] * 25e7)
        assert visit.t_out_ns == int(visit.scan_ids[-1] * 25e7)


def test_a_descriptor_too_far_from_any_in_the_scene_closes_it():
    walk = Walk(beta=1.0).to((0, 0), (5, 0))
    walk.to((5, 0), (20, 0), descriptor=OTHER).finish()
    assert walk.scenes[0].hull[:, 0].max() < 5.0


def test_wavering_on_the_rim_is_one_visit():
    walk = Walk().to((0, 0), (40, 0))
    before = len(walk.ended)
    rim = walk.scenes[0].hull[:, 0].min() - 2.5
    for _ in range(10):
        walk.take((rim + 0.1, 0.0))
        walk.take((rim - 0.4, 0.0))
    walk.take((rim - 20.0, 0.0))
    assert len([v for v in walk.ended[before:] if v.scene_id == walk.scenes[0].scene_id]) == 1


def test_a_robot_that_stays_gets_its_visit_cut():
    walk = Walk(max_visit_s=30.0)
    for _ in range(1000):  # 250 s on one spot
        walk.take((0.0, 0.0))
    assert [visit.number for visit in walk.ended] == list(range(1, len(walk.ended) + 1))
    assert len(walk.ended) >= 6


@pytest.mark.parametrize("points", [[[1.0, 2.0]], [[0, 0], [3, 0], [1, 0], [2, 0]], [[1, 1], [1, 1]]])
def test_points_on_a_line_have_a_grown_hull(points):
    hull = convex_hull(np.array(points, float))
    length = np.ptp(hull, axis=0).max() if len(hull) > 1 else 0.0
    assert grown_area_m2(hull, 2.0) == pytest.approx(4 * length + np.pi * 4)
    assert distance_m(hull, hull[0] + [0, 1.5]) == pytest.approx(1.5)


def test_a_point_inside_the_hull_is_at_no_distance():
    square = convex_hull(np.array([[0, 0], [4, 0], [4, 4], [0, 4], [2, 2]], float))
    assert len(square) == 4
    assert distance_m(square, np.array([1.0, 3.0])) == 0.0
    assert distance_m(square, np.array([7.0, 8.0])) == pytest.approx(5.0)


def test_turning_back_within_a_scene_begins_another_visit():
    walk = Walk().to((0, 0), (14, 0), (0, 1)).finish()
    assert len(walk.scenes) == 1
    assert [visit.number for visit in walk.ended] == [1, 2]
    assert len(walk.ended[1].scan_ids) > 10


def test_each_lap_around_a_lawn_smaller_than_a_scene_is_a_visit():
    lap = [(0, 0), (3, 0), (3, 4), (0, 4), (0, 0)]
    walk = Walk().to(*lap).to(*lap).to(*lap).finish()
    assert len(walk.scenes) == 1
    assert max(visit.number for visit in walk.ended) >= 3
