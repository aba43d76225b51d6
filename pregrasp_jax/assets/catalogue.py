"""The built-in objects: 26 household shapes made from primitives, and the processed bank that ships with the package.

`python -m pregrasp_jax.assets.catalogue` regenerates `catalogue.npz` beside this file.

Sizes follow the YCB object set (B. Calli et al., "Benchmarking in Manipulation Research: The YCB Object and Model
Set", 2015: dimensions and masses as its object table lists them) and products of the KIT ObjectModels database
(A. Kasper et al., 2012), which publishes scans but no table: those sizes are the nominal ones of the product, rounded
to 5 mm. Shapes are our own approximations, solid inside. Masses are YCB's where they lie in 0.08 to 0.6 kg; a YCB
object outside of that range (marked `partly full`) and every KIT object weighs 300 kg/m^3 of its volume, the density
that the real meshes are given. Objects shorter than the push height (the YCB mug, 82 mm) are scaled up and say so.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh

from pregrasp_jax.assets.bank import ConvexObject, load_bank, make_bank, save_bank, select
from pregrasp_jax.assets.decompose import decompose
from pregrasp_jax.assets.shapes import superellipse
from pregrasp_jax.types import HullBank

CATALOGUE_FILE = Path(__file__).with_name("catalogue.npz")

_SECTIONS = 48
"""Points around a cross-section."""


class Recipe(NamedTuple):
    """How to make one built-in object.

    Attributes:
        name: the set it comes from, and the product.
        build: returns the mesh in mm, z up.
        mass: kg, or None for the default density.
    """

    name: str
    build: Callable[[], trimesh.Trimesh]
    mass: float | None = None


def lathe(*profile: tuple[float, float]) -> trimesh.Trimesh:
    """Return the solid of revolution of a profile of (diameter, z), bottom to top."""
    return loft(*((z, diameter, diameter, 2.0) for diameter, z in profile))


def loft(*sections: tuple[float, float, float, float]) -> trimesh.Trimesh:
    """Return the solid through horizontal superellipses (z, width x, depth y, exponent), bottom to top."""
    rings = []
    for z, width, depth, exponent in sections:
        outline = superellipse(width, depth, exponent, _SECTIONS)
        rings.append(np.column_stack([outline, np.full(_SECTIONS, z)]))
    bottom, top = len(rings) * _SECTIONS, len(rings) * _SECTIONS + 1
    here = np.arange(_SECTIONS)
    after = (here + 1) % _SECTIONS
    faces = [np.column_stack([np.full(_SECTIONS, bottom), after, here])]
    for low in range(0, (len(rings) - 1) * _SECTIONS, _SECTIONS):
        high = low + _SECTIONS
        faces += [np.column_stack([low + here, low + after, high + after])]
        faces += [np.column_stack([low + here, high + after, high + here])]
    last = bottom - _SECTIONS
    faces.append(np.column_stack([np.full(_SECTIONS, top), last + here, last + after]))
    centres = [[0.0, 0.0, sections[0][0]], [0.0, 0.0, sections[-1][0]]]
    return trimesh.Trimesh(np.concatenate([*rings, centres]), np.concatenate(faces), process=False)


def box(width: float, depth: float, height: float, *, z: float = 0.0, x: float = 0.0) -> trimesh.Trimesh:
    """Return a sharp box centred at (x, 0) that stands on height z."""
    mesh = trimesh.creation.box((width, depth, height))
    mesh.apply_translation([x, 0.0, z + height / 2])
    return mesh


def carton(width: float, depth: float, height: float) -> trimesh.Trimesh:
    """Return a carton with slightly rounded upright edges."""
    return loft((0.0, width, depth, 12.0), (height, width, depth, 12.0))


def tube(thickness: float, *points: tuple[float, float]) -> trimesh.Trimesh:
    """Return a bent rod along points (x, z) in the plane y = 0."""
    path = [np.array([x, 0.0, z]) for x, z in points]
    rods = [trimesh.creation.cylinder(thickness / 2, segment=ends, sections=12) for ends in pairwise(path)]
    joints = [trimesh.creation.icosphere(subdivisions=1, radius=thickness / 2) for _ in path[1:-1]]
    for joint, point in zip(joints, path[1:-1], strict=True):
        joint.apply_translation(point)
    return join(*rods, *joints)


def join(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return several solids as one mesh; they may overlap."""
    return trimesh.util.concatenate(meshes)  # pyright: ignore[reportReturnType]


