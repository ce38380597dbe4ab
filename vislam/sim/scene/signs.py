"""Painters of things that people put into rooms: posters, labels, doors, books, screens, and walls that carry them."""

from collections.abc import Sequence

import cv2
import numpy as np

from vislam.core.messages import ImageU8
from vislam.sim.scene import paint as p
from vislam.sim.scene.names import Carrying, Hung, Named
from vislam.sim.scene.paint import VIVID, Color
from vislam.sim.scene.scene import Painter


def _vivid(rng: np.random.Generator) -> Color:
    return p.shade(rng, VIVID[int(rng.integers(0, len(VIVID)))], 0.25)


def _polygon(image: ImageU8, points: np.ndarray, color: Color) -> None:
    cv2.fillPoly(image, [np.round(points * 16.0).astype(np.int32)], color, cv2.LINE_AA, 4)


def _contrast(color: Color) -> Color:
    """Return near-white on dark colours and near-black on light ones."""
    bright = 0.114 * color[0] + 0.587 * color[1] + 0.299 * color[2]
    return (25.0, 25.0, 30.0) if bright > 120.0 else (235.0, 238.0, 240.0)


def carrying(base: Painter, things: Sequence[Hung]) -> Painter:
    """Return a painter of a surface with things on it; what does not fit is cut at the border."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        own, *others = rng.spawn(len(things) + 1)
        image = base(own, height, width, ppm)
        for (left_m, top_m, width_m, height_m, painter), stream in zip(things, others, strict=True):
            picture = painter(stream, max(4, round(height_m * ppm)), max(4, round(width_m * ppm)), ppm)
            left, top = round(left_m * ppm), height - round(top_m * ppm)
            x0, y0 = max(0, left), max(0, top)
            x1, y1 = min(width, left + picture.shape[1]), min(height, top + picture.shape[0])
            if x1 > x0 and y1 > y0:
                shadow = image[y0 : min(height, y1 + 2), x0 : min(width, x1 + 2)]
                shadow //= 2
                image[y0:y1, x0:x1] = picture[y0 - top : y1 - top, x0 - left : x1 - left]
        return image

    return Carrying(things, paint)


def poster() -> Painter:
    """A printed poster: one of headline and text, shapes, chart, landscape, street map."""
    kinds = (_headline, _shapes, _chart, _landscape, _street_map)

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        image = kinds[int(rng.integers(0, len(kinds)))](rng, height, width)
        edge = max(1, int(0.012 * ppm))
        frame = (235, 235, 235) if rng.random() < 0.6 else (35, 35, 40)
        cv2.rectangle(image, (0, 0), (width - 1, height - 1), frame, edge)
        grain = p.noise(rng, height, width, (0.1 * ppm, 1.0), (0.02, 0.02))
        return cv2.multiply(image, cv2.merge([grain, grain, grain]), dtype=cv2.CV_8UC3)

    return Named("poster", paint)


def _headline(rng: np.random.Generator, height: int, width: int) -> ImageU8:
    paper = _vivid(rng) if rng.random() < 0.5 else p.shade(rng, (225, 230, 232), 0.05)
    ink = _contrast(paper)
    image = np.full((height, width, 3), paper, dtype=np.uint8)
    y = 0.0
    while y < 0.55 * height:
        cap = height * rng.uniform(0.09, 0.2)
        y += 1.35 * cap
        color = ink if rng.random() < 0.6 else _vivid(rng)
        p.text(image, p.word(rng, int(rng.integers(3, 9))), int(0.06 * width), int(y), cap, color, 2, 0.14)
    line = max(3.0, 0.035 * height)
    while y < 0.92 * height:
        y += 1.5 * line
        x = 0.07 * width
        while x < 0.88 * width:
            end = min(x + width * rng.uniform(0.04, 0.16), 0.93 * width)
            cv2.rectangle(image, (int(x), int(y)), (int(end), int(y + 0.55 * line)), ink, -1)
            x = end + 0.025 * width
    return image


def _shapes(rng: np.random.Generator, height: int, width: int) -> ImageU8:
    image = np.full((height, width, 3), _vivid(rng), dtype=np.uint8)
    for _ in range(int(rng.integers(9, 18))):
        centre = rng.uniform((0, 0), (width, height))
        size = min(height, width) * rng.uniform(0.06, 0.3)
        corners = int(rng.integers(3, 7))
        angles = rng.uniform(0, 2 * np.pi) + np.arange(corners) * 2 * np.pi / corners
        points = centre + size * np.stack([np.cos(angles), np.sin(angles)], axis=1) * rng.uniform(0.5, 1.0, 2)
        _polygon(image, points, _vivid(rng))
    return image


def _chart(rng: np.random.Generator, height: int, width: int) -> ImageU8:
    image = np.full((height, width, 3), p.shade(rng, (228, 230, 232), 0.05), dtype=np.uint8)
    p.text(image, p.word(rng, 6), int(0.06 * width), int(0.14 * height), 0.08 * height, (40, 40, 45), 2, 0.14)
    bars = int(rng.integers(6, 13))
    for index in range(bars):
        left = width * (0.08 + 0.84 * index / bars)
        top = height * rng.uniform(0.22, 0.75)
        corner = (int(left), int(top)), (int(left + 0.6 * width / bars), int(0.88 * height))
        cv2.rectangle(image, *corner, _vivid(rng), -1)
    for row in range(3, 10):
        cv2.line(
            image, (int(0.05 * width), row * height // 10), (int(0.95 * width), row * height // 10), (150, 150, 150), 1
        )
    return image


def _landscape(rng: np.random.Generator, height: int, width: int) -> ImageU8:
    sky = np.linspace(1.15, 0.8, height, dtype=np.float32)[:, None] * np.ones((1, width), dtype=np.float32)
    image = p.tinted(sky * p.noise(rng, height, width, (0.3 * height, 0.08 * height), (0.06, 0.04)), (215, 175, 120))
    x = np.linspace(0.0, width, 48)
    for layer in range(5):
        ridge = np.cumsum(rng.normal(0.0, 0.035 * height, 48)) + height * (0.35 + 0.13 * layer)
        outline = np.concatenate([np.stack([x, ridge], axis=1), [[width, height], [0.0, height]]])
        _polygon(image, outline, p.shade(rng, (90 - 12 * layer, 110 - 8 * layer, 80 + 6 * layer), 0.3))
    p.chips(rng, image, 60, (0.01 * height, 0.035 * height), 0.5)
    return image


def _street_map(rng: np.random.Generator, height: int, width: int) -> ImageU8:
    image = np.full((height, width, 3), p.shade(rng, (205, 225, 215), 0.06), dtype=np.uint8)
    for _ in range(14):
        low = rng.uniform((0, 0), (0.9 * width, 0.9 * height))
        high = low + rng.uniform(0.06, 0.3, 2) * (width, height)
        cv2.rectangle(image, low.astype(int).tolist(), high.astype(int).tolist(), _vivid(rng), -1)
    for _ in range(9):
        ends = rng.uniform((0, 0), (width, height), (2, 2)).astype(int)
        color = (245, 245, 245) if rng.random() < 0.6 else (60, 190, 240)
        cv2.line(image, ends[0].tolist(), ends[1].tolist(), color, max(2, int(0.025 * width)), cv2.LINE_AA)
    return image


def sign(color: Color, words: str | None = None) -> Painter:
    """A plate with a few large letters; random ones if none are given."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        image = np.full((height, width, 3), color, dtype=np.uint8)
        ink = _contrast(color)
        line = words if words is not None else p.word(rng, max(1, min(6, int(1.1 * width / height))))
        cap = min(0.62 * height, 0.85 * width / (0.95 * len(line)))
        p.text(image, line, int(0.08 * width), int(0.5 * height + 0.5 * cap), cap, ink, 2, 0.16)
        cv2.rectangle(image, (0, 0), (width - 1, height - 1), ink, max(1, int(0.012 * ppm)))
        return image

    return Named("sign", paint)


