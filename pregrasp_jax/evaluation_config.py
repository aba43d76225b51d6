"""What an evaluation is told: who plays, on which objects and scenes, and what it changes of the task.

The docstring under a field is its command-line help, as in `config`.
"""

import dataclasses
from dataclasses import dataclass, field
from typing import Any

from pregrasp_jax.config import (
    AssetsConfig,
    CameraName,
    Config,
    FreeSpace,
    PhysicsConfig,
    PlaceConfig,
    SceneConfig,
    TaskConfig,
)
from pregrasp_jax.ranges import RANGES
from pregrasp_jax.settings import check_ranges


@dataclass(frozen=True, kw_only=True)
class TaskOverrides:
    """What an evaluation may change of the task that a policy was trained for; null keeps it."""

    workspace: str | None = None
    """Where: `table`, `shelf`, `narrow` or another name in `spaces.workspace.WORKSPACES` (docs/confined.md)."""
    place: PlaceConfig = field(default_factory=PlaceConfig)
    mirrored_start: bool | None = None
    """Between walls, start in the mirror image of the arm's posture if the target lies on the right (y < 0)."""
    robot: str | None = None
    """Who, for scripts: a name in `robot.ROBOTS`. A trained policy knows one robot only."""
    primitive: str | None = None
    """Does what, for scripts: a name in `task.registry.KINDS`."""
    camera: CameraName | None = None
    """What the policy sees through (`orthographic` for scripts)."""
    sensor: str | None = None
    """What that camera, the masks and the objects get wrong: clean, d435, d455, or a .yaml file. Needs `pinhole`."""
    r_out: float | None = None
    """m, outer radius of the half ring."""
    obstacles_may_leave: bool = False
    """True counts failures as the paper does: an obstacle may leave the workspace, and stands beside it then."""


@dataclass(frozen=True, kw_only=True)
class StrokesOverrides:
    """What an evaluation may change of how Target-PPG plays; null keeps what its policy was trained with."""

    mask_radius: float | None = None
    """m; only strokes that begin so near to the target; 0 considers all."""
    free_space: FreeSpace | None = None
    """When it reaches for the target: once a stroke can take it and nothing else, or (`cluster`) once nothing stands
    within 10 mm of it."""


