"""What must not be reported: one test for each cause of false changes, on worlds in which nothing changed."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("revisitd.drivers.virtual.embree", reason="needs the extra [sim]", exc_type=ImportError)

import staged
from staged import (
    OS1_32,
    OS1_64,
    OS1_128,
    THRESHOLDS,
    Thing,
    Visit,
    compare,
    drive,
    driver,
    open_field,
    submap,
    walker,
    yard,
)

from revisitd.daemon.detection.detector import detect, side_of
from revisitd.drivers.virtual import shapes
from revisitd.drivers.virtual.mesh import Material, box, merge, quads, tube
from revisitd.drivers.virtual.vehicles import car


def rng(seed=3):
    return np.random.default_rng(seed)


# What moves ------------------------------------------------------------------------------------------------------

PATHS = {
    "along the robot's path": [(-6, 2.5), (8, 2.8)],
    "across it in front": [(5.5, -7), (5.0, 8)],
    "towards the robot": [(14, 0.4), (4.5, -0.3)],
    "along the house": [(-7, 9.3), (9, 9.3)],
    "about the same place": [(1, 4), (3, 5), (2, 6), (0.5, 4.5)],
}


@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
def test_people_who_walk_are_no_change(path):
    people = walker(path, 0), walker(path[::-1], 1, 1.0, seed=1)
    compare(yard().plus(movers=people)).expect()


def test_people_who_walk_before_the_open_sky_are_no_change():
    # Nothing returns from behind their heads: no beam says that they have gone.
    people = walker([(-5, 4), (6, 4)], 0), walker([(12, -3), (3, -2.5)], 1, 0.8, seed=1)
    compare(open_field().plus(movers=people)).expect()


def test_people_who_walk_slowly_are_no_change():
    people = walker([(-2, -4), (6, -4.5)], 0, 0.5), walker([(0, 4), (6, 4.5)], 1, 0.3, seed=1)
    compare(yard().plus(movers=people)).expect()


def test_people_who_stand_for_a_second_are_no_change():
    people = walker([(-4, 3), (8, 3.5)], 0, stop_s=2.0, stand_s=1.0), walker([(5, -3), (-8, -4)], 1, 1.0, 1, 2.5, 1.0)
    compare(yard().plus(movers=people)).expect()


def test_two_people_whom_the_scans_chosen_met_at_one_place_are_no_change():
    """They stand there one after the other; that the place was empty in between only the scans not chosen saw."""
    stands = [walker([(-1.8, 4), (6, 4)], 1, 1.2, 3, 1.5, 1.2), walker([(4.68, 4), (-6, 4)], 1, 1.2, 4, 3.9, 1.3)]
    before, after = drive(yard(), 0), drive(yard().plus(movers=tuple(stands)), 1)
    chosen = submap(replace(after, scans=[after.scans[k] for k in (2, 3, 5, 6)]))
    rest = submap(replace(after, scans=[after.scans[k] for k in (0, 1, 4, 7)]))
    sides = side_of(submap(before), THRESHOLDS), side_of(chosen, THRESHOLDS, rest.around)
    assert detect(*sides, THRESHOLDS).objects == []


@pytest.mark.xfail(
    strict=True,
    reason="eight people 0.83 m apart at 1.1 m/s: a place is met by 3 or more of 8 scans over 2 s, by others each "
    "time, and looked through by fewer than half as many: persistent() passes 1330 points as one object, 475 as three",
)
def test_people_who_walk_in_a_file_are_no_change():
    people = [walker([(-9 + 0.83 * k, 4), (8 + 0.83 * k, 4)], 1, 1.1, seed=k) for k in range(8)]
    compare(yard().plus(movers=people)).expect()


CRAWLING = pytest.mark.xfail(
    strict=True,
    reason="at 1 m/s a car of 4.5 m covers a place for 4 s and is met there by 5 scans; where the visit ends before it "
    "is looked through again it cannot be told from a car that stopped (0 points from 1.25 m/s)",
)


@pytest.mark.parametrize("speed_m_s", [pytest.param(1.0, marks=CRAWLING), 2.0])
@pytest.mark.parametrize("visit", [0, 1])
def test_a_car_that_drives_by_slowly_is_no_change(visit, speed_m_s):
    compare(yard().plus(movers=(driver([(-6, 4.5), (30, 4.5)], visit, speed_m_s),))).expect()


def test_leaves_and_grass_that_sway_are_no_change():
    tufts = merge([shapes.grass(rng(k)).moved((*rng(k).uniform((-7, -6), (7, -2.2)), 0)) for k in range(120)])
    plants = (
        Thing("grass", tufts),
        Thing("tree", shapes.tree(rng(1)).moved((-3, 6, 0))),
        Thing("bush", shapes.bush(rng(2)).moved((3, 4, 0))),
        Thing("hedge", shapes.hedge(rng(4), 6.0).moved((0, -7, 0))),
    )
    compare(yard().plus(*plants, wind=True)).expect()


# What the sensor does ---------------------------------------------------------------------------------------------


def puddles(height=lambda xy: np.zeros(len(xy))):
    return merge([shapes.puddle(rng(k), height).moved((x, y, 0)) for k, (x, y) in enumerate(
        [(-2, 2.2), (1, -2.5), (3, 3.5), (-4, -3), (5, -1.5)]
    )])  # fmt: skip


@pytest.mark.parametrize("visits", [None, (0,), (1,)], ids=["in both visits", "dried up", "it has rained"])
def test_puddles_are_no_change(visits):
    compare(yard().plus(Thing("puddles", puddles(), visits))).expect()


def test_panes_are_no_change():
    cars = [Thing("car", car(rng(k)).shut.moved((x, -4, 0), yaw=0.1 * k)) for k, x in enumerate((-5, 1, 6.5))]
    pane = quads([[[-2, 3.5, 0.3], [2, 3.5, 0.3], [2, 3.5, 2.5], [-2, 3.5, 2.5]]], Material.GLASS)
    frame = [tube([[x, 3.5, 0], [x, 3.5, 2.5]], [0.03] * 2, Material.METAL) for x in (-2, 0, 2)]
    compare(yard().plus(Thing("shelter", merge([pane, *frame])), *cars), second=Visit((-3, -0.6), (3, 0.7))).expect()


def test_mixed_pixels_at_edges_are_no_change():
    feet = rng(1).uniform((-8, 2), (8, 7), (20, 2))
    rods = [tube([[x, y, 0], [x, y, 2.2]], [0.05] * 2, Material.METAL) for x, y in feet]
    fence = shapes.fence(rng(2), np.zeros(7)).moved((-6, -5, 0))
    compare(yard().plus(Thing("rods", merge(rods)), Thing("fence", fence)), second=Visit((-3, 0.4), (3, -0.4))).expect()


def test_ground_and_walls_at_grazing_angles_are_no_change():
    sides = [box((44, 0.3, 3.0), Material.BRICK, (0, y, 0)) for y in (-1.7, 1.9)]
    compare(open_field().plus(Thing("passage", merge(sides))), second=Visit((-3, 0.5), (3, -0.6))).expect()


@pytest.mark.parametrize("metadata", [OS1_64, OS1_128], ids=["OS1-64 RNG15", "OS1-128 RNG19"])
def test_a_yard_where_nothing_happened_shows_no_change(metadata):
    compare(yard(), Visit(metadata=metadata), Visit(metadata=metadata)).expect()


@pytest.mark.parametrize("first,second", [(OS1_32, OS1_128), (OS1_128, OS1_32)], ids=["32 then 128", "128 then 32"])
def test_another_sensor_with_other_beams_makes_no_change(first, second):
    compare(yard(), Visit(metadata=first), Visit(metadata=second)).expect()


@pytest.mark.parametrize("visit", [0, 1])
def test_surfaces_that_send_nothing_back_are_no_change(visit):
    dark = box((2.0, 1.5, 1.2), Material.RUBBER, (1, 4, 0))
    wet = (("dark", 0.95), ("wall", 0.7), ("car", 0.9))
    visits = [Visit(lost=wet if k == visit else ()) for k in range(2)]
    compare(yard().plus(Thing("dark", dark)), *visits).expect()


@pytest.mark.parametrize("bodies", [(True, True), (False, True)], ids=["always", "bare at first"])
def test_the_robot_itself_is_no_change(bodies):
    compare(yard(), *(Visit(body=body) for body in bodies)).expect()


# Ground that is none to the segmentation -----------------------------------------------------------------------


def slope(xy):
    return 0.15 * np.asarray(xy)[..., 0]


def cross_slope(xy):
    return 0.15 * np.asarray(xy)[..., 1]


def crest(xy):
    return -0.15 * np.abs(np.asarray(xy)[..., 0])


def kerb(xy):
    return 0.12 * np.clip((np.asarray(xy)[..., 1] - 2.0) / 0.05, 0, 1)


def potholes(xy):
    xy = np.asarray(xy)
    z = np.zeros(xy.shape[:-1])
    for x, y, wide in ((-3, 2, 0.35), (0, -2, 0.5), (2, 2.6, 0.3), (4, -1.2, 0.4), (-5, -3, 0.5)):
        z -= 0.12 * np.exp(-0.5 * ((xy - [x, y]) ** 2).sum(-1) / (0.5 * wide) ** 2)
    return z


GROUNDS = {"15 % ahead": slope, "15 % across": cross_slope, "a crest": crest, "a kerb": kerb, "potholes": potholes}


@pytest.mark.parametrize("height", GROUNDS.values(), ids=GROUNDS)
def test_uneven_ground_is_no_change(height):
    world = open_field(height, cell_m=0.25)
    compare(world, second=Visit((-3, -0.7), (3, 0.6), error=staged.error(0.03, 0.03, 0.04, 0.1, 0.1))).expect()


# Where the visits were -------------------------------------------------------------------------------------------

ERRORS = {
    "ahead": staged.error(x_m=0.1),
    "aside": staged.error(y_m=0.1),
    "above": staged.error(z_m=0.1),
    "turned": staged.error(yaw_deg=0.3),
    "pitched": staged.error(pitch_deg=0.3),
    "all": staged.error(0.06, -0.06, 0.05, -0.2, 0.15, 0.15),
}


@pytest.mark.parametrize("T_map_true", ERRORS.values(), ids=ERRORS)
def test_poses_wrong_by_10_cm_or_a_third_of_a_degree_make_no_change(T_map_true):
    compare(yard(), second=Visit(error=T_map_true)).expect()


LANES = {
    "2 m to the left": ((-3, 2), (3, 2)),
    "2 m to the right": ((-3, -2), (3, -2)),
    "the other way round": ((3, 0), (-3, 0)),
    "both": ((3, 2), (-3, 2)),
}


@pytest.mark.parametrize("ends", LANES.values(), ids=LANES)
@pytest.mark.parametrize("T_map_true", [None, ERRORS["all"]], ids=["true poses", "wrong poses"])
def test_another_lane_or_the_other_way_round_makes_no_change(ends, T_map_true):
    compare(yard(), second=Visit(*ends, error=T_map_true)).expect()


def test_what_one_visit_did_not_get_to_see_is_no_change():
    # The wall goes on beyond what the first visit saw, which stopped short; so do the things behind the corner.
    corner = box((0.3, 9, 3), Material.BRICK, (4.5, 6.0, 0))
    behind = [shapes.crate(rng(k)).moved((x, 4 + k, 0)) for k, x in enumerate((6, 8, 10))]
    world = yard().plus(Thing("corner", corner), Thing("crates", merge(behind)))
    compare(world, Visit((-6, 0), (0, 0)), Visit((0, 0), (6, 0))).expect()
    compare(world, Visit((0, 0), (6, 0)), Visit((-6, 0), (0, 0))).expect()


def test_what_a_car_hid_in_one_visit_is_no_change():
    hidden = [shapes.bin_(rng(1)).moved((-1, 6.5, 0)), shapes.crate(rng(2)).moved((1, 6.3, 0))]
    parked = car(rng(5), "van").shut.of(Material.PAINT).moved((0, 4, 0))
    yard_with = yard().plus(Thing("hidden", merge(hidden)))
    compare(yard_with.plus(Thing("van", parked, (0,)))).expect(disappeared={"van": 0.5})
    compare(yard_with.plus(Thing("van", parked, (1,)))).expect(appeared={"van": 0.5})