def stripes(first: Color = (35, 195, 235), second: Color = (30, 30, 32), width_m: float = 0.09) -> Painter:
    """Slanted warning stripes, worn."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        image = np.full((height, width, 3), first, dtype=np.uint8)
        step = 2.0 * width_m * ppm
        for x in np.arange(-height - step, width + step, step):
            corners = np.array([(x, height), (x + 0.5 * step, height), (x + 0.5 * step + height, 0), (x + height, 0)])
            _polygon(image, corners, second)
        p.chips(rng, image, int(60 * height * width / ppm**2) + 3, (0.006 * ppm, 0.03 * ppm), 0.5)
        return image

    return paint


def carton() -> Painter:
    """A cardboard box: tape, printed marks, a label with text and a bar code."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        cells = (0.15 * ppm, 0.03 * ppm, 1.0)
        image = p.tinted(p.noise(rng, height, width, cells, (0.05, 0.04, 0.03)), p.shade(rng, (95, 140, 180), 0.18))
        if rng.random() < 0.7:
            x, half = int(width * rng.uniform(0.4, 0.6)), max(1, int(0.025 * ppm))
            image[:, max(0, x - half) : x + half] = (image[:, max(0, x - half) : x + half] * 0.6 + 55).astype(np.uint8)
        ink = p.shade(rng, (45, 50, 60), 0.4)
        cap = min(0.25 * height, 0.12 * width) * rng.uniform(0.7, 1.3)
        p.text(image, p.word(rng, 5), int(0.06 * width), int(height * rng.uniform(0.3, 0.45)), cap, ink, 2, 0.14)
        _label(rng, image, ppm)
        p.chips(rng, image, int(30 * height * width / ppm**2) + 2, (0.006 * ppm, 0.02 * ppm), 0.4)
        return image

    return paint


