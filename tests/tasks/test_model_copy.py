"""Which files of a model are copied into a starter plugin."""

from pathlib import Path

import pytest

from rlctl.errors import UsageError
from rlctl.tasks.model_copy import copy_model
from tests.task import mesh_files

URDF = """<?xml version="1.0"{encoding}?><robot name="r"><link name="a"><visual><geometry><mesh filename={name}/>
</geometry></visual></link><gazebo><plugin filename="secret.txt"/></gazebo></robot>"""


def write(folder: Path, name: str, encoding: str = "utf-8", declared: str = "") -> Path:
    file = folder / "arm.urdf"
    folder.mkdir(parents=True, exist_ok=True)
    declaration = f' encoding="{declared}"' if declared else ""
    file.write_bytes(URDF.format(name=name, encoding=declaration).encode(encoding))
    return file


@pytest.mark.parametrize(
    ("written", "name"),
    [
        ('"größe.stl"', "größe.stl"),
        ('"a &amp; b.stl"', "a & b.stl"),
        ("'say &quot;a&quot;.stl'", 'say "a".stl'),
        ('"gr&#246;&#xdf;e.stl"', "größe.stl"),
    ],
)
@pytest.mark.parametrize(("encoding", "declared"), [("utf-8", ""), ("latin-1", "iso-8859-1"), ("latin-1", "")])
def test_meshes_with_odd_names_are_copied(tmp_path, written, name, encoding, declared):
    file = write(tmp_path, written, encoding, declared)
    mesh_files.write_stl(tmp_path / name)
    (tmp_path / "secret.txt").write_text("secret")
    files = copy_model(file)
    assert set(files) == {Path("arm.urdf"), Path("meshes") / name}
    copy = tmp_path / "copy"
    for path, data in files.items():
        (copy / path).parent.mkdir(parents=True, exist_ok=True)
        (copy / path).write_bytes(data)
    assert set(copy_model(copy / "arm.urdf")) == set(files)  # it finds its mesh


def test_a_file_that_is_no_mesh_is_not_copied(tmp_path):
    (tmp_path / "passwords").write_text("secret")
    with pytest.raises(UsageError, match=r"names .*passwords as a mesh or a texture"):
        copy_model(write(tmp_path, '"passwords"'))


@pytest.mark.parametrize("name", ["../../private.stl", "file://{folder}/private.stl"])
def test_a_mesh_outside_the_folder_is_asked_about(tmp_path, monkeypatch, name):
    mesh_files.write_stl(tmp_path / "private.stl")
    file = write(tmp_path / "robot" / "arm", f'"{name.format(folder=tmp_path)}"')
    with pytest.raises(UsageError, match=r"arm\.urdf names files outside its folder .*private\.stl"):
        copy_model(file)
    monkeypatch.setattr("rlctl.output.confirm", lambda question, refusal: True)
    assert Path("meshes/private.stl") in copy_model(file)


@pytest.mark.parametrize(("folder", "is_package"), [("robot/urdf", False), ("robot/deep/down", True)])
def test_meshes_beside_the_models_folder_belong_to_it(tmp_path, folder, is_package):
    (tmp_path / "robot").mkdir()
    mesh_files.write_stl(tmp_path / "robot" / "arm.stl")
    if is_package:
        (tmp_path / "robot" / "package.xml").touch()
    file = write(tmp_path / folder, '"package://robot/arm.stl"')
    assert Path("meshes/arm.stl") in copy_model(file)
