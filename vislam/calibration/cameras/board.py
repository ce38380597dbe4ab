"""Calibration boards: drawn to be printed, and found in images."""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, BinaryIO, Literal

import cv2
import numpy as np
from PIL import Image

from vislam.calibration.options import BoardFile, BoardOptions
from vislam.calibration.outcome import Folder, Outcome
from vislam.core.errors import UsageError
from vislam.core.messages import Array, ImageU8

BoardKind = Literal["charuco", "chessboard"]

_PAPERS_M = {"a4": (0.297, 0.210), "a3": (0.420, 0.297), "a2": (0.594, 0.420), "letter": (0.2794, 0.2159)}
_DPI = 300
_INCH_M = 0.0254
_MIN_POINTS = 8  # of a board that is partly seen: six for its pose, and a little to check it
_SPREAD = 0.15  # of points on the board, in its shorter side: on one line they give no pose


@dataclass(frozen=True, slots=True)
class View:
    """A board in an image: its points [N, 3] in metres and where they are seen [N, 2]."""

    name: str
    points_m: Array
    pixels: Array


@dataclass(frozen=True)
class Board:
    """A flat pattern of `columns` x `rows` squares; raises UsageError when there is no such board."""

    kind: BoardKind
    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3 or not 0.0 < self.square_m < 10.0:
            raise UsageError(
                f"a board of {self.columns} x {self.rows} squares of {self.square_m} m; use 3 x 3 at least, and metres"
            )
        if self.kind == "chessboard":
            return
        if not 0.0 < self.marker_m < self.square_m:
            raise UsageError(f"markers of {self.marker_m} m must fit into squares of {self.square_m} m")
        if not hasattr(cv2.aruco, f"DICT_{self.dictionary}"):
            raise UsageError(
                f"no dictionary '{self.dictionary}'; there are 4X4_50, 5X5_100, 6X6_250, APRILTAG_36h11, ..."
            )
        markers = self.columns * self.rows // 2
        if markers > len(self._markers.bytesList):
            raise UsageError(f"{markers} markers are needed, {self.dictionary} has {len(self._markers.bytesList)}")

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height."""
        return self.columns * self.square_m, self.rows * self.square_m

    def draw(self, px_per_m: float) -> ImageU8:
        """Return the board without a margin."""
        width, height = (round(side * px_per_m) for side in self.size_m)
        if self.kind == "charuco":
            return np.asarray(self._charuco.generateImage((width, height)), dtype=np.uint8)
        column = (np.arange(width) * self.columns // width)[None]
        row = (np.arange(height) * self.rows // height)[:, None]
        return np.asarray(255 * ((column + row) % 2), dtype=np.uint8)

    def find(self, image: ImageU8, name: str) -> View | None:
        """Return the board's points in a grey image [H, W], None where too few of them are seen for its pose."""
        points, pixels = self._charuco_points(image) if self.kind == "charuco" else self._chessboard_points(image)
        if len(points) < _MIN_POINTS:
            return None
        spread = np.linalg.svd(points[:, :2] - points[:, :2].mean(axis=0), compute_uv=False)[1] / np.sqrt(len(points))
        if spread < _SPREAD * min(self.size_m) / 2.0:
            return None
        return View(name, points, pixels)

    def _charuco_points(self, image: ImageU8) -> tuple[Array, Array]:
        corners, ids, _, _ = self._detector.detectBoard(image)
        if ids is None or len(ids) == 0:
            return np.empty((0, 3)), np.empty((0, 2))
        places = np.asarray(self._charuco.getChessboardCorners(), dtype=np.float64)
        return places[np.ravel(ids)], np.asarray(corners, dtype=np.float64).reshape(-1, 2)

    def _chessboard_points(self, image: ImageU8) -> tuple[Array, Array]:
        inner = (self.columns - 1, self.rows - 1)
        found, corners = cv2.findChessboardCornersSB(image, inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found:
            return np.empty((0, 3)), np.empty((0, 2))
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        places = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]).astype(np.float64) * self.square_m
        return places, np.asarray(corners, dtype=np.float64).reshape(-1, 2)

    @cached_property
    def _markers(self) -> Any:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))

    @cached_property
    def _charuco(self) -> Any:
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, self._markers)

    @cached_property
    def _detector(self) -> Any:
        return cv2.aruco.CharucoDetector(self._charuco)


def board_of(options: BoardOptions) -> Board:
    """Return the board that the options describe."""
    marker = options.square_mm * options.marker_share * 1e-3
    return Board(options.kind, options.columns, options.rows, options.square_mm * 1e-3, marker, options.dictionary)


def print_board(options: BoardFile) -> Outcome:
    """Write a board as PNG and PDF in its true size, centred on the smallest paper that holds it."""
    board = board_of(options.board)
    width_m, height_m = board.size_m
    fitting = [name for name, (w, h) in _PAPERS_M.items() if width_m <= w and height_m <= h]
    if options.paper is not None and options.paper not in fitting:
        w, h = (1e3 * side for side in _PAPERS_M[options.paper])
        raise UsageError(
            f"the board is {1e3 * width_m:.0f} x {1e3 * height_m:.0f} mm, {options.paper} is {w:.0f} x {h:.0f}; "
            "take smaller or fewer squares, or another --paper"
        )
    if not fitting:
        raise UsageError(f"no paper holds {1e3 * width_m:.0f} x {1e3 * height_m:.0f} mm; take smaller or fewer squares")
    paper = options.paper or fitting[0]
    folder = Folder(options.out, ("board.png", "board.pdf", "board.json"), options.overwrite)
    page = _page(board, _PAPERS_M[paper])
    for name in ("board.png", "board.pdf"):
        folder.write_with(name, partial(_save, page, name))
    report = {
        "kind": "board", "pattern": board.kind, "columns": board.columns, "rows": board.rows,
        "square_m": board.square_m, "marker_m": board.marker_m, "dictionary": board.dictionary, "paper": paper,
    }  # fmt: skip
    folder.write_report("board.json", report)
    lines = (
        f"{board.columns} x {board.rows} squares of {options.board.square_mm:g} mm on {paper}; print at 100 %, glue it "
        "on something flat, and measure ten squares with a ruler: the scale of lengths hangs on it",
        "next: vislam calibrate camera IMAGES, with the same board options",
    )
    return Outcome(report, lines, tuple(folder.files))


def _page(board: Board, paper_m: tuple[float, float]) -> ImageU8:
    px_per_m = _DPI / _INCH_M
    page: ImageU8 = np.full((round(paper_m[1] * px_per_m), round(paper_m[0] * px_per_m)), 255, dtype=np.uint8)
    drawn = board.draw(px_per_m)
    top, left = (page.shape[0] - drawn.shape[0]) // 2, (page.shape[1] - drawn.shape[1]) // 2
    page[top : top + drawn.shape[0], left : left + drawn.shape[1]] = drawn
    return page


def _save(page: ImageU8, name: str, file: BinaryIO) -> None:
    image = Image.fromarray(page)
    if name.endswith(".png"):
        image.save(file, "png", dpi=(_DPI, _DPI))
        return
    dates = {"creationDate": None, "modDate": None}  # same board, same bytes
    image.save(file, "pdf", title="board", resolution=float(_DPI), **dates)
