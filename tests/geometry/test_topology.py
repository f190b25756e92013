"""Neighbourhoods of a triangle mesh."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import shortest_path

from faceanim.geometry import topology
from faceanim.geometry.shapes import sheet, sphere
from faceanim.ground.errors import UserError


def test_a_closed_surface_obeys_euler() -> None:
    """V - E + F = 2 on a sphere."""
    ball = sphere(10.0, 2)
    assert len(ball.points) - len(topology.edges(ball.triangles)) + len(ball.triangles) == 2


def test_the_edge_of_a_corner_is_the_one_without_it() -> None:
    """Edge and corner together are the triangle."""
    t = sheet(4, 3, 8.0, 6.0).triangles
    edges, index = topology.edge_of_corner(t)
    for k in range(3):
        joined = np.sort(np.concatenate([edges[index[:, k]], t[:, k : k + 1]], axis=1), axis=1)
        assert (joined == np.sort(t, axis=1)).all()


def test_the_triangles_of_a_vertex_hold_it() -> None:
    """Each (triangle, corner) is listed once, under its vertex."""
    mesh = sheet(4, 3, 8.0, 6.0)
    lists = topology.vertex_triangles(mesh.triangles, len(mesh.points))
    for i in range(len(mesh.points)):
        assert (mesh.triangles[lists.of(i)] == i).any(axis=1).all()
    assert len(lists.item) == 3 * len(mesh.triangles)


def test_waves_are_graph_distances() -> None:
    """Breadth-first waves equal Dijkstra's distances with unit edges."""
    mesh = sheet(10, 7, 20.0, 14.0)
    n = len(mesh.points)
    e = topology.edges(mesh.triangles)
    seed = np.zeros(n, dtype=bool)
    seed[[3, 60]] = True
    graph = coo_matrix((np.ones(len(e)), (e[:, 0], e[:, 1])), shape=(n, n))
    expected = shortest_path(graph, directed=False, unweighted=True, indices=[3, 60]).min(axis=0)
    assert (topology.waves(topology.neighbours(mesh.triangles, n), seed) == expected).all()


def test_waves_stay_where_they_are_allowed() -> None:
    """A forbidden column of vertices stops the waves."""
    mesh = sheet(10, 7, 20.0, 14.0)
    n = len(mesh.points)
    left = mesh.points[:, 0] < -0.1
    seed = np.zeros(n, dtype=bool)
    seed[0] = True
    wave = topology.waves(topology.neighbours(mesh.triangles, n), seed, left)
    assert ((wave >= 0) == left).all()


def test_a_seed_of_the_wrong_size_is_rejected() -> None:
    """The seed has one entry per vertex."""
    with pytest.raises(UserError, match="seed has shape"):
        topology.waves(topology.neighbours(sheet(2, 2, 2.0, 2.0).triangles, 9), np.zeros(3, dtype=bool))


def test_no_edge_joins_one_colour() -> None:
    """Neighbours have different colours, and few colours suffice."""
    mesh = sphere(5.0, 2)
    colour = topology.colours(topology.neighbours(mesh.triangles, len(mesh.points)))
    e = topology.edges(mesh.triangles)
    assert (colour[e[:, 0]] != colour[e[:, 1]]).all()
    assert colour.min() == 0 and colour.max() < 8
