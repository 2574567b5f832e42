"""Drawings of the report as SVG: the rig from above and from the side, series over the frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from matplotlib.ticker import MaxNLocator

from gsgan.check.rig import ground_axes
from gsgan.check.silhouette import Float
from gsgan.check.subject import Subject

COLOURS = (
    "#1f77b4", "#d95f02", "#1b9e77", "#c2255c", "#7b5ea7", "#8a6d1d", "#4aa3c7", "#5b8c2a",
)  # fmt: skip
INK, FAINT, BAD = "#222", "#dcdcdc", "#e03131"
PANEL, EDGE = 440, 64  # pixels of a rig panel and its margin, which holds the names
CHART_WIDTH, CHART_HEIGHT = 900, 150
NAMES = 12  # cameras that are named in the panel seen from the side, where they crowd
LEGEND = 7  # names that fit beside a chart; the lines of all are drawn


def rig_drawing(subject: Subject) -> str:
    """Cameras, viewing directions and the person's way: from above, and from the side."""
    first, second = ground_axes(subject.up)
    centres = np.stack([camera.centre for camera in subject.cameras.values()])
    scale, middle = _fit(np.concatenate([centres, subject.p[subject.visible]]), first, second)
    above = _panel(subject, first, second, scale, middle, "seen from above")
    side = _panel(subject, first, subject.up, scale, middle, "seen from the side")
    width, height = 2 * PANEL, PANEL
    return (
        f'<svg viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        f'xmlns="http://www.w3.org/2000/svg" font-family="sans-serif" font-size="12">'
        f'<g>{above}</g><g transform="translate({PANEL} 0)">{side}</g></svg>'
    )


def _fit(points: Float, first: Float, second: Float) -> tuple[float, Float]:
    """Pixels a metre that suit both panels, and the world point in the middle of them."""
    up = np.cross(first, second)
    middle = (points.min(0) + points.max(0)) / 2
    spans = [np.ptp(points @ axis) for axis in (first, second, up)]
    return (PANEL - 2 * EDGE) / max(*spans, 0.5), middle


def _panel(
    subject: Subject, right: Float, up: Float, scale: float, middle: Float, title: str
) -> str:
    def at(points: Float) -> Float:
        flat = np.stack([(points - middle) @ right, -((points - middle) @ up)], -1)
        return flat * scale + PANEL / 2

    parts = [
        f'<rect width="{PANEL}" height="{PANEL}" fill="#fff"/>',
        _grid(scale, middle, right, up),
    ]
    track = subject.p[:, list(subject.template.hips)].mean(1)
    parts.append(_line(at(track), "#888", 1.5))
    row = len(subject.frames) // 2
    for a, b in subject.template.edges:
        if subject.visible[row, [a, b]].all():
            parts.append(_line(at(subject.p[row, [a, b]]), INK, 1.2))
    labels: list[Float] = []
    for i, (name, camera) in enumerate(subject.cameras.items()):
        colour = COLOURS[i % len(COLOURS)]
        height, width = camera.size
        reach = 0.12 * PANEL / scale
        corners = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], float)
        rays = corners @ np.linalg.inv(camera.K).T * reach
        ends = at(camera.centre + rays @ camera.R)
        eye, aim = at(camera.centre), at(camera.centre + 2.2 * reach * camera.R[2])
        for end in ends:
            parts.append(_line(np.stack([eye, end]), colour, 1))
        parts.append(_line(np.concatenate([ends, ends[:1]]), colour, 1))
        parts.append(_line(np.stack([eye, aim]), colour, 1, dash="3 3"))
        parts.append(f'<circle cx="{eye[0]:.1f}" cy="{eye[1]:.1f}" r="3.5" fill="{colour}"/>')
        if up is not subject.up or len(subject.cameras) <= NAMES:
            parts.append(_label(name, eye, colour, labels))
    parts.append(f'<text x="8" y="16" fill="{INK}" font-weight="bold">{escape(title)}</text>')
    parts.append(
        f'<text x="8" y="{PANEL - 8}" fill="#777">grid 1 m; right {_axis(right)}, up {_axis(up)}; '
        "grey: the person's way</text>"
    )
    return "".join(parts)


def _axis(direction: Float) -> str:
    axis = int(np.argmax(np.abs(direction)))
    return ("−" if direction[axis] < 0 else "+") + "xyz"[axis]


def _grid(scale: float, middle: Float, right: Float, up: Float) -> str:
    """Lines at whole metres of the world; none where they would merge."""
    if scale < 4:
        return ""
    half = PANEL / 2 / scale
    lines = []
    for direction, vertical in ((right, True), (up, False)):
        centre = float(middle @ direction)
        for metre in range(int(np.ceil(centre - half)), int(np.floor(centre + half)) + 1):
            k = PANEL / 2 + (metre - centre) * scale * (1 if vertical else -1)
            ends = [[k, 0], [k, PANEL]] if vertical else [[0, k], [PANEL, k]]
            lines.append(_line(np.array(ends), FAINT, 1))
    return "".join(lines)


