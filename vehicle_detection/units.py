"""Units of distances and speeds in pictures and reports; tables are always in SI units."""

from __future__ import annotations

from dataclasses import dataclass

ROUGH_DISTANCE = 0.2
"""Relative standard error above which a distance is marked as rough, by a tilde."""


@dataclass(frozen=True, kw_only=True)
class Units:
    """A unit of distance and one of speed: factors from meters and meters per second, symbols and names."""

    distance: float
    distance_symbol: str
    distance_name: str
    speed: float
    speed_symbol: str
    speed_name: str

    def distance_text(self, meters: float, std_m: float | None, *, with_std: bool = False) -> str:
        """Format a distance, such as "17 m"; "~17 m" if its error exceeds 20%, "17 ± 3 m" with the error.

        >>> UNITS["metric"].distance_text(17.3, 4.0)
        '~17 m'
        >>> UNITS["imperial"].distance_text(17.3, 2.0, with_std=True)
        '57 ± 7 ft'
        """
        value, symbol = self.distance * meters, self.distance_symbol
        if with_std and std_m is not None:
            return f"{value:.0f} ± {self.distance * std_m:.0f} {symbol}"
        rough = std_m is not None and std_m > ROUGH_DISTANCE * meters
        return f"{'~' * rough}{value:.0f} {symbol}"

    def speed_text(
        self, speed_mps: float, std_mps: float | None, *, with_std: bool = False, signed: bool = True
    ) -> str:
        """Format a speed relative to the camera, such as "-6 km/h", or "-6 ± 2 km/h" with its error.

        Speeds over ground are not `signed`: "94 km/h".
        """
        value = round(self.speed * speed_mps) + 0.0  # + 0.0 turns -0.0 into 0.0
        error = f" ± {self.speed * std_mps:.0f}" if with_std and std_mps is not None else ""
        return f"{value:{'+' if signed and value else ''}.0f}{error} {self.speed_symbol}"


UNITS = {
    "metric": Units(
        distance=1.0,
        distance_symbol="m",
        distance_name="meters",
        speed=3.6,
        speed_symbol="km/h",
        speed_name="kilometers per hour",
    ),
    "imperial": Units(
        distance=1 / 0.3048,
        distance_symbol="ft",
        distance_name="feet",
        speed=3600 / 1609.344,
        speed_symbol="mph",
        speed_name="miles per hour",
    ),
}
"""Systems of units by name."""
