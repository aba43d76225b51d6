"""Whether there is enough free space around the target for a last stroke, and which one.

The paper says "enough free space around the target" and no more. Two readings are here. `make_feasible`: there is a
stroke that reaches the target, encloses it and nothing else, and touches no obstacle on its way. `make_cluster`: no
obstacle within 10 mm, as a script of PPG's reference has it. Both look at the height map and the target's mask only.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.policies.strokes import squared_distance
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.robot.region import ClosingRegion
from pregrasp_jax.spaces import grid
from pregrasp_jax.task.push_grasp import APERTURE, DISTANCE, HEADINGS, PushGrasp, push_grasp
from pregrasp_jax.types import ROBOT_ID, TABLE_ID, EnvState

FinalStroke = Callable[[EnvState, jax.Array], tuple[PushGrasp, jax.Array]]
"""(state, key) -> the last stroke and () bool, whether it is to be made now."""

APERTURES = np.linspace(APERTURE.low, APERTURE.high, 6)
"""rad that are tried."""

LATERAL = (0.0, -0.02, 0.02)
"""m beside the target's centroid at which the hand may pass."""

STANDOFF = 0.005
"""m between the commanded point and the near side of the target at the end; 10 mm from the palm."""

MARGIN = 0.005 + grid.HEIGHTMAP_RESOLUTION / 2
"""m that the hand keeps from the middle of every obstacle's cell: 5 mm from the cell."""

MIN_COVERAGE, MAX_OVERLAP = 0.95, 2e-4
"""Share of the target, and m2 of obstacles in the closing region."""

MAX_START = 0.35
"""m from the centre, along x and y, at which a last stroke may begin: the hand floats."""

_BEHIND = 0.065
"""m from the commanded point to the back of the hand."""

_FINEST, _HALF_LINES = 0.001, 0.14
"""m between the lines on which the hand's outline is tabulated, and how far out they go."""

_CLEAR = 0.1
"""m of clearance beyond which more is worth nothing."""

_FREE, _NEAR, _FAR = 0.01, 10, 30
"""Of `make_cluster`: m that are free around the target; cells from it between which its last stroke begins."""


class Seen(NamedTuple):
    """What the map says of the target.

    Attributes:
        points: [H * W, 2] m, centres of cells.
        target: [H * W] bool.
        obstacle: [H * W] bool.
        centroid: [2] m of the target's cells.
    """

    points: jax.Array
    target: jax.Array
    obstacle: jax.Array
    centroid: jax.Array


def look(state: EnvState) -> Seen:
    """Return what the map says of the target."""
    ids = state.obs.instance_ids.ravel()
    target = ids == state.scene.target + 1
    rows, cols = np.indices((grid.GRID_SIZE, grid.GRID_SIZE)).reshape(2, -1)
    points = jnp.asarray(grid.cell_to_world(rows, cols), jnp.float32)
    centroid = jnp.sum(points * target[:, None], axis=0) / jnp.maximum(jnp.sum(target), 1)
    return Seen(points, target, (ids != TABLE_ID) & (ids != ROBOT_ID) & ~target, centroid)


