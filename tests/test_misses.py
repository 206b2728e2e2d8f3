"""What must be found: once, with the right polarity, and with most of what was to be seen of it."""

import numpy as np
import pytest

pytest.importorskip("revisitd.drivers.virtual.embree", reason="needs the extra [sim]", exc_type=ImportError)

from staged import (
    OS1_64,
    OS1_128,
    Outcome,
    Thing,
    Visit,
    compare,
    detected,
    drive,
    error,
    house,
    open_field,
    submap,
    yard,
)

from revisitd.daemon.detection.erasure import update_map
from revisitd.daemon.detection.results import Erasure
from revisitd.drivers.virtual import shapes
from revisitd.drivers.virtual.mesh import Material, box, tube
from revisitd.drivers.virtual.vehicles import car

MOST = 0.75  # of the surface that was seen
# What lies within tau (0.3 m) of a thing that stays is no candidate, and no beam gets 0.3 m past it: a side next to a
# wall, the hinge of an open door, the place of a shut one before the seat and beside the frame.
BESIDE_WHAT_STAYS = 0.6


def rng(seed=3):
    return np.random.default_rng(seed)


def crate(xy=(0.5, 4.0), visits=(1,), kind="crate", **more):
    return Thing(kind, box((0.5, 0.4, 0.6), Material.WOOD).moved((*xy, 0)), visits, **more)


# Small and thin ---------------------------------------------------------------------------------------------------


LOW_AND_FAR = pytest.mark.xfail(
    strict=True,
    reason="of 45 voxels the ground takes 19, and 11 of the 26 others are not confirmed (a beam through the lower half "
    "ends on the ground less than 0.3 m behind): 15 are fewer than min_points, 25",
)


@pytest.mark.parametrize(
    "metadata,y_m",
    [(OS1_64, 3.0), pytest.param(OS1_64, 8.0, marks=LOW_AND_FAR), (OS1_128, 3.0), (OS1_128, 8.0)],
    ids=["OS1-64 at 3 m", "OS1-64 at 8 m", "OS1-128 at 3 m", "OS1-128 at 8 m"],
)
def test_a_box_of_20_cm_on_the_ground_is_found(metadata, y_m):
    cube = Thing("cube", box((0.2, 0.2, 0.2), Material.WOOD, (0.5, y_m, 0)), (1,))
    compare(yard().plus(cube), Visit(metadata=metadata), Visit(metadata=metadata)).expect(appeared={"cube": MOST})


@pytest.mark.parametrize(
    "metadata,y_m",
    [(OS1_64, 3.0), (OS1_64, 6.0), (OS1_128, 6.0)],
    ids=["OS1-64 at 3 m", "OS1-64 at 6 m", "OS1-128 at 6 m"],
)
def test_a_pole_of_6_cm_is_found(metadata, y_m):
    pole = Thing("pole", tube([[0.8, y_m, 0], [0.8, y_m, 2.2]], [0.03] * 2, Material.METAL, 12), (1,))
    compare(yard().plus(pole), Visit(metadata=metadata), Visit(metadata=metadata)).expect(appeared={"pole": MOST})


def test_a_fence_panel_is_found():
    panel = Thing("panel", shapes.fence_panel(rng()).moved((-0.5, 4.5, 0), yaw=0.2), (1,))
    compare(yard().plus(panel)).expect(appeared={"panel": MOST})


# Seen in part -----------------------------------------------------------------------------------------------------


def test_a_person_half_hidden_behind_a_bin_is_found():
    bin_ = Thing("bin", shapes.bin_(rng(1)).moved((0, 4.0, 0)))
    person = Thing("person", shapes.person(rng(2)).moved((0.2, 4.9, 0), yaw=-1.5), (1,))
    compare(yard().plus(bin_, person)).expect(appeared={"person": MOST})


@pytest.mark.parametrize("visits,polarity", [((1,), "appeared"), ((0,), "disappeared")], ids=["comes", "leaves"])
def test_a_large_van_of_which_one_side_is_seen_is_one_change(visits, polarity):
    parked = Thing("parked", car(rng(5), "van").shut.of(Material.PAINT).moved((0.3, 5.5, 0), yaw=0.05), visits)
    compare(yard().plus(parked)).expect(**{polarity: {"parked": MOST}})


