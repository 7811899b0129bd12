"""Units of distances and speeds in pictures and reports; tables are always in SI units."""

from __future__ import annotations

from dataclasses import dataclass

ROUGH_DISTANCE = 0.2
"""Relative standard error above which a distance is marked as rough, by a tilde."""


def format_with_error(value: float, error: float | None, *, signed: bool = False) -> str:
    """Format a value and its standard error, if any; both have a decimal if the error is below 0.95.

    >>> format_with_error(17.3, 4.0), format_with_error(5.23, 0.36), format_with_error(-0.2, None)
    ('17 ± 4', '5.2 ± 0.4', '0')
    """
    digits = int(error is not None and error < 0.95)
    shown = round(value, digits) + 0.0  # + 0.0 turns -0.0 into 0.0
    text = f"{shown:{'+' if signed and shown else ''}.{digits}f}"
    return text if error is None else f"{text} ± {max(error, 0.1):.{digits}f}"


@dataclass(frozen=True)
class Units:
    """A unit of distance and one of speed: factors from meters and meters per second, symbols and names."""

    distance: float
    distance_symbol: str
    distance_name: str
    speed: float
    speed_symbol: str
    speed_name: str

    def distance_text(self, meters: float, std_m: float | None, *, with_std: bool = False) -> str:
        """Format a distance, such as "17 m"; "~17 m" if its error exceeds 20%, "17 ± 3 m" with the error."""
        value, symbol = self.distance * meters, self.distance_symbol
        if with_std and std_m is not None:
            return f"{format_with_error(value, self.distance * std_m)} {symbol}"
        rough = std_m is not None and std_m > ROUGH_DISTANCE * meters
        return f"{'~' * rough}{value:.0f} {symbol}"

    def speed_text(
        self, speed_mps: float, std_mps: float | None, *, with_std: bool = False, signed: bool = True
    ) -> str:
        """Format a speed relative to the camera, such as "-6 km/h", or "-6 ± 2 km/h" with its error.

        Speeds over ground are not `signed`: "94 km/h".
        """
        error = None if std_mps is None or not with_std else self.speed * std_mps
        return f"{format_with_error(self.speed * speed_mps, error, signed=signed)} {self.speed_symbol}"


UNITS = {
    "metric": Units(1.0, "m", "meters", 3.6, "km/h", "kilometers per hour"),
    "imperial": Units(1 / 0.3048, "ft", "feet", 3600 / 1609.344, "mph", "miles per hour"),
}
"""Systems of units by name."""
