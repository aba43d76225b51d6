"""Folders of meshes: what loads, settings, cache, and the table; what is refused is in test_bad_input."""

import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from bad_files import InlineExecutor
from mesh_cases import float_document, glb, with_uri

from pregrasp_jax.assets import mesh_file, meshes
from pregrasp_jax.assets.bank import select
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.assets.decompose import BASE_BAND, decompose, flatten_base, repair
from pregrasp_jax.assets.fit import Fit
from pregrasp_jax.assets.hulls import volume
from pregrasp_jax.assets.mesh_file import load_mesh
from pregrasp_jax.assets.meshes import LoadedDir, Note, Refusal, load_object_dir
from pregrasp_jax.assets.sets import format_table, load_bank_for
from pregrasp_jax.assets.settings import ObjectSettings, load_settings
from pregrasp_jax.robot import get_robot


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("PREGRASP_JAX_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "hulls"


def write(path: Path, mesh: trimesh.Trimesh) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path)


def box(width: float = 0.06, depth: float = 0.07, height: float = 0.15) -> trimesh.Trimesh:
    return trimesh.creation.box((width, depth, height))


def bottle() -> trimesh.Trimesh:
    """Non-convex, one closed surface: wide below, narrow above."""
    return trimesh.creation.revolve([[0, 0], [0.04, 0], [0.04, 0.1], [0.012, 0.1], [0.012, 0.2], [0, 0.2]])


def crash_on_bad(job):
    """A worker in which native code dies on one mesh; at module level, so that it can be sent to a process."""
    if job.name == "bad":
        os._exit(1)
    return try_job(job)


