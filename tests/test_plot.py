"""The picture of the stored results."""

import numpy as np
import pytest
from matplotlib.image import imread
from ouster.sdk import core
from stored import SESSION, make_change, make_scan, pose

from revisitd.daemon import plot
from revisitd.daemon.plotdata import gather
from revisitd.storage.errors import DataDirError
from revisitd.storage.store import Store

SHAPE = (64, 512)
GROUND_M, WALL_M = 1.0, 6.0  # the sensor's height; the radius of a round wall about it


def surroundings():
    """Ranges (H, W) uint32 mm of a sensor on flat ground within a round wall."""
    altitude = np.deg2rad(np.linspace(16.6, -16.6, SHAPE[0]))[:, None]
    with np.errstate(divide="ignore"):
        to_ground = np.where(altitude < 0, GROUND_M / np.sin(-altitude), np.inf)
    return np.broadcast_to(1e3 * np.minimum(to_ground, WALL_M / np.cos(altitude)), SHAPE).astype(np.uint32)


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    monkeypatch.setattr(plot, "DPI", 50)


@pytest.fixture
def store(tmp_path):
    """A street of 30 m walked twice, two visits to its one scene."""
    with Store.open_writer(tmp_path / "data") as store:
        info = core.SensorInfo.from_default(core.LidarMode._512x10)
        info.config.udp_port_lidar = 7502  # 0 would mean that the lidar is off
        store.dir.put_sensor(SESSION["sensor_digest"], info.to_json_string())
        session = store.index.start_session(**SESSION)
        hull = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 1.0]])
        store.index.add_scene(1, session, hull, 2.5, 200.0)
        for number in (1, 2):
            visit = store.index.open_visit(1, number, session, number)
            for x in np.linspace(0, 30, 8):
                add_scan(store, session, pose(x, number), visit)
        yield store


def add_scan(store, session, T_map_sensor, *visits):
    more = {"range_mm": surroundings(), "T_map_sensor": T_map_sensor, "T_start_end": np.eye(4)}
    store.add_scan(make_scan(store.new_scan_id(), session, SHAPE, **more), visits)


def drawn(store, tmp_path):
    plot.plot_map(store.dir.path, tmp_path / "map.png")
    return imread(tmp_path / "map.png")


def test_a_map_without_changes_is_drawn(store, tmp_path):
    image = drawn(store, tmp_path)
    assert image.std() > 0.02


def test_changes_are_drawn_in_their_colours(store, tmp_path):
    without = drawn(store, tmp_path)
    store.changes.add(make_change("appeared", at=(12.0, 3.0, 0.0)))
    store.changes.add(make_change("disappeared", at=(20.0, -3.0, 0.0), visit=7))
    image = drawn(store, tmp_path)
    for colour in ((0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00)):
        assert n_pixels(image, colour) > n_pixels(without, colour) + 30


def n_pixels(image, colour):
    """Pixels of an (H, W, 4) image in 0..1 that have this colour."""
    return np.count_nonzero(np.abs(image[..., :3] - np.array(colour) / 255).max(axis=-1) < 0.02)


def test_the_largest_changes_are_shown_from_near_with_what_was_there_before_and_after(store):
    for n_points in (30, 200, 100):
        store.changes.add(make_change(at=(12.0, 3.0, 0.0), n_points=n_points))
    _, close_ups = gather(store.dir.path, 2)
    assert [close_up.change.id for close_up in close_ups] == [2, 3]
    assert all(len(close_up.before) and len(close_up.after) for close_up in close_ups)
    np.testing.assert_allclose(close_ups[0].eye[1], 2.0, err_msg="the second visit walked along y = 2")


def test_only_the_map_with_the_most_scans_is_drawn(store):
    other = store.index.start_session(**SESSION)
    add_scan(store, other, pose(500.0))
    store.changes.add(make_change(map_id=other))
    picture, _ = gather(store.dir.path, 4)
    assert (picture.map_id, picture.n_maps, picture.changes) == (1, 2, [])
    assert len(picture.trajectory.scan_id) == 16


def test_a_directory_without_scans_says_that_there_is_nothing_to_draw(tmp_path):
    Store.open_writer(tmp_path / "data").close()
    with pytest.raises(DataDirError, match="nothing to draw"):
        plot.plot_map(tmp_path / "data", tmp_path / "map.png")
    assert not (tmp_path / "map.png").exists()


def test_the_floor_plan_is_dark_where_things_stand_and_not_under_a_canopy():
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 20, 0.2), np.arange(0, 20, 0.2)))
    ground = np.column_stack([x, y, 0.1 * x])  # it rises
    along, above = (axis.ravel() for axis in np.meshgrid(np.arange(0.05, 20, 0.1), [0.6, 1.0, 1.4, 1.8]))
    wall = np.column_stack([np.full_like(along, 5.05), along, 0.5 + above])
    canopy = np.column_stack([x, y, np.full_like(x, 6.0)])[x > 12]
    image = plot._floor_plan(np.vstack([ground, wall, canopy]), np.array([0.0, 0.0]), np.array([20.0, 20.0]))
    assert image.shape == (200, 200)
    assert image[:, 50].mean() < 0.7
    assert image[:, 130:].min() > 0.9