def trigger_head(z: float) -> trimesh.Trimesh:
    """Return the head of a spray bottle: neck, body with nozzle, and the trigger that hangs before it."""
    return join(
        loft((z - 2, 28, 28, 2.0), (z + 18, 26, 26, 2.0)),
        box(78, 26, 24, z=z + 16, x=10),
        tube(10, (36, z + 18), (32, z - 4), (38, z - 22)),
    )


SEEN: tuple[Recipe, ...] = (
    Recipe("ycb_master_chef_can", lambda: lathe((102, 0), (102, 139)), 0.414),
    Recipe("ycb_chips_can", lambda: lathe((75, 0), (75, 235), (77, 237), (77, 250)), 0.205),
    Recipe("ycb_mustard_bottle", lambda: _squeeze_bottle(85, 50, 175, neck=24), 0.603),
    Recipe("ycb_pitcher", lambda: _pitcher(108, 235), 0.178),
    # The table's 82 mm mug is lower than the pushes: scaled by 1.45 in height, 1.0 across.
    Recipe("ycb_mug_tall", lambda: _mug(80, 119), 0.118),
    # Standing on its battery: 35 x 46 x 184 mm; partly full.
    Recipe("ycb_power_drill", lambda: _drill(184)),
    # 85 x 85 x 200 mm, 0.729 kg; partly full.
    Recipe("ycb_wood_block", lambda: carton(85, 85, 200)),
    # 65 x 98 x 250 mm, 1.131 kg; partly full.
    Recipe("ycb_bleach_cleanser", lambda: _handled_bottle(98, 65, 250)),
    Recipe("kit_salt_cylinder", lambda: lathe((80, 0), (80, 150), (72, 156))),
    Recipe("kit_hygiene_spray", lambda: lathe((50, 0), (50, 135), (30, 150), (30, 175))),
    Recipe("kit_fruit_drink", lambda: carton(60, 70, 195)),
    Recipe("kit_shampoo", lambda: _squeeze_bottle(75, 45, 185, neck=32)),
    Recipe("kit_potato_dumplings", lambda: carton(75, 50, 145)),
    Recipe("kit_coke_bottle", lambda: _soda_bottle(62, 235)),
    Recipe("kit_jam_jar", lambda: lathe((66, 0), (76, 8), (76, 90), (64, 104), (64, 120))),
    Recipe("kit_spray_flask", lambda: _spray_flask(72, 200)),
    Recipe("kit_green_cup", lambda: lathe((56, 0), (84, 115))),
)
"""The 17 objects of training."""

UNSEEN: tuple[Recipe, ...] = (
    # 80 x 105 x 270 mm, 1.022 kg; partly full.
    Recipe("ycb_windex_bottle", lambda: _windex(95, 62, 250)),
    # The 175 x 89 x 38 mm box would not stand in a push: 50 % thicker.
    Recipe("ycb_sugar_box_thick", lambda: carton(89, 57, 175), 0.514),
    Recipe("kit_melfor_bottle", lambda: lathe((70, 0), (72, 6), (72, 130), (50, 165), (28, 195), (28, 235))),
    Recipe("kit_rusk", lambda: carton(95, 60, 180)),
    Recipe("kit_hot_pot", lambda: lathe((76, 0), (96, 20), (96, 100), (88, 112), (88, 125))),
    Recipe("kit_bath_detergent", lambda: _handled_bottle(90, 58, 215)),
    Recipe("kit_beer_mug", lambda: _mug(86, 150)),
    Recipe("kit_sunflower_oil", lambda: _waisted_bottle(78, 245)),
    Recipe("kit_tea_box", lambda: carton(70, 66, 125)),
)
"""The 9 objects of evaluation only."""


def builtin_bank(object_set: str) -> HullBank:
    """Return the processed built-in objects of one set, `seen` or `unseen`.

    Raises:
        ValueError: another name.
    """
    recipes = {"seen": SEEN, "unseen": UNSEEN}
    if object_set not in recipes:
        raise ValueError(f"object set '{object_set}' is unknown; allowed are {', '.join(recipes)}")
    bank = load_bank(CATALOGUE_FILE)
    return select(bank, [bank.names.index(recipe.name) for recipe in recipes[object_set]])


