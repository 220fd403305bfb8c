"""The judge of a raster's speeds beside closed forms of motions with constant jerk and acceleration."""

import numpy as np

from benchmarks import raster


def _straight(length: float) -> raster.Way:
    """A way along which the second joint alone moves, by 1 rad/m: 7.5 rad/s^2 and 3,750 rad/s^3 are its limits."""
    way = np.linspace(0.0, length, 50)
    by_length = np.zeros((3, 50, 7))
    by_length[0, :, 1] = 1.0
    return raster.Way(way, by_length)


def test_the_way_up_to_a_speed_is_as_long_as_by_the_closed_form() -> None:
    even, largest = raster.largest_speeds([_straight(0.2)], 0.6)
    ramp = 0.5 * 0.6 * (0.6 / 7.5 + 7.5 / 3750.0)
    slow = even[0][largest[0] < 0.6 * (1.0 - 1e-3)]
    assert abs(slow[slow < 0.1].max() - ramp) < 5e-4 and abs(0.2 - slow[slow > 0.1].min() - ramp) < 5e-4
    assert largest.max() <= 0.6 and largest[0][[0, -1]].max() == 0.0


def test_between_near_corners_the_tool_gets_as_fast_as_both_ways_allow() -> None:
    largest = raster.largest_speeds([_straight(0.01)], 0.6)[1]
    # v (v / a + a / j) is the length
    wanted = 7.5 * (-0.002 + np.sqrt(0.002**2 + 4.0 * 0.01 / 7.5)) / 2.0
    assert abs(largest.max() - wanted) < 5e-3 * wanted


def test_a_speed_that_joints_do_not_have_is_bounded_by_them() -> None:
    assert abs(raster.largest_speeds([_straight(2.0)], 5.0)[1].max() - 2.175) < 1e-9