def _line(points: Float, colour: str, width: float, dash: str = "") -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in np.clip(np.nan_to_num(points), -1e5, 1e5))
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    return (
        f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="{width}"{dashed}/>'
    )


def _label(name: str, eye: Float, colour: str, placed: list[Float]) -> str:
    """A camera's name on the outer side of its eye and clear of those placed, which it joins."""
    away = eye - PANEL / 2
    away = away / max(float(np.linalg.norm(away)), 1e-9)
    x, y = eye + away * (26, 16) + (0, 4)
    while any(abs(x - other[0]) < 44 and abs(y - other[1]) < 13 for other in placed):
        y += 4 if away[1] > 0 else -4
    x = float(np.clip(x, 22, PANEL - 22))
    placed.append(np.array([x, y]))
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="middle" fill="{colour}" '
        f'font-weight="bold">{escape(name)}</text>'
    )


def series_chart(
    title: str,
    frames: Sequence[int],
    series: Mapping[str, tuple[Sequence[int], Sequence[float]]],
    *,
    limit: float | None = None,
    doubtful: frozenset[int] = frozenset(),
    least: float | None = None,
    most: float | None = None,
) -> str:
    """Values over frames, a line each.

    Args:
        title: what is drawn, with its unit.
        frames: first to last of the capture.
        series: (frame numbers, values) by name; NaN breaks a line.
        limit: drawn as a dashed red line.
        doubtful: frames marked in red at the foot.
        least, most: ends of the scale where the values do not go beyond.
    """
    values = np.array([v for _, held in series.values() for v in held], float)
    values = values[np.isfinite(values)]
    ends = [e for e in (least, most, limit) if e is not None]
    low = min([*ends, *values.tolist()], default=0.0)
    high = max([*ends, *values.tolist()], default=1.0)
    high = high if high > low else low + 1
    left, right, top, bottom = 52, CHART_WIDTH - 110, 24, CHART_HEIGHT - 24
    first, last = min(frames), max(max(frames), min(frames) + 1)

    def at(frame: float, value: float) -> tuple[float, float]:
        x = left + (frame - first) / (last - first) * (right - left)
        return x, bottom - (value - low) / (high - low) * (bottom - top)

    parts = [
        f'<rect width="{CHART_WIDTH}" height="{CHART_HEIGHT}" fill="#fff"/>',
        f'<text x="{left}" y="15" fill="{INK}" font-weight="bold">{escape(title)}</text>',
    ]
    for value in _round_values(low, high):
        _, y = at(first, float(value))
        parts.append(_line(np.array([[left, y], [right, y]]), FAINT, 1))
        parts.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{value:.3g}</text>')
    for frame in (first, (first + last) // 2, last):
        x, _ = at(frame, low)
        parts.append(
            f'<text x="{x:.1f}" y="{CHART_HEIGHT - 6}" text-anchor="middle">{frame}</text>'
        )
    for frame in doubtful:
        x, _ = at(frame, low)
        parts.append(_line(np.array([[x, bottom], [x, bottom - 9]]), BAD, 2))
    if limit is not None:
        y = at(first, limit)[1]
        parts.append(_line(np.array([[left, y], [right, y]]), BAD, 1, dash="5 4"))
    for i, (name, (at_frames, held)) in enumerate(series.items()):
        colour = COLOURS[i % len(COLOURS)]
        for piece in _pieces(at_frames, held):
            parts.append(_line(np.array([at(f, v) for f, v in piece]), colour, 1.5))
        if i < LEGEND:
            y = top + 6 + 15 * i
            parts.append(f'<text x="{right + 10}" y="{y}" fill="{colour}">{escape(name)}</text>')
    return (
        f'<svg viewBox="0 0 {CHART_WIDTH} {CHART_HEIGHT}" width="{CHART_WIDTH}" '
        f'height="{CHART_HEIGHT}" xmlns="http://www.w3.org/2000/svg" font-family="sans-serif" '
        f'font-size="11">{"".join(parts)}</svg>'
    )


def _round_values(low: float, high: float) -> list[float]:
    """Two to five round numbers between two others."""
    found = MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(low, high)
    return [float(v) for v in found if low - 1e-9 <= v <= high + 1e-9]


def _pieces(frames: Sequence[int], values: Sequence[float]) -> list[list[tuple[float, float]]]:
    """Runs of finite values; a single one is given some width, so that it is seen."""
    pieces: list[list[tuple[float, float]]] = [[]]
    for frame, value in zip(frames, values, strict=True):
        if np.isfinite(value):
            pieces[-1].append((frame, float(value)))
        elif pieces[-1]:
            pieces.append([])
    kept = [piece for piece in pieces if piece]
    return [p if len(p) > 1 else [(p[0][0] - 0.3, p[0][1]), (p[0][0] + 0.3, p[0][1])] for p in kept]
