"""The driver of a UR arm, against the real client and a fake controller, and against what a client has heard."""

import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bundles import push_to, small_decider

from pregrasp_jax.deploy.decision import Decider
from pregrasp_jax.deploy.devices import DeviceError
from pregrasp_jax.deploy.guard import Limits
from pregrasp_jax.deploy.poses import grasp_point

FAKE = Path(__file__).parent / "fake_ur.py"


@pytest.fixture
def decider() -> Decider:
    return small_decider()


class Controller:
    """A fake controller in a process of its own."""

    def __init__(self, mode: str):
        pytest.importorskip("rtde_control")
        self.process = subprocess.Popen([sys.executable, FAKE, mode], stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        if self.process.stdout.readline() != "ready\n":
            self.stop()
            pytest.skip("the ports of a UR controller are taken on this machine")

    def stop(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture
def controller(request: pytest.FixtureRequest):
    running = Controller(request.param)
    yield running
    running.stop()


def make_arm(decider: Decider, **limits):
    from pregrasp_jax.deploy.drivers.ur import UrArm

    slow = Limits(age_s=1.0, **limits)  # this machine may be busy
    return UrArm("127.0.0.1", decider.body.arm, slow, speed=0.2, acceleration=1.0, payload_kg=0.8)


GROUP = pytest.mark.xdist_group("ur_ports")


@GROUP
@pytest.mark.parametrize("controller", ["normal"], indirect=True)
def test_a_ur_arm_makes_a_push(decider: Decider, controller: Controller):
    arm, push = make_arm(decider), push_to(decider)
    try:
        assert arm.joints().shape == (6,)
        arm.push(push)
        here = grasp_point(decider.body.arm, arm.state().tcp_pose)
        np.testing.assert_allclose(here, push.poses[-1, :3], atol=3e-3)
        arm.lift(0.05)
        lifted = grasp_point(decider.body.arm, arm.state().tcp_pose)
        np.testing.assert_allclose(lifted - here, [0, 0, 0.05], atol=3e-3)
        with pytest.raises(DeviceError, match="mm from where the push begins"):
            arm.push(push)
    finally:
        arm.close()


@GROUP
@pytest.mark.parametrize(
    ("controller", "said"),
    [
        ("turned", "turned by 1. degrees"),
        ("protective", "protective stop"),
        ("stall", "stalled"),
        ("push", "pushed with 80 N"),
        ("drop", "link|s old"),
    ],
    indirect=["controller"],
)
def test_a_push_that_goes_wrong_ends_in_one_line(decider: Decider, controller: Controller, said: str):
    arm = make_arm(decider)
    try:
        with pytest.raises(DeviceError, match=said) as stopped:
            arm.push(push_to(decider))
        assert "\n" not in str(stopped.value)
        if said.startswith("pushed"):
            places = [arm.state().tcp_pose for _ in range(2) if time.sleep(0.3) is None]
            np.testing.assert_allclose(places[0], places[1], atol=1e-3, err_msg="it goes on")
    finally:
        arm.close()


class Heard:
    """What a client has heard from a controller that says something every 8 ms until `silent`, s."""

    def __init__(self):
        self.now, self.silent = 0.0, np.inf

    def wait(self, seconds: float) -> None:
        self.now += seconds

    def getTimestamp(self) -> float:
        return 100.0 + 0.008 * (min(self.now, self.silent) // 0.008)

    def __getattr__(self, name: str) -> Any:
        vectors = {"getActualTCPForce": 6, "getActualQ": 6, "getActualTCPPose": 6}
        return lambda: np.zeros(vectors[name]) if name in vectors else name in ("getSafetyMode", "isConnected")


def test_what_was_said_during_a_pause_is_no_news(decider: Decider, monkeypatch: pytest.MonkeyPatch):
    from pregrasp_jax.deploy.drivers import ur

    heard = Heard()
    monkeypatch.setattr(ur.UrArm, "_connect", lambda self, *_: setattr(self, "_receive", heard))
    monkeypatch.setattr(ur, "time", SimpleNamespace(sleep=heard.wait))
    arm = ur.UrArm("", decider.body.arm, Limits(), speed=0.1, acceleration=0.5, clock=lambda: heard.now)
    for pause in (0.02, 3.0):
        heard.wait(pause)
        assert arm.joints().shape == (6,) and arm.state().age_s < 0.02
    heard.silent = heard.now + 0.05
    heard.wait(5.0)
    with pytest.raises(DeviceError, match=r"5\.\d+ s old"):
        arm.joints()


@GROUP
@pytest.mark.parametrize(
    ("controller", "said"),
    [("local", "not under remote control"), ("tcp", "tool centre point")],
    indirect=["controller"],
)
def test_a_controller_that_is_not_ready_is_refused(decider: Decider, controller: Controller, said: str):
    with pytest.raises(DeviceError, match=said):
        make_arm(decider)


def test_no_controller_is_one_line(decider: Decider):
    pytest.importorskip("rtde_control")
    from pregrasp_jax.deploy.drivers.ur import UrArm

    with pytest.raises(DeviceError, match=r"no UR controller at 127\.0\.0\.2"):
        UrArm("127.0.0.2", decider.body.arm, Limits(), speed=0.1, acceleration=0.5)
