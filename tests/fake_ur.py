"""A UR controller on the loopback, for the real ur-rtde client: RTDE on 30004, dashboard on 29999, scripts on 30003.

A process of its own (`python fake_ur.py MODE`), because the client's constructors hold the interpreter's lock. It
integrates straight motions of the tool, and its mode says what goes wrong during the first one: nothing, `protective`
stop, `stall`, `drop` of the link, `push` back with a force, or from the start `local` control, a wrong `tcp`, a hand
that is `turned`.
"""

import math
import select
import socket
import struct
import sys
import threading
import time

HOST, RATE = "127.0.0.1", 125.0
START = [-0.45, 0.0, 0.1, 1.2092, -1.2092, -1.2092]
TCP = [0.0, 0.0, 0.172, 0.0, 0.0, 0.0]
MOVE_L, MOVE_L_PATH = 3, 47

TYPES = {"DOUBLE": "d", "VECTOR6D": "6d", "VECTOR3D": "3d", "VECTOR6INT32": "6i", "UINT64": "Q", "UINT32": "I"}
TYPES |= {"INT32": "i", "UINT8": "B", "BOOL": "?"}

VECTORS = ("target_q", "target_qd", "target_qdd", "target_current", "target_moment", "actual_q", "actual_qd")
VECTORS += ("actual_current", "joint_control_output", "actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force")
VECTORS += ("target_TCP_pose", "target_TCP_speed", "joint_temperatures", "actual_joint_voltage", "ft_raw_wrench")
VECTORS += ("actual_current_window",)


def type_of(name: str) -> str:
    if name in VECTORS:
        return "VECTOR6D"
    if name in ("actual_tool_accelerometer", "payload_cog"):
        return "VECTOR3D"
    if name == "joint_mode":
        return "VECTOR6INT32"
    if name in ("actual_digital_input_bits", "actual_digital_output_bits"):
        return "UINT64"
    if name in ("runtime_state", "robot_status_bits", "safety_status_bits") or "_bit_registers" in name:
        return "UINT32"
    if name in ("robot_mode", "safety_mode", "safety_status") or "int_register" in name:
        return "INT32"
    if name.endswith("_mask") or name in (
        "standard_digital_output",
        "configurable_digital_output",
        "tool_digital_output",
    ):
        return "UINT8"
    if name in ("tool_output_mode", "standard_analog_output_type", "tool_output_voltage", "tool_mode"):
        return "UINT8"
    if name.startswith("speed_slider_mask"):
        return "UINT32"
    return "DOUBLE"


