"""Labels of points in a chart, put where they cover least."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox

SIZE = 7.5  # points
GAP = 7.0  # pixels from a point to its label
MARKER = 5.0  # pixels round a point that no label should cover
# Where a label may go, as shares of its width and height from the point: above, below, right, left,
# corners, then further off. Sideways places come later: there the whiskers are.
PLACES = (
    (-0.5, 0.0), (-0.5, -1.0), (0.0, 0.0), (0.0, -1.0), (-1.0, 0.0), (-1.0, -1.0), (0.0, -0.5),
    (-1.0, -0.5), (-0.5, 1.0), (-0.5, -2.0), (0.0, 1.0), (0.0, -2.0), (-1.0, 1.0), (-1.0, -2.0),
)  # fmt: skip


def put_labels(
    axes: Axes, x: Sequence[float], y: Sequence[float], texts: Sequence[str], colours: Sequence[str]
) -> None:
    """Writes a label beside each point; the layout is fixed by this call.

    Each label in turn takes the place where it covers the least of points, of labels put before,
    and of what is outside the axes.
    """
    figure = axes.figure
    canvas = FigureCanvasAgg(figure)  # type: ignore[arg-type]
    canvas.draw()
    figure.set_layout_engine("none")  # type: ignore[union-attr]
    renderer = canvas.get_renderer()
    frame = axes.get_window_extent(renderer)
    places = axes.transData.transform(list(zip(x, y, strict=True)))
    taken = [_box(px - MARKER, py - MARKER, 2 * MARKER, 2 * MARKER) for px, py in places]
    for (px, py), text, colour in zip(places, texts, colours, strict=True):
        label = axes.annotate(
            text, (px, py), xycoords="figure pixels", fontsize=SIZE, color=colour, va="bottom",
            annotation_clip=False, path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )  # fmt: skip
        extent = label.get_window_extent(renderer)
        boxes = [_beside(px, py, extent.width, extent.height, *place) for place in PLACES]
        costs = [_cost(box, taken, frame) + 0.01 * k for k, box in enumerate(boxes)]
        best = boxes[costs.index(min(costs))]
        label.set_position((best.x0, best.y0))
        taken.append(best)


def _beside(px: float, py: float, width: float, height: float, dx: float, dy: float) -> Bbox:
    shift_x = GAP * (1 if dx == 0 else -1 if dx == -1 else 0)
    shift_y = GAP * (0 if dy == -0.5 else 1 if dy >= 0 else -1)
    return _box(px + shift_x + dx * width, py + shift_y + dy * height, width, height)


def _box(x: float, y: float, width: float, height: float) -> Bbox:
    return Bbox.from_bounds(x, y, width, height)


def _cost(box: Bbox, taken: Sequence[Bbox], frame: Bbox) -> float:
    """Square pixels covered; what is outside the axes counts ten times."""
    covered = sum(_area(Bbox.intersection(box, other)) for other in taken)
    return covered + 10 * (_area(box) - _area(Bbox.intersection(box, frame)))


def _area(box: Bbox | None) -> float:
    return 0.0 if box is None else float(box.width * box.height)
