"""Time both cameras on scenes of eight objects and the robot, and compare them with MuJoCo's ray casting.

Prints one JSON object. Times are ms per scene, from poses to the quantized observation, of one jitted call for
all scenes: the best of several, since only noise makes a run slower. `height_error_mm_max` and
`label_agreement` compare the unquantized orthographic view with `mj_ray` straight down on the same hulls (errors
where labels agree), the keys beginning with `pinhole_` the depth image with `mj_multiRay` from the camera, and,
with --object-dir, those beginning with `original_` with rays on the original meshes and the capsules of the MJCF.
"""

import argparse
import functools
import json
import os
import platform
from pathlib import Path

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)

# isort: split
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import trimesh
from scipy.spatial import ConvexHull
from timing import best_ms

from pregrasp_jax import heightmap
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.assets.meshes import load_mesh, load_object_dir, mesh_folder
from pregrasp_jax.assets.settings import load_settings
from pregrasp_jax.robot import get_robot
from pregrasp_jax.robot.links import pose_to_matrix
from pregrasp_jax.scene.spec import compile_spec, scene_spec
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.types import MAX_OBJECTS, ROBOT_ID, HullBank, Observation, PhysicsObservation, SceneParams

ROBOT = get_robot("ur5e_rg2")

SPACING = 0.1
"""m between the objects, which stand on a 3 x 3 pattern with one place free."""

ABOVE = 2.0
"""m; rays start here."""


def make_scenes(bank: HullBank, count: int, rng: np.random.Generator) -> tuple[SceneParams, PhysicsObservation]:
    """Stand eight objects upright at random yaws, the open hand somewhere among them; leaves are [count, ...]."""
    pattern = SPACING * np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(9, 2)
    ids, poses, hands = [], [], []
    for _ in range(count):
        few = len(bank.names) < MAX_OBJECTS
        ids.append(rng.choice(len(bank.names), MAX_OBJECTS, replace=few))
        xy = rng.permutation(pattern)[:MAX_OBJECTS] + rng.normal(0, 0.01, (MAX_OBJECTS, 2))
        half_yaw = rng.uniform(-np.pi / 2, np.pi / 2, MAX_OBJECTS)
        quat = np.stack([np.cos(half_yaw), 0 * half_yaw, 0 * half_yaw, np.sin(half_yaw)], axis=1)
        poses.append(np.concatenate([xy, np.zeros((MAX_OBJECTS, 1)), quat], axis=1))
        hands.append([rng.uniform(-0.25, 0.1), rng.uniform(-0.15, 0.15), 0.1, 1, 0, 0, 0])
    poses, hand_pose = jnp.asarray(np.stack(poses), jnp.float32), jnp.asarray(hands, jnp.float32)
    home = jnp.asarray(ROBOT.home)

    def solve(pose: jax.Array) -> tuple[jax.Array, jax.Array]:
        controls, code = ROBOT.follow(home, jnp.stack([pose] * 2), jnp.stack([home[6]] * 2), TABLE)
        return controls[0, :6], code[0]

    arm, code = jax.jit(jax.vmap(solve))(hand_pose)
    joint_pos = jnp.concatenate([arm, jnp.broadcast_to(home[6:], (count, 2))], axis=1)
    assert (code == 0).all(), "a hand pose is out of reach"
    scene = SceneParams(jnp.asarray(np.stack(ids), jnp.int32), poses, jnp.zeros(count, jnp.int32))
    return scene, PhysicsObservation(poses, joint_pos, hand_pose, jnp.zeros(count, bool), jnp.zeros(count, jnp.int32))


def add_mesh(spec: mujoco.MjSpec, name: str, vertices: np.ndarray, faces: np.ndarray, pose: np.ndarray) -> None:
    """Add a mesh to be seen by rays; MuJoCo casts them on the triangles themselves."""
    mesh = spec.add_mesh(name=name, uservert=vertices.ravel(), userface=faces.astype(np.int32).ravel())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    kind = mujoco.mjtGeom.mjGEOM_MESH
    spec.worldbody.add_geom(name=name, type=kind, meshname=name, pos=pose[:3], quat=pose[3:], contype=0, conaffinity=0)


def outward_faces(vertices: np.ndarray) -> np.ndarray:
    """Return the triangles [F, 3] of a convex hull, counter-clockwise from outside."""
    hull = ConvexHull(vertices)
    a, b, c = np.moveaxis(vertices[hull.simplices], 1, 0)
    inward = np.sum(np.cross(b - a, c - a) * hull.equations[:, :3], axis=1) < 0
    return np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)