def make_feasible(robot: Robot) -> FinalStroke:
    """Return the criterion that such a stroke exists; of several the one with the largest clearance.

    If no object is left but the target, the stroke with the largest clearance is made even so.

    Raises:
        ValueError: the robot has no closing region, or nobody knows how far it reaches.
    """
    region, front = robot.closing_region, robot.front
    if region is None or front is None:
        raise ValueError(f"robot {robot.name} has no outline; allowed for Target-PPG is a robot with `front`")
    lines = np.arange(-_HALF_LINES, _HALF_LINES + _FINEST / 2, _FINEST)
    with jax.ensure_compile_time_eval():
        fronts = np.stack([np.asarray(front(jnp.float32(a), jnp.asarray(lines, jnp.float32))) for a in APERTURES])
        regions = [region(jnp.float32(a)) for a in APERTURES]
        stations = np.stack([np.asarray(r.x) for r in regions])
        half_widths = np.stack([np.asarray(r.half_width) for r in regions])
    wide = _widened(fronts, round(MARGIN / _FINEST)) + MARGIN

    def try_heading(seen: Seen, yaw: jax.Array, lateral: jax.Array) -> tuple[PushGrasp, jax.Array, jax.Array]:
        """Return strokes [A] of all apertures, their clearance [A] m (-inf out of reach), and which are feasible."""
        ahead, aside = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)]), jnp.stack([-jnp.sin(yaw), jnp.cos(yaw)])
        offset = seen.points - seen.centroid[None]
        x, y = offset @ ahead, offset @ aside - lateral
        near = jnp.min(jnp.where(seen.target, x, jnp.inf)) - grid.HEIGHTMAP_RESOLUTION / 2
        x = x - (near - STANDOFF)
        end = seen.centroid + (near - STANDOFF) * ahead + lateral * aside
        line = jnp.round((y + _HALF_LINES) / _FINEST).astype(jnp.int32)
        beside = (line < 0) | (line >= len(lines))
        line = jnp.clip(line, 0, len(lines) - 1)
        behind = x < -(_BEHIND + DISTANCE + MARGIN)

        def try_aperture(
            reach: jax.Array, wide: jax.Array, stations: jax.Array, half: jax.Array
        ) -> tuple[jax.Array, jax.Array]:
            hand, swept = (jnp.where(beside, -jnp.inf, table[line]) for table in (reach, wide))
            blocked = jnp.any(seen.obstacle & (x <= swept) & ~behind)
            cut = jnp.any(seen.target & (x <= hand))
            inside = ClosingRegion(stations, half, True).holds(jnp.stack([x, y], axis=-1))
            coverage = jnp.sum(seen.target & inside) / jnp.maximum(jnp.sum(seen.target), 1)
            overlap = jnp.sum(seen.obstacle & inside) * grid.HEIGHTMAP_RESOLUTION**2
            half_hand = jnp.max(jnp.where(jnp.isfinite(reach), jnp.abs(jnp.asarray(lines, jnp.float32)), 0.0))
            gap = jnp.where(jnp.isfinite(hand), x - hand, jnp.maximum(jnp.abs(y) - half_hand, x - jnp.max(reach)))
            clearance = jnp.min(jnp.where(seen.obstacle & ~behind, gap, _CLEAR), initial=_CLEAR)
            return clearance, ~blocked & ~cut & (coverage >= MIN_COVERAGE) & (overlap < MAX_OVERLAP)

        tables = (fronts, wide, stations, half_widths)
        clearance, fits = jax.vmap(try_aperture)(*(jnp.asarray(table, jnp.float32) for table in tables))
        start = end - DISTANCE * ahead
        in_reach = jnp.max(jnp.abs(start)) <= MAX_START
        fits &= jnp.any(seen.target) & in_reach
        strokes = jax.vmap(lambda aperture: push_grasp(start, yaw, aperture, final=True))(
            jnp.asarray(APERTURES, jnp.float32)
        )
        return strokes, jnp.where(in_reach, clearance, -jnp.inf), fits

    def final_stroke(state: EnvState, key: jax.Array) -> tuple[PushGrasp, jax.Array]:
        del key
        seen = look(state)
        yaws = 2 * jnp.pi / HEADINGS * jnp.arange(HEADINGS)

        def over_offsets(yaw: jax.Array) -> tuple[PushGrasp, jax.Array, jax.Array]:
            return jax.vmap(try_heading, (None, None, 0))(seen, yaw, jnp.asarray(LATERAL, jnp.float32))

        strokes, clearance, fits = jax.lax.map(over_offsets, yaws)
        alone = ~jnp.any(seen.obstacle) & jnp.any(seen.target)
        # Ties go to the offset and the aperture that come first: none, and the widest.
        score = jnp.where(fits, _CLEAR, 0.0) + clearance
        best = jnp.argmax(score.ravel())
        stroke = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[3:])[best], strokes)
        return stroke, fits.ravel()[best] | (alone & (score.ravel()[best] > -jnp.inf))

    return final_stroke


def make_cluster(robot: Robot) -> FinalStroke:
    """Return the criterion that no obstacle is within 10 mm; the last stroke begins anywhere beside the target."""
    del robot

    def final_stroke(state: EnvState, key: jax.Array) -> tuple[PushGrasp, jax.Array]:
        seen = look(state)
        shape = (grid.GRID_SIZE, grid.GRID_SIZE)
        distance = jnp.sqrt(squared_distance(seen.target.reshape(shape))).ravel()
        crowded = jnp.any(seen.obstacle & (distance * grid.HEIGHTMAP_RESOLUTION <= _FREE))
        to_centroid = jnp.linalg.norm(seen.points - seen.centroid[None], axis=1)
        starts = (distance >= _NEAR) & (distance <= _FAR) & ~seen.obstacle & (to_centroid <= DISTANCE)
        start = seen.points[jax.random.categorical(key, jnp.where(starts, 0.0, -jnp.inf))]
        toward = seen.centroid - start
        box = jnp.where(seen.target[:, None], seen.points, jnp.nan)
        side = jnp.max(jnp.nanmax(box, axis=0) - jnp.nanmin(box, axis=0)) + grid.HEIGHTMAP_RESOLUTION
        aperture = jnp.clip(1.531 - 4.677 * side - 0.05, APERTURE.low, APERTURE.high)
        yaw, length = jnp.arctan2(toward[1], toward[0]), jnp.linalg.norm(toward)
        stroke = push_grasp(start, yaw, aperture, distance=length, final=True)
        return stroke, jnp.any(seen.target) & ~crowded & jnp.any(starts)

    return final_stroke


def _widened(fronts: np.ndarray, lines: int) -> np.ndarray:
    """Return outlines [A, L] whose every line reaches as far as those within so many `lines` of it."""
    padded = np.pad(fronts, ((0, 0), (lines, lines)), constant_values=-np.inf)
    return np.max([padded[:, i : i + fronts.shape[1]] for i in range(2 * lines + 1)], axis=0)
