"""The SVGS beacons: three LED tetrahedra of falling size, one inside the other.

Figures from "High-altitude precision landing by SVGS and sensor fusion" (Drones 8, 37, 2024):
LED places and operating ranges are its Table 3, colours its Figure 10. Each LED of a beacon has
its place in the beacon's frame T (z up); a beacon stands in the pad's frame P.
"""

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from systems.configuration import Finite, NonNegative, Positive, Vector3, configuration

LEDS = 4  # of a beacon
BEACONS = 3
SHORT, MEDIUM, LONG = range(BEACONS)
BEACON_NAMES = ("short", "medium", "long")

# Light of the LED colours in the camera's red, green and blue channels: a typical phone's sensor
# under narrow-band LEDs at 525, 625 and 590 nm.
COLOURS: dict[str, tuple[float, float, float]] = {
    "green": (0.10, 1.00, 0.20),
    "red": (1.00, 0.10, 0.06),
    "yellow": (1.00, 0.70, 0.05),
    "white": (1.00, 1.00, 0.90),
}

# A lamp as a camera sees it: position (m, in P), light in red, green and blue, the range at which
# it is just bright enough (m), radius (m).
LAMP_SIZE = 8

Colour = Literal["green", "red", "yellow", "white"]


@configuration
class SvgsBeacon:
    """Four LEDs at known places."""

    colour: Colour
    leds: Annotated[list[Vector3], Field(min_length=LEDS, max_length=LEDS)]  # m, in T
    position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, 0.0])  # m, T's origin in P
    yaw: Finite = 0.0  # rad, of T in P, counter-clockwise
    operating_range: Positive  # m, upper end of the beacon's range in Table 3
    # How much further the LEDs can just be seen, so that they are clear at the end of the range
    margin: Positive = 1.25
    lamp_radius: Positive = 0.02  # m, of an LED's diffuser; not published

    def led_positions(self) -> np.ndarray:
        """The LEDs in T, m, shape (4, 3)."""
        return np.array(self.leds)

    def led_positions_in_pad(self) -> np.ndarray:
        """The LEDs in P, m, shape (4, 3)."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        R_PT = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return np.array(self.position) + self.led_positions() @ R_PT.T

    def lamps(self) -> np.ndarray:
        """The LEDs as lamps, shape (4, LAMP_SIZE)."""
        rest = [*COLOURS[self.colour], self.margin * self.operating_range, self.lamp_radius]
        return np.column_stack([self.led_positions_in_pad(), np.tile(rest, (LEDS, 1))])


def short_range_beacon() -> SvgsBeacon:
    """The short-range target: Table 3, 0 to 20 m."""
    return SvgsBeacon(
        colour="yellow",
        leds=[[0.0, 0.545, 0.0], [0.0, -0.49, 0.0], [0.0, 0.0, 0.365], [0.315, 0.0, 0.0]],
        # 1.7 m from the landing point: as far as it is in sight from 3 m, and beside the rotors
        position=[-1.7, 0.0, 0.0],
        operating_range=20.0,
    )


def medium_range_beacon() -> SvgsBeacon:
    """The medium-range target: Table 3, 10 to 85 m."""
    return SvgsBeacon(
        colour="red",
        leds=[[0.0, 0.95, 0.0], [0.0, -0.97, 0.0], [0.0, 0.0, 0.91], [0.801, 0.0, 0.0]],
        position=[-3.2, -1.5, 0.0],  # Algorithm 5's 1.5 m on each axis from the short-range target
        operating_range=85.0,
        lamp_radius=0.03,
    )


def long_range_beacon() -> SvgsBeacon:
    """The long-range target: Table 3, 55 to 200 m."""
    return SvgsBeacon(
        colour="green",
        leds=[[0.0, 7.68, 0.0], [0.0, -7.97, 0.0], [0.0, 0.0, 3.09], [9.14, 0.0, 0.0]],
        # Around the medium one (Figure 10), its mast beside the other's
        position=[-4.4, -1.5, 0.0],
        operating_range=200.0,
        lamp_radius=0.05,
    )


@configuration
class SvgsGlint:
    """A reflection or a glint of the sun that looks like an LED."""

    position: Vector3  # m, in P
    colour: Colour = "white"
    visible_range: Positive = 100.0  # m
    radius: NonNegative = 0.02  # m


@configuration
class SvgsBeaconsConfig:
    """The three beacons around the landing point, which is P's origin, and false lights."""

    short: SvgsBeacon = Field(default_factory=short_range_beacon)
    medium: SvgsBeacon = Field(default_factory=medium_range_beacon)
    long: SvgsBeacon = Field(default_factory=long_range_beacon)
    glints: Annotated[list[SvgsGlint], Field(max_length=16)] = Field(default_factory=list)

    def beacons(self) -> tuple[SvgsBeacon, SvgsBeacon, SvgsBeacon]:
        """The beacons by their index: short, medium, long."""
        return self.short, self.medium, self.long

    def led_positions(self) -> np.ndarray:
        """The LEDs of each beacon in its own frame T, m, shape (3, 4, 3)."""
        return np.array([beacon.led_positions() for beacon in self.beacons()])

    def colours(self) -> np.ndarray:
        """The colour of each beacon, shape (3, 3)."""
        return np.array([COLOURS[beacon.colour] for beacon in self.beacons()])

    def placements(self) -> np.ndarray:
        """Where the beacons stand: position in P (m) and yaw (rad), shape (3, 4)."""
        return np.array([[*beacon.position, beacon.yaw] for beacon in self.beacons()])

    def lamps(self) -> np.ndarray:
        """All that shines: the LEDs beacon by beacon, then the glints, shape (n, LAMP_SIZE)."""
        glints = [
            [*glint.position, *COLOURS[glint.colour], glint.visible_range, glint.radius]
            for glint in self.glints
        ]
        rows = [beacon.lamps() for beacon in self.beacons()]
        return np.vstack([*rows, np.array(glints).reshape(-1, LAMP_SIZE)])

    def clearance(self, offset: np.ndarray, reach: float) -> float:
        """Free room around a landed vehicle, negative if it stands on an LED.

        Parameters
        ----------
        offset : array of shape (2,)
            Where the vehicle stands, from P's origin, m.
        reach : float
            Radius of the circle that holds the vehicle, rotors and all, m.

        Returns
        -------
        float
            m, to the nearest LED.
        """
        leds = np.vstack([beacon.led_positions_in_pad() for beacon in self.beacons()])
        return float(np.min(np.hypot(*(leds[:, :2] - offset).T)) - reach)