try_job = meshes._try_job


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """A folder of good and bad meshes, loaded once."""
    folder = tmp_path_factory.mktemp("mixed")
    write(folder / "a_box.stl", box())
    write(folder / "b_bottle.ply", bottle())
    write(folder / "c_millimetres.obj", box(70, 150, 60))  # lies along y
    write(folder / "d_scene.glb", box(0.05, 0.05, 0.2))
    write(folder / "e_twin.stl", box(0.05, 0.06, 0.12))
    write(folder / "e_twin.obj", box(0.06, 0.06, 0.12))
    write(folder / "flat.stl", box(0.05, 0.004, 0.15))
    write(folder / "tiny.stl", box(6e-5, 7e-5, 15e-5))
    (folder / "notes.txt").write_text("not a mesh")
    (folder / "objects.yaml").write_text(
        "defaults: {density: 400, friction: 0.3}\n"
        "a_box.stl: {mass: 0.33}\n"
        "c_millimetres.obj: {scale: 0.001, up: y}\n"
        "gone.stl: {mass: 0.1}\n"
    )
    calls: list[tuple[int, int, str]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(meshes, "WorkerPool", InlineExecutor)
        patch.setenv("PREGRASP_JAX_CACHE", str(tmp_path_factory.mktemp("cache")))
        loaded = load_object_dir(folder, "seen", progress=lambda *call: calls.append(call))
    assert loaded.unused == ["notes.txt: no meshes"]
    assert set(loaded.fits) == set(loaded.bank.names)
    return loaded.bank, {r.name: r.reason for r in loaded.refusals}, calls


def test_good_meshes_load_beside_bad_ones(mixed):
    bank, reasons, calls = mixed
    assert bank.names == ("a_box", "b_bottle", "c_millimetres", "d_scene", "e_twin.obj", "e_twin.stl")
    assert set(reasons) == {"flat.stl", "tiny.stl", "gone.stl"}
    assert [done for done, _, _ in calls] == sorted(done for done, _, _ in calls)
    assert calls[-1][:2] == (len(bank.names) + len(reasons),) * 2


def test_settings_reach_the_objects(mixed):
    bank, _, _ = mixed
    assert float(bank.mass[0]) == pytest.approx(0.33)
    np.testing.assert_allclose(bank.friction, 0.3)
    assert float(bank.mass[3]) == pytest.approx(400 * 0.05 * 0.05 * 0.2, rel=3e-3)
    # Millimetres along y: standing up it is 60 x 70 mm and 150 mm tall, as a proper rotation, not a swap.
    extent = np.ptp(np.asarray(bank.full.vertices)[np.asarray(bank.object_hulls)[2, 0]], axis=0)
    np.testing.assert_allclose(extent, [0.06, 0.07, 0.15], atol=1e-6)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_up_axis_is_a_proper_rotation(tmp_path, up):
    """A chiral solid keeps its volume's sign, and its tip (along the up axis) ends on top."""
    sign, axis = -1.0 if up.startswith("-") else 1.0, "xyz".index(up[-1])
    tip = np.roll([0.15, 0.0, 0.0], axis) * sign
    a, b, c = np.roll([0.0, 0.06, 0.0], axis), np.roll([0.0, 0.0, 0.06], axis), np.roll([0.0, -0.03, -0.03], axis)
    mesh = trimesh.Trimesh([tip, a, b, c], [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    mesh.export(tmp_path / "m.ply")
    turned = mesh_file._upright(np.asarray(mesh.vertices), up)
    np.testing.assert_allclose(turned[0], [0.0, 0.0, 0.15], atol=1e-9)
    assert np.linalg.det(turned[1:] - turned[0]) == pytest.approx(np.linalg.det(mesh.vertices[1:] - mesh.vertices[0]))
    assert load_mesh(tmp_path / "m.ply", ObjectSettings(up=up)).bounds[1, 2] == pytest.approx(0.15)


def test_cache_is_used_and_depends_on_content_settings_and_health(tmp_path, cache, monkeypatch):
    monkeypatch.setattr(meshes, "WorkerPool", InlineExecutor)
    folder = tmp_path / "set"
    write(folder / "one.stl", box())
    first = load_object_dir(folder, "seen")
    (entry,) = cache.iterdir()
    with monkeypatch.context() as patch:
        patch.setattr(meshes, "WorkerPool", None)  # a second decomposition would fail
        again = load_object_dir(folder, "seen")
    assert again.bank.content_hash == first.bank.content_hash
    assert again.fits["one"].as_numbers() == first.fits["one"].as_numbers()
    entry.write_bytes(entry.read_bytes()[:-200])
    with pytest.warns(UserWarning, match=rf"{entry.name} is damaged; one\.stl is decomposed anew"):
        assert load_object_dir(folder, "seen").bank.content_hash == first.bank.content_hash
    (folder / "objects.yaml").write_text("one.stl: {mass: 0.4}")
    assert float(load_object_dir(folder, "seen").bank.mass[0]) == pytest.approx(0.4)
    assert len(list(cache.iterdir())) == 2


def test_cache_depends_on_the_buffers_of_a_gltf(tmp_path, monkeypatch):
    monkeypatch.setattr(meshes, "WorkerPool", InlineExecutor)
    document, buffer = with_uri("m.bin")
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "m.gltf").write_bytes(document)
    heights = []
    for scale in (1.0, 1.2):
        corners = np.frombuffer(buffer[:96], "<f4") * np.float32(scale)
        (tmp_path / "set" / "m.bin").write_bytes(corners.tobytes() + buffer[96:])
        loaded = load_object_dir(tmp_path / "set", "seen")
        assert loaded.unused == []
        heights.append(float(loaded.bank.height[0]))
    np.testing.assert_allclose(heights, [0.15, 0.18], atol=1e-6)
    (tmp_path / "set" / "m.bin").unlink()
    assert (
        load_object_dir(tmp_path / "set", "seen")
        .refusals[0]
        .reason.startswith("its buffer 'm.bin' is missing; allowed")
    )


def test_a_format_whose_library_is_missing_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setattr(meshes, "WorkerPool", InlineExecutor)
    monkeypatch.setitem(sys.modules, "collada", None)
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "m.dae").write_bytes(b"<?xml version='1.0'?><COLLADA/>")
    (refusal,) = load_object_dir(tmp_path / "set", "seen").refusals
    assert "the format .dae requires collada; install it with pip install 'pregrasp_jax[formats]'" in refusal.reason


def test_a_folder_for_each_object(tmp_path, monkeypatch):
    """As YCB, Gazebo and pybullet ship them: the original mesh, unless objects.yaml names another one."""
    monkeypatch.setattr(meshes, "WorkerPool", InlineExecutor)
    for name in (
        "003_box/google_16k/textured.obj",
        "003_box/google_16k/nontextured.stl",
        "004_can/vhacd.obj",
    ):
        write(tmp_path / "set" / name, box())
    write(tmp_path / "set" / "004_can/meshes/visual.ply", box(height=0.2))
    write(tmp_path / "set" / "mug.stl", box(height=0.13))
    write(tmp_path / "set" / "mug/mug.stl", box(height=0.14))
    for name in (
        "003_box/google_16k/textured.mtl",
        "003_box/google_16k/map.png",
        "004_can/model.urdf",
        "004_can/a.mtl",
    ):
        (tmp_path / "set" / name).write_text("")
    (tmp_path / "set" / "mug/textured.mtl").write_text("")
    (tmp_path / "set" / "empty").mkdir()
    (tmp_path / "set" / "teapot.fbx").write_text("")
    (tmp_path / "set" / "objects.yaml").write_text("003_box: {mass: 0.4}\n004_can/vhacd.obj: {mass: 0.2}\nmug.stl:\n")
    loaded = load_object_dir(tmp_path / "set", "seen")
    assert loaded.bank.names == ("003_box", "004_can", "mug.stl", "mug/mug.stl")
    np.testing.assert_allclose(loaded.bank.mass[:2], [0.4, 0.2])
    np.testing.assert_allclose(loaded.bank.height, [0.15, 0.15, 0.13, 0.14], atol=1e-6)
    assert loaded.refusals[0].name == "teapot.fbx"
    assert loaded.refusals[0].reason.startswith(
        ".fbx is not read; allowed are .obj, .stl, .ply, .glb, .gltf, .off, .dae"
    )
    assert loaded.unused == [
        "nontextured.stl, visual.ply: one mesh a folder is read; another one listed in objects.yaml is read instead",
        "empty: empty folders",
        "map.png, textured.mtl (2 times), a.mtl: materials and textures; only shapes are read",
        "model.urdf: descriptions; scale, up, mass and friction are set in objects.yaml",
    ]


def test_meshes_beside_the_folders_of_the_sets_are_told(tmp_path, monkeypatch):
    monkeypatch.setattr(meshes, "WorkerPool", InlineExecutor)
    write(tmp_path / "set" / "seen" / "a.stl", box())
    write(tmp_path / "set" / "stray.stl", box())
    assert load_object_dir(tmp_path / "set", "seen").unused == [
        "stray.stl: beside the folder seen, whose meshes are read"
    ]


def test_a_set_up_axis_is_not_doubted(tmp_path):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "m.glb").write_bytes(glb(*float_document()))
    assert "doubt" not in load_mesh(tmp_path / "set" / "m.glb", ObjectSettings(up="z")).metadata