def model_of_hulls(hulls: heightmap.HullInstances) -> tuple[mujoco.MjModel, np.ndarray]:
    """Compile the hulls [K] of one scene as meshes; return the model and the label of each geom."""
    spec = mujoco.MjSpec()
    present = np.flatnonzero(np.asarray(hulls.present))
    for k in present:
        vertices = np.asarray(hulls.vertices[k], np.float64)
        add_mesh(spec, f"hull{k}", vertices, outward_faces(vertices), np.array([0, 0, 0, 1, 0, 0, 0]))
    return spec.compile(), np.asarray(hulls.labels)[present]


def model_of_originals(meshes: list[trimesh.Trimesh], ids: np.ndarray) -> tuple[mujoco.MjModel, np.ndarray]:
    """Compile robot, table, and the original meshes of the objects; return the model and the label of each geom."""
    spec = scene_spec(ROBOT, TABLE)
    for slot, index in enumerate(ids):
        mesh = meshes[index]
        add_mesh(spec, f"original{slot}", mesh.vertices, mesh.faces, np.array([0, 0, 0, 1, 0, 0, 0]))
    mj_model = compile_spec(spec)
    labels = np.full(mj_model.ngeom, ROBOT_ID)
    labels[mj_model.geom("table").id] = 0
    for slot in range(len(ids)):
        labels[mj_model.geom(f"original{slot}").id] = slot + 1
    return mj_model, labels


