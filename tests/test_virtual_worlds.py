"""The virtual worlds: seeded, varied, and honest about what a beam meets."""

import numpy as np
import pytest

pytest.importorskip("revisitd.drivers.virtual.embree", reason="needs the extra [sim]", exc_type=ImportError)

from revisitd.drivers.ouster import sensor_from_metadata
from revisitd.drivers.virtual import SCENARIOS
from revisitd.drivers.virtual.embree import NO_FACE, Solid
from revisitd.drivers.virtual.mesh import Material, box, quads
from revisitd.drivers.virtual.raycast import Caster, Hits
from revisitd.drivers.virtual.sensor import MIN_RANGE_M, receive, virtual_metadata
from revisitd.drivers.virtual.worlds import build_world, random_world

SHAPE = (64, 512)


@pytest.fixture(scope="module")
def sensor():
    return sensor_from_metadata(virtual_metadata(32, 512))


@pytest.fixture(scope="module")
def world():
    return random_world(3, "tiny")


def flat(range_m, material=Material.CONCRETE, incidence=1.0, number=1):
    """Hits on one thing; scalars or (H, W)."""
    full = [np.broadcast_to(np.asarray(v, t), SHAPE).copy() for v, t in (
        (range_m, np.float32), (number, np.uint16), (material, np.uint8), (incidence, np.float32), (1.0, np.float32)
    )]  # fmt: skip
    return Hits(*full)


def received(hits, seed=0):
    return receive(hits, np.zeros(SHAPE[0], int), np.random.default_rng(seed))


def test_the_same_seed_is_the_same_world_and_another_seed_another(world):
    again, other = random_world(3, "tiny"), random_world(4, "tiny")
    assert world.kinds == again.kinds
    for one, two in zip(world.items, again.items, strict=True):
        np.testing.assert_array_equal(one.mesh.vertices, two.mesh.vertices)
    assert not np.array_equal(world.route.xy[:50], other.route.xy[:50])


def test_every_scenario_is_described_and_builds_with_its_changes():
    assert {"demo", "short", "long", "quiet", "loop600", "tiny"} <= set(SCENARIOS)
    for name in ("tiny", "demo"):
        scenario = SCENARIOS[name]
        built = build_world(scenario, 1)
        assert scenario.about
        assert sum(change.part_of is None for change in built.changes) == len(scenario.staged)
        assert len(built.patrol.passes) == scenario.passes


def test_long_has_eighteen_changes_of_both_polarities_and_a_pass_the_other_way():
    built = build_world(SCENARIOS["long"], 0)
    polarity = [change.polarity for change in built.changes if change.part_of is None]
    assert len(polarity) == 18
    assert min(polarity.count("appeared"), polarity.count("disappeared")) >= 6
    assert [one.reverse for one in built.patrol.passes] == [False, False, True]


def test_changes_stand_beside_the_route_and_not_on_it():
    built = random_world(2, "short")
    for change in built.changes:
        corner = built.items[change.object_id - 1].mesh.vertices[:, :2]
        gap = np.linalg.norm(built.route.xy[:, None] - corner[None], axis=2).min()
        assert 1.5 < gap < 15


def test_the_robot_rests_first_and_stays_clear_of_walkers(world):
    patrol = world.patrol
    rest = patrol.pose(np.linspace(0, 1.0, 20))
    assert np.ptp(rest[:, :3, 3], axis=0).max() < 0.005
    times = np.arange(0, patrol.duration_s, 0.1)
    for mover in world.movers:
        during = times[[patrol.pass_at(t) == mover.pass_index for t in times]]
        gap = np.linalg.norm(mover.place(during)[0] - patrol.pose(during)[:, :2, 3], axis=1)
        assert gap.min() > 1.0


def test_a_beam_meets_a_plane_at_its_exact_range(sensor):
    wall = quads([[[10, -50, -50], [10, 50, -50], [10, 50, 50], [10, -50, 50]]], Material.BRICK)
    ray, origin = sensor.direction.reshape(-1, 3), sensor.offset.reshape(-1, 3)
    face, range_m, _, cosine = Solid(wall).hit(origin, ray, np.full(len(ray), 60.0))
    met = face != NO_FACE
    assert met.any()
    np.testing.assert_allclose((origin + range_m[:, None] * ray)[met, 0], 10.0, atol=1e-4)
    np.testing.assert_allclose(cosine[met], ray[met, 0], atol=1e-4)


def test_what_stands_behind_something_is_not_met(sensor):
    near, far = box((0.2, 4, 4), Material.WOOD, (5, 0, -2)), box((0.2, 4, 4), Material.WOOD, (9, 0, -2))
    ray, origin = sensor.direction.reshape(-1, 3), sensor.offset.reshape(-1, 3)
    limit = Solid(near).hit(origin, ray, np.full(len(ray), 50.0))[1]
    behind = Solid(far).hit(origin, ray, limit)[0]
    assert not (behind[limit < 50] != NO_FACE).any()


