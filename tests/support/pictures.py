"""The functions of ``plotting``, each call on a figure of its own where no axes are given."""

import numpy as np
from matplotlib import pyplot
from matplotlib.path import Path

from hjbjax import plotting


class OnNewFigures:
    """``plotting`` whose pictures do not meet: without axes a picture goes on pyplot's current ones."""

    def __getattr__(self, name):
        member = getattr(plotting, name)
        if not callable(member) or isinstance(member, type):
            return member

        def draw(*arguments, **options):
            pyplot.close("all")  # the figures live on as long as a test holds them
            return member(*arguments, **options)

        return draw


pictures = OnNewFigures()


def hatched_nodes(artists, grid):
    """The nodes that lie under a hatch, bool (*grid)."""
    middle = (np.asarray(grid.lo) + np.asarray(grid.hi)) / 2
    nodes = middle + (grid.nodes() - middle) * (1 - 1e-6)  # a node on the edge of the box lies on that of its hatch
    areas = [artist for artist in artists if getattr(artist, "hatches", None) and any(artist.hatches)]
    covered = np.zeros(grid.shape, bool)
    for area in areas:
        covered |= covers(area, nodes.reshape(-1, 2)).reshape(grid.shape)
    return covered


def covers(area, points):
    """True for the points, (k, 2), that lie in a filled contour: within an odd number of its rings."""
    rings = [Path(ring) for path in area.get_paths() for ring in path.to_polygons()]
    return sum((ring.contains_points(points).astype(int) for ring in rings), np.zeros(len(points), int)) % 2 == 1


def scale_label(mesh):
    """The text above the colour scale of a mesh, in one line."""
    (text,) = [text for text in mesh.colorbar.ax.texts if text.get_gid() == "label"]
    assert text.get_rotation() == 0
    return text.get_text().replace("\n", " ")


def texts(figure):
    """The texts that a figure shows and their boxes in points; tick labels outside of the axes are not shown."""
    figure.canvas.draw()
    shown = []
    for ax in figure.axes:
        for axis in (ax.xaxis, ax.yaxis):
            lo, hi = sorted(axis.get_view_interval())
            slack = 1e-9 * (hi - lo)
            shown += [tick.label1 for tick in axis.get_major_ticks() if lo - slack <= tick.get_loc() <= hi + slack]
            shown.append(axis.label)
        shown += [ax.title, ax._left_title, ax._right_title, *ax.texts]
        shown += ax.get_legend().get_texts() if ax.get_legend() else []
    points = 72 / figure.dpi
    boxes = [(text.get_text(), text.get_window_extent()) for text in shown if text.get_text() and text.get_visible()]
    return [(text, np.array([[box.x0, box.y0], [box.x1, box.y1]]) * points) for text, box in boxes]


def clearance(first, second):
    """The distance of two boxes along the axis on which they are farther apart; negative if they overlap."""
    return float(max(np.max(first[0] - second[1]), np.max(second[0] - first[1])))
