"""Supervised learning of strokes from stable grasps, as PPG does it.

The start of a stroke is a class among all cells of the padded map, turned back to where it came from; its loss is the
binary cross-entropy of the softmax against that one cell, summed over cells. The aperture's is smooth L1.
"""

from typing import Any, NamedTuple

import flax.struct as struct
import jax
import jax.numpy as jnp
import optax

from pregrasp_jax.config import StrokesConfig
from pregrasp_jax.learning import stroke_network as networks
from pregrasp_jax.learning.networks import same_shapes
from pregrasp_jax.learning.stroke_network import ApertureNetwork, StrokeNetwork
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.actions import ActionSpace
from pregrasp_jax.spaces.turned_grid import PAD, SIZE
from pregrasp_jax.task.push_grasp import HEADINGS

_QUARTER = HEADINGS // 4
"""Headings in a quarter turn."""

_MOST_SCENES = 4
"""Headings of a scene that are looked at together: more take memory, fewer take time."""


class Demonstration(NamedTuple):
    """A stroke that ended in a stable grasp.

    Attributes:
        height: [H, W] m before it.
        row: () int32 of its start.
        col: () int32.
        heading: () int32.
        aperture: () float32, share of its range.
    """

    height: jax.Array
    row: jax.Array
    col: jax.Array
    heading: jax.Array
    aperture: jax.Array


class Losses(NamedTuple):
    """Losses [...] of a demonstration.

    Attributes:
        start: of its start and heading.
        aperture: of its aperture.
    """

    start: jax.Array
    aperture: jax.Array


class Learner(struct.PyTreeNode):
    """Parameters that are being learnt.

    Attributes:
        params: {"start": ..., "aperture": ...} of the two networks.
        opt_state: of Adam.
        updates: () int32.
    """

    params: Any
    opt_state: Any
    updates: jax.Array


class StrokeFunction:
    """The two networks of a configuration."""

    def __init__(self, config: StrokesConfig, actions: ActionSpace):
        """Make them; parameters are kept outside."""
        self.start = StrokeNetwork(config.width, normalized=config.normalization == "batch")
        self.aperture = ApertureNetwork()
        self.actions = actions

    def init(self, key: jax.Array) -> Any:
        """Return initial parameters."""
        start_key, aperture_key = jax.random.split(key)
        return {
            "start": self.start.init(start_key, jnp.zeros((1, SIZE, SIZE)))["params"],
            "aperture": self.aperture.init(aperture_key, jnp.zeros((1, networks.WINDOW, networks.WINDOW)))["params"],
        }

    def fits(self, params: Any) -> bool:
        """Return whether parameters belong to these networks."""
        return same_shapes(params, jax.eval_shape(self.init, jax.random.key(0)))

    def values(self, params: Any, height: jax.Array) -> jax.Array:
        """Return the logits [H, W, K] of all starts and headings on a height map [H, W] m."""
        image = networks.padded(height)

        def look(headings: jax.Array) -> jax.Array:
            turned = jax.vmap(networks.turn, (None, 0))(image, headings)
            logits = self.start.apply({"params": params["start"]}, turned)
            return networks.crop(jax.vmap(networks.turn_back)(jnp.asarray(logits), headings))

        maps = jax.lax.map(look, jnp.arange(HEADINGS).reshape(-1, _MOST_SCENES))
        return jnp.moveaxis(maps.reshape(HEADINGS, *height.shape), 0, -1)

    def aperture_of(self, params: Any, height: jax.Array, index: jax.Array) -> jax.Array:
        """Return the aperture () rad for the stroke of a flat index () int32."""
        window = networks.window(height, *self.actions.unravel(index))
        share = jnp.asarray(self.aperture.apply({"params": params["aperture"]}, window[None]))[0]
        return networks.to_aperture(share)

    def losses(self, params: Any, batch: Demonstration, *, train: bool) -> tuple[Losses, Any]:
        """Return the losses [B] of demonstrations [B], and the moments of their batch (empty unless `train`)."""
        turned = jax.vmap(lambda height, heading: networks.turn(networks.padded(height), heading))(
            batch.height, batch.heading
        )
        variables = {"params": params["start"]}
        if train:
            logits, sown = self.start.apply(variables, turned, train=True, mutable=["moments"])
        else:
            logits, sown = self.start.apply(variables, turned), {}
        start = jax.vmap(start_loss)(jnp.asarray(logits), batch.row, batch.col, batch.heading)
        windows = jax.vmap(networks.window)(batch.height, batch.row, batch.col, batch.heading)
        shares = jnp.asarray(self.aperture.apply({"params": params["aperture"]}, windows))
        return Losses(start, optax.huber_loss(shares, batch.aperture)), sown.get("moments", {})