def test_an_unreadable_mesh_costs_one_mesh(tmp_path, monkeypatch):
    """Also where the rights of root make every file readable."""
    for name in ("bad", "good"):
        write(tmp_path / f"{name}.stl", box())
    read_bytes = Path.read_bytes

    def refuse_bad(path: Path) -> bytes:
        if path.name == "bad.stl":
            raise PermissionError(13, "Permission denied", str(path))
        return read_bytes(path)

    monkeypatch.setattr(Path, "read_bytes", refuse_bad)
    bank, refusals, *_ = load_object_dir(tmp_path, "seen")
    assert bank.names == ("good",)
    assert refusals == [Refusal("bad.stl", "cannot be read (Permission denied); allowed are readable files")]


def test_a_crashing_decomposition_costs_one_mesh(tmp_path, monkeypatch):
    for name in ("bad", "good"):
        write(tmp_path / f"{name}.stl", box())
    monkeypatch.setattr(meshes, "_try_job", crash_on_bad)
    bank, refusals, *_ = load_object_dir(tmp_path, "seen")
    assert bank.names == ("good",)
    assert [r.name for r in refusals] == ["bad.stl"]
    assert "worker process died" in refusals[0].reason


def test_sets_and_folders(tmp_path):
    with pytest.raises(ValueError, match="'train' is unknown; allowed are seen, unseen"):
        load_object_dir(tmp_path, "train")
    (tmp_path / "unseen").mkdir()
    with pytest.raises(ValueError, match="has no 'seen' set; allowed here are unseen"):
        load_object_dir(tmp_path, "seen")
    assert meshes.mesh_folder(tmp_path, "unseen") == tmp_path / "unseen"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a.stl: {colour: red}", "unknown setting 'colour'; allowed are scale, up, mass, density, friction"),
        ("a.stl: {up: w}", "up is 'w'; allowed are x, y, z, -x, -y, -z"),
        ("a.stl: {mass: true}", "mass is True; allowed is a number from 0.005 to 20"),
        ("defaults: {scale: -1}", "defaults: scale is -1; allowed is"),
        ("a.stl: {density: .nan}", "density is nan"),
        ("a.stl: {mass: 1, density: 300}", "both mass and density"),
        ("a.stl: [1, 2]", "is list; allowed is a mapping"),
        ("- a", "is list; allowed is a mapping"),
        ("a: {b", "line 1: while parsing a flow mapping"),
        ("a.stl: !!python/object/apply:os.getcwd []", "line 1: could not determine a constructor"),
    ],
)
def test_wrong_settings_are_one_line(tmp_path, text, message):
    (tmp_path / "objects.yaml").write_text(text)
    with pytest.raises(ValueError) as error:
        load_settings(tmp_path)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_density_overrides_a_default_mass(tmp_path):
    (tmp_path / "objects.yaml").write_text("defaults: {mass: 0.2}\na.stl: {density: 700}\nb.stl:\n")
    defaults, listed = load_settings(tmp_path)
    assert (defaults.mass, listed["b.stl"].mass) == (0.2, 0.2)
    assert (listed["a.stl"].mass, listed["a.stl"].density) == (None, 700)