@pytest.mark.parametrize("model,visits,polarity", [("sedan", (1,), "appeared"), ("van", (0,), "disappeared")])
def test_a_car_with_panes_is_one_change(visits, polarity, model):
    parked = Thing("parked", car(rng(5), model).shut.moved((0.3, 4.2, 0), yaw=0.05), visits)
    compare(yard().plus(parked)).expect(**{polarity: {"parked": 0.7}})


def test_a_thing_against_a_wall_is_found():
    wall = Thing("near wall", box((6, 0.2, 2.0), Material.BRICK, (0, 4.5, 0)))
    leaning = Thing("case", box((0.5, 0.3, 0.8), Material.PLASTIC, (0.3, 4.2, 0)), (1,))  # 5 cm before the wall
    compare(yard().plus(wall, leaning)).expect(appeared={"case": BESIDE_WHAT_STAYS})


@pytest.mark.xfail(
    strict=True,
    reason="its front is 20 cm from the wall, nearer than tau (0.3 m) and than the margin of a look through: of 1174 "
    "voxels that are not ground none is a candidate",
)
def test_a_flat_thing_against_a_wall_is_found():
    wall = Thing("near wall", box((6, 0.2, 2.0), Material.BRICK, (0, 4.5, 0)))
    leaning = Thing("board", box((1.0, 0.15, 1.2), Material.WOOD, (0.3, 4.275, 0)), (1,))  # 5 cm before the wall
    compare(yard().plus(wall, leaning)).expect(appeared={"board": MOST})


@pytest.mark.xfail(
    strict=True,
    reason="persistent() wants each point met by 3 scans; what is passed so near, with 1.2 m between scans, is met by "
    "1 or 2 and never looked through: of 399 confirmed voxels 85 are left at 1.7 m (0.50 covered), 3 of 332 at 1.4 m",
)
@pytest.mark.parametrize("y_m", [1.4, 1.7], ids=["at 1.4 m", "at 1.7 m"])
def test_a_box_beside_the_path_is_found(y_m):
    low = Thing("box", box((0.6, 0.6, 0.5), Material.WOOD, (0, y_m, 0)), (1,))
    compare(yard().plus(low), second=Visit(n_scans=6, every_s=1.0)).expect(appeared={"box": MOST})


LEAVES = pytest.mark.xfail(
    strict=True,
    reason="0.71 of its surface: leaves that their own visit looks through do not count as having stayed",
)


@pytest.mark.parametrize("y_m", [3.5, pytest.param(7.0, marks=LEAVES)], ids=["at 3.5 m", "at 7 m"])
def test_a_fallen_tree_is_found(y_m):
    tree = Thing("fallen tree", shapes.fallen_tree(rng(7)).moved((0.3, y_m, 0), yaw=0.3), (1,))
    compare(yard().plus(tree)).expect(appeared={"fallen tree": MOST})


def test_a_thing_is_found_from_another_lane_the_other_way_round():
    compare(yard().plus(crate()), second=Visit((3, -2), (-3, -2))).expect(appeared={"crate": MOST})


def test_a_thing_is_found_gone_from_another_lane_the_other_way_round():
    compare(yard().plus(crate(visits=(0,))), second=Visit((3, 2), (-3, 2))).expect(disappeared={"crate": MOST})


# Doors ------------------------------------------------------------------------------------------------------------


def test_a_car_door_that_opens_is_found_with_the_place_it_left():
    made = car(rng(4), "sedan")
    place = dict(xyz=(0.5, -4.2, 0), yaw=0.0)  # its left door towards the robot
    world = yard().plus(
        Thing("body", made.body.moved(**place)),
        Thing("shut", made.door_shut.moved(**place), (0,)),
        Thing("open", made.door_open.moved(**place), (1,)),
    )
    compare(world).expect(appeared={"open": BESIDE_WHAT_STAYS}, disappeared={"shut": BESIDE_WHAT_STAYS})


@pytest.mark.parametrize("z_m", [-0.1, 0.1])
def test_a_van_door_that_opens_takes_no_roof_with_it_where_poses_are_wrong(z_m):
    made = car(rng(4), "van")  # its roof at the sensor's height, seen at a grazing angle
    place = dict(xyz=(0.5, -4.2, 0), yaw=0.0)
    world = yard().plus(
        Thing("body", made.body.moved(**place)),
        Thing("shut", made.door_shut.moved(**place), (0,)),
        Thing("open", made.door_open.moved(**place), (1,)),
    )
    outcome = compare(world, second=Visit(error=error(z_m=z_m)))
    outcome.expect(appeared={"open": BESIDE_WHAT_STAYS}, disappeared={"shut": 0.5})
    assert all(np.ptp(found.points, axis=0).max() < 1.2 for found in outcome.detection.objects)


