"""What is kept of random strokes: stable grasps, with how far the push took an object from its nearest neighbour."""

import types

import jax.numpy as jnp
import numpy as np
import pytest

from pregrasp_jax.assets.bank import select
from pregrasp_jax.assets.sets import builtin_bank
from pregrasp_jax.policies.strokes import IndexedStroke
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.training.stroke_collection import Attempt, blank_positives, make_keep
from pregrasp_jax.types import MAX_OBJECTS

CAN = 0
"""A round object: two of them are as far apart as their centres, less a diameter."""

REACH = 0.2
"""m beyond which neighbours are not looked for."""


@pytest.fixture(scope="module")
def bank():
    bank = builtin_bank("seen")
    return select(bank, [bank.names.index("ycb_chips_can")])


@pytest.fixture(scope="module")
def keep(bank):
    return make_keep(bank)


def attempt(*scenes):
    """Return what was tried in scenes (slot of the stable grasp or None, {slot: (xy before, xy pushed)})."""
    object_ids = np.full((len(scenes), MAX_OBJECTS), -1)
    poses = np.stack([[parking_poses()] * 3] * len(scenes))
    stable = np.zeros((len(scenes), MAX_OBJECTS), bool)
    for row, (held, places) in enumerate(scenes):
        for slot, ways in places.items():
            object_ids[row, slot] = CAN
            for leg, xy in enumerate(ways):
                poses[row, leg, slot] = [*xy, 0.0, 1.0, 0.0, 0.0, 0.0]
        if held is not None:
            stable[row, held], poses[row, 2, held, 2] = True, 0.3
    numbers = np.arange(len(scenes))
    return Attempt(
        height=np.broadcast_to(numbers[:, None, None], (len(scenes), 100, 100)).astype(np.uint8),  # pyright: ignore
        stroke=IndexedStroke(jnp.asarray(1000 + numbers), jnp.asarray(0.6 + numbers / 100)),
        scene_ids=object_ids,  # pyright: ignore
        result=types.SimpleNamespace(outcome=types.SimpleNamespace(stable=stable)),  # pyright: ignore
        poses=poses,  # pyright: ignore
    )


def test_gains_are_how_far_the_nearest_neighbour_is_left_behind(bank, keep):
    away, far = ((-0.2, -0.2), (-0.2, -0.2)), ((0.0, 0.2), (0.0, 0.2))
    scenes = [
        (2, {2: ((0.0, 0.0), (0.05, 0.0)), 3: ((-0.08, 0.0), (-0.08, 0.0))}),  # 3 stays, 2 goes 5 cm away from it
        (3, {2: ((0.0, 0.0), (0.05, 0.0)), 3: ((-0.08, 0.0), (-0.08, 0.0))}),  # seen from the other one
        (5, {5: ((0.0, 0.0), (0.0, 0.03)), 1: ((0.1, 0.0), (0.1, 0.03)), 7: away}),  # pushed together
        (0, {0: ((0.0, 0.0), (0.04, 0.0)), 4: ((-0.09, 0.0), (-0.09, 0.0)), 6: ((0.2, 0.0), (0.13, 0.0))}),  # then 6
        (1, {1: ((0.0, 0.0), (0.1, 0.0))}),  # alone
        (1, {1: ((0.0, 0.0), (0.0, -0.15)), 2: far}),  # no nearer than is looked for
        (1, {1: ((0.1, 0.0), (0.0, 0.0)), 2: ((0.0, 0.0), (-0.08, 0.0))}),  # into it
    ]
    to_reach = REACH - (0.2 - float(bank.min_width[CAN]))
    gains = [0.05, 0.05, 0.0, 0.0, 0.0, to_reach, -0.02]
    positives = blank_positives(10)
    assert keep(positives, 0, attempt(*scenes)) == len(scenes)
    np.testing.assert_allclose(positives.gain[: len(scenes)], gains, atol=2e-3)
    assert not positives.gain[len(scenes) :].any()


def test_only_stable_grasps_are_kept_in_order_and_no_more_than_there_is_room(keep):
    alone = {4: ((0.0, 0.0), (0.05, 0.0))}
    tried = attempt((None, alone), (4, alone), (None, alone), (4, alone), (4, alone))
    positives = blank_positives(5)
    written = keep(positives, 0, tried)
    assert written == 3 and keep(positives, written, tried) == 5
    assert positives.index.tolist() == [1001, 1003, 1004, 1001, 1003]
    np.testing.assert_allclose(positives.aperture, 0.6 + (positives.index - 1000) / 100, atol=1e-6)
    assert (positives.height == (positives.index - 1000)[:, None, None]).all()
    assert keep(positives, 5, tried) == 5, "full"
