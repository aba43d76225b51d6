"""The contract that every stage shares: hulls, scenes, observations and what a push did.

Everything is a frozen pytree and, unless a docstring says otherwise, describes ONE scene (unbatched);
batches come from `jax.vmap` at the edge. Poses are ``[x, y, z, qw, qx, qy, qz]`` in metres.
"""

from typing import Any

import flax.struct as struct
import jax

MAX_OBJECTS = 8
"""Object slots in a compiled scene; the paper packs 5 to 8 objects."""

MAX_HULLS = 6
"""Convex hulls per object."""

FULL_TOPOLOGY = (32, 60, 90)
"""Vertices V, faces F = 2V - 4, edges E = 3V - 6 of a hull at the `full` level (native physics, drawing)."""

COARSE_TOPOLOGY = (16, 28, 42)
"""V, F, E at the `coarse` level (MJX)."""

CTRL_DT = 0.02
"""s between two rows of a control trajectory; engines interpolate linearly in between."""

TABLE_ID = 0
"""Instance id of the table; slot i has id i + 1."""

ROBOT_ID = MAX_OBJECTS + 1
"""Instance id of every robot link."""

REASONS = (
    "running",
    "nan",
    "unreachable",
    "off_table",
    "target_toppled",
    "target_in_region",
    "obstacle_in_region",
    "no_action",
    "truncated",
    "grasp_failed",
    "target_held",
    "target_not_alone",
    "obstacle_grasped",
)
"""Why an episode ended; an integer reason indexes this tuple, earlier entries win. The last three are of strokes."""

PUSH_REASONS = REASONS[: REASONS.index("grasp_failed") + 1]
"""Why episodes of pushes end: those that a training counts, and checkpoints hold the counts of."""

OBSTRUCTIONS = ("none", "no_ik", "joint_limit", "table", "wall", "too_long", "end_error", "jammed")
"""What keeps a hand from where it is sent: no joint solution, a joint's limit of angle or speed, an arm link too near
to the table or to a wall, a motion longer than was planned for; or, after the motion, a final error above 10 mm, or
objects pressed into each other or into a wall."""


class HandPose(struct.PyTreeNode):
    """Where a hand is sent, and how it is held; it stays horizontal.

    Attributes:
        xy: [2] float32 m, the grasp point in the world.
        z: () float32 m above the table.
        yaw: () float32 rad, the heading, 0 along +x.
        aperture: () float32 rad, drive angle of the fingers.
    """

    xy: jax.Array
    z: jax.Array
    yaw: jax.Array
    aperture: jax.Array


class Hulls(struct.PyTreeNode):
    """M convex hulls padded to one topology by repeating their last vertex, face and edge.

    Attributes:
        vertices: [M, V, 3] float32, m.
        planes: [M, F, 4] float32 rows (n, d) with unit outward n: a point x is inside iff n . x <= d for all.
        edges: [M, E, 2] int32 vertex indices.
    """

    vertices: jax.Array
    planes: jax.Array
    edges: jax.Array


class HullBank(struct.PyTreeNode):
    """A catalogue of N objects, each a set of at most `MAX_HULLS` convex hulls.

    The object frame has its origin on the base plane below the centre of mass of the standing object, z up.

    Attributes:
        full: the M hulls at `FULL_TOPOLOGY`.
        coarse: the same M hulls at `COARSE_TOPOLOGY`.
        object_hulls: [N, MAX_HULLS] int32 index into the hulls, -1 where absent.
        mass: [N] kg.
        com: [N, 3] m, centre of mass (x = y = 0 by construction of the frame).
        inertia: [N, 3] kg m^2, principal moments about the centre of mass.
        inertia_quat: [N, 4] wxyz, principal axes in the object frame.
        friction: [N] sliding friction of the surface against other objects.
        height: [N] m.
        min_width: [N] m, smallest caliper width of the vertical projection.
        names: N object names.
        content_hash: hash of everything that shaped the bank.
    """

    full: Hulls
    coarse: Hulls
    object_hulls: jax.Array
    mass: jax.Array
    com: jax.Array
    inertia: jax.Array
    inertia_quat: jax.Array
    friction: jax.Array
    height: jax.Array
    min_width: jax.Array
    names: tuple[str, ...] = struct.field(pytree_node=False)
    content_hash: str = struct.field(pytree_node=False)


class SceneParams(struct.PyTreeNode):
    """What goes into an engine: which object stands where, and which one is wanted.

    Attributes:
        object_ids: [MAX_OBJECTS] int32 index into the hull bank, -1 for an empty slot.
        poses: [MAX_OBJECTS, 7] float32 pose of each object frame in the world.
        target: () int32 slot of the target.
    """

    object_ids: jax.Array
    poses: jax.Array
    target: jax.Array


class Touch(struct.PyTreeNode):
    """What a hand touched in a stroke: down, ahead, close, up.

    Attributes:
        collided: () bool, it touched something on its way down, and went no farther.
        rows: () int32 control rows that it moved; 0 before the first stroke.
        poses: [3, MAX_OBJECTS, 7] float32 of the objects before it pushed, before it closed, and at the end, when what
            it has lifted is still in the hand.
        contacts: [L, MAX_OBJECTS] bool, which links of the robot touch which slots at the end.
        gone: [MAX_OBJECTS] bool, which objects were taken away after it.
    """

    collided: jax.Array
    rows: jax.Array
    poses: jax.Array
    contacts: jax.Array
    gone: jax.Array


