"""Mesh files that are read here, because the viewer shows them differently than PyBullet."""

import numpy as np
import pytest
from PIL import Image

from rlctl.replaying.meshes import load_mesh

COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><unit meter="0.01"/><up_axis>{up}</up_axis></asset>
  <library_geometries><geometry id="g"><mesh>
    <source id="p"><float_array count="12">0 0 0  1 0 0  1 1 0  0 1 0</float_array></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    <polylist count="1"><input semantic="VERTEX" source="#v" offset="0"/>
      <input semantic="NORMAL" source="#n" offset="1"/>
      <vcount>4</vcount><p>0 0 1 0 2 0 3 0</p></polylist>
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="s">
    <node><translate>0 0 5</translate>
      <node><rotate>0 0 1 90</rotate><scale>2 2 2</scale><instance_geometry url="#g"/></node>
    </node>
  </visual_scene></library_visual_scenes>
</COLLADA>"""


@pytest.mark.parametrize(("up", "corner"), [("Z_UP", (-0.02, 0.02, 0.05)), ("Y_UP", (-0.02, -0.05, 0.02))])
def test_collada_files_are_placed_by_their_nodes(tmp_path, up, corner):
    (tmp_path / "square.dae").write_text(COLLADA.format(up=up))
    mesh = load_mesh(tmp_path / "square.dae")
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    # (1, 1, 0): twice as large, a quarter turn about z, 5 upwards, in centimetres; y upwards: (x, y, z) is (x, -z, y).
    np.testing.assert_allclose(mesh.vertices[2], corner, atol=1e-12)


def test_textures_of_obj_files(tmp_path):
    Image.new("RGB", (2, 2), "red").save(tmp_path / "paint.png")
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd paint.png\n")
    faces = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3 -1/1\n"
    (tmp_path / "m.obj").write_text(f"mtllib m.mtl\n{faces}")
    mesh = load_mesh(tmp_path / "m.obj")
    assert mesh.texture == tmp_path / "paint.png"
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.uvs.tolist() == [[0, 1], [1, 1], [1, 0], [0, 1]]  # from the upper edge
    (tmp_path / "plain.obj").write_text(faces)
    assert load_mesh(tmp_path / "plain.obj") is None


@pytest.mark.parametrize("name", ["m.dae", "m.obj"])
def test_damaged_files_are_left_to_the_viewer(tmp_path, name):
    Image.new("RGB", (2, 2), "red").save(tmp_path / "paint.png")
    (tmp_path / "m.mtl").write_text("map_Kd paint.png\n")
    (tmp_path / name).write_text("mtllib m.mtl\nv 0 0 0\nvt 0 0\nf 1/1 7/9 a/b\n<COLLADA/>")
    assert load_mesh(tmp_path / name) is None