def process(recipe: Recipe) -> ConvexObject:
    """Build and decompose one built-in object; deterministic."""
    mesh = recipe.build()
    mesh.apply_scale(1e-3)
    return ConvexObject(recipe.name, decompose(mesh), mass=recipe.mass)


def _squeeze_bottle(width: float, depth: float, height: float, *, neck: float) -> trimesh.Trimesh:
    shoulder = 0.75 * height
    return loft(
        (0, 0.96 * width, 0.96 * depth, 3.0),
        (6, width, depth, 3.0),
        (shoulder, 0.95 * width, 0.92 * depth, 2.6),
        (0.84 * height, 1.3 * neck, 1.2 * neck, 2.2),
        (0.85 * height, neck, neck, 2.0),
        (height, 0.8 * neck, 0.8 * neck, 2.0),
    )


def _soda_bottle(diameter: float, height: float) -> trimesh.Trimesh:
    profile = ((0.85, 0.0), (1.0, 0.05), (1.0, 0.35), (0.9, 0.45), (1.0, 0.55), (0.95, 0.65), (0.45, 0.88), (0.45, 1.0))
    return lathe(*((d * diameter, z * height) for d, z in profile))


def _waisted_bottle(diameter: float, height: float) -> trimesh.Trimesh:
    profile = ((0.97, 0.0), (1.0, 0.03), (1.0, 0.3), (0.78, 0.42), (0.78, 0.5), (0.98, 0.62), (0.4, 0.85), (0.4, 1.0))
    return lathe(*((d * diameter, z * height) for d, z in profile))


def _mug(diameter: float, height: float) -> trimesh.Trimesh:
    r = diameter / 2
    handle = ((r - 4, 0.82 * height), (r + 26, 0.76 * height), (r + 26, 0.32 * height), (r - 4, 0.22 * height))
    return join(lathe((diameter, 0), (diameter, height)), tube(12, *handle))


def _pitcher(diameter: float, height: float) -> trimesh.Trimesh:
    r = diameter / 2
    body = lathe((0.86 * diameter, 0), (diameter, height))
    handle = ((r - 6, 0.88 * height), (r + 36, 0.84 * height), (r + 30, 0.34 * height), (r - 8, 0.28 * height))
    return join(body, tube(16, *handle))


def _drill(height: float) -> trimesh.Trimesh:
    return join(
        loft((0, 80, 70, 6.0), (45, 78, 66, 6.0)),
        loft((40, 38, 34, 4.0), (height - 40, 40, 36, 4.0)),
        box(110, 46, 46, z=height - 46, x=10),
        tube(22, (60, height - 23), (90, height - 23)),
    )


def _handled_bottle(width: float, depth: float, height: float) -> trimesh.Trimesh:
    half = width / 2
    body = loft(
        (0, width, depth, 4.0), (0.52 * height, width, depth, 4.0), (0.62 * height, 0.6 * width, 0.8 * depth, 3.0)
    )
    neck = loft((0.6 * height, 0.5 * width, 0.6 * depth, 2.5), (0.88 * height, 34, 34, 2.0), (height, 30, 30, 2.0))
    handle = tube(20, (6, 0.86 * height), (half - 12, 0.78 * height), (half - 12, 0.5 * height))
    return join(body, neck, handle)


def _spray_flask(diameter: float, height: float) -> trimesh.Trimesh:
    shoulder = height - 40
    body = lathe((diameter, 0), (diameter, 0.6 * shoulder), (0.75 * diameter, 0.85 * shoulder), (30, shoulder))
    return join(body, trigger_head(shoulder))


def _windex(width: float, depth: float, height: float) -> trimesh.Trimesh:
    shoulder = height - 40
    body = loft(
        (0, width, depth, 3.5),
        (0.45 * shoulder, width, depth, 3.5),
        (0.6 * shoulder, 0.6 * width, 0.8 * depth, 3.0),
        (0.8 * shoulder, 0.62 * width, 0.75 * depth, 2.5),
        (shoulder, 30, 30, 2.0),
    )
    return join(body, trigger_head(shoulder))


def main(recipes: Sequence[Recipe] = (*SEEN, *UNSEEN)) -> None:
    """Regenerate the shipped bank."""
    bank = make_bank([process(recipe) for recipe in recipes])
    save_bank(CATALOGUE_FILE, bank)
    print(f"{CATALOGUE_FILE.name}: {len(bank.names)} objects, {len(bank.full.vertices)} hulls, {bank.content_hash}")


if __name__ == "__main__":
    main()