def test_what_is_refused_of_a_usable_set_is_a_warning(tmp_path, monkeypatch):
    monkeypatch.setattr(meshes, "WorkerPool", InlineExecutor)
    for number in range(5):
        write(tmp_path / f"{number}.stl", box(height=0.12 + 0.01 * number))
    write(tmp_path / "low.stl", box(0.06, 0.06, 0.05))
    with pytest.warns(UserWarning, match=r"low\.stl refused: too low"):
        assert len(load_bank_for(tmp_path, "seen").names) == 5
    assert load_bank_for(None, "unseen").content_hash == builtin_bank("unseen").content_hash


def test_table_names_objects_and_refusals():
    bank = builtin_bank("seen")
    why_not = get_robot("ur5e_rg2").eligibility(bank).reasons
    table = format_table(LoadedDir(bank, [Refusal("x.stl", "too low")]), why_not).splitlines()
    assert table[0].split() == ["object", "hulls", "size", "[mm]", "mass", "[kg]", "target"]
    chips = next(line for line in table if line.startswith("ycb_chips_can"))
    assert chips.split()[1:] == ["1", "77", "x", "76", "x", "250", "0.205", "yes"]
    pitcher = next(line for line in table if line.startswith("ycb_pitcher"))
    assert "no: narrowest width" in pitcher
    assert table[-2].startswith("17 objects, ")
    assert table[-1] == "refused: x.stl: too low"


