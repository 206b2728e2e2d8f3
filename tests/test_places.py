"""What a visit says of a place: occupied, free, or not observed."""

import numpy as np
import pytest

pytest.importorskip("revisitd.drivers.virtual.embree", reason="needs the extra [sim]", exc_type=ImportError)

from staged import Thing, drive, submap, yard

from revisitd.daemon.config import Config
from revisitd.daemon.places import look
from revisitd.drivers.virtual.mesh import Material, box

RADIUS_M = 0.3
MIDDLE = np.array([0.5, 5.0, 0.6])  # of all things here; the path runs along y = 0


def state_of(place, *things):
    """What a visit to the yard with some things says of a place."""
    return look(submap(drive(yard().plus(*things), 0)), place, RADIUS_M, Config().detection)[2]


def panel(turned_by_rad):
    """A door's leaf, upright, of 4 cm: seen from its face, or from its side."""
    return Thing("panel", box((1.0, 0.04, 1.2), Material.METAL).moved((*MIDDLE[:2], 0), yaw=turned_by_rad))


def test_nothing_there_is_free_and_so_is_the_place_beside_a_thing():
    assert state_of(MIDDLE) == "free"
    assert state_of(MIDDLE - [1.2, 0, 0], panel(0.0)) == "free"


@pytest.mark.parametrize("turned_deg", [0, 45, 90])
def test_a_thin_panel_is_there_from_whichever_side_it_is_seen(turned_deg):
    assert state_of(MIDDLE, panel(np.radians(turned_deg))) == "occupied"


def test_a_hollow_thing_is_occupied_in_its_middle_too():
    bin_ = Thing("bin", box((0.5, 0.5, 1.1), Material.PLASTIC, (*MIDDLE[:2], 0)))
    assert state_of(MIDDLE, bin_) == "occupied"


def test_behind_a_wall_nothing_is_observed():
    wall = Thing("wall", box((8.0, 0.2, 3.0), Material.BRICK, (0.5, 3.5, 0)))
    assert state_of(MIDDLE, wall) == "not observed"
