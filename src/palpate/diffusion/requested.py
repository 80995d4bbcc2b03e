"""What is requested of a touch: numbers for all images, or a profile over the time of a video.

A profile is a table in CSV with the columns ``time_s`` (rising), ``strength`` (from 0, no contact,
to 1), ``shear_x`` and ``shear_y`` (% of the width, right and down); between its rows the numbers
change evenly.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import PalpateError, require

if TYPE_CHECKING:  # torch takes seconds to import, and what is checked here needs none of it
    from palpate.diffusion.contact import ContactScale

#: Markers that move farther, in % of the gel's width, have left their place in the lattice.
FARTHEST = 10.0
COLUMNS = ("time_s", "strength", "shear_x", "shear_y")
FIX_PROFILE = "E.g. time_s,strength,shear_x,shear_y in the first line, then 0,0.2,0,0"


@dataclass(frozen=True)
class Requested:
    """A touch that is requested; None is drawn among touches of training.

    Attributes:
        at: place of the contact in shares of width and height, from the top left.
        area: share of the gel in contact.
        strength: mean change, as its quantile among the training contacts.
        shear: mean displacement of the markers, right and down [% of the width].
        force: in place of a strength, where training knew forces [N].
        depth: in place of a strength, where training knew depths [mm].

    Raises:
        PalpateError: on numbers out of range, or two in the place of one strength.
    """

    at: tuple[float, float] | None = None
    area: float | None = None
    strength: float | None = None
    shear: tuple[float, float] | None = None
    force: float | None = None
    depth: float | None = None

    def __post_init__(self) -> None:
        if self.at is not None:
            must = "must lie on the gel: two shares of its width and height from the top left"
            inside = len(self.at) == 2 and all(0 <= v <= 1 for v in self.at)
            require(inside, "at", f"{must}, 0 to 1", _text(self.at), (0.5, 0.5))
        if self.area is not None:
            must = "must be a share of the gel above 0, and at most 1"
            require(0 < self.area <= 1, "area", must, f"{self.area:g}", 0.4)
        if self.strength is not None:
            must = "must lie in 0 to 1, a quantile of the training contacts"
            require(0 <= self.strength <= 1, "strength", must, f"{self.strength:g}", 0.5)
        if self.shear is not None:
            must = f"must be two numbers, right and down, within {FARTHEST:g} % of the width"
            near = len(self.shear) == 2 and all(abs(v) <= FARTHEST for v in self.shear)
            require(near, "shear", must, _text(self.shear), (1.0, 0.0))
        given = [name for name in ("strength", "force", "depth") if getattr(self, name) is not None]
        must = "must be left out, or stand alone"
        require(len(given) < 2, given[-1] if given else None, must, f"{' and '.join(given)}")

    def given(self) -> dict[str, Any]:
        """What is requested, by name."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    def row(self, scale: ContactScale | None, sensor: str | None = None) -> NDArray[np.float64]:
        """The touch (6,) as the generator knows it, NaN where nothing is requested.

        Args:
            scale: the generator's; None for one that was trained without contacts.
            sensor: whose strength, force or depth it is.

        Raises:
            PalpateError: if the generator knows no contacts, or none of this force or depth.
        """
        given, row = self.given(), np.full(6, np.nan)
        must, fix = "must be left out for a generator trained without contacts", "Train one on gels"
        require(scale is not None or not given, next(iter(given), None), must, "one", fix=fix)
        if self.at is not None:
            row[:2] = self.at
        row[2] = np.nan if self.area is None else self.area
        row[3] = np.nan if self.strength is None else self.strength
        if self.shear is not None:
            row[4:] = self.shear
        for name in ("force", "depth"):
            if name in given and scale is not None:
                row[3] = scale.strength_of(name, given[name], sensor)
        return row


def _text(values: Any) -> str:
    return " ".join(f"{value:g}" for value in values)


@dataclass(frozen=True)
class Profile:
    """Strength and shear over time.

    Attributes:
        seconds: (k,), rising.
        values: (k, 3) strength, shear in x and y.
        name: of the file, for errors.
    """

    seconds: NDArray[np.float64]
    values: NDArray[np.float64]
    name: str = "profile"

    @classmethod
    def load(cls, path: str | Path) -> Profile:
        """Read a table.

        Raises:
            PalpateError: if it is missing or malformed.
        """
        import polars as pl

        def wrong(got: str) -> PalpateError:
            must, fix = f"must be a table of {', '.join(COLUMNS)}", FIX_PROFILE
            return PalpateError(must, f"{Path(path).name}: {got}", fix, argument="profile")

        try:
            table = pl.read_csv(path).select(COLUMNS).cast(pl.Float64).to_numpy()
        except Exception as error:  # polars raises several kinds for what is no such table
            raise wrong(str(error).splitlines()[0]) from None
        most = np.array([np.inf, 1, FARTHEST, FARTHEST])
        fits = (table >= -most * [1, 0, 1, 1]) & (table <= most)
        fits[:, 0] &= np.diff(table[:, 0], prepend=-np.inf) > 0
        if not len(table):
            raise wrong("no rows")
        for row, column in np.argwhere(~fits):
            raise wrong(f"{COLUMNS[column]} {table[row, column]:g} in row {row + 1}")
        return cls(table[:, 0], table[:, 1:], Path(path).name)

    def at(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Touches (n, 6) at these times; place and area are NaN.

        Raises:
            PalpateError: if the profile ends earlier.
        """
        last, end = float(self.seconds[-1]), float(seconds[-1])
        must, fix = f"must reach to the end of the video, {end:.2f} s", "Add a last row"
        step = (end - float(seconds[0])) / max(1, len(seconds) - 1)
        got = f"{self.name} ends at {last:.2f} s"
        require(last >= end - step, "profile", must, got, fix=fix)
        rows = np.full((len(seconds), 6), np.nan)
        for k in range(3):
            rows[:, 3 + k] = np.interp(seconds, self.seconds, self.values[:, k])
        return rows
