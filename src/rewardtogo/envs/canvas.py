"""A sheet to draw environments on: shapes in the units of the scene, with smooth edges, in colours that colour-blind eyes tell apart."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

Colour = tuple[int, int, int]
Point = Sequence[float] | Float[np.ndarray, "2"]

PAPER, MIST, STONE, INK = (255, 255, 255), (226, 226, 226), (150, 150, 150), (45, 45, 45)
"""From white to black: the ground, what is faint, what is solid, lines."""
BLUE, SKY, GREEN = (0, 114, 178), (86, 180, 233), (0, 158, 115)
ORANGE, VERMILION, YELLOW = (230, 159, 0), (213, 94, 0), (240, 228, 66)
"""The colours of Okabe and Ito (2008): `BLUE` is who acts, `GREEN` where it should be, `VERMILION` what it should not touch."""
LONGEST = 480
"""Points of a picture's longer side."""
SMOOTH = 3
"""Shapes are drawn so many times as large and then shrunk."""


class Canvas:
    """A sheet that shows the rectangle from `low` to `high`, (right, up), the longer side `LONGEST` points."""

    def __init__(self, low: Point, high: Point, ground: Colour = PAPER):
        width, height = float(high[0] - low[0]), float(high[1] - low[1])
        scale = LONGEST / max(width, height)
        # Even numbers of points: films of the kind MP4 want them.
        self._size = (2 * round(width * scale / 2), 2 * round(height * scale / 2))
        self._corner, self._scale = (float(low[0]), float(high[1])), scale * SMOOTH
        self._image = Image.new("RGB", (self._size[0] * SMOOTH, self._size[1] * SMOOTH), ground)
        self._pen = ImageDraw.Draw(self._image)

    def _at(self, point: Point) -> tuple[float, float]:
        return (float(point[0]) - self._corner[0]) * self._scale, (self._corner[1] - float(point[1])) * self._scale

    def disc(self, middle: Point, radius: float, colour: Colour, hole: float = 0.0, inside: Colour = PAPER) -> None:
        """A disc, or with a hole of that radius a ring."""
        x, y = self._at(middle)
        for size, fill in ((radius, colour), (hole, inside)):
            if size > 0:
                r = size * self._scale
                self._pen.ellipse((x - r, y - r, x + r, y + r), fill=fill)

    def polygon(self, points: Iterable[Point], colour: Colour) -> None:
        """A filled polygon."""
        self._pen.polygon([self._at(p) for p in points], fill=colour)

    def box(self, low: Point, high: Point, colour: Colour) -> None:
        """A filled rectangle."""
        self.polygon([low, (high[0], low[1]), high, (low[0], high[1])], colour)

    def line(self, points: Iterable[Point], width: float, colour: Colour) -> None:
        """A line of round ends and corners."""
        points = list(points)
        self._pen.line([self._at(p) for p in points], fill=colour, width=max(1, round(width * self._scale)))
        for point in points:
            self.disc(point, width / 2, colour)

    def picture(self) -> UInt8[np.ndarray, "H W 3"]:
        """What was drawn."""
        return np.asarray(self._image.resize(self._size, Image.Resampling.BOX))


def enlarged(picture: UInt8[np.ndarray, "H W *C"]) -> UInt8[np.ndarray, "X Y 3"]:
    """A small picture with its pixels as squares. Three channels are colours, of any other number the last one is shown, in grey."""
    if picture.ndim == 2 or picture.shape[2] != 3:
        picture = np.repeat((picture if picture.ndim == 2 else picture[..., -1])[..., None], 3, -1)
    scale = max(1, LONGEST // max(picture.shape[:2]))
    return np.ascontiguousarray(picture.repeat(scale, 0).repeat(scale, 1))