def _label(rng: np.random.Generator, image: ImageU8, ppm: float) -> None:
    height, width = image.shape[:2]
    w, h = min(0.45 * width, 0.22 * ppm), min(0.4 * height, 0.15 * ppm)
    x, y = rng.uniform(0.05, 0.5) * width, height * rng.uniform(0.45, 0.58)
    color = (235, 238, 240) if rng.random() < 0.7 else _vivid(rng)
    cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), color, -1)
    position = x + 0.08 * w
    while position < x + 0.9 * w:
        bar = w * rng.uniform(0.015, 0.06)
        cv2.rectangle(
            image, (int(position), int(y + 0.5 * h)), (int(position + bar), int(y + 0.9 * h)), (25, 25, 25), -1
        )
        position += bar + w * rng.uniform(0.02, 0.05)
    p.text(image, p.word(rng, 6), int(x + 0.08 * w), int(y + 0.4 * h), 0.25 * h, (30, 30, 30), 0, 0.1)


def crate(color: Color) -> Painter:
    """A plastic crate: ribs, rim, a plate with a number."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        base = p.shade(rng, color, 0.2)
        image = p.tinted(p.noise(rng, height, width, (0.1 * ppm, 1.0), (0.05, 0.03)), base)
        dark = tuple(0.55 * c for c in base)
        for x in np.arange(0.05 * ppm, width, rng.uniform(0.06, 0.11) * ppm):
            cv2.line(image, (int(x), int(0.2 * height)), (int(x), height), dark, max(1, int(0.01 * ppm)), cv2.LINE_AA)
        image[: max(1, int(0.12 * height))] = np.clip(np.asarray(base) * 1.25, 0, 255).astype(np.uint8)
        plate = sign(_vivid(rng))(rng, max(4, int(0.35 * height)), max(4, int(0.45 * width)), ppm)
        top, left = int(0.38 * height), int(rng.uniform(0.1, 0.45) * width)
        image[top : top + plate.shape[0], left : left + plate.shape[1]] = plate
        p.chips(rng, image, int(40 * height * width / ppm**2) + 2, (0.006 * ppm, 0.02 * ppm), 0.4)
        return image

    return paint


def door(color: Color) -> Painter:
    """A door with frame, window, handle, number plate and scuffs."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        image = p.plain(color, blotch=0.05)(rng, height, width, ppm)
        rim = int(0.06 * ppm)
        cv2.rectangle(image, (0, 0), (width - 1, height + rim), p.shade(rng, (80, 85, 90), 0.3), rim)
        cv2.rectangle(image, (rim, rim), (width - rim, height), (35, 35, 38), max(1, int(0.008 * ppm)))
        if rng.random() < 0.65:
            low, high = (
                (int(0.25 * width), int(0.15 * height)),
                (int(0.75 * width), int(rng.uniform(0.3, 0.45) * height)),
            )
            cv2.rectangle(image, low, high, p.shade(rng, (120, 105, 85), 0.4), -1)
            cv2.line(image, (low[0], high[1]), (high[0], low[1]), (185, 180, 170), max(1, int(0.02 * ppm)), cv2.LINE_AA)
            cv2.rectangle(image, low, high, (50, 50, 55), max(1, int(0.02 * ppm)))
        plate = sign(_vivid(rng))(rng, max(4, int(0.13 * ppm)), max(4, int(0.4 * ppm)), ppm)
        top, left = int(0.5 * height), int(0.3 * width)
        part = image[top : top + plate.shape[0], left : left + plate.shape[1]]
        part[:] = plate[: part.shape[0], : part.shape[1]]
        handle = (int(0.82 * width), int(0.53 * height)), (int(0.93 * width), int(0.545 * height))
        cv2.rectangle(image, *handle, (200, 205, 208), -1)
        return image

    return Named("door", paint)


