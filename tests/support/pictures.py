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