@dataclass(frozen=True, kw_only=True)
class PlanningConfig:
    """A search in a scene that is rebuilt from the camera's pictures, see docs/planning.md."""

    budget_ms: float = 0.0
    """ms for a decision: no round of simulations begins that would exceed it. 0 sets no limit, and results repeat."""
    candidates: int = 8
    """Pushes that the network proposes, 2 cm apart; scripts add up to 8, and to 12 in all."""
    variants: int = 6
    """Most rebuilt scenes in which a push is tried; all but the first have other poses, sides, masses and friction."""
    depth: int = 2
    """Pushes of the network that may follow a candidate."""
    networks: int = 2
    """Networks of the policy that value what a simulated push leads to, the first ones; all of them propose."""

    def validate(self) -> "PlanningConfig":
        """Return self.

        Raises:
            ValueError: a value is outside its range; one line names the key, the value and the range.
        """
        check_ranges(self, _PLANNING_RANGES, "planning.")
        return self


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """One evaluation."""

    policy: str
    """random, guided, straight, clear, lookahead, pretrained, cpu-1, or the folder of a run, a policy or a bundle. Of
    strokes (docs/baselines.md): ppg, target-ppg, strokes, target-strokes, a run of the preset `ppg`, or that as
    target-ppg:FOLDER."""
    assets: AssetsConfig = field(default_factory=AssetsConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    task: TaskOverrides = field(default_factory=TaskOverrides)
    strokes: StrokesOverrides = field(default_factory=StrokesOverrides)
    reachable: bool = False
    """Let a trained policy take the best push that the arm can make, as `deploy` does; False takes the best of all, and
    an episode ends by one that is out of reach, as in the paper."""
    plan: bool = False
    """Let a trained policy search in a rebuilt scene before every push."""
    planning: PlanningConfig = field(default_factory=PlanningConfig)
    episodes: int = 100
    """Test scenes to run, from the first; all policies meet the same."""
    seed: int = 0
    """Seed of the policy's own randomness; scenes, yaws and targets are fixed."""
    num_envs: int = 0
    """Scenes side by side, 0 chooses; with `native` results do not depend on it."""

    def validate(self) -> "EvaluationConfig":
        """Return self.

        Raises:
            ValueError: a number is out of range, or two settings contradict each other; one line says which.
        """
        if self.num_envs < 0:
            raise ValueError(
                f"num_envs = {self.num_envs} is out of range; allowed is 1 and more, or 0 to let it choose"
            )
        if self.episodes < 1:
            raise ValueError(f"episodes = {self.episodes} is out of range; allowed is 1 and more")
        if self.plan and self.reachable:
            raise ValueError(
                "reachable = True: plan = True takes no push that is out of reach; allowed is one of the two"
            )
        refuse_planning(self.plan, self.planning)
        return self


def refuse_planning(plan: bool, planning: PlanningConfig) -> None:
    """Refuse settings of a search that is not asked for, or out of range.

    Raises:
        ValueError: one line says which.
    """
    if not plan and planning != PlanningConfig():
        raise ValueError("planning.* is set, but plan = False; allowed is plan = True with it")
    planning.validate()


def environment_config(request: EvaluationConfig, trained: Config) -> Config:
    """Return the configuration of a policy with everything replaced that an evaluation decides.

    Raises:
        ValueError: out of range, or a contradiction; one line says what.
    """
    if trained.network.architecture == "compact" and (request.task.r_out or 0.0) > trained.task.r_out:
        raise ValueError(
            f"task.r_out = {request.task.r_out} is out of range; allowed for this policy, whose network values no "
            f"longer pushes, is {trained.task.r_in} to {trained.task.r_out}"
        )
    scenes, default = request.scene.test_scenes, SceneConfig().test_scenes
    if scenes < request.episodes and scenes != default:
        raise ValueError(
            f"scene.test_scenes = {scenes} are fewer than episodes = {request.episodes}; allowed is as many and more"
        )
    config = dataclasses.replace(
        trained,
        seed=request.seed,
        assets=request.assets,
        scene=dataclasses.replace(request.scene, test_scenes=max(scenes, request.episodes)),
        physics=request.physics,
        task=_task(trained.task, request.task),
        strokes=dataclasses.replace(trained.strokes, **given(request.strokes)),
    )
    return config.validate()


def refuse_other_hand(config: Config, trained: Config) -> None:
    """Refuse a robot or a primitive that a policy was not trained with.

    Raises:
        ValueError: one line says which.
    """
    for name in ("robot", "primitive"):
        asked, known = getattr(config.task, name), getattr(trained.task, name)
        if asked != known:
            raise ValueError(
                f"task.{name} = {asked!r}: the policy was trained with {known!r}, which is what is allowed"
            )


def given(overrides: TaskOverrides | PlaceConfig | StrokesOverrides) -> dict[str, Any]:
    """Return what is to be changed, by name."""
    return {key: value for key, value in vars(overrides).items() if value is not None}


def _task(trained: TaskConfig, overrides: TaskOverrides) -> TaskConfig:
    """Return the task of a policy, changed; another place has dimensions of its own."""
    elsewhere = overrides.workspace not in (None, trained.workspace)
    place = dataclasses.replace(PlaceConfig() if elsewhere else trained.place, **given(overrides.place))
    return dataclasses.replace(trained, **given(overrides) | {"place": place})


_PLANNING_RANGES: dict[str, tuple[float, float]] = {
    "budget_ms": (0.0, 600_000.0),
    "candidates": (1, 64),
    "variants": (1, 8),
    "depth": (0, 8),
    "networks": RANGES["network.members"],
}
