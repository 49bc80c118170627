"""Mesh files that MuJoCo does not read are converted for it."""

import numpy as np
import pytest

from rlctl.task.meshes import convert_mesh, count_vertices, read_collada
from tests.task import mesh_files


@pytest.mark.parametrize("kind", ["triangles", "polylist", "polygons"])
def test_collada(tmp_path, kind):
    mesh_files.write_collada(tmp_path / "a.dae", kind=kind)
    points, triangles = read_collada(tmp_path / "a.dae")
    assert points.tolist() == [list(map(float, point)) for point in mesh_files.POINTS]
    assert triangles.tolist() == [list(face) for face in mesh_files.FACES]


@pytest.mark.parametrize(("up", "corner"), [("Z_UP", (0.0, 0.02, 0.05)), ("Y_UP", (0.0, -0.05, 0.02))])
def test_collada_is_placed_by_its_nodes(tmp_path, up, corner):
    turned = f"<node><rotate>0 0 1 90</rotate><scale>2 2 2</scale>{mesh_files.NODE}</node>"
    nodes = f"<node><translate>0 0 5</translate>{turned}</node>"
    mesh_files.write_collada(tmp_path / "a.dae", unit=0.01, up=up, nodes=nodes)
    # (1, 0, 0): twice as large, a quarter turn about z, 5 upwards, in centimetres; y upwards: (x, y, z) is (x, -z, y).
    np.testing.assert_allclose(read_collada(tmp_path / "a.dae")[0][1], corner, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "converted"), [("a.stl", False), ("text.stl", True), ("a.obj", False), ("a.dae", True)]
)
def test_what_is_converted(tmp_path, name, converted):
    mesh_files.WRITERS[name](tmp_path / name)
    content = convert_mesh(tmp_path / name)
    # MSH: 4 numbers, 4 points of 3 floats, 4 triangles of 3 numbers, each of 4 bytes.
    assert (content is not None and len(content) == 16 + 48 + 48) == converted
    assert count_vertices(tmp_path / name) == 4


@pytest.mark.parametrize("name", ["a.dae", "a.stl"])
def test_damaged_files(tmp_path, name):
    (tmp_path / name).write_text("<COLLADA/>")
    with pytest.raises(ValueError, match=name):
        convert_mesh(tmp_path / name)
