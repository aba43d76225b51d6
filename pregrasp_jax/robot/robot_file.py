"""A robot's body as plain arrays, for a runtime that has no MuJoCo: what is needed to draw it and to reach with it."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from pregrasp_jax.robot.chain import LinkGeom, Links
from pregrasp_jax.robot.following import Body
from pregrasp_jax.robot.kinematics import Arm


class LinkHulls(NamedTuple):
    """Hulls of links; what drawing needs of `types.Hulls`.

    Attributes:
        vertices: [M, V, 3] float32 m, in link frames.
        planes: [M, F, 4] float32, inside iff n . x <= d.
    """

    vertices: np.ndarray
    planes: np.ndarray


_ARM = ("a", "d", "alpha", "world_from_base", "flange_from_hand", "limits", "max_speed")
_LINKS = ("parents", "fixed", "to_axis", "joint", "turn", "slide", "ancestors", "hull_links")


def to_arrays(body: Body) -> dict[str, np.ndarray]:
    """Return the arrays of a body by name; inverse of `from_arrays`."""
    links, geoms = body.links, body.links.geoms
    return {
        **{f"arm_{name}": np.asarray(getattr(body.arm, name)) for name in _ARM},
        **{f"links_{name}": np.asarray(getattr(links, name)) for name in _LINKS},
        "links_names": np.array(links.names),
        "hulls_vertices": np.asarray(links.hulls.vertices, np.float32),
        "hulls_planes": np.asarray(links.hulls.planes, np.float32),
        "geoms_name": np.array([geom.name for geom in geoms]),
        "geoms_link": np.array([geom.link for geom in geoms]),
        "geoms_radius": np.array([geom.radius for geom in geoms]),
        "geoms_size": np.array([len(geom.points) for geom in geoms]),
        "geoms_points": np.concatenate([geom.points for geom in geoms]),
        "geoms_above_table": np.array([_holds(body.above_table, geom) for geom in geoms]),
        "geoms_moving": np.array([_holds(body.moving, geom) for geom in geoms]),
    }


def from_arrays(arrays: Mapping[str, Any]) -> Body:
    """Return the body that arrays describe.

    Raises:
        KeyError: one is missing.
    """
    ends = np.cumsum(arrays["geoms_size"])[:-1]
    geoms = tuple(
        LinkGeom(str(name), int(link), points, float(radius))
        for name, link, points, radius in zip(
            arrays["geoms_name"],
            arrays["geoms_link"],
            np.split(arrays["geoms_points"], ends),
            arrays["geoms_radius"],
            strict=True,
        )
    )
    links = Links(
        names=tuple(str(name) for name in arrays["links_names"]),
        geoms=geoms,
        hulls=LinkHulls(arrays["hulls_vertices"], arrays["hulls_planes"]),
        **{name: arrays[f"links_{name}"] for name in _LINKS},
    )
    numbers = {name: arrays[f"arm_{name}"] for name in _ARM}
    return Body(
        arm=Arm(**(numbers | {"max_speed": float(numbers["max_speed"])})),
        links=links,
        above_table=[geom for geom, counts in zip(geoms, arrays["geoms_above_table"], strict=True) if counts],
        moving=[geom for geom, counts in zip(geoms, arrays["geoms_moving"], strict=True) if counts],
    )


def _holds(geoms: Any, wanted: LinkGeom) -> bool:
    return any(geom.name == wanted.name and geom.link == wanted.link for geom in geoms)
