"""Measures of the road."""

from __future__ import annotations

from dataclasses import dataclass

LANE = 3.6
"""Width of a lane in metres."""


@dataclass(frozen=True)
class Road:
    """A straight road: `lanes` lanes of which the camera drives in number `own`, counted from the left."""

    lanes: int = 3
    own: int = 1
    shoulder: float = 2.2

    @property
    def left(self) -> float:
        """Where the leftmost lane ends, in metres right of the camera."""
        return -(self.own + 0.5) * LANE

    @property
    def right(self) -> float:
        """Where the rightmost lane ends."""
        return (self.lanes - self.own - 0.5) * LANE

    @property
    def barrier(self) -> float:
        """Where the barrier to the oncoming lanes stands."""
        return self.left - 1.1

    def lane(self, number: int) -> float:
        """Middle of a lane; -1 and below are the oncoming ones behind the barrier."""
        return self.barrier - 1.4 + (number + 0.5) * LANE if number < 0 else (number - self.own) * LANE