class Controller:
    """What the robot is doing; all threads read and write it under one lock."""

    def __init__(self, mode: str):
        self.mode, self.lock = mode, threading.Lock()
        self.pose, self.velocity, self.goal = list(START), [0.0] * 6, None
        if mode == "turned":
            self.pose[3:] = [1.0, -1.2092, -1.2092]
        self.speed, self.force = 0.1, [0.0] * 6
        self.runtime, self.status, self.ready, self.safety = 1, 1, 0, 1
        self.moved, self.frozen, self.dropped, self.stopping, self.answered = 0.0, False, False, False, True
        self.inputs: dict[str, float] = {}

    def value(self, name: str):
        if name == "timestamp":
            return time.monotonic()
        if name in ("actual_TCP_pose", "target_TCP_pose"):
            return self.pose
        if name in ("actual_TCP_speed", "target_TCP_speed"):
            return self.velocity
        if name == "actual_TCP_force":
            return self.force
        if name in ("actual_q", "target_q"):
            return [0.0, -1.5, 1.5, 0.0, 1.5, 0.0]
        fixed = {"runtime_state": self.runtime, "robot_status_bits": self.status, "robot_mode": 7}
        fixed |= {"safety_mode": self.safety, "safety_status": self.safety, "output_int_register_0": self.ready}
        fixed |= {
            "safety_status_bits": 1 if self.safety == 1 else 4,
            "speed_scaling": 1.0,
            "target_speed_fraction": 1.0,
        }
        if name in fixed:
            return fixed[name]
        if name.startswith("output_double_register_"):
            index = int(name.rsplit("_", 1)[1])
            wrong = 0.05 if self.mode == "tcp" and index == 2 else 0.0
            return TCP[index] + wrong if index < 6 else 0.0
        layout = TYPES[type_of(name)]
        return [0] * int(layout[0]) if layout[0].isdigit() else 0

    def command(self, values: dict[str, float]) -> None:
        """Take what the client has written into the input registers."""
        self.inputs |= values
        code = int(self.inputs.get("input_int_register_0", 0))
        if code in (0, 255):
            if code == 255:
                self.runtime, self.ready = 1, 0
            elif self.ready == 2:
                self.ready = 1
            return
        if self.ready != 1:
            return
        numbers = [self.inputs.get(f"input_double_register_{i}", 0.0) for i in range(8)]
        if code == MOVE_L:
            self.goal, self.speed = numbers[:6], numbers[6]
        elif self.goal is not None:  # a stop of any kind
            self.goal, self.velocity = None, [0.0] * 6
        asynchronous = code == MOVE_L and int(self.inputs.get("input_int_register_1", 0)) == 1
        self.answered = self.goal is None or asynchronous
        if self.answered:
            self.ready = 2

    def advance(self, dt: float) -> None:
        if self.goal is None or self.frozen:
            return
        along = [g - p for g, p in zip(self.goal[:3], self.pose[:3], strict=True)]
        left = math.sqrt(sum(x * x for x in along))
        step = min(self.speed * dt, left)
        if left < 1e-6:
            self.goal, self.velocity = None, [0.0] * 6
            if not self.answered:  # else the client is through with this command, and would take it for the next one's
                self.ready, self.answered = 2, True
            return
        self.velocity = [x / left * self.speed for x in along] + [0.0] * 3
        self.pose = [p + x / left * step for p, x in zip(self.pose[:3], along, strict=True)] + list(self.goal[3:])
        self.moved += step
        if self.moved > 0.03:
            self._go_wrong()

    def _go_wrong(self) -> None:
        if self.mode == "protective":
            self.safety, self.runtime, self.frozen, self.velocity = 3, 4, True, [0.0] * 6
        elif self.mode == "stall":
            self.frozen, self.velocity = True, [0.0] * 6
        elif self.mode == "push":
            self.force = [80.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        elif self.mode == "drop":
            self.dropped = True


def pack(kind: int, payload: bytes) -> bytes:
    return struct.pack(">HB", len(payload) + 3, kind) + payload


def serve_rtde(controller: Controller, connection: socket.socket) -> None:
    recipes: dict[int, list[tuple[str, str]]] = {}
    outputs: list[tuple[str, str]] = []
    started, buffer, period, following = False, b"", 1 / RATE, time.monotonic()
    connection.setblocking(False)
    try:
        while not controller.dropped:
            readable, _, _ = select.select([connection], [], [], 0.001)
            if readable:
                data = connection.recv(65536)
                if not data:
                    return
                buffer += data
            while len(buffer) >= 3 and len(buffer) >= struct.unpack(">H", buffer[:2])[0]:
                size = struct.unpack(">H", buffer[:2])[0]
                kind, payload, buffer = buffer[2], buffer[3:size], buffer[size:]
                if kind == 86:
                    answer = b"\x01"
                elif kind == 118:
                    answer = struct.pack(">IIII", 5, 11, 0, 0)
                elif kind == 79:
                    names = payload[8:].decode().split(",")
                    outputs = [(name, type_of(name)) for name in names if name]
                    answer = b"\x01" + ",".join(kind for _, kind in outputs).encode()
                elif kind == 73:
                    names = [name for name in payload.decode().split(",") if name]
                    recipe = len(recipes) + 1
                    recipes[recipe] = [(name, type_of(name)) for name in names]
                    answer = bytes([recipe]) + ",".join(kind for _, kind in recipes[recipe]).encode()
                elif kind == 83:
                    started, answer = True, b"\x01"
                elif kind == 80:
                    started, answer = False, b"\x01"
                elif kind == 85:
                    fields = recipes[payload[0]]
                    layout = ">" + "".join(TYPES[kind] for _, kind in fields)
                    values = struct.unpack(layout, payload[1 : 1 + struct.calcsize(layout)])
                    with controller.lock:
                        controller.command(dict(zip([name for name, _ in fields], values, strict=True)))
                    continue
                else:
                    continue
                connection.sendall(pack(kind, answer))
            now = time.monotonic()
            if started and now >= following:
                following = now + period
                with controller.lock:
                    row = b"".join(
                        struct.pack(">" + TYPES[kind], *(v if isinstance(v, list) else [v]))
                        for v, kind in ((controller.value(name), kind) for name, kind in outputs)
                    )
                connection.sendall(pack(85, b"\x01" + row))
    except OSError:
        return
    finally:
        connection.close()


def serve_dashboard(controller: Controller, connection: socket.socket) -> None:
    answers = {"polyscopeversion": "URSoftware 5.11.0.108249 (Jan 01 2022)", "get serial number": "20195500001"}
    answers |= {"robotmode": "Robotmode: RUNNING", "get robot model": "UR5"}
    connection.sendall(b"Connected: Universal Robots Dashboard Server\n")
    with connection, connection.makefile("r") as lines:
        for line in lines:
            asked = line.strip().lower()
            if asked == "is in remote control":
                said = "false" if controller.mode == "local" else "true"
            elif asked == "safetystatus":
                said = "Safetystatus: " + ("NORMAL" if controller.safety == 1 else "PROTECTIVE_STOP")
            else:
                said = answers.get(asked, "could not understand")
            try:
                connection.sendall((said + "\n").encode())
            except OSError:
                return


def serve_script(controller: Controller, connection: socket.socket) -> None:
    with connection:
        while data := connection.recv(65536):
            if data.strip():
                with controller.lock:
                    controller.runtime, controller.status, controller.ready = 2, 3, 1


def listen(port: int, serve, controller: Controller) -> None:
    with socket.create_server((HOST, port)) as server:
        while True:
            connection, _ = server.accept()
            if controller.dropped:
                connection.close()
                continue
            threading.Thread(target=serve, args=(controller, connection), daemon=True).start()


def main(mode: str) -> None:
    controller = Controller(mode)
    for port, serve in ((30004, serve_rtde), (29999, serve_dashboard), (30003, serve_script), (30002, serve_script)):
        threading.Thread(target=listen, args=(port, serve, controller), daemon=True).start()
    time.sleep(0.05)
    print("ready", flush=True)
    last = time.monotonic()
    while True:
        time.sleep(0.004)
        now = time.monotonic()
        with controller.lock:
            controller.advance(now - last)
        last = now


if __name__ == "__main__":
    main(sys.argv[1])