def test_things_are_met_exactly_in_the_passes_that_have_them(world, sensor):
    for change in world.changes:
        item = world.items[change.object_id - 1]
        middle = item.mesh.vertices.mean(0)
        nearest = world.route.xy[np.linalg.norm(world.route.xy - middle[:2], axis=1).argmin()]
        pose = np.eye(4)
        pose[:3, 3] = [*nearest, middle[2] + 0.3]
        for index in (0, 1):
            labels = Caster(world, index).cast(sensor, pose)[1]
            assert (labels == change.object_id).any() == item.is_there(index)


def test_each_column_is_cast_from_its_own_pose(world, sensor):
    caster = Caster(world, 0)
    start, end = world.patrol.pose(5.0), world.patrol.pose(6.5)
    moving = np.where(np.arange(512)[:, None, None] < 256, start, end)
    first, both, last = (caster.cast(sensor, pose)[0] for pose in (start, moving, end))
    np.testing.assert_array_equal(both[:, :256], first[:, :256])
    np.testing.assert_array_equal(both[:, 256:], last[:, 256:])
    assert not np.array_equal(first, last)


def test_movers_show_only_where_their_time_is_given(world, sensor):
    caster, pose = Caster(world, 0), world.patrol.pose(3.0)
    first = len(world.items) + 1
    assert caster.cast(sensor, pose)[1].max() < first
    seen = [caster.cast(sensor, pose, np.full(512, t))[1] for t in np.arange(0.0, 12.0, 2.0)]
    assert any((labels >= first).any() for labels in seen)


def test_the_robot_sees_its_own_antennas_and_nothing_that_they_hide(world, sensor):
    pose = world.patrol.pose(3.0)
    without, with_own = Caster(world, 0).trace(sensor, pose), Caster(world, 0, with_vehicle=True).trace(sensor, pose)
    own = with_own.object_id == len(world.kinds) - 1
    assert world.kinds[-1] == "vehicle" and 0 < own.sum() < own.size / 30
    assert (with_own.range_m[own] < without.range_m[own]).all() and with_own.range_m[own].max() < 2.0
    np.testing.assert_array_equal(with_own.range_m[~own], without.range_m[~own])


def test_ranges_scatter_by_about_a_centimetre_and_more_when_far_or_slanted():
    def scatter(range_m, incidence):
        range_mm = received(flat(range_m, incidence=incidence))["RANGE"].astype(float)
        return np.std(range_mm[range_mm > 0] - 1e3 * range_m)

    near = scatter(8.0, 1.0)
    assert 8 < near < 16
    assert scatter(50.0, 1.0) > 1.3 * near
    assert scatter(20.0, 0.1) > 1.3 * near


def test_returns_are_lost_more_often_far_away_and_at_grazing_angles():
    def lost(range_m, incidence):
        return np.mean(received(flat(range_m, Material.ASPHALT, incidence))["RANGE"] == 0)

    assert lost(8.0, 1.0) < 0.01
    assert lost(8.0, 1.0) <= lost(40.0, 1.0) < lost(90.0, 1.0)
    assert lost(30.0, 0.8) < lost(30.0, 0.04)


def test_an_edge_gives_some_returns_between_its_two_surfaces():
    edge = flat(np.where(np.arange(SHAPE[1]) % 16 < 8, 6.0, 7.0))
    range_m = received(edge)["RANGE"] * 1e-3
    between = (range_m > 6.1) & (range_m < 6.9)
    assert 0.005 < between.mean() < 0.08
    beside_edge = np.isin(np.arange(SHAPE[1]) % 16, (0, 7, 8, 15))
    assert not between[:, ~beside_edge].any()


def test_what_met_nothing_or_lies_within_the_blind_zone_gives_no_return():
    assert not received(flat(np.inf, number=0))["RANGE"].any()
    assert not received(flat(MIN_RANGE_M - 0.2))["RANGE"].any()


def test_labels_belong_to_returns_alone():
    fields = received(flat(60.0, Material.RUBBER, number=7))
    assert ((fields["object"] == 7) == (fields["RANGE"] > 0)).all()
    assert (fields["RANGE"] == 0).any()


def test_metadata_resembles_a_real_os1_and_differs_by_serial_number():
    one, two = (sensor_from_metadata(virtual_metadata(128, 1024, serial=s)) for s in (122300000001, 122300000002))
    assert one.product == "OS-1-128" and one.shape == (128, 1024)
    assert np.rad2deg(one.altitude_rad[0] - one.altitude_rad[-1]) == pytest.approx(42.4, abs=0.3)
    assert list(one.pixel_shift[:4]) == [12, 4, -4, -12]
    assert one.digest != two.digest
    with pytest.raises(ValueError, match="no OS1-48"):
        virtual_metadata(48)