def cast_down(mj_model: mujoco.MjModel, mj_data: mujoco.MjData, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return heights and labels [H, W] at the cell centres by vertical rays."""
    height, seen = np.zeros((grid.GRID_SIZE, grid.GRID_SIZE)), np.zeros((grid.GRID_SIZE, grid.GRID_SIZE), int)
    centers = np.asarray(grid.cell_centers(), np.float64)
    geom_id = np.zeros(1, np.int32)
    for row, y in enumerate(centers):
        for col, x in enumerate(centers):
            distance = mujoco.mj_ray(mj_model, mj_data, [x, y, ABOVE], [0, 0, -1], None, 1, -1, geom_id)
            if 0 <= distance < ABOVE:
                height[row, col], seen[row, col] = ABOVE - distance, labels[geom_id[0]]
    return height, seen


def cast_from_camera(
    mj_model: mujoco.MjModel, mj_data: mujoco.MjData, labels: np.ndarray, camera: heightmap.Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Return depth and labels [rows, columns] of a camera that looks straight down on the table."""
    rows, columns = camera.shape
    focal, above = float(camera.focal), float(camera.position[2])
    u, v = (np.arange(columns) + 0.5 - columns / 2) / focal, (rows / 2 - np.arange(rows) - 0.5) / focal
    rays = np.stack([*np.meshgrid(u, v), -np.ones((rows, columns))], axis=-1).reshape(-1, 3)
    lengths = np.linalg.norm(rays, axis=1)
    geom_id, distance = np.zeros(len(rays), np.int32), np.zeros(len(rays))
    origin, directions = np.asarray(camera.position, np.float64), (rays / lengths[:, None]).ravel()
    mujoco.mj_multiRay(
        mj_model, mj_data, origin, directions, None, 1, -1, geom_id, distance, None, len(rays), mujoco.mjMAXVAL
    )
    depth = distance / lengths
    hit = (geom_id >= 0) & (depth < above)
    return np.where(hit, depth, above).reshape(rows, columns), np.where(hit, labels[geom_id], 0).reshape(rows, columns)


def compare_all(pairs: list[tuple[tuple, tuple]]) -> tuple[float, np.ndarray]:
    """Return the share of equal labels, and the errors in mm where they are equal and not 0."""
    equal = [np.asarray(labels) == expected_labels for (_, labels), (_, expected_labels) in pairs]
    errors = [
        np.abs(np.asarray(value) - expected)[same & (expected_labels > 0)]
        for same, ((value, _), (expected, expected_labels)) in zip(equal, pairs, strict=True)
    ]
    return float(np.mean(equal)), 1e3 * np.concatenate(errors)


def load_originals(object_dir: Path, object_set: str, bank: HullBank) -> list[trimesh.Trimesh]:
    """Return the mesh of every object of the bank, moved to its object frame by the centre of its bounding box."""
    folder = mesh_folder(object_dir, object_set)
    defaults, listed = load_settings(folder)
    files = {path.stem: path for path in sorted(folder.iterdir()) if path.is_file()}
    meshes = []
    for index, name in enumerate(bank.names):
        mesh = load_mesh(files[name], listed.get(files[name].name, defaults))
        of_object = np.asarray(bank.object_hulls)[index]
        points = np.asarray(bank.full.vertices)[of_object[of_object >= 0]].reshape(-1, 3)
        shift = (points.min(axis=0) + points.max(axis=0)) / 2 - mesh.bounds.mean(axis=0)
        shift[2] = -mesh.bounds[0, 2]
        mesh.apply_translation(shift)
        meshes.append(mesh)
    return meshes


def place(mesh: trimesh.Trimesh, pose: np.ndarray) -> trimesh.Trimesh:
    """Return a copy of a mesh at a pose [7]."""
    return mesh.copy().apply_transform(pose_to_matrix(pose[:3], pose[3:]))


def with_robot_at(mj_model: mujoco.MjModel, joint_pos: np.ndarray | None) -> mujoco.MjData:
    """Return data with kinematics done, the robot (if there is one) at joint positions [8]."""
    mj_data = mujoco.MjData(mj_model)
    if joint_pos is not None:
        mj_data.qpos[ROBOT.joint_qpos_ids(mj_model)] = joint_pos
        for side in ("left", "right"):
            mj_data.joint(f"hand_{side}_tip").qpos[0] = -mj_data.joint(f"hand_{side}_driver").qpos[0]
    mujoco.mj_forward(mj_model, mj_data)
    return mj_data


def measure(args: argparse.Namespace) -> dict[str, float]:
    """Return every figure."""
    bank = load_object_dir(args.object_dir, "seen")[0] if args.object_dir else builtin_bank("seen")
    scene, physics_obs = make_scenes(bank, args.scenes, np.random.default_rng(args.seed))
    camera = heightmap.overhead_camera()
    place_hulls = functools.partial(heightmap.scene_hulls, bank, ROBOT)
    hulls = jax.jit(jax.vmap(place_hulls))(scene, physics_obs)

    def timed(view: str | heightmap.Camera) -> float:
        def look(scene: SceneParams, physics_obs: PhysicsObservation) -> Observation:
            return heightmap.observe(place_hulls(scene, physics_obs), ROBOT.start, camera=view)

        run = jax.jit(jax.vmap(look))
        return best_ms(lambda: run(scene, physics_obs), repetitions=args.repetitions) / args.scenes

    result = {"orthographic_ms_per_scene": timed("orthographic"), "pinhole_ms_per_scene": timed(camera)}
    rows = [jax.tree.map(lambda leaf, i=i: leaf[i], (hulls, physics_obs, scene)) for i in range(args.scenes)]
    from_above, from_camera = jax.jit(heightmap.orthographic), jax.jit(heightmap.render_pinhole)
    above, through, original = [], [], []
    meshes = load_originals(args.object_dir, "seen", bank) if args.object_dir else None
    for instances, obs, params in rows:
        mj_model, labels = model_of_hulls(instances)
        mj_data = with_robot_at(mj_model, None)
        above.append((from_above(instances), cast_down(mj_model, mj_data, labels)))
        through.append((from_camera(instances, camera), cast_from_camera(mj_model, mj_data, labels, camera)))
        if meshes:
            ids, poses = np.asarray(params.object_ids), np.asarray(obs.object_poses, np.float64)
            placed = [place(meshes[i], pose) for i, pose in zip(ids, poses, strict=True)]
            mj_model, labels = model_of_originals(placed, np.arange(len(placed)))
            mj_data = with_robot_at(mj_model, np.asarray(obs.joint_pos))
            original.append((from_above(instances), cast_down(mj_model, mj_data, labels)))
    result["label_agreement"], errors = compare_all(above)
    result["height_error_mm_max"] = float(errors.max())
    # Not the largest: a pixel on the outline of one hull before another of the same object may see either.
    result["pinhole_label_agreement"], errors = compare_all(through)
    result["pinhole_share_within_0.1_mm"] = float(np.mean(errors <= 0.1))
    if meshes:
        result["original_label_agreement"], errors = compare_all(original)
        result["original_height_error_mm_median"] = float(np.median(errors))
    return result


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=16, help="scenes per call")
    parser.add_argument("--repetitions", type=int, default=10, help="timed calls")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--object-dir", type=Path, help="folder of meshes; the built-in catalogue otherwise")
    args = parser.parse_args()
    machine = {"cores": os.cpu_count(), "cpu": platform.machine(), "device": jax.devices()[0].device_kind}
    print(json.dumps({**measure(args), "scenes": args.scenes, "objects": MAX_OBJECTS, "machine": machine}, indent=2))


if __name__ == "__main__":
    main()
