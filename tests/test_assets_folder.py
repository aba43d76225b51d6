"""Which mesh of a folder is an object's, what it is called, and where settings may not lie."""

import pytest
from test_assets_meshes import box, write

from pregrasp_jax.assets.folder import find_meshes


def test_the_original_is_read_before_what_was_simplified(tmp_path):
    for name in ("can/model.obj", "can/a_collision_0.obj", "can/z/model.stl"):
        write(tmp_path / "set" / name, box())
    (found,) = find_meshes(tmp_path / "set", ()).meshes
    assert (found.name, found.key) == ("can", "can/model.obj")
    for name in ("lid/lid_color.ply", "lid/lid_vhacd.obj", "pot/pot_col.obj", "pot/pot.ply"):
        write(tmp_path / "others" / name, box())
    keys = [mesh.key for mesh in find_meshes(tmp_path / "others", ()).meshes]
    assert keys == ["lid/lid_color.ply", "pot/pot.ply"], "a colour is no collision shape"


def test_objects_have_names_of_their_own_whatever_files_are_called(tmp_path):
    for name in ("a.obj", "a.stl", "a.obj.stl", "b.stl"):
        write(tmp_path / "set" / name, box())
    names = [mesh.name for mesh in find_meshes(tmp_path / "set", ()).meshes]
    assert names == ["a.obj", "a.obj.stl", "a.stl", "b"]


def test_settings_in_an_objects_own_folder_are_refused(tmp_path):
    write(tmp_path / "set" / "mug" / "mug.obj", box())
    inside = tmp_path / "set" / "mug" / "objects.yaml"
    inside.write_text("mug.obj: {mass: 0.9}")
    (tmp_path / "set" / "objects.yaml").write_text("mug: {mass: 0.9}")
    with pytest.raises(
        ValueError, match=r"mug/objects\.yaml: not read; allowed is .*/set/objects\.yaml, which lists mug"
    ):
        find_meshes(tmp_path / "set", ())
    inside.unlink()
    assert len(find_meshes(tmp_path / "set", ()).meshes) == 1
