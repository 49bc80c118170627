"""A tetrahedron of 1 m as mesh files; its corners are the origin and the ends of the axes."""

import struct

POINTS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))

COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><unit meter="{unit}"/><up_axis>{up}</up_axis></asset>
  <library_geometries><geometry id="g"><mesh>
    <source id="p"><float_array id="f" count="12">0 0 0  1 0 0  0 1 0  0 0 1</float_array>
      <technique_common><accessor source="#f" count="4" stride="3"/></technique_common></source>
    <source id="n"><float_array id="m" count="3">0 0 1</float_array>
      <technique_common><accessor source="#m" count="1" stride="3"/></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    <{kind} count="4"><input semantic="VERTEX" source="#v" offset="0"/>
      <input semantic="NORMAL" source="#n" offset="1"/>{faces}</{kind}>
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="s">{nodes}</visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#s"/></scene>
</COLLADA>"""
NODE = '<node><instance_geometry url="#g"/></node>'


def write_stl(file):
    rows = (struct.pack("<12fH", 0, 0, 0, *(value for corner in face for value in POINTS[corner]), 0) for face in FACES)
    file.write_bytes(bytes(80) + struct.pack("<I", len(FACES)) + b"".join(rows))


def write_stl_text(file):
    corners = ("".join(f"vertex {x} {y} {z}\n" for x, y, z in (POINTS[corner] for corner in face)) for face in FACES)
    facets = (f"facet normal 0 0 0\nouter loop\n{facet}endloop\nendfacet\n" for facet in corners)
    file.write_text(f"solid t\n{''.join(facets)}endsolid t\n")


def write_obj(file):
    points = "".join(f"v {x} {y} {z}\n" for x, y, z in POINTS)
    file.write_text(points + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in FACES))


def write_collada(file, *, kind="triangles", unit=1, up="Z_UP", nodes=NODE):
    lists = [" ".join(f"{corner} 0" for corner in face) for face in FACES]
    faces = "".join(f"<p>{numbers}</p>" for numbers in lists) if kind == "polygons" else f"<p>{' '.join(lists)}</p>"
    counts = "<vcount>3 3 3 3</vcount>" if kind == "polylist" else ""
    file.write_text(COLLADA.format(unit=unit, up=up, kind=kind, nodes=nodes, faces=counts + faces))


WRITERS = {"a.stl": write_stl, "text.stl": write_stl_text, "a.obj": write_obj, "a.dae": write_collada}