def test_a_house_door_that_opens_is_found_with_the_place_it_left():
    world = (
        yard()
        .without("house door")
        .plus(Thing("shut", house().door_shut, (0,)), Thing("open", house().door_open, (1,)))
    )
    x = house().door_xyz[0]
    past = Visit((x - 3, 4.0), (x + 3, 4.0))
    compare(world, past, past).expect(appeared={"open": BESIDE_WHAT_STAYS}, disappeared={"shut": BESIDE_WHAT_STAYS})


# Coming, going, moving ----------------------------------------------------------------------------------------------


def test_a_thing_taken_away_is_found():
    compare(yard().plus(crate(visits=(0,)))).expect(disappeared={"crate": MOST})


@pytest.mark.parametrize("step", [(1.0, 0.0), (0.0, 1.0)], ids=["aside", "away"])
def test_a_thing_moved_by_a_metre_goes_and_comes(step):
    before, after = (0.5, 4.0), (0.5 + step[0], 4.0 + step[1])
    world = yard().plus(crate(before, (0,), "here"), crate(after, (1,), "there"))
    compare(world).expect(appeared={"there": MOST}, disappeared={"here": MOST})


@pytest.mark.parametrize("visits,polarity", [((1,), "appeared"), ((0,), "disappeared")], ids=["comes", "leaves"])
def test_a_change_at_the_edge_of_what_is_compared_is_found(visits, polarity):
    far_wall = Thing("far wall", box((40, 0.3, 4), Material.BRICK, (0, 22.5, 0)))
    parked = Thing("parked", car(rng(5)).shut.of(Material.PAINT).moved((0.3, 17.3, 0)), visits)
    compare(open_field().plus(far_wall, parked)).expect(**{polarity: {"parked": MOST}})


def test_a_thing_put_down_in_the_middle_of_a_visit_is_found():
    compare(yard().plus(crate(since=0.4)), second=Visit(n_scans=10, every_s=0.6)).expect(appeared={"crate": MOST})


# Three visits -------------------------------------------------------------------------------------------------------


def third_visit(world):
    """What the third visit is told to have changed, by a map that knows what the second one found gone."""
    first, second, third = (drive(world, k) for k in range(3))
    gone = [o for o in detected(submap(first), submap(second)).objects if o.polarity == "disappeared"]
    known = submap(first, second)
    erasures = [Erasure(o.points, 1, o.after_ns) for o in gone]
    known = update_map(known, np.ones(len(known.stamp_ns), int), erasures)
    return Outcome(detected(known, submap(third)), second, third), gone


def test_what_is_known_to_be_gone_is_not_found_gone_again():
    outcome, gone = third_visit(yard().plus(crate(visits=(0,))))
    assert len(gone) == 1
    outcome.expect()


def test_what_came_back_on_the_third_visit_is_found():
    outcome, _ = third_visit(yard().plus(crate(visits=(0, 2))))
    outcome.expect(appeared={"crate": MOST})


def test_what_came_on_the_second_visit_is_found_gone_on_the_third():
    outcome, gone = third_visit(yard().plus(crate(visits=(1,))))
    assert not gone
    outcome.expect(disappeared={"crate": MOST})


def test_what_came_on_the_second_visit_and_stays_is_not_found_again():
    outcome, _ = third_visit(yard().plus(crate(visits=(1, 2))))
    outcome.expect()


def test_a_third_visit_tells_apart_what_went_before_and_what_went_now():
    world = yard().plus(
        crate((-1.5, 4.0), (0,), "gone before"),
        crate((0.5, 4.5), (0, 1), "gone now"),
        crate((2.0, 5.0), (0, 2), "back again"),
        crate((0.0, -3.5), (2,), "new"),
    )
    outcome, gone = third_visit(world)
    assert len(gone) == 2
    outcome.expect(appeared={"back again": MOST, "new": MOST}, disappeared={"gone now": MOST})
