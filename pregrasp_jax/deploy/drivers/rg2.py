"""An OnRobot RG2 by Modbus TCP through its Compute Box, with pymodbus (extra `robot`).

Source of the registers: OnRobot's connectivity guide. Widths are in 1/10 mm, forces in 1/10 N.
"""

import time
from collections.abc import Callable
from typing import Any

from pregrasp_jax.deploy.devices import DeviceError, refuse_missing
from pregrasp_jax.messages import one_line

MAX_FORCE_N = 40.0

_TARGET, _STATUS, _WIDTH = 0x0000, 0x010C, 0x0113
"""The width is the one with fingertips, as it is commanded; 0x010B has it without."""

_GRIP_WITH_OFFSET, _STOP = 16, 8
_BUSY, _HELD, _SWITCHES, _SAFETY_ERROR = 1 << 0, 1 << 1, 0b111100, 1 << 6
_WIDTH_ERROR = 0.004
"""m; how far from where they were sent the fingers may stand before a push."""

_PERIOD = 0.02
_BEGINS = 0.3
"""s within which the fingers begin to move, if they have to."""

_TIMEOUT = 3.0
"""s for the fingers to arrive; the whole way takes under 1 s."""


class Rg2:
    """The gripper."""

    def __init__(
        self,
        host: str,
        *,
        port: int = 502,
        unit: int = 65,
        force_n: float = 20.0,
        max_width_m: float = 0.110,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Connect, and refuse a gripper that is not ready.

        Args:
            host: name or address of the Compute Box.
            port: of it.
            unit: 65; 66 and 67 on a dual changer.
            force_n: of a grasp.
            max_width_m: between the fingertips, all the way open.
            clock: s.

        Raises:
            DeviceError: not installed, not there, or a safety switch has tripped.
            ValueError: a force that it does not have.
        """
        if not 3.0 <= force_n <= MAX_FORCE_N:
            raise ValueError(f"gripper force = {force_n} N is out of range; allowed is 3 to {MAX_FORCE_N:g}")
        self._unit, self._force, self._width, self._clock = unit, force_n, max_width_m, clock
        try:
            from pymodbus.client import ModbusTcpClient
            from pymodbus.exceptions import ModbusException
        except ImportError as error:
            raise refuse_missing("pymodbus", "robot", error) from None
        self._errors = (ModbusException, OSError)
        self._client = ModbusTcpClient(host, port=port, timeout=1.0, retries=0)
        if not self._client.connect():
            raise DeviceError(f"no gripper at {host}:{port}; is the Compute Box on, and in this network?")
        try:
            self._status()
        except BaseException:
            self.close()
            raise

    def opening(self) -> float:
        """Return how far it is open, measured."""
        return min(max(self._read(_WIDTH) * 1e-4 / self._width, 0.0), 1.0)

    def move(self, opening: float) -> None:
        """Open or close to a share of the widest opening, and wait for it."""
        if not 0.0 <= opening <= 1.0:
            raise DeviceError(f"gripper opening = {opening}; allowed is 0 to 1")
        self._send(opening * self._width)
        wanted, stands = opening * self._width, self._read(_WIDTH) * 1e-4
        if abs(stands - wanted) > _WIDTH_ERROR:
            raise DeviceError(
                f"the gripper stands {stands * 1e3:.0f} mm open instead of {wanted * 1e3:.0f}; allowed are "
                f"{_WIDTH_ERROR * 1e3:.0f} mm of difference. Something is in the way of its fingers"
            )

    def grasp(self) -> bool:
        """Close with constant force; return whether something is held."""
        return bool(self._send(0.0) & _HELD)

    def close(self) -> None:
        """Let go of the connection."""
        self._client.close()

    def _send(self, width_m: float) -> int:
        """Command a width, wait until the fingers stand still, and return the status."""
        self._status()
        words = [round(self._force * 10), round(width_m * 1e4), _GRIP_WITH_OFFSET]
        self._call(self._client.write_registers, _TARGET, words)
        begun = self._clock()
        while not (status := self._status()) & _BUSY and self._clock() - begun < _BEGINS:
            time.sleep(_PERIOD)
        while (status := self._status()) & _BUSY:
            if self._clock() - begun > _TIMEOUT:
                self._call(self._client.write_registers, _TARGET, [words[0], words[1], _STOP])
                raise DeviceError(f"the gripper is still busy after {_TIMEOUT:g} s")
            time.sleep(_PERIOD)
        return status

    def _status(self) -> int:
        status = self._read(_STATUS)
        if status & (_SWITCHES | _SAFETY_ERROR):
            raise DeviceError(
                f"a safety switch of the gripper has tripped (status {status:#04x}); free it, then switch it off and on"
            )
        return status

    def _read(self, register: int) -> int:
        return int(self._call(self._client.read_holding_registers, register, count=1).registers[0])

    def _call(self, function: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """Call the client; errors come back as answers."""
        try:
            answer = function(*args, device_id=self._unit, **options)
        except self._errors as error:
            raise DeviceError(f"the gripper does not answer ({one_line(error)})") from None
        if answer.isError():
            raise DeviceError(f"the gripper refuses ({answer}); is its unit id {self._unit}?")
        return answer
