"""Plots of the report as SVG: the cameras from above and from the side, series over the frames."""

from __future__ import annotations

import io
from collections.abc import Sequence, Set

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gsgan.check.frames import Motion
from gsgan.check.rig import axis_name, ground_axes
from gsgan.check.settings import Limits
from gsgan.check.views import Subject, View, grouped
from gsgan.data.formats.trust import Float
from gsgan.utils.palette import BLACK, COLOURS, GREY, VERMILLION

NAMES = 12  # cameras that are named seen from the side, where they crowd
LEGEND = 8  # cameras that are named beside the charts; all are drawn


def rig_drawing(subject: Subject) -> bytes:
    """Cameras, viewing directions and the person's path, from above and from the side."""
    figure = Figure((9, 4.5), layout="tight")
    first, second = ground_axes(subject.up)
    titles = {"seen from above": second, "seen from the side": subject.up}
    for axes, (title, up) in zip(figure.subplots(1, 2), titles.items(), strict=True):
        named = up is second or len(subject.cameras) <= NAMES
        _panel(axes, subject, np.stack([first, up]), named)
        axes.set(title=title, xlabel=f"{axis_name(first)} (m)", ylabel=f"{axis_name(up)} (m)")
    return _svg(figure)


def _panel(axes: Axes, subject: Subject, plane: Float, named: bool) -> None:
    """Draws onto the plane ``[2, 3]``: right, up."""
    axes.plot(*plane @ subject.p[:, list(subject.template.hips)].mean(1).T, color=GREY)
    row = len(subject.frames) // 2
    for edge in map(list, subject.template.edges):
        if subject.visible[row, edge].all():
            axes.plot(*plane @ subject.p[row, edge].T, color=BLACK, linewidth=1)
    centres = np.stack([camera.centre for camera in subject.cameras.values()])
    reach = 0.1 * max(1.0, float(np.ptp(centres, axis=0).max()))  # metres
    for i, (name, camera) in enumerate(subject.cameras.items()):
        colour, (height, width) = COLOURS[i % len(COLOURS)], camera.size
        corners = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], float)
        ends = camera.centre + reach * corners @ np.linalg.inv(camera.K).T @ camera.R
        for line in (ends[[0, 1, 2, 3, 0]], *(np.stack([camera.centre, end]) for end in ends)):
            axes.plot(*plane @ line.T, color=colour, linewidth=0.8)
        aim = np.stack([camera.centre, camera.centre + 2.2 * reach * camera.R[2]])
        axes.plot(*plane @ aim.T, color=colour, linewidth=0.8, linestyle=":")
        if named:
            axes.annotate(
                name, tuple(plane @ camera.centre), (4, 4), textcoords="offset points", color=colour
            )
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)


def series_chart(
    subject: Subject, views: Sequence[View], motion: Motion, limits: Limits, doubtful: Set[int]
) -> bytes:
    """Four charts over the frames, with a tick at the bottom for each doubtful frame."""
    figure = Figure((10, 6.8), layout="tight")
    inside, area, jump, seen = every = figure.subplots(4, sharex=True)
    for i, (name, own) in enumerate(grouped(views).items()):
        own = sorted(own, key=lambda view: view.frame)
        frames, colour = [view.frame for view in own], COLOURS[i % len(COLOURS)]
        label = name if i < LEGEND else None
        inside.plot(frames, [view.inside for view in own], ".-", c=colour, label=label)
        area.plot(frames, [view.fullness for view in own], ".-", c=colour)
    jump.plot(subject.frames, np.nan_to_num(motion.jump).max(1), ".-")
    seen.plot(subject.frames, motion.seen, ".-")
    charts: dict[str, float | None] = {
        "share of joints inside the mask": 1 - limits.frame_outside,
        "area of the mask over that of the estimated silhouette": None,
        "largest jump of a joint, m": limits.joint_jump,
        "share of joints seen": limits.seen_share,
    }
    for axes, (title, limit) in zip(every, charts.items(), strict=True):
        if limit is not None:
            axes.axhline(limit, color=VERMILLION, linestyle="--", linewidth=1)
        foot = axes.get_xaxis_transform()
        axes.plot(sorted(doubtful), [0] * len(doubtful), "|", color=VERMILLION, transform=foot)
        axes.set_title(title, loc="left", fontsize="medium")
        axes.grid(alpha=0.3)
    if views:
        inside.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize="small")
    return _svg(figure)


def _svg(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="svg")
    return stream.getvalue()