def lockers(color: Color) -> Painter:
    """A row of metal lockers or drawers, each with slots, number and some stickers."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        image = p.plain(color)(rng, height, width, ppm)
        count = max(1, round(width / (0.3 * ppm)))
        for index in range(count):
            left, right = index * width // count, (index + 1) * width // count
            tint = rng.uniform(0.8, 1.15)
            image[:, left:right] = cv2.convertScaleAbs(image[:, left:right], alpha=tint)
            cv2.rectangle(image, (left, 0), (right, height), (35, 38, 40), max(1, int(0.012 * ppm)))
            for slot in range(4):
                y = int((0.06 + 0.022 * slot) * height)
                cv2.line(image, (int(left + 0.07 * ppm), y), (int(right - 0.07 * ppm), y), (40, 42, 45), 1)
            p.text(
                image, p.word(rng, 2), int(left + 0.05 * ppm), int(0.3 * height), 0.07 * ppm, (235, 235, 235), 0, 0.12
            )
            if rng.random() < 0.6:
                sticker = poster()(rng, max(6, int(0.14 * ppm)), max(6, int(0.16 * ppm)), ppm)
                top = int(rng.uniform(0.35, 0.75) * height)
                part = image[top : top + sticker.shape[0], left + 6 : min(right - 4, left + 6 + sticker.shape[1])]
                part[:] = sticker[: part.shape[0], : part.shape[1]]
        return image

    return paint


def books() -> Painter:
    """Spines of books or folders on a board, with titles."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        image = np.full((height, width, 3), (28, 30, 34), dtype=np.uint8)
        x = 0.0
        while x < width:
            thick = rng.uniform(0.02, 0.065) * ppm
            top = int(height * rng.uniform(0.02, 0.3))
            color = _vivid(rng)
            left, right = int(x), min(width, int(x + thick))
            image[top:, left:right] = color
            band = int(rng.uniform(0.15, 0.5) * (height - top)) + top
            image[band : band + max(1, int(0.03 * ppm)), left:right] = _contrast(color)
            for row in range(band + int(0.05 * ppm), height - 3, max(2, int(0.016 * ppm))):
                if rng.random() < 0.6 and right - left > 4:
                    image[row : row + max(1, int(0.007 * ppm)), left + 2 : right - 2] = _contrast(color)
            image[top:, max(0, right - 1) : right] = (20, 20, 22)
            x += thick
        return image

    return paint


