"""The SVGS beacons: Table 3, their layout, and the room beside them."""

import numpy as np
import pytest

from plants.svgs_beacons import (
    COLOURS,
    LAMP_SIZE,
    SvgsBeacon,
    SvgsBeaconsConfig,
    SvgsGlint,
)
from plants.vehicles import dr_spider

# Table 3 of the paper: extent along x, along y to both sides, and along z, m.
TABLE_3 = {"short": (0.315, 0.545, -0.49, 0.365), "medium": (0.801, 0.95, -0.97, 0.91),
           "long": (9.14, 7.68, -7.97, 3.09)}  # fmt: skip


@pytest.mark.parametrize("name", TABLE_3)
def test_leds_are_those_of_table_3(name):
    leds = getattr(SvgsBeaconsConfig(), name).led_positions()
    x, y_left, y_right, z = TABLE_3[name]
    np.testing.assert_array_equal(leds, [[0, y_left, 0], [0, y_right, 0], [0, 0, z], [x, 0, 0]])


def test_leds_stand_in_the_pads_frame():
    beacon = SvgsBeacon(
        colour="red",
        leds=[[1.0, 0.0, 0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, -1.0, 0.0]],
        position=[10.0, 20.0, 0.0],
        yaw=np.pi / 2,
        operating_range=50.0,
    )
    in_pad = beacon.led_positions_in_pad()
    np.testing.assert_allclose(in_pad[0], [10.0, 21.0, 0.5], atol=1e-12)
    np.testing.assert_allclose(in_pad[1], [9.0, 20.0, 0.0], atol=1e-12)


def test_lamps():
    config = SvgsBeaconsConfig(glints=[SvgsGlint(position=[1.0, 2.0, 0.0])])
    lamps = config.lamps()
    assert lamps.shape == (13, LAMP_SIZE)
    np.testing.assert_allclose(lamps[0, 3:6], COLOURS["yellow"])
    np.testing.assert_allclose(lamps[8, 3:6], COLOURS["green"])
    # Clear beyond the upper end of the operating ranges of Table 3
    assert np.all(lamps[:12, 6] > np.repeat([20.0, 85.0, 200.0], 4))
    np.testing.assert_allclose(lamps[12, 3:6], COLOURS["white"])


def test_beacons_are_concentric():
    """Figure 10: each within the next larger one."""
    short, medium, long = (b.led_positions_in_pad()[:, :2] for b in SvgsBeaconsConfig().beacons())
    for inner, outer in ((medium, long), (short, long)):
        assert np.all(inner.min(axis=0) > outer.min(axis=0))
        assert np.all(inner.max(axis=0) < outer.max(axis=0))


def test_the_landing_point_is_free():
    vehicle = dr_spider()
    rotors = np.linalg.norm(np.array(vehicle.rotor_positions)[:, :2], axis=1)
    reach = float(rotors.max() + vehicle.rotor_radius)
    config = SvgsBeaconsConfig()
    assert config.clearance(np.zeros(2), reach) > 0.5
    assert config.clearance(np.array([-1.7, 0.0]), reach) < 0.0


def test_placements():
    placements = SvgsBeaconsConfig().placements()
    assert placements.shape == (3, 4)
    # Algorithm 5 moves 1.5 m on each axis from the medium to the short-range beacon.
    np.testing.assert_allclose(placements[0, :2] - placements[1, :2], [1.5, 1.5])