def test_table_tells_how_hulls_fit_and_what_is_not_used():
    bank = select(builtin_bank("seen"), [0, 1])
    size = np.array([0.06, 0.06, 0.1])
    fits = {
        "a": Fit(size, size + 0.002, 1.1, 0.1),
        "b": Fit(size, size, 0.96, 0.1),
        "c": Fit(size, size, np.nan, np.nan),
    }
    loaded = LoadedDir(
        bank, notes=[Note("a.stl", fits["a"].remark())], fits=fits, unused=["a.mtl: only shapes are read"]
    )
    table = format_table(loaded, [""] * len(bank.names)).splitlines()
    said = (
        "hulls against meshes: extents differ by 0.0 mm (median) to 2.0 mm (a), volumes by 7.0 % (median) to 10.0 % (a)"
    )
    assert table[-3] == said
    assert table[-2] == "note: a.stl: hulls 62 x 62 x 102 mm, mesh 60 x 60 x 100 mm; volume 1.10 x that of the mesh"
    assert table[-1] == "not used: a.mtl: only shapes are read"


def test_repair_merges_seams_fills_holes_and_turns_inside_out_faces():
    mesh = bottle()
    soup = trimesh.Trimesh(
        mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3)[1:], process=False
    )
    soup.faces[::2] = soup.faces[::2, ::-1]
    mended = repair(soup)
    assert mended.is_watertight
    assert mended.volume == pytest.approx(mesh.volume, rel=1e-6)


def test_large_meshes_are_decimated():
    mesh = trimesh.creation.icosphere(subdivisions=6, radius=0.08)
    mended = repair(mesh)
    assert 5000 < len(mended.faces) < 25_000 < len(mesh.faces)
    assert mended.convex_hull.volume == pytest.approx(mesh.volume, rel=1e-3)


def test_decomposition_is_deterministic_tight_and_flat():
    mesh = bottle()
    first, second = decompose(mesh), decompose(mesh)
    assert 2 <= len(first) <= 6
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    assert sum(volume(part) for part in first) == pytest.approx(mesh.volume, rel=0.08)
    assert volume(np.asarray(mesh.vertices)) > 1.3 * mesh.volume  # one hull would be the decoy
    assert min(part[:, 2].min() for part in first) == 0.0


def test_open_meshes_are_refitted_to_their_surface():
    """Remeshing inflates; with the refit nothing sticks out of the mesh's own bounding box."""
    mesh = bottle()
    torn = trimesh.Trimesh(mesh.vertices, np.delete(mesh.faces, [5, 6, 7, 8, 60, 61, 62, 63], axis=0), process=False)
    assert not torn.is_watertight
    points = np.concatenate(decompose(torn))
    assert points[:, :2].max() <= 0.04 + 1e-9
    assert points[:, 2].max() <= 0.2 + 1e-9


def test_flatten_base_moves_only_the_band():
    part = np.array(
        [[0.0, 0.0, 0.5], [0.1, 0.0, 0.5 + 0.9 * BASE_BAND], [0.0, 0.1, 0.5 + 1.1 * BASE_BAND], [0, 0, 0.7]]
    )
    (flat,) = flatten_base([part])
    np.testing.assert_allclose(flat[:, 2], [0.0, 0.0, 1.1 * BASE_BAND, 0.2])
    np.testing.assert_array_equal(flat[:, :2], part[:, :2])


@pytest.mark.slow
@pytest.mark.skipif("PREGRASP_JAX_OBJECTS" not in os.environ, reason="PREGRASP_JAX_OBJECTS names no folder of meshes")
def test_a_folder_of_real_meshes(tmp_path):
    folder = meshes.mesh_folder(Path(os.environ["PREGRASP_JAX_OBJECTS"]), "seen")
    shutil.copytree(folder, tmp_path / "seen")
    bank, refusals, *_ = load_object_dir(tmp_path, "seen")
    assert not refusals
    assert get_robot("ur5e_rg2").eligibility(bank).eligible.mean() > 0.8
    assert min(meshes.tip_angle(bank, i) for i in range(len(bank.names))) > meshes.MIN_TIP_ANGLE