def window() -> Painter:
    """A window with a bright sky, roofs and bars."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        image = _landscape(rng, height, width)
        bar = max(2, int(0.05 * ppm))
        for x in np.linspace(0, width - 1, max(2, int(width / (0.7 * ppm)) + 1)):
            cv2.line(image, (int(x), 0), (int(x), height), (205, 208, 210), bar)
        for y in (0, height // 2, height - 1):
            cv2.line(image, (0, y), (width, y), (205, 208, 210), bar)
        return image

    return Named("window", paint)


def whiteboard() -> Painter:
    """A whiteboard with words, sketches and magnets."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        image = p.tinted(p.noise(rng, height, width, (0.4 * ppm, 0.08 * ppm), (0.03, 0.02)), (228, 228, 225))
        inks: tuple[Color, ...] = ((160, 60, 30), (40, 40, 190), (60, 120, 30), (40, 40, 40))
        for _ in range(int(9 * height * width / ppm**2) + 3):
            ink = inks[int(rng.integers(0, 4))]
            x, y = rng.uniform((0.05 * width, 0.15 * height), (0.75 * width, 0.9 * height)).astype(int)
            if rng.random() < 0.55:
                cap = ppm * rng.uniform(0.03, 0.09)
                p.text(image, p.word(rng, int(rng.integers(3, 8))), int(x), int(y), cap, ink, 0, 0.1)
                continue
            points = np.array([x, y]) + np.cumsum(rng.normal(0.0, 0.09 * ppm, (7, 2)), axis=0)
            cv2.polylines(
                image, [np.round(points * 16).astype(np.int32)], False, ink, max(1, int(0.008 * ppm)), cv2.LINE_AA, 4
            )
        cv2.rectangle(image, (0, 0), (width - 1, height - 1), (120, 122, 125), max(2, int(0.03 * ppm)))
        return image

    return Named("whiteboard", paint)


def screen() -> Painter:
    """A monitor showing a program: panels, text lines, a plot."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        image = np.full((height, width, 3), (45, 40, 36), dtype=np.uint8)
        line = max(3, int(0.018 * ppm))
        for y in range(2 * line, height - 2 * line, line):
            x = int(0.04 * width + line * rng.integers(0, 4))
            while x < 0.55 * width:
                end = int(x + rng.uniform(0.03, 0.12) * width)
                cv2.line(image, (x, y), (end, y), _vivid(rng), max(1, line // 2))
                x = end + line
        plot = poster()(rng, int(0.7 * height), int(0.36 * width), ppm)
        image[int(0.12 * height) : int(0.12 * height) + plot.shape[0], int(0.6 * width) :][:, : plot.shape[1]] = plot
        cv2.rectangle(image, (0, 0), (width - 1, height - 1), (20, 20, 22), max(2, int(0.02 * ppm)))
        return image

    return paint


def rug(color: Color) -> Painter:
    """A woven rug: border, random lozenges, weave."""

    def paint(rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        image = np.full((height, width, 3), color, dtype=np.uint8)
        for _ in range(int(26 * height * width / ppm**2) + 8):
            centre = rng.uniform((0, 0), (width, height))
            size = ppm * rng.uniform(0.03, 0.14)
            _polygon(image, centre + size * np.array([(1, 0), (0, 0.7), (-1, 0), (0, -0.7)]), _vivid(rng))
        for inset, tone in ((0.0, 0.5), (0.06, 1.5)):
            low, high = int(inset * ppm), (width - 1 - int(inset * ppm), height - 1 - int(inset * ppm))
            border = tuple(min(255.0, tone * c) for c in color)
            cv2.rectangle(image, (low, low), high, border, max(2, int(0.04 * ppm)))
        grey = p.noise(rng, height, width, (0.5 * ppm, 2.0, 1.0), (0.06, 0.05, 0.06))
        return cv2.multiply(image, cv2.merge([grey, grey, grey]), dtype=cv2.CV_8UC3)

    return paint
