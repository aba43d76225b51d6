"""How a hand moves from one place to another: straight, with minimum jerk. For numpy and jax alike."""

from typing import Any, NamedTuple

from pregrasp_jax.spaces.arrays import namespace

Array = Any

SETTLE_TIME = 0.25
"""s of standing still after a push."""

APERTURE_TIME = 0.5
"""s for the fingers to open or close before a push that changes the aperture."""

TURN_SPEED = 1.5
"""rad/s, mean speed of a turn: a push that turns the hand farther than its length has time for takes longer."""


class Held(NamedTuple):
    """Where a hand is and how it is held, now or at T times.

    Attributes:
        xy: [..., 2] m.
        z: [...] m above the table.
        yaw: [...] rad.
        aperture: [...] rad.
    """

    xy: Array
    z: Array
    yaw: Array
    aperture: Array


class Line(NamedTuple):
    """A straight motion; leaves have the leading axis T of the times that were asked for.

    Attributes:
        xy: [T, 2] m.
        z: [T] m.
        yaw: [T] rad.
        aperture: [T] rad.
        seconds: () s, how long the motion takes, standing still included.
    """

    xy: Array
    z: Array
    yaw: Array
    aperture: Array
    seconds: Array


def straight_line(start: Held, end: Held, times: Array, *, push_speed: float, shortest: float) -> Line:
    """Change the aperture if it differs, move and turn, stand still.

    Args:
        start: where the hand is.
        end: where it goes; with that aperture it moves.
        times: [T] s.
        push_speed: m/s, mean speed of the minimum-jerk profile.
        shortest: s, the least time of a motion.
    """
    xp = namespace(times, end.xy, start.xy)
    distance = xp.linalg.norm(end.xy - start.xy)
    wait = xp.where(xp.abs(end.aperture - start.aperture) < 1e-6, 0.0, APERTURE_TIME)
    turn = xp.mod(end.yaw - start.yaw + xp.pi, 2 * xp.pi) - xp.pi
    duration = xp.maximum(xp.maximum(distance / push_speed, xp.abs(turn) / TURN_SPEED), shortest)
    share = minimum_jerk((times - wait) / duration)
    return Line(
        xy=start.xy[None] + share[:, None] * (end.xy - start.xy)[None],
        z=start.z + share * (end.z - start.z),
        yaw=start.yaw + share * turn,
        aperture=start.aperture + minimum_jerk(times / APERTURE_TIME) * (end.aperture - start.aperture),
        seconds=wait + duration + SETTLE_TIME,
    )


def minimum_jerk(share: Array) -> Array:
    """Return the travelled share [...] of a minimum-jerk motion after a `share` [...] of its time, clipped to [0, 1].

    Source: Flash and Hogan 1985, 10 s^3 - 15 s^4 + 6 s^5.
    """
    s = namespace(share).clip(share, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)