class PhysicsObservation(struct.PyTreeNode):
    """What comes out of an engine.

    Attributes:
        object_poses: [MAX_OBJECTS, 7] float32.
        joint_pos: [J] float32 rad or m, the joints of the robot in the order of `Robot.joints`.
        hand_pose: [7] float32 pose of the grasp point frame (x forward, z up) in the world.
        diverged: () bool, what the engine holds makes no sense (see `physics.base`): NaN, too fast, too deep, fallen.
        overflows: () int32 physics steps since the reset in which the engine had no room for every contact.
        touch: what the hand touched in its last stroke, of engines that tell (`physics.strokes`).
    """

    object_poses: jax.Array
    joint_pos: jax.Array
    hand_pose: jax.Array
    diverged: jax.Array
    overflows: jax.Array
    touch: Touch | None = None


class Observation(struct.PyTreeNode):
    """What a camera above the table sees, on the grid (row = y, col = x), and where the hand has been sent.

    Attributes:
        height: [H, W] uint8, 0 to 255 for 0 to 0.30 m above the table (see `grid.quantize_height`).
        instance_ids: [H, W] uint8, `TABLE_ID`, slot + 1, or `ROBOT_ID`.
        hand: commanded end of the last push, the start pose before the first.
    """

    height: jax.Array
    instance_ids: jax.Array
    hand: HandPose


class Outcome(struct.PyTreeNode):
    """What a push did, for every object, so that any of them can be judged as the target (hindsight).

    Attributes:
        coverage: [MAX_OBJECTS] float32 share of each object inside the closing region after the push, as if the hand
            were open.
        aperture: () float32 rad, drive angle of the fingers during the push; without open fingers there is no region.
        distance_before: [MAX_OBJECTS] float32 m, planar distance centroid to grasp point before the push.
        distance_after: [MAX_OBJECTS] float32 m, the same after it.
        toppled: [MAX_OBJECTS] bool, tilted more than 0.7 rad after the push.
        off_table: [MAX_OBJECTS] bool, outside the workspace or below the table after the push.
        obstruction: () int32 index into `OBSTRUCTIONS`, what kept the hand from where it was sent.
        no_action: () bool, no push is allowed after this one.
        diverged: () bool, the physics diverged.
        slipped: [MAX_OBJECTS] bool, a grasp was tried and did not hold it; none if none was.
    """

    coverage: jax.Array
    aperture: jax.Array
    distance_before: jax.Array
    distance_after: jax.Array
    toppled: jax.Array
    off_table: jax.Array
    obstruction: jax.Array
    no_action: jax.Array
    diverged: jax.Array
    slipped: jax.Array

    @property
    def unreachable(self) -> jax.Array:
        """Return () bool, whether something kept the hand from where it was sent."""
        return self.obstruction != OBSTRUCTIONS.index("none")


class GraspResult(struct.PyTreeNode):
    """What a grasp did.

    Attributes:
        held: () bool, the target was lifted and stayed between the fingers.
        diverged: () bool, as in `PhysicsObservation`.
        overflows: () int32, as in `PhysicsObservation`, the pushes before the grasp included.
        obstruction: () int32 index into `OBSTRUCTIONS`, what kept it from being tried.
    """

    held: jax.Array
    diverged: jax.Array
    overflows: jax.Array
    obstruction: jax.Array


class EnvState(struct.PyTreeNode):
    """State of one scene between pushes.

    Attributes:
        physics: the engine's own pytree.
        scene: what the episode started from.
        scene_index: () int32 row of the scene bank.
        physics_obs: what the engine reports now.
        obs: what the camera sees now, and where the hand has been sent.
        centroids: [MAX_OBJECTS, 3] float32 m, centre of mass of each object.
        num_pushes: () int32 pushes so far in this episode.
    """

    physics: Any
    scene: SceneParams
    scene_index: jax.Array
    physics_obs: PhysicsObservation
    obs: Observation
    centroids: jax.Array
    num_pushes: jax.Array

    @property
    def hand(self) -> HandPose:
        """Return where the hand has been sent."""
        return self.obs.hand

    @property
    def target_xy(self) -> jax.Array:
        """Return the planar centre of mass [2] m of the target."""
        return self.centroids[self.scene.target, :2]


class StepResult(struct.PyTreeNode):
    """What `env.step` returns beside the next state.

    Attributes:
        outcome: what the push did, per object: an `Outcome`, or what else the rules measure.
        reward: () float32 for the scene's own target.
        terminated: () bool, the episode ended by itself.
        truncated: () bool, it ran out of pushes.
        reason: () int32 index into `REASONS`.
        seconds: () float32 s, how long the robot took; 0 for a push that was not executed.
    """

    outcome: Any
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    reason: jax.Array
    seconds: jax.Array