def start_loss(logits: jax.Array, row: jax.Array, col: jax.Array, heading: jax.Array) -> jax.Array:
    """Return the loss () of the logits [SIZE, SIZE] of a turned map for the start of a stroke on the map itself."""
    log_p = jax.nn.log_softmax(networks.turn_back(logits, heading).ravel())
    label = (row + PAD) * SIZE + col + PAD
    others = jnp.log1p(-jnp.minimum(jnp.exp(log_p), 1 - 1e-6))
    return -(log_p[label] + jnp.sum(others) - others[label])


def make_optimizer(config: StrokesConfig, num_updates: int) -> optax.GradientTransformation:
    """Return Adam whose step size falls to 0 along a half cosine."""
    return optax.adam(optax.cosine_decay_schedule(config.learning_rate, max(num_updates, 1)))


def update(
    function: StrokeFunction, optimizer: optax.GradientTransformation, learner: Learner, batch: Demonstration
) -> tuple[Learner, Losses]:
    """Take one step of Adam; return the new learner and the mean losses."""

    def objective(params: Any) -> tuple[jax.Array, tuple[Losses, Any]]:
        losses, moments = function.losses(params, batch, train=True)
        mean = jax.tree.map(jnp.mean, losses)
        return mean.start + mean.aperture, (mean, moments)

    grads, (mean, moments) = jax.grad(objective, has_aux=True)(learner.params)
    updates, opt_state = optimizer.update(grads, learner.opt_state, learner.params)
    params: Any = optax.apply_updates(learner.params, updates)
    params = {**params, "start": networks.with_moments(params["start"], moments)}
    return Learner(params, opt_state, learner.updates + 1), mean


def demonstration(height: jax.Array, index: jax.Array, aperture: jax.Array, actions: ActionSpace) -> Demonstration:
    """Return what is learnt from a stored grasp: height [H, W] uint8, flat index (), aperture () rad."""
    row, col, heading = actions.unravel(index)
    share = networks.from_aperture(aperture)
    return Demonstration(grid.dequantize_height(height), row, col, heading, share)


def turned_at_random(key: jax.Array, shown: Demonstration) -> Demonstration:
    """Turn a scene and its stroke by a random number of right angles, and reflect them with probability 1/2."""
    turn_key, mirror_key = jax.random.split(key)
    last = shown.height.shape[0] - 1
    images, rows, cols, headings = [shown.height], [shown.row], [shown.col], [shown.heading]
    for _ in range(3):
        # By a right angle from x to y: what was in row r and column c comes to row c and column -r.
        images.append(images[-1][::-1].T)
        rows, cols = [*rows, cols[-1]], [*cols, last - rows[-1]]
        headings.append((headings[-1] + _QUARTER) % HEADINGS)
    turns = jax.random.randint(turn_key, (), 0, 4)
    image, row, col, heading = (jnp.stack(choices)[turns] for choices in (images, rows, cols, headings))
    mirrored = jax.random.bernoulli(mirror_key)
    return Demonstration(
        height=jnp.where(mirrored, image[::-1], image),
        row=jnp.where(mirrored, last - row, row),
        col=col,
        heading=jnp.where(mirrored, -heading % HEADINGS, heading),
        aperture=shown.aperture,
    )
