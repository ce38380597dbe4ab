"""Painters of matte surfaces: procedural, seeded, never twice the same, with crisp corners at several scales.

A painter takes a generator, the height and width in pixels and the pixels per metre, and returns a BGR image. The
factories here return painters, so that a world can say `rectangle(..., paint.brick((60, 80, 140)))`.
"""

import cv2
import numpy as np

from vislam.core.messages import ImageF32, ImageU8
from vislam.sim.scene.scene import Painter

Color = tuple[float, float, float]  # BGR, display values 0..255

_COARSE = 4
_LETTERS = "ABCDEFGHJKLMNPQRSTUVWXYZ0123456789"
VIVID: tuple[Color, ...] = (
    (40, 60, 200), (30, 140, 225), (40, 200, 230), (70, 160, 60), (190, 110, 30), (150, 60, 110), (60, 60, 60),
    (225, 225, 225), (160, 180, 40), (120, 90, 220),
)  # fmt: skip


def noise(
    rng: np.random.Generator, height: int, width: int, cells_px: tuple[float, ...], strengths: tuple[float, ...]
) -> ImageF32:
    """Return smooth noise around 1 [H, W]: random grids with the given cell sizes in pixels, enlarged and summed."""
    small = (-(-height // _COARSE) + 1, -(-width // _COARSE) + 1)
    coarse = np.zeros(small, dtype=np.float32)
    out = np.ones((height, width), dtype=np.float32)
    for cell, strength in zip(cells_px, strengths, strict=True):
        if cell <= 1.0:
            layer = rng.integers(0, 256, (height, width), dtype=np.uint8)
            cv2.addWeighted(out, 1.0, layer, strength / 74.0, -127.5 * strength / 74.0, out, cv2.CV_32F)
        elif cell > 4.0 * _COARSE:  # large cells are summed at a quarter of the resolution: sixteen times cheaper
            coarse += _enlarged(rng, small[0], small[1], cell / _COARSE, strength)
        else:
            out += _enlarged(rng, height, width, cell, strength)
    enlarged = cv2.resize(coarse, (small[1] * _COARSE, small[0] * _COARSE), interpolation=cv2.INTER_LINEAR)
    out += enlarged[:height, :width]
    return out


def _enlarged(rng: np.random.Generator, height: int, width: int, cell: float, strength: float) -> ImageF32:
    rows, columns = int(np.ceil(height / cell)) + 3, int(np.ceil(width / cell)) + 3
    grid = rng.standard_normal((rows, columns), dtype=np.float32) * np.float32(strength)
    size = (int(columns * cell) + 1, int(rows * cell) + 1)
    kind = cv2.INTER_CUBIC if cell > 4.0 else cv2.INTER_LINEAR
    top, left = (int(rng.integers(0, max(1, int(cell)))) for _ in range(2))
    return cv2.resize(grid, size, interpolation=kind)[top : top + height, left : left + width]


def tinted(grey: ImageF32, color: Color) -> ImageU8:
    """Return a BGR image of one colour times a grey pattern around 1."""
    return cv2.merge([cv2.convertScaleAbs(np.maximum(grey, 0.0), alpha=float(part)) for part in color])


def shade(rng: np.random.Generator, color: Color, spread: float) -> Color:
    """Return a colour with random brightness and a little random hue."""
    bright, *hue = (2.0 * rng.random(4) - 1.0).tolist()
    blue, green, red = (
        min(255.0, max(0.0, part * (1.0 + spread * bright) * (1.0 + 0.3 * spread * turn)))
        for part, turn in zip(color, hue, strict=True)
    )
    return blue, green, red


def text(
    image: ImageU8, words: str, left: int, bottom: int, cap_px: float, color: Color, font: int, bold: float
) -> None:
    """Write one line whose capitals are `cap_px` high, its lower left corner at (left, bottom)."""
    thickness = max(1, round(cap_px * bold))
    cv2.putText(image, words, (left, bottom), font, cap_px / 21.0, color, thickness, cv2.LINE_AA)


def word(rng: np.random.Generator, length: int) -> str:
    """Return random capitals and digits."""
    return "".join(_LETTERS[index] for index in rng.integers(0, len(_LETTERS), length))


def chips(rng: np.random.Generator, image: ImageU8, count: int, size_px: tuple[float, float], contrast: float) -> None:
    """Scatter small polygons, darker or lighter than what is below: flakes of paint, stones, dirt."""
    height, width = image.shape[:2]
    centres = rng.random((count, 2)) * (width, height)
    sizes = size_px[0] * (size_px[1] / size_px[0]) ** rng.random(count)
    angles = np.sort(2.0 * np.pi * rng.random((count, 5)), axis=1)
    radii = sizes[:, None] * (0.6 + 0.4 * rng.random((count, 5)))
    points = centres[:, None] + radii[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    polygons = np.round(points * 16.0).astype(np.int32)
    below = image[centres[:, 1].astype(int), centres[:, 0].astype(int)].astype(np.float64)
    bright = 1.0 + contrast * (2.0 * rng.random((count, 1)) - 1.0)
    hue = 1.0 + 0.3 * contrast * (2.0 * rng.random((count, 3)) - 1.0)
    colors = np.clip(below * bright * hue, 0.0, 255.0).tolist()
    for polygon, color in zip(polygons, colors, strict=True):
        cv2.fillConvexPoly(image, polygon, color, cv2.LINE_AA, 4)


def cracks(rng: np.random.Generator, image: ImageU8, count: int, length_px: float, darkness: float) -> None:
    """Draw thin dark random walks."""
    height, width = image.shape[:2]
    for _ in range(count):
        steps = int(rng.integers(8, 30))
        turns = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(rng.normal(0.0, 0.45, steps))
        start = rng.uniform((0, 0), (width, height))
        walk = start + np.cumsum(np.stack([np.cos(turns), np.sin(turns)], axis=1), axis=0) * length_px / steps
        x, y = int(np.clip(walk[0, 0], 0, width - 1)), int(np.clip(walk[0, 1], 0, height - 1))
        blue, green, red = (float(c) * darkness for c in image[y, x])
        cv2.polylines(image, [np.round(walk * 16).astype(np.int32)], False, (blue, green, red), 1, cv2.LINE_AA, 4)


def plain(color: Color, grain: float = 0.04, blotch: float = 0.06) -> Painter:
    """Painted metal or plastic: nearly even, with grain, soft blotches and a few scratches."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        grey = noise(rng, height, width, (0.3 * ppm, 0.06 * ppm, 1.0), (blotch, 0.5 * blotch, grain))
        image = tinted(grey, shade(rng, color, 0.12))
        area = height * width / ppm**2
        cracks(rng, image, int(6 * area) + 1, 0.25 * ppm, 0.7)
        chips(rng, image, int(25 * area) + 1, (0.004 * ppm, 0.015 * ppm), 0.35)
        return image

    return paint


def concrete(color: Color = (140, 145, 148), stones_per_m2: float = 45.0) -> Painter:
    """A concrete floor: clouds, stains, stones, cracks, joints, scuffs."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        cells = (1.7 * ppm, 0.5 * ppm, 0.13 * ppm, 0.035 * ppm, 2.0)
        image = tinted(noise(rng, height, width, cells, (0.07, 0.06, 0.06, 0.05, 0.05)), color)
        area = height * width / ppm**2
        chips(rng, image, int(stones_per_m2 * area), (0.006 * ppm, 0.03 * ppm), 0.4)
        chips(rng, image, int(1.5 * area), (0.03 * ppm, 0.14 * ppm), 0.25)
        cracks(rng, image, int(1.2 * area), 0.8 * ppm, 0.45)
        for along in (0, 1):
            position = rng.uniform(1.0, 2.0) * ppm
            while position < image.shape[1 - along]:
                at = int(position)
                start, end = ((at, 0), (at, height)) if along == 0 else ((0, at), (width, at))
                cv2.line(image, start, end, (70, 72, 74), max(1, int(0.008 * ppm)), cv2.LINE_AA)
                position += rng.uniform(1.9, 2.6) * ppm
        return image

    return paint


def plaster(upper: Color, lower: Color | None = None, border_m: float = 1.1) -> Painter:
    """A painted wall, two-tone if `lower` is given, with patches, scratches and flaked paint."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        cells = (1.1 * ppm, 0.3 * ppm, 0.07 * ppm, 1.0)
        grey = noise(rng, height, width, cells, (0.05, 0.035, 0.03, 0.03))
        image = tinted(grey, shade(rng, upper, 0.05))
        if lower is not None and height > border_m * ppm:
            split = height - int(border_m * ppm)
            image[split:] = tinted(grey[split:], shade(rng, lower, 0.05))
            cv2.line(image, (0, split), (width, split), (60, 60, 60), max(2, int(0.015 * ppm)))
        area = height * width / ppm**2
        chips(rng, image, int(14 * area), (0.006 * ppm, 0.03 * ppm), 0.35)
        chips(rng, image, int(1.0 * area), (0.05 * ppm, 0.2 * ppm), 0.12)
        cracks(rng, image, int(2.0 * area), 0.5 * ppm, 0.6)
        return image

    return paint


def brick(color: Color = (70, 90, 150), size_m: tuple[float, float] = (0.24, 0.08), spread: float = 0.28) -> Painter:
    """Brickwork, every brick its own shade."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        columns, rows = int(width / (size_m[0] * ppm)) + 2, int(height / (size_m[1] * ppm)) + 1
        image = tinted(noise(rng, height, width, (0.05 * ppm,), (0.06,)), (150, 160, 165))
        joint = 0.006 * ppm
        for row in range(rows):
            shift = (-0.5 if row % 2 else 0.0) + rng.uniform(-0.03, 0.03)
            for column in range(columns):
                left, top = (column + shift) * size_m[0] * ppm, row * size_m[1] * ppm
                low = np.round(np.array([left + joint, top + joint]) * 16).astype(int)
                high = np.round(np.array([left + size_m[0] * ppm - joint, top + size_m[1] * ppm - joint]) * 16).astype(
                    int
                )
                points = np.array([low, (high[0], low[1]), high, (low[0], high[1])], dtype=np.int32)
                cv2.fillConvexPoly(image, points, shade(rng, color, spread), cv2.LINE_AA, 4)
        grey = noise(rng, height, width, (0.9 * ppm, 0.03 * ppm, 1.0), (0.07, 0.07, 0.06))
        return cv2.multiply(image, cv2.merge([grey, grey, grey]), dtype=cv2.CV_8UC3)

    return paint


def wood(color: Color = (80, 125, 175), plank_m: float = 0.11, upright: bool = False) -> Painter:
    """Planks with grain, gaps and nails."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        if upright:
            return np.ascontiguousarray(cv2.transpose(paint_planks(rng, width, height, ppm)))
        return paint_planks(rng, height, width, ppm)

    def paint_planks(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        fine = rng.standard_normal((height, max(2, int(width / (0.08 * ppm)) + 2)), dtype=np.float32)
        grain = cv2.resize(fine, (width, height), interpolation=cv2.INTER_CUBIC) * np.float32(0.09)
        grey = noise(rng, height, width, (0.25 * ppm, 1.0), (0.08, 0.03)) + grain
        image = np.empty((height, width, 3), dtype=np.uint8)
        top = 0
        while top < height:
            end = min(height, top + max(3, round(plank_m * ppm * rng.uniform(0.85, 1.15))))
            image[top:end] = tinted(grey[top:end], shade(rng, color, 0.2))
            image[top : top + max(1, int(0.006 * ppm))] //= 3
            for left in (int(0.03 * ppm), width - int(0.03 * ppm)):
                cv2.circle(image, (left, (top + end) // 2), max(1, int(0.006 * ppm)), (40, 40, 45), -1, cv2.LINE_AA)
            top = end
        chips(rng, image, int(12 * height * width / ppm**2) + 2, (0.006 * ppm, 0.025 * ppm), 0.45)
        return image

    return paint


def tiles(color: Color, size_m: float, spread: float) -> Painter:
    """Square tiles with joints; a few in another colour."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        step = size_m * ppm
        columns, rows = int(width / step) + 2, int(height / step) + 2
        image = np.full((height, width, 3), (95, 95, 95), dtype=np.uint8)
        shift = rng.uniform(0.0, step, 2)
        for row in range(rows):
            for column in range(columns):
                low = np.array([column * step - shift[0], row * step - shift[1]]) + 0.006 * ppm
                high = low + step - 0.012 * ppm
                points = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
                own = shade(rng, color, spread if rng.random() > 0.06 else 3.0 * spread)
                cv2.fillConvexPoly(image, np.round(points * 16).astype(np.int32), own, cv2.LINE_AA, 4)
        chips(rng, image, int(10 * height * width / ppm**2), (0.006 * ppm, 0.025 * ppm), 0.3)
        grey = noise(rng, height, width, (0.8 * ppm, 0.1 * ppm, 1.0), (0.04, 0.03, 0.04))
        return cv2.multiply(image, cv2.merge([grey, grey, grey]), dtype=cv2.CV_8UC3)

    return paint
