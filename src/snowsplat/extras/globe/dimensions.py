"""The shape of the snow globe, in its own frame. Both the video and the page read it from here.

The origin is the centre of the glass sphere, whose radius is 1. As everywhere in snowsplat, −y is
up. A flat floor closes the sphere at the bottom. Below it is a turned base.
"""

from dataclasses import dataclass

#: y of the floor, on which the scene stands and on which the snow lies.
FLOOR = 0.54
#: Radius of the floor: that of the sphere at this height.
FLOOR_RADIUS = (1.0 - FLOOR**2) ** 0.5
#: Distance from the centre at which the centre of a flake touches the glass.
WALL = 0.975


@dataclass(frozen=True)
class Ring:
    """A part of the base: a solid of revolution whose profile is a rounded rectangle."""

    y: float  # height of its middle; positive is down
    half: float  # half of its height
    radius: float  # its outer radius, including the rounded edge
    edge: float  # radius of the rounded edge


#: The base from top to bottom: the collar that holds the glass, the body, and the foot.
BASE = (
    Ring(0.560, 0.055, 0.915, 0.050),
    Ring(0.745, 0.180, 0.830, 0.060),
    Ring(0.925, 0.075, 0.985, 0.065),
)
#: Length over which the parts of the base are blended into each other.
BLEND = 0.05
#: y of the ground below the base.
GROUND = BASE[-1].y + BASE[-1].half
